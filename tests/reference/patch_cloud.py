"""Plain float64 twins of the kernels that turn points into patches: slow, obvious, and the specification.

Points are (n, 3), in the coordinates of the kernels' sorted points.
"""

import numpy as np

from clsurf.surface.slim import frame_of_normals

FACING_NODE, FACING_VIEW, RIDGE = 0.2, 0.25, 1e-3


def assign_regions(points, normals, seeds, flatness, bend):
    """Return the costs (n, s) of every seed (s, 6) for every point."""
    d = points[:, None] - seeds[None, :, :3]
    off = np.einsum("nsk,sk->ns", d, seeds[:, 3:6])
    facing = normals @ seeds[:, 3:6].T
    return np.einsum("nsk,nsk->ns", d, d) + flatness * off**2 + bend * (1 - facing)


def region_extents(points, frame):
    """Return (5, 16) of the points of one region, frame (6,): low u, high u, low v, high v; heights in the last row."""
    x, y = frame_of_normals(frame[None, 3:6])
    d = points - frame[:3]
    a, b, w = d @ x[0], d @ y[0], d @ frame[3:6]
    out = np.zeros((5, 16))
    for k in range(16):
        c, s = np.cos(k * np.pi / 32), np.sin(k * np.pi / 32)
        u, v = c * a + s * b, c * b - s * a
        out[:4, k] = u.min(), u.max(), v.min(), v.max()
    out[4, :2] = w.min(), w.max()
    return out


def fit_patch_nodes(points, normals, regions, light, frame, patch, columns, rows, spacing):
    """Return (8, rows, columns) of one patch: height, squared distances of node and cell, known, light.

    Parameters
    ----------
    regions : (3, n) int
    frame : (18,)
    """
    reach, widen, tolerance, slack = frame[14:18]
    d = points - frame[:3]
    u, v, w = d @ frame[3:6], d @ frame[6:9], d @ frame[9:12]
    facing = normals @ frame[9:12]
    usable = facing > FACING_NODE
    slope_u, slope_v = -(normals @ frame[3:6]) / facing, -(normals @ frame[6:9]) / facing
    own = usable & (regions[0] == patch)
    near_own = usable & (regions == patch).any(axis=0)
    out = np.zeros((8, rows, columns))
    out[1:3] = np.inf
    for j in range(rows):
        for i in range(columns):
            du, dv = u - i * spacing, v - j * spacing
            weight = np.clip(1 - (du**2 + dv**2) / reach**2, 0, None) ** 4
            g = weight * near_own
            if not (own & (np.maximum(np.abs(du), np.abs(dv)) <= spacing + widen)).any() or g.sum() == 0:
                continue
            h = (g * (w - slope_u * du - slope_v * dv))[near_own].sum() / g.sum()
            su, sv = (g * slope_u)[near_own].sum() / g.sum(), (g * slope_v)[near_own].sum() / g.sum()
            t2 = (du**2 + dv**2) / reach**2
            r = w - h - su * du - sv * dv
            sheet = usable & (t2 < 1) & (np.abs(r) <= tolerance + slack * t2)
            if not (weight * sheet).sum() > 0:
                continue
            x, y, r, g = du[sheet] / reach, dv[sheet] / reach, r[sheet], weight[sheet] / weight[sheet].sum()
            mx, my, mr = (g * x).sum(), (g * y).sum(), (g * r).sum()
            matrix = np.array([[(g * (x - mx) ** 2).sum() + RIDGE, (g * (x - mx) * (y - my)).sum()],
                               [(g * (x - mx) * (y - my)).sum(), (g * (y - my) ** 2).sum() + RIDGE]])
            gx, gy = np.linalg.solve(matrix, [(g * (x - mx) * (r - mr)).sum(), (g * (y - my) * (r - mr)).sum()])
            fitted, fit_u, fit_v = h + mr - gx * mx - gy * my, su + gx / reach, sv + gy / reach
            rise = w[sheet] - fitted
            half = spacing / 2
            out[0, j, i] = fitted
            out[1, j, i] = (du[sheet] ** 2 + dv[sheet] ** 2 + rise**2).min()
            out[2, j, i] = ((du[sheet] - half) ** 2 + (dv[sheet] - half) ** 2
                            + (rise - half * (fit_u + fit_v)) ** 2).min()
            out[3, j, i] = 1
            narrow = weight[sheet] ** 3
            out[4:, j, i] = (light[:, sheet] * narrow).sum(axis=1) / narrow.sum()
    return out


def pixels(points, view, step):
    """Return column, row and height over the corner (n,) each of points in a view (12,)."""
    d = points - view[:3]
    return (np.floor(d @ view[3:6] / step + 0.5).astype(int), np.floor(d @ view[6:9] / step + 0.5).astype(int),
            d @ view[9:12])


def splat_depths(points, normals, view, step, columns, rows):
    """Return the largest height (rows, columns) of each pixel, -inf where there is none."""
    i, j, height = pixels(points, view, step)
    out = np.full((rows, columns), -np.inf)
    for k in np.flatnonzero(normals @ view[9:12] >= FACING_VIEW):
        if 0 <= i[k] < columns and 0 <= j[k] < rows:
            out[j[k], i[k]] = max(out[j[k], i[k]], height[k])
    return out


def splat_means(points, normals, light, view, step, front, thickness):
    """Return the sums (7, rows, columns): points, height over the front, facing, light."""
    i, j, height = pixels(points, view, step)
    facing = normals @ view[9:12]
    out = np.zeros((7, *front.shape))
    for k in np.flatnonzero(facing >= FACING_VIEW):
        if not (0 <= i[k] < front.shape[1] and 0 <= j[k] < front.shape[0]):
            continue
        if height[k] < front[j[k], i[k]] - thickness:
            continue
        d = points[k] - view[:3]
        du, dv = i[k] * step - d @ view[3:6], j[k] * step - d @ view[6:9]
        rise = -((normals[k] @ view[3:6]) * du + (normals[k] @ view[6:9]) * dv) / facing[k]
        rise = np.clip(rise, -thickness, thickness)
        out[:, j[k], i[k]] += 1, height[k] + rise - front[j[k], i[k]], facing[k], *light[:, k]
    return out
