"""Surfaces on a device for rays: at once where it holds them, otherwise piece by piece, in halves of halves.

Where a hit is one primitive's, a piece is any share of the primitives. Where hits blend what is around them, a piece
has a region of its own: it carries what reaches into it, and rays look for hits a little beyond it, so that what is
frontmost there is known on both sides of a cut.
"""

import logging
import threading
import weakref
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import DeviceMemoryError
from ..surface.arrays import finite_rows
from .kinds import Plan, Traced, plan_of

log = logging.getLogger("clsurf")

BEYOND = 1.0  # largest radii that rays look beyond a region: hits from behind are set back by a quarter radius
WORTH = 0.9  # a half with a larger share of the primitives is not worth a cut


@dataclass(eq=False)
class Piece:
    """Primitives of a surface, and their halves once the device was found not to hold them.

    `rows` (k,) int, None: all; `region` (2, 3) float64, frame, or None: the piece has no region of its own.
    """

    rows: NDArray | None = None
    region: NDArray | None = None
    reach: float = 0.0  # beyond the region, frame: where rays look for hits
    halves: list["Piece"] | None = None


class Held:
    """A surface as a device holds it: `whole`, or None where it comes in pieces by `each`."""

    def __init__(self, surface, device: Device):
        self.device, self.surface, self.whole, self.plan = device, weakref.ref(surface), None, None
        plan = plan_of(surface)
        try:
            self.whole = _put(device, plan, None)
        except DeviceMemoryError:
            self._cut_up(plan)
        self.grain, self.colors, self.packets = plan.grain, plan.colors, plan.packets

    def _cut_up(self, plan: Plan) -> None:
        self.plan, self.whole, self.pieces = plan, None, {blending: Piece() for blending in (False, True)}

    @property
    def empty(self) -> bool:
        """Whether there is nothing to hit."""
        return self.whole is not None and self.whole.empty

    def each(self, use, blending: bool = False, rays: bool = True) -> None:
        """Call ``use(traced, piece)`` with what is on the device, piece by piece; each makes room for the next.

        Parameters
        ----------
        blending : bool
            Whether pieces must know what blends into their hits: not where any hit will do.
        rays : bool
            Whether single rays are traced.
        """
        if self.whole is not None and rays:
            try:
                self.whole.ready()
            except DeviceMemoryError:  # single rays need more than packets
                self._cut_up(plan_of(self.surface()))
        if self.whole is not None:
            use(self.whole, Piece())
            return
        self._each(self.pieces[blending and self.plan.radii is not None], use, blending, rays)

    def _each(self, piece: Piece, use, blending: bool, rays: bool) -> None:
        if piece.halves is None:
            try:
                traced = _put(self.device, self.plan, piece)
                if rays:
                    traced.ready()
            except DeviceMemoryError:
                piece.halves = _halves(self.plan, piece, blending)
                if piece.halves is None:
                    raise
                log.info("%r is more than the device holds at once: traced in parts", self.surface())
            else:
                if not traced.empty:
                    use(traced, piece)
                self.device.finish()  # what still runs keeps its memory
                return
        for half in piece.halves:
            self._each(half, use, blending, rays)


def _put(device: Device, plan: Plan, piece: Piece | None) -> Traced:
    """Return a piece on the device, None: all."""
    traced = replace(plan.hold(device, None if piece is None else piece.rows), grain=plan.grain, colors=plan.colors)
    if piece is None or piece.region is None or traced.empty:
        return traced
    box = piece.region + piece.reach * np.array([[-1.0], [1.0]])
    return replace(traced, box=np.stack([np.maximum(traced.box[0], box[0]), np.minimum(traced.box[1], box[1])]))


def _halves(plan: Plan, piece: Piece, blending: bool) -> list[Piece] | None:
    """Return two pieces in place of one, or None where it cannot be cut."""
    low, high = plan.reaches()
    rows = piece.rows
    if rows is None:
        rows = np.flatnonzero(finite_rows(low) & finite_rows(high))
    if len(rows) < 2:
        return None
    middles = (low[rows] + high[rows]) / 2
    if not blending or plan.radii is None:
        axis = int(np.argmax(np.ptp(middles, axis=0)))
        order = np.argpartition(middles[:, axis], len(rows) // 2)
        return [Piece(np.sort(rows[part])) for part in np.split(order, [len(rows) // 2])]
    region = np.stack([low[rows].min(axis=0), high[rows].max(axis=0)]) if piece.region is None else piece.region
    for axis in np.argsort(region[0] - region[1]):  # the longest side first
        inside = ((middles >= region[0]) & (middles <= region[1])).all(axis=1)
        if not inside.any():
            return None
        cut = float(np.median(middles[inside, axis]))
        parts = [_region_piece(plan, rows, low, high, one) for one in _cut(region, axis, cut)]
        if max(len(part.rows) for part in parts) <= WORTH * len(rows):
            return parts
    return None


def _cut(region: NDArray, axis: int, place: float) -> list[NDArray]:
    """Return the two parts of a box (2, 3)."""
    below, above = region.copy(), region.copy()
    below[1, axis] = above[0, axis] = place
    return [below, above]


def _region_piece(plan: Plan, rows: NDArray, low: NDArray, high: NDArray, region: NDArray) -> Piece:
    """Return the piece of `rows` that a region needs."""
    def touching(margin):
        return rows[((low[rows] <= region[1] + margin) & (high[rows] >= region[0] - margin)).all(axis=1)]

    own = touching(0.0)
    largest = float(plan.radii[own].max()) if len(own) else 0.0
    return Piece(touching((BEYOND + plan.blend) * largest), region, BEYOND * largest)


_kept = threading.local()


def held(device: Device, surface) -> Held:
    """Return how `device` holds `surface`, made on this thread's first use and kept while the surface lives.

    Raises
    ------
    InputError
        Something that cannot be traced.
    """
    surfaces = _kept.__dict__.setdefault(id(device), weakref.WeakKeyDictionary())
    if surface not in surfaces:
        surfaces[surface] = Held(surface, device)
    return surfaces[surface]


def traced(device: Device, surface) -> Traced:
    """Return all of `surface` on the device; it stays there while the surface lives.

    Raises
    ------
    InputError
        Something that cannot be traced.
    DeviceMemoryError
        The device does not hold it at once: see `held`.
    """
    one = held(device, surface)
    return _put(device, one.plan, None) if one.whole is None else one.whole


def forget(device: Device) -> None:
    """Give back what the device holds of surfaces; how they were cut stays known."""
    surfaces = _kept.__dict__.get(id(device), {})
    for surface in [surface for surface, one in surfaces.items() if one.whole is not None]:
        del surfaces[surface]
    device.trim()
