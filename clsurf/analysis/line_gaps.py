"""Closing the gaps of broken lines: ends that lie close and point at each other are joined."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

INWARD = 6  # vertices from an end to the one that tells the line's direction
CLOSE = 2.0  # pixels; across shorter gaps the ends only need to agree with each other
AGREE, AIM = 0.5, 0.8  # cosines between the ends' directions, and between each of them and the gap


def bridges(points: NDArray, graph, reach: float, steepest: float) -> NDArray:
    """Return pairs (m, 2) of ends of different or the same lines to join by straight pieces.

    Parameters
    ----------
    points : (n, 4) float32
        x, y (pixels), depth, strength.
    graph : csr_array
        Symmetric; a point has at most two neighbours.
    reach : float
        Pixels.
    steepest : float
        Largest difference of depth per pixel of the gap: lines are not joined across jumps.
    """
    degree = np.diff(graph.indptr)
    ends = np.flatnonzero(degree == 1)
    none = np.empty((0, 2), np.int64)
    if len(ends) < 2 or not reach > 0:
        return none
    direction, other_end = _outward(points, graph, degree, ends)
    pairs = cKDTree(points[ends, :2]).query_pairs(reach, output_type="ndarray")
    if len(pairs) == 0:
        return none
    a, b = pairs.T
    gap = points[ends[b]] - points[ends[a]]
    far = np.hypot(gap[:, 0], gap[:, 1])
    along = gap[:, :2] / np.maximum(far, 1e-6)[:, None]
    aim = np.minimum((direction[a] * along).sum(axis=1), -(direction[b] * along).sum(axis=1))
    agree = -(direction[a] * direction[b]).sum(axis=1)
    good = (agree > AGREE) & ((far < CLOSE) | (aim > AIM)) & (np.abs(gap[:, 2]) <= steepest * np.maximum(far, 1))
    good &= other_end[a] != ends[b]  # a line of a few vertices is not bent into a ring
    pairs, cost = pairs[good], far[good] * (2 - agree[good])
    # Each end takes its best partner; a pair is joined where both have chosen each other.
    best = np.full(len(ends), np.inf)
    np.minimum.at(best, pairs.ravel(), np.repeat(cost, 2))
    chosen = pairs[(cost == best[pairs[:, 0]]) & (cost == best[pairs[:, 1]])]
    free = np.zeros(len(ends), bool)  # equal costs: the first pair
    keep = np.empty(len(chosen), bool)
    for i, (p, q) in enumerate(chosen):
        keep[i] = not (free[p] or free[q])
        free[[p, q]] |= keep[i]
    return ends[chosen[keep]]


def _outward(points, graph, degree, ends):
    """Return the ends' unit directions (k, 2) out of their lines, and the vertices reached inside."""
    first = graph.indices[graph.indptr[:-1].clip(max=len(graph.indices) - 1)]
    second = graph.indices[(graph.indptr[1:] - 1).clip(0)]
    before, here = ends, first[ends]
    for _ in range(INWARD - 1):
        following = np.where(first[here] == before, second[here], first[here])
        stop = degree[here] < 2
        before, here = np.where(stop, before, here), np.where(stop, here, following)
    direction = points[ends, :2] - points[here, :2]
    return direction / np.maximum(np.hypot(direction[:, 0], direction[:, 1]), 1e-6)[:, None], here
