"""Pictures of surfaces larger than memory: read as views need them; and of those larger than the device's buffers."""

import functools
import http.server
import threading

import numpy as np
import pytest
from test_build_streamed import ORIGIN, ground, write_las

import clsurf
from clsurf.build import streamed
from clsurf.errors import DeviceMemoryError, InputError
from clsurf.render import bands

SIZE = (160, 120)


@pytest.fixture(scope="module")
def stored(device, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    write_las(folder / "hills.las", *ground(30_000))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed, "sizes_of", lambda limit: streamed.Sizes(10_000, 4_000, 3_000))
        return clsurf.build_slim(folder / "hills.las", error=0.003, out=folder / "a.clsurf", device=device)


@pytest.fixture(scope="module")
def whole(stored):
    return stored.load()


def camera(height=120.0, x=100.0):
    middle = ORIGIN + np.array([x, 100, 0])
    return clsurf.Camera.look_at(middle + np.array([0, -0.4 * height, height]), middle, (0, 0, 1), 50)


def close_to(frame, wanted, off=0.05, share=0.995):
    """Assert that two frames show the same."""
    both = np.isfinite(frame.depth) & np.isfinite(wanted.depth)
    assert (np.isfinite(frame.depth) == np.isfinite(wanted.depth)).mean() > share
    assert (np.abs(frame.depth - wanted.depth)[both] < off).mean() > share


@pytest.mark.parametrize("height", (60, 150, 2000))
def test_shows_what_the_whole_surface_shows(stored, whole, device, height):
    close_to(clsurf.render(stored, camera(height), SIZE, device=device),
             clsurf.render(whole, camera(height), SIZE, device=device), off=max(0.05, 3e-4 * height))


def test_moved(stored, whole, device):
    matrix = np.eye(4)
    matrix[:3, :3] *= 2
    matrix[:3, 3] = 5 - 2 * ORIGIN
    framed = clsurf.Camera.framing(whole.moved(matrix), direction=(0.2, -0.5, 1))
    close_to(clsurf.render(clsurf.Placed(stored, matrix), framed, SIZE, device=device),
             clsurf.render(whole.moved(matrix), framed, SIZE, device=device))


def test_refines_without_waiting(stored, whole, device, monkeypatch):
    gate, read = threading.Event(), stored.read
    monkeypatch.setattr(stored, "read", lambda part, levels=None: (part == 0 or gate.wait(30)) and read(part, levels))
    with clsurf.Renderer(device) as renderer:
        for _ in range(100):  # nothing but the coarse levels is there, and frames come all the same
            first = renderer.render(stored, camera(), SIZE)
            if np.isfinite(first.depth).any():
                break
        assert np.isfinite(first.depth).any() and not renderer.complete
        gate.set()
        for _ in range(200):
            frame = renderer.render(stored, camera(), SIZE)
            if renderer.complete:
                break
            next(iter(renderer._residents.values())).settle(5)
        assert renderer.complete
        close_to(frame, clsurf.render(whole, camera(), SIZE, device=device))


def test_reads_only_what_is_seen_and_within_the_budget(stored, device, monkeypatch):
    reads, read = [], type(stored).read
    monkeypatch.setattr(type(stored), "read", lambda self, part, levels=None: reads.append((part, levels)) or
                        read(self, part, levels))
    with clsurf.Renderer(device, wait=True) as renderer:
        renderer.render(stored, camera(12.0, x=20.0), SIZE)
        close = {part for part, _ in reads}
        assert 1 < len(close) < 0.6 * len(stored.surfels)
    reads.clear()
    with clsurf.Renderer(device, wait=True) as renderer:
        renderer.render(stored, camera(20_000.0), SIZE)
        assert {part for part, _ in reads} == {0} and renderer.complete  # a few pixels: the coarse levels do
    with clsurf.Renderer(device, wait=True, budget=180 * int(stored.surfels[0].sum() + 2_000)) as renderer:
        renderer.render(stored, camera(), SIZE)
        resident = next(iter(renderer._residents.values()))
        assert len(resident.surface) <= stored.surfels[0].sum() + 2_000
    with pytest.raises(InputError, match="budget"):
        clsurf.Renderer(device, budget="much")


def test_over_the_web(stored, whole, device):
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=stored.place)
    handler.log_message = lambda *_: None
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        remote = clsurf.open_surface(f"http://127.0.0.1:{server.server_address[1]}")
        frame = clsurf.render(remote, camera(), SIZE, device=device)
        assert len(remote) == len(whole)
        server.shutdown()
    close_to(frame, clsurf.render(whole, camera(), SIZE, device=device))


class Slow(http.server.SimpleHTTPRequestHandler):
    """Serves a store; what `gates` has a name for waits for the event there, or fails where it is None."""

    gates = None  # set by the test
    asked = None

    def do_GET(self):
        Slow.asked.append(self.path)
        for name, gate in Slow.gates.items():
            if name in self.path:
                if gate is None:
                    self.send_error(503)
                    return
                gate.wait(30)
        super().do_GET()

    def log_message(self, *_):
        pass


