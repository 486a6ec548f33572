"""Distances between scans and surfaces: against closed forms, zero on the surface itself, invariance, the twin."""

import numpy as np
import pytest
import trimesh

from clsurf import models
from clsurf.analysis.error import SurfaceError, error, surface_samples

from clsurf.build.patches import build_patches
from clsurf.build.triangles import nearest_triangles, triangle_distances
from clsurf.errors import InputError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh
from tests.reference import analysis_error as twin
from tests.reference import surfaces


def turned(scale=2.5):
    matrix = np.eye(4)
    matrix[:3, :3] = scale * trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))[:3, :3]
    matrix[:3, 3] = 100, -20, 7
    return matrix


def ball(count=3):
    shape = trimesh.creation.icosphere(count)
    return Mesh(shape.vertices, shape.faces)


def test_triangle_distances(device):
    rng = np.random.default_rng(3)
    corners = rng.uniform(-1, 1, (60, 1, 3)) + rng.uniform(-0.3, 0.3, (60, 3, 3))
    corners[5] = corners[5, 0]  # a point
    corners[6, 2] = 0.3 * corners[6, 0] + 0.7 * corners[6, 1]  # a segment
    points = np.concatenate([rng.uniform(-1.5, 1.5, (90, 3)), corners[7], corners[8].mean(axis=0)[None], [[40, 0, 0]]])
    faces = np.arange(180).reshape(60, 3)
    found = triangle_distances(corners.reshape(-1, 3), faces, points, device)
    np.testing.assert_allclose(found, twin.triangle_distances(corners, points), atol=2e-6)


def test_triangle_distances_leave_broken_faces_out(device):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [np.nan, 0, 0]], float)
    found = triangle_distances(vertices, np.array([[0, 1, 2], [0, 1, 3]]), np.array([[0.2, 0.2, 3.0]]), device)
    assert found[0] == pytest.approx(3, abs=1e-5)
    with pytest.raises(InputError, match="finite corners"):
        triangle_distances(vertices, np.array([[0, 1, 3]]), np.zeros((1, 3)), device)


@pytest.mark.parametrize("away", (0.02, -0.03))
def test_error_of_a_sphere_is_its_offset(device, away):
    """Points of a sphere of radius R + d lie d from a SLIM sphere of radius R: with its sign, all figures alike."""
    surface = surfaces.sphere(400, radius=2.0)
    found = error(surface, surfaces.sphere_points(3000, 2.0 + away)[0], device=device)
    sagitta = 2e-3  # of the Taylor paraboloids at the rims of the balls
    assert found.mean == pytest.approx(away, abs=sagitta)
    for value in (found.rms, found.max, found.median, found.percentile(99)):
        assert value == pytest.approx(abs(away), abs=sagitta)
    assert found.within(abs(away) + sagitta) == 1 and found.within(abs(away) - sagitta) == 0
    assert found.diagonal == pytest.approx(2 * np.sqrt(3) * (2 + away), rel=1e-3)
    assert found.relative.rms == pytest.approx(found.rms / found.diagonal) and found.relative.diagonal == 1


def test_error_of_a_plane_is_the_noise(device):
    points, normals = surfaces.plane_points(40)
    surface = surfaces.fitted(points, normals, 0.15, degree=1)
    heights = np.random.default_rng(0).normal(scale=0.01, size=len(points))
    found = error(surface, PointCloud(points + heights[:, None] * normals), device=device)
    assert found.rms == pytest.approx(np.sqrt((heights**2).mean()), rel=1e-4)
    assert found.mean == pytest.approx(heights.mean(), abs=1e-6)
    assert found.max == pytest.approx(np.abs(heights).max(), rel=1e-4)
    assert found.percentile(90) == pytest.approx(np.percentile(np.abs(heights), 90), rel=1e-3)


def test_error_is_zero_on_the_surface_itself(device):
    mesh, slim = ball(), surfaces.sphere(300)
    assert error(mesh, mesh, device=device).relative.max < 1e-6
    for surface in (mesh, slim, slim.moved(turned()), build_patches(mesh, patches=40, device=device)):
        on_it = surface_samples(surface, 2000, device)
        assert len(on_it) == 2000 and error(surface, on_it, device=device).relative.max < 2e-6


def test_error_moves_with_surface_and_scan(device):
    surface, matrix = surfaces.sphere(300), turned()
    points = surfaces.torus_points(500)[0]
    there = points @ matrix[:3, :3].T + matrix[:3, 3]
    for thing in (surface, build_patches(ball(), patches=40, device=device)):
        here = error(thing, points, device=device).distance
        np.testing.assert_allclose(error(thing.moved(matrix), there, device=device).distance, 2.5 * here, atol=2e-5)


def test_backward_sees_what_forward_cannot(device):
    """Half a sphere as the scan of a whole one: its points lie on the surface, the surface's other half is far away."""
    whole = ball(4)
    up = np.asarray(whole.vertices)[:, 2] > -1e-6
    half = Mesh(whole.vertices, whole.faces[up[whole.faces].all(axis=1)])
    keep = Mesh(np.asarray(half.vertices)[up], (np.cumsum(up) - 1)[half.faces])
    found = error(whole, keep, both=True, samples=20_000, device=device)
    assert found.max < 1e-5 and found.backward.max == pytest.approx(np.sqrt(2), abs=0.05)
    # Below the rim, at height -z, the nearest point of the rim is sqrt(2 - 2 sqrt(1 - z^2)) away; z is uniform.
    z = np.linspace(0, 1, 10_001)
    expected = np.sqrt(np.mean(2 - 2 * np.sqrt(1 - z**2)) / 2)
    assert found.backward.rms == pytest.approx(expected, rel=0.03)
    assert found.relative.backward.rms == pytest.approx(found.backward.rms / found.diagonal)
    slim = surfaces.sphere(600)
    assert error(slim, whole, both=True, samples=5000, device=device).backward.max < 5e-3


def test_error_of_odd_input(device):
    surface = surfaces.sphere(200)
    points = surfaces.sphere_points(500)[0].astype(np.float32)
    points[3] = np.nan
    found = error(surface, PointCloud(points), device=device)
    assert len(found.distance) == 499 and np.isfinite(found.distance).all()
    assert "L2" in repr(found) and isinstance(found, SurfaceError)
    far = error(surface.moved(np.eye(4) + np.array([[0, 0, 0, 1e7]] + 3 * [[0] * 4])),
                surfaces.sphere_points(500)[0] + [1e7, 0, 0], device=device)
    assert far.rms < 2e-3  # float64 coordinates


@pytest.mark.parametrize(("surface", "scan", "options", "says"), [
    ("sphere", "nothing.ply", {}, "nothing.ply"), ("sphere", np.zeros((4, 2)), {}, "scan: expected"),
    ("sphere", "surface", {}, "got a surface"), ("sphere", np.full((3, 3), np.nan), {}, "finite point"),
    ("sphere", np.zeros((3, 3)), {"both": True}, "faces"), (None, np.zeros((3, 3)), {}, "surface: expected"),
    ("points", np.zeros((3, 3)), {}, "mesh with faces"),
])
def test_error_refuses(device, surface, scan, options, says):
    sphere = surfaces.sphere(100)
    surface = {"sphere": sphere, "points": Mesh(np.zeros((3, 3)))}.get(surface, models.sphere(50))
    with pytest.raises(InputError, match=says):
        error(surface, sphere if isinstance(scan, str) and scan == "surface" else scan, device=device, **options)
