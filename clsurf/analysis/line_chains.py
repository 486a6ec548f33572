"""From points on pixel edges to polylines: segments within cells of four pixels, chains, hysteresis, order."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, depth_first_order

from .line_gaps import bridges
from .line_planes import Crossings


@dataclass(frozen=True, eq=False)
class Chains:
    """Polylines: points[offset[i]:offset[i + 1]] in order; a closed one's last point is joined to its first."""

    points: NDArray  # (n, 4) float32: x, y (pixels), depth, strength
    offset: NDArray  # (k + 1,) int64
    closed: NDArray  # (k,) bool


def cell_segments(crossings: Crossings, contours: bool) -> NDArray:
    """Return pairs (m, 2) of points that are joined within a cell, the square of four neighbouring pixels' centres.

    Of three points the two nearest to each other are joined; of `contours` the strongest (before the background, so
    that outlines close), then the nearest to the eye. Four are joined in the two pairs that are shorter together.
    """
    edges, points, columns = crossings.edges, crossings.points, crossings.columns
    if len(edges) == 0:
        return np.empty((0, 2), np.int64)
    number = np.empty(2 * columns * (crossings.height + 1) + 2, np.int32)  # undefined but for the edges
    number[edges] = np.arange(len(edges), dtype=np.int32)
    pixel, down = edges >> 1, edges & 1
    before = pixel - np.where(down, 1, columns)  # the other cell that the edge belongs to
    marks = np.zeros(columns * crossings.height, bool)
    marks[pixel] = marks[before[before >= 0]] = True
    cells = np.flatnonzero(marks)
    # Top, left, bottom, right.
    wanted = 2 * cells[:, None] + np.array([0, 1, 2 * columns, 3])
    found = number[wanted]
    known = (found >= 0) & (found < len(edges))
    known[known] = edges[found[known]] == wanted[known]
    found = np.where(known, found, -1)
    count = (found >= 0).sum(axis=1)
    two, three, four = found[count == 2], found[count == 3], found[count == 4]
    pairs = [two[two >= 0].reshape(-1, 2)]
    if len(three):
        three = three[three >= 0].reshape(-1, 3)
        choices = np.array([[0, 1], [1, 2], [0, 2]])
        chosen = three[:, choices]  # (t, 3, 2)
        far = 1 + np.abs(points[:, 2]).max()
        cost = (points[chosen, 2] - 4 * far * points[chosen, 3]).sum(axis=2) if contours else _lengths(points, chosen)
        pairs.append(chosen[np.arange(len(three)), np.argmin(cost, axis=1)])
    if len(four):
        a, b = four[:, [[0, 1], [2, 3]]], four[:, [[0, 3], [1, 2]]]
        shorter = _lengths(points, a).sum(axis=1) <= _lengths(points, b).sum(axis=1)
        pairs.append(np.where(shorter[:, None, None], a, b).reshape(-1, 2))
    return np.concatenate(pairs).astype(np.int64)


def _lengths(points, pairs):
    """Lengths (...) in pixels between the points that pairs (..., 2) name."""
    d = points[pairs[..., 0], :2] - points[pairs[..., 1], :2]
    return np.hypot(d[..., 0], d[..., 1])


