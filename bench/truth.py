"""What a picture of a mesh should be: exact ray casting of its triangles at clsurf's pixel centres.

Each triangle is put onto the pixel centres that it covers by the signed volumes of ray and edges, in float64, edges
included, so that neighbouring triangles leave no gap; the nearest wins. It needs nothing but NumPy, and agrees with
Open3D's Embree to float32 rounding (test_bench_truth). Results are cached: about 2 s a view of the dragon.
"""

import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.device.icd import cache_folder
from clsurf.errors import InputError

VERSION = 2  # of the cached files: raise it when the casting changes
PAIRS = 1 << 22  # (triangle, pixel) candidates worked on at once: about 0.6 GB at the peak


@dataclass(frozen=True, eq=False)
class Truth:
    """The exact picture of a mesh in one view.

    Attributes
    ----------
    hit : (h, w) bool
    depth : (h, w) float32
        Along the viewing axis, world units; NaN where nothing is hit.
    normal, facet : (h, w, 3) float32
        Unit, facing the eye: interpolated between area-weighted vertex normals, and of the triangle itself.
    """

    hit: NDArray
    depth: NDArray
    normal: NDArray
    facet: NDArray


def mesh_key(vertices, faces) -> str:
    """Return a short name of the mesh's content."""
    digest = hashlib.sha256(np.ascontiguousarray(vertices).tobytes())
    digest.update(np.ascontiguousarray(faces).tobytes())
    return digest.hexdigest()[:16]


def vertex_normals(vertices, faces) -> NDArray:
    """Return unit normals (v, 3) float64: facet normals averaged by area."""
    v = np.asarray(vertices, np.float64)
    edge1, edge2 = v[faces[:, 1]] - v[faces[:, 0]], v[faces[:, 2]] - v[faces[:, 0]]
    facet = np.cross(edge1, edge2)
    total = np.stack([np.bincount(faces.ravel(), np.repeat(facet[:, i], 3), len(v)) for i in range(3)], axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def cast(mesh, camera, size, cache: bool = True, key: str | None = None) -> Truth:
    """Return what `camera` sees of `mesh` at the pixel centres of `size` (width, height).

    Parameters
    ----------
    mesh : clsurf.Mesh
        All of it must lie in front of the eye.
    key : str, optional
        `mesh_key` of the mesh where it is known already.

    Raises
    ------
    InputError
        The mesh has no faces, or reaches behind the eye.
    """
    if not len(mesh.faces):
        raise InputError("truth: expected a mesh with faces to cast rays at, got points only")
    key = key or mesh_key(mesh.vertices, mesh.faces)
    p = camera.projection(size)
    view = np.concatenate([camera.eye - mesh.origin, camera.rotation.ravel(), [p.fx, p.fy, p.cx, p.cy, p.perspective]])
    name = hashlib.sha256(view.round(9).tobytes() + repr(tuple(size)).encode()).hexdigest()[:16]
    path = cache_folder() / "bench" / f"truth{VERSION}-{key}" / f"{name}.npz"
    if cache and path.exists():
        return _unpacked(path, size)
    faces = np.asarray(mesh.faces, np.int64)
    depth, face, weights = nearest_triangles(np.asarray(mesh.vertices, np.float64) - (camera.eye - mesh.origin),
                                             faces, camera, size)
    hit = face >= 0
    found, w = faces[face[hit]], weights[hit]
    v = np.asarray(mesh.vertices, np.float64)
    facet = np.cross(v[found[:, 1]] - v[found[:, 0]], v[found[:, 2]] - v[found[:, 0]])
    facet /= np.maximum(np.linalg.norm(facet, axis=1, keepdims=True), 1e-300)
    smooth = (vertex_normals(v, faces)[found] * w[:, :, None]).sum(axis=1)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-300)
    directions = camera.rays(size)[1].reshape(size[1], size[0], 3)[hit]
    for normal in (facet, smooth):
        normal *= -np.sign((normal * directions).sum(axis=1, keepdims=True))
    arrays = dict(hit=np.packbits(hit), depth=depth[hit].astype(np.float32),
                  normal=np.round(smooth * 32767).astype(np.int16), facet=np.round(facet * 32767).astype(np.int16))
    if cache:
        _write(path, arrays)
    return _picture(arrays, size)


