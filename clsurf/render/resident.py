"""Surfaces larger than memory in the renderer: what of a `StoredSurface` is in memory, and what a view asks for.

A node is a part of the store and one of its levels. A view needs a part's levels down to the one whose balls appear no
larger than the threshold of detail; coarse levels come first, then those that appear largest, within a budget. A thread
reads them; a frame is drawn from what is there.
"""

import threading
import weakref
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..io.parts import joined
from ..io.stored import StoredSurface
from ..surface.arrays import lengths_of
from ..surface.placed import Placed
from ..surface.slim import COEFFICIENTS, SlimSurface, segment_end
from .scene import Scene

BYTES = 180  # of a surfel: its arrays, and those of the device
INTERNAL_SCALE = 1.5  # of internal surfels that stand for what is not there, as in render/slim.py
FIRST_SECONDS = 0.25  # that the first frame waits for the coarse part, without which it shows nothing
LEAST_PIXELS = 1.0  # a threshold of 0 draws leaves only, however small; the store is read down to this


@dataclass(frozen=True)
class Cut:
    """How many levels of each part are wanted or there; (k,) int, 0: none."""

    levels: NDArray

    def __eq__(self, other):
        return isinstance(other, Cut) and np.array_equal(self.levels, other.levels)

    __hash__ = None


def wanted_cut(stored: StoredSurface, matrix: NDArray | None, camera, size, lod: float, budget: int
               ) -> tuple[Cut, bool]:
    """Return what a view needs of a placed store within `budget` bytes, and whether that is all that it needs."""
    matrix = np.eye(4) if matrix is None else matrix
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    counts = np.asarray(stored.surfels)
    parts, levels = counts.shape
    distance, seen = _distances(stored.part_bounds, matrix, camera, size)
    p = camera.projection(size)
    pixels = 2 * max(p.fx, p.fy) * scale * stored.diagonal * np.array([segment_end(k + 1) for k in range(levels)])
    # (k, levels): how large a level's internal surfels appear at most.
    large = pixels[None, :] / (np.maximum(distance, 1e-9)[:, None] if p.perspective else 1.0)
    limit = max(lod, LEAST_PIXELS)
    need = np.zeros((parts, levels), bool)
    need[:, 0] = seen
    need[:, 1:] = seen[:, None] & (large[:, :-1] > limit)  # a level is wanted where the one before shows
    need[0] = True
    need = np.logical_and.accumulate(need | (counts == 0), axis=1) & seen[:, None] | (np.arange(parts) == 0)[:, None]
    taken = np.zeros(parts, int)
    taken[0] = levels
    left = budget - BYTES * int(counts[0].sum())
    order = [(level, -large[part, level], part) for part, level in np.argwhere(need & (counts > 0)) if part]
    whole = left >= 0
    closed = np.zeros(parts, bool)
    for level, _, part in sorted(order):
        cost = BYTES * int(counts[part, level])
        if closed[part] or cost > left:
            closed[part], whole = True, False
            continue
        left -= cost
        taken[part] = level + 1
    return Cut(taken), whole


