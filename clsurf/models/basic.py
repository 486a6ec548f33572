"""Simple shapes as oriented point clouds, evenly sampled, with exact normals."""

import numpy as np

from clsurf.errors import InputError
from clsurf.surface.cloud import PointCloud

from ..surface.arrays import lengths_of
from .lattice import GOLDEN, points_on


def sphere(n: int = 10_000, radius: float = 1.0) -> PointCloud:
    """Return `n` points of a sphere about the origin on a Fibonacci lattice."""
    _check(n, radius=radius)
    i = np.arange(n)
    z = 1 - (2 * i + 1) / n
    normals = _turned(np.sqrt(1 - z * z), z, i * GOLDEN % 1)
    return _cloud(normals * radius, normals)


def ellipsoid(n: int = 10_000, axes=(1.0, 0.75, 0.5)) -> PointCloud:
    """Return `n` points of the ellipsoid about the origin with the half `axes` along x, y, z."""
    axes = np.asarray(axes, np.float64)
    if axes.shape != (3,):
        raise InputError(f"axes: expected three half axes, got shape {axes.shape}")
    _check(n, axes=axes.min())

    def surface(s, t):
        z = np.clip(1 - 2 * s, -1, 1)
        return _turned(np.sqrt(1 - z * z), z, t) * axes

    points = points_on(surface, n)[0]
    normals = points / axes**2
    return _cloud(points, normals / lengths_of(normals, keepdims=True))


def torus(n: int = 10_000, major: float = 1.0, minor: float = 0.4) -> PointCloud:
    """Return `n` points of the torus about the z axis; `minor` is the radius of the tube."""
    _check(n, major=major, minor=minor, difference=major - minor)

    def surface(s, t):
        angle = 2 * np.pi * s
        return _turned(major + minor * np.cos(angle), minor * np.sin(angle), t)

    points, _, s, t = points_on(surface, n)
    normals = _turned(np.cos(2 * np.pi * s), np.sin(2 * np.pi * s), t)
    return _cloud(points, normals)


def disc(n: int = 10_000, radius: float = 1.0) -> PointCloud:
    """Return `n` points of the flat disc in the plane z = 0, normals along z, on a sunflower lattice."""
    _check(n, radius=radius)
    i = np.arange(n)
    points = _turned(radius * np.sqrt((i + 0.5) / n), np.zeros(n), i * GOLDEN % 1)
    return _cloud(points, np.tile((0.0, 0.0, 1.0), (n, 1)))


def cylinder(n: int = 10_000, radius: float = 0.5, height: float = 2.0) -> PointCloud:
    """Return `n` points of the open cylinder about the z axis, from z = -height / 2 to height / 2."""
    _check(n, radius=radius, height=height)
    i = np.arange(n)
    turn = i * GOLDEN % 1
    points = _turned(np.full(n, radius), ((i + 0.5) / n - 0.5) * height, turn)
    return _cloud(points, _turned(np.ones(n), np.zeros(n), turn))


def _turned(radius, z, turn):
    """Return (n, 3) positions from cylinder coordinates; `turn` is the angle in full turns."""
    angle = 2 * np.pi * np.asarray(turn)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z + 0 * angle], axis=1)


def _cloud(points, normals) -> PointCloud:
    return PointCloud(points, normals, origin=np.zeros(3))


def _check(n, **lengths) -> None:
    if n < 1:
        raise InputError(f"n: expected at least one point, got {n}")
    for name, value in lengths.items():
        if not value > 0 or not np.isfinite(value):
            raise InputError(f"{name}: expected a positive length, got {value}")
