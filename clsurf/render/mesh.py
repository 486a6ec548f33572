"""Meshes in the renderer: upload and placement; the tile stage is that of triangles."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..surface.arrays import box_of, finite_rows, whole_faces
from ..surface.mesh import Mesh
from ..surface.srgb import LINEAR_OF_BYTE
from .points import space_order
from .shade import Look
from .texture import upload_texture
from .tiles import Grid, Scratch
from .triangles import Triangles, draw_triangles, place_triangles


@dataclass(frozen=True, eq=False)
class MeshUpload:
    """A `Mesh` on a device."""

    triangles: Triangles
    origin: NDArray  # (3,) float64
    center: NDArray  # (3,) float64, relative to origin
    reach: float  # every vertex lies within this of `center`


def upload_mesh(device: Device, mesh: Mesh) -> MeshUpload:
    """Put a mesh on the device; faces with a vertex that is not finite are left out.

    Raises
    ------
    DeviceMemoryError
    """
    v = len(mesh.vertices)
    device.check_memory(positions=16 * v, faces=12 * len(mesh.faces), normals=0 if mesh.normals is None else 16 * v,
                        colors=0 if mesh.colors is None else 16 * v)
    finite = finite_rows(mesh.vertices)
    faces = mesh.faces if finite.all() else mesh.faces[whole_faces(mesh.faces, finite)]
    faces, order = drawing_order(mesh.vertices, faces)
    put = lambda rows: device.upload(_fours(rows.take(order, 0)))  # noqa: E731
    colors = None if mesh.colors is None else LINEAR_OF_BYTE[mesh.colors[:, :3]]
    textured = mesh.uv is not None and mesh.texture is not None and mesh.texture.size > 0
    triangles = Triangles(put(mesh.vertices), device.upload(faces), None if mesh.normals is None else put(mesh.normals),
                          None if colors is None else put(colors), put(mesh.uv) if textured else None,
                          upload_texture(device, mesh.texture) if textured else None)
    points = mesh.vertices.take(order, 0).astype(np.float64)
    low, high = box_of(points) if len(points) else (np.zeros(3), np.zeros(3))
    center = low / 2 + high / 2
    return MeshUpload(triangles, mesh.origin, center, float(np.linalg.norm(high - center)))


def _fours(rows) -> NDArray:
    """Return rows (n, 2 or 3) as (n, 4) float32."""
    out = np.zeros((len(rows), 4), np.float32)
    out[:, :rows.shape[1]] = rows
    return out


def drawing_order(vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """Sort faces along the Morton curve of their middles, and vertices by their first use in that order.

    Neighbours in space become neighbours in memory (dragon, the tile stage: 0.6 of the time).

    Returns
    -------
    faces : (f, 3) int32
        In the new numbers of vertices.
    order : (v,) int64
        The old numbers of the vertices that are used.
    """
    if not len(faces):
        return np.zeros((0, 3), np.int32), np.zeros(0, np.int64)
    middle = vertices[faces[:, 0]] / 3 + vertices[faces[:, 1]] / 3 + vertices[faces[:, 2]] / 3
    ends = faces[space_order(middle)].ravel()
    first = np.full(len(vertices), len(ends), np.int64)
    first[ends[::-1]] = np.arange(len(ends))[::-1]
    used = np.flatnonzero(first < len(ends))
    order = used[np.argsort(first[used])]
    number = np.empty(len(vertices), np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    return number[ends].reshape(-1, 3), order


def draw_mesh(device: Device, scratch: Scratch, grid: Grid, upload: MeshUpload, matrix, camera, look: Look,
              number: int) -> None:
    """Draw one placed mesh into the planes of a grid."""
    floats = place_triangles(camera, grid.size, matrix, upload.origin, upload.center, upload.reach, look.shading.color)
    draw_triangles(device, scratch, grid, upload.triangles, floats, look, number)
