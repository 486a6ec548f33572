"""Traced light: shadows and ambient occlusion of a picture whose bins are drawn, before they are shaded.

The tile stages of all kinds of surfaces leave depth and normals in the bins' planes; rays from there find which lamps
and directions every point sees (casters.py), and the light goes into the colour planes. Kernel:
kernels/render/light_bins.cl.
"""

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from .casters import cast, casters_of
from .shade import KINDS, Shading
from .tiles import Grid, Scratch, view_floats

LAMP_FLOATS = 8
LARGEST_LAMPS = 32  # bits of a word
REACH = 0.25  # of the scene's diagonal: what ambient occlusion looks for by default


def wants_traced_light(shading: Shading, channels) -> bool:
    """Return whether rays decide over the light of a picture."""
    return bool(shading.shadows or shading.occlusion) and shading.look == "phong" and "color" in channels


def light_grid(device: Device, scratch: Scratch, grid: Grid, scene, camera, shading: Shading, floats: NDArray,
               lamps: DeviceArray) -> None:
    """Light the planes of a picture: `floats` and `lamps` are the shading buffer on the host and on the device."""
    if shading.shadows and len(scene.lights) > LARGEST_LAMPS:
        raise InputError(f"shadows: expected at most {LARGEST_LAMPS} lights, got {len(scene.lights)}: leave some out")
    casters = casters_of(device, grid, scene, camera)
    bins = grid.bin_count
    shadows = directions = hidden = scratch.array("no_bits", (1,), np.uint32)
    count = 0
    if shading.shadows:
        shadows = scratch.array("shadows", (bins, 64), np.uint32)
        cast(device, scratch, grid, casters, floats[16:].reshape(-1, LAMP_FLOATS), np.inf, shadows, 1, 0)
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
            cast(device, scratch, grid, casters, lights[32 * word:32 * word + 32], reach, hidden, count // 32, word)
    constants = grid.layout.constants | {"VW": scratch.lanes, "OCCLUSION": count, "SHADOWS": int(shading.shadows)}
    items, group = ((64 * bins,), (64,)) if scratch.lanes == 1 else ((bins,), (16,))
    device.kernel("render/light_bins.cl", constants=constants)(
        items, group, device.upload(view_floats(camera, grid.size)), lamps, shadows, directions, hidden, grid.bins_x,
        bins, grid.touched, grid.planes)


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
