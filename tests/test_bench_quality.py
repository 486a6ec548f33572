"""The measure of pictures: faults painted by hand must be counted, each under its own name."""

from dataclasses import replace

import numpy as np
import pytest

from bench import quality, truth, views
from clsurf.errors import InputError
from clsurf.render.camera import Camera
from clsurf.surface.mesh import Mesh

SIZE = (96, 80)
AXIS = (0.0, 0.0, 1.0)


def square() -> truth.Truth:
    """Return the exact picture of a square facing the eye at depth 2, with its left half at depth 1."""
    hit = np.zeros((80, 96), bool)
    hit[20:60, 20:76] = True
    depth = np.where(hit, 2.0, np.nan).astype(np.float32)
    depth[20:60, 20:40] = 1.0
    normal = np.full((80, 96, 3), np.nan, np.float32)
    normal[hit] = AXIS
    return truth.Truth(hit, depth, normal, normal)


def counts(exact, depth) -> dict:
    return quality.measure(exact, depth, None, 1.0, AXIS)


def test_perfect_picture_has_no_faults():
    exact = square()
    found = quality.measure(exact, exact.depth, exact.normal, 1.0, AXIS)
    assert all(found[name] == 0 for name in (*quality.COUNTS, "normals_missing", "depth_median", "normal_median"))


def test_holes_count_inside_the_eroded_silhouette_only():
    exact, depth = square(), square().depth.copy()
    depth[30:32, 50:53] = np.nan
    assert counts(exact, depth)["holes"] == 6 and counts(exact, depth)["missing"] == 6
    depth = exact.depth.copy()
    depth[20:23, 50] = np.nan  # a notch of 3 pixels: no hole; the two behind the rim are missing
    assert counts(exact, depth)["holes"] == 0 and counts(exact, depth)["missing"] == 2


def test_a_rim_of_one_pixel_is_not_outside():
    exact, depth = square(), square().depth.copy()
    depth[19, 20:76] = 2.0
    assert counts(exact, depth)["outside"] == 0
    depth[17:19, 50] = 2.0
    assert counts(exact, depth)["outside"] == 2 and counts(exact, depth)["fragments"] == 0


def test_fragments_float_apart_or_in_front():
    exact, depth = square(), square().depth.copy()
    depth[5:7, 5:8] = 2.0  # apart from the silhouette
    assert counts(exact, depth)["fragments"] == 1 and counts(exact, depth)["fragment_pixels"] == 6
    depth[50:52, 60:62] = 1.5  # in front of a flat part of the surface
    assert counts(exact, depth)["fragments"] == 2
    depth[30:50, 40] = 1.0  # the depth jump moved by a pixel: an edge, no fragment
    found = counts(exact, depth)
    assert found["fragments"] == 2 and found["depth_outliers"] == 24 and found["depth_outliers_inner"] == 4


def test_depth_and_normal_errors_have_units():
    exact = square()
    tilted = np.broadcast_to(np.float32([0, np.sin(np.radians(3)), np.cos(np.radians(3))]), exact.normal.shape).copy()
    found = quality.measure(exact, exact.depth + np.float32(0.002), tilted, 2.0, AXIS)
    assert found["depth_median"] == pytest.approx(0.1, rel=1e-3)
    assert found["depth_rms"] == pytest.approx(0.1, rel=1e-3)
    assert found["normal_median"] == pytest.approx(3.0, rel=1e-3)
    tilted[30, 30] = np.nan
    assert quality.measure(exact, exact.depth, tilted, 2.0, AXIS)["normals_missing"] == 1


def test_summary_takes_worst_and_mean():
    found = quality.summary([{"holes": 1}, {"holes": 5}])
    assert found == {"worst_holes": 5, "mean_holes": 3.0}


# Exact pictures -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [
    Camera.look_at((0.3, 0.4, 3.0), (0, 0, 0), fov=40), Camera.orthographic((0.3, 0.4, 3.0), (0, 0, 0), height=2.4)])
