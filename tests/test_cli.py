"""The command line as a user meets it."""

import logging
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import clsurf
from clsurf.cli import main
from clsurf.cli.common import parsed_size

COMMANDS = ["demo", "devices", "doctor", "info", "build", "convert", "render", "trace", "curvature", "smooth", "report",
            "bench"]


@pytest.fixture
def on_device(monkeypatch, device):
    """Commands without --device use the device under test."""
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")


@pytest.fixture
def scan(tmp_path):
    """A small coloured cloud with normals on disk."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = np.full((4000, 4), 255, np.uint8)
    colors[:, 0] = 20
    path = tmp_path / "ball.ply"
    clsurf.save(clsurf.PointCloud(normals * 2 + 100, normals=normals, colors=colors), path)
    return path


@pytest.mark.parametrize("command", COMMANDS)
def test_help(command, capsys):
    assert main([command, "--help"]) == 0
    assert "Usage" in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "says"), [
    (["frobnicate"], "frobnicate"), (["info", "gone.ply"], "gone.ply"), (["info"], "path"),
    (["build", "gone.ply", "x.png"], "ends in .clsurf"),
    (["render", "a.ply", "b.png", "--size", "big"], "WIDTHxHEIGHT"),
    (["devices", "--no-such"], "no-such"), (["build", "a.ply", "b.clsurf", "--degree", "7"], "degree"),
    (["build", "gone.ply", "b.clsurf", "--device", "unobtainium"], ""),
    (["render", "gone.ply", "x.gif"], "ends in .png"), (["render", "gone.ply", "no/x.png"], "no does not exist"),
    (["render", "gone.ply", "x.png", "--channels", "colour"], "colour"), (["render", "gone.ply", "x.png", "--fov", "0"],
                                                                         "fov"),
    (["render", "gone.ply", "x.png", "--channels", "depth"], "color among them"),
    (["render", "gone.ply", "x.png", "--up", "0,0,0"], "not all 0"), (["render", "gone.ply", "x.png", "--lod", "-1"],
                                                                     "lod"),
    (["render", "gone.ply", "x.png", "--shading", "metal"], "metal"), (["demo", "x.gif"], "ends in .png"),
    (["build", "gone.ply", "x.clsurf", "--error", "2"], "between 0 and 1"), (["convert", "gone.ply", "x"], "ends in"),
    (["render", "gone.ply", "x.png", "--eye", "1,2,3", "--target", "1,2,3.0"], "apart"),
    (["smooth", "gone.ply", "-o", "x.ply", "--strength", "-1"], "strength"),
    (["smooth", "gone.ply", "-o", "x.ply", "--strength", "much"], "strength"),
    (["bench", "nothing"], "nothing"), (["bench", "compare", "one.json"], "two JSON files"),
])
def test_a_users_mistake_is_one_line_and_exit_code_2(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith("clsurf: ") and says in said[-1] and "Traceback" not in "".join(said)
    assert not list(tmp_path.iterdir())  # nothing half-written


def test_garbage_is_one_line(capsys, tmp_path):
    path = tmp_path / "bad.ply"
    path.write_bytes(b"\x00garbage" * 100)
    assert main(["info", str(path)]) == 2
    assert "bad.ply" in capsys.readouterr().err


def test_build_info_render_convert(scan, tmp_path, capsys, on_device):
    surface, exr, png = tmp_path / "ball.clsurf", tmp_path / "ball.exr", tmp_path / "ball.png"
    assert main(["build", str(scan), str(surface)]) == 0
    assert "surface: " in capsys.readouterr().err
    assert main(["info", str(surface)]) == 0
    said = capsys.readouterr().out
    assert "leaves" in said and "T_MDL 0.01" in said
    assert main(["render", str(surface), str(png), "--size", "90x70"]) == 0
    assert main(["render", str(scan), str(exr), "--size", "90x70", "--quiet"]) == 0
    from clsurf.io.images import read_image
    picture = np.asarray(read_image(png))
    assert picture.shape[:2] == (70, 90)
    assert picture[0, 0, 0] != picture[35, 45, 0] or picture[0, 0, 1] != picture[35, 45, 1]  # the ball is in the middle
    assert exr.stat().st_size > 1000
    assert main(["convert", str(surface), str(tmp_path / "ball.slim2t")]) == 0
    assert main(["convert", str(scan), str(tmp_path / "ball.xyz")]) == 0
    assert len(clsurf.load(tmp_path / "ball.xyz").points) == 4000


@pytest.mark.parametrize("ending", ["ply", "obj", "stl", "off", "glb", "npz", "xyz", "txt", "asc", "pts", "csv", "npy",
                                    "las", "laz"])
def test_a_surface_converts_to_every_format(ending, scan, tmp_path, capsys, on_device):
    """Triangles where the format has them, else evenly spread points; colours where it has those."""
    surface, out = tmp_path / "ball.clsurf", tmp_path / f"out.{ending}"
    assert main(["build", str(scan), str(surface), "-q"]) == 0
    assert main(["convert", str(surface), str(out), "--spacing", "0.3"]) == 0
    points = ending in ("xyz", "txt", "asc", "pts", "csv", "npy", "las", "laz")
    assert ("points " if points else "mesh ") in capsys.readouterr().err
    back = clsurf.load(out)
    assert isinstance(back, clsurf.PointCloud if points else clsurf.Mesh)
    radius = np.linalg.norm(back.points + (back.origin - 100), axis=1)
    assert np.abs(radius - 2).max() < 0.02 and 200 < len(radius) < 2000
    if ending not in ("stl",):
        assert np.abs(back.colors[:, :3].astype(int) - (20, 255, 255)).max() <= 1


def test_what_cannot_be_converted_is_one_line(scan, tmp_path, capsys, on_device):
    surface = tmp_path / "ball.clsurf"
    assert main(["build", str(scan), str(surface), "-q"]) == 0
    for arguments, says in (([surface, "a.ply", "--spacing", "-1"], "spacing: expected a length"),
                            ([surface, "a.ply", "--spacing", "1e-9"], "spacing: expected at least"),
                            ([surface, "a.ply", "--spacing", "99"], "spacing: expected a smaller one"),
                            ([surface, "a.clsurf", "--spacing", "1"], "spacing: expected a surface and a format"),
                            ([scan, "a.xyz", "--spacing", "1"], "spacing: expected a surface and a format")):
        arguments[1] = tmp_path / arguments[1]
        assert main(["convert", *map(str, arguments), "-q"]) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert said[-1].startswith("clsurf: ") and says in said[-1] and "Traceback" not in "".join(said)
        assert not arguments[1].exists()


def test_quiet_says_nothing(scan, tmp_path, capsys, on_device):
    level = logging.getLogger("clsurf").level
    assert main(["build", str(scan), str(tmp_path / "b.clsurf"), "--quiet"]) == 0
    out = capsys.readouterr()
    assert out.out == "" and out.err == ""
    assert logging.getLogger("clsurf").level == level, "a program that calls main keeps its own level"


def test_demo(tmp_path, capsys, on_device):
    picture = tmp_path / "demo.png"
    assert main(["demo", str(picture), "--size", "160x120"]) == 0
    said = capsys.readouterr().err
    assert str(picture) in said and "build the surface" in said and picture.stat().st_size > 3000


def test_devices_and_doctor(capsys):
    assert main(["devices"]) == 0 and "* " in capsys.readouterr().out
    assert main(["doctor"]) == 0 and "ok " in capsys.readouterr().out


def test_a_closed_pipe_is_no_error():
    # The reader leaves at once: every write of ours fails, not only the last.
    command = f"{sys.executable} -u -m clsurf doctor | true"
    done = subprocess.run(["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True)
    assert "Traceback" not in done.stderr and done.returncode == 0


def test_ctrl_c_is_exit_code_130_and_leaves_nothing(tmp_path, on_device):
    path = tmp_path / "large.npy"
    np.save(path, np.random.default_rng(0).normal(size=(3_000_000, 3)).astype(np.float32))
    with subprocess.Popen([sys.executable, "-m", "clsurf", "build", path, tmp_path / "large.clsurf"],
                          stderr=subprocess.PIPE, text=True, start_new_session=True) as work:
        try:
            assert work.stderr.readline().startswith("load") and "3,000,000 points" in work.stderr.readline()
            time.sleep(0.5)  # inside the build, which takes seconds
            work.send_signal(signal.SIGINT)
            said = work.communicate(timeout=120)[1]
        finally:
            work.kill()
    assert work.returncode == 130 and said.strip().endswith("clsurf: stopped")
    assert os.listdir(tmp_path) == ["large.npy"]


def test_ctrl_c_while_importing_is_one_line(tmp_path):
    """A module that Ctrl-C stops at, in place of one that clsurf imports."""
    (tmp_path / "numpy.py").write_text("raise KeyboardInterrupt")
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = subprocess.run([sys.executable, "-m", "clsurf", "devices"], capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": path})
    assert done.stderr == "clsurf: stopped\n" and done.returncode in (-signal.SIGINT, 130)


def test_a_device_that_is_not_there(capsys, monkeypatch):
    monkeypatch.setenv("CLSURF_DEVICE", "nonsense")
    assert main(["devices"]) == 2
    said = capsys.readouterr()
    assert "lanes a work-item" in said.out or "work-group" in said.out  # what there is, is listed
    assert "CLSURF_DEVICE=nonsense" in said.err
    assert main(["doctor"]) == 1 and "unset CLSURF_DEVICE" in capsys.readouterr().out


def test_no_device_at_all(monkeypatch, capsys):
    """Without a driver: one line that says what to install; the doctor does not suggest what is installed."""
    from clsurf.device import context, doctor
    monkeypatch.setattr(context, "all_devices", list)
    monkeypatch.setattr(doctor, "all_devices", list)
    assert main(["render", __file__, "x.png"]) == 2
    assert "pip install" in capsys.readouterr().err
    assert main(["doctor"]) == 1
    assert "no OpenCL device found" in capsys.readouterr().out


def test_a_home_that_cannot_be_written_still_has_pocl(tmp_path):
    """A file where the home should be, as root may write everywhere: PoCL's cache goes elsewhere."""
    home = tmp_path / "file"
    home.write_text("")
    env = {k: v for k, v in os.environ.items() if k not in ("POCL_CACHE_DIR", "XDG_CACHE_HOME", "CLSURF_DEVICE")}
    done = subprocess.run([sys.executable, "-m", "clsurf", "devices", "-q"], capture_output=True, text=True,
                          env=env | {"HOME": str(home)})
    assert done.returncode == 0 and "pthread" in done.stdout


def test_version(capsys):
    assert main(["--version"]) == 0 and capsys.readouterr().out == f"clsurf {clsurf.__version__}\n"


@pytest.mark.parametrize(("text", "size"), [("640x480", (640, 480)), ("1X1", (1, 1))])
def test_sizes(text, size):
    assert parsed_size(text) == size
