"""The viewer without a canvas: what events and keys do to its pictures, picks, channels, lines and screenshots."""

import numpy as np
import pytest
from reference import view as twin
from reference.surfaces import sphere
from test_render_patches import globe

import clsurf
from clsurf.errors import DeviceError, InputError
from clsurf.io.images import read_image
from clsurf.view import picture
from clsurf.view.controls import HELP, KEYS
from clsurf.view.pace import SETTLE
from clsurf.view.state import pixel_of

SIZE = (96, 72)


class Clock:
    """Time that passes when it is told to."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def viewer(device, tmp_path):
    told = []
    with clsurf.Viewer(sphere(300), size=SIZE, device=device, folder=tmp_path, report=told.append,
                       clock=Clock()) as viewer:
        viewer.told = told
        yield viewer


def click(viewer, x, y, *modifiers):
    for kind in ("pointer_down", "pointer_up"):
        viewer.handle({"event_type": kind, "x": x, "y": y, "button": 1, "modifiers": modifiers})


def drag(viewer, start, end, button=1, modifiers=(), steps=4):
    viewer.handle({"event_type": "pointer_down", "x": start[0], "y": start[1], "button": button,
                   "modifiers": modifiers})
    for i in range(1, steps + 1):
        x, y = (a + (b - a) * i / steps for a, b in zip(start, end, strict=True))
        viewer.handle({"event_type": "pointer_move", "x": x, "y": y, "buttons": (button,)})
    viewer.handle({"event_type": "pointer_up", "x": end[0], "y": end[1], "button": button})


def press(viewer, *keys):
    return [viewer.handle({"event_type": "key_down", "key": key}) for key in keys]


def test_dragging_turns_and_pans(viewer):
    first = viewer.draw()
    assert first.shape == (72, 96, 4) and first.dtype == np.uint8 and (first[..., 3] == 255).all()
    eye, target = viewer.camera.eye, viewer.state.target
    drag(viewer, (40, 30), (60, 30))
    turn = np.degrees(np.arccos(viewer.camera.rotation[2] @ viewer.home.camera.rotation[2]))
    assert 15 < turn < 51 and (viewer.state.target == target).all()  # 180 degrees across the picture's height
    for button, modifiers in ((2, ()), (3, ()), (1, ("Shift",))):
        before = viewer.state
        drag(viewer, (40, 30), (60, 30), button, modifiers)
        np.testing.assert_allclose(viewer.camera.rotation, before.camera.rotation)
        assert np.linalg.norm(viewer.state.target - before.target) > 0.1
    press(viewer, "r")
    assert (viewer.camera.eye == eye).all() and (viewer.state.target == target).all()


def test_a_release_outside_ends_the_drag(viewer):
    viewer.handle({"event_type": "pointer_down", "x": 40, "y": 30, "button": 1})
    before = viewer.state
    assert not viewer.handle({"event_type": "pointer_move", "x": 90, "y": 30, "buttons": ()})
    assert not viewer.handle({"event_type": "pointer_move", "x": 20, "y": 30, "buttons": (1,)})
    assert viewer.state is before


def test_pictures_shrink_while_they_move_and_refine_when_still(viewer):
    """The clock tells that a moving picture took long: the next is smaller. Still: the full one, then the fine one."""
    viewer.draw()
    slow = viewer._draw

    def slowly(quality):
        viewer.clock.now += 0.5 / quality.reduce**2
        return slow(quality)
    viewer._draw = slowly
    sizes = []
    for i in range(8):
        drag(viewer, (40, 30), (50 + i, 30))
        sizes.append(viewer.draw().shape[0])
    assert sizes[-1] <= 18 and 0 < viewer.due() <= SETTLE
    viewer._draw = slow
    viewer.clock.now += viewer.due() + 1e-6
    full = viewer.draw()
    assert full.shape == (72, 96, 4) and viewer.due() == 0.0
    fine = viewer.draw()
    assert viewer.due() is None and fine.shape == full.shape
    edges = [np.abs(np.diff(p[..., :3].astype(int), axis=1)).max() for p in (full, fine)]
    assert edges[1] < edges[0]  # anti-aliased


def test_distances_are_drawn_and_reported(viewer):
    """Two Shift clicks on the sphere: its surface's distance to within the picture's footprint."""
    before = viewer.draw()
    click(viewer, 48, 36, "Shift")
    assert viewer.distance is None and "second point" in viewer.told[-1]
    click(viewer, 60, 30, "Shift")
    for point in viewer.state.picks:
        assert np.linalg.norm(point) == pytest.approx(1, abs=5e-3)
    wanted = viewer.state.picks
    assert viewer.distance == pytest.approx(np.linalg.norm(wanted[0] - wanted[1]))
    assert viewer.told[-1].startswith(f"distance {viewer.distance:.9g}")
    assert pixel_of(viewer.camera, SIZE, wanted[1]) == pytest.approx((60.5, 30.5))
    marked = viewer.draw()
    red = (marked[..., 0].astype(int) - marked[..., 1] > 100)
    assert red[30, 60] and red[36, 48] and red.sum() > 20
    assert not (before[..., 0].astype(int) - before[..., 1] > 100).any()
    click(viewer, 1, 1, "Shift")
    assert len(viewer.state.picks) == 2 and viewer.state.words == "nothing there"
    press(viewer, "Escape")
    assert viewer.distance is None
    press(viewer, "m")
    click(viewer, 48, 36)
    click(viewer, 50, 40)
    assert viewer.distance is not None


def test_picks_see_the_picture_as_it_is_now(viewer):
    """Just after a movement the picture on show is an old or a coarse one; a pick does not use it."""
    viewer.draw()
    drag(viewer, (40, 30), (40, 50))
    drag(viewer, (40, 30), (45, 30), 2)
    click(viewer, 50, 36, "Shift")
    point, = viewer.state.picks
    assert np.linalg.norm(point) == pytest.approx(1, abs=5e-3)
    assert pixel_of(viewer.camera, SIZE, point) == pytest.approx((50.5, 36.5))


def test_double_clicks_centre(viewer):
    viewer.draw()
    click(viewer, 60, 30)
    viewer.clock.now += 1.0
    click(viewer, 60, 30)
    assert viewer.state.target.tolist() == viewer.home.target.tolist()  # too slow
    viewer.clock.now += 0.2
    click(viewer, 61, 30)
    assert pixel_of(viewer.camera, SIZE, viewer.state.target) == pytest.approx((48, 36))
    assert np.linalg.norm(viewer.state.target) == pytest.approx(1, abs=5e-3)


def test_wheels_dolly_or_move_the_clip_plane(viewer):
    far = np.linalg.norm(viewer.camera.eye - viewer.state.target)
    viewer.handle({"event_type": "wheel", "dx": 0, "dy": -100, "modifiers": ()})
    assert np.linalg.norm(viewer.camera.eye - viewer.state.target) == pytest.approx(far / 1.0015**100)
    press(viewer, "x")
    offset = viewer.state.clip.offset
    viewer.handle({"event_type": "wheel", "dx": 0, "dy": 100, "modifiers": ("Control",)})
    assert viewer.state.clip.offset > offset


def test_a_clip_plane_shows_the_inside(viewer):
    whole = viewer.draw()
    press(viewer, "v", "Escape")  # the words cover a corner
    viewer.clock.now += 1
    cut = viewer.draw()
    depth = viewer._seen[0].depth[36, 48]
    assert depth > np.linalg.norm(viewer.camera.eye - viewer.state.target)  # behind the middle
    assert (cut != whole).any()


def test_channels_and_lines(viewer):
    """Every channel of a quadratic SLIM surface gives another picture, and contours draw dark lines."""
    assert viewer.channels == ("color", "normal", "depth", "mean", "gaussian", "k1", "k2", "level")
    assert len(viewer.lines) == 2  # suggestive contours need cubic surfels
    pictures = {}
    for _ in viewer.channels:
        pictures[viewer.state.channel] = viewer.draw()[:50].tobytes()
        press(viewer, "c")
    assert viewer.state.channel == "color" and len(set(pictures.values())) == len(viewer.channels)
    press(viewer, "C")
    assert viewer.state.channel == "level"
    press(viewer, "c", "l", "Escape")
    viewer.draw()
    viewer.clock.now += 1
    plain, lined = viewer.still(), None
    press(viewer, "l")
    lined = viewer.still()
    assert (plain[..., 0] < 60).sum() > (lined[..., 0] < 60).sum()


def test_scales_of_curvature_stay_while_the_camera_moves(viewer):
    viewer.state = viewer.state.__class__(**{**viewer.state.__dict__, "channel": "mean"})
    viewer.draw()
    limits = dict(viewer.limits)
    press(viewer, "+", "+", "ArrowLeft")
    viewer.draw()
    assert viewer.limits == limits and len(limits) == 1


def test_surfaces_one_by_one(device):
    matrix = np.diag([0.5, 0.5, 0.5, 1.0])
    matrix[0, 3] = 2
    with clsurf.Viewer([sphere(300), globe(radius=1.0).moved(matrix)], size=SIZE, device=device) as viewer:
        assert "id" in viewer.channels
        covered = []
        for _ in range(3):
            viewer.draw()
            covered.append(np.isfinite(viewer._seen[0].depth).sum())
            press(viewer, "n")
        assert viewer.state.only == -1 and covered[0] > covered[1] > covered[2] > 0


def test_help_hint_and_words(viewer):
    hint = viewer.draw()
    viewer.handle({"event_type": "resize", "width": 400, "height": 300, "pixel_ratio": 1.0})
    hint = viewer.draw()
    press(viewer, "h")
    panel = viewer.draw()
    assert hint.shape == panel.shape == (300, 400, 4)
    assert (hint[250:, :100, :3] < 60).any() and (panel[20:200, 20:200, :3].max(axis=2) < 60).mean() > 0.3
    press(viewer, "h")
    assert viewer.hint is False and not (viewer.draw()[250:, :100, :3] < 60).any()


def test_every_key_does_something_and_is_in_the_help(viewer):
    text = " ".join(key for key, _ in HELP)
    for key in KEYS:
        shown = {"Home": "Home", "Tab": "Tab", "Escape": "Esc", "?": "h", "F1": "h", "=": "+"}.get(key, key)
        assert shown in text or key.startswith("Arrow") or key == "C"
        if key not in ("q", "s", "[", "]", "Tab", "n", "Escape", "u", "r", "Home"):
            assert press(viewer, key) == [True], key
    assert press(viewer, "Control", "9") == [False, False]
    assert viewer.handle({"event_type": "key_down", "key": "c", "modifiers": ("Control",)}) is False
    press(viewer, "q")
    assert viewer.closed


def test_screenshots_never_replace_one(viewer, tmp_path):
    viewer.draw()
    press(viewer, "h", "s", "s")
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["clsurf-000.png", "clsurf-001.png"] and str(tmp_path) in viewer.told[-1]
    shot = read_image(tmp_path / "clsurf-000.png")
    assert shot.shape[:2] == (72, 96) and (shot[:5, :5, :3] == 255).all()  # no help panel
    viewer.folder = tmp_path / "gone"
    press(viewer, "s")
    assert "does not exist" in viewer.told[-1]


def test_sizes_come_with_the_canvas(viewer):
    """Logical pixels times their ratio; the first view goes with the shape, a camera of the user's does not."""
    viewer.handle({"event_type": "resize", "width": 60, "height": 80, "pixel_ratio": 2.0})
    assert viewer.size == (120, 160) and viewer.draw().shape == (160, 120, 4)
    border = np.isfinite(viewer._seen[0].depth)
    assert border.any() and not border[:, 0].any() and not border[0].any()
    click(viewer, 30, 40, "Shift")
    assert pixel_of(viewer.camera, viewer.size, viewer.state.picks[0]) == pytest.approx((60.5, 80.5))
    drag(viewer, (20, 20), (30, 20))
    mine = viewer.camera
    viewer.handle({"event_type": "resize", "width": 90, "height": 60, "pixel_ratio": 1.0})
    assert viewer.camera is mine


