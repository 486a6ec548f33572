"""Nearest triangles of meshes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import DeviceMemoryError, InputError
from ..surface.arrays import lengths_of
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
    corners = np.asarray(vertices, np.float64).take(faces, 0)
    kept = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)))
    corners = corners[kept]
    if not len(corners):
        raise InputError("surface: expected a mesh with faces, got none with finite corners")
    box = column_bounds(corners.reshape(-1, 3))
    middle, unit = box.mean(axis=0), max(float(np.linalg.norm(box[1] - box[0])), np.finfo(np.float32).tiny)
    corners = (corners - middle) / unit
    found, number = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    batch = min(BATCH, device.rows_at_once(12, 4, 4))

    def ask(rows: NDArray) -> None:
        """Look among some triangles; in halves where the device does not hold them, or look through them, at once."""
        try:
            tree = triangle_tree(corners[rows], device)
            for start in range(0, len(points), batch):
                part = slice(start, start + batch)
                local = (np.asarray(points[part], np.float64) - middle) / unit
                away, at = tree.nearest(np.ascontiguousarray(local, np.float32))
                nearer = away < found[part]
                found[part][nearer], number[part][nearer] = away[nearer], kept[rows[at[nearer]]]
            return
        except DeviceMemoryError:
            if len(rows) < 2:
                raise
        axis = int(np.argmax(np.ptp(corners[rows, 0], axis=0)))
        order = np.argpartition(corners[rows, 0, axis], len(rows) // 2)
        for half in (order[:len(rows) // 2], order[len(rows) // 2:]):
            ask(rows[np.sort(half)])

    ask(np.arange(len(corners)))
    return found * unit, number


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """Triangles on a device, along the Morton curve, with a tree over their balls (triangle_distances.cl)."""

    device: Device
    arrays: tuple
    order: NDArray
    margin: float

    def nearest(self, points: NDArray) -> tuple[NDArray, NDArray]:
        """Return the distances (n,) of points (n, 3) float32 to the nearest triangle, and its number (n,)."""
        device, count = self.device, len(points)
        order, _, _ = morton_order(points, device)
        stride = -(-count // BLOCK) * BLOCK
        queries = np.zeros((3, stride), np.float32)
        queries[:, :count] = points[order].T
        found, at = device.empty(stride, np.float32), device.empty(stride, np.int32)
        device.kernel("build/triangle_distances.cl")((stride // BLOCK,), (1,), count, stride, device.upload(queries),
                                                     *self.arrays, self.margin, found, at)
        away, number = np.empty(count, np.float32), np.empty(count, np.int64)
        away[order] = device.download(found, copy=False)[:count]
        number[order] = self.order[device.download(at, copy=False)[:count]]
        return away, number


def triangle_tree(corners: NDArray, device: Device) -> TriangleTree:
    """Put triangles (f, 3, 3) float64, within about 1 of zero, on the device."""
    padded = -(-len(corners) // BLOCK) * BLOCK
    device.check_memory(triangles=4 * TRIANGLE * padded, balls=16 * padded)
    centroid = corners.mean(axis=1)
    order, _, _ = morton_order(np.ascontiguousarray(centroid, np.float32), device)
    corners, centroid = corners[order], centroid[order]
    records = np.zeros((padded, TRIANGLE), np.float32)
    records[:len(order), :3] = corners[:, 0]
    records[:len(order), 3:9] = (corners[:, 1:] - corners[:, :1]).reshape(-1, 6)
    radius = np.sqrt(((corners - centroid[:, None]) ** 2).sum(axis=2).max(axis=1)) * 1.0001 + 2e-7
    balls = np.empty((4, padded), np.float32)
    balls[:3], balls[3] = np.repeat(centroid[-1:].T, padded, axis=1), -1  # the padding is never near
    balls[:3, :len(order)], balls[3, :len(order)] = centroid.T, radius
    on_device = device.upload(balls)
    arrays = (device.upload(records), padded, on_device,
              *build_boxes(on_device, padded, device, radius=device.upload(balls[3])))
    return TriangleTree(device, arrays, order, float(np.median(radius)))


def barycentric_foot(points: NDArray, corners: NDArray) -> tuple[NDArray, NDArray]:
    """Return the places (n, 3) of triangles (n, 3 corners, 3) that are nearest to points (n, 3), and their weights.

    Weights (n, 3) are barycentric, exactly 0 for the corners that an edge or a corner leaves out. Nothing is compared
    with a fixed length: trimesh's `closest_point` takes points over faces with edges of 0.0003 to their edges.
    """
    a = corners[:, 0]
    e, f, d = corners[:, 1] - a, corners[:, 2] - a, points - a
    dot = lambda x, y: np.einsum("ij,ij->i", x, y)  # noqa: E731
    ee, ef, ff, de, df = dot(e, e), dot(e, f), dot(f, f), dot(d, e), dot(d, f)
    area = ee * ff - ef * ef
    flat = area > 1e-14 * ee * ff  # else a needle, whose edges are as near as its inside
    area[~flat] = 1
    v, w = (ff * de - ef * df) / area, (ee * df - ef * de) / area
    part = lambda x, y: np.clip(x / np.maximum(y, 1e-300), 0, 1)  # noqa: E731
    s, t, u = part(de, ee), part(df, ff), part(df - de + ee - ef, ee + ff - 2 * ef)
    zero = np.zeros_like(s)
    edges = np.stack([np.stack([1 - s, s, zero], axis=1), np.stack([1 - t, zero, t], axis=1),
                      np.stack([zero, 1 - u, u], axis=1)])
    away = lengths_of(np.einsum("kni,nij->knj", edges, corners) - points)
    best = edges[np.argmin(away, axis=0), np.arange(len(points))]
    inside = flat & (v > 0) & (w > 0) & (v + w < 1)
    weights = np.where(inside[:, None], np.stack([1 - v - w, v, w], axis=1), best)
    return np.einsum("ni,nij->nj", weights, corners), weights
