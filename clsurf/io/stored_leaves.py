"""The leaves of a surface that stays in its store, read part by part as points and rays need them, within a budget.

What a surface is at a place depends on the leaves whose balls hold it, all of which are in parts whose boxes do. So
work is cut by places: each piece of it gets the parts around its own.
"""

from collections import OrderedDict
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface.slim import SlimSurface, segment_end

BYTES = 180  # of a leaf: its arrays, and those of a device
SLAB = 1 << 18  # places looked at together


class StoredLeaves:
    """Leaves of a `StoredSurface`.

    Attributes
    ----------
    boxes : (k, 2, 3) float64
        World boxes that hold the whole balls of each part; low above high: a part without leaves.
    budget : int
        Bytes that may be in memory; one place's parts are read even where they are more.
    """

    def __init__(self, stored, budget: int):
        self.stored, self.budget = stored, budget
        surfels = np.asarray(stored.surfels)
        self.rows = np.concatenate([[0], np.cumsum(surfels.sum(axis=1))])  # where each part's surfels begin
        level = np.argmax(surfels > 0, axis=1) + 1
        reach = stored.diagonal * np.array([segment_end(int(one)) for one in level])
        self.boxes = stored.part_bounds + reach[:, None, None] * np.array([[-1.0], [1.0]])
        empty = (surfels.sum(axis=1) == 0) | ~np.isfinite(self.boxes).all(axis=(1, 2))
        self.boxes[empty] = np.array([[np.inf], [-np.inf]])
        self._parts: OrderedDict[int, tuple[SlimSurface, NDArray]] = OrderedDict()
        self._last: tuple[tuple, SlimSurface | None, NDArray] = ((), None, np.zeros(0, np.int64))
        if empty.all():
            raise InputError("surface: expected at least one leaf, got none")

    def __len__(self):
        return len(self.boxes)

    def cost(self, parts) -> int:
        """Return the bytes that parts may take."""
        return BYTES * int(np.diff(self.rows)[np.asarray(parts, int)].sum())

    def distances(self, points: NDArray) -> NDArray:
        """Return how far points (n, 3) are from every part's box, (n, k) float64; inf: an empty part."""
        out = np.zeros((len(points), len(self)))
        for axis in range(3):
            low, high = self.boxes[:, 0, axis], self.boxes[:, 1, axis]
            place = points[:, axis, None]
            out += np.maximum(np.maximum(low - place, place - high), 0) ** 2
        return np.sqrt(out)

    def leaves(self, part: int) -> tuple[SlimSurface, NDArray]:
        """Return the leaves of a part and their numbers among all surfels; the parts used last stay in memory."""
        if part in self._parts:
            self._parts.move_to_end(part)
            return self._parts[part]
        surface = self.stored.read(part)
        keep = np.flatnonzero(surface.leaf)
        self._parts[part] = only(surface, keep), keep + self.rows[part]
        while len(self._parts) > 1 and self.cost(list(self._parts)) > self.budget:
            self._parts.popitem(last=False)
        return self._parts[part]

    def surface(self, parts) -> tuple[SlimSurface, NDArray]:
        """Return the leaves of parts as one surface without links, and their numbers among all surfels."""
        key = tuple(sorted(int(part) for part in parts))
        if key != self._last[0]:
            self._last = ((), None, self._last[2])
            both = [self.leaves(part) for part in key]
            some = [one for one in both if len(one[0])] or both[:1]
            self._last = key, side_by_side([surface for surface, _ in some], self.stored), np.concatenate(
                [numbers for _, numbers in some])
        return self._last[1], self._last[2]

    def groups(self, places: NDArray):
        """Yield (rows, parts): places (n, 3) taken together, and the parts whose boxes hold any of them."""
        for start in range(0, len(places), SLAB):
            inside = self.distances(places[start:start + SLAB]) == 0
            home = np.argmax(np.append(inside[:, 1:], np.ones((len(inside), 1), bool), axis=1), axis=1)
            for one in np.unique(home):
                yield from self._within(start, np.flatnonzero(home == one), inside, places)

    def _within(self, start: int, rows: NDArray, inside: NDArray, places: NDArray):
        parts = np.flatnonzero(inside[rows].any(axis=0))
        here = places[start + rows]
        spread = np.ptp(here, axis=0)
        if self.cost(parts) > self.budget and spread.max() > 0:
            axis = int(np.argmax(spread))
            upper = here[:, axis] > (here[:, axis].min() + here[:, axis].max()) / 2
            for half in (rows[~upper], rows[upper]):
                yield from self._within(start, half, inside, places)
        else:
            yield start + rows, parts


def only(surface: SlimSurface, keep: NDArray) -> SlimSurface:
    """Return some surfels of a surface, without links."""
    take = lambda array: None if array is None else array[keep]  # noqa: E731
    names = ("centers", "radii", "normals", "coefficients", "level", "leaf", "fit_error", "footprint", "colors")
    return replace(surface, **{name: take(getattr(surface, name)) for name in names},
                   child_offset=np.zeros(len(keep) + 1, np.int32), children=np.zeros(0, np.int32))


def side_by_side(surfaces: list[SlimSurface], stored) -> SlimSurface:
    """Return surfaces without links as one, with the numbers of the whole one they are parts of."""
    if len(surfaces) == 1:
        return replace(surfaces[0], diagonal=stored.diagonal, bound=stored.bound, bound_share=stored.bound_share,
                       bound_all=stored.bound_all)
    origin = surfaces[-1].origin  # of a cell; that of part 0 may be far away
    gather = lambda name: np.concatenate([getattr(one, name) for one in surfaces])  # noqa: E731
    names = ("radii", "normals", "coefficients", "level", "leaf", "fit_error")
    optional = {}
    if any(one.footprint is not None for one in surfaces):
        optional["footprint"] = np.concatenate([np.full((len(one), 8), 255, np.uint8) if one.footprint is None
                                                else one.footprint for one in surfaces])
    if all(one.colors is not None for one in surfaces):
        optional["colors"] = gather("colors")
    count = sum(len(one) for one in surfaces)
    return SlimSurface(
        degree=stored.degree, error=stored.error, origin=origin, diagonal=stored.diagonal, bound=stored.bound,
        bound_share=stored.bound_share, bound_all=stored.bound_all, oriented=all(one.oriented for one in surfaces),
        centers=np.concatenate([one.centers + (one.origin - origin) for one in surfaces]).astype(np.float32),
        child_offset=np.zeros(count + 1, np.int32), children=np.zeros(0, np.int32),
        **{name: gather(name) for name in names}, **optional)
