"""Plain float64 twins of the point renderer's kernels: slow, obvious, the specification."""

import numpy as np

from .render import in_view, opened

BULGE, EDGE_ON, NEIGHBOUR, TINY_PX = 0.3, 0.1, 6, 0.75


def point_spacing(points, runs):
    """Distance to the 6th nearest other place for 16 of 256 points (n, 3) of each run, in it and beside it."""
    out = np.empty((runs, 16))
    for run in range(runs):
        near = points[max(run - 1, 0) * 256:(run + 2) * 256]
        d = np.linalg.norm(points[run * 256:run * 256 + 16, None] - near[None], axis=2)
        out[run] = np.sort(np.where(d > 0, d, np.inf), axis=1)[:, NEIGHBOUR - 1]
    return out


def disc_samples(view, centers, radii, normals, pixels):
    """Keys and depths (p, n) of discs at pixels (p, 2), inf where they are not; `normals` None: across the view."""
    v = opened(view)
    c = in_view(view, centers)
    z, radius = -c[:, 2], v.scale * np.asarray(radii, np.float64)
    x = (pixels[:, None, 0] - v.cx) / v.fx
    y = (v.cy - pixels[:, None, 1]) / v.fy
    near = max(v.near, 0) if v.perspective else v.near
    with np.errstate(all="ignore"):
        middle = (c[:, :2] / z[:, None] if v.perspective else c[:, :2]) * (v.fx, -v.fy) + (v.cx, v.cy)
        n = np.tile((0.0, 0.0, 1.0), (len(c), 1)) if normals is None else normals.astype(np.float64) @ v.rotation.T
        toward = -c / z[:, None] if v.perspective else np.tile((0.0, 0.0, 1.0), (len(c), 1))
        along = (n * toward).sum(1)
        length = np.linalg.norm(n, axis=1)
        if normals is not None:  # no flatter than EDGE_ON
            limit = np.where(along < 0, -1, 1) * EDGE_ON * length
            along = np.where(np.abs(along) < EDGE_ON * length, limit, along)
        # On the ray of a pixel, less that of the middle by (a, b), the plane is at z / (1 - (nx a + ny b) / along).
        a, b = (x - c[:, 0] / z, y - c[:, 1] / z) if v.perspective else (x - c[:, 0], y - c[:, 1])
        m = -(n[:, 0] * a + n[:, 1] * b) / along
        depth = z / np.maximum(1 + m, 0.1) if v.perspective else z - m
        point = np.stack(np.broadcast_arrays(x * depth, y * depth, -depth) if v.perspective
                         else np.broadcast_arrays(x, y, -depth), axis=-1)
        away = ((point - c) ** 2).sum(-1) / radius ** 2
        depth = np.clip(depth, z - radius, z + radius)
        across = radius * v.fx / (z if v.perspective else 1)
        inside = (away <= 1) | ((across < TINY_PX) & (np.floor(middle) == np.floor(pixels[:, None])).all(-1))
        inside &= (z > near) & (depth > near)
    key = depth + BULGE * radius * np.minimum(away, 4)
    if normals is None:
        depth = key
    return np.where(inside, key, np.inf), np.where(inside, depth, np.inf)


def tile_points(view, centers, radii, normals, pixels):
    """Depth (p,) of the disc that wins at pixels (p, 2), inf for nothing, and its number (p,), -1 for none."""
    key, depth = disc_samples(view, centers, radii, normals, pixels)
    best = key.argmin(axis=1)
    found = depth[np.arange(len(pixels)), best]
    return found, np.where(np.isfinite(found), best, -1)


def eye_dome(depth, steps, strength, reference):
    """What is kept of the colours of pixels whose depth (h, w) is finite."""
    rim = int(np.abs(steps).max())
    wide = np.pad(depth, rim, constant_values=np.inf)
    h, w = depth.shape
    total = np.zeros((h, w))
    with np.errstate(invalid="ignore"):
        for dx, dy in steps:
            total += np.maximum(depth - wide[rim + dy:rim + dy + h, rim + dx:rim + dx + w], 0)
        return np.exp(-strength * total / len(steps) / (reference or depth))
