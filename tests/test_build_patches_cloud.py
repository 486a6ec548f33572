"""Patches from point clouds: exact on known shapes, apart where sheets are apart, open where points are missing."""

import numpy as np
import pytest

from bench.patch_coverage import coverage, distance_to_cells, opaque_cells, point_spacing
from clsurf.build import patch_local, patch_regions, patch_seeds, patch_views
from clsurf.build.patch_points import sheet_points
from clsurf.build.patches import build_patches
from clsurf.errors import Cancelled, InputError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.srgb import premultiplied, straight
from tests.reference import patch_cloud as twin

RNG = np.random.default_rng(3)


def sphere(count, radius=1.0):
    """A Fibonacci lattice: points and normals (count, 3)."""
    normals = patch_views.sphere_directions(count)
    return radius * normals, normals


def grid(columns, rows, step=1.0, jitter=0.2):
    i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    points = np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3).astype(float)
    points[:, :2] += jitter * RNG.uniform(-1, 1, (len(points), 2))
    return step * points


def turned(points):
    """Turn points so that nothing is parallel to an axis."""
    q, _ = np.linalg.qr(np.array([[0.3, -0.5, 0.8], [0.9, 0.2, -0.1], [0.1, 0.7, 0.4]]))
    return points @ q.T


def drawn(surface):
    nodes = surface.positions()
    return nodes[np.isfinite(nodes[:, 0])]


def cloud_of(points, normal=(0, 0, 1), **rest):
    return PointCloud(turned(points), turned(np.broadcast_to(np.array(normal, float), points.shape)), **rest)


