"""Every kernel of the SLIM build against its float64 twin."""

import itertools

import numpy as np
import pytest

from clsurf.build import point_tree, project, radius
from clsurf.build import slim_levels as slim
from clsurf.build.slim import build_slim
from clsurf.surface.cloud import PointCloud
from tests.reference import build as twin


def wavy_sheet(count, seed=0, noise=0.0):
    """Points and normals (count, 3) float32 of z = 0.1 sin(6x) cos(5y) over the unit square."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 1, (2, count))
    z = 0.1 * np.sin(6 * x) * np.cos(5 * y) + noise * rng.normal(size=count)
    n = np.stack([-0.6 * np.cos(6 * x) * np.cos(5 * y), 0.5 * np.sin(6 * x) * np.sin(5 * y), np.ones(count)], axis=1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.stack([x, y, z], axis=1).astype(np.float32), n.astype(np.float32)


@pytest.fixture(scope="module")
def tree(device):
    points, normals = wavy_sheet(2000, noise=5e-4)
    return point_tree.build_point_tree(points, normals, np.array([0.5, 0.5, 0], np.float32), 1 / 1.5, device)


@pytest.fixture(scope="module")
def sorted_points(tree):
    host = tree.device.download(tree.sorted)[:, :tree.count].astype(float)
    return host[:3].T, host[3:6].T


def test_morton_codes(device):
    points, _ = wavy_sheet(300)
    order, codes, (bits, scale) = point_tree.morton_order(points, device)
    expected = twin.morton_codes(points[order], points.min(axis=0), scale, bits)
    assert (codes == expected).all() and (np.diff(codes.astype(np.int64)) >= 0).all()
    assert (np.sort(order) == np.arange(300)).all()


def test_gather_points(device):
    points, normals = wavy_sheet(100)
    middle = np.array([0.3, 0.2, 0.1], np.float32)
    tree = point_tree.build_point_tree(points, 7 * normals, middle, 0.25, device, np.arange(100, dtype=np.float32))
    host = device.download(tree.sorted)
    place, unit = twin.gather_points(points, normals, tree.order, middle, 0.25)
    np.testing.assert_allclose(host[:3, :100].T, place, atol=1e-7)
    np.testing.assert_allclose(host[3:6, :100].T, unit, atol=1e-6)
    assert (host[:3, 100:] == point_tree.FAR_POINT).all()


def test_gather_weights(device):
    points, normals = wavy_sheet(100)
    weights = np.random.default_rng(0).uniform(size=100).astype(np.float32)
    tree = point_tree.build_point_tree(points, normals, np.zeros(3, np.float32), 1.0, device, weights)
    expected = twin.gather_weights(weights, tree.order, tree.padded)
    assert (device.download(tree.sorted)[6] == expected.astype(np.float32)).all()


@pytest.mark.parametrize("count", (16, 17, 5000))
def test_block_boxes(device, count):
    padded = -(-count // 16) * 16
    rng = np.random.default_rng(count)
    coordinates, ball = rng.normal(size=(3, padded)).astype(np.float32), rng.uniform(size=padded).astype(np.float32)
    for r in (None, ball):
        boxes, offset, _ = point_tree.build_boxes(device.upload(coordinates), padded, device,
                                                  radius=None if r is None else device.upload(r))
        first, last = device.download(offset)[1:3]
        np.testing.assert_allclose(device.download(boxes)[first:last], twin.block_boxes(coordinates.T, r), rtol=1e-5)


def test_node_boxes(device):
    coordinates = np.random.default_rng(1).normal(size=(3, 16 * 700)).astype(np.float32)
    boxes, offset, top = point_tree.build_boxes(device.upload(coordinates), 16 * 700, device)
    records, offset = device.download(boxes), device.download(offset)
    assert top == 3 and list(np.diff(offset)) == [0, 44, 3, 1]
    for level in (2, 3):
        below = records[offset[level - 1]:offset[level]]
        assert (records[offset[level]:offset[level + 1]] == twin.node_boxes(below, len(below)).astype(np.float32)).all()


def test_open_points(device):
    rng = np.random.default_rng(0)
    overlap, held = rng.integers(0, 20, 160, dtype=np.uint32), (rng.uniform(size=160) < 0.2).astype(np.uint8)
    state = device.empty(160, np.uint8)
    device.kernel("build/open_points.cl")((10,), (1,), 150, 10, 10, device.upload(overlap), device.upload(held), state)
    expected = twin.open_points(overlap, held, 10) & (np.arange(160) < 150)
    assert ((device.download(state) == 0) == expected).all()


def test_cells(tree, sorted_points):
    points, _ = sorted_points
    for some in (None, np.flatnonzero(np.random.default_rng(0).uniform(size=tree.count) < 0.1)):
        first, end, colors = tree.cells(0.1, some)
        seen = np.zeros(tree.count, int)
        for a, b in zip(first, end, strict=True):
            seen[a:b] += 1
            assert np.ptp(points[a:b], axis=0).max() < 0.21
        assert seen.max() == 1 and (seen[some if some is not None else slice(None)] == 1).all()
        for start, stop in itertools.pairwise(colors):
            ranges = zip(first[start:stop], end[start:stop], strict=True)
            middles = np.array([points[a:b].mean(axis=0) for a, b in ranges])
            for m in middles:  # cells of one colour are a whole cell apart
                other = np.abs(middles - m).max(axis=1)
                assert ((other == 0) | (other > 0.1)).all()


@pytest.mark.parametrize("spacing", (0.02, 0.1, 2.0))
def test_choose_centers(tree, sorted_points, spacing):
    device, points = tree.device, sorted_points[0]
    closed = np.ones(tree.padded, np.uint8)
    closed[:tree.count] = np.random.default_rng(0).uniform(size=tree.count) < 0.3
    state = device.empty(tree.padded, np.uint8)
    device.write(state, closed)
    first, end, colors = tree.cells(spacing * 1.001, np.flatnonzero(closed == 0))
    kernel, on_device = device.kernel("build/choose_centers.cl"), (device.upload(first), device.upload(end))
    for start, stop in itertools.pairwise(colors):
        kernel((stop - start,), (1,), stop - start, start, *on_device, spacing, *tree.arguments, state)
    chosen = np.flatnonzero(device.download(state) == slim.CENTER)
    ranges = [(first, end)]  # sorted by colour
    assert (chosen == twin.choose_centers(points, closed[:tree.count] == 0, ranges, spacing)).all()


LAMBDA = 1e-8


def fitted(tree, degree, centers, r_r, lanes=None, penalty=1e-9, mode=slim.SEGMENT, tolerance=np.inf):
    device = tree.device
    need = 2 * twin.terms(min(degree, 2)) + 2
    out = device.empty((len(centers), slim.RECORD), np.float32)
    form = {"VW": lanes} if lanes else point_tree.lane_form(device)
    kernel = device.kernel("build/fit_surfels.cl", constants={"DEGREE": degree, **form})
    kernel((len(centers),), (1,), len(centers), device.upload(centers, np.int32), r_r, LAMBDA, penalty, 0.02, need,
           mode, tolerance, *tree.arguments, out)
    return device.download(out), need


@pytest.mark.parametrize("degree", (1, 2, 3))
@pytest.mark.parametrize("lanes", (16, 1))
def test_fit_surfels(tree, sorted_points, degree, lanes):
    points, normals = sorted_points
    centers = np.arange(0, tree.count, 25)
    agree = 0
    for r_r in (0.06, 0.14):
        record, need = fitted(tree, degree, centers, r_r, lanes)
        for c, got in zip(centers, record.astype(float), strict=True):
            if (((points - points[c]) ** 2).sum(axis=1) < r_r**2).sum() < need:
                continue  # the kernel's ball grows, see test_sparse_ball
            radius_, normal, e, leaf, k = twin.fit_surfels(points, normals, c, r_r, LAMBDA, 1e-9, need, degree)
            if bool(got[5]) != leaf or abs(got[0] - radius_) > 1e-4 * radius_:
                continue  # a decision that rounding tips: another lane, whose E is the same
            agree += 1
            assert normal @ got[1:4] > 1 - 1e-6
            assert got[4] == pytest.approx(e, rel=1e-3, abs=1e-6)
            u, v = np.meshgrid(*2 * [np.linspace(-0.6, 0.6, 5) * radius_])
            error = twin.height(got[6:6 + len(k)], u, v) - twin.height(k, u, v)
            assert np.abs(error).max() < 2e-3 * r_r * (1 if degree < 3 else 3)
            assert np.sqrt((error**2).mean()) < 2e-5
    assert agree > 0.9 * 2 * len(centers) - 20


@pytest.mark.parametrize("lanes", (16, 1))
def test_cubics_on_few_points_are_quadratics(tree, sorted_points, lanes):
    """A bent sheet: the smallest balls are quadratics, and no leaf of degree 3 has an E above that of degree 2."""
    centers = np.arange(0, tree.count, 10)
    found = {degree: fitted(tree, degree, centers, 0.06, lanes, penalty=1e-12)[0] for degree in (2, 3)}
    few, cubic = (found[3][:, 12:] == 0).all(axis=1), found[3]
    points = np.array([((sorted_points[0] - sorted_points[0][c]) ** 2).sum(axis=1) for c in centers])
    count = (points < (cubic[:, 0] * (1 - 1e-5))[:, None] ** 2).sum(axis=1)
    usual = (points < 0.06 ** 2).sum(axis=1) >= 22  # the ball did not grow
    leaf = usual & (cubic[:, 5] > 0)
    assert (leaf & few).sum() > 10 and (leaf & ~few).sum() > 10
    assert count[leaf & few].max() < 22 and count[leaf & ~few].min() >= 21 and count[leaf].min() >= 13
    energy = {degree: found[degree][:, 4] ** 2 + 1e-12 / found[degree][:, 0] ** 2 for degree in (2, 3)}
    both = leaf & (found[2][:, 5] > 0)
    assert np.mean(energy[3][both] <= energy[2][both] * (1 + 1e-4)) > 0.95


@pytest.mark.parametrize("lanes", (16, 1))
def test_fit_leaves_sheet_behind_out(device, lanes):
    """Sparse points, two bent sheets nearer to each other than a ball is wide: every leaf is of its own sheet."""
    points, normals = wavy_sheet(700)
    points, normals = np.concatenate([points, points - 0.02 * normals]), np.concatenate([normals, -normals])
    tree = point_tree.build_point_tree(points, normals, np.zeros(3, np.float32), 1.0, device)
    host = device.download(tree.sorted)[:, :tree.count].astype(float)
    centers = np.arange(0, tree.count, 10)
    record, need = fitted(tree, 2, centers, 0.09, lanes, penalty=1e-12)
    agree = 0
    for c, got in zip(centers, record.astype(float), strict=True):
        inside = ((host[:3].T - host[:3, c]) ** 2).sum(axis=1) < 0.09**2
        if inside.sum() < need or (inside & (host[3:].T @ host[3:, c] > -0.2)).sum() < twin.terms(2):
            continue
        radius_, normal, e, leaf, _ = twin.fit_surfels(host[:3].T, host[3:].T, c, 0.09, LAMBDA, 1e-12, need, 2)
        if got[5]:
            assert got[1:4] @ host[3:, c] > 0.9
            assert got[4] < 0.003  # 0.01 with both sheets
        if leaf and got[5] and abs(got[0] - radius_) < 1e-4 * radius_:
            agree += 1
            assert normal @ got[1:4] > 1 - 1e-6 and got[4] == pytest.approx(e, rel=1e-2, abs=1e-6)
    assert agree > 0.6 * len(centers)


@pytest.mark.parametrize("lanes", (16, 1))
def test_fit_of_thinned_ball(device, lanes):
    points, normals = wavy_sheet(20000, noise=1e-3)
    tree = point_tree.build_point_tree(points, normals, np.zeros(3, np.float32), 1.0, device)
    host = device.download(tree.sorted)[:, :tree.count].astype(float)
    centers = np.arange(0, tree.count, 999)
    record, _ = fitted(tree, 2, centers, 0.2, lanes, mode=slim.FIXED)
    for c, got in zip(centers, record.astype(float), strict=True):
        _, k, e2 = twin.fit_at(host[:3].T, host[3:].T, c, 0.2, 0.618034 * 0.2, 2)
        assert got[4] == pytest.approx(np.sqrt(e2), rel=1e-3)
        unit = 0.2 ** np.array([-1, 0, 0, 1, 1, 1])
        np.testing.assert_allclose(got[6:12] * unit, k * unit, atol=2e-5)


@pytest.mark.parametrize("lanes", (16, 1))
def test_sparse_ball(tree, lanes):
    record, _ = fitted(tree, 2, np.arange(0, tree.count, 200), 1e-4, lanes)
    assert (record[:, 5] == 1).all() and (record[:, 0] > 1e-4).all() and np.isfinite(record[:, :12]).all()


@pytest.mark.parametrize("tolerance", (np.inf, 3e-4))
def test_cover_points(tree, sorted_points, tolerance):
    points, normals = sorted_points
    device, centers = tree.device, np.arange(0, tree.count, 40)
    record, _ = fitted(tree, 2, centers, 0.1)
    record[::3, 5] = 0
    record[::5, 1:4] *= -1  # leaves that face away represent only their own centre
    overlap, held = device.zeros(tree.padded, np.uint32), device.zeros(tree.padded, np.uint8)
    device.kernel("build/cover_points.cl")((len(centers),), (1,), len(centers), device.upload(centers, np.int32),
                                           device.upload(record), tolerance, 6, *tree.arguments, overlap, held)
    expected, expected_held = twin.cover_points(points, normals, centers, record, tolerance=tolerance)
    got = device.download(overlap)[:tree.count] / slim.OVERLAP_ONE
    assert (np.abs(got - expected) < 3e-4).all()
    assert ((device.download(held)[:tree.count] != 0) != expected_held).mean() < 0.002


def test_cover_leaves(tree, sorted_points):
    points, normals = sorted_points
    device, centers = tree.device, np.arange(0, tree.count, 40)
    record, _ = fitted(tree, 2, centers, 0.1)
    place = (points[centers] + 0.004).astype(np.float32)
    overlap, held = device.zeros(tree.padded, np.uint32), device.zeros(tree.padded, np.uint8)
    device.kernel("build/cover_leaves.cl")((len(place),), (1,), len(place), device.upload(place), device.upload(record),
                                           5e-3, 6, *tree.arguments, overlap, held)
    expected, _ = twin.cover_leaves(points, normals, place, record, tolerance=5e-3)
    # Points that are as far off as the tolerance, to rounding, may fall either way.
    assert (np.abs(device.download(overlap)[:tree.count] / slim.OVERLAP_ONE - expected) < 3e-4).mean() > 0.999
    assert 0.1 < (expected > 0).mean() < 1


def test_check_leaves(tree, sorted_points):
    points, _ = sorted_points
    device, centers = tree.device, np.arange(0, tree.count, 40)
    record, _ = fitted(tree, 2, centers, 0.14)
    place = (points[centers] + 0.004).astype(np.float32)
    own = np.zeros(tree.padded, np.uint8)
    own[:tree.count] = points[:, 0] > 0
    sums = device.empty((len(place), 2), np.float32)
    device.kernel("build/check_leaves.cl")(
        (len(place),), (1,), len(place), device.upload(place), device.upload(record), 6, tree.padded, tree.sorted,
        device.upload(own), *tree.arguments[2:], sums)
    expected = twin.check_leaves(points, own[:tree.count], place, record)
    assert np.allclose(device.download(sums), expected, rtol=2e-4, atol=1e-7)
    assert (expected[:, 0] == 0).any() and (expected[:, 0] > 5).any()


@pytest.mark.parametrize("tolerance", (1e-3, 1e-4))
@pytest.mark.parametrize("lanes", (16, 1))
def test_tolerance_of_fits(tree, sorted_points, tolerance, lanes):
    """A leaf keeps half the tolerance in its mean error and comes near its centre, or is a disc at the centre."""
    centers = np.arange(0, tree.count, 10)
    record, _ = fitted(tree, 2, centers, 0.14, lanes, tolerance=tolerance)
    free, _ = fitted(tree, 2, centers, 0.14, lanes)
    disc = (record[:, 6:] == 0).all(axis=1) & (record[:, 5] > 0)
    leaf = (record[:, 5] > 0) & ~disc
    assert (record[leaf, 4] <= 0.5 * tolerance * 1.01).all() and (np.abs(record[leaf, 6]) <= tolerance).all()
    assert (record[leaf] == free[leaf]).all()
    assert np.allclose(record[disc, 1:4], sorted_points[1][centers[disc]], atol=1e-5)


@pytest.mark.parametrize("turns", (None, 65535), ids=("on_the_device", "on_the_host"))
def test_neighbor_spread(tree, sorted_points, turns, monkeypatch):
    monkeypatch.setattr(tree.device, "loop_turns", turns)
    points = sorted_points[0]
    noise = radius.measure_noise(tree)
    pairs = np.array([twin.neighbor_spread(points, i) for i in range(tree.count)])
    assert noise.variance == pytest.approx(pairs[:, 0].mean(), rel=1e-3)
    assert noise.spacing == pytest.approx(np.sqrt(np.median(pairs[:, 1]) * np.pi / 10.5), rel=1e-4)


@pytest.mark.parametrize("degree", (1, 2, 3))
def test_surfel_footprints(tree, sorted_points, degree):
    points, normals = sorted_points
    centers = np.arange(0, tree.count, 30, dtype=np.int32)
    record, _ = fitted(tree, degree, centers, 0.1)
    got = slim.surfel_footprints(tree, centers, record, 1 if degree == 1 else twin.terms(degree))
    limited = 0
    for c, surfel, octagon in zip(centers, record, got, strict=True):
        if surfel[5]:
            share = twin.surfel_footprints(points, normals, c, surfel, degree)
            limited += share.min() < 1
            assert np.abs(octagon - 255 * np.clip(share, 0, 1)).max() <= 1.01
        else:
            assert (octagon == 255).all()
    assert limited > 5


def test_surfel_colors(tree, sorted_points):
    points, normals = sorted_points
    centers = np.arange(0, tree.count, 50, dtype=np.int32)
    record, _ = fitted(tree, 2, centers, 0.1)
    colors = np.random.default_rng(0).uniform(size=(4, tree.padded)).astype(np.float32)
    device = tree.device
    out = device.empty((len(centers), 4), np.float32)
    device.kernel("build/surfel_colors.cl")((len(centers),), (1,), len(centers), device.upload(centers),
                                            device.upload(record), device.upload(colors), *tree.arguments, out)
    for c, surfel, got in zip(centers, record, device.download(out), strict=True):
        expected = twin.surfel_colors(points, normals, c, surfel, colors[:, :tree.count].T)
        np.testing.assert_allclose(got, expected, atol=1e-4)


@pytest.mark.parametrize("degree", (1, 2, 3))
def test_project_points(device, degree):
    points, normals = wavy_sheet(3000)
    surface = build_slim(PointCloud(points, normals=normals), degree=degree, error=0.02, device=device)
    queries = points[::30].astype(float) + np.random.default_rng(0).normal(scale=0.01, size=(100, 3))
    near = project.project(surface, queries, device=device)
    expected = [twin.project_points(surface, p) for p in queries]
    error = np.array([np.linalg.norm(q - got) for (q, _, _), got in zip(expected, near.position, strict=True)])
    assert np.mean(error < 2e-5) > 0.97  # the nearest leaf may tip where two are equally near
    good = error < 2e-5
    np.testing.assert_allclose(near.distance[good], np.array([e[2] for e in expected])[good], atol=2e-5)
    assert (np.einsum("ij,ij->i", near.normal, np.array([e[1] for e in expected]))[good] > 1 - 1e-4).all()
