"""The viewer without a canvas: what events do to the camera, picks, clip planes, channels, and the pace of pictures."""

import numpy as np
import pytest
from reference.surfaces import sphere
from test_render_patches import globe

import clsurf
from clsurf.errors import DeviceError, InputError
from clsurf.io.images import read_image, to_srgb8
from clsurf.view import picture
from clsurf.view.controls import HELP, KEYS
from clsurf.view.pace import BUDGET, FINE, FULL, SETTLE, STEPS, Pace
from clsurf.view.state import (
    ViewState,
    centred,
    clip_moved,
    clipped,
    dollied,
    leveled,
    orbited,
    panned,
    picked,
    pixel_of,
    point_at,
    toggled_projection,
)

SIZE = (96, 72)
POINT = np.array([0.3, 0.2, -0.4])


def state(camera=None, target=(0.2, 0.1, 0.0), up=(0, 1, 0)):
    camera = clsurf.Camera.look_at((1, 2, 5), target, fov=35) if camera is None else camera
    return ViewState(camera, np.array(target, np.float64), np.array(up, np.float64))


def flat():
    return state(clsurf.Camera.orthographic((1, 2, 5), (0.2, 0.1, 0), height=3))


def pinhole():
    camera = clsurf.Camera.look_at((1, 2, 5), (0.2, 0.1, 0))
    matrix = np.array([[80.0, 0, 40], [0, 90, 30], [0, 0, 1]])
    return state(clsurf.Camera(camera.eye, camera.rotation, intrinsics=matrix, intrinsics_size=(96, 72)))


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


# Moving the camera ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [state, flat, pinhole])
def test_orbits_keep_target_distance_and_upright(make):
    before = make()
    after = orbited(before, 30, 20)
    for s in (before, after):
        assert pixel_of(s.camera, SIZE, s.target) == pytest.approx(pixel_of(before.camera, SIZE, before.target))
    assert np.linalg.norm(after.camera.eye - after.target) == pytest.approx(np.linalg.norm(before.camera.eye -
                                                                                          before.target))
    assert after.camera.rotation[0] @ after.up == pytest.approx(0, abs=1e-12)  # its right axis stays level
    assert after.camera.rotation[2] @ after.up > before.camera.rotation[2] @ before.up  # dragged down: seen from above


def test_orbits_follow_the_pointer():
    """What faces the eye goes right when dragged right, and down when dragged down."""
    before = state()
    near = before.target + 0.5 * before.camera.rotation[2]
    x, y = pixel_of(before.camera, SIZE, near)
    assert pixel_of(orbited(before, 10, 0).camera, SIZE, near)[0] > x + 1
    assert pixel_of(orbited(before, 0, 10).camera, SIZE, near)[1] > y + 1


@pytest.mark.parametrize("down", [170, -170, 1e6])
def test_orbits_stop_at_the_poles(down):
    after = orbited(state(), 0, down)
    assert np.degrees(np.arccos(abs(after.camera.rotation[2] @ after.up))) == pytest.approx(0.5, abs=1e-6)
    again = orbited(orbited(after, 40, 0), 0, -np.sign(down) * 30)
    assert np.degrees(np.arccos(abs(again.camera.rotation[2] @ again.up))) == pytest.approx(30.5, abs=1e-6)
    assert again.camera.rotation[0] @ again.up == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("make", [state, flat, pinhole])
def test_a_pan_takes_the_target_along(make):
    before = make()
    x, y = pixel_of(before.camera, SIZE, before.target)
    after = panned(before, 7, -5, SIZE)
    assert pixel_of(after.camera, SIZE, before.target) == pytest.approx((x + 7, y - 5))
    assert pixel_of(after.camera, SIZE, after.target) == pytest.approx((x, y))


@pytest.mark.parametrize("make", [state, flat, pinhole])
def test_dollies_and_centres(make):
    before = make()
    off = before.target + 0.4 * before.camera.rotation[0]
    nearer = dollied(before, 0.5)
    gap = [np.subtract(pixel_of(s.camera, SIZE, off), pixel_of(s.camera, SIZE, s.target))[0] for s in (before, nearer)]
    assert gap[1] == pytest.approx(2 * gap[0])
    looking = centred(before, POINT)
    wanted = pixel_of(before.camera, SIZE, before.target)
    assert pixel_of(looking.camera, SIZE, POINT) == pytest.approx(wanted) and looking.target is not before.target
    assert dollied(state(), 1e-300).camera.eye.tolist() == state().camera.eye.tolist()  # never onto the target itself


def test_the_other_projection_keeps_the_targets_size():
    for before in (state(), pinhole()):
        other = toggled_projection(before)
        assert other.camera.height is not None
        again = toggled_projection(other)
        for s in (other, again):
            off = before.target + 0.1 * before.camera.rotation[1]
            scale = abs(pixel_of(s.camera, SIZE, off)[1] - pixel_of(s.camera, SIZE, before.target)[1])
            first = abs(pixel_of(before.camera, SIZE, off)[1] - pixel_of(before.camera, SIZE, before.target)[1])
            assert scale == pytest.approx(first, rel=1e-6)