# Kernels -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(device):
    """A bowl of 700 coloured points, as the kernels see it."""
    xy = RNG.uniform(-1, 1, (700, 2))
    points = np.concatenate([xy, 0.3 * (xy**2).sum(axis=1, keepdims=True)], axis=1)
    normals = np.concatenate([-0.6 * xy, np.ones((700, 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = RNG.integers(1, 256, (700, 4)).astype(np.uint8)
    return patch_regions.Sheet(sheet_points(PointCloud(points, normals, colors), device))


@pytest.mark.parametrize("lanes", [16, 8, 4, 1])
def test_assign_regions(device, small, lanes):
    tree, rng = small.points.tree, np.random.default_rng(5)
    seeds = np.zeros((37, 8), np.float32)
    seeds[:, :3] = small.position[rng.choice(len(small), 37)]
    seeds[:, 3:6] = small.normals[rng.choice(len(small), 37)]
    order, boxes = patch_seeds.sorted_seeds(seeds)
    seeds = seeds[order]
    labels = device.zeros(tree.padded, np.int32)
    kernel = device.kernel("build/assign_regions.cl", constants={"VW": lanes})
    kernel((-(-tree.count // lanes),), (1,), tree.count, tree.padded, tree.sorted, len(seeds), device.upload(seeds),
           device.upload(boxes), 3.0, 0.1, labels)
    found = device.download(labels)[:tree.count]
    cost = twin.assign_regions(small.position, small.normals, seeds.astype(float), 3.0, 0.1)
    np.testing.assert_allclose(cost[np.arange(len(cost)), found], cost.min(axis=1), atol=1e-6)
    assert len(np.unique(found)) > 20


def test_region_extents(device, small):
    tree = small.points.tree
    label = (small.position[:, 0] > 0).astype(int) + 2 * (small.position[:, 1] > 0.1)
    order = np.argsort(label, kind="stable").astype(np.int32)
    start = np.searchsorted(label[order], np.arange(5)).astype(np.int32)
    frames = np.zeros((4, 8), np.float32)
    frames[:, :6] = patch_regions.mean_frames(small, order, label[order], 4)
    out = device.empty((4, 5, 16), np.float32)
    device.kernel("build/region_extents.cl")((4,), (1,), 4, device.upload(start), device.upload(order), tree.padded,
                                             tree.sorted, device.upload(frames), out)
    found = device.download(out)
    for k in range(4):
        expected = twin.region_extents(small.position[label == k], frames[k].astype(float))
        np.testing.assert_allclose(found[k, :4], expected[:4], atol=2e-6)
        np.testing.assert_allclose(found[k, 4, :2], expected[4, :2], atol=2e-6)


@pytest.mark.parametrize("lanes", [16, 8, 4, 1])
def test_fit_patch_nodes(device, small, lanes, monkeypatch):
    monkeypatch.setattr(device, "lanes", lanes)
    captured = []
    kernel_of = device.kernel
    monkeypatch.setattr(device, "kernel", lambda path, *rest, **more: (
        lambda *given: captured.append(given) or kernel_of(path, *rest, **more)(*given)))
    gap = 0.05
    regions = patch_regions.find_regions(small, (6 * gap, 4 * gap))
    regions.noise[:] = 0
    captured.clear()
    patch_local.fitted(small, regions, gap, (7, 5))
    given = captured[-1]
    count, found = given[2], device.download(given[-1])
    frames = device.download(given[7]).astype(float)
    labels, light = device.download(given[-3])[:, :len(small)], device.download(given[-2])[:, :len(small)].astype(float)
    assert count == len(regions) > 10
    for k in range(0, count, 5):
        expected = twin.fit_patch_nodes(small.position, small.normals, labels, light, frames[k], k, 7, 5, gap)
        same = (found[3, k] > 0) == (expected[3] > 0)
        assert same.all()
        shown = expected[3] > 0
        np.testing.assert_allclose(found[0, k][shown], expected[0][shown], atol=3e-5)
        np.testing.assert_allclose(np.sqrt(found[1:3, k][:, shown]), np.sqrt(expected[1:3][:, shown]), atol=1e-4)
        np.testing.assert_allclose(found[4:, k][:, shown], expected[4:][:, shown], atol=1e-3)


def test_splats(device, small):
    tree, points = small.points.tree, small.points
    x, y, z = turned(np.eye(3)).T
    view = np.concatenate([-0.4 * x - 0.4 * y, x, y, z]).astype(np.float32)
    step, columns, rows, thickness = 0.04, 21, 19, 0.05
    nearest = device.empty((rows, columns), np.uint32)
    device.fill(nearest, 0xFFFFFFFF)
    sums = device.zeros((7, rows, columns), np.int32)
    given = (tree.count, tree.padded, tree.sorted, device.upload(view), 1 / step, columns, rows, nearest)
    device.kernel("build/splat_depths.cl")((tree.count,), (64,), *given)
    device.kernel("build/splat_means.cl")((tree.count,), (64,), *given, thickness, 1e5, device.upload(points.light),
                                          sums)
    bits = device.download(nearest)
    front = -np.where(bits & 0x80000000, bits & 0x7FFFFFFF, ~bits).astype(np.uint32).view(np.float32).astype(float)
    expected = twin.splat_depths(small.position, small.normals, view.astype(float), step, columns, rows)
    empty = bits == 0xFFFFFFFF
    assert (empty == ~np.isfinite(expected)).all() and 20 < (~empty).sum()
    np.testing.assert_allclose(front[~empty], expected[~empty], atol=1e-6)
    expected = twin.splat_means(small.position, small.normals, points.light[:, :len(small)].astype(float),
                                view.astype(float), step, expected, thickness)
    found = device.download(sums) / np.array([1, 1e5, 4096, 4096, 4096, 4096, 4096])[:, None, None]
    assert (found[0] == expected[0]).all()
    np.testing.assert_allclose(found[1:], expected[1:], atol=2e-3)


# Exactness -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["local", "global_views"])
def test_a_plane_is_exact(device, method):
    points = grid(60, 40)
    surface = build_patches(cloud_of(points), method=method, precise=True, device=device)
    heights = drawn(surface) @ turned(np.eye(3))[2]
    assert np.abs(heights).max() < (1e-4 if method == "local" else 2e-3)  # z-buffers are of 1/1024 pixels
    found = coverage(surface, turned(points))
    assert found.points_covered == 1 and found.nodes_supported == 1
    normals = surface.axis_z / np.linalg.norm(surface.axis_z, axis=1, keepdims=True)
    if method == "local":
        np.testing.assert_allclose(normals, np.broadcast_to(turned(np.eye(3))[2], normals.shape), atol=1e-3)


def test_the_error_on_a_sphere_is_of_second_order(device):
    error = []
    for count in (3000, 12000):
        surface = build_patches(PointCloud(*sphere(count)), precise=True, device=device)
        error.append(np.sqrt(np.mean((np.linalg.norm(drawn(surface), axis=1) - 1) ** 2)))
        assert coverage(surface, sphere(count)[0]).points_covered == 1
    assert error[0] < 4e-3 and error[0] / error[1] > 3.3


@pytest.mark.parametrize("second", [1, -1])
def test_two_sheets_stay_apart(device, second):
    points = np.concatenate([grid(40, 40), grid(40, 40) + np.array([0, 0, 3])])
    normals = np.repeat([[0.0, 0, second], [0, 0, 1]], 1600, axis=0)
    surface = build_patches(PointCloud(points, normals), precise=True, device=device)
    z = drawn(surface)[:, 2]
    assert np.minimum(np.abs(z), np.abs(z - 3)).max() < 0.02
    assert (z < 1.5).any() and (z > 1.5).any()


def test_a_gap_stays_and_a_crack_does_not(device):
    points = grid(60, 60, jitter=0.0)
    points[points[:, 0] >= 30, 0] += 2.6  # 3.6 between the rows
    surface = build_patches(PointCloud(points, np.broadcast_to([0.0, 0, 1], points.shape)), device=device)
    nodes, cells = surface.positions(), opaque_cells(surface)
    middle = np.stack([np.full(200, 30.8), np.linspace(1, 58, 200), np.zeros(200)], axis=1)
    assert not np.isfinite(distance_to_cells(middle, nodes, cells, 0.2)).any()
    inside = np.concatenate([RNG.uniform(1, 28, (3000, 1)), RNG.uniform(1, 58, (3000, 1)), np.zeros((3000, 1))], axis=1)
    assert np.isfinite(distance_to_cells(inside, nodes, cells, 0.15 * 1.25)).mean() > 0.1
    assert covered_by_cells(surface, inside).all()


def covered_by_cells(surface, points):
    """Whether points of the plane z = 0 lie over a cell that shows (cells as quads in x and y)."""
    corners = surface.positions()[opaque_cells(surface)][:, [0, 1, 3, 2], :2]
    out = np.zeros(len(points), bool)
    for quad in corners:
        near = np.flatnonzero(~out & (np.abs(points[:, :2] - quad.mean(axis=0)) < 2).all(axis=1))
        a, b = quad, np.roll(quad, -1, axis=0)
        side = ((b - a)[:, None, 0] * (points[None, near, 1] - a[:, None, 1])
                - (b - a)[:, None, 1] * (points[None, near, 0] - a[:, None, 0]))
        out[near] |= (side >= -1e-6).all(axis=0) | (side <= 1e-6).all(axis=0)
    return out


def test_patches_overlap_without_seams(device):
    points = grid(70, 50)
    surface = build_patches(PointCloud(points, np.broadcast_to([0.0, 0, 1], points.shape)), device=device)
    assert len(surface) > 6
    inside = np.concatenate([RNG.uniform(1, 68, (4000, 1)), RNG.uniform(1, 48, (4000, 1)), np.zeros((4000, 1))], axis=1)
    assert covered_by_cells(surface, inside).all()


# Attributes and invariance -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["local", "global_views"])
def test_colors(device, method):
    points = grid(40, 40)
    colors = np.where(points[:, :1] < 19.5, [[200, 30, 0, 255]], [[0, 120, 250, 255]]).astype(np.uint8)
    cloud = PointCloud(points, np.broadcast_to([0.0, 0, 1], points.shape), colors)
    surface = build_patches(cloud, method=method, device=device)
    nodes = surface.positions()
    for side, color in ((nodes[:, 0] < 16, (200, 30, 0)), (nodes[:, 0] > 23, (0, 120, 250))):
        assert side.any() and (np.abs(surface.colors[side].astype(int) - color) <= 1).all()
    black = build_patches(PointCloud(points, cloud.normals, np.tile(np.uint8([0, 0, 0, 255]), (1600, 1))),
                          method=method, device=device)
    assert (black.colors[black.opaque] == 1).all()


def test_premultiplied_and_back():
    colors = RNG.integers(1, 256, (500, 4)).astype(np.uint8)
    assert np.abs(straight(premultiplied(colors)).astype(int) - colors).max() <= 1


@pytest.mark.parametrize("method", ["local", "global_views"])
def test_order_and_repetition_do_not_matter(device, method):
    points, normals = sphere(2500)
    wanted = build_patches(PointCloud(points, normals), method=method, device=device)
    order = RNG.permutation(np.repeat(np.arange(2500), 2))
    found = build_patches(PointCloud(points[order], normals[order]), method=method, device=device)
    assert (found.displacements == wanted.displacements).all() and (found.origins == wanted.origins).all()


def test_spacing_is_that_of_an_even_grid(device):
    spacing = lambda points: sheet_points(PointCloud(points), device).spacing  # noqa: E731
    points = grid(50, 50, step=0.3, jitter=0.3)
    assert spacing(points) == pytest.approx(0.3, rel=0.05)
    assert spacing(np.concatenate([points, points])) == spacing(points)
    rounded = np.round(points / 0.3) * 0.3
    assert spacing(rounded) == pytest.approx(0.3, rel=0.15)
    twins = np.concatenate([points, points + 1e-4])  # pairs of points at nearly the same place
    assert spacing(twins) == pytest.approx(0.3 / np.sqrt(2), rel=0.1) and point_spacing(twins) < 0.01


@pytest.mark.parametrize("method", ["local", "global_views"])
def test_without_normals_and_far_away(device, method):
    points, _ = sphere(4000)
    far = np.array([7_691_239.553, -512_000.25, 31.0])
    surface = build_patches(PointCloud(points + far), method=method, device=device)
    assert surface.oriented
    nodes = drawn(surface) - far
    assert np.abs(np.linalg.norm(nodes, axis=1) - 1).max() < 0.03
    assert coverage(surface, points + far).points_covered > 0.999
    out = np.einsum("ij,ij->i", surface.axis_z, surface.origins + surface.origin - far)
    assert (out > 0).mean() > 0.99


def test_unoriented_normals_are_said_so(device):
    from clsurf.build.patch_points import agreement
    points, normals = sphere(3000)
    found = sheet_points(PointCloud(points, normals), device)
    flipped = found.normals * RNG.choice([-1, 1], (3000, 1))
    assert agreement(found.position, found.normals, found.neighbours) == 1
    assert agreement(found.position, flipped, found.neighbours) < 0.7


# What is asked for ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["local", "global_views"])
def test_number_of_patches(device, method):
    surface = build_patches(PointCloud(*sphere(6000)), patches=40, method=method, device=device)
    assert 30 <= len(surface) <= 40


def test_spacing_and_sizes(device):
    cloud = PointCloud(*sphere(4000))
    surface = build_patches(cloud, spacing=0.08, nodes=(9, 17), device=device)
    np.testing.assert_allclose(np.linalg.norm(surface.axis_x, axis=1), 0.08, rtol=1e-5)
    assert (surface.size == (9, 17)).all() and coverage(surface, sphere(4000)[0]).points_covered > 0.999


def test_error_is_kept(device):
    points, normals = sphere(6000)
    fine, coarse = (build_patches(PointCloud(points, normals), nodes=9, error=e, device=device)
                    for e in (1e-3, 4e-3))
    for surface, error in ((fine, 1e-3), (coarse, 4e-3)):
        off = np.abs(np.linalg.norm(drawn(surface), axis=1) - 1)
        assert np.sqrt(np.mean(off**2)) < 1.5 * error * surface.diagonal
    assert len(coarse) < len(fine)


def test_bound_and_diagonal(device):
    points, normals = sphere(5000)
    surface = build_patches(PointCloud(points, normals), device=device)
    assert surface.diagonal == pytest.approx(2 * np.sqrt(3), rel=1e-3) and surface.bound_share == 0.999
    nodes = surface.positions()
    near = np.isfinite(distance_to_cells(points, nodes, opaque_cells(surface), 0.06))
    assert near.all() and 0 < surface.bound < 0.02


def test_progress_and_cancel(device):
    seen = []
    cloud = PointCloud(*sphere(2000))
    build_patches(cloud, device=device, progress=lambda what, done: seen.append(done))
    assert seen == sorted(seen) and seen[0] == 0 and seen[-1] == 1
    with pytest.raises(Cancelled):
        build_patches(cloud, device=device, progress=lambda what, done: done < 0.5)


# Odd input -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["local", "global_views"])
@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.ones((1, 3)), np.ones((5, 3)), np.full((4, 3), np.nan)])
def test_no_extent_is_said_in_one_line(device, method, points):
    with pytest.raises(InputError, match=r"^scan: [^\n]*$"):
        build_patches(PointCloud(points), method=method, device=device)


@pytest.mark.parametrize("points", [np.eye(3), np.eye(3)[:2], np.arange(50.0)[:, None] * [1, 2, 3],
                                    RNG.normal(size=(300, 3)) * 1e6, RNG.normal(size=(60, 3)) * 1e-20])
def test_odd_clouds_work_or_say_so(device, points):
    for method in ("local", "global_views"):
        try:
            surface = build_patches(PointCloud(points), method=method, device=device)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert np.isfinite(surface.bounds).all()


def test_points_that_are_not_finite_are_left_out(device):
    points, normals = sphere(3000)
    broken = points.copy()
    broken[::50] = np.nan
    surface = build_patches(PointCloud(broken, normals, origin=np.zeros(3)), device=device)
    assert np.isfinite(surface.bounds).all() and coverage(surface, points).points_covered == 1


# Parts ---------------------------------------------------------------------------------------------------------------


def test_regions_fit(small):
    size = (0.5, 0.3)
    regions = patch_regions.find_regions(small, size)
    label = regions.label
    assert (np.bincount(label[label >= 0]) >= patch_regions.LEAST).all() and (label >= 0).mean() > 0.98
    assert (regions.extent[:, 0] <= size[0]).all() and (regions.extent[:, 1] <= size[1]).all()
    np.testing.assert_allclose(regions.axes @ regions.axes.transpose(0, 2, 1), np.tile(np.eye(3), (len(regions), 1, 1)),
                               atol=1e-6)
    for k in range(len(regions)):
        offset = (small.position[label == k] - regions.center[k]) @ regions.axes[k].T
        assert (np.abs(offset[:, :2]) <= regions.extent[k] / 2 + 1e-6).all()


def test_connected_splits_what_does_not_hang_together(small):
    label = np.where(np.abs(small.position[:, 0]) < 0.12, 0, 1)  # the bowl without its middle falls in two
    found = patch_regions.connected(small, label)
    assert len(np.unique(found[label == 0])) == 1 and len(np.unique(found[label == 1])) == 2


def test_supported_opens_what_bridges():
    known = np.ones((1, 3, 4), bool)
    near2, cell2 = np.full((1, 3, 4), 0.5), np.full((1, 3, 4), 0.5)
    near2[0, 1, 1], cell2[0, 1, 1] = 0.9, 2.0  # the middle of cell (1, 1) has no point; node (1, 1) is the worst
    shows = patch_local.supported(known, near2, cell2, np.ones(1))
    assert not shows[0, 1, 1] and not shows[0, 0, 0] and shows[0, :, 2:].all()  # (0, 0): no whole cell is left


def test_gaps_are_filled_but_not_jumps():
    height = np.zeros((9, 12))
    height[:, 6:] = 10.0
    height += 0.1 * np.arange(12) + 0.2 * np.arange(9)[:, None]
    wanted = height.copy()
    height[4, 2] = height[4:6, 9] = height[3:6, 5] = np.nan
    height[:, 11] = np.nan
    image = patch_views.View(np.zeros(3), np.eye(3), height, np.ones((9, 12)), None)
    patch_views.fill_gaps(image, 1.0)
    assert np.isnan(image.height[4, 5]) and np.isnan(image.height[:, 11]).all()  # a jump, a border
    np.testing.assert_allclose(image.height[4:6, [2, 9]], wanted[4:6, [2, 9]], atol=1e-12)


def test_rectangles_hold_all_their_cells():
    i, j = RNG.integers(0, 50, (2, 700))
    first_i, first_j, place = patch_views.rectangles(i, j, (8, 6))
    kept = place >= 0
    assert kept.mean() > 0.8
    inside_i, inside_j = i[kept] - first_i[place[kept]], j[kept] - first_j[place[kept]]
    assert ((inside_i >= 0) & (inside_i < 8) & (inside_j >= 0) & (inside_j < 6)).all()


def test_coverage_counts_what_it_says():
    from clsurf.build.quantize import quantized
    height = np.zeros((17, 17))
    height[5, 5] = np.nan
    surface = quantized(np.zeros((1, 3)), np.array([[0.1, 0, 0]]), np.array([[0, 0.1, 0]]), height.ravel(), (17, 17))
    points = np.stack(np.meshgrid(np.linspace(0, 1.6, 33), np.linspace(0, 1.6, 33), [0.0]), axis=-1).reshape(-1, 3)
    assert coverage(surface, points + np.array([0, 0, 0.17])).points_covered == 1
    assert coverage(surface, points + np.array([0, 0, 0.201])).points_covered == 0
    assert coverage(surface, points + np.array([0, 0, 0.099])).nodes_supported == 1
    assert coverage(surface, points + np.array([0, 0, 0.101])).nodes_supported == 0
    found = coverage(surface, points)
    assert (found.patches, found.nodes, found.opaque) == (1, 289, 288)
    assert found.node_spacing == pytest.approx(0.1) and found.point_spacing == pytest.approx(0.05)
