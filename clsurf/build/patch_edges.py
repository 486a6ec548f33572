"""Sharp edges and open borders of meshes, found, and cut into straight strips.

A patch ends in steps of whole cells, so that two patches that meet in an edge leave holes between them, or stand out
over it. Small patches along the edge cure that (paper on spatial patches, section 4.4); patch_strips.py makes them.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from ..surface.arrays import lengths_of
from .segments import FaceGraph

LEAST_ANGLE = 30.0  # degrees between face normals: a cell across less bulges by under 0.1 of its side
ABOVE_SMOOTH = 3.0  # times the angle between faces around: a coarse sphere has no edges, noise few
SURE_ANGLE = 65.0  # degrees: an edge in any surroundings (a box of 12 triangles has no smooth ones)
SHARP_TURN = 40.0  # degrees: a corner within a line of edges
BEND = 0.2  # node spacings that the edge may bow out of a strip's straight row
ALONG = 2.0  # node spacings between the columns of a strip, at most: nothing bends along a straight edge
TWIST = 20.0  # degrees that half-angle normals of one strip differ
# Node spacings: mean length (weighted by itself) of the lines, from junction or corner to the next, that hang together.
# Fandisk 105; noisy meshes and the ragged parts of scans 4-12: edges there would ask for many short strips.
LEAST_LINE = 15.0
LEAST_STRIP = 2.0  # node spacings: lines that break into shorter strips are ragged
STEEPEST = 0.08  # cosine between a strip's z and a face of it


@dataclass(frozen=True)
class SharpEdges:
    """Edges of a mesh: creases between two faces, and open borders.

    Attributes
    ----------
    ends : (e, 2) int64
        Vertices, in the order in which the first face has them.
    faces : (e, 2) int64
        The second is -1 at an open border.
    pair : (e,) int64
        Which of the graph's pairs of faces; -1 at an open border.
    """

    ends: NDArray
    faces: NDArray
    pair: NDArray

    def __len__(self):
        return len(self.ends)


@dataclass(frozen=True)
class Strips:
    """Straight pieces of sharp edges; each becomes one patch.

    Attributes
    ----------
    start, end : (s, 3) float64
    normal : (s, 3) float64
        Half the angle between the faces; unit, perpendicular to the piece.
    slope : (s, 2) float64
        Cosine of the angle between `normal` and the faces on the left and on the right (0: none, a border).
    bow : (s, 2) float64
        Least and largest offset of the edge from the piece to its left, world units.
    edges : SharpEdges
        Of all strips, one after the other.
    offset : (s + 1,) int64
        Where those of a strip start; an edge that is cut belongs to several.
    """

    start: NDArray
    end: NDArray
    normal: NDArray
    slope: NDArray
    bow: NDArray
    edges: SharpEdges
    offset: NDArray

    def __len__(self):
        return len(self.start)


NO_STRIPS = Strips(*(np.zeros((0, width)) for width in (3, 3, 3, 2, 2)),
                   SharpEdges(*(np.zeros(shape, np.int64) for shape in ((0, 2), (0, 2), 0))), np.zeros(1, np.int64))


def shared_corners(corners: NDArray, pairs: NDArray) -> NDArray:
    """Return for pairs (e, 2) of faces the corners (e, 2, 2) that they share: [edge, face, end], 0 to 2.

    The two are in the order of the first face.
    """
    a, b = corners[pairs[:, 0]], corners[pairs[:, 1]]
    same = a[:, :, None] == b[:, None, :]
    other = np.where(same.any(axis=2), 0, 1).argmax(axis=1)  # the corner that the second face lacks
    first = np.stack([(other + 1) % 3, (other + 2) % 3], axis=1)
    return np.stack([first, same[np.arange(len(pairs))[:, None], first].argmax(axis=2)], axis=1)


def sharp_edges(graph: FaceGraph) -> SharpEdges:
    """Return the creases and the open borders of a mesh.

    Left out are edges of three or more faces, and between faces of opposite orientation.
    """
    chosen = np.flatnonzero(graph.cosine < np.cos(np.radians(LEAST_ANGLE)))
    if len(chosen):
        limit = np.clip(ABOVE_SMOOTH * _angle_around(graph, chosen), LEAST_ANGLE, SURE_ANGLE)
        chosen = chosen[graph.cosine[chosen] < np.cos(np.radians(limit))]
    faces = graph.pairs[chosen]
    at = shared_corners(graph.corners, faces)
    ends, back = (np.take_along_axis(graph.corners[faces[:, k]], at[:, k], axis=1) for k in range(2))
    follows = (at[:, 1, 0] - at[:, 1, 1]) % 3 == 1  # the second face has the edge the other way round
    key = np.sort(ends, axis=1) @ np.array([len(graph.vertices), 1], np.int64)
    _, which, count = np.unique(key, return_inverse=True, return_counts=True)
    good = (ends == back).all(axis=1) & follows & (count[which] == 1)
    open_ends, open_faces = _open_borders(graph)
    return SharpEdges(np.concatenate([ends[good], open_ends]),
                      np.concatenate([faces[good], np.stack([open_faces, np.full_like(open_faces, -1)], axis=1)]),
                      np.concatenate([chosen[good], np.full_like(open_faces, -1)]))


def _open_borders(graph) -> tuple[NDArray, NDArray]:
    """Return the vertices (b, 2) of edges with one face, in its order, and that face (b,)."""
    sides = np.bincount(graph.pairs.ravel(), minlength=len(graph))
    some = (sides < 3) & (graph.area > 0)
    face = np.flatnonzero(some)
    near = some[graph.pairs].any(axis=1)
    pairs = graph.pairs[near]
    at = shared_corners(graph.corners, pairs)
    taken = [3 * pairs[:, k] + _edge_of(at[:, k]) for k in range(2)]
    every = (3 * face[:, None] + np.arange(3)).ravel()
    free = every[~np.isin(every, np.concatenate(taken))]
    face, edge = np.divmod(free, 3)
    c = graph.corners[face]
    rows = np.arange(len(face))
    return np.stack([c[rows, edge], c[rows, (edge + 1) % 3]], axis=1), face


def _edge_of(two) -> NDArray:
    """Return the edge (e,) of a face, from corner k to k + 1, that two different corners (e, 2) are the ends of."""
    return np.where((two[:, 0] + 1) % 3 == two[:, 1], two[:, 0], two[:, 1])


def _angle_around(graph, chosen) -> NDArray:
    """Return the angle (k,) between faces around each of the `chosen` pairs, degrees.

    The mean, over the faces around the pair's own corners, of the middle one of each face's three angles.
    """
    vertex = np.zeros(len(graph.vertices), bool)
    vertex[graph.corners[graph.pairs[chosen]]] = True
    face = np.flatnonzero(vertex[graph.corners].any(axis=1))
    number = np.full(len(graph), -1)
    number[face] = np.arange(len(face))
    near = np.flatnonzero((number[graph.pairs] >= 0).any(axis=1))
    angle = np.degrees(np.arccos(graph.cosine[near]))
    at, angle = number[graph.pairs[near]].ravel(), np.repeat(angle, 2)
    at, angle = at[at >= 0], angle[at >= 0]
    total, sides = np.bincount(at, angle, len(face)), np.bincount(at, minlength=len(face))
    most, least = np.zeros(len(face)), np.where(sides < 3, 0.0, np.inf)
    np.maximum.at(most, at, angle)
    np.minimum.at(least, at, angle)
    middle = np.maximum(total - most - least, 0)
    c = graph.corners[face]
    times = np.bincount(c.ravel(), minlength=len(vertex))
    mean = np.bincount(c.ravel(), np.repeat(middle, 3), len(vertex)) / np.maximum(times, 1)
    return mean[graph.corners[graph.pairs[chosen]]].mean(axis=(1, 2))


def strips_of(graph: FaceGraph, spacing: float, columns: int, along: float = ALONG) -> Strips:
    """Cut the lines of a mesh's sharp edges into straight strips.

    Parameters
    ----------
    graph : FaceGraph
    spacing : float
        Between the nodes of the patches beside the edges, world units.
    columns : int
        Nodes of a strip along its edge.
    along : float
        Largest distance between them, in spacings; 1 where colours matter.

    Notes
    -----
    Noise and ragged borders make none: see `LEAST_LINE` and `LEAST_STRIP`.
    """
    edges, vertices = sharp_edges(graph), graph.vertices
    left = graph.normal[edges.faces[:, 0]]
    right = np.where(edges.faces[:, 1:] >= 0, graph.normal[edges.faces[:, 1]], 0)
    length = lengths_of(vertices[edges.ends[:, 0]] - vertices[edges.ends[:, 1]])
    longest = along * spacing * max(inner_columns(columns) - 1, 1)
    found = []
    for line in _long_lines(vertices, edges, length, LEAST_LINE * spacing):
        found += _cut_line(vertices, edges, line, left, right, length, spacing, longest)
    if not found:
        return NO_STRIPS
    *arrays, chosen = zip(*found, strict=True)
    offset = np.concatenate([[0], np.cumsum([len(e) for e in chosen])]).astype(np.int64)
    chosen = np.concatenate(chosen)
    return Strips(*(np.array(part, np.float64) for part in arrays),
                  SharpEdges(edges.ends[chosen], edges.faces[chosen], edges.pair[chosen]), offset)


def inner_columns(columns) -> int:
    """Return how many of a strip's columns lie on its piece; a margin column at both ends where there are enough."""
    return columns - 2 if columns >= 6 else columns


