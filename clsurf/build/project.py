"""Nearest points of surfaces."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, open_device
from ..device.arrays import DeviceArray
from ..errors import InputError
from ..io.stored import StoredSurface
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.patch_mesh import patch_mesh
from ..surface.placed import Placed
from ..surface.scale_map import ScaleMap
from ..surface.slim import SlimSurface, frame_of_normals
from ..surface.surfel import SurfelHierarchy
from .point_tree import BLOCK, build_boxes, column_bounds, morton_order
from .project_mesh import project_mesh
from .project_scale_map import project_scale_map
from .project_stored import project_stored
from .project_surfels import project_surfels

LEAF = 24  # floats a leaf (project_points.cl)
BATCH = 1 << 22  # queries of one launch


@dataclass(frozen=True, eq=False, repr=False)
class Projection:
    """Nearest points on a surface, world space, float64.

    Attributes
    ----------
    position, normal : (n, 3)
        Normals are unit and oriented as the surface.
    distance : (n,)
        Signed, world units: positive on the side that the normal points to.
    """

    position: NDArray
    normal: NDArray
    distance: NDArray

    def __repr__(self):
        return f"Projection({len(self.distance):,} points)"


@dataclass(eq=False)
class LeafTree:
    """A surface's leaves on a device, with a tree over their balls; coordinates (x - middle) / unit."""

    device: Device
    degree: int
    count: int
    padded: int
    records: DeviceArray  # (count, LEAF) float32
    balls: DeviceArray  # (4, padded) float32: centre and radius
    boxes: DeviceArray
    node_offset: DeviceArray
    top_level: int
    margin: float  # first guess of a query's distance
    middle: NDArray  # (3,) float64, relative to the surface's origin
    unit: float  # world length of 1


def project(surface, points, device=None) -> Projection:
    """Project points onto a surface.

    Parameters
    ----------
    surface : SlimSurface, StoredSurface, PatchSurface, SurfelHierarchy, ScaleMap, Mesh or Placed
        A SLIM surface's leaves are used; of a hierarchy the base surfels, blended, or the triangles; of patches the
        triangles between their opaque nodes. Of a StoredSurface the parts around the points are read, within its
        budget.
    points : (n, 3) array_like
        World positions, float64.
    device : None, str or Device

    Returns
    -------
    Projection
        Points far from the surface (against its radius of curvature) get a near point, not always the nearest. On a
        scale map the nearest point to second order in the texels' size; normals point outward. On triangles the nearest
        point, and the sign of the distance is right at edges and vertices too.

    Raises
    ------
    InputError
        Positions of another shape or not finite, or a surface without leaves.
    """
    try:
        points = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"points: expected an array of numbers of shape (n, 3), got {points!r:.60}") from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points: expected an array of shape (n, 3), got {points.shape}")
    if not np.isfinite(points).all():
        raise InputError("points: expected finite positions, got NaN or infinity: leave those out")
    if isinstance(surface, Placed):
        linear, scale = surface.matrix[:3, :3], surface.scale
        local = (points - surface.matrix[:3, 3]) @ linear / scale**2  # the inverse of a similarity
        near = project(surface.surface, local, device)
        return Projection(near.position @ linear.T + surface.matrix[:3, 3], near.normal @ linear.T / scale,
                          near.distance * scale)
    if isinstance(surface, StoredSurface):
        return Projection(*project_stored(surface, points, open_device(device)))
    if isinstance(surface, SurfelHierarchy):
        return Projection(*project_surfels(surface, points, open_device(device)))
    if isinstance(surface, ScaleMap):
        return Projection(*project_scale_map(surface, points, open_device(device)))
    if isinstance(surface, PatchSurface):
        surface = patch_mesh(surface)
    if isinstance(surface, Mesh):
        return Projection(*project_mesh(surface, points, open_device(device)))
    if not isinstance(surface, SlimSurface):
        raise InputError("surface: expected a SlimSurface, StoredSurface, PatchSurface, SurfelHierarchy, ScaleMap or "
                         f"Mesh, or one of these placed, got {type(surface).__name__}")
    device = open_device(device)
    tree = leaf_tree(surface, device)
    shift = surface.origin + tree.middle
    out = np.empty((7, len(points)))
    for start in range(0, len(points), BATCH):
        part = points[start:start + BATCH]
        local = np.ascontiguousarray((part - shift) / tree.unit, np.float32)
        order, _, _ = morton_order(local, device)
        padded = -(-len(local) // BLOCK) * BLOCK
        queries = np.zeros((3, padded), np.float32)
        queries[:, :len(local)] = local[order].T
        result = project_sorted(tree, device.upload(queries), len(local), padded)
        out[:, start + order] = device.download(result, copy=False)[:, :len(local)]
    return Projection(np.ascontiguousarray(out[:3].T * tree.unit + shift), np.ascontiguousarray(out[3:6].T),
                      out[6] * tree.unit)


def leaf_tree(surface: SlimSurface, device: Device, middle: NDArray | None = None) -> LeafTree:
    """Put the leaves of `surface` on `device`, sorted along the Morton curve, in coordinates (x - middle) / diagonal.

    Parameters
    ----------
    middle : (3,) float64, optional
        Relative to the surface's origin; the middle of the leaves where not given.
    """
    leaf = np.flatnonzero(surface.leaf)
    if len(leaf) == 0:
        raise InputError("surface: expected at least one leaf, got none")
    centers = surface.centers[leaf]
    if middle is None:
        middle = (column_bounds(centers) / 2).sum(axis=0, dtype=np.float64)
    unit = surface.diagonal
    order, _, _ = morton_order(centers, device)
    leaf = leaf[order]
    count, padded = len(leaf), -(-len(leaf) // BLOCK) * BLOCK
    records = np.zeros((count, LEAF), np.float32)
    normals = surface.normals[leaf]
    records[:, 0:3] = (surface.centers[leaf] - middle) / unit
    records[:, 3] = surface.radii[leaf] / unit
    records[:, 4:7] = normals
    records[:, 7:10], records[:, 10:13] = frame_of_normals(normals)
    degree_of_term = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])[:surface.coefficients.shape[1]]
    records[:, 13:13 + len(degree_of_term)] = surface.coefficients[leaf] * unit ** (degree_of_term - 1.0)
    balls = np.repeat(records[-1:, :4].T, padded, axis=1)
    balls[3] = -1  # what pads the last block neither widens its box nor is ever near
    balls[:, :count] = records[:, :4].T
    on_device = device.upload(balls)
    boxes, node_offset, top_level = build_boxes(on_device, padded, device, radius=device.upload(balls[3]))
    return LeafTree(device, surface.degree, count, padded, device.upload(records), on_device, boxes, node_offset,
                    top_level, float(np.median(records[:, 3])) * 0.1, middle, unit)


def project_sorted(tree: LeafTree, queries: DeviceArray, count: int, stride: int) -> DeviceArray:
    """Return (7, stride) float32: position, normal and signed distance in the tree's coordinates.

    Parameters
    ----------
    queries : DeviceArray
        At least (3, stride) float32 in the tree's coordinates; neighbours should stand together.
    """
    device = tree.device
    out = device.empty((7, stride), np.float32)
    kernel = device.kernel("build/project_points.cl", constants={"DEGREE": tree.degree})
    packets = -(-count // BLOCK)
    kernel((packets,), (1,), count, stride, queries, tree.records, tree.padded, tree.balls, tree.boxes,
           tree.node_offset, tree.top_level, tree.margin, out)
    return out
