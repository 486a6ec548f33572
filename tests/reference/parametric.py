"""Exact curvature of parametric pieces of surfaces, float64: forms by differences of the parametrisation."""

import numpy as np
from scipy.spatial import cKDTree

STEP = 1e-3  # of eighth-order differences: far below the errors that tests look for


def sphere_piece(u, v):
    return np.stack([np.sin(u), np.sin(v) * np.cos(u), np.cos(v) * np.cos(u)], axis=-1)


def torus_piece(u, v):
    ring = 1 + 0.6 * np.sin(v + 0.5)
    return np.stack([ring * np.cos(u), ring * np.sin(u), 0.6 * np.cos(v + 0.5)], axis=-1)


def ellipsoid_piece(u, v):
    return sphere_piece(u, v) * (1.5, 0.8, 1.1)


def catenoid_piece(u, v):
    return np.stack([-np.cosh(v) * np.cos(u), np.cosh(v) * np.sin(u), v], axis=-1)


def enneper_piece(u, v):
    return np.stack([u - u**3 / 3 + u * v * v, v - v**3 / 3 + v * u * u, u * u - v * v], axis=-1)


PIECES = {piece.__name__.removesuffix("_piece"): piece for piece in
          (sphere_piece, torus_piece, ellipsoid_piece, catenoid_piece, enneper_piece)}


def difference(function, u, v, du, dv):
    """Derivative of function(u, v) along (du, dv), eighth order."""
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    return sum(w * (function(u + i * STEP * du, v + i * STEP * dv) - function(u - i * STEP * du, v - i * STEP * dv))
               for i, w in weights.items()) / STEP


def tangents(piece, u, v):
    """r_u and r_v (..., 3)."""
    return difference(piece, u, v, 1, 0), difference(piece, u, v, 0, 1)


def normal(piece, u, v):
    n = np.cross(*tangents(piece, u, v))
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def forms(piece, u, v):
    """First and second fundamental forms (..., 2, 2); a sphere about the origin with outward normals has +1/R."""
    r = np.stack(tangents(piece, u, v), axis=-2)
    n = np.stack([difference(lambda a, b: normal(piece, a, b), u, v, *d) for d in ((1, 0), (0, 1))], axis=-2)
    second = np.einsum("...ai,...bi->...ab", r, n)
    return np.einsum("...ai,...bi->...ab", r, r), (second + np.swapaxes(second, -1, -2)) / 2


def principal(piece, u, v):
    """k1 >= k2 (..., 2) and their directions (..., 2, 2) in (u, v), of unit length on the surface."""
    first, second = forms(piece, u, v)
    values, vectors = np.linalg.eig(np.linalg.solve(first, second))
    order = np.argsort(-values.real, axis=-1)
    values = np.take_along_axis(values.real, order, -1)
    vectors = np.take_along_axis(vectors.real, order[..., None, :], -1)
    length = np.sqrt(np.einsum("...ai,...ab,...bi->...i", vectors, first, vectors))
    return values, np.swapaxes(vectors / length[..., None, :], -1, -2)


def piece_points(piece, spacing, half=0.8, seed=0):
    """Points (n, 3) about `spacing` apart on the piece |u|, |v| < half, at random within their cells, and normals."""
    n = round(2 * half / spacing)
    u, v = np.meshgrid(*2 * [np.arange(n)], indexing="ij")
    u, v = (np.stack([u, v]) + np.random.default_rng(seed).uniform(0.2, 0.8, (2, n, n))).reshape(2, -1) / n
    u, v = (2 * u - 1) * half, (2 * v - 1) * half
    return piece(u, v), normal(piece, u, v)


def parameters(piece, points, half=0.8):
    """The (u, v) of the places on the piece nearest to points (n, 3)."""
    grid = np.linspace(-half, half, 80)
    u, v = (a.ravel() for a in np.meshgrid(grid, grid, indexing="ij"))
    near = cKDTree(piece(u, v)).query(points)[1]
    at = np.stack([u[near], v[near]], axis=1)
    for _ in range(8):
        r = np.stack(tangents(piece, *at.T), axis=-1)
        rest = np.einsum("nia,ni->na", r, points - piece(*at.T))
        at = at + np.linalg.solve(np.einsum("nia,nib->nab", r, r), rest[..., None])[..., 0]
    return at.T
