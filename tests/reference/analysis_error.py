"""Twin of triangle_distances.cl in plain float64: every point against every triangle."""

import numpy as np


def triangle_distances(corners, points):
    """Distances (n,) of points to the nearest of triangles (f, 3, 3), region by region (Ericson 2005, 5.1.5)."""
    best = np.full(len(points), np.inf)
    for a, b, c in corners:
        for i, p in enumerate(points):
            best[i] = min(best[i], np.linalg.norm(p - nearest_on_triangle(p, a, b, c)))
    return best


def nearest_on_triangle(p, a, b, c):
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = ab @ ap, ac @ ap
    if d1 <= 0 and d2 <= 0:
        return a
    d3, d4 = ab @ (p - b), ac @ (p - b)
    if d3 >= 0 and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        return a + d1 / (d1 - d3) * ab
    d5, d6 = ab @ (p - c), ac @ (p - c)
    if d6 >= 0 and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        return a + d2 / (d2 - d6) * ac
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 >= d3 and d5 >= d6:
        return b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b)
    return a + (vb * ab + vc * ac) / (va + vb + vc)
