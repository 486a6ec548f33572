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
    """Return normals (3, n) averaged over `reach`, within each one's hemisphere where they disagree as a whole."""
    x, n = sorted_points[:3].T, sorted_points[3:6].T
    out = np.zeros_like(n)
    for i in range(len(x)):
        g = np.maximum(1 - ((x - x[i]) ** 2).sum(axis=1) / reach**2, 0)
        agree = np.linalg.norm(g @ n) > 0.5 * g.sum()
        out[i] = (g if agree else g * (n @ n[i] > 0)) @ n
    return (out / np.linalg.norm(out, axis=1, keepdims=True)).T


def fit_quartics(sorted_points, center, radius):
    """Return the coefficients (15,) of a surfel of degree 4 in units of its radius."""
    return heights(*ball(sorted_points, center, radius), 4)


def point_curvature(q, n, records, steps):
    """Return the curvature at q (3,) of the surfels `records` (m, 32), as far as they face n (3,), after `steps`."""
    for step in range(steps + 1):
        weight = f = 0
        gradient, hessian = np.zeros(3), np.zeros((3, 3))
        for o in records[np.linalg.norm(records[:, :3] - q, axis=1) < records[:, 3]]:
            d = (q - o[:3]) / o[3]
            g = max(1 - d @ d, 0) ** 3 * max(n @ o[4:7], 0) ** 2
            u, v = d @ o[7:10], d @ o[10:13]
            dh = {(a, b): sum(c * _falling(i, a) * _falling(j, b) * u ** max(i - a, 0) * v ** max(j - b, 0)
                              for c, (i, j) in zip(o[13:28], POWERS, strict=True))
                  for a, b in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))}
            axes = o[7:13].reshape(2, 3)
            weight += g
            f += g * o[3] * (d @ o[4:7] - dh[0, 0])
            gradient += g * (o[4:7] - dh[1, 0] * axes[0] - dh[0, 1] * axes[1])
            form = np.array([[dh[2, 0], dh[1, 1]], [dh[1, 1], dh[0, 2]]])
            hessian -= g / o[3] * (axes.T @ form @ axes)
        if step < steps:
            q, n = q - f * gradient / (gradient @ gradient), gradient / np.linalg.norm(gradient)
    length = np.linalg.norm(gradient)
    normal = gradient / length
    along = np.eye(3) - np.outer(normal, normal)
    values, vectors = np.linalg.eigh(along @ hessian @ along / length)
    skip = np.argmax(np.abs(vectors.T @ normal))
    k2, k1 = np.delete(values, skip)
    direction = np.delete(vectors, skip, axis=1)[:, 1]
    return {"position": q, "normal": normal, "mean": (k1 + k2) / 2, "gaussian": k1 * k2, "k1": k1, "k2": k2,
            "direction1": direction}


def _falling(i, a):
    """i (i - 1) ... (i - a + 1)."""
    return float(np.prod([i - k for k in range(a)]))
