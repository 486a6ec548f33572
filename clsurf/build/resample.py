"""Meshes to range images: heights and colours of faces over the nodes of patches."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..surface.arrays import lengths_of
from ..surface.mesh import Mesh
from ..surface.srgb import LINEAR_OF_BYTE

VERTEX_COLORS, FACE_COLORS, TEXTURE = 1, 2, 3  # SOURCE of resample_colors.cl
REACH = 1.25  # node steps, see resample_heights.cl
FACE_TURNS = 256  # of resample_heights.cl's loops for a face of two steps a side
LEAST_ALPHA = 128  # nodes that cannot hold alpha are transparent below it


@dataclass(frozen=True)
class Frames:
    """Where the nodes of patches lie, relative to the mesh's origin."""

    origins: NDArray  # (p, 3) float64: node (0, 0) at height 0
    axis_x: NDArray  # (p, 3) float64, world units a node step
    axis_y: NDArray  # (p, 3) float64, perpendicular to axis_x
    size: NDArray  # (p, 2) int32: nodes along axis_x and axis_y

    def __len__(self):
        return len(self.origins)

    @property
    def node_offset(self) -> NDArray:
        """(p + 1,) int32: the first node of each patch, and the number of all."""
        return np.concatenate([[0], np.cumsum(self.size.astype(np.int64).prod(axis=1))]).astype(np.int32)

    @property
    def unit_z(self) -> NDArray:
        """(p, 3) float64: the direction of heights."""
        z = np.cross(self.axis_x, self.axis_y)
        return z / lengths_of(z, keepdims=True)


@dataclass(frozen=True)
class FaceLists:
    """The faces of patches: of patch k ``faces[offset[k]:offset[k + 1]]``, the first `own[k]` of them its own."""

    faces: NDArray  # int32
    offset: NDArray  # (p + 1,) int32
    own: NDArray  # (p,) int32


