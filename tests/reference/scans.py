"""Scans of analytic surfaces for tests: points and unit normals on jittered even grids."""

import numpy as np

from clsurf.surface.cloud import PointCloud


def torus(count, seed=0, tube=0.4):
    """Points and unit normals (n, 3) float64 of a torus of radius 1, about `count` on a jittered even grid."""
    rng = np.random.default_rng(seed)
    around = int(np.sqrt(count / tube))
    across = count // around
    a, b = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    a, b = ((g + rng.uniform(-0.2, 0.2, g.shape)).ravel() for g in (a, b))
    a, b = a * 2 * np.pi / around, b * 2 * np.pi / across
    n = np.stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)], axis=1)
    ring = np.stack([np.cos(a), np.sin(a), np.zeros_like(a)], axis=1)
    return ring + tube * n, n


def ellipsoid(count, seed=0):
    """Points and unit normals (n, 3) float64 of an ellipsoid of half axes 1, 0.7, 0.8, on a Fibonacci spiral."""
    i = np.arange(count) + 0.5 + 0.2 * np.random.default_rng(seed).uniform(-1, 1, count)
    z, angle = 1 - 2 * i / (count + 0.5), i * np.pi * (3 - np.sqrt(5))
    unit = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    axes = np.array([1, 0.7, 0.8])
    n = unit / axes
    return unit * axes, n / np.linalg.norm(n, axis=1, keepdims=True)


def cloud_of(shape, count):
    points, normals = shape(count)
    return PointCloud(points, normals=normals)
