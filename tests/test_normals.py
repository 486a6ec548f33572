"""Estimated normals and their orientation, on shapes whose normals are known."""

import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import scan_path

from bench.answer_scenes import forms
from clsurf.build.normals import distinct, estimate_normals
from clsurf.build.orientation import contracted, seen_from_outside, signed_graph, voxel_means
from clsurf.errors import Cancelled, InputError
from clsurf.surface.cloud import PointCloud

RNG = np.random.default_rng(7)


def sphere(count, radius=1.0):
    points = RNG.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    return radius * points, points


def torus(count, radius=1.0, tube=0.3):
    # Rejection makes the samples even over the area.
    u, v = RNG.uniform(0, 2 * np.pi, (2, 3 * count))
    keep = RNG.uniform(0, radius + tube, 3 * count) < radius + tube * np.cos(v)
    u, v = u[keep][:count], v[keep][:count]
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
    return radius * np.stack([np.cos(u), np.sin(u), 0 * u], axis=1) + tube * normals, normals


def half_sphere(count):
    points, normals = sphere(2 * count)
    return points[points[:, 2] > 0], normals[points[:, 2] > 0]


def nested_spheres(count):
    (outer, out), (inner, inward) = sphere(count), sphere(count, 0.5)
    return np.concatenate([outer, inner]), np.concatenate([out, inward])


def slab(count):
    """Two parallel sheets, 5 point spacings apart: the faces of a plate."""
    points = RNG.random((2 * count, 3)) * [1, 1, 0]
    points[count:, 2] = 5 / np.sqrt(count)
    return points, np.repeat([[0.0, 0, -1], [0, 0, 1]], count, axis=0)


def terrain(count):
    x, y = RNG.random((2, count)) * 4
    height, slope = 0.1 * np.sin(5 * x) * np.cos(4 * y), (0.5 * np.cos(5 * x) * np.cos(4 * y),
                                                          -0.4 * np.sin(5 * x) * np.sin(4 * y))
    normals = np.stack([-slope[0], -slope[1], np.ones(count)], axis=1)
    return np.stack([x, y, height], axis=1), normals / np.linalg.norm(normals, axis=1)[:, None]


SHAPES = {shape.__name__: shape(20000) for shape in (sphere, torus, half_sphere, nested_spheres, slab, terrain)}


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_consistent_and_outward(device, name):
    points, normals = SHAPES[name]
    found = estimate_normals(PointCloud(points), device=device).normals
    cosine = np.einsum("ij,ij->i", found, normals)
    assert (cosine < 0).mean() <= 0.0005
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 2.5


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_noisy_torus(device, noise):
    points, normals = SHAPES["torus"]
    spacing = np.sqrt(4 * np.pi**2 * 0.3 / len(points))
    noisy = points + noise * spacing * RNG.normal(size=points.shape)
    found = estimate_normals(PointCloud(noisy), device=device).normals
    assert (np.einsum("ij,ij->i", found, normals) < 0).mean() < 0.003


def test_a_plane_is_exact(device):
    points = RNG.random((5000, 3)) @ np.array([[1, 0, 1], [0, 1, 2], [0, 0, 0]])
    found = estimate_normals(PointCloud(points), device=device).normals
    np.testing.assert_allclose(found, np.broadcast_to(np.array([-1, -2, 1]) / np.sqrt(6), found.shape), atol=2e-4)


def test_orientations(device):
    points, normals = SHAPES["sphere"]
    points = points + np.array([7, 8, 9])

    def dot(cloud, **how):
        return np.einsum("ij,ij->i", estimate_normals(cloud, device=device, **how).normals, normals)

    cloud = PointCloud(points)
    assert (dot(cloud, orient=(7, 8, 9)) < -0.9).all()  # from the middle
    assert (dot(cloud, orient="up") * normals[:, 2] > 0)[np.abs(normals[:, 2]) > 0.1].all()
    assert (np.abs(dot(cloud, orient=None)) > 0.9).all()
    seen = PointCloud(cloud.points, scanners=cloud.points - np.float32(0.1) * normals, origin=cloud.origin)
    assert (dot(seen) < -0.9).all() and (dot(seen, orient="graph") > 0.9).all()


def test_lidar_is_seen_from_above(device):
    points = RNG.random((4000, 3)) * [100, 100, 3]
    cloud = PointCloud(points, attributes={"classification": np.zeros(4000, np.uint8)})
    assert (estimate_normals(cloud, device=device).normals[:, 2] >= 0).all()


def test_everything_else_is_kept(device):
    points, _ = SHAPES["sphere"]
    cloud = PointCloud(points + 1e9, colors=RNG.integers(0, 255, (len(points), 4)), attributes={"a": points[:, 0]})
    found = estimate_normals(cloud, device=device)
    assert found.points is cloud.points and found.attributes == cloud.attributes
    assert (found.colors == cloud.colors).all() and (found.origin == cloud.origin).all()


