"""Cuts through a surface's hierarchy: coarser versions of it, by error."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .slim import SlimSurface


def cut(surface: SlimSurface, error: float) -> NDArray:
    """Return the surfels of the cut by `error`: top-down, each path stops where the fit error is small enough.

    Parameters
    ----------
    surface : SlimSurface
    error : float
        World units, absolute: a path stops at the first surfel whose `fit_error` is at most this, or at a leaf.

    Returns
    -------
    (k,) int32
        Ascending indices; a surfel that several paths reach counts once.
    """
    offset, children = surface.child_offset, surface.children
    stops = surface.leaf | (surface.fit_error <= error) | (np.diff(offset) == 0)
    taken, seen = np.zeros(len(surface), bool), np.zeros(len(surface), bool)
    front = surface.roots
    while len(front):
        seen[front] = True
        taken[front[stops[front]]] = True
        inner = front[~stops[front]]
        count = offset[inner + 1] - offset[inner]
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        front = np.unique(children[np.repeat(offset[inner], count) + step])
        front = front[~seen[front]]
    return np.flatnonzero(taken).astype(np.int32)


def cut_surface(surface: SlimSurface, error: float) -> SlimSurface:
    """Return the cut by `error` (world units) as a surface of its own: its surfels are leaves without links."""
    keep = cut(surface, error)
    take = lambda array: None if array is None else array[keep]  # noqa: E731
    return replace(surface, centers=surface.centers[keep], radii=surface.radii[keep], normals=surface.normals[keep],
                   coefficients=surface.coefficients[keep], level=surface.level[keep],
                   leaf=np.ones(len(keep), bool), child_offset=np.zeros(len(keep) + 1, np.int32),
                   children=np.zeros(0, np.int32), fit_error=surface.fit_error[keep],
                   footprint=take(surface.footprint), colors=take(surface.colors))
