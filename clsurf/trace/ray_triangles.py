"""Meshes and spatial patches for single rays: triangles in blocks of 16. Kernel: kernels/trace/ray_triangles.cl."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import InputError
from ..surface.arrays import box_of, finite_rows, lengths_of, whole_faces
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.patch_mesh import patch_mesh
from ..surface.srgb import LINEAR_OF_BYTE
from .kinds import NOTHING, Plan, Traced, items, register
from .tree import WIDTH, node_boxes, plant, room

LARGEST_COUNT = 1 << 27
MARGIN = 1e-6  # of boxes, frame units: more than the kernel's rounding, as coordinates are at most 1 or so
FAR = 3.0  # where the triangle of an empty slot lies: outside the frame's box, and without area


@register(Mesh)
def plan_mesh(mesh: Mesh) -> Plan:
    """Plan the faces."""
    plan = plan_triangles(mesh, None)
    some = mesh.faces[::max(len(mesh.faces) // 10000, 1)]
    with np.errstate(invalid="ignore"):
        edges = lengths_of(mesh.vertices[some[:, 0]].astype(np.float64) - mesh.vertices[some[:, 1]])
    edge = float(np.nanmedian(edges)) if np.isfinite(edges).any() else np.inf
    grain = min(edge / 3, plan.grain)  # faces of boxes are large, and near to each other
    return replace(plan, grain=grain, colors=mesh_colors(mesh.faces, mesh.colors))


def mesh_colors(corners: NDArray, colors: NDArray | None):
    """Return the function from faces to the mean linear colour of their vertices; it keeps arrays, not the mesh."""
    return None if colors is None else lambda faces: LINEAR_OF_BYTE[colors[corners[faces], :3]].mean(axis=1)


@register(PatchSurface)
def plan_patches(surface: PatchSurface) -> Plan:
    """Plan two triangles for every opaque cell; a hit's primitive is its patch."""
    patch, i, j = surface.node_patches()
    m, n = surface.size[patch].T.astype(np.int64)
    first = np.flatnonzero((i < m - 1) & (j < n - 1))
    corners = np.stack([first, first + 1, first + m[first], first + m[first] + 1])
    whole = surface.opaque[corners].all(axis=0)
    plan = plan_triangles(patch_mesh(surface), np.tile(patch[first[whole]], 2))
    spacing = lengths_of(surface.axis_x)
    return replace(plan, grain=float(np.median(spacing)) if len(spacing) else 0.0,
                   colors=patch_colors(surface.colors, surface.color, surface.node_offset))


def patch_colors(colors: NDArray | None, color, node_offset: NDArray):
    """Return the function from patches to the mean linear colour of their nodes; it keeps arrays, not the surface."""
    if colors is None:
        return None if color is None else lambda patches: np.tile(LINEAR_OF_BYTE[np.asarray(color)], (len(patches), 1))

    def means(patches):
        sums = np.add.reduceat(LINEAR_OF_BYTE[colors[:, :3]], node_offset[:-1], axis=0)
        return (sums / np.diff(node_offset)[:, None])[patches]

    return means


def plan_triangles(mesh: Mesh, numbers: NDArray | None) -> Plan:
    """Plan faces, in a frame around the middle of the used vertices in which the longest side is 1/2 to 1.

    Parameters
    ----------
    numbers : (f,) int, optional
        What a hit's primitive is; by default the face. Faces with a vertex that is not finite are left out.
    """
    kept = np.flatnonzero(whole_faces(mesh.faces, finite_rows(mesh.vertices)))
    if not len(kept):
        nothing = Traced(mesh.origin, 1.0, NOTHING, lambda *_: None)
        return Plan(lambda *_: nothing, lambda: (np.zeros((0, 3)), np.zeros((0, 3))), nothing.grain)
    faces = mesh.faces[kept]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces.ravel()] = True
    points = mesh.vertices[used].astype(np.float64)
    low, high = box_of(points)
    middle, extent = low / 2 + high / 2, float((high / 2 - low / 2).max()) * 2
    unit = 2.0 ** math.ceil(math.log2(extent)) if extent > 0 else max(float(np.abs(middle).max()), 1.0)
    corners = ((mesh.vertices.astype(np.float64) - middle) / unit).astype(np.float32).take(faces, 0)
    order = (kept if numbers is None else numbers[kept]).astype(np.int32)
    half, center = (high - low) / 2 / unit + 1e-3, mesh.origin + middle
    frame = Traced(center, unit, np.stack([-half, half]), lambda *_: None)

    def hold(device, rows):
        some = slice(None) if rows is None else rows
        return replace(frame, launch=hold_triangles(device, corners[some], order[some]))

    return Plan(hold, lambda: (corners.min(axis=1).astype(np.float64), corners.max(axis=1).astype(np.float64)),
                frame.grain)


def hold_triangles(device: Device, corners: NDArray, order: NDArray):
    """Put triangles (f, 3, 3) of a frame, numbered `order` (f,), on the device; return what launches rays.

    Raises
    ------
    InputError
        More faces than a slot's number holds.
    DeviceMemoryError
    """
    if len(order) > LARGEST_COUNT:
        raise InputError(f"mesh: expected at most {LARGEST_COUNT:,} faces to trace, got {len(order):,}: split it")
    slots, nodes = room(len(order))
    device.check_memory(triangles=36 * slots, nodes=24 * WIDTH * nodes, numbers=4 * slots)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    below = np.minimum(np.minimum(a, b), c) - np.float32(MARGIN)
    above = np.maximum(np.maximum(a, b), c) + np.float32(MARGIN)
    tree = plant(device, below, above)
    blocks = tree.in_slots(corners.reshape(-1, 9), FAR).reshape(-1, WIDTH, 9).transpose(0, 2, 1)
    arrays = [device.upload(node_boxes(tree, below, above)), device.upload(np.ascontiguousarray(blocks)),
              device.upload(tree.in_slots(order, -1))]

    def launch(mode, count, rays, hits):
        size, group, batch = items(device, count)
        device.kernel("trace/ray_triangles.cl", constants={"VW": device.lanes, "MODE": mode})(
            size, group, count, batch, tree.roots, tree.first_bottom, *arrays, rays, hits)

    return launch
