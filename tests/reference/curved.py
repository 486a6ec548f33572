"""Surfaces of known curvature as points: positions, unit normals, mean and Gaussian curvature."""

import numpy as np

from clsurf.surface.cloud import PointCloud


def lattice(n):
    """Return n points (s, t) of the unit square on a rank-1 lattice: even, and without rows."""
    i = np.arange(n)
    return (i + 0.5) / n, i * (np.sqrt(5) - 1) / 2 % 1


def parametric(surface, s, t, step=1e-3):
    """Return positions, normals, H and K (outward along x_s x x_t) of `surface(s, t)` by its derivatives."""
    x = surface(s, t)
    d = lambda a, b: surface(s + a * step, t + b * step)  # noqa: E731
    xs, xt = (d(1, 0) - d(-1, 0)) / (2 * step), (d(0, 1) - d(0, -1)) / (2 * step)
    xss, xtt = (d(1, 0) - 2 * x + d(-1, 0)) / step**2, (d(0, 1) - 2 * x + d(0, -1)) / step**2
    xst = (d(1, 1) - d(1, -1) - d(-1, 1) + d(-1, -1)) / (4 * step**2)
    n = np.cross(xs, xt)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    dot = lambda a, b: np.einsum("ij,ij->i", a, b)  # noqa: E731
    e, f, g, p, m, q = dot(xs, xs), dot(xs, xt), dot(xt, xt), dot(xss, n), dot(xst, n), dot(xtt, n)
    area = e * g - f * f
    return x, n, -(e * q - 2 * f * m + g * p) / (2 * area), (p * q - m * m) / area


def torus(n, major=1.0, minor=0.4):
    """Exact H and K of a torus, points nearly even."""
    s, t = lattice(n)
    v = 2 * np.pi * s
    for _ in range(30):  # even area: v + (minor / major) sin v = 2 pi s
        v -= (v + minor / major * np.sin(v) - 2 * np.pi * s) / (1 + minor / major * np.cos(v))
    u, c = 2 * np.pi * t, np.cos(v)
    normals = np.stack([c * np.cos(u), c * np.sin(u), np.sin(v)], axis=1)
    points = minor * normals + major * np.stack([np.cos(u), np.sin(u), 0 * u], axis=1)
    ring = c / (major + minor * c)
    return points, normals, (1 / minor + ring) / 2, ring / minor


def sphere(n, radius=2.0):
    s, t = lattice(n)
    z, a = 1 - 2 * s, 2 * np.pi * t
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(a), np.sqrt(1 - z * z) * np.sin(a), z], axis=1)
    return radius * normals, normals, np.full(n, 1 / radius), np.full(n, 1 / radius**2)


def ellipsoid(n, axes=(1.0, 0.8, 0.6)):
    """H and K from the implicit form."""
    _, unit, _, _ = sphere(n)
    a2 = np.asarray(axes) ** 2
    x = unit * axes
    g = x / a2
    length = np.linalg.norm(g, axis=1)
    h = (length**2 * (1 / a2).sum() - (g * g / a2).sum(axis=1)) / (2 * length**3)
    k = 1 / (np.prod(a2) * length**4)
    return x, g / length[:, None], h, k


def catenoid(n, waist=0.5, height=0.6):
    """H is 0."""
    s, t = lattice(n)
    v, u = (2 * s - 1) * height / waist, 2 * np.pi * t
    points = waist * np.stack([np.cosh(v) * np.cos(u), np.cosh(v) * np.sin(u), v], axis=1)
    normals = np.stack([np.cos(u), np.sin(u), -np.sinh(v)], axis=1) / np.cosh(v)[:, None]
    return points, normals, np.zeros(n), -1 / (waist**2 * np.cosh(v) ** 4)


def enneper(n, size=0.7):
    """H is 0, K = -4 / (1 + u^2 + v^2)^4."""
    s, t = lattice(n)
    u, v = (2 * s - 1) * size, (2 * t - 1) * size
    points = np.stack([u - u**3 / 3 + u * v * v, -v + v**3 / 3 - u * u * v, u * u - v * v], axis=1)
    r = 1 + u * u + v * v
    normals = np.stack([2 * u, 2 * v, u * u + v * v - 1], axis=1) / r[:, None]
    return points, normals, np.zeros(n), -4 / r**4


def saddle(n, size=0.5):
    """The graph z = (x^2 - y^2) / 2, normals upward."""
    s, t = lattice(n)
    x, y = (2 * s - 1) * size, (2 * t - 1) * size
    return parametric(lambda x, y: np.stack([x, y, (x * x - y * y) / 2], axis=1), x, y)


def plane(n, size=0.5):
    s, t = lattice(n)
    points = np.stack([(2 * s - 1) * size, (2 * t - 1) * size, 0 * s], axis=1)
    return points, np.tile((0.0, 0.0, 1.0), (n, 1)), np.zeros(n), np.zeros(n)


def cloud_of(points, normals):
    return PointCloud(points, np.asarray(normals, np.float32))


def size_of(mean, gaussian):
    """Root mean square of the larger principal curvature's kind, to measure errors by where H vanishes."""
    return np.sqrt(np.mean(4 * mean**2 - 2 * gaussian)) or 1.0


def rotation(seed=0):
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return q * np.sign(np.linalg.det(q))
