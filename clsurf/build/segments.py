"""Partition of a triangle mesh into areas that can each be one spatial patch."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

# Directions that widths of areas are measured along: axes, diagonals of the faces and of the box of a cube.
DIRECTIONS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -1, 0], [1, 0, 1], [1, 0, -1], [0, 1, 1],
                       [0, 1, -1], [1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]], np.float64)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)


@dataclass(frozen=True)
class FaceGraph:
    """The faces of a mesh and which of them share an edge."""

    corners: NDArray  # (f, 3) int64, vertices at one place under one number
    middle: NDArray  # (f, 3) float64
    normal: NDArray  # (f, 3) float64, unit, zero where a face has no area
    area: NDArray  # (f,) float64
    pairs: NDArray  # (e, 2) int64 faces that share an edge
    bend: NDArray  # (f,) float64: sum over the edges of half the squared angle times the length
    low: NDArray  # (f, 13) float32: extent along DIRECTIONS
    high: NDArray

    def __len__(self):
        return len(self.area)


def face_graph(vertices: NDArray, corners: NDArray) -> FaceGraph:
    v = vertices[corners]
    cross = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    doubled = np.linalg.norm(cross, axis=1)
    normal = cross / np.where(doubled > 0, doubled, 1)[:, None]
    count = len(vertices)
    a, b = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    key = np.minimum(a, b) * np.int64(count) + np.maximum(a, b)
    order = np.argsort(key, kind="stable")
    key = key[order]
    same = key[1:] == key[:-1]
    pairs = np.stack([order[:-1][same], order[1:][same]], axis=1) // 3
    edge = order[:-1][same]
    length = np.linalg.norm(vertices[a[edge]] - vertices[b[edge]], axis=1)
    cosine = np.clip(np.einsum("ij,ij->i", normal[pairs[:, 0]], normal[pairs[:, 1]]), -1, 1)
    bend = 2 * (1 - cosine) * length / 2
    bend = np.bincount(pairs.ravel(), np.repeat(bend, 2), len(corners))
    along = (vertices @ DIRECTIONS.T).astype(np.float32)
    x, y, z = along[corners[:, 0]], along[corners[:, 1]], along[corners[:, 2]]
    return FaceGraph(corners, v.mean(axis=1), normal, doubled / 2, pairs, bend, np.minimum(np.minimum(x, y), z),
                     np.maximum(np.maximum(x, y), z))


class Areas:
    def __init__(self, graph, owner=None, count=None, floor=1e-3):
        self.graph = graph
        if owner is None:
            owner, count = np.arange(len(graph)), len(graph)
            self.area, self.normal, self.bend = graph.area, graph.area[:, None] * graph.normal, graph.bend
            self.low, self.high = graph.low, graph.high
        else:
            self.area = np.bincount(owner, graph.area, count)
            self.bend = np.bincount(owner, graph.bend, count)
            self.normal = np.stack([np.bincount(owner, graph.area * graph.normal[:, k], count) for k in range(3)], 1)
            order = np.argsort(owner, kind="stable")
            starts = np.searchsorted(owner[order], np.arange(count))
            self.low = np.minimum.reduceat(graph.low[order], starts)
            self.high = np.maximum.reduceat(graph.high[order], starts)
        self.owner, self.count = owner, count
        self.floor = floor * graph.bend.sum() / graph.area.sum()
        self.pairs = np.empty((0, 2), np.int64)
        self.set_pairs(owner[graph.pairs])

    def set_pairs(self, pairs):
        a, b = pairs.min(axis=1), pairs.max(axis=1)
        key = np.unique((a * np.int64(self.count) + b)[a != b])
        self.pairs = np.stack(np.divmod(key, self.count), axis=1)

    def energy(self, width, bend, area):
        return width ** 3 * (bend + self.floor * area)

    def costs(self, least_cosine):
        a, b = self.pairs.T
        width = (np.maximum(self.high[a], self.high[b]) - np.minimum(self.low[a], self.low[b])).max(axis=1).astype(float)
        area = self.area[a] + self.area[b]
        cosine = 2 * np.linalg.norm(self.normal[a] + self.normal[b], axis=1) / np.maximum(area, 1e-300) - 1
        own = self.energy((self.high - self.low).max(axis=1).astype(float), self.bend, self.area)
        cost = self.energy(width, self.bend[a] + self.bend[b], area) - own[a] - own[b]
        steep = np.maximum(cosine, 0.05) ** -3
        cost = cost * steep
        return np.where(cosine >= least_cosine, cost, np.inf)

    def merge(self, target, least_cosine):
        while self.count > target:
            cost = self.costs(least_cosine)
            order = np.argsort(cost, kind="stable")
            order = order[np.isfinite(cost[order])]
            if not len(order):
                return
            back = order[::-1]
            best = np.full(self.count, -1)
            rank = np.empty(len(cost), np.int64)
            rank[order] = np.arange(len(order))
            b0 = np.full(self.count, len(cost))
            b0[self.pairs[back, 0]] = rank[back]
            b1 = np.full(self.count, len(cost))
            b1[self.pairs[back, 1]] = rank[back]
            best = np.minimum(b0, b1)
            a, b = self.pairs[order].T
            r = np.arange(len(order))
            mutual = order[(best[a] == r) & (best[b] == r)]
            room = self.count - target
            most = max(1, room // 3) if self.count < 4 * target else room
            self.apply(mutual[:min(most, room)])

    def apply(self, chosen):
        keep, gone = self.pairs[chosen].T
        new = np.arange(self.count)
        new[gone] = keep
        stays = np.ones(self.count, bool)
        stays[gone] = False
        number = np.cumsum(stays) - 1
        new = number[new]
        def joined(x, how):
            x = x.copy()
            x[keep] = how(x[keep], x[gone])
            return x[stays]
        self.area, self.bend = joined(self.area, np.add), joined(self.bend, np.add)
        self.normal = joined(self.normal, np.add)
        self.low, self.high = joined(self.low, np.minimum), joined(self.high, np.maximum)
        pairs = new[self.pairs]
        self.count = int(stays.sum())
        self.owner = new[self.owner]
        self.set_pairs(pairs)


def central_faces(graph, owner, count):
    """Return the face of every area nearest to its centroid."""
    weight = graph.area + 1e-9 * graph.area.mean()
    total = np.bincount(owner, weight, count)
    middle = np.stack([np.bincount(owner, weight * graph.middle[:, k], count) for k in range(3)], 1) / total[:, None]
    apart = ((graph.middle - middle[owner]) ** 2).sum(axis=1)
    order = np.lexsort((apart, owner))
    return order[np.searchsorted(owner[order], np.arange(count))]


def regrown(graph, seeds, weights):
    """Return the seed (f,) that every face is nearest to along `weights` (e,) of the graph's pairs; -1: unreached."""
    a, b = graph.pairs.T
    n = len(graph)
    net = sparse.csr_matrix((weights, (a, b)), (n, n))
    _, _, source = csgraph.dijkstra(net, directed=False, indices=seeds, min_only=True, return_predecessors=True)
    number = np.full(n + 1, -1)
    number[seeds] = np.arange(len(seeds))
    return np.where(source >= 0, number[source], -1)


def edge_weights(graph, bend_weight=2.0):
    a, b = graph.pairs.T
    apart = np.linalg.norm(graph.middle[a] - graph.middle[b], axis=1)
    cosine = np.einsum("ij,ij->i", graph.normal[a], graph.normal[b])
    return np.maximum(apart, 1e-12 * apart.mean()) * (1 + bend_weight * (1 - cosine))
