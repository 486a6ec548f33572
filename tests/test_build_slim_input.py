"""SLIM surfaces from odd input: options and scans that are refused, scans without area, any cloud at all."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clsurf.build.slim import Points, build_slim, check_room, parse_bytes
from clsurf.errors import DeviceMemoryError, InputError
from clsurf.io import load, save
from clsurf.surface.cloud import PointCloud
from tests.reference.scans import cloud_of, ellipsoid


@pytest.mark.parametrize(("option", "message"), ((dict(degree=4), "degree: expected 1, 2 or 3"),
                                                 (dict(error=0), "error: expected a share"),
                                                 (dict(error="fine"), "error: expected a share"),
                                                 (dict(memory_limit="lots"), "memory_limit: expected bytes")))
def test_refuses_options(device, option, message):
    with pytest.raises(InputError, match=message):
        build_slim(cloud_of(ellipsoid, 500), device=device, **option)


def test_memory_limit(device):
    assert parse_bytes("2GB") == 2e9 and parse_bytes("1.5 MB") == 1.5e6 and parse_bytes(1000) == 1000
    with pytest.raises(DeviceMemoryError, match="memory_limit: the build of 500 points needs"):
        build_slim(cloud_of(ellipsoid, 500), memory_limit="1MB", device=device)
    with pytest.raises(DeviceMemoryError):
        check_room(device, 10**13, None, Points(None, None, None, None))


@pytest.mark.parametrize("points", (np.zeros((0, 3)), np.zeros((1, 3)), np.zeros((30, 3)), np.full((20, 3), np.nan)))
def test_refuses_scans_without_extent(device, points):
    with pytest.raises(InputError, match="scan: expected"):
        build_slim(PointCloud(points, normals=np.tile([0.0, 0, 1], (len(points), 1))), device=device)


def test_refuses_other_things(device, tmp_path):
    with pytest.raises(InputError, match="expected a Mesh, a PointCloud, a RangeScan or the path of a scan, got int"):
        build_slim(3, device=device)
    with pytest.raises(InputError):
        build_slim(tmp_path / "none.ply", device=device)
    save(build_slim(cloud_of(ellipsoid, 500), device=device), tmp_path / "model.clsurf")
    with pytest.raises(InputError, match=r"scan: expected .* got SlimSurface"):
        build_slim(tmp_path / "model.clsurf", device=device)


def test_builds_from_a_path(device, tmp_path):
    scan = cloud_of(ellipsoid, 2000)
    save(scan, tmp_path / "scan.ply")
    plain = build_slim(load(tmp_path / "scan.ply"), device=device)
    for path in (tmp_path / "scan.ply", str(tmp_path / "scan.ply")):
        assert build_slim(path, device=device).coefficients.tobytes() == plain.coefficients.tobytes()


DEGENERATE = {
    "collinear": lambda t: np.stack([t, 2 * t, 3 * t], axis=1),
    "flat": lambda t: np.stack([t, (t * 7.13) % 1, 0 * t], axis=1),
    "two points": lambda t: np.array([[0, 0, 0], [1e-12, 0, 0]]),
    "huge": lambda t: 1e9 * np.stack([t, (t * 7.13) % 1, (t * 3.77) % 1], axis=1),
    "duplicates": lambda t: np.repeat(np.stack([t, (t * 7.13) % 1, 0 * t], axis=1)[:5], 300, axis=0),
    "outlier": lambda t: np.concatenate([np.stack([t, (t * 7.13) % 1, 0 * t], axis=1), [[1e4, 0, 0]]]),
    "tiny": lambda t: 1e-25 * np.stack([t, (t * 7.13) % 1, 0 * t], axis=1),
}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("degree", (1, 2, 3))
def test_degenerate_scans(device, name, degree):
    points = DEGENERATE[name](np.linspace(0, 1, 1500))
    surface = build_slim(PointCloud(points, normals=np.tile([0.0, 0.6, 0.8], (len(points), 1))), degree=degree,
                         device=device)
    check_sane(surface)
    if name == "outlier":
        assert surface.diagonal < 2


def check_sane(surface):
    for name in ("centers", "radii", "normals", "coefficients", "fit_error"):
        assert np.isfinite(getattr(surface, name)).all(), name
    assert surface.leaf.any() and np.isfinite(surface.bound)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(*3 * [st.sampled_from([0.0, 1.0, 1.0 + 1e-7, 1e-12, -3.0, 0.5, 1e9])]), max_size=60),
       st.integers(1, 3), st.integers(0, 2**16))
def test_any_cloud_gives_a_surface_or_an_error(device, places, degree, seed):
    points = np.array(places, float).reshape(-1, 3)
    normals = np.random.default_rng(seed).normal(size=points.shape)
    try:
        surface = build_slim(PointCloud(points, normals=normals), degree=degree, device=device)
    except InputError:
        return
    check_sane(surface)
