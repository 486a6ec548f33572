"""How far the discs of base surfels, blended as they are drawn, are from the scan that they were made from."""

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import finite_rows, lengths_of, used_numbers
from ..surface.mesh import Mesh
from ..surface.slim import frame_of_normals
from .neighbours import BoxTree, box_tree, nearest
from .surfel_points import Base

BOUND_SHARE = 0.999  # of the scan lies within `bound` of the finest level
BOUND_SAMPLES = 1 << 14
BLENDED = 16  # base surfels about a place
AROUND, WIDEST = 6, 1.75  # neighbours of a base surfel, and the angle between two that make a triangle with it


def bounds_of(scan, base: Base, device) -> tuple[float, float]:
    """Return the distances to the blended discs that BOUND_SHARE and all of an even sample of the scan keep.

    Of points; of the middles of faces, where there are any; and of places between base surfels on the surface that
    their normals give, where tangent planes are farthest from what they touch. What is drawn blends discs where the
    ray meets each, and at a silhouette one alone to its rim: the second takes all of the discs into account.
    """
    points = scan.points
    if isinstance(scan, Mesh) and len(scan.faces):
        points = points[used_numbers(scan.faces, len(points))]  # loose vertices are no part of the surface
    points = points[finite_rows(points)]
    places = [evenly(points, BOUND_SAMPLES)]
    if isinstance(scan, Mesh) and len(scan.faces):
        faces = evenly(scan.faces, BOUND_SAMPLES)
        middles = scan.vertices[faces].astype(np.float64).mean(axis=1)
        places.append(middles[finite_rows(middles)])
    tree = box_tree(base.positions, device)
    if len(base.positions) > 3:
        places.append(between(base, tree))
    distance = drawn_distance(np.concatenate(places), base, tree)
    return float(np.quantile(distance, BOUND_SHARE, method="higher")), max(float(distance.max()), at_rims(base, tree))


def at_rims(base: Base, tree: BoxTree) -> float:
    """Return how far the base surfels next to each other's discs say that these stand off at their rims.

    The height of a neighbour over the disc's plane grows with the square of the way to it, as of quadratic surfaces.
    """
    own = evenly(np.arange(len(base.positions)), BOUND_SAMPLES)
    at = nearest(tree, min(BLENDED, len(base.positions)), base.positions[own])[0]
    positions, normals = base.positions.astype(np.float64), base.normals.astype(np.float64)
    d = positions[at] - positions[own, None]
    high = np.abs((d * normals[own, None]).sum(axis=2))
    flat2 = np.maximum((d * d).sum(axis=2) - high * high, 0)
    radius2 = base.radii[own, None].astype(np.float64) ** 2
    same = (at >= 0) & ((normals[at] * normals[own, None]).sum(axis=2) > 0.5)
    same &= (flat2 > radius2 / 4) & (flat2 <= radius2) & (high * high < radius2)
    return float(np.max(high * radius2 / np.maximum(flat2, radius2 / 4), where=same, initial=0.0))


def evenly(rows: NDArray, most: int) -> NDArray:
    """Return at most about `most` of the rows, evenly, as they are."""
    return rows[::max(1, len(rows) // most)]


def between(base: Base, tree: BoxTree) -> NDArray:
    """Return places (n, 3) as far as can be from the corners of triangles of neighbouring base surfels of one side.

    Of a quadratic surface the mean of the corners and that of the corners' tangent planes lie as far on either side.
    """
    own = evenly(np.arange(len(base.positions)), BOUND_SAMPLES // AROUND)
    at = nearest(tree, min(AROUND + 1, len(base.positions)), base.positions[own])[0][:, 1:]
    positions, normals = base.positions.astype(np.float64), base.normals.astype(np.float64)
    u, v = frame_of_normals(normals[own])
    d = positions[at] - positions[own, None]
    angle = np.arctan2((d * v[:, None]).sum(axis=2), (d * u[:, None]).sum(axis=2))
    same = (at >= 0) & ((normals[at] * normals[own, None]).sum(axis=2) > 0.5)
    turn = np.argsort(np.where(same, angle, np.inf), axis=1)
    at, angle, same = (np.take_along_axis(a, turn, axis=1) for a in (at, angle, same))
    gap = np.mod(np.roll(angle, -1, axis=1) - angle, 2 * np.pi)
    good = same & np.roll(same, -1, axis=1) & (gap < WIDEST) & (gap > 0)
    corners = np.stack([np.broadcast_to(own[:, None], at.shape)[good], at[good], np.roll(at, -1, axis=1)[good]], axis=1)
    p, n = positions[corners], normals[corners]
    # Weights of the middle of the circle through the corners; of blunt triangles, of the longest edge's.
    side2 = ((np.roll(p, -1, axis=1) - np.roll(p, 1, axis=1)) ** 2).sum(axis=2)
    weights = np.maximum(side2 * (side2.sum(axis=1, keepdims=True) - 2 * side2), 0)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
    middle, normal = ((weights[..., None] * a).sum(axis=1) for a in (p, n))
    normal /= np.maximum(lengths_of(normal, keepdims=True), 1e-300)
    planes = (weights * ((p - middle[:, None]) * n).sum(axis=2)).sum(axis=1)
    return middle + planes[:, None] / 2 * normal


def drawn_distance(places: NDArray, base: Base, tree: BoxTree) -> NDArray:
    """Return how far places (n, 3) are from the blend of the discs over them, or from the nearest disc, (n,)."""
    count = min(BLENDED, len(base.positions))
    at = nearest(tree, count, np.ascontiguousarray(places, np.float32))[0]
    at = np.where(at < 0, at[:, :1], at)
    p, n, r = (a[at].astype(np.float64) for a in (base.positions, base.normals, base.radii))
    d = places[:, None] - p
    high, away2 = (d * n).sum(axis=2), (d * d).sum(axis=2)
    flat = np.sqrt(np.maximum(away2 - high * high, 0))
    disc = np.hypot(high, np.maximum(flat - r, 0))
    side = n[np.arange(len(at)), np.argmin(disc, axis=1)]
    weight = np.maximum(1 - flat * flat / (r * r), 0) ** 3
    weight *= ((n * side[:, None]).sum(axis=2) > 0) & (np.abs(high) < r)
    total = weight.sum(axis=1)
    along = lengths_of((weight[..., None] * n).sum(axis=1))
    blend = np.abs((weight * high).sum(axis=1)) / np.maximum(along, 1e-300)
    return np.where(total > 0, blend, disc.min(axis=1))