def _long_lines(vertices, edges, length, least) -> list[list[tuple[int, bool]]]:
    """Return the lines of edges whose groups have lines of at least the mean length `least`."""
    if not len(edges):
        return []
    count = int(edges.ends.max()) + 1
    links = sparse.csr_matrix((np.ones(len(edges), bool), tuple(edges.ends.T)), (count, count))
    group = csgraph.connected_components(links, directed=False)[1][edges.ends[:, 0]]
    lines = _lines(vertices, edges, np.bincount(group, length)[group] >= least)
    reach = np.array([length[[e for e, _ in line]].sum() for line in lines])
    of = np.array([group[line[0][0]] for line in lines], np.int64)
    enough = np.bincount(of, reach**2) >= least * np.bincount(of, reach)
    return [line for line, g in zip(lines, of, strict=True) if enough[g]]


def _lines(vertices, edges, use) -> list[list[tuple[int, bool]]]:
    """Return lines of edges without junction or corner; each is a list of (edge, forward)."""
    chosen = np.flatnonzero(use)
    at = {}
    for e in chosen.tolist():
        for end in (0, 1):
            at.setdefault(int(edges.ends[e, end]), []).append((e, end))
    border = edges.faces[:, 1] < 0
    direction = vertices[edges.ends[:, 1]] - vertices[edges.ends[:, 0]]
    direction /= np.maximum(lengths_of(direction), 1e-300)[:, None]
    turn = np.cos(np.radians(SHARP_TURN))
    onward = {}  # (edge, end) to the edge's continuation there
    for meeting in at.values():
        if len(meeting) != 2:
            continue
        (e, p), (f, q) = meeting
        if border[e] == border[f] and (direction[e] @ direction[f]) * (1 if p != q else -1) >= turn:
            onward[e, p], onward[f, q] = (f, q), (e, p)
    lines, done = [], set()
    for e in sorted(chosen.tolist(), key=lambda e: (e, 0) in onward and (e, 1) in onward):  # ends of lines first
        if e in done:
            continue
        forward = (e, 0) not in onward or (e, 1) in onward
        line, step = [], (e, forward)
        while step is not None and step[0] not in done:
            line.append(step)
            done.add(step[0])
            next_one = onward.get((step[0], 1 if step[1] else 0))
            step = None if next_one is None else (next_one[0], next_one[1] == 0)
        lines.append(line)
    return lines