def test_repeated_points_have_the_normals_of_the_distinct_ones(device):
    points, _ = SHAPES["sphere"]
    points = points[:3000].astype(np.float32)
    many = estimate_normals(PointCloud(np.repeat(points, 20, axis=0)), device=device).normals
    once = estimate_normals(PointCloud(points), device=device).normals
    np.testing.assert_allclose(many, np.repeat(once, 20, axis=0), atol=1e-4)


def test_normals_do_not_depend_on_the_order_or_the_kernel_form(device, monkeypatch):
    points, _ = SHAPES["torus"]
    shuffle = RNG.permutation(len(points))
    wanted = estimate_normals(PointCloud(points), device=device).normals
    shuffled = estimate_normals(PointCloud(points[shuffle]), device=device).normals
    np.testing.assert_allclose(shuffled, wanted[shuffle], atol=1e-3)
    assert (estimate_normals(PointCloud(points), device=device).normals == wanted).all()
    for lanes in (n for n in (8, 4, 1) if n <= forms(device)[0]):
        monkeypatch.setattr(device, "lanes", lanes)
        np.testing.assert_allclose(estimate_normals(PointCloud(points), device=device).normals, wanted, atol=1e-3)


DEGENERATE = {"none": np.zeros((0, 3)), "one": np.ones((1, 3)), "two": [[0, 0, 0], [1e-12, 0, 0]], "three": np.eye(3),
              "same": np.ones((3000, 3)), "line": np.arange(500.0)[:, None] * [1, 2, 3], "axis": np.eye(3)[[0] * 9] * 5,
              "far": RNG.random((500, 3)) + 1e9, "huge": RNG.random((500, 3)) * 1e30,
              "tiny": RNG.random((500, 3)) * 1e-30, "apart": np.concatenate([RNG.random((99, 3)), 1e9 + np.eye(3)]),
              "stray": np.concatenate([RNG.random((2000, 3)), [[1e20, 0, 0]]])}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("orient", ["auto", "up", None])
def test_degenerate_clouds_get_unit_vectors(device, name, orient):
    cloud = PointCloud(np.asarray(DEGENERATE[name], float))
    found = estimate_normals(cloud, orient=orient, device=device).normals
    assert found.shape == cloud.points.shape
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, rtol=1e-4)


def test_unusable_input(device):
    cloud = PointCloud(np.eye(3))
    for bad, how in ((PointCloud(np.full((3, 3), np.nan)), {}), (cloud, {"k": 2}), (cloud, {"orient": "out"}),
                     (cloud, {"orient": (1, 2)}), (cloud, {"orient": "scanners"})):
        with pytest.raises(InputError):
            estimate_normals(bad, device=device, **how)
    with pytest.raises(Cancelled):
        estimate_normals(cloud, device=device, progress=lambda stage, share: False)


def test_distinct():
    points = np.float32([[0, 0, 0], [1, 2, 3], [-0.0, 0, 0], [1, 2, 4]])
    kept, inverse = distinct(points)
    assert len(kept) == 3 and (kept[inverse] == points).all()
    assert distinct(points[:2])[1] is None


def test_contracted_finds_planted_signs(device):
    points, normals = SHAPES["torus"]
    points, normals = points[:4000].astype(np.float32), normals[:4000].astype(np.float32)
    planted = RNG.choice(np.float32([-1, 1]), 4000)
    weights = signed_graph(points, normals * planted[:, None], 8, device)
    assert abs(weights - weights.T).max() < 1e-12
    signs, part = contracted(weights)
    for number in range(part.max() + 1):
        agreement = (signs * planted)[part == number]
        assert (agreement == agreement[0]).all()


def test_voxel_means():
    points, normals = SHAPES["sphere"]
    flipped = normals * RNG.choice([-1, 1], len(normals))[:, None]
    voxel, means, axes = voxel_means(points.astype(np.float32), flipped.astype(np.float32), 0.1)
    for number in (0, len(means) // 2, len(means) - 1):
        np.testing.assert_allclose(means[number], points[voxel == number].mean(axis=0), rtol=1e-4, atol=1e-5)
    assert np.abs(np.einsum("ij,ij->i", axes[voxel], normals)).min() > 0.98


def test_the_outside_sees_the_outer_sphere_only():
    points, normals = SHAPES["nested_spheres"]
    votes, seen = seen_from_outside(points.astype(np.float32), normals.astype(np.float32), 0.08)
    half = len(points) // 2
    assert (votes[:half] > 0.1).mean() > 0.99 and (seen[half:] == 0).mean() > 0.99


def test_raw_range_scans(device):
    scan_path("range_scans/happy")
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from bench.happy import load_happy

    points, sensor = load_happy()
    found = estimate_normals(PointCloud(points), device=device).normals
    assert (np.einsum("ij,ij->i", found, sensor) < 0).mean() < 0.015