def test_leveling_a_tilted_camera():
    tilted = state(clsurf.Camera.look_at((1, 2, 5), (0.2, 0.1, 0), up=(1, 1, 0)))
    upright = leveled(tilted)
    assert upright.camera.rotation[0] @ upright.up == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(upright.camera.eye, tilted.camera.eye)


def test_pixels_and_points_are_inverse():
    for camera in (state().camera, flat().camera, pinhole().camera):
        depth = -(camera.rotation[2] @ (POINT - camera.eye))
        np.testing.assert_allclose(point_at(camera, SIZE, *pixel_of(camera, SIZE, POINT), depth), POINT, atol=1e-12)
    assert pixel_of(state().camera, SIZE, state().camera.eye + state().camera.rotation[2]) is None


def test_clip_planes_by_key():
    """Through the target, then the other side of it, then off; the plane moves along its normal."""
    planes = [clipped(state(), "y")]
    planes += [clipped(planes[0], "y")]
    for plane, sign in zip(planes, (-1, 1), strict=True):
        assert plane.clip.equation[:3].tolist() == [0, sign, 0]
        assert plane.clip.equation @ (*plane.target, 1) == pytest.approx(0)
    assert clipped(planes[1], "y").clip is None
    facing = clipped(planes[0], "view")
    np.testing.assert_allclose(facing.clip.normal, -facing.camera.rotation[2])
    moved = clip_moved(facing, 0.25)
    assert moved.clip.equation @ (*(facing.target + 0.25 * facing.clip.normal), 1) == pytest.approx(0)
    assert clip_moved(state(), 1).clip is None


def test_a_third_pick_starts_again():
    one = picked(state(), np.zeros(3))
    two = picked(one, np.array([0, 3.0, 4]))
    assert one.distance is None and two.distance == 5 and len(picked(two, np.ones(3)).picks) == 1


# Pace -----------------------------------------------------------------------------------------------------------------


def shown(pace, seconds_of, start, count, gap=0.05):
    """The qualities of pictures drawn while something moves."""
    out, now = [], start
    for _ in range(count):
        pace = pace.touched(now)
        quality = pace.quality(now)
        pace = pace.drawn(quality, seconds_of(quality), now)
        out.append(quality)
        now += gap
    return pace, out


@pytest.mark.parametrize("full_seconds", [0.005, 0.1, 0.5, 2.0])
def test_moving_pictures_get_coarse_enough_and_no_coarser(full_seconds):
    """Drawing time goes with the number of pixels: in the end every picture keeps to the budget, or nearly."""
    def seconds(quality):
        return full_seconds / quality.reduce**2 * (0.7 if quality.lod > 4 else 1)
    pace, qualities = shown(Pace(), seconds, 0.0, 40)
    late = [seconds(q) for q in qualities[10:]]
    assert max(late) <= max(BUDGET, full_seconds / STEPS[-1][0]**2)
    assert len({q for q in qualities[20:]}) == 1  # it does not flicker between two
    if full_seconds < BUDGET:
        assert qualities[-1].reduce == 1
    _, after = shown(pace, lambda q: 1e-4, 10.0, 20)  # something easier to draw
    assert (after[-1].reduce, after[-1].lod) == STEPS[0]


def test_still_pictures_are_refined_step_by_step():
    pace = Pace().touched(10.0)
    assert pace.quality(10.0).lod == STEPS[0][1] and pace.due(10.0) == pytest.approx(SETTLE)
    pace = pace.drawn(pace.quality(10.0), 0.01, 10.0)
    later = 10.0 + SETTLE
    assert pace.due(later) == 0.0 and pace.quality(later) == FULL
    pace = pace.drawn(FULL, 0.01, later)
    assert pace.due(later) == 0.0 and pace.quality(later) == FINE
    assert pace.drawn(FINE, 0.05, later).due(later) is None
    slow = Pace().stale().drawn(FULL, 1.0, later)
    assert slow.due(later) is None and slow.quality(later) == FULL  # the fine one would take seconds
    assert pace.stale().quality(later) == FULL


# Events and pictures --------------------------------------------------------------------------------------------------


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


def test_bytes_of_colours():
    color = np.random.default_rng(0).random((9, 7, 4)).astype(np.float32)
    color[..., 3] = 1
    color[0, 0, :3] = (0, 1, 2)
    assert np.abs(picture.to_bytes(color).astype(int) - to_srgb8(color)).max() <= 1


def test_nothing_to_see_is_shown(device):
    with clsurf.Viewer(clsurf.Scene([]), size=(40, 30), device=device) as viewer:
        assert (viewer.draw() == 255).all()
        click(viewer, 20, 15, "Shift")
        assert viewer.distance is None
        press(viewer, "c", "x", "n", "r", "o")
        viewer.draw()


@pytest.mark.parametrize(("arguments", "says"), [
    ({"camera": 3}, "camera"), ({"up": (0, 0, 0)}, "up"), ({"size": (0, 3)}, "size"),
    ({"background": (1, 1, 1, 0.5)}, "background")])
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
