"""Exact nearest neighbours and their covariance, on the device.

Points are sorted along a Hilbert curve and cut into leaves of 16 consecutive points under a tree of 16-wide boxes. One
work-item answers 16 neighbouring queries at once, its lanes. The search is exact at any density and has nothing to
tune.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import DeviceArray, open_device
from ..errors import InputError
from ..surface.arrays import box_of

LARGEST_K = 128
WIDTH = 16  # points of a leaf, children of a node
LONG_RUN = 64  # points in one cell of the curve that are worth a finer curve of their own


@dataclass
class BoxTree:
    """Points in the order of a Hilbert curve, and the tree of boxes over them; lives on `device`.

    Attributes
    ----------
    order : (n,) uint32
        Index of the point at each place along the curve.
    unit : float
        World length of 1 in the tree's coordinates, a power of two: squares neither overflow nor vanish.
    leaf_count, first_leaf : int
        Leaves of 16 points; heap number of the first one (kernels/build/knn_tree.cl).
    """

    device: object
    points: DeviceArray  # (n, 3) float32
    order: NDArray  # (n,) uint32
    order_on_device: DeviceArray
    leaves: DeviceArray  # (leaf_count, 3, 16) float32, world / unit
    nodes: DeviceArray  # (node_count, 6, 16) float32
    leaf_count: int
    first_leaf: int
    unit: float

    def __len__(self):
        return len(self.order)


def box_tree(points, device=None, unit=None) -> BoxTree:
    """Build the tree over `points` (n, 3) float32, n at least 1, all finite; `unit`: see `BoxTree`.

    Raises
    ------
    InputError
        An array of another shape, no points, or NaN or infinity among them.
    """
    device = open_device(device)
    points = checked(points)
    count = len(points)
    low, high = box_of(points)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise InputError("points: expected finite coordinates, got NaN or infinity: drop them first (load() does)")
    extent = float((high.astype(np.float64) - low).max())
    if unit is None:
        unit = float(2.0 ** np.clip(np.ceil(np.log2(extent)), -100, 100)) if extent > 0 else 1.0
    leaf_count = -(-count // WIDTH)
    depth = 1
    while WIDTH ** depth < leaf_count:
        depth += 1
    first_leaf = (WIDTH ** depth - 1) // (WIDTH - 1)
    node_count = (first_leaf + leaf_count - 2) // WIDTH + 1
    device.check_memory(points=points.nbytes, keys=8 * count, leaves=192 * leaf_count, nodes=384 * node_count)
    on_device = device.upload(points)
    order = curve_order(device, points, on_device, low, extent)
    tree = BoxTree(device, on_device, order, device.upload(order), device.empty((leaf_count, 3, WIDTH), np.float32),
                     device.empty((node_count, 6, WIDTH), np.float32), leaf_count, first_leaf, unit)
    _fill_boxes(tree, depth)
    return tree


def _fill_boxes(tree: BoxTree, depth: int) -> None:
    """Fill leaves and nodes, from the leaves up."""
    padded = -(-tree.leaf_count // WIDTH) * WIDTH
    tree.device.kernel("build/knn_tree.cl", "knn_leaves")(
        (padded,), None, tree.points, tree.order_on_device, tree.leaves, tree.nodes, len(tree), tree.leaf_count, padded,
        tree.first_leaf, 1.0 / tree.unit)
    count = padded // WIDTH
    for level in range(depth - 1, 0, -1):
        first, padded = (WIDTH ** level - 1) // (WIDTH - 1), -(-count // WIDTH) * WIDTH
        tree.device.kernel("build/knn_tree.cl", "knn_nodes")((padded,), None, tree.nodes, first, count, padded)
        count = padded // WIDTH


def checked(points) -> NDArray:
    """Return `points` as C-contiguous (n, 3) float32, n at least 1."""
    points = np.ascontiguousarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(f"points: expected an array of shape (n, 3) with at least one point, got {points.shape}")
    return points


def curve_order(device, points, on_device, low, extent) -> NDArray:
    """Return the order (n,) uint32 of `points` along a Hilbert curve through the cube of side `extent` at `low`."""
    count = len(points)
    keys, index_bits = _curve_keys(device, on_device, low, extent)
    keys.sort()
    order = (keys & np.uint64((1 << index_bits) - 1)).astype(np.uint32)
    if count <= LONG_RUN:
        return order
    keys >>= np.uint64(index_bits)
    # Only where LONG_RUN points share one cell can keys that far apart be equal.
    if (keys[LONG_RUN:] == keys[:-LONG_RUN]).any():
        _refine(device, points, order, keys)
    return order


def _curve_keys(device, on_device, low, extent) -> tuple[NDArray, int]:
    """Return the sort keys (n,) uint64, curve index above point index, and the bits of the latter."""
    count = len(on_device)
    index_bits = max((count - 1).bit_length(), 1)
    curve_bits = min((64 - index_bits) // 3, 21)
    keys = device.empty(count, np.uint64)
    lanes = device.lanes
    kernel = device.kernel("build/hilbert.cl", constants={"VW": lanes, "CURVE_BITS": curve_bits,
                                                          "INDEX_BITS": index_bits})
    cells = min(2.0 ** curve_bits / extent, 3e38) if extent > 0 else 0.0
    kernel((-(-count // lanes),), _local(device), on_device, keys, count, *low, cells)
    return device.download(keys, copy=False), index_bits


def _refine(device, points, order, cells) -> None:
    """Sort points that share a cell of the curve along finer curves of their own, again until none are left.

    A cloud whose density varies by more than the curve's resolution would otherwise have leaves as large as a cell.
    """
    pending = [(0, len(order), cells)]
    while pending:
        start, stop, cells = pending.pop()
        edges = np.flatnonzero(np.diff(cells)) + 1
        edges = np.concatenate([[0], edges, [stop - start]])
        for run in np.flatnonzero(np.diff(edges) > LONG_RUN):
            a, b = start + edges[run], start + edges[run + 1]
            inside = points[order[a:b]]
            low = inside.min(axis=0)
            extent = float((inside.max(axis=0).astype(np.float64) - low).max())
            if extent == 0.0:
                continue  # one position many times
            keys, index_bits = _curve_keys(device, device.upload(inside), low, extent)
            keys = np.sort(keys)
            order[a:b] = order[a:b][keys & np.uint64((1 << index_bits) - 1)]
            keys >>= np.uint64(index_bits)
            if (keys[LONG_RUN:] == keys[:-LONG_RUN]).any() and keys[0] != keys[-1]:
                pending.append((a, b, keys))


def _local(device) -> tuple:
    """Work-group size: one item with lanes on CPUs, 64 items without lanes elsewhere."""
    return (64,) if device.lanes == 1 and device.kind != "cpu" else (1,)


@dataclass
class _Queries:
    """Query points in blocks of 16 neighbours."""

    blocks: DeviceArray  # (b, 3, 16) float32, tree units
    order: DeviceArray  # (q,) uint32, where results go
    starts: DeviceArray  # (b,) uint32, a leaf near each block
    count: int


def _own_queries(tree: BoxTree, order=None) -> _Queries:
    starts = tree.device.upload(np.arange(tree.leaf_count, dtype=np.uint32))
    return _Queries(tree.leaves, tree.order_on_device if order is None else order, starts, len(tree))


def _other_queries(tree: BoxTree, queries) -> _Queries:
    """Sort `queries` (q, 3) along a curve of their own; each block starts at a leaf near its first query."""
    other = box_tree(queries, tree.device, tree.unit)
    first = checked(queries)[other.order[::WIDTH]]
    return _Queries(other.leaves, other.order_on_device, tree.device.upload(_near_leaves(tree, first)), len(other))


def _near_leaves(tree: BoxTree, points) -> NDArray:
    """Return for each of `points` (b, 3) the leaf (b,) uint32 with the nearest first point among a thinned sample."""
    from scipy.spatial import cKDTree

    step = max(1, tree.leaf_count // 4096)
    sample = tree.device.download(tree.points)[tree.order[::WIDTH * step]]
    return (cKDTree(sample).query(points)[1] * step).astype(np.uint32)


def nearest(points, k, queries=None, device=None) -> tuple[NDArray, NDArray]:
    """Return the exact k nearest points of every query.

    Parameters
    ----------
    points : (n, 3) array_like
        Finite float32 positions.
    k : int
        1 to 128.
    queries : (q, 3) array_like, optional
        Positions to ask for, by default the points themselves, each of which then is its own nearest neighbour.
    device : optional
        See `clsurf.device.open_device`.

    Returns
    -------
    indices : (q, k) int32
        Nearest first; -1 where there are fewer than k points. Which of several points at exactly the k-th distance is
        given is not specified, but it is the same each time.
    distances : (q, k) float32
        In the points' unit; infinity where there are fewer than k points.

    Raises
    ------
    InputError
        No points, NaN among them, or k out of range.
    """
    tree = points if isinstance(points, BoxTree) else box_tree(points, device)
    _check_k(k)
    asked = _own_queries(tree) if queries is None else _other_queries(tree, queries)
    rows = tree.device.rows_at_once(4 * k, 4 * k)
    if asked.count <= rows:
        return _nearest(tree, asked, k)
    indices, distances = np.empty((asked.count, k), np.int32), np.empty((asked.count, k), np.float32)
    for order, part in _parts(tree.device, asked, rows):
        indices[order], distances[order] = _nearest(tree, part, k)
    return indices, distances


def _parts(device, asked: _Queries, rows: int) -> Iterator[tuple[NDArray, _Queries]]:
    """Yield where results go, and queries whose results stand one after the other: at most `rows`, whole blocks."""
    order, starts = device.download(asked.order), device.download(asked.starts)
    for first in range(0, asked.count, rows):
        own, part = order[first:first + rows], slice(first // WIDTH, (first + rows) // WIDTH)
        blocks = device.upload(device.download(asked.blocks, copy=False)[part])
        places = device.upload(np.arange(len(own), dtype=np.uint32))
        yield own, _Queries(blocks, places, device.upload(starts[part]), len(own))


def _nearest(tree: BoxTree, asked: _Queries, k: int) -> tuple[NDArray, NDArray]:
    device = tree.device
    indices, distances = device.empty((asked.count, k), np.int32), device.empty((asked.count, k), np.float32)
    device.kernel("build/knn_indices.cl", constants={"VW": device.lanes, "CHUNKS": -(-k // 16)})(
        (-(-asked.count // device.lanes),), _local(device), tree.nodes, tree.leaves, tree.order_on_device, asked.blocks,
        asked.order, asked.starts, indices, distances, len(tree), asked.count, k, tree.first_leaf, tree.leaf_count,
        tree.unit)
    return device.download(indices), device.download(distances)


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the k nearest points of every query.

    Attributes
    ----------
    eigenvalues : (q, 3) float32
        Ascending, squared units of the points.
    normals : (q, 3) float32
        Unit eigenvectors of the smallest eigenvalues; signs without meaning (the last non-zero component is positive).
    reach : (q,) float32
        Distance to the k-th point: density is k / (pi reach^2); far above the median it marks outliers.
    """

    eigenvalues: NDArray
    normals: NDArray
    reach: NDArray


