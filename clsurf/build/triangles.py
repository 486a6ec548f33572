"""Nearest triangles of meshes."""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import InputError
from .point_tree import BLOCK, build_boxes, column_bounds, morton_order

TRIANGLE = 12  # floats a triangle (triangle_distances.cl)
BATCH = 1 << 22  # queries of one launch


def triangle_distances(vertices: NDArray, faces: NDArray, points: NDArray, device: Device) -> NDArray:
    """Return the distances (n,) float64 of points to the nearest triangle; see `nearest_triangles`."""
    return nearest_triangles(vertices, faces, points, device)[0]


def nearest_triangles(vertices: NDArray, faces: NDArray, points: NDArray, device: Device) -> tuple[NDArray, NDArray]:
    """Return the distances (n,) float64 of points to the nearest triangle, and its number (n,) int64.

    Parameters
    ----------
    vertices : (v, 3) float
    faces : (f, 3) int
        f at least 1. Faces with corners that are not finite do not count.
    points : (n, 3) float
        Finite, in the space and the units of the vertices.

    Raises
    ------
    InputError
        No face with finite corners.
    """
    corners = np.asarray(vertices, np.float64)[faces]
    kept = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)))
    corners = corners[kept]
    if not len(corners):
        raise InputError("surface: expected a mesh with faces, got none with finite corners")
    box = column_bounds(corners.reshape(-1, 3))
    middle, unit = box.mean(axis=0), max(float(np.linalg.norm(box[1] - box[0])), np.finfo(np.float32).tiny)
    corners = (corners - middle) / unit
    centroid = corners.mean(axis=1)
    order, _, _ = morton_order(np.ascontiguousarray(centroid, np.float32), device)
    corners, centroid, kept = corners[order], centroid[order], kept[order]
    padded = -(-len(order) // BLOCK) * BLOCK
    records = np.zeros((padded, TRIANGLE), np.float32)
    records[:len(order), :3] = corners[:, 0]
    records[:len(order), 3:9] = (corners[:, 1:] - corners[:, :1]).reshape(-1, 6)
    radius = np.sqrt(((corners - centroid[:, None]) ** 2).sum(axis=2).max(axis=1)) * 1.0001 + 2e-7
    balls = np.empty((4, padded), np.float32)
    balls[:3], balls[3] = np.repeat(centroid[-1:].T, padded, axis=1), -1  # the padding is never near
    balls[:3, :len(order)], balls[3, :len(order)] = centroid.T, radius
    on_device = device.upload(balls)
    tree = (device.upload(records), padded, on_device,
            *build_boxes(on_device, padded, device, radius=device.upload(balls[3])))
    kernel = device.kernel("build/triangle_distances.cl")
    margin = float(np.median(radius))
    out, number = np.empty(len(points)), np.empty(len(points), np.int64)
    for start in range(0, len(points), BATCH):
        local = np.ascontiguousarray((np.asarray(points[start:start + BATCH], np.float64) - middle) / unit, np.float32)
        order, _, _ = morton_order(local, device)
        stride = -(-len(local) // BLOCK) * BLOCK
        queries = np.zeros((3, stride), np.float32)
        queries[:, :len(local)] = local[order].T
        found, at = device.empty(stride, np.float32), device.empty(stride, np.int32)
        kernel((stride // BLOCK,), (1,), len(local), stride, device.upload(queries), *tree, margin, found, at)
        out[start + order] = device.download(found, copy=False)[:len(local)]
        number[start + order] = kept[device.download(at, copy=False)[:len(local)]]
    return out * unit, number
