"""Where patches cover a surface, from their frames alone."""

import numpy as np
from scipy.spatial import cKDTree

from clsurf.models.lattice import GOLDEN


def directions(count):
    """Return `count` evenly spread unit vectors and, since gaps hide there, the poles and the date line."""
    i = np.arange(count)
    y = 1 - (2 * i + 1) / count
    turn = 2 * np.pi * (i * GOLDEN % 1)
    r = np.sqrt(1 - y * y)
    spread = np.stack([r * np.sin(turn), y, r * np.cos(turn)], axis=1)
    lat = np.linspace(-np.pi / 2, np.pi / 2, 2001)
    line = np.stack([0 * lat, np.sin(lat), -np.cos(lat)], axis=1)
    return np.concatenate([spread, line])


def margin(surface, points):
    """Return how many nodes deep each point (n, 3) lies inside the best of the patches that it projects into."""
    centers = surface.origins + ((surface.size[:, :1] - 1) * surface.axis_x + (surface.size[:, 1:] - 1)
                                 * surface.axis_y) / 2.0
    x, y = surface.axis_x.astype(np.float64), surface.axis_y.astype(np.float64)
    near = cKDTree(centers).query(points, 12)[1]
    offset = points[:, None] - centers[near]
    i = np.einsum("nka,nka->nk", offset, x[near]) / (x ** 2).sum(axis=1)[near]
    j = np.einsum("nka,nka->nk", offset, y[near]) / (y ** 2).sum(axis=1)[near]
    half = (surface.size[near] - 1) / 2
    return np.minimum(half[..., 0] - np.abs(i), half[..., 1] - np.abs(j)).max(axis=1)
