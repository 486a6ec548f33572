"""Geospheres: subdivided icosahedra as ten square grids of directions."""

import functools

import numpy as np
from numpy.typing import NDArray

from .arrays import lengths_of


@functools.lru_cache(maxsize=4)
def geosphere_directions(steps: int) -> NDArray:
    """Return unit directions (10, steps + 1, steps + 1, 3) float64: 20 steps^2 triangles.

    Each grid is two triangles of an icosahedron, ABC and DCB with A at (0, 0), B at (0, steps), C at (steps, 0); cells
    are cut along B C. Grids share the nodes of their borders. A to B to C runs clockwise seen from outside, as rows and
    columns of the cube's faces do.
    """
    ring = np.arange(5) * 2 * np.pi / 5
    z, r = 1 / np.sqrt(5), 2 / np.sqrt(5)
    north, south = np.array([0.0, 0, 1]), np.array([0.0, 0, -1])
    upper = np.stack([r * np.cos(ring), r * np.sin(ring), np.full(5, z)], axis=1)
    lower = np.stack([r * np.cos(ring + np.pi / 5), r * np.sin(ring + np.pi / 5), np.full(5, -z)], axis=1)
    grids = []
    for k in range(5):
        n = (k + 1) % 5
        grids.append((north, upper[n], upper[k], lower[k]))
        grids.append((upper[n], lower[n], lower[k], south))
    i, j = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1), indexing="ij")
    first = (i + j <= steps)[..., None]
    i, j = i[..., None] / steps, j[..., None] / steps
    out = np.stack([np.where(first, a * (1 - i - j) + b * j + c * i, d * (i + j - 1) + b * (1 - i) + c * (1 - j))
                    for a, b, c, d in grids])
    out /= lengths_of(out, keepdims=True)
    out.flags.writeable = False
    return out
