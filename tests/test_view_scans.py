"""Scans in the viewer: as they are, beside their surface, on the command line; surfaces that stay in their store."""

import threading

import numpy as np
import pytest
from reference.surfaces import sphere
from test_build_streamed import ORIGIN, ground, write_las
from test_view import Clock, click, press

import clsurf
from clsurf.build import streamed
from clsurf.cli import main
from clsurf.errors import InputError
from clsurf.io.images import read_image
from clsurf.view import canvas as canvases

SIZE = (96, 72)
RED, BLUE, WHITE = (clsurf.Material("flat", color) for color in ((1.0, 0, 0), (0, 0, 1.0), (1.0, 1, 1)))


def cloud(radius=1.0, normals=False, count=6000):
    """A cloud of a sphere about 0."""
    steps = np.arange(count) + 0.5
    z, angle = 1 - 2 * steps / count, np.pi * (1 + 5**0.5) * steps
    points = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    return clsurf.PointCloud(radius * points, normals=points if normals else None)


def opened(scene, device, **options):
    return clsurf.Viewer(scene, size=SIZE, device=device, clock=Clock(), **options)


def hit(viewer):
    """The depth of the picture on show."""
    viewer.draw()
    return viewer._seen[0].depth


def test_surface_scan_or_both(device):
    """The scan is a larger sphere: shown alone or with the surface, what is seen in the middle is the scan."""
    with opened(sphere(300), device, scans=cloud(1.2)) as viewer:
        far = np.linalg.norm(viewer.camera.eye)
        seen = []
        for shows in ("surface", "scan", "both", "surface"):
            assert viewer.state.shows == shows
            seen.append(hit(viewer)[36, 48])
            press(viewer, "t")
        assert far - np.array(seen) == pytest.approx([1, 1.2, 1.2, 1], abs=0.02)
        assert viewer.state.words == "scan"


def test_both_meet_in_one_depth(device):
    """A cloud on the surface it was made into: each hides the other somewhere."""
    with opened(sphere(300), device, scans=cloud(0.9999), shows="both") as viewer:
        numbers = viewer._renderer.render(viewer.shown_scene(), viewer.camera, SIZE, ("id",)).id
        assert (numbers == 0).sum() > 30 and (numbers == 1).sum() > 30


def test_what_a_surface_has_and_its_scan_lacks(device):
    """Channels and lines that the scan does not have are left when it is shown; a pick is of what is shown."""
    with opened(sphere(300), device, scans=[cloud(1.2)]) as viewer:
        press(viewer, "C", "C", "l")
        assert viewer.state.channel == "k2" and viewer.lines[1] == ("contours",)
        press(viewer, "t")
        assert viewer.state.channel == "color" and "k2" not in viewer.channels
        viewer.draw()
        click(viewer, 48, 36, "Shift")
        press(viewer, "t", "t")
        click(viewer, 48, 36, "Shift")
        assert [np.linalg.norm(point) for point in viewer.state.picks] == pytest.approx([1.2, 1], abs=0.01)


def test_one_of_several_keeps_its_material_and_its_scan(device):
    """A surface shown alone has its own material, not the first one's; one without a scan stands for itself."""
    away = np.eye(4)
    away[0, 3] = 3
    scene = clsurf.Scene([sphere(300), sphere(300).moved(away)], materials=[RED, BLUE])
    with opened(scene, device, scans=[None, cloud().moved(away)]) as viewer:
        colors = []
        for keys in ("n", "n", "t", "n", "n", "n"):
            press(viewer, keys, "Escape")
            pixels = viewer.still()[..., :3].astype(int)
            colors.append((bool((pixels[..., 0] - pixels[..., 1] > 200).any()),
                           bool((pixels[..., 2] - pixels[..., 1] > 200).any())))
        # The first, the second, the second's scan, all scans, the first for want of a scan, the second's scan.
        assert colors == [(True, False), (False, True), (False, True), (True, True), (True, False), (False, True)]


def test_eye_dome_lighting_by_key(device):
    """A cloud without normals has it until a key takes it away; one with normals gets it."""
    for normals in (False, True):
        with opened(cloud(normals=normals), device) as viewer:
            assert viewer.eye_dome is (not normals)
            first = viewer.still()
            press(viewer, "e", "Escape")
            assert viewer.eye_dome is normals
            second = viewer.still()
            press(viewer, "e", "Escape")
            assert (viewer.still() == first).all() and (first != second).any(axis=2).mean() > 0.1
    with opened(cloud(), device, points=clsurf.PointDrawing(eye_dome=False)) as viewer:
        assert viewer.eye_dome is False


def test_no_scan_is_said(device):
    for scans in (None, [None]):
        with opened(sphere(100), device, scans=scans) as viewer:
            press(viewer, "t")
            assert viewer.state.shows == "surface" and "no scan" in viewer.state.words