def chains(points: NDArray, segments: NDArray, peak: float, length: float, gap: float = 0.0,
           steepest: float = np.inf, ring: float = 1.0) -> Chains:
    """Join segments into polylines; keep those whose strength is somewhere `peak`, and summed along the line `length`.

    So a line of strength 1 must be `length` pixels long, a weaker one longer: short weak lines are noise. Gaps of up to
    `gap` pixels between lines that go on in the same direction are closed before, unless the depth differs by more than
    `steepest` a pixel. Closed lines need `ring` times the length. No point may belong to more than two segments.
    """
    n = len(points)
    if len(segments) == 0:
        return Chains(np.empty((0, 4), np.float32), np.zeros(1, np.int64), np.empty(0, bool))
    graph = _symmetric(segments, n)
    closing = bridges(points, graph, gap, steepest)
    if len(closing):
        segments = np.concatenate([segments, closing])
        graph = _symmetric(segments, n)
    count, label = connected_components(graph, directed=True, connection="weak")
    share = _lengths(points, segments) * points[segments, 3].mean(axis=1)
    total = np.bincount(label[segments[:, 0]], share, count)
    strong, open_line = np.zeros(count, bool), np.zeros(count, bool)
    strong[label[points[:, 3] >= peak]] = True
    open_line[label[np.diff(graph.indptr) == 1]] = True
    keep = (total >= length * np.where(open_line, 1.0, ring)) & strong
    used = segments[keep[label[segments[:, 0]]]]
    if len(used) == 0:
        return Chains(np.empty((0, 4), np.float32), np.zeros(1, np.int64), np.empty(0, bool))
    degree = np.bincount(used.ravel(), minlength=n)
    own = np.flatnonzero(degree)
    # Every line starts at its first end, or a closed one at its first point: what is assigned last stays.
    ends, start = np.flatnonzero(degree == 1), np.full(count, -1)
    start[label[own[::-1]]] = own[::-1]
    start[label[ends[::-1]]] = ends[::-1]
    lines = np.flatnonzero(start >= 0)
    closed, starts = ~open_line[lines], start[lines]
    return Chains(*_ordered(points, used, starts), closed)


def _symmetric(segments, n: int):
    """Return the symmetric graph of `segments` between n points."""
    both = np.concatenate([segments, segments[:, ::-1]])
    return coo_array((np.ones(len(both), np.int8), (both[:, 0], both[:, 1])), shape=(n, n)).tocsr()


def _ordered(points, segments, starts):
    """Return the points line by line in order, and the lines' offsets; each line is walked from its start."""
    # A search in depth walks a line from end to end. Lines hang in a row on points of their own, so that one search
    # walks all of them.
    n, k = len(points), len(starts)
    hooks = n + np.arange(k)
    rows = np.concatenate([segments[:, 0], hooks, hooks[:-1]])
    columns = np.concatenate([segments[:, 1], starts, hooks[1:]])
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(n + k, n + k)).tocsr()
    walk = depth_first_order(graph, n, directed=False, return_predecessors=False)
    inside = walk < n
    # Each hook comes before or after its line's points; the points of one line are never separated.
    at = np.flatnonzero(inside)
    walk = walk[at]
    mark = np.zeros(n, bool)
    mark[starts] = True
    order_starts = np.flatnonzero(mark[walk])
    lines = np.split(walk, order_starts[1:])
    back = np.empty(n, np.int64)
    back[starts] = np.arange(k)
    turn = np.argsort(back[walk[order_starts]])
    lines = [lines[i] for i in turn]
    offset = np.concatenate([[0], np.cumsum([len(line) for line in lines])])
    return points[np.concatenate(lines)], offset


def relaxed(found: Chains, rounds: int) -> NDArray:
    """Return the points (n, 4), each the mean of itself (1/2) and its line's neighbours (1/4 each), `rounds` times.

    Ends stay in place; strengths are smoothed four times as often, so that widths change gently.
    """
    n = len(found.points)
    if n == 0:
        return found.points.copy()
    before, after = np.arange(n) - 1, np.arange(n) + 1
    first, last = found.offset[:-1], found.offset[1:] - 1
    before[first] = np.where(found.closed, last, first)
    after[last] = np.where(found.closed, first, last)
    points, columns = found.points, list(found.points.T.copy())
    held = np.concatenate([first[~found.closed], last[~found.closed]])
    ends = points[held, :3]
    for i in range(4 * rounds):
        # Each of the ends counts as its own neighbour.
        parts = range(4) if i < rounds else (3,)
        for k in parts:
            columns[k] = 0.5 * columns[k] + 0.25 * (columns[k][before] + columns[k][after])
    points = np.stack(columns, axis=1)
    points[held, :3] = ends
    return points
