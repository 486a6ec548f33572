"""Exact nearest neighbours and covariance, against brute force and SciPy's k-d tree, in every kernel form."""

import numpy as np
import pytest
from reference import neighbours as reference
from scipy.spatial import cKDTree

import clsurf
from bench.answer_scenes import forms
from clsurf.build import neighbours
from clsurf.build.neighbours import box_tree, covariance, nearest, noise_level, sampled_covariance
from clsurf.errors import InputError


@pytest.fixture(params=[16, 8, 4, 1])
def form(request, device, monkeypatch):
    """The device in each kernel form: lanes of one work-item, or one item per query."""
    monkeypatch.setattr(device, "lanes", request.param)
    return device


def clouds():
    rng = np.random.default_rng(1)
    uniform = rng.random((3000, 3))
    dense = rng.normal(size=(3000, 3)) * 10.0 ** rng.uniform(-9, 0, (3000, 1))
    clusters = np.concatenate([rng.random((700, 3)) * 10.0**-i + [i, 0, 0] for i in range(6)])
    lattice = np.stack(np.meshgrid(*[np.arange(12.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    flat = np.concatenate([rng.random((2000, 2)), np.zeros((2000, 1))], axis=1)
    return {"uniform": uniform, "dense": dense, "clusters": clusters, "lattice": rng.permutation(lattice), "flat": flat,
            "repeated": np.repeat(uniform[:300], 7, axis=0), "far": uniform + 1e7, "large": uniform * 1e25,
            "tiny": uniform * 1e-25, "few": uniform[:5], "seventeen": uniform[:17], "one": uniform[:1],
            "same": np.ones((2000, 3)), "line": np.linspace(0, 1, 1000)[:, None] * [1.0, 2, 3]}


CLOUDS = {name: points.astype(np.float32) for name, points in clouds().items()}


def assert_nearest(points, queries, k, indices, distances):
    """Exact: every distance is the k-d tree's, and belongs to its index; no point comes twice."""
    wanted = cKDTree(points.astype(float)).query(queries.astype(float), k)[0].reshape(len(queries), k)
    np.testing.assert_allclose(distances, wanted, rtol=1e-5)
    found = indices >= 0
    assert (found == np.isfinite(wanted)).all()
    own = np.linalg.norm(points[indices].astype(float) - queries[:, None].astype(float), axis=2)
    np.testing.assert_allclose(own[found], wanted[found], rtol=1e-5)
    ordered = np.sort(np.where(found, indices, -1 - np.arange(k)), axis=1)
    assert (np.diff(ordered, axis=1) > 0).all()


@pytest.mark.parametrize("bits", [1, 2, 5, 14])
def test_hilbert(form, bits):
    points = np.random.default_rng(0).uniform(-1, 1, (333, 3)).astype(np.float32)
    low, cells = np.float32([-1, -1, -1]), 2.0**bits / 2
    keys = form.empty(len(points), np.uint64)
    kernel = form.kernel("build/hilbert.cl", constants={"VW": form.lanes, "CURVE_BITS": bits, "INDEX_BITS": 10})
    kernel((-(-len(points) // form.lanes),), None, form.upload(points), keys, len(points), *low, cells)
    keys = form.download(keys)
    assert (keys & np.uint64(1023) == np.arange(len(points))).all()
    assert (keys >> np.uint64(10) == reference.hilbert(points, low, cells, bits)).all()


def test_hilbert_curve_makes_unit_steps(device):
    grid = np.stack(np.meshgrid(*[np.arange(16.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    order = neighbours.curve_order(device, grid, device.upload(grid), grid.min(axis=0), 15.0)
    assert (np.abs(np.diff(grid[order], axis=0)).sum(axis=1) == 1).all()


@pytest.mark.parametrize("count", [1, 16, 17, 256, 257, 5000])
def test_knn_leaves_and_knn_nodes(device, count):
    points = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    tree = box_tree(points, device)
    leaves, boxes = reference.knn_leaves(points, tree.order, tree.unit)
    assert (device.download(tree.leaves) == leaves).all()
    nodes = device.download(tree.nodes)
    first = tree.first_leaf
    while True:
        children = (first - 1 + np.arange(len(boxes))) // 16, (first - 1 + np.arange(len(boxes))) % 16
        assert (nodes[children[0], :3, children[1]] == boxes[:, 0]).all()
        assert (nodes[children[0], 3:, children[1]] == boxes[:, 1]).all()
        last = children[0][-1], children[1][-1]
        assert (nodes[last[0], :3, last[1] + 1:] == np.inf).all()  # missing children have empty boxes
        if first == 1:
            break
        boxes, first = reference.knn_nodes(boxes), (first - 1) // 16


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("k", [1, 16])
def test_knn_indices(device, name, k):
    points = CLOUDS[name]
    assert_nearest(points, points, k, *nearest(points, k, device=device))


@pytest.mark.parametrize("k", [3, 10, 40])
def test_knn_indices_in_every_form(form, k):
    points = CLOUDS["clusters"]
    indices, distances = nearest(points, k, device=form)
    assert_nearest(points, points, k, indices, distances)
    wanted = reference.knn_indices(points, points[:100], k)
    np.testing.assert_allclose(distances[:100], wanted[1], rtol=1e-5)
    assert (indices[:100] == wanted[0]).mean() > 0.999


@pytest.mark.parametrize("name", ["uniform", "dense", "few", "lattice", "same"])
def test_nearest_of_other_queries(device, name):
    points = CLOUDS[name]
    queries = np.random.default_rng(2).normal(size=(200, 3)).astype(np.float32)
    queries[::7] *= 1000
    assert_nearest(points, queries, 12, *nearest(points, 12, queries, device))


def test_a_full_list_of_leaves_goes_on(form):
    # The 16 queries are spread over the cloud, so that their common box meets all 1875 leaves: 29 full lists.
    rng = np.random.default_rng(3)
    points, queries = rng.random((30000, 3)).astype(np.float32), rng.random((16, 3)).astype(np.float32)
    assert_nearest(points, queries, 16, *nearest(points, 16, queries, form))
    eigenvalues, _, reach = reference.knn_covariance(points, queries, 16)
    found = covariance(points, 16, queries, form)
    np.testing.assert_allclose(found.eigenvalues, eigenvalues, rtol=1e-3)
    np.testing.assert_allclose(found.reach, reach, rtol=1e-5)


@pytest.mark.parametrize("k", [10, 40])
def test_knn_covariance(form, k):
    points = CLOUDS["dense"][:600]
    found = covariance(points, k, device=form)
    eigenvalues, normals, reach = reference.knn_covariance(points, points, k)
    np.testing.assert_allclose(found.reach, reach, rtol=1e-5)
    assert (np.abs(found.eigenvalues - eigenvalues) <= 2e-5 * eigenvalues[:, 2:]).all()
    clear = eigenvalues[:, 1] - eigenvalues[:, 0] > 1e-2 * eigenvalues[:, 2]
    assert (np.abs(np.einsum("ij,ij->i", found.normals, normals))[clear] > 1 - 1e-5).all()
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, rtol=1e-5)


@pytest.mark.parametrize("name", CLOUDS)
def test_covariance_is_finite(device, name):
    found = covariance(CLOUDS[name], 16, device=device)
    # Squares of the largest coordinates do not fit float32.
    assert np.isfinite(found.eigenvalues).all() or name == "large"
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1, rtol=1e-4)
    assert (found.eigenvalues[:, 1:] >= found.eigenvalues[:, :-1]).all() and (found.eigenvalues >= 0).all()


@pytest.mark.parametrize("name", ["uniform", "lattice"])
def test_covariance_does_not_depend_on_the_order(device, name):
    points = CLOUDS[name]
    shuffle = np.random.default_rng(4).permutation(len(points))
    a, b = covariance(points, 16, device=device), covariance(points[shuffle], 16, device=device)
    assert (np.abs(a.eigenvalues[shuffle] - b.eigenvalues) <= 1e-5 * b.eigenvalues[:, 2:]).all()
    np.testing.assert_allclose(a.reach[shuffle], b.reach, rtol=1e-6)


def test_kernel_forms_agree(device, monkeypatch):
    points, found = CLOUDS["uniform"], []
    for lanes in (n for n in (16, 8, 4, 1) if n <= forms(device)[0]):
        monkeypatch.setattr(device, "lanes", lanes)
        found.append(covariance(points, 16, device=device))
    for other in found[1:]:
        np.testing.assert_allclose(other.eigenvalues, found[0].eigenvalues, rtol=1e-3, atol=1e-9)
        np.testing.assert_allclose(other.reach, found[0].reach, rtol=1e-6)


def test_lists_larger_than_a_buffer(device, largest_buffer):
    """Neighbours are asked for in parts, which changes nothing: of the points themselves, and of other places."""
    points = CLOUDS["uniform"]
    places = np.random.default_rng(3).random((1777, 3)).astype(np.float32)
    wanted = nearest(points, 30, device=device), nearest(points, 30, places, device)
    largest_buffer(40 * len(points))
    got = nearest(points, 30, device=device), nearest(points, 30, places, device)
    for one, other in zip(wanted, got, strict=True):
        np.testing.assert_array_equal(one, other)


def test_patches_of_lists_larger_than_a_buffer(device, largest_buffer):
    """The patches of a cloud are the same where its neighbours are found in parts."""
    cloud = clsurf.models.sphere(6000)
    wanted = clsurf.build_patches(cloud, device=device)
    largest_buffer(60 * len(cloud.points))
    got = clsurf.build_patches(cloud, device=device)
    np.testing.assert_array_equal(got.displacements, wanted.displacements)
    np.testing.assert_array_equal(got.origins, wanted.origins)


def test_noise_level(device):
    rng = np.random.default_rng(5)
    points = np.concatenate([rng.random((20000, 2)), 2e-4 * rng.normal(size=(20000, 1))], axis=1)
    # A plane fitted to 50 points takes 3 of 50 degrees of freedom.
    assert noise_level(points, 50, device=device) == pytest.approx(4e-8 * 47 / 50, rel=0.03)
    assert noise_level(points, 50, 4000, device) == pytest.approx(4e-8 * 47 / 50, rel=0.06)
    assert 4000 <= len(sampled_covariance(points, 10, 4000, device).reach) < 8000


@pytest.mark.parametrize("points, k, message", [
    (np.zeros((0, 3)), 4, "at least one point"), (np.zeros((4, 2)), 4, "shape"), (np.full((4, 3), np.nan), 4, "NaN"),
    (np.zeros((4, 3)), 0, "1 to 128"), (np.zeros((4, 3)), 129, "1 to 128")])
def test_unusable_input(device, points, k, message):
    with pytest.raises(InputError, match=message):
        nearest(points, k, device=device)
