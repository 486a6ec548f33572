"""Meshes in the renderer: upload and placement; the tile stage is that of triangles."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..surface.mesh import Mesh
from ..surface.srgb import LINEAR_OF_BYTE
from .shade import Look
from .tiles import Grid, Scratch
from .triangles import Triangles, draw_triangles, place_triangles

MORTON_BITS = 10  # an axis, of the order in which faces are drawn


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
    finite = np.isfinite(mesh.vertices).all(axis=1)
    faces = mesh.faces if finite.all() else mesh.faces[finite[mesh.faces].all(axis=1)]
    points = mesh.vertices[finite].astype(np.float64)
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    center = low / 2 + high / 2
    colors = None if mesh.colors is None else _fours(LINEAR_OF_BYTE[mesh.colors[:, :3]])
    triangles = Triangles(device.upload(_fours(mesh.vertices)), device.upload(faces[face_order(mesh.vertices, faces)]),
                          None if mesh.normals is None else device.upload(_fours(mesh.normals)),
                          None if colors is None else device.upload(colors))
    return MeshUpload(triangles, mesh.origin, center, float(np.linalg.norm(high - center)))


def _fours(rows) -> NDArray:
    """Return rows (n, 3) as (n, 4) float32."""
    out = np.zeros((len(rows), 4), np.float32)
    out[:, :3] = rows
    return out


def face_order(vertices: NDArray, faces: NDArray) -> NDArray:
    """Return the order (f,) of faces along the Morton curve of their middles, so that neighbours lie close."""
    if not len(faces):
        return np.zeros(0, np.int64)
    middle = vertices[faces[:, 0]] + vertices[faces[:, 1]] + vertices[faces[:, 2]]
    low = middle.min(axis=0)
    extent = max(float((middle.max(axis=0) - low).max()), 1e-30)
    cell = ((middle - low) * np.float32(((1 << MORTON_BITS) - 1) / extent)).astype(np.uint32)
    code = np.zeros(len(faces), np.uint32)
    for axis in range(3):
        code |= _spread(cell[:, axis]) << np.uint32(axis)
    return np.argsort(code, kind="stable")


def _spread(x: NDArray) -> NDArray:
    """Return the low 10 bits of x (n,) uint32 with two free bits between each."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        x = (x | x << np.uint32(shift)) & np.uint32(mask)
    return x


def draw_mesh(device: Device, scratch: Scratch, grid: Grid, upload: MeshUpload, matrix, camera, look: Look,
              number: int) -> None:
    """Draw one placed mesh into the planes of a grid."""
    floats = place_triangles(camera, grid.size, matrix, upload.origin, upload.center, upload.reach, look.shading.color)
    draw_triangles(device, scratch, grid, upload.triangles, floats, look, number)
