"""Nearest points of surfaces that stay in their store."""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..io.stored import StoredSurface
from ..io.stored_leaves import SLAB, StoredLeaves


def project_stored(stored: StoredSurface, points: NDArray, device: Device) -> tuple[NDArray, NDArray, NDArray]:
    """Return position (n, 3), normal (n, 3) and signed distance (n,), float64, of `points` (n, 3) on a stored surface.

    The parts are asked one after the other, each only for points that its box comes nearer to than what was found; then
    all parts that hold a found place together decide, so that parts blend into each other as they do in memory.
    """
    from .project import project
    leaves = stored.leaves()
    out = np.empty((len(points), 7))
    for start in range(0, len(points), SLAB):
        slab = slice(start, start + SLAB)
        place = nearest_places(leaves, points[slab], device)
        for rows, parts in leaves.groups(place):
            near = project(leaves.surface(parts)[0], points[slab][rows], device)
            out[start + rows] = np.concatenate([near.position, near.normal, near.distance[:, None]], axis=1)
    return np.ascontiguousarray(out[:, :3]), np.ascontiguousarray(out[:, 3:6]), np.ascontiguousarray(out[:, 6])


def nearest_places(leaves: StoredLeaves, points: NDArray, device: Device) -> NDArray:
    """Return the nearest of the places (n, 3) that the parts give for points (n, 3), each part by itself."""
    from .project import project
    away = leaves.distances(points)
    best, place = np.full(len(points), np.inf), np.array(points, np.float64)

    def ask(part: int, rows: NDArray) -> None:
        surface = leaves.leaves(part)[0] if len(rows) else ()
        if not len(surface):
            return
        near = project(surface, points[rows], device)
        closer = np.abs(near.distance) < best[rows]
        best[rows[closer]], place[rows[closer]] = np.abs(near.distance[closer]), near.position[closer]

    home = np.argmin(np.where(np.arange(len(leaves)) == 0, np.inf, away), axis=1)  # the coarse part is everywhere
    for part in np.unique(home):
        if np.isfinite(away[:, part]).any():
            ask(int(part), np.flatnonzero(home == part))
    for part in range(len(leaves)):
        if np.isfinite(leaves.boxes[part]).all():
            ask(part, np.flatnonzero((away[:, part] < best) & (home != part)))
    return place
