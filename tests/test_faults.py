"""Faults around clsurf: forks and threads, full disks, caches that cannot be written, devices that fail, Ctrl-C."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import types

import numpy as np
import pyopencl as cl
import pytest

import clsurf
from clsurf.device import open_device
from clsurf.device.program import Kernel
from clsurf.errors import DeviceError, DeviceMemoryError

SIZE = (48, 40)


@pytest.fixture(scope="module")
def slim(device):
    return clsurf.build_slim(clsurf.models.torus(1500), error=0.02, device=device)


def picture(slim, device):
    return clsurf.render(slim, size=SIZE, device=device).color


def draw_in_child(slim, selector, answers):
    answers.put(picture(slim, selector))


@pytest.mark.parametrize("how", ["fork", "spawn"])
def test_processes_draw_what_their_parent_drew(slim, device, how):
    """PoCL's threads are not copied by a fork: without care the child waits for ever."""
    wanted = picture(slim, device)
    selector = os.environ.get("CLSURF_DEVICE") or "pocl"
    context = multiprocessing.get_context(how)
    answers = context.Queue()
    child = context.Process(target=draw_in_child, args=(slim, selector, answers))
    child.start()
    got = answers.get(timeout=240)
    child.join(60)
    assert child.exitcode == 0
    np.testing.assert_array_equal(got, wanted)


def draw_with(device, slim, renderer, answers):
    answers.put(picture(slim, device))
    try:
        renderer.render(slim, size=SIZE)
        answers.put("drawn")
    except DeviceError as error:
        answers.put(str(error))


def test_what_a_fork_inherits(slim, device):
    """An opened device is opened anew in a child; a renderer says what to do."""
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    with clsurf.Renderer(device) as renderer:
        child = context.Process(target=draw_with, args=(device, slim, renderer, answers))
        child.start()
        np.testing.assert_array_equal(answers.get(timeout=240), picture(slim, device))
        assert "make a new Renderer" in answers.get(timeout=60)
        child.join(60)
    assert child.exitcode == 0


