"""Curvature of odd scans: sheets, rims, strays, copies, tiny and far clouds, wrong options."""

import numpy as np
import pytest
from reference import curved
from reference.curved import cloud_of

import clsurf
from clsurf.analysis.curvature import curvature
from clsurf.errors import Cancelled, InputError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh


def test_close_sheets_do_not_mix(device):
    points, normals, _, _ = curved.sphere(6000, 1.0)
    shell = np.concatenate([points, 0.985 * points])  # closer than the points of one sheet
    found = curvature(cloud_of(shell, np.concatenate([normals, -normals])), device=device)
    np.testing.assert_allclose(found.mean[:6000], 1, atol=2e-3)
    np.testing.assert_allclose(found.mean[6000:], -1 / 0.985, atol=2e-3)


def test_uneven_sampling(device):
    points, normals, mean, _ = curved.torus(12000)
    keep = (points[:, 0] > 0) | (np.arange(12000) % 8 == 0)
    found = curvature(cloud_of(points[keep], normals[keep]), device=device)
    error = np.abs(found.mean - mean[keep])
    assert np.sqrt(np.mean(error[points[keep][:, 0] > 0.5] ** 2)) < 8e-3
    assert np.sqrt(np.mean(error**2)) < 0.25  # an eighth of the points, six spacings around the tube's radius


def test_open_rims(device):
    points, normals, _, _ = curved.sphere(5000, 1.0)
    cap = points[:, 2] > 0.3
    found = curvature(cloud_of(points[cap], normals[cap]), device=device)
    np.testing.assert_allclose(found.mean, 1, atol=0.01)


def test_strays_are_unknown_and_harm_nobody(device):
    points, normals, _, _ = curved.sphere(4000, 1.0)
    rng = np.random.default_rng(2)
    strays = rng.normal(size=(20, 3))
    strays *= rng.uniform(2, 4, (20, 1)) / np.linalg.norm(strays, axis=1, keepdims=True)
    found = curvature(cloud_of(np.concatenate([points, strays]), np.concatenate([normals, np.eye(3)[[2] * 20]])),
                      device=device)
    np.testing.assert_allclose(found.mean[:4000], 1, atol=3e-3)
    assert np.isnan(found.mean[4000:]).all()


def test_outliers_near_the_surface_are_left_out(device):
    points, normals, mean, _ = curved.torus(12000)
    rng = np.random.default_rng(3)
    wrong = rng.random(12000) < 0.02
    moved = points + np.where(wrong[:, None], rng.normal(size=points.shape) * 0.15, 0)
    found = curvature(cloud_of(moved, normals), device=device)
    error = np.abs(found.mean - mean)[~wrong] / np.sqrt(np.mean(mean**2))
    assert np.isfinite(error).all() and np.median(error) < 0.01 and np.quantile(error, 0.99) < 0.2


def test_points_that_cannot_be_used_are_nan(device):
    points, normals, _, _ = curved.sphere(1000, 1.0)
    points, normals = points.astype(np.float32), normals.astype(np.float32)
    points[3], points[7, 1], normals[11] = np.nan, np.inf, 0
    found = curvature(PointCloud(points, normals), device=device)
    assert np.flatnonzero(np.isnan(found.mean)).tolist() == [3, 7, 11]
    assert np.nanmax(np.abs(found.mean - 1)) < 0.01


def test_normals_of_slivers_do_no_harm(device):
    points, normals, _, _ = curved.sphere(4000, 1.0)
    again = points[::200] + 1e-4 * np.roll(normals[::200], 1, axis=1)
    found = curvature(cloud_of(np.concatenate([points, again]), np.concatenate([normals, -normals[::200]])),
                      device=device)
    np.testing.assert_allclose(found.mean, 1, atol=0.1)
    assert (np.einsum("ij,ij->i", found.normal[4000:], again) > 0.9).all()


def test_copies_have_the_curvature_of_their_place(device):
    points, normals, _, _ = curved.sphere(1000, 1.0)
    plain = curvature(cloud_of(points, normals), device=device)
    twice = curvature(cloud_of(np.repeat(points, 3, axis=0), np.repeat(normals, 3, axis=0)), device=device)
    np.testing.assert_allclose(twice.mean, np.repeat(plain.mean, 3), atol=2e-3)