def nearest_triangles(vertices, faces, camera, size):
    """Return depth (h, w) float64, triangle (h, w) int64 (-1: none) and weights (h, w, 3) of the nearest triangle.

    Parameters
    ----------
    vertices : (v, 3) float64
        Relative to the eye, world axes.
    """
    width, height = size
    p = camera.projection(size)
    view = vertices @ camera.rotation.T
    if p.perspective and view[:, 2].max() >= 0:
        raise InputError("truth: expected a mesh that lies in front of the eye, got one that reaches behind it")
    scale = -1 / view[:, 2] if p.perspective else np.ones(len(view))
    x, y = p.cx + p.fx * view[:, 0] * scale, p.cy - p.fy * view[:, 1] * scale
    # Pixel centres are at +0.5: the columns whose centres lie in the box of a triangle; a hair wider, for the edges.
    tx, ty = x[faces], y[faces]
    x0 = np.clip(np.ceil(tx.min(axis=1) - 0.5 - 1e-9), 0, width).astype(np.int64)
    x1 = np.clip(np.floor(tx.max(axis=1) - 0.5 + 1e-9) + 1, 0, width).astype(np.int64)
    y0 = np.clip(np.ceil(ty.min(axis=1) - 0.5 - 1e-9), 0, height).astype(np.int64)
    y1 = np.clip(np.floor(ty.max(axis=1) - 0.5 + 1e-9) + 1, 0, height).astype(np.int64)
    columns, rows = np.maximum(x1 - x0, 0), np.maximum(y1 - y0, 0)
    depth = np.full(width * height, np.inf)
    face, weights = np.full(width * height, -1, np.int64), np.zeros((width * height, 3))
    for chosen, pixel in _candidates(columns, rows, x0, y0, width):
        w, d = _weights(view, faces, chosen, pixel, p, width)
        inside = (w >= -1e-12).all(axis=1) & np.isfinite(d)
        chosen, pixel, w, d = chosen[inside], pixel[inside], w[inside], d[inside]
        order = np.lexsort((chosen, d, pixel))
        first = order[np.diff(pixel[order], prepend=-1) > 0]
        nearer = first[d[first] < depth[pixel[first]]]
        depth[pixel[nearer]], face[pixel[nearer]], weights[pixel[nearer]] = d[nearer], chosen[nearer], w[nearer]
    depth[face < 0] = np.nan
    return depth.reshape(height, width), face.reshape(height, width), weights.reshape(height, width, 3)


def _candidates(columns, rows, x0, y0, width):
    """Yield (triangle, pixel) pairs, each pixel box expanded, at most about PAIRS at a time."""
    area = columns * rows
    some = np.flatnonzero(area)
    group = np.cumsum(area[some]) // PAIRS
    for part in np.split(some, np.flatnonzero(np.diff(group)) + 1) if len(some) else ():
        count = area[part]
        chosen = np.repeat(part, count)
        local = np.arange(len(chosen)) - np.repeat(np.cumsum(count) - count, count)
        row, column = np.divmod(local, columns[chosen])
        yield chosen, (y0[chosen] + row) * width + x0[chosen] + column


def _weights(view, faces, chosen, pixel, p, width):
    """Return barycentric weights (n, 3) and depths (n,) of the pixels' rays in the triangles' planes.

    A ray meets the triangle's plane at the sum of its corners weighted by the signed volumes that the ray spans with
    the opposite edges; outside, one of them is negative.
    """
    a, b, c = (view[faces[chosen, i]] for i in range(3))
    row, column = np.divmod(pixel, width)
    right, up = (column + 0.5 - p.cx) / p.fx, (p.cy - row - 0.5) / p.fy
    if p.perspective:
        ray = np.stack([right, up, -np.ones_like(right)], axis=1)
    else:
        start = np.stack([right, up, np.zeros_like(right)], axis=1)
        a, b, c = a - start, b - start, c - start
        ray = np.broadcast_to(np.array([0.0, 0.0, -1.0]), start.shape)
    volumes = np.stack([(np.cross(b, c) * ray).sum(axis=1), (np.cross(c, a) * ray).sum(axis=1),
                        (np.cross(a, b) * ray).sum(axis=1)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        w = volumes / volumes.sum(axis=1, keepdims=True)
    return w, -(w[:, 0] * a[:, 2] + w[:, 1] * b[:, 2] + w[:, 2] * c[:, 2])


# The cache ----------------------------------------------------------------------------------------------------------


def _write(path: Path, arrays: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
        np.savez(file, **arrays)
    os.replace(file.name, path)


def _unpacked(path: Path, size) -> Truth:
    with np.load(path) as arrays:
        return _picture(dict(arrays), size)


def _picture(arrays: dict, size) -> Truth:
    width, height = size
    hit = np.unpackbits(arrays["hit"], count=width * height).reshape(height, width).astype(bool)
    depth = np.full((height, width), np.nan, np.float32)
    depth[hit] = arrays["depth"]
    normals = []
    for name in ("normal", "facet"):
        normal = np.full((height, width, 3), np.nan, np.float32)
        unit = arrays[name].astype(np.float32)
        normal[hit] = unit / np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-30)
        normals.append(normal)
    return Truth(hit, depth, *normals)
