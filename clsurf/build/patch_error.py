"""How far points of a scan lie from the patches that stand for their part of it."""

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface


def patch_distances(surface: PatchSurface, patch: NDArray, points: NDArray,
                    to_nodes: bool = True) -> tuple[NDArray, NDArray]:
    """Return distances from points to patches that cover them.

    Parameters
    ----------
    patch : (n,) int
        Patch of every point.
    points : (n, 3) float64
        Relative to the surface's origin.
    to_nodes : bool
        Measure points whose cell is not opaque to cells near by, or to the patch's nodes; otherwise they are at inf.

    Returns
    -------
    upper : (n,) float64
        World units, never less than the distance to the surface: along the patch's z where the point's cell is opaque,
        otherwise to a point of the opaque cells around, or to the patch's nearest opaque node.
    near : (n,) float64
        The first one times the cosine of the cell's slope: the distance itself, to first order.
    """
    x, y, z = (a.astype(np.float64) for a in (surface.axis_x, surface.axis_y, surface.axis_z))
    apart = points - surface.origins[patch]
    i, j, k = (np.einsum("ij,ij->i", apart, (a / np.einsum("ij,ij->i", a, a)[:, None])[patch]) for a in (x, y, z))
    m, n = surface.size[patch].T.astype(np.int64)
    column, row = np.clip(np.floor(i), 0, m - 2).astype(np.int64), np.clip(np.floor(j), 0, n - 2).astype(np.int64)
    at = surface.node_offset[patch] + row * m + column
    corners = np.stack([at, at + 1, at + m, at + m + 1])
    inside = (i >= 0) & (i <= m - 1) & (j >= 0) & (j <= n - 1) & surface.opaque[corners].all(axis=0)
    d = surface.displacements[corners].astype(np.float64)
    u, v = i - column, j - row
    miss = k - ((1 - v) * ((1 - u) * d[0] + u * d[1]) + v * ((1 - u) * d[2] + u * d[3]))
    lengths = [lengths_of(a)[patch] for a in (x, y, z)]
    upper = np.abs(miss) * lengths[2]
    slope_x = ((1 - v) * (d[1] - d[0]) + v * (d[3] - d[2])) * lengths[2] / lengths[0]
    slope_y = ((1 - u) * (d[2] - d[0]) + u * (d[3] - d[1])) * lengths[2] / lengths[1]
    near = upper / np.sqrt(1 + slope_x ** 2 + slope_y ** 2)
    outside = np.flatnonzero(~inside)
    upper[outside] = near[outside] = np.inf
    if to_nodes and len(outside):
        local = np.stack([i, j, k], axis=1)[outside]
        upper[outside] = near[outside] = _to_cells(surface, patch[outside], local, np.stack(lengths, axis=1)[outside])
        far = outside[~np.isfinite(upper[outside])]
        upper[far] = near[far] = _to_nodes(surface, patch[far], points[far])
    return upper, near


def bound_of_all(surface: PatchSurface, distance: NDArray) -> float:
    """Return the largest of the distances (n,), and half a step of the displacements; NaN for none, or one at inf."""
    largest = float(distance.max(initial=-np.inf)) + float(surface.axis_z_length.max(initial=0)) / 2
    return largest if np.isfinite(largest) else float("nan")


def _to_cells(surface, patch, local, lengths) -> NDArray:
    """Return the least distance (n,) of points to the points over or nearest to them in the 5 x 5 cells around.

    Parameters
    ----------
    local : (n, 3) float64
        Node steps and displacement steps.
    lengths : (n, 3) float64
        World units of these.
    """
    best, opaque = np.full(len(patch), np.inf), surface.opaque
    m, n = surface.size[patch].T.astype(np.int64)
    base = np.clip(np.floor(local[:, 0]), 0, m - 2), np.clip(np.floor(local[:, 1]), 0, n - 2)
    for shift in np.ndindex(5, 5):
        column = np.clip(base[0] + shift[0] - 2, 0, m - 2).astype(np.int64)
        row = np.clip(base[1] + shift[1] - 2, 0, n - 2).astype(np.int64)
        at = surface.node_offset[patch] + row * m + column
        corners = np.stack([at, at + 1, at + m, at + m + 1])
        u, v = np.clip(local[:, 0] - column, 0, 1), np.clip(local[:, 1] - row, 0, 1)
        d = surface.displacements[corners].astype(np.float64)
        z = (1 - v) * ((1 - u) * d[0] + u * d[1]) + v * ((1 - u) * d[2] + u * d[3])
        gap = lengths_of((local - np.stack([column + u, row + v, z], axis=1)) * lengths)
        best = np.minimum(best, np.where(opaque[corners].all(axis=0), gap, np.inf))
    return best


def _to_nodes(surface, patch, points) -> NDArray:
    """Return the distances (n,) of points to the nearest opaque node of their patch; inf where it has none."""
    begins, counts = surface.node_offset[patch], np.diff(surface.node_offset)[patch]
    row = np.repeat(np.arange(len(patch)), counts)
    local = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    node, m = begins[row] + local, surface.size[patch[row], 0]
    place = (surface.origins[patch[row]].astype(np.float64) + (local % m)[:, None] * surface.axis_x[patch[row]]
             + (local // m)[:, None] * surface.axis_y[patch[row]]
             + surface.displacements[node, None] * surface.axis_z[patch[row]])
    gap = lengths_of(place - points[row])
    gap[~surface.opaque[node]] = np.inf
    return np.minimum.reduceat(gap, np.cumsum(counts) - counts) if len(patch) else np.zeros(0)
