"""Nearest points of surfel hierarchies: on their base surfels, blended, or on the triangles of the hybrid form."""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import InputError
from ..surface.arrays import finite_rows, lengths_of
from ..surface.surfel import SurfelHierarchy
from .neighbours import nearest
from .triangles import barycentric_foot, nearest_triangles

NEIGHBOURS = 12  # base surfels that are blended
STEPS = 4  # onto the blend, each about a tenth of the way left by the one before
BATCH = 1 << 18  # points at a time


def project_surfels(surface: SurfelHierarchy, points: NDArray, device: Device) -> tuple[NDArray, NDArray, NDArray]:
    """Return position (n, 3), unit normal (n, 3) and signed distance (n,), float64, world, of the nearest places.

    Of base surfels: their planes, blended by (1 - t^2)^3 of the distance over the radius, which is what is drawn.
    """
    local = points - surface.origin
    out = np.empty((len(points), 7))
    for start in range(0, len(points), BATCH):
        part = local[start:start + BATCH]
        out[start:start + BATCH] = (on_triangles if surface.hybrid else on_discs)(surface, part, device)
    return out[:, :3] + surface.origin, out[:, 3:6].copy(), out[:, 6].copy()


def on_discs(surface: SurfelHierarchy, points: NDArray, device: Device) -> NDArray:
    """Return (n, 7): position, normal, signed distance of `points` (n, 3) relative to the surface's origin."""
    base = surface.base
    base = base[finite_rows(surface.positions[base]) & (surface.radii[base] > 0)]
    if not len(base):
        raise InputError("surface: expected at least one base surfel, got none")
    positions, normals, radii = (a[base].astype(np.float64) for a in (surface.positions, surface.normals,
                                                                      surface.radii))
    count = min(NEIGHBOURS, len(base))
    ask = lambda q: nearest(surface.positions[base], count, np.ascontiguousarray(q, np.float32), device)[0]  # noqa: E731
    q = points
    for _ in range(2):  # the neighbours of the point, then those of its place on the surface
        at = ask(q)
        p, n, r = positions[at], normals[at], radii[at]
        # On the nearest disc.
        d = points[:, None] - p
        high = (d * n).sum(axis=2)
        flat = d - high[..., None] * n
        length = lengths_of(flat)
        flat *= np.minimum(1, r / np.maximum(length, 1e-300))[..., None]
        away = lengths_of(d - flat)
        best = np.argmin(away, axis=1)
        row = np.arange(len(points))
        q, normal = p[row, best] + flat[row, best], n[row, best]
        inside = length[row, best] < r[row, best]
        seen = (n * normal[:, None]).sum(axis=2) > 0  # the other side of a thin sheet is another surface
        for _ in range(STEPS):
            e = q[:, None] - p
            g = np.where(seen, np.maximum(1 - (e**2).sum(axis=2) / r**2, 0) ** 3, 0)
            total = g.sum(axis=1)
            use = inside & (total > 1e-9)
            mean = (g[..., None] * n).sum(axis=1)
            mean /= np.maximum(lengths_of(mean, keepdims=True), 1e-300)
            off = (g * (e * n).sum(axis=2)).sum(axis=1) / np.maximum(total, 1e-300)
            normal = np.where(use[:, None], mean, normal)
            # Onto the blend, and below the point along the blend's normal.
            moved = q - off[:, None] * normal
            moved = points - ((points - moved) * normal).sum(axis=1, keepdims=True) * normal
            near = lengths_of(moved - q) < r[row, best]
            q = np.where((use & near)[:, None], moved, q)
    sign = np.where(((points - q) * normal).sum(axis=1) < 0, -1.0, 1.0)
    return np.concatenate([q, normal, (sign * lengths_of(points - q))[:, None]], axis=1)


def on_triangles(surface: SurfelHierarchy, points: NDArray, device: Device) -> NDArray:
    """Return (n, 7): position, interpolated normal, signed distance; see `on_discs`."""
    _, face = nearest_triangles(surface.vertices, surface.triangles, points, device)
    index = surface.triangles[face]
    q, weights = barycentric_foot(points, surface.vertices[index].astype(np.float64))
    normal = (weights[:, :, None] * surface.vertex_normals[index]).sum(axis=1)
    normal /= np.maximum(lengths_of(normal, keepdims=True), 1e-300)
    sign = np.where(((points - q) * normal).sum(axis=1) < 0, -1.0, 1.0)
    return np.concatenate([q, normal, (sign * lengths_of(points - q))[:, None]], axis=1)
