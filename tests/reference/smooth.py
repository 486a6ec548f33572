"""Plain float64 twins of the kernels that smooth (kernels/analysis), one face, surfel or point at a time."""

import numpy as np

from clsurf.surface.slim import frame_of_normals


def guided_planes(vertices, faces):
    """Rows (f, 8): unit normal, area, centroid, 0."""
    v = np.asarray(vertices, float)[faces]
    cross = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    return np.hstack([cross / np.where(length > 0, length, 1), length / 2, v.mean(axis=1), np.zeros((len(v), 1))])


def guided_normals(rows, faces, width2, sharp):
    """Filtered unit normals (f, 3): a mean over the corners' faces, by area, distance and angle."""
    out = np.empty((len(faces), 3))
    for f, corners in enumerate(faces):
        total = np.zeros(3)
        for corner in corners:
            for g in np.flatnonzero((faces == corner).any(axis=1)):
                away = np.sum((rows[g, 4:7] - rows[f, 4:7]) ** 2) / width2
                turn = sharp * (1 - rows[g, :3] @ rows[f, :3])
                total += rows[g, 3] * max(1 - (away + turn) / 8, 0) ** 8 * rows[g, :3]
        out[f] = total / np.linalg.norm(total)
    return out


def weight(share2, turn, sharp):
    """(1 - d^2/r^2)^3 times about exp(-sharp (1 - cosine))."""
    return np.maximum(1 - share2, 0) ** 3 * np.maximum(1 - sharp / 8 * turn, 0) ** 8


def guided_fits(points, normals, weights, center, radius, sharp):
    """Coefficients (6,), effective points and mean squared residual of one surfel."""
    n = normals[center]
    u, v = (a[0] for a in frame_of_normals(n[None]))
    away = points - points[center]
    g = weights * weight((away * away).sum(axis=1) / radius**2, 1 - normals @ n, sharp)
    a, b, w = away @ u / radius, away @ v / radius, away @ n / radius
    terms = np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], axis=1)
    count = g.sum() ** 2 / (g * g).sum()
    used = 6 if count >= 8 else 3 if count >= 3.5 else 1
    c = np.zeros(6)
    root = np.sqrt(g)[:, None]
    c[:used] = np.linalg.lstsq(root * terms[:, :used], root[:, 0] * w, rcond=None)[0]
    residual2 = (g * (w - terms @ c) ** 2).sum() / g.sum() * radius**2
    return c * np.array([radius, 1, 1, 1 / radius, 1 / radius, 1 / radius]), count, residual2


def guided_blend(point, normal, surfels, sharp):
    """Offset, unit normal (3,) and effective points of the blend of surfels (m, 16) at one point."""
    total = f = points = 0.0
    slope = np.zeros(3)
    for s in np.asarray(surfels, float):
        center, radius, n, c = s[:3], s[3], s[4:7], s[7:13]
        u, v = (a[0] for a in frame_of_normals(n[None]))
        d = point - center
        g = weight(d @ d / radius**2, 1 - normal @ n, sharp) * s[13]
        a, b = d @ u, d @ v
        f += g * (d @ n - (c[0] + c[1] * a + c[2] * b + c[3] * a * a + c[4] * a * b + c[5] * b * b))
        slope += g * (n - (c[1] + 2 * c[3] * a + c[4] * b) * u - (c[2] + c[4] * a + 2 * c[5] * b) * v)
        total, points = total + g, points + g * s[13]
    length = np.linalg.norm(slope)
    return f / length, slope / length, points / total


def ring_means(values, lists):
    """Means (n, c) over each point, counted twice, and the points of its list."""
    return np.stack([(2 * values[i] + values[near].sum(axis=0)) / (2 + len(near)) for i, near in enumerate(lists)])


def move_vertices(vertices, faces, wanted, kind, relax):
    """One step of vertices toward the wanted normals (f, 3) of faces."""
    v = np.asarray(vertices, float)
    out = v.copy()
    own = guided_planes(v, faces)[:, :3]
    for i in range(len(v)):
        mine = np.flatnonzero((faces == i).any(axis=1))
        if not len(mine) or not kind[i]:
            continue
        away = v[faces[mine]].mean(axis=1) - v[i]
        n = wanted[mine]
        out[i] += ((away * n).sum(axis=1)[:, None] * n).mean(axis=0)
        if kind[i] == 3 and ((own[mine] * n).sum(axis=1) < 0.5).any():
            axis = n.sum(axis=0) / np.linalg.norm(n.sum(axis=0))
            out[i] += relax * (away.mean(axis=0) - away.mean(axis=0) @ axis * axis)
    return out


def place_vertices(vertices, faces, normals, points, stay=0.02):
    """Vertices nearest to the planes of their faces through `points` (f, 3), and a little to where they were."""
    out = np.asarray(vertices, float).copy()
    for i in range(len(out)):
        mine = np.flatnonzero((faces == i).any(axis=1))
        n = normals[mine]
        rows = np.vstack([n, np.sqrt(stay * len(mine)) * np.eye(3)])
        right = np.concatenate([((points[mine] - out[i]) * n).sum(axis=1), np.zeros(3)])
        out[i] += np.linalg.lstsq(rows, right, rcond=None)[0]
    return out
