"""Generated scans: on their surface, with exact normals, evenly spread, and the same every time."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsurf import models
from clsurf.errors import InputError


def on_torus(p):
    return np.hypot(np.hypot(p[:, 0], p[:, 1]) - 1, p[:, 2]) - 0.4


def on_ellipsoid(p):
    return np.linalg.norm(p / (1, 0.75, 0.5), axis=1) - 1


def on_cylinder(p):
    return np.hypot(p[:, 0], p[:, 1]) - 0.5


SHAPES = [("sphere", lambda p: np.linalg.norm(p, axis=1) - 1, 4 * np.pi), ("torus", on_torus, 4 * np.pi**2 * 0.4),
          ("ellipsoid", on_ellipsoid, None), ("cylinder", on_cylinder, 2 * np.pi), ("disc", lambda p: p[:, 2], np.pi)]


@pytest.mark.parametrize("name, distance, area", SHAPES)
def test_points_and_normals_are_exact(name, distance, area):
    scan = getattr(models, name)(5000)
    p, n = scan.points.astype(np.float64), scan.normals.astype(np.float64)
    assert p.shape == (5000, 3) and not scan.origin.any()
    assert np.abs(distance(p)).max() < 2e-7
    step = 1e-5
    gradient = np.stack([(distance(p + step * e) - distance(p - step * e)) / (2 * step) for e in np.eye(3)], axis=1)
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    assert np.linalg.norm(gradient - n, axis=1).max() < 1e-5


@pytest.mark.parametrize("name, distance, area", SHAPES)
def test_points_are_evenly_spread(name, distance, area):
    scan = getattr(models, name)(5000)
    nearest = cKDTree(scan.points).query(scan.points, 2)[0][:, 1]
    if area is not None:
        # The golden lattice keeps at least 1/sqrt(sqrt 5) of the spacing of a square one, less the stretch of the map.
        assert nearest.min() > 0.5 * np.sqrt(area / 5000)
    assert nearest.max() < 2.6 * nearest.min()


def test_demo_scan():
    scan = models.demo_scan()
    assert abs(len(scan.points) - 100_000) < 2000
    assert scan.colors.shape == (len(scan.points), 4) and len(np.unique(scan.colors, axis=0)) > 50
    np.testing.assert_allclose(np.linalg.norm(scan.normals, axis=1), 1, atol=1e-6)
    nearest = cKDTree(scan.points).query(scan.points, 2)[0][:, 1]
    assert np.percentile(nearest, 99) < 1.3 * np.median(nearest)
    assert scan.bounds[0, 1] == pytest.approx(0, abs=1e-4)
    again = models.demo_scan()
    assert again.points.tobytes() == scan.points.tobytes() and again.colors.tobytes() == scan.colors.tobytes()


def test_demo_scan_normals_point_outwards():
    scan = models.demo_scan(20_000)
    belly = (scan.points[:, 1] > 0.45) & (scan.points[:, 1] < 0.64) & (np.abs(scan.points[:, 0]) < 0.2)
    outward = scan.points[belly] * (1, 0, 1)
    assert (np.einsum("ij,ij->i", outward, scan.normals[belly]) > 0).mean() > 0.99
    rim = scan.points[:, 1] > 1.0725
    assert rim.any() and (scan.normals[rim, 1] > 0.5).all()
    assert (scan.normals[scan.points[:, 1] < 0.001, 1] < 0).any()


@pytest.mark.parametrize("make", [
    lambda: models.sphere(0), lambda: models.torus(10, minor=2), lambda: models.disc(5, -1),
    lambda: models.ellipsoid(5, (1, 2)), lambda: models.demo_scan(3), lambda: models.cylinder(5, np.nan)])
def test_bad_sizes(make):
    with pytest.raises(InputError, match="expected"):
        make()
