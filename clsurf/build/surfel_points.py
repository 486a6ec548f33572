"""Base surfels: the points of a scan, or of its faces, with their normals, radii and colours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import InputError
from ..surface.arrays import extent_of, finite_rows, lengths_of, whole_faces
from ..surface.mesh import Mesh
from ..surface.srgb import premultiplied
from .large_faces import LARGE, longest2
from .neighbours import nearest
from .slim import usable_points

# Of a point, itself among them (kernels/build/surfel_radii.cl). In scattered clouds 16 may lie on one side, which then
# passes for a rim: 15 places of a million were holes.
NEIGHBOURS = 24
# Radii over the reach of a point's Voronoi cell. At 1.5 a place lies in 3.5 discs on average, and what is seen of them
# is their inner 0.85, which still leaves no hole (kernels/render/tile_surfels.cl).
OVERLAP = 1.5
STRAY = 2.5  # times the median radius of its neighbours that a radius may have
FEWEST = 20_000  # points that a mesh of larger faces is sampled at
MOST = 1 << 26  # base surfels


@dataclass(eq=False)
class Base:
    """Base surfels, relative to the scan's origin."""

    positions: NDArray  # (n, 3) float32
    normals: NDArray  # (n, 3) float32, unit
    radii: NDArray  # (n,) float32
    colors: NDArray | None  # (n, 4) float32, premultiplied linear light
    spacing: float  # median


def base_surfels(scan, spacing, device: Device) -> Base:
    """Return the base surfels of a PointCloud or a Mesh.

    Parameters
    ----------
    spacing : float, optional
        World units between points: denser ones become one, and a mesh's faces are sampled at it. By default all of a
        cloud's points; those of a mesh's vertices and, where its faces are large against the median one or there are
        few, points on them.
    """
    if isinstance(scan, Mesh) and len(scan.faces):
        scan = sampled_mesh(scan, spacing)
    points = usable_points(scan, None, device)
    normals = unit(points.normals)
    colors = None if points.colors is None else premultiplied(points.colors).astype(np.float32)
    positions = points.position
    if spacing is not None:
        positions, normals, colors = thinned(positions, normals, colors, spacing)
    if len(positions) > MOST:
        raise InputError(f"spacing: expected at most {MOST:,} base surfels, got {len(positions):,}: give a larger "
                         "spacing")
    radii, spacings = surfel_radii(positions, normals, device)
    return Base(positions, normals, radii, colors, float(np.median(spacings)))


def unit(vectors) -> NDArray:
    """Return vectors (n, 3) float32 of length 1."""
    vectors = np.asarray(vectors, np.float64)
    return (vectors / lengths_of(vectors, keepdims=True)).astype(np.float32)


def surfel_radii(positions: NDArray, normals: NDArray, device: Device) -> tuple[NDArray, NDArray]:
    """Return radii (n,) float32 that leave no hole, and the distance to neighbours (n,) float32 around each point."""
    n = len(positions)
    if n < 4:
        reach = lengths_of(positions - positions.mean(axis=0)).max() if n > 1 else 1.0
        reach = np.full(n, reach if reach > 0 else 1.0, np.float32)
        return reach, reach
    device.check_memory(points=12 * n, normals=12 * n)
    indices, _ = nearest(positions, min(NEIGHBOURS, n), device=device)
    if indices.shape[1] < NEIGHBOURS:
        indices = np.pad(indices, ((0, 0), (0, NEIGHBOURS - indices.shape[1])), constant_values=-1)
    radii, spacings = np.empty(n, np.float32), np.empty(n, np.float32)
    kernel = device.kernel("build/surfel_radii.cl", constants={"K": NEIGHBOURS})
    points, across, rows = device.upload(positions), device.upload(normals), device.rows_at_once(4 * NEIGHBOURS, 8)
    for first in range(0, n, rows):
        near = device.upload(indices[first:first + rows])
        out = device.empty((len(near),), np.float32), device.empty((len(near),), np.float32)
        kernel((len(near),), (64,), len(near), first, points, across, near, OVERLAP, *out)
        radii[first:first + rows], spacings[first:first + rows] = map(device.download, out)
    lost = ~(radii > 0)  # a point with no neighbour of its own sheet
    if lost.any():
        usual = radii[~lost]
        radii[lost] = np.median(usual) if len(usual) else np.linalg.norm(extent_of(positions)) / 2 or 1.0
    return without_strays(radii, indices), spacings


