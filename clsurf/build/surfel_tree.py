"""The tree of a surfel hierarchy: base elements are clustered from the top down, and each cluster gets a disc.

Elements are base surfels or the triangles of the hybrid form: a position, a normal and a radius each.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import lengths_of
from ..surface.slim import frame_of_normals

FEW = 16  # elements of a cluster that is not divided any more
SPLITS = 3  # halvings from one level to the next: up to 8 children
PER_LEAF = 12  # elements that the last clusters should have
TWO_SIDED = 0.45  # variance of unit normals along an axis above which a cluster is divided by normals, not positions
# Half angle of the cone over the root mean square deviation of its normals: 1.37 if they are even, 2 holds nearly all.
CONE = 2.0


@dataclass(eq=False)
class Tree:
    """Clusters level by level; the elements in an order in which every cluster's stand together."""

    order: NDArray  # (n,) int64, elements
    start: NDArray  # (c,) int64, first element of each cluster in `order`
    count: NDArray  # (c,) int64, elements of each cluster
    level: NDArray  # (c,) int32, 1: the root
    child_start: NDArray  # (c,) int64, first child among the clusters; where there are none, irrelevant
    child_count: NDArray  # (c,) int64


def cluster(positions: NDArray, normals: NDArray, report) -> Tree:
    """Divide elements into a tree of clusters.

    A cluster is halved at the mean along the axis in which its positions vary most, or, where its normals point to
    opposite sides (both faces of a thin sheet), along the axis in which those vary most.

    Parameters
    ----------
    positions, normals : (n, 3) float32
        n at least 1; normals are unit.
    report : callable
        report(done), from 0 to 1.
    """
    n = len(positions)
    order = np.arange(n)
    start, count = np.array([0]), np.array([n])
    starts, counts, levels, child_starts, child_counts = [], [], [], [], []
    number, first, settled = 1, 0, 0
    while len(start):
        starts.append(start)
        counts.append(count)
        levels.append(np.full(len(start), number, np.int32))
        open_ = np.flatnonzero(count > FEW)
        settled += int(count[count <= FEW].sum())
        report(settled / n)
        children_of = np.zeros(len(start), np.int64)
        first += len(start)
        pieces_start, pieces_count = start[open_], count[open_]
        parent, left = open_, np.clip(np.ceil(np.log2(pieces_count / PER_LEAF)), 1, SPLITS).astype(int)
        for _ in range(SPLITS):
            divide = (left > 0) & (pieces_count > 1)
            if not divide.any():
                break
            size = halve(order, positions, normals, pieces_start[divide], pieces_count[divide])
            keep = np.where(divide, 2, 1)
            new_start, new_count = np.repeat(pieces_start, keep), np.repeat(pieces_count, keep)
            at = np.cumsum(keep) - keep
            new_count[at[divide]] = size
            new_count[at[divide] + 1] -= size
            new_start[at[divide] + 1] += size
            parent, left = np.repeat(parent, keep), np.repeat(left - 1, keep)
            pieces_start, pieces_count = new_start, new_count
        np.add.at(children_of, parent, 1)
        child_counts.append(children_of)
        child_starts.append(first + np.cumsum(children_of) - children_of)
        start, count = pieces_start, pieces_count
        number += 1
    return Tree(order, *(np.concatenate(parts) for parts in (starts, counts, levels, child_starts, child_counts)))