def drawn_until(renderer, stored, view, done, frames=600):
    """Draw until `done(frame)`; return the numbers of surfels that were in memory on the way."""
    held = []
    for _ in range(frames):
        frame = renderer.render(stored, view, SIZE)
        resident = next(iter(renderer._residents.values()))
        held.append(len(resident.surface))
        if done(frame):
            return frame, held
        resident.settle(0.05)
    raise AssertionError(f"not done after {frames} frames: {held}")


def test_a_slow_server_never_blocks_the_picture(stored, whole, device):
    """The coarse part, then finer ones, each held back: frames come meanwhile, coarse first, within the budget."""
    coarse, fine = threading.Event(), threading.Event()
    budget = 180 * int(0.7 * len(whole))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Slow, directory=stored.place)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        Slow.gates, Slow.asked = {}, []
        remote = clsurf.open_surface(f"http://127.0.0.1:{server.server_address[1]}")
        try:
            Slow.asked.clear()
            Slow.gates = {"parts/00000/": coarse} | {f"parts/{k:05d}/": fine for k in range(1, len(stored.surfels))}
            with clsurf.Renderer(device, budget=budget) as renderer:
                frame = renderer.render(remote, camera(), SIZE)
                assert not np.isfinite(frame.depth).any() and not renderer.complete  # nothing yet, but a picture
                coarse.set()
                frame, held = drawn_until(renderer, remote, camera(), lambda f: np.isfinite(f.depth).any())
                assert not renderer.complete and held[-1] == stored.surfels[0].sum()
                assert not fine.is_set() and all("parts/00000/" in path for path in Slow.asked[:10])
                fine.set()
                frame, held = drawn_until(renderer, remote, camera(), lambda f: renderer.complete)
                assert held == sorted(held) and 180 * max(held) <= budget and held[-1] > stored.surfels[0].sum()
                Slow.gates = dict.fromkeys(Slow.gates)  # the server fails: what is there stays on the picture
                far = drawn_until(renderer, remote, camera(300.0), lambda f: np.isfinite(f.depth).any())[0]
                assert np.isfinite(far.depth).mean() > 0.1
                Slow.gates = {}
                drawn_until(renderer, remote, camera(300.0), lambda f: renderer.complete)
        finally:
            coarse.set()
            fine.set()
            Slow.gates = {}
            server.shutdown()


def test_a_store_that_cannot_be_read_is_told(stored, device, monkeypatch):
    monkeypatch.setattr(stored, "read", lambda part, levels=None: (_ for _ in ()).throw(OSError("gone")))
    with clsurf.Renderer(device) as renderer, pytest.raises(OSError, match="gone"):
        for _ in range(100):
            renderer.render(stored, camera(), SIZE)


def test_opens_a_plain_store(whole, tmp_path):
    clsurf.save(whole, tmp_path / "zip.clsurf")
    opened = clsurf.open_surface(tmp_path / "zip.clsurf")
    assert len(opened) == len(whole) and np.allclose(opened.bounds, whole.bounds)
    with pytest.raises(InputError, match="no such"):
        clsurf.open_surface(tmp_path / "none.clsurf")


ALL = ("color", "depth", "normal", "id", "count", "mean")


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("kind", ("perspective", "orthographic"))
def test_bands_are_the_picture(whole, device, monkeypatch, lanes, kind):
    """A device whose largest buffer holds a fraction of the model and of the picture draws the same picture."""
    view = camera(80) if kind == "perspective" else clsurf.Camera.orthographic(
        camera(80).eye, ORIGIN + np.array([100.0, 100, 0]), (0, 0, 1), 90)
    with clsurf.Renderer(device, lanes=lanes) as renderer:
        wanted = renderer.render(whole, view, (192, 160), ALL)
        monkeypatch.setattr(device, "largest_buffer_bytes", 84 * len(whole) // 3)
        drawn = []
        monkeypatch.setattr(bands, "band_of", lambda *a, of=bands.band_of: drawn.append(a[2]) or of(*a))
        frame = renderer.render(whole, view, (192, 160), ALL)
    assert len(drawn) > 3
    for name in ALL:
        got, want = getattr(frame, name), getattr(wanted, name)
        same = np.isclose(got, want, rtol=1e-3, atol=2e-3, equal_nan=True)
        assert same.mean() > 0.998, name


def test_a_device_without_room_is_told(whole, device, monkeypatch):
    monkeypatch.setattr(device, "largest_buffer_bytes", 1000)
    with clsurf.Renderer(device) as renderer, pytest.raises(DeviceMemoryError, match="buffer"):
        renderer.render(whole, camera(), (64, 64))
