"""Smoothing of scattered points: projection along the normal onto blended local surfaces (paper 003, equation 6)."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..build.neighbours import nearest
from ..build.normals import estimate_normals
from ..build.point_tree import build_point_tree
from ..build.radius import robust_box
from ..device import Device
from ..io.cleaning import first_of_duplicates
from ..surface.arrays import finite_rows, lengths_of
from ..surface.cloud import PointCloud
from .smooth_fits import (
    LAST_STEP,
    SHARP,
    Queries,
    Rings,
    Samples,
    blended,
    choose_radii,
    guided_fits,
    queries_of,
)

NEIGHBORS = 12  # of the spacing and of the means
LEAST = 4  # points; fewer have no surface
GUIDE_RADIUS, GUIDE_SHARP = 3.3, 1.0  # of the surfels whose blended normals guide the others


def smooth_points(cloud, strength: float, device: Device):
    """Return `cloud` (a PointCloud, or a Mesh without faces) with its points projected onto blended local surfaces.

    Points that are not finite stay; points at the same place move together.
    """
    finite = finite_rows(cloud.points)
    first, target = first_of_duplicates(cloud.points[finite])
    points = cloud.points[finite][first]
    if len(points) < LEAST:
        return cloud
    normals = cloud.normals
    box = robust_box(points)
    unit, middle = float(np.linalg.norm(box[1] - box[0])), box.mean(axis=0)
    if not unit > 0:
        return cloud
    local = ((points - middle) / unit).astype(np.float32)
    normals = usable_normals(cloud, local, None if normals is None else normals[finite][first], device)
    moved, turned = projected(local, normals, strength, device)
    shift = (moved - local) * np.float32(unit * min(strength, 1.0))
    new = cloud.points.copy()
    new[finite] += shift[target]
    if cloud.normals is None:
        return _with(cloud, new, None)
    found = cloud.normals.copy()
    found[finite] = turned[target]
    return _with(cloud, new, found)


def _with(cloud, points: NDArray, normals: NDArray | None):
    name = "points" if isinstance(cloud, PointCloud) else "vertices"
    return replace(cloud, normals=normals, **{name: points})


def usable_normals(cloud, points: NDArray, normals: NDArray | None, device: Device) -> NDArray:
    """Return unit normals (n, 3) float32 of `points`: the cloud's where all are usable, otherwise estimated ones."""
    if normals is not None:
        length = lengths_of(normals, keepdims=True)
        if (np.isfinite(length) & (length > 1e-12)).all():
            return (normals / length).astype(np.float32)
    return estimate_normals(PointCloud(points), device=device).normals


def projected(points: NDArray, normals: NDArray, strength: float, device: Device) -> tuple[NDArray, NDArray]:
    """Return the points (n, 3) float32 on the blended surfaces, and the unit normals there.

    Parameters
    ----------
    points : (n, 3) float32
        Distinct and finite, in a box of diagonal 1.
    normals : (n, 3) float32
        Unit; their signs may differ between sheets, not between neighbours.
    """
    tree = build_point_tree(points, normals, np.zeros(3, np.float32), 1.0, device, np.ones(len(points), np.float32))
    inverse = np.empty(len(points), np.int32)
    inverse[tree.order] = np.arange(len(points), dtype=np.int32)
    index, distance = nearest(points, min(NEIGHBORS, len(points)), device=device)
    index = inverse[index[tree.order]]
    offset = np.arange(len(points) + 1, dtype=np.int32) * index.shape[1]
    rings = Rings(device, len(points), device.upload(offset), device.upload(index.ravel()))
    reach = distance[tree.order].max(axis=1)
    # A disc of the radius of the 12th neighbour holds 12.5 points; an even triangle mesh has an edge of 1.07 times the
    # root of the area of a point.
    spacing = 1.0746 * reach * np.sqrt(np.pi / (index.shape[1] + 0.5))
    spacing = np.exp(rings.means(np.log(np.maximum(spacing, 1e-7))[None], 2)[0])
    samples = Samples(device, tree.count, tree.padded, tree.sorted, tree.boxes, tree.node_offset, tree.top_level,
                      spacing, 1.0)
    queries = Queries(tree.count, tree.padded, tree.sorted)
    guide = guided_fits(samples, np.float32(GUIDE_RADIUS) * spacing, GUIDE_SHARP)
    turned = blended(guide, queries)[1:4].T
    tree = build_point_tree(points, _scattered(turned, tree.order), np.zeros(3, np.float32), 1.0, device,
                            np.ones(len(points), np.float32))
    samples = Samples(device, tree.count, tree.padded, tree.sorted, tree.boxes, tree.node_offset, tree.top_level,
                      spacing, 1.0)
    sorted_points = points[tree.order]
    queries = queries_of(sorted_points, turned, device)
    choice = choose_radii(samples, queries, rings, SHARP)
    radii = choice.factor * spacing * max(strength, 1.0)
    off, *normal, _ = blended(guided_fits(samples, radii, SHARP, LAST_STEP), queries)
    normal = np.stack(normal, axis=1)
    return _scattered(sorted_points - off[:, None] * normal, tree.order), _scattered(normal, tree.order)


def _scattered(rows: NDArray, order: NDArray) -> NDArray:
    out = np.empty(rows.shape, np.float32)
    out[order] = rows
    return out