def covariance(points, k=16, queries=None, device=None) -> Covariance:
    """Return eigenvalues, normals and reach of the k nearest points (each point counts itself) around every query.

    Points at exactly the k-th distance (up to 1e-5 of its square) are all taken, so that the result does not depend on
    the order of the points.

    Parameters
    ----------
    points : (n, 3) array_like or BoxTree
        Finite float32 positions.
    k : int
        1 to 128; all points where there are fewer.
    queries : (q, 3) array_like, optional
        Positions to ask for, by default the points themselves.
    device : optional

    Raises
    ------
    InputError
        No points, NaN among them, or k out of range.
    """
    tree = points if isinstance(points, BoxTree) else box_tree(points, device)
    asked = _own_queries(tree) if queries is None else _other_queries(tree, queries)
    return _covariance(tree, asked, k)


def _covariance(tree: BoxTree, asked: _Queries, k: int) -> Covariance:
    device, count = tree.device, asked.count
    _check_k(k)
    device.check_memory(normals=12 * count, eigenvalues=12 * count, reach=4 * count)
    normals, eigenvalues = device.empty((count, 3), np.float32), device.empty((count, 3), np.float32)
    reach = device.empty(count, np.float32)
    device.kernel("build/knn_covariance.cl", constants={"VW": device.lanes, "K": k})(
        (-(-count // device.lanes),), _local(device), tree.nodes, tree.leaves, asked.blocks, asked.order, asked.starts,
        normals, eigenvalues, reach, count, tree.first_leaf, tree.leaf_count, tree.unit)
    return Covariance(device.download(eigenvalues, copy=False), device.download(normals, copy=False),
                      device.download(reach, copy=False))


def _check_k(k) -> None:
    if not 1 <= k <= LARGEST_K:
        raise InputError(f"k: expected 1 to {LARGEST_K} neighbours, got {k}")


def sampled_covariance(points, k, samples, device=None) -> Covariance:
    """Return `covariance` at no fewer than `samples` of the points themselves, or at all where there are fewer.

    They are taken in whole leaves, spread evenly along the curve, which costs a fraction of scattered queries.
    """
    tree = points if isinstance(points, BoxTree) else box_tree(points, device)
    step = len(tree) // max(samples, WIDTH)
    if step < 2:
        return covariance(tree, k)
    whole = np.arange(0, len(tree) // WIDTH, step)
    count = WIDTH * len(whole)
    blocks = tree.device.upload(tree.device.download(tree.leaves, copy=False)[whole])
    asked = _Queries(blocks, tree.device.upload(np.arange(count, dtype=np.uint32)),
                     tree.device.upload(whole.astype(np.uint32)), count)
    return _covariance(tree, asked, k)


def noise_level(points, k=10, samples=20000, device=None) -> float:
    """Return the mean smallest eigenvalue of the covariance of k nearest points: lambda of the SLIM paper, section 2.

    Parameters
    ----------
    points : (n, 3) array_like or BoxTree
    samples : int
        At least this many points are looked at, where there are as many.
    """
    return float(sampled_covariance(points, k, samples, device).eigenvalues[:, 0].mean(dtype=np.float64))
