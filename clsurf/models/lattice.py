"""Quasi-uniform points on parametric surfaces: a golden-ratio lattice pressed into shape by the surface's area."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import lengths_of

GOLDEN = (5 ** 0.5 - 1) / 2
_GRID = 129  # samples a side of the area density
_STEP = 1e-6  # of the parameter range; central differences in float64 are then good to 1e-9


def points_on(surface: Callable, count: int,
              density: NDArray | None = None) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Spread `count` points evenly over the surface and return them with exact normals.

    Parameters
    ----------
    surface : callable
        Maps s, t (both (n,) float64 in [0, 1]) to positions (n, 3); smooth, and defined a little beyond the square.
    count : int
    density : NDArray, optional
        `area_density` of the surface, where it is at hand.

    Returns
    -------
    points, normals : (count, 3) float64
        The normals point along d/ds x d/dt.
    s, t : (count,) float64
        Parameters of the points.

    Notes
    -----
    The lattice (i + 1/2) / n, frac(i g), g the golden ratio, is even in the unit square at any ratio of the sides; the
    inverse of the cumulated area, first along s, then along t for that s, carries it to the surface.
    """
    i = np.arange(count)
    a, b = (i + 0.5) / count, (i * GOLDEN + 0.5) % 1
    s, t = _area_to_parameters(area_density(surface) if density is None else density, a, b)
    points = surface(s, t)
    normals = np.cross(_derivative(surface, s, t, 0), _derivative(surface, s, t, 1))
    normals /= lengths_of(normals, keepdims=True)
    return points, normals, s, t


def area_density(surface: Callable) -> NDArray:
    """Return the area per unit of s and t at the middles of a grid, (grid, grid) float64; its mean is the area."""
    middles = (np.arange(_GRID) + 0.5) / _GRID
    s, t = (m.ravel() for m in np.meshgrid(middles, middles, indexing="ij"))
    area = np.cross(_derivative(surface, s, t, 0), _derivative(surface, s, t, 1))
    return lengths_of(area).reshape(_GRID, _GRID)


def _area_to_parameters(density: NDArray, a: NDArray, b: NDArray) -> tuple[NDArray, NDArray]:
    edges = np.arange(_GRID + 1) / _GRID
    rows = np.append(0, np.cumsum(density.sum(axis=1)))
    s = np.interp(a, rows / rows[-1], edges)
    along = np.concatenate([np.zeros((_GRID, 1)), np.cumsum(density, axis=1)], axis=1)
    along /= along[:, -1:]
    inverse = np.stack([np.interp(edges, row, edges) for row in along])
    x = np.clip(s * _GRID - 0.5, 0, _GRID - 1.000001)
    y = np.clip(b * _GRID, 0, _GRID - 1e-6)
    k, j = x.astype(int), y.astype(int)
    fx, fy = x - k, y - j
    low = inverse[k, j] * (1 - fy) + inverse[k, j + 1] * fy
    high = inverse[k + 1, j] * (1 - fy) + inverse[k + 1, j + 1] * fy
    return s, low * (1 - fx) + high * fx


def _derivative(surface: Callable, s: NDArray, t: NDArray, axis: int) -> NDArray:
    ds, dt = (_STEP, 0) if axis == 0 else (0, _STEP)
    return (surface(s + ds, t + dt) - surface(s - ds, t - dt)) / (2 * _STEP)