def without_strays(radii: NDArray, indices: NDArray) -> NDArray:
    """Return radii (n,) float32 that exceed those of the neighbours (n, k) little.

    A point far from all others reaches halfway to them: without the limit the lion has discs as large as its head.
    """
    near = indices[:, 1:]
    usual = np.median(np.where(near >= 0, radii[near], radii[:, None]), axis=1)
    return np.minimum(radii, STRAY * usual).astype(np.float32)


def sampled_mesh(mesh: Mesh, spacing) -> Mesh:
    """Return the mesh with points on its large faces as further vertices, which belong to no face."""
    finite = finite_rows(mesh.vertices)
    faces = mesh.faces[whole_faces(mesh.faces, finite)]
    if not len(faces):
        return mesh
    corners = mesh.vertices.take(faces, 0).astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = lengths_of(cross)
    longest = np.sqrt(longest2(mesh.vertices.astype(np.float64), faces))
    if spacing is None:
        spacing = min(float(np.median(longest)), float(np.sqrt(doubled.sum() / 2 / FEWEST)))
        limit = LARGE * spacing
    else:
        limit = spacing
    if not spacing > 0:
        return mesh
    if doubled.sum() / spacing**2 > MOST:
        raise InputError(f"spacing: expected at most {MOST:,} base surfels, got about "
                         f"{doubled.sum() / 2 / spacing**2:,.0f}: give a larger spacing")
    large = np.flatnonzero((longest > limit) & (doubled > 0))
    if not len(large):
        return mesh
    parts = np.maximum(np.rint(longest[large] / (2 * spacing)), 1).astype(np.int64)
    new = [[], [], [], []]
    for k in np.unique(parts):
        own, weights = large[parts == k], thirds(int(k))
        face = np.repeat(own, len(weights))
        blend = lambda values, weights=weights, own=own: np.einsum(  # noqa: E731
            "pc,fcd->fpd", weights, np.asarray(values, np.float64)[faces[own]]).reshape(-1, values.shape[1])
        new[0].append(blend(mesh.vertices))
        flat = cross[face] / doubled[face, None]
        new[1].append(flat if mesh.normals is None else blend(mesh.normals))
        if mesh.colors is not None:
            new[2].append(blend(mesh.colors))
        if mesh.uv is not None:
            new[3].append(blend(mesh.uv))
    joined = lambda old, parts, dtype: None if old is None else np.concatenate(  # noqa: E731
        [old, *parts]).astype(dtype)
    own_normals = mesh.normals
    if own_normals is None:
        from .slim import face_normals
        own_normals = face_normals(mesh.vertices, mesh.faces)
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    own_normals = np.where(used[:, None], own_normals, 0)  # loose vertices are no part of the surface
    return Mesh(np.concatenate([mesh.vertices, *new[0]]).astype(np.float32), None,
                joined(own_normals, new[1], np.float32), joined(mesh.colors, [np.rint(c) for c in new[2]], np.uint8),
                joined(mesh.uv, new[3], np.float32), mesh.texture, mesh.origin)


def thirds(k: int) -> NDArray:
    """Return the barycentric coordinates (k * k, 3) of the middles of a triangle's k * k like parts."""
    i, j = (t.ravel() for t in np.meshgrid(np.arange(k), np.arange(k), indexing="ij"))
    up, down = i + j < k, i + j < k - 1
    first = np.concatenate([i[up] + 1 / 3, i[down] + 2 / 3])
    second = np.concatenate([j[up] + 1 / 3, j[down] + 2 / 3])
    return np.stack([first, second, k - first - second], axis=1) / k


def thinned(positions: NDArray, normals: NDArray, colors: NDArray | None, spacing: float) -> tuple:
    """Return means of the points, normals and colours in every cube of side `spacing` that face the same way."""
    low = positions.min(axis=0).astype(np.float64)
    cell = np.floor((positions - low) / spacing).astype(np.int64)
    side = np.argmax(np.abs(normals), axis=1)
    side = 2 * side + (normals[np.arange(len(normals)), side] < 0)
    shape = cell.max(axis=0) + 1
    if float(shape[0]) * shape[1] * shape[2] * 6 > 2.0**62:
        raise InputError(f"spacing: expected more than {extent_of(positions).max() / 2**20:.3g}, got {spacing}")
    key = ((cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]) * 6 + side
    _, group = np.unique(key, return_inverse=True)
    count = np.bincount(group)
    mean = lambda values: np.stack([np.bincount(group, column) / count for column in values.T], axis=1)  # noqa: E731
    kept = mean(normals)
    length = lengths_of(kept)
    good = length > 1e-3
    return (mean(positions)[good].astype(np.float32), (kept[good] / length[good, None]).astype(np.float32),
            None if colors is None else mean(colors)[good].astype(np.float32))
