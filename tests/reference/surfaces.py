"""Analytic SLIM surfaces for tests: no builder needed."""

import numpy as np
from scipy.spatial import cKDTree

from clsurf.surface.slim import COEFFICIENTS, SlimSurface, frame_of_normals

POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


def sphere_points(n, radius=1.0):
    """Fibonacci points (n, 3) on a sphere about the origin, and their normals."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    return radius * normals, normals


def torus_points(n, major=1.0, minor=0.4, seed=0):
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(0, 2 * np.pi, (2, 4 * n))
    keep = rng.uniform(0, major + minor, 4 * n) < major + minor * np.cos(v)
    u, v = u[keep][:n], v[keep][:n]
    normals = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=1)
    ring = np.stack([np.cos(u), np.sin(u), np.zeros_like(u)], axis=1)
    return major * ring + minor * normals, normals


def plane_points(n, half=1.0):
    """A square grid of n x n points in the plane z = 0."""
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)
    return points, np.tile([0.0, 0.0, 1.0], (n * n, 1))


def fitted(points, normals, spacing, degree=2, reach=2.6, **more):
    """Weighted least-squares surfels of radius reach * spacing, centres about `spacing` apart; all are leaves."""
    tree = cKDTree(points)
    left, chosen = np.ones(len(points), bool), []
    for i in range(len(points)):
        if left[i]:
            chosen.append(i)
            left[tree.query_ball_point(points[i], spacing)] = False
    radius = reach * spacing
    n = normals[chosen].astype(np.float32)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    coefficients = []
    for c, u, v, w in zip(points[chosen], *frame_of_normals(n.astype(np.float64)), n, strict=True):
        d = points[tree.query_ball_point(c, radius)] - c
        a, b, height = d @ u, d @ v, d @ w
        g = np.sqrt(np.clip(1 - (d**2).sum(axis=1) / radius**2, 0, None) ** 3)
        m = np.stack([a**i * b**j for i, j in POWERS[:COEFFICIENTS[degree]]], axis=1)
        coefficients.append(np.linalg.lstsq(m * g[:, None], height * g, rcond=None)[0])
    return leaves(points[chosen], np.full(len(chosen), radius), n, np.array(coefficients), degree, **more)


def leaves(centers, radii, normals, coefficients, degree, **more):
    """A surface of leaves only."""
    n = len(centers)
    base = dict(level=np.ones(n), leaf=np.ones(n, bool), child_offset=np.zeros(n + 1), children=np.zeros(0),
                fit_error=np.zeros(n))
    return SlimSurface(degree=degree, error=0.01, centers=centers, radii=radii, normals=normals,
                       coefficients=coefficients, **(base | more))


def sphere(n=400, radius=1.0, reach=1.6, **more):
    """Quadratic surfels on a sphere by its Taylor polynomial: w = -(u^2 + v^2) / (2 R)."""
    points, normals = sphere_points(n, radius)
    spacing = radius * np.sqrt(4 * np.pi / n)
    k = np.zeros((n, 6))
    k[:, 3] = k[:, 5] = -0.5 / radius
    return leaves(points, np.full(n, reach * spacing), normals, k, 2, **more)


def two_level_sphere(coarse=60, fine=600, radius=1.0, error=0.0):
    """Internal surfels of level 1, each the parent of the leaves of level 2 inside its ball; most have two parents."""
    top, bottom = sphere(coarse, radius, 1.2), sphere(fine, radius, 1.6)
    inside = cKDTree(bottom.centers).query_ball_point(top.centers, top.radii[0])
    counts = [len(i) for i in inside]
    n = coarse + fine
    join = {name: np.concatenate([getattr(top, name), getattr(bottom, name)])
            for name in ("centers", "radii", "normals", "coefficients")}
    return SlimSurface(degree=2, error=0.01, **join, level=np.repeat([1, 2], [coarse, fine]),
                       leaf=np.arange(n) >= coarse,
                       child_offset=np.concatenate([[0], np.cumsum(counts), np.full(fine, sum(counts))]),
                       children=coarse + np.concatenate([np.sort(i) for i in inside]),
                       fit_error=np.where(np.arange(n) < coarse, error, 0))


def reordered(surface, order):
    """The same leaves in another order."""
    arrays = {name: getattr(surface, name)[order] for name in ("centers", "radii", "normals", "coefficients")}
    return leaves(arrays["centers"], arrays["radii"], arrays["normals"], arrays["coefficients"], surface.degree,
                  oriented=surface.oriented)