@pytest.mark.parametrize("size", [(9, 7), (64, 65), (1, 1)])
def test_pack_bytes(size, device):
    color = np.random.default_rng(0).random((*size, 4)).astype(np.float32)
    color[..., :3] *= color[..., 3:]
    color[0, 0] = (-1, 1, 50, 1)
    got = picture.to_bytes(device, color)
    assert got.shape == color.shape and got.dtype == np.uint8 and (got[0, 0] == (0, 255, 255, 255)).all()
    assert np.abs(got.astype(int) - twin.pack_bytes(color)).max() <= 1  # 4096 levels
    color[0, 0, 0] = np.nan
    assert picture.to_bytes(device, color)[0, 0, 0] == 0


def test_nothing_to_see_is_shown(device):
    with clsurf.Viewer(clsurf.Scene([]), size=(40, 30), device=device) as viewer:
        assert (viewer.draw() == 255).all()
        click(viewer, 20, 15, "Shift")
        assert viewer.distance is None
        press(viewer, "c", "x", "n", "r", "o")
        viewer.draw()


@pytest.mark.parametrize(("arguments", "says"), [
    ({"camera": 3}, "camera"), ({"up": (0, 0, 0)}, "up"), ({"size": (0, 3)}, "size")])
def test_wrong_arguments(arguments, says, device):
    with pytest.raises(InputError, match=says):
        clsurf.Viewer(sphere(50), device=device, **arguments)


def test_a_closed_viewer_says_so(device):
    viewer = clsurf.Viewer(sphere(50), size=SIZE, device=device)
    viewer.close()
    viewer.close()
    with pytest.raises(DeviceError, match="closed"):
        viewer.draw()


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (0, -1, 0), (1, 1, 1)])
def test_the_first_view_is_upright_and_from_above(up, device):
    with clsurf.Viewer(sphere(50), size=SIZE, up=up, device=device) as viewer:
        assert viewer.camera.rotation[1] @ viewer.state.up > 0.8 and viewer.camera.rotation[2] @ viewer.state.up > 0.1
    if up == (0, 0, 1):
        assert viewer.camera.rotation[2][1] < -0.5  # survey axes: seen from the south
