"""Models that a device does not hold at once: drawn piece by piece into the same planes, in halves of halves.

Meshes, points, patches and surfel hierarchies are cut in space; a piece goes to the device, is drawn, and makes room
for the next. SLIM surfaces blend across any cut: pictures of them are drawn in bands instead (`bands`).
"""

import logging
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import DeviceMemoryError
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.ranges import RangeScan
from ..surface.surfel import SurfelHierarchy
from .points import attribute_range, space_order, upload_cloud

log = logging.getLogger("clsurf")


@dataclass(frozen=True, eq=False)
class CloudPiece:
    """A part of a cloud, with what its colours need to know of the whole.

    `ranges`: the least and largest value of each attribute that colours tell apart.
    """

    cloud: PointCloud
    ranges: dict = field(default_factory=dict)


def upload_piece(device, piece: CloudPiece):
    """Put a piece of a cloud on the device."""
    return replace(upload_cloud(device, piece.cloud), ranges=piece.ranges)


def draw_pieces(surface, kept, draw) -> None:
    """Draw a surface, or its halves where the device lacks memory for it.

    Parameters
    ----------
    kept : WeakKeyDictionary
        Surface to its halves, where they were needed before; changed.
    draw : callable
        draw(surface) raises DeviceMemoryError before it changes a pixel.
    """
    parts = kept.get(surface)
    if parts is None:
        try:
            draw(surface)
            return
        except DeviceMemoryError:
            parts = halves(surface)
            if parts is None:
                raise
            log.info("%r is more than the device holds at once: drawn in parts", surface)
            kept[surface] = parts
    for part in parts:
        draw_pieces(part, kept, draw)


def halves(surface) -> list | None:
    """Return two parts of a surface that drawn one after the other show it; None where it cannot be cut further."""
    if isinstance(surface, RangeScan):
        surface = surface.to_points()
    if isinstance(surface, PointCloud):
        surface = CloudPiece(surface, {name: attribute_range(values) for name, values in surface.attributes.items()
                                       if np.ndim(values) == 1 and np.asarray(values).dtype.kind in "fiub"})
    if isinstance(surface, CloudPiece):
        return _in_half(len(surface.cloud.points), lambda: space_order(surface.cloud.points),
                        lambda rows: CloudPiece(_points(surface.cloud, rows), surface.ranges))
    if isinstance(surface, Mesh):
        middles = lambda: surface.vertices[surface.faces].mean(axis=1, dtype=np.float32)  # noqa: E731
        return _in_half(len(surface.faces), lambda: space_order(np.nan_to_num(middles())),
                        lambda rows: _faces(surface, rows))
    if isinstance(surface, PatchSurface):  # patches stand in the order of the scan's parts: near ones together
        return _in_half(len(surface), lambda: np.arange(len(surface)), lambda rows: _patches(surface, rows))
    if isinstance(surface, SurfelHierarchy):
        return _subtrees(surface)
    return None


def _in_half(count: int, order, take) -> list | None:
    if count < 2:
        return None
    rows = order()
    return [take(np.sort(rows[:count // 2])), take(np.sort(rows[count // 2:]))]


def _points(cloud: PointCloud, rows: NDArray) -> PointCloud:
    take = lambda array: None if array is None else np.asarray(array)[rows]  # noqa: E731
    return PointCloud(take(cloud.points), take(cloud.normals), take(cloud.colors), origin=cloud.origin,
                      attributes={name: take(values) for name, values in cloud.attributes.items()})


def _faces(mesh: Mesh, rows: NDArray) -> Mesh:
    used, faces = np.unique(mesh.faces[rows], return_inverse=True)
    take = lambda array: None if array is None else array[used]  # noqa: E731
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), normals=take(mesh.normals),
                colors=take(mesh.colors), uv=take(mesh.uv), texture=mesh.texture, origin=mesh.origin)


def _patches(surface: PatchSurface, rows: NDArray) -> PatchSurface:
    """Return consecutive patches; their nodes are not copied."""
    own = slice(int(rows[0]), int(rows[-1]) + 1)
    nodes = slice(int(surface.node_offset[own.start]), int(surface.node_offset[own.stop]))
    return replace(surface, origins=surface.origins[own], axis_x=surface.axis_x[own], axis_y=surface.axis_y[own],
                   axis_z_length=surface.axis_z_length[own], size=surface.size[own],
                   displacements=surface.displacements[nodes],
                   colors=None if surface.colors is None else surface.colors[nodes])


def _subtrees(surface: SurfelHierarchy) -> list | None:
    """Return the subtrees below the coarsest level that has more than one surfel, in two groups."""
    levels, counts = np.unique(surface.level, return_counts=True)
    if not (counts > 1).any():
        return None
    roots = np.flatnonzero(surface.level == levels[np.argmax(counts > 1)])
    group = np.full(len(surface), -1, np.int8)
    group[roots[space_order(surface.positions[roots])][:len(roots) // 2]] = 0
    group[roots[space_order(surface.positions[roots])][len(roots) // 2:]] = 1
    parent = np.repeat(np.arange(len(surface)), np.diff(surface.child_offset))
    for level in levels:
        links = surface.level[parent] == level
        below = group[parent[links]] >= 0
        group[surface.children[links][below]] = group[parent[links]][below]
    return [_surfels(surface, group == one) for one in (0, 1)]


def _surfels(surface: SurfelHierarchy, keep: NDArray) -> SurfelHierarchy:
    rows = np.flatnonzero(keep)
    number = np.cumsum(keep) - 1
    parent = np.repeat(np.arange(len(surface)), np.diff(surface.child_offset))
    links = keep[parent] & keep[surface.children]
    texels, texel_offset = _runs(surface.map_offset[rows], surface.map_size[rows].astype(np.int64) ** 2)
    take = lambda array, at: None if array is None else array[at]  # noqa: E731
    more = {}
    if surface.triangles is not None:
        first = surface.triangle_offset[rows]
        own, offset = _runs(first, surface.triangle_offset[rows + 1] - first)
        used, triangles = np.unique(surface.triangles[own], return_inverse=True)
        more = {"triangles": triangles.reshape(-1, 3).astype(np.int32), "triangle_offset": offset,
                **{name: take(getattr(surface, name), used) for name in ("vertices", "vertex_normals",
                                                                         "vertex_colors")}}
    names = ("positions", "normals", "radii", "spheres", "heights", "spreads", "level", "map_size", "colors")
    return replace(surface, **{name: take(getattr(surface, name), rows) for name in names},
                   child_offset=np.concatenate([[0], np.cumsum(np.bincount(
                       number[parent[links]], minlength=len(rows)))]).astype(np.int32),
                   children=number[surface.children[links]].astype(np.int32), map_offset=texel_offset[:-1],
                   normal_atlas=surface.normal_atlas[texels], color_atlas=take(surface.color_atlas, texels), **more)


def _runs(first: NDArray, counts: NDArray) -> tuple[NDArray, NDArray]:
    """Return the indices of runs that begin at `first`, one after the other, and where each begins there."""
    offset = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return np.repeat(first - offset[:-1], counts) + np.arange(offset[-1]), offset.astype(np.int32)