@pytest.mark.parametrize("count", [6, 9, 14, 25, 60])
def test_tiny_clouds(count, device):
    points, normals, _, _ = curved.sphere(400, 1.0)
    points, normals = points[:count] * 2, normals[:count]  # a cap
    found = curvature(cloud_of(points, normals), device=device)
    np.testing.assert_allclose(found.mean, 0.5, atol=0.12)


def test_missing_normals_are_estimated_outward(device):
    points, _, mean, _ = curved.torus(3000)
    found = curvature(PointCloud(points), device=device)
    assert np.sqrt(np.mean((found.mean - mean) ** 2)) < 0.03


def test_meshes_take_their_faces_normals(device):
    import trimesh
    ball = trimesh.creation.icosphere(4, 2.0)
    found = curvature(Mesh(ball.vertices, ball.faces), device=device)
    np.testing.assert_allclose(found.mean, 0.5, atol=1e-3)
    inside_out = curvature(Mesh(ball.vertices, ball.faces[:, ::-1]), device=device)
    np.testing.assert_allclose(inside_out.mean, -0.5, atol=1e-3)


def test_survey_coordinates(device):
    points, normals, _, _ = curved.sphere(1000, 1.0)
    far = np.array([7_691_239.553, 1_234_567.891, 312.5])
    found = curvature(PointCloud(points + far, normals.astype(np.float32)), device=device)
    np.testing.assert_allclose(found.mean, 1, atol=0.01)
    np.testing.assert_allclose(found.position, points + far, atol=1e-5)


@pytest.mark.parametrize(("scan", "says"), [
    (PointCloud(np.zeros((0, 3))), "at least 6 finite points"),
    (PointCloud(np.eye(3)), "at least 6 finite points"),
    (PointCloud(np.full((9, 3), np.nan, np.float32)), "at least 6 finite points"),
    (PointCloud(np.ones((50, 3), np.float32), np.ones((50, 3))), "at least 6 different points"),
    (PointCloud(np.eye(3)[[0, 1, 2] * 3].astype(np.float32), np.zeros((9, 3))), "at least 6 different points"),
    ("nowhere.ply", "nowhere.ply"), (3, "expected a Mesh"), ([], "expected a Mesh")])
def test_what_has_no_curvature_is_said_in_one_line(scan, says, device):
    with pytest.raises(InputError, match=says) as error:
        curvature(scan, device=device)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("options", [{"points": [[0, 0]]}, {"points": [[0, 0, np.nan]]}, {"points": "x"},
                                     {"radius": 0}, {"radius": -1.0}, {"radius": "large"}, {"radius": np.nan},
                                     {"radius": True}])
def test_options_out_of_range(options, device):
    with pytest.raises(InputError, match=next(iter(options))):
        curvature(clsurf.models.sphere(100), device=device, **options)


@pytest.mark.parametrize("radius", [1e-6, 1e6])
def test_a_radius_without_a_surface_is_refused(radius, device):
    points, normals, _, _ = curved.sphere(2000)
    with pytest.raises(InputError, match="the spacing is 0"):
        curvature(cloud_of(points, normals), radius=radius, device=device)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_extreme_scales(scale, device):
    points, normals, _, _ = curved.sphere(1000, 1.0)
    found = curvature(PointCloud((points * scale).astype(np.float32), normals.astype(np.float32)), device=device)
    np.testing.assert_allclose(found.mean * scale, 1, atol=0.01)


def test_far_strays(device):
    points, normals, _, _ = curved.sphere(1000, 1.0)
    points = np.concatenate([points, [[1e8, 0, 0]]]).astype(np.float32)
    found = curvature(cloud_of(points, np.concatenate([normals, [[0, 0, 1]]])), device=device)
    np.testing.assert_allclose(found.mean[:-1], 1, atol=0.01)
    assert np.isnan(found.mean[-1])


def test_points_on_a_line_do_not_fail(device):
    line = np.linspace(0, 1, 40)[:, None] * (1.0, 2.0, 3.0)
    found = curvature(PointCloud(line), device=device)
    assert len(found) == 40 and np.nanmax(np.abs(found.mean), initial=0) < 1e-3


def test_progress_can_stop_the_work(device):
    seen = []
    curvature(clsurf.models.sphere(500), progress=lambda *step: seen.append(step), device=device)
    assert seen[0] == ("points", 0.0) and seen[-1] == ("curvature", 1.0)
    with pytest.raises(Cancelled):
        curvature(clsurf.models.sphere(500), progress=lambda stage, done: stage != "surfels", device=device)
