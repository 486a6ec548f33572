"""What moves the viewer's camera: orbits, pans, dollies, projections, clip planes and picks, as plain functions."""

import numpy as np
import pytest

import clsurf
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
