"""Traced light: shadows and ambient occlusion of a picture whose bins are drawn, before they are shaded.

The tile stages of all kinds of surfaces leave depth and normals in the bins' planes; rays from there find which lamps
and directions every point sees, and the light goes into the colour planes. Kernels: kernels/trace/trace_lights.cl,
kernels/render/light_bins.cl.
"""

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from ..surface.slim import SlimSurface
from ..trace.hits import trace
from ..trace.packets import packet_lanes, trace_lights
from ..trace.slim import TracedSlim, kept_traced
from .mirror import grain
from .shade import KINDS, Shading
from .tiles import BIN, Grid, Scratch, view_floats

LAMP_FLOATS = 8
LARGEST_LAMPS = 32  # bits of a word
LIFT_STEPS = 1.5  # spacings that shadow rays start above surfaces: rays see two flat triangles in each cell of a patch
REACH = 0.25  # of the scene's diagonal: what ambient occlusion looks for by default


def wants_traced_light(shading: Shading, channels) -> bool:
    """Return whether rays decide over the light of a picture."""
    return bool(shading.shadows or shading.occlusion) and shading.look == "phong" and "color" in channels


def light_grid(device: Device, scratch: Scratch, grid: Grid, scene, camera, shading: Shading, floats: NDArray,
               lamps: DeviceArray) -> None:
    """Light the planes of a picture: `floats` and `lamps` are the shading buffer on the host and on the device."""
    if shading.shadows and len(scene.lights) > LARGEST_LAMPS:
        raise InputError(f"shadows: expected at most {LARGEST_LAMPS} lights, got {len(scene.lights)}: leave some out")
    casters = [(kept_traced(device, surface), matrix) for surface, matrix in scene.placed
               if isinstance(surface, SlimSurface)]
    views = [device.upload(occluder_view(traced, matrix, camera, grid.size)) for traced, matrix in casters]
    bins = grid.bin_count
    shadows = directions = hidden = scratch.array("no_bits", (1,), np.uint32)
    count = 0
    if shading.shadows:
        shadows = scratch.array("shadows", (bins, 64), np.uint32)
        own = device.upload(floats[16:].reshape(-1, LAMP_FLOATS)) if len(scene.lights) else lamps
        cast(device, scratch, grid, casters, views, own, len(scene.lights), np.inf, shadows, 1, 0)
        cast_rays(device, grid, scene, camera, shadows)
    if shading.occlusion:
        lights = sphere_lamps(shading.occlusion, camera)
        count = len(lights)
        directions = device.upload(lights)
        device.check_memory(hidden=8 * count * bins)
        hidden = scratch.array("hidden", (bins, count // 32, 64), np.uint32)
        reach = shading.occlusion_reach
        if reach is None:
            reach = REACH * float(np.linalg.norm(np.nan_to_num(scene.bounds[1] - scene.bounds[0], nan=np.inf)))
        for word in range(count // 32):
            part = device.upload(np.ascontiguousarray(lights[32 * word:32 * word + 32]))
            cast(device, scratch, grid, casters, views, part, 32, reach, hidden, count // 32, word)
    constants = grid.layout.constants | {"VW": scratch.lanes, "OCCLUSION": count, "SHADOWS": int(shading.shadows)}
    items, group = ((64 * bins,), (64,)) if scratch.lanes == 1 else ((bins,), (16,))
    device.kernel("render/light_bins.cl", constants=constants)(
        items, group, device.upload(view_floats(camera, grid.size)), lamps, shadows, directions, hidden, grid.bins_x,
        bins, grid.touched, grid.planes)


def cast(device: Device, scratch: Scratch, grid: Grid, casters, views, lamps: DeviceArray, count: int,
         reach: float, mask: DeviceArray, words: int, word: int) -> None:
    """Fill word `word` of the mask (bins, words, 64) with the lamps that are hidden by any of the casters."""
    if not casters or not count:
        device.fill(mask, 0)
        return
    for i, ((traced, _), view) in enumerate(zip(casters, views, strict=True)):
        trace_lights(device, packet_lanes(scratch.lanes), traced, view, grid.layout.constants, lamps, count, reach,
                     i == 0, grid.bins_x, grid.bins_y, grid.touched, grid.planes, mask, 64 * words, 64 * word)


def cast_rays(device: Device, grid: Grid, scene, camera, mask: DeviceArray) -> None:
    """Add to the mask (bins, 64) the lamps that surfaces other than SLIM hide: single rays from points to lamps."""
    parts = [part for part in scene.surfaces if not isinstance(getattr(part, "surface", part), SlimSurface)]
    if not parts:
        return
    bins = np.flatnonzero(device.download(grid.touched) >= 0)
    planes = device.download(grid.planes)[bins, :4].astype(np.float64)
    at, pixel = np.nonzero(planes[:, 0] < np.inf)
    depth, gradient = planes[at, 0, pixel], planes[at, 1:4, pixel]
    x, y = bins[at] % grid.bins_x * BIN + pixel % BIN + 0.5, bins[at] // grid.bins_x * BIN + pixel // BIN + 0.5
    p = camera.projection(grid.size)
    across = depth if p.perspective else 1.0
    points = np.stack([(x - p.cx) / p.fx * across, (p.cy - y) / p.fy * across, -depth], axis=1)
    points = points @ camera.rotation + camera.eye
    normals = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-300) @ camera.rotation
    step = LIFT_STEPS * max(grain(*part) for part in scene.placed if not isinstance(part[0], SlimSurface))
    found = device.download(mask)
    for bit, light in enumerate(scene.lights):
        if light.kind == "headlight":
            continue
        vector = np.asarray(light.vector, np.float64)
        to = vector - points if light.kind == "point" else np.broadcast_to(vector, points.shape)
        want = (normals * to).sum(axis=1) > 0
        want &= found[bins[at], pixel] >> np.uint32(bit) & 1 == 0
        far = np.linalg.norm(to[want], axis=1) if light.kind == "point" else np.inf
        hidden = trace(parts, points[want] + step * normals[want], to[want], "any", near=step, far=far,
                       device=device).hit
        rows = np.flatnonzero(want)[hidden]
        found[bins[at[rows]], pixel[rows]] |= np.uint32(1 << bit)
    device.write(mask, found)


def occluder_view(traced: TracedSlim, matrix: NDArray | None, camera, size) -> NDArray:
    """Return the view buffer (kernels/common/view.clh) of a placed surface that throws shadows."""
    matrix = np.eye(4) if matrix is None else matrix
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    zero = matrix[:3, :3] @ traced.origin + matrix[:3, 3]
    return view_floats(camera, size, camera.rotation @ (matrix[:3, :3] / scale), camera.rotation @ (zero - camera.eye),
                       scale)


def sphere_lamps(directions: int, camera) -> NDArray:
    """Return directional lamps (n, 8) float32, view space, spread evenly over the sphere, fixed in the world.

    n is a multiple of 32, twice `directions` or the next larger one: half of them lie above any tangent plane.
    """
    n = -(-2 * directions // 32) * 32
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    flat = np.sqrt(1 - z * z)
    out = np.zeros((n, LAMP_FLOATS), np.float32)
    out[:, 0] = KINDS["directional"]
    out[:, 1:4] = np.stack([flat * np.cos(angle), z, flat * np.sin(angle)], axis=1) @ camera.rotation.T
    return out