def _distances(bounds: NDArray, matrix: NDArray, camera, size) -> tuple[NDArray, NDArray]:
    """Return the distances (k,) of placed boxes (k, 2, 3) from the eye, and which of them the picture may show."""
    corners = np.stack([np.stack([bounds[:, i, 0], bounds[:, j, 1], bounds[:, k, 2]], axis=1)
                        for i in (0, 1) for j in (0, 1) for k in (0, 1)], axis=1)
    finite = np.isfinite(corners).all(axis=(1, 2))
    corners = np.nan_to_num(corners) @ matrix[:3, :3].T + matrix[:3, 3]
    view = (corners - camera.eye) @ camera.rotation.T
    depth = -view[..., 2]
    p = camera.projection(size)
    near = max(camera.near, 1e-9) if p.perspective else -np.inf
    x, y = p.fx * view[..., 0], p.fy * view[..., 1]
    outside = (depth < near).all(axis=1)
    for side, extent, middle in ((x, size[0], p.cx), (-y, size[1], p.cy)):
        if p.perspective:  # planes through the eye, so that corners behind it count on their side
            outside |= (side + middle * depth < 0).all(axis=1) | (side + (middle - extent) * depth > 0).all(axis=1)
        else:
            outside |= (side + middle < 0).all(axis=1) | (side + middle - extent > 0).all(axis=1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    away = lengths_of(np.maximum(np.maximum(low - camera.eye, camera.eye - high), 0))
    return np.where(finite, away, np.inf), finite & ~outside


class Resident:
    """What of a stored surface is in memory.

    Parameters
    ----------
    stored : StoredSurface
    budget : int
        Bytes of surfels in memory and on the device.
    wait : bool
        Read in the calling thread: every frame is complete.
    prepare : callable, optional
        prepare(surface) puts a new `surface` on the device before it takes the old one's place, in the thread that
        reads: 3.4 s of the picture's for 2.5M surfels.

    Attributes
    ----------
    surface : SlimSurface
        What is there, as one surface; it changes when more has been read.
    complete : bool
        Whether it is all that the last view needs (within the budget).
    error : Exception or None
        What the last reading failed with; it is tried again.
    """

    def __init__(self, stored: StoredSurface, budget: int, wait: bool = False, prepare=lambda surface: None):
        # Not held here: a renderer keeps this while the surface itself lives.
        self.stored, self.budget, self.wait = weakref.proxy(stored), budget, wait
        self.prepare, self.complete, self.error = prepare, False, None
        self._lock = threading.Condition()
        self._parts: dict[tuple[int, int], SlimSurface] = {}
        self._cut = Cut(np.zeros(len(stored.surfels), int))
        self._wanted: Cut | None = None
        self._thread: threading.Thread | None = None
        self.surface = nothing_of(stored)

    @property
    def begun(self) -> bool:
        """Whether the coarse levels, part 0, are there."""
        return bool(self._cut.levels[0])

    def view(self, matrix, camera, size, lod: float) -> SlimSurface:
        """Return what there is for a view now, and have the rest of what it needs read."""
        wanted, _ = wanted_cut(self.stored, matrix, camera, size, lod, self.budget)
        with self._lock:
            self.complete = wanted == self._cut
            if self.complete:
                return self.surface
            self._wanted = wanted
            if not self.wait and (self._thread is None or not self._thread.is_alive()):
                self.error = None
                self._thread = threading.Thread(target=self._read, name="clsurf-resident", daemon=True)
                self._thread.start()
            if not self.wait and not self.begun:
                self._lock.wait_for(lambda: self.begun or self.error is not None, FIRST_SECONDS)
                if self.error is not None and not self.begun:
                    raise self.error
        if self.wait:
            self._read()
            if self.error is not None:
                raise self.error
            self.complete = True
        return self.surface

    def settle(self, timeout: float | None = None) -> bool:
        """Wait until what was asked for has been read; return whether it has."""
        thread = self._thread
        if thread is not None:
            thread.join(timeout)
        return thread is None or not thread.is_alive()

    def _read(self) -> None:
        """Read what is wanted, one step after the other, until nothing is; the surface changes after each step."""
        while True:
            with self._lock:
                wanted, self._wanted = self._wanted, None
            if wanted is None:
                return
            try:
                for cut in self._steps(wanted):
                    self._take(cut)
                    with self._lock:
                        if self._wanted is not None and not self.wait:
                            break  # the view has moved on
                self.error = None
            except Exception as error:  # a store on the web that cannot be reached now: what is there stays
                with self._lock:
                    self.error = error
                    self._lock.notify_all()
                return

    def _steps(self, wanted: Cut) -> list[Cut]:
        """Return the cuts on the way: the coarse part, half of what is wanted of every other part, then all."""
        if self.wait:
            return [wanted]
        coarse = Cut(np.where(np.arange(len(wanted.levels)) == 0, wanted.levels, self._cut.levels))
        half = Cut(np.minimum(wanted.levels, np.maximum(self._cut.levels, wanted.levels - 2)))
        half.levels[0] = wanted.levels[0]
        steps = [coarse] * (not self.begun) + [half, wanted]
        return [cut for cut, before in zip(steps, [self._cut, *steps[:-1]], strict=True) if cut != before]

    def _take(self, cut: Cut) -> None:
        kept = {}
        for part, levels in enumerate(cut.levels.tolist()):
            if levels:
                key = part, levels
                kept[key] = self._parts.get(key) or self.stored.read(part, None if part == 0 else levels)
        surface = shown(list(kept.values()), self.stored)
        self.prepare(surface)
        with self._lock:
            self._parts, self._cut, self.surface = kept, cut, surface
            self._lock.notify_all()


def resident_scene(scene: Scene, residents, camera, size, lod: float, new) -> tuple[Scene, bool]:
    """Return the scene with what is in memory in place of stored surfaces, and whether that is all that is needed.

    `residents` are those of the renderer, by stored surface; ``new(stored)`` makes one.
    """
    if not any(isinstance(own, StoredSurface) for own, _ in scene.placed):
        return scene, True
    surfaces, complete = [], True
    for surface, (own, matrix) in zip(scene.surfaces, scene.placed, strict=True):
        if isinstance(own, StoredSurface):
            resident = residents.get(own)
            if resident is None:
                resident = residents[own] = new(own)
            part = resident.view(matrix, camera, size, lod)
            complete &= resident.complete
            surface = part if matrix is None else Placed(part, matrix)
        surfaces.append(surface)
    return replace(scene, surfaces=surfaces), complete


def nothing_of(stored: StoredSurface) -> SlimSurface:
    """Return a surface without surfels in a stored one's place."""
    three, one = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    return SlimSurface(degree=stored.degree, error=stored.error, origin=stored.origin, diagonal=stored.diagonal,
                       centers=three, radii=one, normals=three,
                       coefficients=np.zeros((0, COEFFICIENTS[stored.degree]), np.float32),
                       level=np.zeros(0, np.int32), leaf=np.zeros(0, bool), child_offset=np.zeros(1, np.int32),
                       children=np.zeros(0, np.int32), fit_error=one)


def shown(parts: list[SlimSurface], stored: StoredSurface) -> SlimSurface:
    """Return parts as one surface in which internal surfels without children stand for what is not there."""
    surface = joined(parts, {"diagonal": stored.diagonal, "bound": stored.bound, "bound_share": stored.bound_share})
    alone = ~surface.leaf & (np.diff(surface.child_offset) == 0)
    if not alone.any():
        return surface
    radii = surface.radii.copy()
    radii[alone] *= INTERNAL_SCALE
    footprint = None
    if surface.footprint is not None:
        footprint = surface.footprint.copy()
        footprint[alone] = 255
    return replace(surface, leaf=surface.leaf | alone, radii=radii, footprint=footprint)
