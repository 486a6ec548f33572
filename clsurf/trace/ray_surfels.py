"""Surfel hierarchies for single rays: the base surfels' discs, or the triangles below the hybrid form.

Kernel: kernels/trace/ray_surfels.cl.
"""

import math
from dataclasses import replace

import numpy as np

from ..device import Device
from ..surface.srgb import LINEAR_OF_BYTE
from ..surface.surfel import SurfelHierarchy
from .kinds import NOTHING, Traced, items, register
from .ray_triangles import mesh_colors, trace_triangles
from .tree import WIDTH, node_boxes, plant

MARGIN = 1e-6  # of boxes, frame units: more than the kernel's rounding, as coordinates are at most 1 or so


@register(SurfelHierarchy)
def trace_surfels(device: Device, surface: SurfelHierarchy) -> Traced:
    """Put the finest level on the device, in a frame around its middle whose longest side is 1/2 to 1."""
    if surface.hybrid:
        return replace(trace_triangles(device, surface.mesh, None), grain=surface.spacing,
                       colors=mesh_colors(surface.triangles, surface.vertex_colors))
    base = surface.base
    usable = (np.isfinite(surface.positions[base]).all(axis=1) & np.isfinite(surface.normals[base]).all(axis=1)
              & np.isfinite(surface.radii[base]) & (surface.radii[base] > 0))
    base = base[usable]
    bottoms = 16 * -(-len(base) // WIDTH) / 15
    device.check_memory(discs=int(bottoms * 28 * WIDTH), nodes=int(bottoms * 24 * WIDTH / 15))
    if not len(base):
        return Traced(surface.origin, 1.0, NOTHING, lambda *_: None)
    positions, normals = surface.positions[base].astype(np.float64), surface.normals[base].astype(np.float64)
    radii = surface.radii[base].astype(np.float64)
    reach = radii[:, None] * np.sqrt(np.clip(1 - normals**2, 0, 1))
    low, high = (positions - reach).min(axis=0), (positions + reach).max(axis=0)
    middle, extent = low / 2 + high / 2, float((high / 2 - low / 2).max()) * 2
    unit = 2.0 ** math.ceil(math.log2(extent)) if extent > 0 else 1.0
    centers, reach, own = (positions - middle) / unit, reach / unit + MARGIN, radii / unit
    tree = plant(device, centers - reach, centers + reach)
    fields = np.concatenate([centers, normals, own[:, None]], axis=1).astype(np.float32)
    blocks = tree.in_slots(fields, 0).reshape(-1, WIDTH, 7).transpose(0, 2, 1)  # empty slots have no radius
    arrays = [device.upload(node_boxes(tree, centers - reach, centers + reach)),
              device.upload(np.ascontiguousarray(blocks)), device.upload(tree.in_slots(base.astype(np.int32), -1))]

    def launch(mode, count, rays, hits):
        size, group, batch = items(device, count)
        device.kernel("trace/ray_surfels.cl", constants={"VW": device.lanes, "MODE": mode})(
            size, group, count, batch, tree.roots, tree.first_bottom, float(own.max()), *arrays, rays, hits)

    half = (high - low) / 2 / unit + 1e-3
    colors = surface.colors
    return Traced(surface.origin + middle, unit, np.stack([-half, half]), launch, surface.spacing,
                  colors=None if colors is None else lambda surfels: LINEAR_OF_BYTE[colors[surfels, :3]])
