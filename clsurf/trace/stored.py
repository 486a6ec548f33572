"""Rays against surfaces that stay in their store: space is cut into boxes, each traced with the parts around it.

A box is small enough for its parts to fit in the budget, and only boxes that rays cross are read. A ray's hits in a box
are those on its way through it, so that each is found once, with all balls that hold it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..io.stored import StoredSurface
from ..io.stored_leaves import StoredLeaves
from ..surface.arrays import finite_rows, lengths_of
from ..surface.placed import Placed
from .rays import Hits

DEEPEST = 40  # cuts of a box: what does not fit then is read all the same
SLACK = 1e-6  # of the diagonal: what rounds to the other side of a cut is found on both


@dataclass(eq=False)
class Way:
    """Rays in a stored surface's own space, and what they have met so far.

    `near` and `far` (n,) are world distances along the world's unit directions; `scale` world lengths to one of here.
    """

    origins: NDArray  # (n, 3) float64
    directions: NDArray  # (n, 3) float64, unit
    near: NDArray
    far: NDArray
    scale: float
    matrix: NDArray | None  # model to world

    def through(self, box: NDArray, rows: NDArray) -> tuple[NDArray, NDArray]:
        """Return where rays enter and leave a box (2, 3), as distances of the world."""
        with np.errstate(all="ignore"):
            times = (box[None] - self.origins[rows, None]) / self.directions[rows, None]
        # Along an axis that a ray does not move on, it is inside all the time or never.
        still = self.directions[rows] == 0
        inside = (self.origins[rows] >= box[0]) & (self.origins[rows] <= box[1])
        enter = np.where(still, np.where(inside, -np.inf, np.inf), times.min(axis=1)).max(axis=1)
        leave = np.where(still, np.where(inside, np.inf, -np.inf), times.max(axis=1)).min(axis=1)
        return enter * self.scale, leave * self.scale


def trace_stored(stored: StoredSurface, matrix: NDArray | None, rays, query: str, device):
    """Return the `Hits` of checked rays (hits.py, `Rays`), flat, of one placed stored surface, numbered 0.

    Primitives are numbered through the parts in their order.
    """
    from .hits import trace
    way = _way(rays, matrix)
    leaves: StoredLeaves = stored.leaves()
    n, slack = rays.count, SLACK * stored.diagonal * way.scale
    out = Hits(np.full(n, np.inf), np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full(n, -1, np.int32),
               np.full(n, -1, np.int32))
    every: list[tuple] = []  # of all hits: ray and the columns of `Hits`

    def meet(box: NDArray, rows: NDArray, depth: int) -> None:
        enter, leave = way.through(box, rows)
        near, far = np.maximum(way.near[rows], enter - slack), np.minimum(way.far[rows], leave + slack)
        if query != "all":
            far = np.minimum(far, out.distance[rows] if query == "closest" else
                             np.where(np.isfinite(out.distance[rows]), -np.inf, np.inf))
        some = near < far
        rows, near, far = rows[some], near[some], far[some]
        if not len(rows):
            return
        parts = [part for part in np.flatnonzero(_overlap(leaves.boxes, box)) if _met(way, leaves.boxes[part], rows,
                                                                                     near, far)]
        if not parts:
            return
        if leaves.cost(parts) > leaves.budget and depth < DEEPEST:
            for half in _halves(box, way.directions[rows].sum(axis=0)):
                meet(half, rows, depth + 1)
            return
        surface, numbers = leaves.surface(parts)
        found = trace(surface if matrix is None else Placed(surface, matrix), _world(way, rays, "origins", rows),
                      _world(way, rays, "directions", rows), query, near, far, device)
        if query == "all":
            ray = np.repeat(rows, np.diff(found.offsets))
            every.append((ray, found.distance, found.position, found.normal, numbers[found.primitive]))
            return
        closer = np.flatnonzero(found.distance < out.distance[rows])
        at = rows[closer]
        out.distance[at], out.position[at], out.normal[at] = (
            found.distance[closer], found.position[closer], found.normal[closer])
        out.surface[at], out.primitive[at] = 0, numbers[found.primitive[closer]]

    finite = np.isfinite(leaves.boxes).all(axis=(1, 2))
    whole = np.stack([leaves.boxes[finite, 0].min(axis=0), leaves.boxes[finite, 1].max(axis=0)])
    good = finite_rows(way.origins) & finite_rows(way.directions)
    meet(whole, np.flatnonzero(good), 0)
    return out if query != "all" else _sorted(every, n, 2 * slack)


def _way(rays, matrix: NDArray | None) -> Way:
    rows = lambda name: np.broadcast_to(getattr(rays, name), (rays.count, *getattr(rays, name).shape[1:]))  # noqa: E731
    origins, directions, scale = rows("origins"), rows("directions"), 1.0
    if matrix is not None:
        linear = matrix[:3, :3]
        scale = float(np.cbrt(np.linalg.det(linear)))
        origins, directions = (origins - matrix[:3, 3]) @ linear / scale**2, directions @ linear
    with np.errstate(all="ignore"):
        directions = directions / lengths_of(directions, keepdims=True)
    return Way(origins, directions, rows("near"), rows("far"), scale, matrix)


def _world(way: Way, rays, name: str, rows: NDArray) -> NDArray:
    array = getattr(rays, name)
    return array[0] if len(array) == 1 else array[rows]


def _overlap(boxes: NDArray, box: NDArray) -> NDArray:
    """Return which boxes (k, 2, 3) touch a box (2, 3)."""
    return ((boxes[:, 0] <= box[1]) & (boxes[:, 1] >= box[0])).all(axis=1)


def _met(way: Way, box: NDArray, rows: NDArray, near: NDArray, far: NDArray) -> bool:
    """Return whether any of the rays crosses a box between its limits."""
    enter, leave = way.through(box, rows)
    return bool((np.maximum(enter, near) <= np.minimum(leave, far)).any())


def _halves(box: NDArray, along: NDArray) -> list[NDArray]:
    """Return the halves of a box across its longest side, first the one that most rays come to first."""
    axis = int(np.argmax(box[1] - box[0]))
    middle = (box[0, axis] + box[1, axis]) / 2
    low, high = box.copy(), box.copy()
    low[1, axis] = high[0, axis] = middle
    return [low, high] if along[axis] >= 0 else [high, low]


def _sorted(every: list[tuple], count: int, same: float):
    """Return all hits in the order of the rays, those found on both sides of a cut once."""
    empty = (np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int64))
    ray, distance, position, normal, primitive = (np.concatenate(parts) for parts in zip(empty, *every, strict=True))
    order = np.lexsort((distance, primitive, ray))
    again = ((np.diff(ray[order]) == 0) & (np.diff(primitive[order]) == 0) & (np.diff(distance[order]) < same))
    order = np.delete(order, np.flatnonzero(again) + 1)
    order = order[np.lexsort((distance[order], ray[order]))]
    offsets = np.concatenate([[0], np.cumsum(np.bincount(ray[order], minlength=count))])
    return Hits(distance[order], position[order], normal[order], np.zeros(len(order), np.int32),
                primitive[order].astype(np.int32), offsets)


def merged(hits: list, numbers: list[list[int]], rays, query: str):
    """Return `Hits` of several things as one, in the rays' shape; `numbers`: of their surfaces in the scene."""
    hits = [replace(one, surface=np.where(one.surface < 0, -1, np.array([*own, -1], np.int32)[one.surface]).astype(
        np.int32)) for one, own in zip(hits, numbers, strict=True)]
    names = ("distance", "position", "normal", "surface", "primitive")
    if query == "all":
        ray = np.concatenate([np.repeat(np.arange(rays.count), np.diff(one.offsets)) for one in hits])
        columns = [np.concatenate([getattr(one, name) for one in hits]) for name in names]
        order = np.lexsort((columns[0], ray))
        offsets = np.concatenate([[0], np.cumsum(np.bincount(ray, minlength=rays.count))])
        return type(hits[0])(*(column[order] for column in columns), offsets=offsets)
    first, *rest = hits
    columns = [np.array(getattr(first, name)).reshape(rays.count, *np.shape(getattr(first, name))[len(rays.shape):])
               for name in names]
    for one in rest:
        closer = np.flatnonzero(one.distance < columns[0])
        for column, name in zip(columns, names, strict=True):
            column[closer] = getattr(one, name)[closer]
    return type(first)(*(column.reshape(*rays.shape, *column.shape[1:]) for column in columns))