def _cut_line(vertices, edges, line, left, right, length, spacing, longest) -> list[tuple]:
    """Return the strips of one line: (start, end, normal, slope, bow, edges) each."""
    ids = np.array([e for e, _ in line])
    if edges.faces[ids[0], 1] < 0 and not line[0][1]:  # along borders the face lies to the left
        line = [(e, not forward) for e, forward in line[::-1]]
        ids = ids[::-1]
    forward = np.array([f for _, f in line])
    tail = np.where(forward, edges.ends[ids, 0], edges.ends[ids, 1])
    head = np.where(forward, edges.ends[ids, 1], edges.ends[ids, 0])
    sides = np.where(forward[:, None], left[ids], right[ids]), np.where(forward[:, None], right[ids], left[ids])
    parts = np.maximum(np.ceil(length[ids] / (0.5 * longest)), 1).astype(int)  # long edges are several strips
    which = np.repeat(np.arange(len(ids)), parts)
    share = (np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[which]
    points = vertices[tail[which]] * (1 - share[:, None]) + vertices[head[which]] * share[:, None]
    points = np.concatenate([points, vertices[head[-1:]]])
    weights = (length[ids] / parts)[which]
    a, b = (weights[:, None] * side[which] for side in sides)
    cut = lambda limit: _cuts(points, a, b, BEND * spacing, limit)  # noqa: E731
    ends, total = cut(longest), weights.sum()
    even = cut(min(longest, 1.02 * total / (len(ends) - 1)))
    ends = even if len(even) <= len(ends) else ends
    pieces = len(ends) - 1
    if pieces > 1 and total < LEAST_STRIP * spacing * pieces:
        return []
    return [(*_strip(points, a, b, i, j), np.unique(ids[which[i:j]])) for i, j in pairwise(ends)]


def _cuts(points, a, b, bend, longest) -> list[int]:
    """Return where to cut a line of `points` so that each piece fits one strip, as few as possible in order."""
    ends, last = [0], len(points) - 1
    while ends[-1] < last:
        low, step = ends[-1] + 1, 1
        while low + step <= last and _fits(points, a, b, ends[-1], low + step, bend, longest):
            low, step = low + step, 2 * step
        while step > 1:
            step //= 2
            if low + step <= last and _fits(points, a, b, ends[-1], low + step, bend, longest):
                low += step
        ends.append(low)
    return ends


def _fits(points, a, b, i, j, bend, longest) -> bool:
    start, end, normal, slope, bow = _strip(points, a, b, i, j)
    along = end - start
    length = np.linalg.norm(along)
    if length > longest * 1.001 or length == 0:
        return False
    offset = points[i:j + 1] - start
    offset = offset - (offset @ along / length**2)[:, None] * along
    if (np.einsum("ij,ij->i", offset, offset) > bend**2).any():
        return False
    half = a[i:j] + b[i:j]
    size = lengths_of(half)
    cosine = np.cos(np.radians(TWIST))
    return bool((half @ normal >= cosine * size).all() and (slope[0] > STEEPEST) and np.isfinite(bow).all())


def _strip(points, a, b, i, j):
    """Return (start, end, normal, slope, bow) of the piece from point i to j."""
    start, end = points[i], points[j]
    along = end - start
    along = along / max(np.linalg.norm(along), 1e-300)
    total = [side[i:j].sum(axis=0) for side in (a, b)]
    unit = [t / max(np.linalg.norm(t), 1e-300) for t in total]
    normal = unit[0] + unit[1]
    normal = normal - (normal @ along) * along
    normal = normal / max(np.linalg.norm(normal), 1e-300)
    left = (points[i:j + 1] - start) @ _cross(normal, along)
    return start, end, normal, np.array([u @ normal for u in unit]), np.array([left.min(), left.max()])


def _cross(a, b) -> NDArray:
    """Return the cross product of two vectors; np.cross takes ten times as long."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