@pytest.mark.parametrize(("options", "says"), [
    ({"scans": [None, None]}, "scans: expected one for each of 1"), ({"scans": [3]}, "scans: number 0 is a int"),
    ({"shows": "half"}, "shows: expected one of"), ({"shows": "scan"}, "shows: expected scans="),
    ({"budget": "much"}, "budget")])
def test_wrong_scans(device, options, says):
    with pytest.raises(InputError, match=says):
        opened(sphere(50), device, **options)


# The command line -----------------------------------------------------------------------------------------------------


@pytest.fixture
def looked(device, monkeypatch):
    """What `clsurf view` opens, as viewers, without a browser."""
    viewers = []

    def view(scene, camera, backend, size, up, host, port, folder, device, report, scans, shows, **options):
        viewers.append(clsurf.Viewer(scene, camera, size, up, folder, device, scans=scans, shows=shows, **options))
        return viewers[-1]
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")
    monkeypatch.setattr(clsurf, "view", view)
    monkeypatch.setattr(canvases, "backend_module", lambda name: None)
    yield viewers
    for viewer in viewers:
        viewer.close()


def test_scans_as_they_are_by_option(looked, tmp_path):
    clsurf.save(cloud(normals=True, count=2000), tmp_path / "cloud.ply")
    clsurf.save(sphere(200), tmp_path / "ball.clsurf")
    files = [str(tmp_path / "cloud.ply"), str(tmp_path / "ball.clsurf")]
    for way in ("surface", "both", "scan"):
        assert main(["view", *files, "-q", "--as", way, "--point-size", "3px", "--no-eye-dome"]) == 0
    built, both, plain = looked
    assert isinstance(built.scene.surfaces[0], clsurf.SlimSurface) and built.state.shows == "surface"
    assert isinstance(built.scans[0], clsurf.PointCloud) and built.scans[1] is None and both.state.shows == "both"
    assert isinstance(plain.scene.surfaces[0], clsurf.PointCloud) and not plain.scans and plain.eye_dome is False
    assert plain.options["points"].size == 3 and plain.options["points"].unit == "pixels"


@pytest.mark.parametrize(("options", "says"), [
    (["--as", "photo"], "as: expected surface"), (["--as", "scan"], "as: expected a scan"),
    (["--point-size", "-3"], "size"), (["--budget", "much"], "budget")])
def test_mistakes_are_one_line(looked, options, says, tmp_path, capsys):
    clsurf.save(sphere(50), tmp_path / "ball.clsurf")
    assert main(["view", str(tmp_path / "ball.clsurf"), "-q", *options]) == 2
    said = capsys.readouterr().err.strip()
    assert says in said and "\n" not in said and not looked


# Surfaces that stay in their store ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stored(device, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    write_las(folder / "hills.las", *ground(20_000))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed, "sizes_of", lambda limit: streamed.Sizes(8_000, 4_000, 3_000))
        return clsurf.build_slim(folder / "hills.las", error=0.003, out=folder / "a.clsurf", device=device)


def test_streamed_surfaces_refine_as_they_are_read(stored, device, monkeypatch):
    """What is there is shown at once; the viewer asks to be drawn until all is read; a screenshot waits for it."""
    middle = ORIGIN + np.array([100.0, 100, 0])
    camera = clsurf.Camera.look_at(middle + np.array([0, -40.0, 100]), middle, (0, 0, 1), 50)
    gate, read = threading.Event(), stored.read
    monkeypatch.setattr(stored, "read", lambda part, levels=None: (part == 0 or gate.wait(30)) and read(part, levels))
    with opened(stored, device, camera=camera) as viewer:
        assert "mean" in viewer.channels
        viewer.clock.now += 1
        viewer.draw()
        viewer.draw()
        assert viewer.pace.shown == 2 and viewer.due() is not None
        gate.set()
        still = viewer.still()
        assert viewer._complete and viewer.due() is None
    with opened(stored.load(), device, camera=camera) as whole:
        assert (np.abs(still.astype(int) - whole.still()).max(axis=2) > 24).mean() < 0.01


def test_a_streamed_surface_is_opened_not_read(looked, stored, tmp_path, monkeypatch, capsys):
    """`view` and `render` leave what no view needs in the store."""
    assert main(["view", stored.place, "-q", "--budget", "100MB"]) == 0
    assert isinstance(looked[0].scene.surfaces[0], clsurf.StoredSurface)
    monkeypatch.setattr(clsurf.StoredSurface, "load", lambda self: pytest.fail("read whole"))
    out = tmp_path / "hills.png"
    assert main(["render", stored.place, str(out), "-q", "--size", "80x60", "--up", "0,0,1"]) == 0
    assert 0.05 < (read_image(out)[..., :3] < 250).any(axis=2).mean() < 0.95
    assert main(["render", "http://127.0.0.1:9/gone.clsurf", str(out), "-q"]) == 2
    assert "\n" not in capsys.readouterr().err.strip()