def resample_faces(device, mesh: Mesh, frames: Frames, lists: FaceLists, precise: bool = False,
                   reach: float = REACH,
                   cut: NDArray | None = None) -> tuple[NDArray, NDArray | None, NDArray]:
    """Project faces orthogonally onto the nodes of patches.

    Parameters
    ----------
    device : Device
    mesh : Mesh
        Its texture is taken, otherwise ``attributes["face_colors"]``, (f, 3 or 4) uint8, otherwise vertex colours.
    frames : Frames
    lists : FaceLists
        Own faces are covered wholly by the opaque cells of the patch, as far as its grid reaches; the faces around them
        (those that share a vertex with them, and once more) give the heights of the nodes just beyond.
    precise : bool
        Keep alpha; otherwise nodes of less than half alpha are transparent.
    reach : float
        Half the side, in node steps, of the square around a needed node that meets an own face; 1: exactly the
        corners of the cells that own faces meet.
    cut : (v,) uint8, optional
        1: a vertex on an edge that own faces are not carried on over (patch_strips.py).

    Returns
    -------
    heights : (N,) float64
        World units over the plane of the patch; NaN: transparent.
    colors : (N, 3 or 4) uint8 or None
        sRGB, with straight alpha where `precise`; None where the mesh has no colours.
    source : (N,) int32
        Face that a node's height comes from, -1 for none.

    Notes
    -----
    The paper on spatial patches, section 4.1.
    """
    count, offset = len(frames), frames.node_offset
    cut = np.zeros(len(mesh.vertices), np.uint8) if cut is None else cut
    nodes = int(offset[-1])
    if not nodes:
        return np.zeros(0), None, np.zeros(0, np.int32)
    device.check_memory(nodes=20 * nodes, lists=lists.faces.nbytes, mesh=mesh.nbytes)
    packed, size, offset = device.upload(_packed(frames)), device.upload(frames.size, np.int32), device.upload(offset)
    heights, source = device.empty(nodes, np.float32), device.empty(nodes, np.int32)
    kernel = device.kernel("build/resample_heights.cl", constants={"REACH": f"{float(reach)!r}f"})
    rows, faces_at_once = _at_once(device, frames.size, lists)
    most, bands = max(int(np.diff(lists.offset).max(initial=1)), 1), -(-int(frames.size[:, 1].max()) // rows)
    arrays = [device.upload(array, dtype) for array, dtype in (
        (lists.offset, np.int32), (lists.own, np.int32), (lists.faces, np.int32), (mesh.faces, None),
        (mesh.vertices, None), (cut, np.uint8))]
    faces, vertices = arrays[3:5]
    scratch = device.empty(nodes, np.float32), device.empty(nodes, np.float32)
    for begin in range(0, most, faces_at_once):
        end = min(begin + faces_at_once, most)
        kernel((count * bands,), (1,), count, rows, bands, begin, end, int(end == most), packed, size, offset, *arrays,
               *scratch, heights, source)
    colors, kind = _colors_of(mesh), 0
    if colors is not None:
        kind, texels, width, height = colors
        uv = mesh.uv if kind == TEXTURE else np.zeros((1, 2), np.float32)
        out = device.empty((nodes, 4), np.uint8)
        device.kernel("build/resample_colors.cl", constants={"SOURCE": kind})(
            (count,), (1,), count, packed, size, offset, source, faces, vertices, device.upload(texels), width, height,
            device.upload(uv), device.upload(LINEAR_OF_BYTE.astype(np.float32)), out)
    z, found = device.download(heights).astype(np.float64), device.download(source)
    if colors is None:
        return z, None, found
    rgba = device.download(out)
    z[rgba[:, 3] < (1 if precise else LEAST_ALPHA)] = np.nan
    return z, rgba if precise else np.ascontiguousarray(rgba[:, :3]), found


def _at_once(device, size: NDArray, lists) -> tuple[int, int]:
    """Return the rows of nodes of a work-item of resample_heights.cl, and the faces of a launch."""
    rows, faces = int(size[:, 1].max()), max(int(np.diff(lists.offset).max(initial=1)), 1)
    if device.loop_turns is not None:  # half for the nodes, half for the faces
        rows = max(min(rows, device.loop_turns // (4 * int(size[:, 0].max()))), 1)
        return rows, max(device.loop_turns // 2 // FACE_TURNS, 1)
    return rows, faces


def area_lists(owner: NDArray, count: int, corners: NDArray, rings: int = 2) -> FaceLists:
    """Return the faces of every area, and those around them.

    Parameters
    ----------
    owner : (f,) int
        Area of every face, -1 for none.
    count : int
        Number of areas.
    corners : (f, 3) int
        Vertices of every face; vertices at one place under one number.
    rings : int
        How many times the faces that share a vertex are added.
    """
    faces = len(corners)
    vertices = int(corners.max()) + 1 if faces else 0
    owned = np.flatnonzero(owner >= 0)
    own = sparse.csr_matrix((np.ones(len(owned), np.int32), (owner[owned], owned)), (count, faces))
    touch = sparse.csr_matrix((np.ones(3 * faces, np.int32), corners.ravel(), 3 * np.arange(faces + 1)),
                              (faces, vertices))
    around, back = own, touch.T.tocsr()
    for _ in range(rings):
        around = (around @ touch) @ back
        around.data[:] = 1
    area = np.repeat(np.arange(count), np.diff(around.indptr))
    theirs = owner[around.indices] == area
    order = np.lexsort((around.indices, ~theirs, area))
    return FaceLists(around.indices[order].astype(np.int32), around.indptr.astype(np.int32),
                     np.bincount(area[theirs], minlength=count).astype(np.int32))


def _packed(frames: Frames) -> NDArray:
    """Return the frames (p, 13) float32 as patch_frame.clh reads them."""
    x2 = np.einsum("ij,ij->i", frames.axis_x, frames.axis_x)[:, None]
    y2 = np.einsum("ij,ij->i", frames.axis_y, frames.axis_y)[:, None]
    step = (x2 * y2) ** 0.25
    return np.concatenate([frames.origins, frames.axis_x / x2, frames.axis_y / y2, frames.unit_z / step, step],
                          axis=1).astype(np.float32)


def _colors_of(mesh: Mesh):
    """Return (SOURCE, bytes, width, height) of the mesh's colours, or None."""
    if mesh.texture is not None and mesh.uv is not None and mesh.texture.size:
        height, width = mesh.texture.shape[:2]
        return TEXTURE, mesh.texture, width, height
    of_faces = mesh.attributes.get("face_colors")
    if of_faces is not None and np.shape(of_faces) in ((len(mesh.faces), 3), (len(mesh.faces), 4)):
        return FACE_COLORS, rgba_of(of_faces), 0, 0
    return None if mesh.colors is None else (VERTEX_COLORS, mesh.colors, 0, 0)


def has_colors(mesh: Mesh) -> bool:
    """Return whether patches of the mesh have colours."""
    return _colors_of(mesh) is not None


def rgba_of(colors) -> NDArray:
    """Return (n, 3 or 4) uint8 colours as (n, 4), opaque where they have no alpha."""
    colors = np.asarray(colors, np.uint8)
    out = np.full((len(colors), 4), 255, np.uint8)
    out[:, :colors.shape[1]] = colors
    return out