def test_cast_agrees_with_a_sphere(camera):
    import trimesh
    ball = trimesh.creation.icosphere(5)
    far = np.array([10, 0, 0])
    seen = truth.cast(Mesh(ball.vertices + far, ball.faces), replace(camera, eye=camera.eye + far), SIZE, cache=False)
    origins, directions = camera.rays(SIZE)
    b = (origins * directions).sum(axis=1)
    discriminant = (b * b - (origins * origins).sum(axis=1) + 1).reshape(SIZE[::-1])
    assert np.all(seen.hit[discriminant > 0.01]) and not seen.hit[discriminant < 0].any()
    inside = discriminant > 0.01
    place = origins + (-b - np.sqrt(np.maximum(discriminant.ravel(), 0)))[:, None] * directions
    depth = ((place - camera.eye) @ -camera.rotation[2]).reshape(SIZE[::-1])
    assert np.abs(seen.depth - depth)[inside].max() < 0.004  # the facets' sagitta over the slope at the rim
    assert np.einsum("ijk,ijk->ij", seen.normal, place.reshape(*SIZE[::-1], 3))[inside].min() > 0.999


def test_cast_is_watertight_and_takes_the_nearest():
    # Two squares of two triangles that share edges through pixel centres; the nearer one faces away.
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    mesh = Mesh(np.concatenate([corners, corners * 0.5 + [0, 0, 1]]), [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]],
                origin=np.zeros(3))
    seen = truth.cast(mesh, Camera.orthographic((0, 0, 5), (0, 0, 0), height=2.0), (65, 65), cache=False)
    assert seen.hit.all()
    middle = np.zeros((65, 65), bool)
    middle[17:48, 17:48] = True
    assert np.all(seen.depth[middle] == 4) and np.all(seen.depth[:16] == 5)
    assert np.all(seen.facet[..., 2] == 1)


def test_cast_from_within_the_mesh_says_so():
    mesh = Mesh([[0, 0, 1], [1, 0, -1], [0, 1, -1]], [[0, 1, 2]], origin=np.zeros(3))
    with pytest.raises(InputError, match="behind"):
        truth.cast(mesh, Camera.look_at((0, 0, 0), (0, 0, -1)), SIZE, cache=False)


def test_cast_is_cached(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    mesh = Mesh([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[0, 1, 2]], origin=np.zeros(3))
    camera = Camera.look_at((0, 0, 3), (0, 0, 0))
    first = truth.cast(mesh, camera, SIZE)
    monkeypatch.setattr(truth, "nearest_triangles", None)
    again = truth.cast(mesh, camera, SIZE)
    for name in ("hit", "depth", "normal", "facet"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))


def test_views_and_orbit():
    box = np.array([[1, 2, 3], [2, 4, 4]], float)
    cameras = views.views(box)
    target = box.mean(axis=0)
    directions = np.array([c.rotation[2] for c in cameras])
    assert np.allclose(np.degrees(np.arcsin(directions[:, 1])), [20, -20] * 4)
    turned = np.degrees(np.arctan2(directions[:, 0], directions[:, 2])) % 360
    assert np.allclose(turned, np.arange(0, 360, 45))
    small = views.orbit(box, 3, height_px=100, picture_px=1024)
    top, bottom = (small[0].rotation @ (target + np.array([0, s, 0]) - small[0].eye) for s in (1, -1))
    p = small[0].projection((1024, 1024))
    height = abs(p.fy * (top[1] / top[2] - bottom[1] / bottom[2]))
    assert 90 < height < 102  # the elevation of 20 degrees foreshortens it
    first, second = (c.eye - target for c in small[:2])
    turn = np.degrees(np.arctan2(second[0], second[2]) - np.arctan2(first[0], first[2]))
    assert turn == pytest.approx(1.0)
