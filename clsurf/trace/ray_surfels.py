"""Surfel hierarchies for single rays: the base surfels' discs, or the triangles below the hybrid form.

Kernel: kernels/trace/ray_surfels.cl.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..surface.arrays import box_of, finite_rows
from ..surface.srgb import LINEAR_OF_BYTE
from ..surface.surfel import SurfelHierarchy
from .kinds import NOTHING, Plan, Traced, items, register
from .ray_triangles import mesh_colors, plan_triangles
from .tree import WIDTH, node_boxes, plant, room

MARGIN = 1e-6  # of boxes, frame units: more than the kernel's rounding, as coordinates are at most 1 or so
DECIDES = 1.5  # largest radii past a ray's end within which discs decide on hits before it (ray_surfels.cl)


@register(SurfelHierarchy)
def plan_surfels(surface: SurfelHierarchy) -> Plan:
    """Plan the finest level, in a frame around its middle whose longest side is 1/2 to 1."""
    if surface.hybrid:
        return replace(plan_triangles(surface.mesh, None), grain=surface.spacing,
                       colors=mesh_colors(surface.triangles, surface.vertex_colors))
    base = surface.base
    usable = (finite_rows(surface.positions[base]) & finite_rows(surface.normals[base])
              & np.isfinite(surface.radii[base]) & (surface.radii[base] > 0))
    base = base[usable]
    if not len(base):
        nothing = Traced(surface.origin, 1.0, NOTHING, lambda *_: None)
        return Plan(lambda *_: nothing, lambda: (np.zeros((0, 3)), np.zeros((0, 3))), nothing.grain)
    positions, normals = surface.positions[base].astype(np.float64), surface.normals[base].astype(np.float64)
    radii = surface.radii[base].astype(np.float64)
    reach = radii[:, None] * np.sqrt(np.clip(1 - normals**2, 0, 1))
    low, high = box_of(positions - reach)[0], box_of(positions + reach)[1]
    middle, extent = low / 2 + high / 2, float((high / 2 - low / 2).max()) * 2
    unit = 2.0 ** math.ceil(math.log2(extent)) if extent > 0 else 1.0
    centers, reach, own = (positions - middle) / unit, reach / unit + MARGIN, radii / unit
    half, origin, largest = (high - low) / 2 / unit + 1e-3, surface.origin, float(own.max())
    fields = np.concatenate([centers, normals, own[:, None]], axis=1).astype(np.float32)

    def hold(device, rows):
        some = slice(None) if rows is None else rows
        launch = hold_discs(device, centers[some], reach[some], fields[some], base[some].astype(np.int32), largest,
                            rows is not None)
        return Traced(origin + middle, unit, np.stack([-half, half]), launch)

    colors = surface.colors
    return Plan(hold, lambda: (centers - reach, centers + reach), surface.spacing,
                None if colors is None else lambda surfels: LINEAR_OF_BYTE[colors[surfels, :3]],
                radii=own, blend=DECIDES, same=2e-6)


def hold_discs(device: Device, centers: NDArray, reach: NDArray, fields: NDArray, numbers: NDArray, largest: float,
               some: bool):
    """Put discs with the boxes centers -+ reach (n, 3) on the device; return what launches rays.

    `fields` (n, 7): position, normal, radius; `largest`: radius of the surface's largest disc; frame units.
    `some`: the discs are not all of the surface's.
    """
    slots, nodes = room(len(numbers))
    device.check_memory(discs=28 * slots, nodes=24 * WIDTH * nodes, numbers=4 * slots)
    tree = plant(device, centers - reach, centers + reach)
    blocks = tree.in_slots(fields, 0).reshape(-1, WIDTH, 7).transpose(0, 2, 1)  # empty slots have no radius
    arrays = [device.upload(node_boxes(tree, centers - reach, centers + reach)),
              device.upload(np.ascontiguousarray(blocks)), device.upload(tree.in_slots(numbers, -1))]

    def launch(mode, count, rays, hits):
        size, group, batch = items(device, count)
        device.kernel("trace/ray_surfels.cl", constants={"VW": device.lanes, "MODE": mode, "PIECES": some})(
            size, group, count, batch, tree.roots, tree.first_bottom, largest, *arrays, rays, hits)

    return launch
