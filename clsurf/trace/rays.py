"""Rays as arrays, and what they hit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError


@dataclass(frozen=True, eq=False, repr=False)
class Hits:
    """Where rays hit, world space.

    For the queries "closest" and "any" the arrays have the shape of the rays (here: n); for "all" they hold the hits of
    all rays, nearest first within each, and those of ray i (counted through the rays' shape) are
    ``offsets[i]:offsets[i + 1]``.

    Attributes
    ----------
    distance : (n,) float64
        From the ray's origin, world units whatever the direction's length; inf: missed.
    position : (n, 3) float64
        NaN: missed.
    normal : (n, 3) float64
        Unit, toward the side that the ray comes from; NaN: missed. Of meshes, patches and hybrid hierarchies the
        triangle's own, which the renderer's smooth normals are near to.
    surface : (n,) int32
        Number of the surface in the scene or list, 0 for a single surface; -1: missed.
    primitive : (n,) int32
        What was hit of it: a mesh's face, a SLIM surface's or hierarchy's frontmost surfel, a patch; -1: missed.
    offsets : (rays + 1,) int64 or None
        Only for "all".
    """

    distance: NDArray
    position: NDArray
    normal: NDArray
    surface: NDArray
    primitive: NDArray
    offsets: NDArray | None = None

    @property
    def hit(self) -> NDArray:
        """Which rays hit something: bool, in the rays' shape (for "all": (rays,))."""
        return np.isfinite(self.distance) if self.offsets is None else np.diff(self.offsets) > 0

    def __repr__(self):
        if self.offsets is not None:
            return f"Hits({len(self.distance):,} of {len(self.offsets) - 1:,} rays)"
        return f"Hits({int(self.hit.sum()):,} of {self.distance.size:,} rays hit)"


@dataclass(frozen=True, eq=False)
class Rays:
    """Checked rays: arrays of `count` rows, or of 1 that serves all."""

    shape: tuple[int, ...]
    count: int
    origins: NDArray  # (count or 1, 3) float64
    directions: NDArray  # (count or 1, 3) float64
    near: NDArray  # (count or 1,) float64
    far: NDArray  # (count or 1,) float64

    def rows(self, name: str, first: int, stop: int) -> NDArray:
        """Return rows first to stop of an array, one row where that serves all."""
        array = getattr(self, name)
        return array if len(array) == 1 else array[first:stop]

    def step(self, name: str) -> int:
        """Return the elements from one ray's entry to the next."""
        array = getattr(self, name)
        return 0 if len(array) == 1 else array.size // max(len(array), 1)


def checked_rays(origins, directions, near, far) -> Rays:
    """Return rays as arrays, or raise InputError."""
    try:
        o, d = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
        limits = [np.asarray(near, np.float64), np.asarray(far, np.float64)]
    except (TypeError, ValueError):
        raise InputError("trace: expected origins, directions and limits as arrays of numbers") from None
    for name, array in (("origins", o), ("directions", d)):
        if array.ndim < 1 or array.shape[-1] != 3:
            raise InputError(f"{name}: expected an array of shape (..., 3), got {array.shape}")
    try:
        shape = np.broadcast_shapes(o.shape[:-1], d.shape[:-1], *(limit.shape for limit in limits))
    except ValueError:
        raise InputError("trace: expected origins, directions and limits that broadcast against each other, got "
                         f"{o.shape}, {d.shape}, {limits[0].shape}, {limits[1].shape}") from None
    if np.isnan(limits[0]).any() or np.isnan(limits[1]).any():
        raise InputError("trace: expected distances near and far, got NaN")
    count = int(np.prod(shape))
    spread = [_rows(a, (*shape, 3), (count, 3)) for a in (o, d)] + [_rows(a, shape, (count,)) for a in limits]
    return Rays(shape, count, *spread)


def _rows(array: NDArray, shape: tuple, rows: tuple) -> NDArray:
    """Return `array` broadcast to `shape` as rows; a single row stays one."""
    if array.size == int(np.prod(rows[1:])) and rows[0] != 1:
        return array.reshape(1, *rows[1:])
    return np.ascontiguousarray(np.broadcast_to(array, shape)).reshape(rows)
