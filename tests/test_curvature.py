"""Curvature at points: surfaces of known curvature, orders, invariance, odd scans, surfaces, kernels against twins."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import analysis_curvature as twin
from reference import curved
from reference.curved import cloud_of, rotation, size_of

import clsurf
from clsurf.analysis import quartics
from clsurf.analysis.curvature import curvature
from clsurf.build import slim
from clsurf.build.point_tree import build_point_tree
from clsurf.errors import InputError
from clsurf.surface.cloud import PointCloud

# Surfaces of known curvature ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "mean_error", "gaussian_error"), [
    ("sphere", 5e-5, 7e-5), ("torus", 4e-3, 4e-3), ("ellipsoid", 6e-4, 8e-4), ("catenoid", 3e-3, 8e-3),
    ("enneper", 2e-3, 6e-3), ("saddle", 3e-5, 5e-5), ("plane", 1e-6, 1e-6)])
def test_surfaces_of_known_curvature(name, mean_error, gaussian_error, device):
    points, normals, mean, gaussian = getattr(curved, name)(4000)
    found = curvature(cloud_of(points, normals), device=device)
    size = size_of(mean, gaussian)
    assert np.sqrt(np.mean((found.mean - mean) ** 2)) < mean_error * size
    assert np.sqrt(np.mean((found.gaussian - gaussian) ** 2)) < gaussian_error * size**2
    assert np.linalg.norm(found.position - points, axis=1).max() < 2e-4
    assert np.einsum("ij,ij->i", found.normal, normals).min() > 0.999


def test_parts_agree_with_each_other(device):
    points, normals, _, _ = curved.torus(3000)
    found = curvature(cloud_of(points, normals), device=device)
    assert (found.k1 >= found.k2).all()
    np.testing.assert_allclose(found.k1 + found.k2, 2 * found.mean, atol=1e-5)
    np.testing.assert_allclose(found.k1 * found.k2, found.gaussian, atol=2e-5)
    frame = np.stack([found.direction1, found.direction2, found.normal], axis=1)
    np.testing.assert_allclose(np.linalg.det(frame), 1, atol=1e-5)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frame.shape), atol=1e-5)
    for array in vars(found).values():
        assert array.dtype == np.float64 and not array.flags.writeable


def test_principal_directions_of_a_torus(device):
    points, normals, mean, gaussian = curved.torus(4000)
    found = curvature(cloud_of(points, normals), device=device)
    around = np.stack([-points[:, 1], points[:, 0], 0 * points[:, 0]], axis=1)
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    assert np.abs(np.einsum("ij,ij->i", found.direction1, around)).max() < 0.02  # k1 belongs to the tube
    assert np.abs(np.einsum("ij,ij->i", found.direction2, around)).min() > 0.999
    apart = np.sqrt(mean**2 - gaussian)
    np.testing.assert_allclose(found.k1, mean + apart, rtol=0.02)


def test_sign_follows_the_normals(device):
    points, normals, _, _ = curved.torus(2000)
    out, inside = (curvature(cloud_of(points, sign * normals), device=device) for sign in (1, -1))
    np.testing.assert_allclose(inside.mean, -out.mean, atol=2e-3)
    np.testing.assert_allclose(inside.k1, -out.k2, atol=2e-3)
    np.testing.assert_allclose(inside.gaussian, out.gaussian, atol=1e-2)


def test_order_of_convergence(device):
    errors = []
    for n in (4000, 16000):
        points, normals, mean, _ = curved.torus(n)
        found = curvature(cloud_of(points, normals), radius=20 / np.sqrt(n), device=device)
        errors.append(np.sqrt(np.mean((found.mean - mean) ** 2)))
    assert np.log2(errors[0] / errors[1]) > 3.5


def test_noise_is_averaged_out_without_a_parameter(device):
    points, normals, mean, _ = curved.torus(20000)
    noisy = points + 0.004 * np.random.default_rng(0).normal(size=points.shape)
    found = curvature(cloud_of(noisy, normals), device=device)
    assert np.sqrt(np.mean((found.mean - mean) ** 2)) < 0.035 * np.sqrt(np.mean(mean**2))
    ring = np.hypot(found.position[:, 0], found.position[:, 1]) - 1
    assert np.std(np.hypot(ring, found.position[:, 2])) < 0.15 * 0.004  # distances to the tube's axis


def test_noise_at_open_rims_stays_bounded(device):
    points, normals, mean, _ = curved.torus(20000)
    part = (points[:, 0] > 0.3) | (points[:, 1] > 0.4)
    noisy = points + 0.004 * np.random.default_rng(0).normal(size=points.shape)
    found = curvature(cloud_of(noisy[part], normals[part]), device=device)
    error = (found.mean - mean[part]) / np.sqrt(np.mean(mean**2))
    assert np.sqrt(np.mean(error**2)) < 0.045 and np.abs(error).max() < 0.6


def test_turned_normals_of_noisy_points_do_no_harm(device):
    points, normals, mean, _ = curved.torus(20000)
    rng = np.random.default_rng(0)
    noisy = points + 0.006 * rng.normal(size=points.shape)
    turned = normals * np.where(rng.random(20000) < 0.05, -1, 1)[:, None]
    found = curvature(cloud_of(noisy, turned), device=device)
    assert np.sqrt(np.mean((found.mean - mean) ** 2)) < 0.06 * np.sqrt(np.mean(mean**2))


# Invariance --------------------------------------------------------------------------------------------------------


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 1000), scale=st.floats(-6, 6))
def test_similarities_carry_over(seed, scale, device):
    points, normals, mean, gaussian = curved.ellipsoid(1500)
    turn, scale = rotation(seed), 10.0**scale
    found = curvature(cloud_of(scale * points @ turn.T, normals @ turn.T), device=device)
    assert np.sqrt(np.mean((found.mean * scale - mean) ** 2)) < 6e-3
    assert np.sqrt(np.mean((found.gaussian * scale**2 - gaussian) ** 2)) < 0.015


def test_order_of_the_points_does_not_matter(device):
    points, normals, _, _ = curved.torus(3000)
    points, normals = points.astype(np.float32), normals.astype(np.float32)
    order = np.random.default_rng(1).permutation(3000)
    a = curvature(PointCloud(points, normals), device=device)
    b = curvature(PointCloud(points[order], normals[order]), device=device)
    np.testing.assert_array_equal(a.mean[order], b.mean)
    np.testing.assert_array_equal(a.direction1[order], b.direction1)


def test_same_bytes_each_time(device):
    points, normals, _, _ = curved.torus(3000)
    a, b = (curvature(cloud_of(points, normals), device=device) for _ in range(2))
    for name, values in vars(a).items():
        np.testing.assert_array_equal(values, getattr(b, name))


# Elsewhere than at the scan's points, and surfaces -----------------------------------------------------------------


def test_given_positions(device):
    points, normals, _, _ = curved.sphere(4000, 1.0)
    rng = np.random.default_rng(4)
    asked = rng.normal(size=(300, 3))
    asked *= rng.uniform(0.6, 2.0, (300, 1)) / np.linalg.norm(asked, axis=1, keepdims=True)
    found = curvature(PointCloud(points + 5, normals.astype(np.float32)), asked + 5, device=device)
    np.testing.assert_allclose(found.mean, 1, atol=1e-3)
    away = found.position - 5
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 1, atol=1e-5)
    outward = asked / np.linalg.norm(asked, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", away, outward).min() > 0.999
    assert len(curvature(PointCloud(points), np.zeros((0, 3)), device=device)) == 0


@pytest.mark.parametrize(("degree", "tolerance"), [(2, 0.06), (3, 0.02)])
def test_slim_surfaces_blend_their_own_surfels(degree, tolerance, device):
    points, normals, mean, _ = curved.torus(20000)
    surface = clsurf.build_slim(cloud_of(points, normals), degree=degree, error=0.001, device=device)
    found = curvature(surface, points[::10], device=device)
    assert np.sqrt(np.mean((found.mean - mean[::10]) ** 2)) < tolerance * np.sqrt(np.mean(mean**2))
    np.testing.assert_allclose(found.position, points[::10], atol=1e-3)
    assert len(curvature(surface, device=device)) == surface.leaf.sum()


@pytest.mark.parametrize(("degree", "order"), [(2, 1.2), (3, 1.6)])
def test_order_of_slim_surfaces(degree, order, device):
    points, normals, mean, _ = curved.torus(12000)
    usable = slim.usable_points(cloud_of(points, normals), None, device)
    tree = build_point_tree(usable.position, usable.normals, np.zeros(3, np.float32), 0.25, device)
    errors = []
    for radius in (0.08, 0.04):  # one level of leaves of this radius, over the diagonal
        levels = slim.build_levels(tree, degree, 1e-15, slim.measure_noise(tree), lambda *_: None, radius)
        surface = slim.assemble(levels, usable, tree, degree, 0.01, 4.0, np.zeros(3))
        found = curvature(surface, points[::40], device=device)
        errors.append(np.sqrt(np.mean((found.mean - mean[::40]) ** 2)))
    assert np.log2(errors[0] / errors[1]) > order


def test_planes_have_no_curvature(device):
    surface = clsurf.build_slim(clsurf.models.sphere(500), degree=1, device=device)
    with pytest.raises(InputError, match="degree=2"):
        curvature(surface, device=device)


def test_placed_surfaces(device):
    surface = clsurf.build_slim(clsurf.models.torus(5000), degree=3, device=device)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 3 * rotation(7), (1, 2, 3)
    asked = curved.torus(200)[0]
    here = curvature(surface, asked, device=device)
    there = curvature(surface.moved(matrix), asked @ matrix[:3, :3].T + matrix[:3, 3], device=device)
    np.testing.assert_allclose(there.mean, here.mean / 3, atol=1e-4)
    np.testing.assert_allclose(there.gaussian, here.gaussian / 9, atol=1e-4)
    np.testing.assert_allclose(there.position, here.position @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5)
    np.testing.assert_allclose(there.normal, here.normal @ rotation(7).T, atol=1e-4)


def test_patches_are_measured_at_their_nodes(device):
    surface = clsurf.models.perfect_sphere()
    found = curvature(surface, device=device)
    assert len(found) == surface.opaque.sum()
    assert np.median(found.mean) * 128 == pytest.approx(1, rel=0.02)


# Kernels against twins ---------------------------------------------------------------------------------------------


def tree_of(n, device, noise=0.0):
    points, normals, _, _ = curved.torus(n)
    points = points + noise * np.random.default_rng(0).normal(size=points.shape)
    tree = build_point_tree(points.astype(np.float32), normals.astype(np.float32), np.zeros(3, np.float32), 0.25,
                            device)
    return tree, device.download(tree.sorted)[:, :tree.count].astype(np.float64)


def test_spread_centers(device):
    tree, host = tree_of(3000, device)
    spacing = np.where(np.arange(tree.padded // 16) % 3 == 0, 0.03, 0.05).astype(np.float32)
    centers = quartics.spread_centers(tree, spacing)
    assert (np.diff(centers) > 0).all()
    own = spacing[centers // 16]
    distance = np.linalg.norm(host[:3].T[:, None] - host[:3].T[None, centers], axis=2)
    assert (distance <= own * 1.0001).any(axis=1).all()  # every point is near a centre
    between = distance[centers]
    np.fill_diagonal(between, np.inf)
    assert between.min() > 0.0299


@pytest.mark.parametrize("lanes", (16, 1))
def test_fit_quartics(device, lanes, monkeypatch):
    monkeypatch.setattr(device, "lanes", lanes)
    tree, host = tree_of(2000, device, 0.002)
    radius = np.full(tree.padded // 16, 0.09, np.float32)
    surfels = quartics.fit_surfels(tree, radius)
    records = device.download(surfels.records)
    centers = quartics.spread_centers(tree, quartics.SPACING[0] * radius)
    assert device.download(surfels.balls)[3, :len(centers)].min() > 0
    assert (device.download(surfels.balls)[3, len(centers):] == -1).all()
    for i in range(0, len(centers), 7):
        wanted = twin.fit_quartics(host, centers[i], float(records[i, 3]))
        np.testing.assert_allclose(records[i, 13:28], wanted, atol=2e-4 * max(1, np.abs(wanted).max()))


def test_point_curvature(device):
    tree, host = tree_of(2000, device, 0.002)
    surfels = quartics.fit_surfels(tree, np.full(tree.padded // 16, 0.09, np.float32))
    rows = quartics.evaluate(surfels, tree.sorted, tree.order, tree.padded, 1)
    records = device.download(surfels.records)[device.download(surfels.balls)[3] > 0].astype(np.float64)
    for i in range(0, tree.count, 150):
        wanted = twin.point_curvature(host[:3, i], host[3:6, i], records, 1)
        got = rows[tree.order[i]]
        np.testing.assert_allclose(got[:3], wanted["position"], atol=1e-6)
        np.testing.assert_allclose(got[3:6], wanted["normal"], atol=1e-5)
        np.testing.assert_allclose(got[6:10], [wanted[k] for k in ("mean", "gaussian", "k1", "k2")], rtol=1e-4,
                                   atol=2e-3)
        assert abs(got[10:13] @ wanted["direction1"]) > 0.999


def test_values_larger_than_a_buffer(device, largest_buffer):
    """The values of a scan's own points, and of other places, come in parts."""
    scan = clsurf.models.torus(12000)
    wanted = curvature(scan, device=device), curvature(scan, scan.points[:1000] * 1.01, device=device)
    largest_buffer(40 * len(scan.points))
    got = curvature(scan, device=device), curvature(scan, scan.points[:1000] * 1.01, device=device)
    for one, other in zip(wanted, got, strict=True):
        for name, values in vars(one).items():
            np.testing.assert_array_equal(values, getattr(other, name))
