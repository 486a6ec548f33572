"""Partition of a triangle mesh into areas that are each to become one spatial patch.

Source: the paper on spatial patches, section 4.1: preliminary areas, secondary areas grown simultaneously from the
central faces of these, and merging. Preliminary areas come of merging as well, from single faces.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from ..surface.arrays import lengths_of

# Directions that widths of areas are measured along: the axes, then the diagonals of the faces and of the cube itself.
# Every direction is within 28 degrees of one.
DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1], [0, 1, 1],
                       [0, 1, -1], [1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]], np.float64)
DIRECTIONS /= lengths_of(DIRECTIONS, keepdims=True)
AXES = 3  # directions that are enough while areas are small

CONE = 60.0  # degrees: half the cone of a cap whose normals spread as an area's do
FORCED_CONES = (75.0, 89.0, 180.0)  # tried in turn where a number of areas is asked for that CONE does not reach
DIAGONAL = 1.45  # how much wider than the sides a rectangle may be
CREASE = 60.0  # degrees: mean angle over a common border that no area crosses
CREASE_COST = 20.0  # times as far across a crease while areas grow
TURN_COST = 4.0  # growing across an edge: its length times 1 + TURN_COST (1 - cosine) / 2
LEAST_BEND = 1e-3  # of the mesh's mean, given to every area by its size: planes are cut into compact areas
FLAT = 1e-6  # squared angle below which a mesh counts as flat: a disc's areas would be merged in no order otherwise
# Times as many preliminary areas as in the end: the bunny's vertices are at most 0.057 % off its patches, 0.077 % where
# areas are merged first and grown last, RMS the same within 5 %.
PRELIMINARY = 2.0
# Costs go with this power of 1 / cosine of the cone: steep faces have wide cells, and what lies beyond them
# turns away. 8 in place of 3: a third fewer pixels outside the silhouettes of two coarse scans, a bunny as good.
STEEP_COST = 8
STEEP = 0.5  # cosine between a face and its area's normal below which a neighbour may suit it better


@dataclass(frozen=True)
class FaceGraph:
    """The faces of a mesh and which of them share an edge.

    Where more than two faces share one, each hangs together with the next.
    """

    vertices: NDArray  # (v, 3) float64
    corners: NDArray  # (f, 3) int64, vertices at one place under one number
    normal: NDArray  # (f, 3) float64, unit; zero where a face has no area
    area: NDArray  # (f,) float64
    pairs: NDArray  # (e, 2) int64 faces
    length: NDArray  # (e,) float64, of the edge
    cosine: NDArray  # (e,) float64, between the normals

    def __len__(self):
        return len(self.area)

    @cached_property
    def middle(self) -> NDArray:
        """(f, 3) float64: the centroids."""
        v, c = self.vertices, self.corners
        return (v[c[:, 0]] + v[c[:, 1]] + v[c[:, 2]]) / 3

    @cached_property
    def bend(self) -> NDArray:
        """(e,) float64: squared angle times length, for small angles."""
        return 2 * (1 - self.cosine) * self.length

    @cached_property
    def components(self) -> tuple[int, NDArray]:
        """The number of connected parts, and the part of every face."""
        a, b = self.pairs.T
        net = sparse.csr_matrix((np.ones(len(a), bool), (a, b)), (len(self), len(self)))
        return csgraph.connected_components(net, directed=False)

    def normals_of(self, owner: NDArray, count: int) -> NDArray:
        """Return the unit mean normals (count, 3) of areas; +z where normals cancel."""
        total = sums(owner, self.area[:, None] * self.normal, count)
        length = lengths_of(total, keepdims=True)
        return np.where(length > 0, total / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])


def face_graph(vertices: NDArray, corners: NDArray) -> FaceGraph:
    """Return the graph of faces (f, 3) of welded `vertices` (v, 3) float64."""
    v = [vertices[corners[:, k]] for k in range(3)]
    cross = np.cross(v[1] - v[0], v[2] - v[0])
    doubled = np.sqrt(np.einsum("ij,ij->i", cross, cross))
    normal = cross / np.where(doubled > 0, doubled, 1)[:, None]
    a, b = corners.ravel(), corners[:, [1, 2, 0]].ravel()
    key = np.minimum(a, b) * np.int64(len(vertices)) + np.maximum(a, b)
    order = ordered(key)
    key = key[order]
    same = np.flatnonzero(key[1:] == key[:-1])
    edge, pairs = order[same], np.stack([order[same], order[same + 1]], axis=1) // 3
    edge, pairs = edge[pairs[:, 0] != pairs[:, 1]], pairs[pairs[:, 0] != pairs[:, 1]]
    apart = vertices[a[edge]] - vertices[b[edge]]
    cosine = np.clip(np.einsum("ij,ij->i", normal[pairs[:, 0]], normal[pairs[:, 1]]), -1, 1)
    cosine[(doubled[pairs] == 0).any(axis=1)] = 1.0
    return FaceGraph(vertices, corners, normal, doubled / 2, pairs, np.sqrt(np.einsum("ij,ij->i", apart, apart)),
                     cosine)


def ordered(key: NDArray) -> NDArray:
    """Return the stable order of (n,) int64 keys of 0 or more; half the time of np.argsort where the bits suffice."""
    bits = max(len(key) - 1, 1).bit_length()
    if not len(key) or int(key.max()).bit_length() + bits > 63:
        return np.argsort(key, kind="stable")
    return np.sort(key << bits | np.arange(len(key))) & ((1 << bits) - 1)


def sums(owner: NDArray, values: NDArray, count: int) -> NDArray:
    """Return the sums (count, k) of rows of `values` (n, k) by their owner."""
    return np.stack([np.bincount(owner, values[:, k], count) for k in range(values.shape[1])], axis=1)


class Merging:
    """Areas that are merged two by two, the cheapest first.

    The cost of an area is what its patch will be wrong by: a cell of side s across an edge that bends by an angle
    misses it by about s times the angle, over a strip as wide as s; so s^3 times the sum over its edges of squared
    angle times length. s goes with the area's width.

    Parameters
    ----------
    graph : FaceGraph
    owner : (f,) int64
        Areas to begin with, 0 to count - 1, each with a face.
    directions : int
        How many of `DIRECTIONS` widths are measured along.
    widest : float
        Areas may not become wider, world units.
    fits : callable, optional
        Asked before areas that would become wider than `widest`, up to `DIAGONAL` times, are merged: called with the
        owner (f,) of every face among the k pairs of areas in question, -1 for the others, and k; returns (k,) bool.
    """

    def __init__(self, graph: FaceGraph, owner: NDArray, count: int, directions: int = len(DIRECTIONS),
                 widest: float = np.inf, fits=None):
        self.owner, self.count, self.widest, self.fits = owner, count, widest, fits
        self.area = np.bincount(owner, graph.area, count)
        self.normal = sums(owner, graph.area[:, None] * graph.normal, count)
        a, b = owner[graph.pairs].T
        inner = a == b
        self.bend = np.bincount(a[inner], graph.bend[inner], count).astype(np.float64)  # of no pair: int64
        bend = max(graph.bend.sum(), FLAT * graph.length.sum())
        self.least_bend = LEAST_BEND * bend / max(graph.area.sum(), 1e-300)
        along = (DIRECTIONS[:directions] @ graph.vertices.T).astype(np.float32)
        along = np.concatenate([along, -along])
        order = ordered(owner)
        starts = np.searchsorted(owner[order], np.arange(count))
        corner = [graph.corners[order, k] for k in range(3)]
        # Rows: the largest value along each direction, then the largest along its opposite.
        self.reach = np.stack([np.maximum.reduceat(np.maximum(np.maximum(row[corner[0]], row[corner[1]]),
                                                              row[corner[2]]), starts) for row in along])
        self._set_pairs(a, b, graph.bend, graph.length, np.zeros(len(a), bool))

    def _set_pairs(self, a, b, bend, length, banned):
        """Keep every pair of neighbouring areas once, with the bend and length of the border between them."""
        apart = a != b
        a, b, bend, length = np.minimum(a, b)[apart], np.maximum(a, b)[apart], bend[apart], length[apart]
        banned = banned[apart]
        key = a * np.int64(self.count) + b
        order = ordered(key)
        key = key[order]
        first = np.flatnonzero(np.append(True, key[1:] != key[:-1])) if len(key) else np.zeros(0, np.int64)
        self.a, self.b = a[order[first]], b[order[first]]
        self.border_bend = np.add.reduceat(bend[order], first) if len(first) else bend
        self.border_length = np.add.reduceat(length[order], first) if len(first) else length
        self.banned = np.logical_or.reduceat(banned[order], first) if len(first) else banned  # they only grow

    def _costs(self, least_cosine: float) -> tuple[NDArray, NDArray]:
        """Return what merging each pair adds to the cost, inf where it is not allowed, and the width of both."""
        a, b, half = self.a, self.b, len(self.reach) // 2
        own, width = np.zeros(self.count, np.float32), np.zeros(len(a), np.float32)
        for high, low in zip(self.reach[:half], self.reach[half:], strict=True):
            np.maximum(own, high + low, out=own)
            np.maximum(width, np.maximum(high[a], high[b]) + np.maximum(low[a], low[b]), out=width)
        own, width = own.astype(np.float64), width.astype(np.float64)
        area, total = self.area[a] + self.area[b], self.normal[a] + self.normal[b]
        # A cap of half-angle c has a mean normal as long as (1 + cos c) / 2.
        length = np.sqrt(np.einsum("ij,ij->i", total, total))
        cosine = np.where(area > 0, 2 * length / np.where(area > 0, area, 1) - 1, 1)
        energy = own ** 3 * (self.bend + self.least_bend * self.area)
        cost = (width ** 3 * (self.bend[a] + self.bend[b] + self.border_bend + self.least_bend * area)
                - energy[a] - energy[b]) * np.maximum(cosine, 0.05) ** -STEEP_COST
        crease = self.border_bend > 2 * (1 - np.cos(np.radians(CREASE))) * self.border_length
        widest = self.widest * (1 if self.fits is None else DIAGONAL)
        banned = self.banned | (cosine < least_cosine) | (width > widest) | (crease & (least_cosine > -1))
        return np.where(banned, np.inf, cost), width

    def merge(self, target: int, cone: float = CONE, step=None) -> None:
        """Merge until `target` areas are left, or no two may be merged.

        Each round merges pairs that are each other's cheapest; near the end only the cheapest of them, so that the
        order is nearly that of one pair at a time.
        """
        least_cosine = np.cos(np.radians(cone)) if cone < 180 else -2.0
        while self.count > target:
            if step is not None:
                step()
            cost, width = self._costs(least_cosine)
            best = np.full(self.count, np.inf)
            np.minimum.at(best, self.a, cost)
            np.minimum.at(best, self.b, cost)
            mutual = np.flatnonzero((cost == best[self.a]) & (cost == best[self.b]) & np.isfinite(cost))
            rank = np.arange(len(cost))  # of equal costs the first pair
            # Of faces without area any: in order, a row of them would lose one a round (a sliver took 50 s).
            free = mutual[cost[mutual] == 0]
            rank[free] = np.random.default_rng(0).permutation(free)
            first = np.full(self.count, len(cost))
            np.minimum.at(first, self.a[mutual], rank[mutual])
            np.minimum.at(first, self.b[mutual], rank[mutual])
            mutual = mutual[(first[self.a[mutual]] == rank[mutual]) & (first[self.b[mutual]] == rank[mutual])]
            if not len(mutual):
                return
            spare = self.count - target
            most = max(1, spare // 2) if self.count < 4 * target else spare
            if len(mutual) > most:
                mutual = mutual[np.argsort(cost[mutual], kind="stable")[:most]]
            self._apply(self._fitting(mutual, width[mutual]))

    def _fitting(self, chosen, width) -> NDArray:
        """Return which of the chosen pairs fit; the others are banned."""
        doubtful = chosen[width > self.widest]
        if self.fits is None or not len(doubtful):
            return chosen
        number = np.full(self.count, -1)
        number[self.a[doubtful]] = number[self.b[doubtful]] = np.arange(len(doubtful))
        self.banned[doubtful] = ~self.fits(number[self.owner], len(doubtful))
        return chosen[~self.banned[chosen]]

    def _apply(self, chosen):
        keep, gone = self.a[chosen], self.b[chosen]
        self.bend[keep] += self.bend[gone] + self.border_bend[chosen]
        self.area[keep] += self.area[gone]
        self.normal[keep] += self.normal[gone]
        stays = np.ones(self.count, bool)
        stays[gone] = False
        number = np.cumsum(stays) - 1
        number[gone] = number[keep]
        self.reach[:, keep] = np.maximum(self.reach[:, keep], self.reach[:, gone])
        self.area, self.bend, self.normal = self.area[stays], self.bend[stays], self.normal[stays]
        self.reach = np.ascontiguousarray(self.reach[:, stays])
        self.owner, self.count = number[self.owner], int(np.count_nonzero(stays))
        self._set_pairs(number[self.a], number[self.b], self.border_bend, self.border_length, self.banned)


def partition(graph: FaceGraph, target: int, widest: float = np.inf, exact: bool = False, step=None, fits=None):
    """Divide a mesh into areas.

    Parameters
    ----------
    graph : FaceGraph
    target : int
        Number of areas; more where cones, creases, `widest` or separate parts of the mesh ask for them.
    widest : float
        Largest width of an area along any of `DIRECTIONS`, world units.
    exact : bool
        Exactly `target` areas, over any cone and crease if need be; it must be from the number of separate parts to the
        number of faces.
    step : callable, optional
        Called now and then.
    fits : callable, optional
        Allows areas that are wider, see `Merging`.

    Returns
    -------
    owner : (f,) int64
        Area of every face.
    count : int
    """
    owner, count = np.arange(len(graph)), len(graph)
    early, middle = 8 * target, int(PRELIMINARY * target)
    if count > early:
        merging = Merging(graph, owner, count, AXES, widest / 2)
        merging.merge(early, step=step)
        owner, count = merging.owner, merging.count
    if count > middle:
        merging = Merging(graph, owner, count, widest=0.7 * widest)
        merging.merge(middle, step=step)
        owner = grown(graph, central_faces(graph, merging.owner, merging.count))
        count = merging.count
    merging = Merging(graph, owner, count, widest=widest, fits=fits)
    merging.merge(target, step=step)
    for cone in FORCED_CONES if exact else ():
        merging.merge(target, cone, step)
    owner, count = merging.owner, merging.count
    for _ in range(3):
        owner = turned(graph, owner, count)
    return owner, count


def central_faces(graph: FaceGraph, owner: NDArray, count: int) -> NDArray:
    """Return the face (count,) of every area that lies nearest to its centroid."""
    weight = graph.area + max(graph.area.mean(), 1e-300) * 1e-9
    middle = sums(owner, weight[:, None] * graph.middle, count) / np.bincount(owner, weight, count)[:, None]
    gap = graph.middle - middle[owner]
    order = np.lexsort((np.einsum("ij,ij->i", gap, gap), owner))
    return order[np.searchsorted(owner[order], np.arange(count))]


def grown(graph: FaceGraph, seeds: NDArray) -> NDArray:
    """Return the areas (f,) grown simultaneously from the faces `seeds`; every part of the mesh must have one."""
    a, b = graph.pairs.T
    gap = graph.middle[a] - graph.middle[b]
    apart = np.sqrt(np.einsum("ij,ij->i", gap, gap))
    turn = (1 - graph.cosine) / 2
    weight = np.maximum(apart, 1e-9 * max(apart.mean(), 1e-300) if len(apart) else 0) * (1 + TURN_COST * turn)
    weight[graph.cosine < np.cos(np.radians(CREASE))] *= CREASE_COST
    net = sparse.coo_matrix((weight, (np.minimum(a, b), np.maximum(a, b))), (len(graph), len(graph))).tocsr()
    _, _, source = csgraph.dijkstra(net, directed=False, indices=seeds, min_only=True, return_predecessors=True)
    number = np.zeros(len(graph), np.int64)
    number[seeds] = np.arange(len(seeds))
    return number[source]


def turned(graph: FaceGraph, owner: NDArray, count: int) -> NDArray:
    """Return the areas with faces that stand steeply on theirs given to the neighbour they suit better."""
    normal = graph.normals_of(owner, count)
    own = np.einsum("ij,ij->i", graph.normal, normal[owner])
    a, b = np.concatenate([graph.pairs, graph.pairs[:, ::-1]]).T
    chosen = (own[a] < STEEP) & (owner[a] != owner[b]) & (graph.area[a] > 0)
    face, to = a[chosen], owner[b[chosen]]
    cosine = np.einsum("ij,ij->i", graph.normal[face], normal[to])
    better = cosine > own[face] + 0.1
    face, to, cosine = face[better], to[better], cosine[better]
    order = np.lexsort((to, cosine))  # the best one is written last
    out = owner.copy()
    out[face[order]] = to[order]
    emptied = np.bincount(out, minlength=count) == 0
    return np.where(emptied[owner], owner, out)


def split_faces(corners: NDArray, vertices: NDArray, longest: float) -> tuple[NDArray, list[NDArray], NDArray]:
    """Cut faces in such a way that no edge is longer than `longest`.

    Edges that are the longest of all their faces are halved until none is too long: no face is then cut elsewhere,
    needles are cut across, and no new ones arise.

    Returns
    -------
    faces : (f', 3) int64
        The first v numbers are the old vertices.
    ends : list of (k, 2) int64
        New vertices, each halfway between two older ones, numbered on; those of one array do not refer to each other.
    source : (f',) int64
        Face that a part was cut from.
    """
    faces, source = corners.astype(np.int64), np.arange(len(corners))
    place, ends = vertices, []
    done = []
    while len(faces):
        length = lengths_of(place[faces] - place[faces[:, [1, 2, 0]]])
        whole = length.max(axis=1) <= longest
        done.append((faces[whole], source[whole]))
        faces, source, length = faces[~whole], source[~whole], length[~whole]
        if not len(faces):
            break
        key = _edge_keys(faces, len(place))
        chosen = np.unique(key[_longest(key, length)])
        pair = np.stack(np.divmod(chosen, len(place)), axis=1)
        ends.append(pair)
        at = np.minimum(np.searchsorted(chosen, key), len(chosen) - 1)
        cut = np.where(chosen[at] == key, len(place) + at, -1)
        place = np.concatenate([place, (place[pair[:, 0]] + place[pair[:, 1]]) / 2])
        faces, source = _cut(faces, source, cut)
    faces = np.concatenate([f for f, _ in done]) if done else np.zeros((0, 3), np.int64)
    source = np.concatenate([s for _, s in done]) if done else np.zeros(0, np.int64)
    order = np.argsort(source, kind="stable")
    return faces[order], ends, source[order]


def _edge_keys(faces, count) -> NDArray:
    """Return a number (f, 3) of every edge of faces, k to k + 1, the same from both sides."""
    a, b = faces, faces[:, [1, 2, 0]]
    return np.minimum(a, b) * np.int64(count) + np.maximum(a, b)


def _longest(key, length) -> NDArray:
    """Return which edges (f, 3) are the longest of all their faces, of equally long ones that of the largest key."""
    edge, which = np.unique(key, return_inverse=True)
    rank = np.empty(len(edge), np.int64)
    size = np.zeros(len(edge))
    size[which.ravel()] = length.ravel()
    rank[np.lexsort((edge, size))] = np.arange(len(edge))
    rank = rank[which.reshape(key.shape)]
    first = rank == rank.max(axis=1, keepdims=True)
    beaten = np.zeros(len(edge), bool)
    beaten[which.reshape(key.shape)[~first]] = True
    return first & ~beaten[which.reshape(key.shape)]


def _cut(faces, source, cut):
    """Return the faces with those halved whose edge k to k + 1 has a vertex in `cut` (f, 3), at most one; -1: none."""
    some = (cut >= 0).any(axis=1)
    turned = (np.argmax(cut[some] >= 0, axis=1)[:, None] + np.arange(3)) % 3  # the edge comes first
    a, b, c = np.take_along_axis(faces[some], turned, 1).T
    x = cut[some].max(axis=1)
    parts = [faces[~some], np.stack([a, x, c], axis=1), np.stack([x, b, c], axis=1)]
    return np.concatenate(parts), np.concatenate([source[~some], source[some], source[some]])