def halve(order: NDArray, positions: NDArray, normals: NDArray, start: NDArray, count: NDArray) -> NDArray:
    """Reorder the elements of each piece of `order` in place so that its first part is one half; return their sizes."""
    where = np.repeat(start - (np.cumsum(count) - count), count) + np.arange(count.sum())
    piece, first = np.repeat(np.arange(len(start)), count), np.cumsum(count) - count
    own = order[where]
    p, q = (np.ascontiguousarray(array[own].T, np.float64) for array in (positions, normals))
    means, axis, _ = principal(p, piece, first, count)
    length2 = sum((np.add.reduceat(c, first) / count) ** 2 for c in q)
    mixed = np.flatnonzero(1 - length2 > TWO_SIDED)  # no axis has more variance than all together
    if len(mixed):
        among = np.zeros(len(start), bool)
        among[mixed] = True
        some = among[piece]
        size = count[mixed]
        normal_means, normal_axis, variance = principal(q[:, some], np.repeat(np.arange(len(mixed)), size),
                                                        np.cumsum(size) - size, size)
        chosen = mixed[variance > TWO_SIDED]
        means[:, chosen], axis[:, chosen] = normal_means[:, variance > TWO_SIDED], normal_axis[:, variance > TWO_SIDED]
        among[:] = False
        among[chosen] = True
        p = np.where(among[piece], q, p)
    side = sum(axis[k][piece] * (p[k] - means[k][piece]) for k in range(3)) > 0
    right = np.add.reduceat(side, first, dtype=np.int64)
    # All on one side: the same place many times. Halved by number.
    stuck = (right == 0) | (right == count)
    if stuck.any():
        within = np.arange(len(where)) - first[piece]
        side = np.where(stuck[piece], within >= (count // 2)[piece], side)
        right = np.where(stuck, count - count // 2, right)
    ahead = np.cumsum(side) - side  # on the right side, before this one, in all pieces
    ahead -= ahead[first][piece]
    within = np.arange(len(where)) - first[piece]
    target = start[piece] + np.where(side, (count - right)[piece] + ahead, within - ahead)
    order[target] = own
    return count - right


def principal(columns: NDArray, piece: NDArray, first: NDArray, count: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return mean (3, m), main axis (3, m) and the variance along it (m,) of the vectors (3, n) of each piece."""
    mean = np.stack([np.add.reduceat(c, first) for c in columns]) / count
    d = columns - mean[:, piece]
    c = np.empty((len(first), 3, 3))
    for i in range(3):
        for j in range(i, 3):
            c[:, i, j] = c[:, j, i] = np.add.reduceat(d[i] * d[j], first) / count
    trace = np.maximum(np.trace(c, axis1=1, axis2=2), 1e-300)
    power = c / trace[:, None, None]
    for _ in range(5):  # the 32nd power: all but the main axis has gone
        power = power @ power
        power /= np.maximum(np.trace(power, axis1=1, axis2=2), 1e-300)[:, None, None]
    best = np.argmax(np.einsum("nij,nij->nj", power, power), axis=1)
    axis = power[np.arange(len(power)), :, best]
    axis /= np.maximum(lengths_of(axis, keepdims=True), 1e-300)
    return mean, axis.T, np.einsum("ni,nij,nj->n", axis, c, axis)


@dataclass(eq=False)
class Discs:
    """What the clusters look like; float64, relative to the surface's origin."""

    positions: NDArray  # (c, 3)
    normals: NDArray  # (c, 3)
    radii: NDArray  # (c,)
    spheres: NDArray  # (c,)
    heights: NDArray  # (c,)
    spreads: NDArray  # (c,)
    colors: NDArray | None  # (c, 4) premultiplied linear light


def discs_of(tree: Tree, positions: NDArray, normals: NDArray, radii: NDArray, colors: NDArray | None) -> Discs:
    """Return the disc of every cluster: its plane and cone from all its elements, by area; a circle around them.

    Parameters
    ----------
    positions, normals, radii : (n, 3), (n, 3), (n,)
        Of the elements.
    colors : (n, 4), optional
        Premultiplied linear light.
    """
    c = len(tree.start)
    p, q, r = positions[tree.order].astype(np.float64), normals[tree.order].astype(np.float64), radii[tree.order]
    r = r.astype(np.float64)
    shade = None if colors is None else colors[tree.order]
    out = Discs(np.empty((c, 3)), np.empty((c, 3)), np.empty(c), np.zeros(c), np.empty(c), np.empty(c),
                None if colors is None else np.empty((c, 4)))
    area = r * r
    for level in range(1, int(tree.level.max()) + 1):
        use = np.flatnonzero(tree.level == level)
        count = tree.count[use]
        first = np.cumsum(count) - count
        at = np.repeat(tree.start[use] - first, count) + np.arange(count.sum())
        piece = np.repeat(np.arange(len(use)), count)
        w = area[at]
        total = np.maximum(np.add.reduceat(w, first), 1e-300)
        mean = lambda values, w=w, first=first, total=total: np.stack(  # noqa: E731
            [np.add.reduceat(w * column, first) / total for column in values.T], axis=1)
        own, facing = p[at], q[at]
        middle, normal = mean(own), mean(facing)
        length = lengths_of(normal)
        lost = length < 1e-3  # normals that cancel say nothing: the first one does
        normal = np.where(lost[:, None], facing[first], normal / np.maximum(length, 1e-300)[:, None])
        u, v = frame_of_normals(normal)
        d = own - middle[piece]
        x, y, z = (np.einsum("ij,ij->i", d, a[piece]) for a in (u, v, normal))
        reach = r[at]
        # The middle of the extents in the plane holds them in a smaller circle than their mean does.
        extents = [(np.minimum.reduceat(t - reach, first) + np.maximum.reduceat(t + reach, first)) / 2 for t in (x, y)]
        middle = middle + extents[0][:, None] * u + extents[1][:, None] * v
        x, y = x - extents[0][piece], y - extents[1][piece]
        cosine = np.einsum("ij,ij->i", facing, normal[piece])
        tilt = reach * np.sqrt(np.clip(1 - cosine**2, 0, 1))
        out.positions[use], out.normals[use] = middle, normal
        out.radii[use] = np.maximum.reduceat(np.hypot(x, y) + reach, first)
        out.heights[use] = np.maximum.reduceat(np.abs(z) + tilt, first)
        out.spreads[use] = np.where(lost, 1, np.minimum(CONE * np.sqrt(np.clip(1 - length**2, 0, 1)), 1))
        bottom = tree.child_count[use] == 0
        held = np.maximum.reduceat(np.sqrt(x * x + y * y + z * z) + reach, first)
        out.spheres[use] = np.where(bottom, held, 0)
        if shade is not None:
            out.colors[use] = mean(shade[at])
    for level in range(int(tree.level.max()) - 1, 0, -1):
        use = np.flatnonzero((tree.level == level) & (tree.child_count > 0))
        count = tree.child_count[use]
        first = np.cumsum(count) - count
        child = np.repeat(tree.child_start[use] - first, count) + np.arange(count.sum())
        apart = lengths_of(out.positions[child] - np.repeat(out.positions[use], count, axis=0))
        if len(use):
            out.spheres[use] = np.maximum.reduceat(apart + out.spheres[child], first)
    return out
