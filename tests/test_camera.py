"""Cameras and frames."""

import numpy as np
import pytest
from test_render_triangles import globe

from clsurf.build.scale_map import build_scale_map
from clsurf.build.surfels import build_surfels
from clsurf.errors import InputError
from clsurf.models.basic import sphere
from clsurf.render.camera import Camera
from clsurf.render.frame import Frame
from clsurf.render.scene import Scene
from clsurf.surface.cloud import PointCloud

BOX = np.array([[-1.0, -2.0, -0.5], [3.0, 1.0, 0.5]])


def cameras():
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    matrix = np.array([[500.0, 0, 310], [0, 510, 250], [0, 0, 1]])
    return [Camera.look_at((4, 3, 9), (0, 0, 0), fov=35), Camera.framing(BOX, (1, 0.2, -2)),
            Camera.orthographic((4, 3, 9), (0, 0, 0), height=3), Camera.from_intrinsics(matrix, pose, (640, 480))]


@pytest.mark.parametrize("camera", cameras(), ids=repr)
def test_rays_hit_their_own_pixels(camera):
    """A point anywhere on a pixel's ray projects onto the pixel's centre."""
    size = (7, 5)
    p = camera.projection(size)
    origins, directions = camera.rays(size)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    view = (origins + 2.5 * directions - camera.eye) @ camera.rotation.T
    depth = -view[:, 2] if p.perspective else 1
    x, y = p.cx + p.fx * view[:, 0] / depth, p.cy - p.fy * view[:, 1] / depth
    centre_y, centre_x = np.mgrid[:5, :7] + 0.5
    np.testing.assert_allclose(x, centre_x.ravel(), atol=1e-9)
    np.testing.assert_allclose(y, centre_y.ravel(), atol=1e-9)


@pytest.mark.parametrize("direction", [(1, 0.5, 2), (0, 1, 0), (0, -1, 1e-12), (-3, 0, 0)])
@pytest.mark.parametrize("aspect", [0.5, 1, 2])
def test_framing_sees_every_corner_and_touches_the_border(direction, aspect):
    size = (int(1000 * aspect), 1000)
    camera = Camera.framing(BOX, direction, 50, aspect=aspect, margin=1.0)
    p = camera.projection(size)
    corners = np.array([[x, y, z] for x in BOX[:, 0] for y in BOX[:, 1] for z in BOX[:, 2]])
    view = (corners - camera.eye) @ camera.rotation.T
    x, y = p.cx + p.fx * view[:, 0] / -view[:, 2], p.cy - p.fy * view[:, 1] / -view[:, 2]
    border = np.min([x, size[0] - x, y, size[1] - y], axis=0)
    assert (-view[:, 2] > 0).all() and -1e-6 <= border.min() < 1e-6  # sees all, not from further away than needed


def test_framing_a_scan_is_centred_and_closer_than_its_box():
    """A cone's top is narrower than its box: framed by its points, the picture is fuller, and margins are equal."""
    angle, h = np.linspace(0, 60, 4000), np.linspace(0, 1, 4000)
    cone = PointCloud(np.stack([(1 - h) * np.cos(angle), 2 * h, (1 - h) * np.sin(angle)], axis=1))
    camera, boxed = Camera.framing(cone, (0.3, 1, 1), margin=1.0), Camera.framing(cone.bounds, (0.3, 1, 1), margin=1.0)
    assert np.linalg.norm(camera.eye - (0, 1, 0)) < 0.95 * np.linalg.norm(boxed.eye - (0, 1, 0))
    p = camera.projection((1000, 1000))
    view = (cone.points + cone.origin - camera.eye) @ camera.rotation.T
    y = p.cy - p.fy * view[:, 1] / -view[:, 2]
    x = p.cx + p.fx * view[:, 0] / -view[:, 2]
    assert min(x.min(), y.min()) >= -1e-3 and max(x.max(), y.max()) <= 1000 + 1e-3
    assert abs((1000 - y.max()) - y.min()) < 10 and abs((1000 - x.max()) - x.min()) < 10


@pytest.mark.parametrize("make", (
    lambda device: build_surfels(sphere(20_000), map_size=2, device=device),
    lambda device: build_surfels(globe(40, 80), map_size=2, hybrid=True, device=device),
    lambda device: build_scale_map(globe(40, 80), size=32, bits=16, device=device)), ids=("pure", "hybrid", "scale"))
def test_surfels_and_scale_maps_are_framed_by_their_surface(make, device):
    """The eye stands where the cone of view touches the unit sphere, not the corners of its box."""
    surface = make(device)
    for thing in (surface, Scene([surface])):
        away = np.linalg.norm(Camera.framing(thing, (1, 1, 1), fov=40, margin=1.0).eye)
        assert away == pytest.approx(1 / np.sin(np.radians(20)), abs=0.06)


def test_intrinsics_scale_with_the_picture():
    camera = cameras()[-1]
    whole, half = camera.projection((640, 480)), camera.projection((320, 240))
    assert (half.fx, half.cy) == (whole.fx / 2, whole.cy / 2)
    # Computer vision's y runs down: a point below the axis lands in a lower row.
    view = (np.array([1.0, 2.5, 5.0]) - camera.eye) @ camera.rotation.T
    assert whole.cy - whole.fy * view[1] / -view[2] > 250


def test_orbit_keeps_the_distance_and_the_target():
    camera = Camera.look_at((0, 0, 5), (1, 0, 0))
    turned = camera.orbited((1, 0, 0), 90)
    np.testing.assert_allclose(np.linalg.norm(turned.eye - (1, 0, 0)), np.sqrt(26))
    np.testing.assert_allclose(turned.rotation @ ((1, 0, 0) - turned.eye), (0, 0, -np.sqrt(26)), atol=1e-12)


@pytest.mark.parametrize("make", [
    lambda: Camera.look_at((0, 0, 0), (0, 0, 0)), lambda: Camera.look_at((np.nan, 0, 0), (0, 0, 0)),
    lambda: Camera.look_at((0, 0, 1), (0, 0, 0), fov=180), lambda: Camera.orthographic((0, 0, 1), (0, 0, 0), height=0),
    lambda: Camera.framing(np.full((2, 3), np.nan)), lambda: Camera((0, 0, 0), np.eye(3)),
    lambda: Camera((0, 0, 0), np.diag([1, 1, -1.0]), fov=40),
    lambda: Camera.framing(BOX, fov=0), lambda: Camera.framing(BOX, aspect=0),
    lambda: Camera.framing(BOX, up=(0, 0, 0)),
    lambda: Camera.from_intrinsics(np.diag([1.0, 0, 1]), np.eye(4), (4, 4)),
    lambda: Camera.from_intrinsics(np.array([[1.0, 1, 0], [0, 1, 0], [0, 0, 1]]), np.eye(4), (4, 4)),
])
def test_bad_cameras_are_named(make):
    with pytest.raises(InputError, match="camera"):
        make()


def test_a_missing_channel_says_how_to_get_it():
    frame = Frame({"color": np.zeros((4, 6, 4), np.float32)})
    assert frame.size == (6, 4) and frame.color.shape == (4, 6, 4)
    with pytest.raises(AttributeError, match="channels="):
        frame.depth  # noqa: B018


def test_frame_in_a_notebook():
    png = Frame({"color": np.ones((4, 6, 4), np.float32)})._repr_png_()
    assert png.startswith(b"\x89PNG")
    assert Frame({"depth": np.ones((4, 6), np.float32)})._repr_png_() is None
