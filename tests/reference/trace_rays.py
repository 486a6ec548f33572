"""Plain float64 twins of the kernels of single rays: every ray against everything, no tree."""

import numpy as np

from clsurf.surface.slim import frame_of_normals

from .render import (
    ALPHA,
    BACK_BIAS,
    K0,
    K6,
    SUPPORT,
    TRIES,
    height,
    inside_footprint,
    ray_poly,
    ray_root,
)


def unit(vectors):
    """Vectors (..., 3) of length 1."""
    vectors = np.asarray(vectors, np.float64)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def ray_triangles(vertices, faces, origin, direction):
    """Distances of one ray's hits, ascending, and their faces; an edge that is met exactly counts for both faces."""
    corners = np.asarray(vertices, np.float64)[faces]
    d = unit(direction)
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    with np.errstate(all="ignore"):
        p = np.cross(d, f)
        inverse = 1 / (e * p).sum(axis=1)
        s = origin - corners[:, 0]
        u = (s * p).sum(axis=1) * inverse
        q = np.cross(s, e)
        v = q @ d * inverse
        t = (f * q).sum(axis=1) * inverse
        good = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & np.isfinite(t)
    found = np.flatnonzero(good)
    found = found[np.argsort(t[found], kind="stable")]
    return t[found], found


class Leaves:
    """The leaves of a surface: positions, frames and coefficients in float64."""

    def __init__(self, surface):
        self.index = np.flatnonzero(surface.leaf) if surface.leaf.any() else np.arange(len(surface))
        at, self.degree, self.oriented = self.index, surface.degree, surface.oriented
        self.centers = surface.centers[at].astype(np.float64) + surface.origin
        self.radii = surface.radii[at].astype(np.float64)
        n = surface.normals[at].astype(np.float64)
        self.axes = np.stack([*frame_of_normals(n), n], axis=1)  # (n, 3 axes, 3)
        k = surface.coefficients[at].astype(np.float64)
        k = k * self.radii[:, None] ** (np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])[:k.shape[1]] - 1)
        if k.shape[1] > 1:
            k[:, 4] /= 2
        self.k = np.zeros((len(at), 32))
        self.k[:, K0:K0 + min(k.shape[1], 6)] = k[:, :6]
        self.k[:, K6:K6 + max(k.shape[1] - 6, 0)] = k[:, 6:]
        self.footprint = np.full((len(at), 8), 255) if surface.footprint is None else surface.footprint[at]


def ray_slim(leaves, origin, direction):
    """Distance, normal, surfel and side of one ray's closest hit by the renderer's rules; inf: none."""
    d = unit(direction)
    local = lambda p: np.einsum("nax,nx->na", leaves.axes, p) / leaves.radii[:, None]  # noqa: E731
    offset = leaves.centers - origin
    t = offset @ d
    p, e = local(t[:, None] * d - offset), np.einsum("nax,x->na", leaves.axes, d)
    keys, roots = [], []
    with np.errstate(all="ignore"):
        for side in (1, -1):
            s, _, good = ray_root(leaves.degree, ray_poly(leaves.degree, leaves.k, p, e), side)
            at, root = p + s[:, None] * e, t + s * leaves.radii
            good = good & ((at**2).sum(axis=1) < ALPHA**2) & inside_footprint(leaves.footprint, at)
            roots.append(np.where(good, root, np.inf))
            keys.append(roots[-1] + (BACK_BIAS * leaves.radii if side < 0 and leaves.oriented else 0))
    low, best = 0.0, (np.inf, np.full(3, np.nan), -1, 0)
    for _ in range(TRIES):
        reachable = np.where(np.stack(roots) > low, np.stack(keys), np.inf)
        which, surfel = np.unravel_index(np.argmin(reachable), reachable.shape)
        if not np.isfinite(reachable[which, surfel]):
            break
        side, hit = (1, -1)[which], roots[which][surfel]
        weight, step, normal = blend(leaves, origin + hit * d, e, side)
        if weight > 0:
            best = hit + step, normal, int(leaves.index[surfel]), side
        if weight >= SUPPORT:
            break
        low = hit
    return best


def blend(leaves, q, e, side):
    """Weight, step along the ray and normal of the surfels around q; e (n, 3) is the ray in their frames."""
    p = np.einsum("nax,nx->na", leaves.axes, q - leaves.centers) / leaves.radii[:, None]
    inside = (p**2).sum(axis=1) < 1
    with np.errstate(all="ignore"):
        poly = ray_poly(leaves.degree, leaves.k, p, e)
        sides = np.full(len(p), side) if leaves.oriented else np.where(poly[1] < 0, 1, -1)
        s, _, good = ray_root(leaves.degree, poly, sides)
        s = np.where(inside & good, s, 0)
        p = p + s[:, None] * e
        g = 1 - (p**2).sum(axis=1)
        weight = np.where(inside & good & (g > 0), g**3, 0)
    _, gu, gv = height(leaves.degree, leaves.k, p[:, 0], p[:, 1])
    gradient = leaves.axes[:, 2] - gu[:, None] * leaves.axes[:, 0] - gv[:, None] * leaves.axes[:, 1]
    total = weight.sum()
    if not total > 0:
        return 0.0, 0.0, np.full(3, np.nan)
    return total, (weight * s * leaves.radii).sum() / total, unit((weight * sides) @ gradient)


# Grids ---------------------------------------------------------------------------------------------------------------


def on_grid(grid, width, perspective, tolerance, origins, directions):
    """Whether each ray lies on the grid (4, 3) of clsurf/trace/grids.py; origins and directions (n, 3) or (1, 3)."""
    start, corner, right, down = np.asarray(grid, float)
    count = max(len(origins), len(directions))
    number = np.arange(count)
    at = corner + (number % width)[:, None] * right + (number // width)[:, None] * down
    toward = at if perspective else np.broadcast_to(start, at.shape)
    d = np.broadcast_to(directions, at.shape)
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    along = (d * toward).sum(axis=1)
    beside = np.linalg.norm(toward - along[:, None] * d, axis=1)
    if perspective:
        same = (np.broadcast_to(origins, at.shape) == start).all(axis=1)
        return same & (beside <= tolerance) & (along > 0)
    apart = np.linalg.norm(origins - at, axis=1)
    return (np.hypot(apart, beside * tolerance * 1e9) <= tolerance) & (along > 0)


def grid_hits(width, count, view, touched, planes, order, inverse_unit):
    """Hits (count, 8) of single rays from the planes (bins, 5, 64) of a picture; `view`: kernels/common/view.clh."""
    bins_x = -(-width // 8)
    hits = np.zeros((count, 8))
    hits[:, 0], hits[:, 4] = np.inf, -1
    turn, fx, fy, cx, cy = np.reshape(view[:9], (3, 3)), *view[13:17]
    for i in range(count):
        x, y = i % width, i // width
        bin_, pixel = y // 8 * bins_x + x // 8, y % 8 * 8 + x % 8
        depth = planes[bin_, 0, pixel]
        if touched[bin_] < 0 or not depth < np.inf:
            continue
        ray = np.array([(x + 0.5 - cx) / fx, (cy - y - 0.5) / fy, -1.0]) if view[17] else np.array([0, 0, -1.0])
        hits[i, 0] = depth * np.linalg.norm(ray) / view[9] * inverse_unit
        hits[i, 1:4] = turn.T @ planes[bin_, 1:4, pixel]
        hits[i, 4] = order[planes[bin_, 4, pixel].astype(int)]
    return hits