def test_renderers_in_threads(slim, device):
    """Threads that draw at once get the picture that one alone gets."""
    wanted, got = picture(slim, device), []

    def draw():
        with clsurf.Renderer(device) as renderer:
            got.extend(renderer.render(slim, size=SIZE).color for _ in range(4))
    threads = [threading.Thread(target=draw) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(240)
    assert len(got) == 16
    for color in got:
        np.testing.assert_array_equal(color, wanted)


SAVE = """
import resource, signal, sys
import clsurf, numpy as np
from clsurf.surface.mesh import Mesh
cloud = clsurf.models.sphere(20_000)
mesh = Mesh(cloud.points, np.arange(19_998).reshape(-1, 3))
frame = clsurf.Frame({"color": np.random.default_rng(1).random((200, 200, 4)).astype("f4")})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
for path in sys.argv[1:]:
    ending = path.rsplit(".", 1)[1]
    try:
        if ending in ("png", "exr", "jpg"):
            frame.save(path)
        else:
            clsurf.save(mesh if ending in ("obj", "stl", "off", "glb") else cloud, path)
        print("saved", path)
    except clsurf.Error as error:
        print("refused" if chr(10) not in str(error) else "lines", path)
"""


def test_a_full_disk_leaves_nothing_and_loses_nothing(tmp_path):
    """Files may have 20 KB, as on a disk with no more room: every writer says so, and the old file stays."""
    paths = [tmp_path / f"a.{ending}" for ending in ("ply", "obj", "stl", "off", "glb", "xyz", "npy", "las", "laz",
                                                     "clsurf", "png", "exr", "jpg")]
    for path in paths:
        path.write_text("old")
    done = subprocess.run([sys.executable, "-c", SAVE, *map(str, paths)], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["refused"] * len(paths), done.stdout
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    assert all(path.read_text() == "old" for path in paths)


STREAM = """
import resource, signal, sys, warnings
import clsurf
warnings.simplefilter("ignore")
def build(out=sys.argv[2]):
    return clsurf.build_slim(sys.argv[1], error=0.02, out=out, memory_limit="1GB")
build(sys.argv[2] + ".first")  # PoCL's compiler ends the process where its own cache is full
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
most = resource.getrlimit(resource.RLIMIT_FSIZE)
for limit in map(int, sys.argv[3:]):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, most[1]))
    try:
        print("built", build())
    except clsurf.Error as error:
        print("refused" if chr(10) not in str(error) and ".part" in str(error) else error)
resource.setrlimit(resource.RLIMIT_FSIZE, most)
print(build())
"""


def test_a_streamed_build_on_a_full_disk_goes_on_when_there_is_room(device, tmp_path):
    """No file may have more than 100 bytes, then 20 KB: an error each time; without a limit the same call ends."""
    clsurf.save(clsurf.models.torus(20_000), tmp_path / "a.ply")
    done = subprocess.run([sys.executable, "-c", STREAM, str(tmp_path / "a.ply"), str(tmp_path / "a.clsurf"), "100",
                           "20000"], capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("refused\nrefused\nStoredSurface("), done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.clsurf", "a.clsurf.first", "a.ply"]
    clsurf.build_slim(tmp_path / "a.ply", error=0.02, out=tmp_path / "b.clsurf", memory_limit="1GB", device=device)
    one, other = clsurf.load(tmp_path / "a.clsurf"), clsurf.load(tmp_path / "b.clsurf")
    np.testing.assert_array_equal(one.coefficients, other.coefficients)


def test_a_compiler_cache_on_a_full_disk(tmp_path):
    """pyopencl's cache of built kernels cannot be written: the kernel is built without it."""
    text = ("import resource, signal, sys, clsurf; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
            "device = clsurf.open_device('pocl')\n"
            "import pyopencl.cache as cache\n"
            "def full(*_, **__): raise OSError(28, 'No space left on device')\n"
            "cache._create_built_program_from_source_cached = full\n"
            "print(clsurf.render(clsurf.models.sphere(300), size=(8, 8), device=device))")
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=240,
                          env={**os.environ, "XDG_CACHE_HOME": str(tmp_path)})
    assert done.returncode == 0 and done.stdout.startswith("Frame(8 x 8"), done.stderr


def test_a_cache_that_cannot_be_written(tmp_path):
    """A file where the cache folder should be: clsurf takes another place and draws."""
    blocked = tmp_path / "file"
    blocked.write_text("")
    environment = {**os.environ, "XDG_CACHE_HOME": str(blocked), "HOME": str(blocked), "TMPDIR": str(tmp_path)}
    environment.pop("POCL_CACHE_DIR", None)
    text = "import clsurf; print(clsurf.render(clsurf.build_slim(clsurf.models.sphere(300)), size=(8, 8)))"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=240, env=environment)
    assert done.returncode == 0 and done.stdout.startswith("Frame(8 x 8"), done.stderr


def test_a_device_that_fails_in_the_middle(slim, monkeypatch):
    """A launch that fails is one of clsurf's errors; the next call works, on a new context as the device was lost."""
    selector = os.environ.get("CLSURF_DEVICE") or "pocl"
    device = open_device(selector)
    wanted = first_hit(slim, device)
    fail_at(monkeypatch, 2, cl.status_code.DEVICE_NOT_AVAILABLE)
    with pytest.raises(DeviceError, match="clsurf devices") as caught:
        first_hit(slim, device)
    assert "\n" not in str(caught.value)
    monkeypatch.undo()
    again = open_device(selector)
    assert again is not device
    np.testing.assert_array_equal(first_hit(slim, again), wanted)


def test_rays_that_run_out_of_memory_are_traced_all_the_same(slim, monkeypatch):
    """A launch that finds no room: what is kept on the device goes, and the rays come again."""
    device = open_device(os.environ.get("CLSURF_DEVICE") or "pocl")
    wanted = first_hit(slim, device)
    fail_at(monkeypatch, 2, cl.status_code.OUT_OF_RESOURCES)
    np.testing.assert_array_equal(first_hit(slim, device), wanted)
    assert open_device(os.environ.get("CLSURF_DEVICE") or "pocl") is device


def first_hit(slim, device):
    return clsurf.trace(slim, [[0.9, 0.1, 5.0]], [[0.0, 0.0, -1.0]], device=device).position


def fail_at(monkeypatch, number: int, code: int) -> None:
    """Make the launch of that number fail."""
    launches, launch = [], Kernel._launch

    def failing(self, *arguments):
        launches.append(self.label)
        if len(launches) == number:
            raise cl.RuntimeError(types.SimpleNamespace(code=lambda: code, what=lambda: "launch", routine=lambda: ""))
        return launch(self, *arguments)
    monkeypatch.setattr(Kernel, "_launch", failing)


def test_a_picture_that_runs_out_of_memory_is_drawn_in_bands(slim, device, monkeypatch):
    """A launch in the middle of a frame that finds no room: the picture comes all the same."""
    wanted = picture(slim, device)
    fail_at(monkeypatch, 3, cl.status_code.OUT_OF_RESOURCES)
    np.testing.assert_allclose(picture(slim, device), wanted, atol=1e-3)


def test_too_little_device_memory_is_told_and_forgotten(slim, device, monkeypatch):
    """A limit met between two frames: one clear error, nothing kept, and the frame after it is whole."""
    wanted = picture(slim, device)
    monkeypatch.setattr(device, "largest_buffer_bytes", 1000)
    with pytest.raises(DeviceMemoryError, match="one buffer may have"):
        clsurf.Renderer(device).render(slim, size=SIZE)
    monkeypatch.undo()
    np.testing.assert_array_equal(picture(slim, device), wanted)


INTERRUPTED = """
import os, sys, clsurf
slim = clsurf.build_slim(clsurf.models.torus(3000))
print("ready", flush=True)
try:
    while True:
        frame = clsurf.render(slim, size=(640, 480))
except KeyboardInterrupt:
    print("stopped", clsurf.render(slim, size=(8, 8)), flush=True)
"""


def test_ctrl_c_in_the_middle_of_frames():
    """Ctrl-C ends a loop of frames at once, and the renderer still works."""
    with subprocess.Popen([sys.executable, "-c", INTERRUPTED], stdout=subprocess.PIPE, text=True) as work:
        assert work.stdout.readline() == "ready\n"
        time.sleep(1)
        work.send_signal(signal.SIGINT)
        assert work.stdout.readline().startswith("stopped Frame(8 x 8")
        assert work.wait(60) == 0
