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
