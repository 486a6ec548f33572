"""Twins of the kernels of curvature and risk: plain NumPy, float64."""

import numpy as np

from clsurf.surface.slim import frame_of_normals

POWERS = [(d - j, j) for d in range(5) for j in range(d + 1)]  # u^i v^j, in the order of the surfels
SHEET_COSINE = 0.2


def ball(sorted_points, center, radius):
    """Return u, v, w over the radius and the weights of the points in the ball about a sorted point (6, n)."""
    x, n = sorted_points[:3].T, sorted_points[3:6].T
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    u, v = frame_of_normals(n[center])
    d = (x - x[center]) / radius
    d2 = (d * d).sum(axis=1)
    near = (d2 < 1) & (n @ n[center] >= SHEET_COSINE)
    d = d[near]
    return d @ u, d @ v, d @ n[center], (1 - d2[near]) ** 3


def heights(u, v, w, g, degree):
    """Return the coefficients (15,) of the weighted fit of `degree`; those of higher degree are 0."""
    terms = (degree + 1) * (degree + 2) // 2
    basis = np.stack([u**i * v**j for i, j in POWERS[:terms]], axis=1)
    root = np.sqrt(g)
    c = np.zeros(15)
    c[:terms] = np.linalg.lstsq(basis * root[:, None], w * root, rcond=None)[0]
    return c


def mean_curvature(c):
    g = 1 + c[1] ** 2 + c[2] ** 2
    return -((1 + c[2] ** 2) * c[3] - c[1] * c[2] * c[4] + (1 + c[1] ** 2) * c[5]) / g**1.5


def sample_fits(sorted_points, center, radius):
    """Points, mean curvature of degree 2 and 4, height of degree 2 and 4, squared residual of degree 3 (s, r, 6)."""
    out = np.zeros((*radius.shape, 6))
    for s, r in np.ndindex(radius.shape):
        u, v, w, g = ball(sorted_points, center[s], radius[s, r])
        two, three, four = (heights(u, v, w, g, degree) for degree in (2, 3, 4))
        residual = w - sum(c * u**i * v**j for c, (i, j) in zip(three, POWERS, strict=True))
        rho = radius[s, r]
        out[s, r] = (len(u), mean_curvature(two) / rho, mean_curvature(four) / rho, two[0] * rho, four[0] * rho,
                     (g * residual**2).sum() / g.sum() * rho**2)
    return out


def average_normals(sorted_points, reach):
    """Return normals (3, n) averaged over `reach` within each one's hemisphere."""
    x, n = sorted_points[:3].T, sorted_points[3:6].T
    out = np.zeros_like(n)
    for i in range(len(x)):
        g = np.maximum(1 - ((x - x[i]) ** 2).sum(axis=1) / reach**2, 0) * (n @ n[i] > 0)
        out[i] = g @ n
    return (out / np.linalg.norm(out, axis=1, keepdims=True)).T
