"""Traced light: shadows and ambient occlusion of a picture whose bins are drawn, before they are shaded.

The tile stages of all kinds of surfaces leave depth and normals in the bins' planes; rays from there find which lamps
and directions every point sees (casters.py), and `light_bins` takes it from there.
"""

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from .casters import cast, casters_of, fresh_mask
from .light import KINDS, LIGHT_FLOATS
from .lighting import Lighting, light_bins
from .shade import HEAD_FLOATS, Shading
from .sky import sky_lamps
from .tiles import Grid, Scratch

LAMP_FLOATS = 8
LARGEST_LAMPS = 32  # bits of a word
REACH = 0.25  # of the scene's diagonal: what ambient occlusion looks for by default


def light_grid(device: Device, scratch: Scratch, grid: Grid, scene, camera, shading: Shading, floats: NDArray,
               lamps: DeviceArray, lighting: Lighting) -> None:
    """Light the planes of a picture: `floats` and `lamps` are the shading buffer on the host and on the device."""
    own = shadow_lamps(floats)
    shadowed, occluded = shading.shadows and lighting.lit, shading.occlusion and lighting.lit
    if shadowed and len(own) > LARGEST_LAMPS:
        raise InputError(f"shadows: expected at most {LARGEST_LAMPS} lights, got {len(own)}: leave some out")
    casters = casters_of(device, grid, scene, camera) if shadowed or occluded else None
    bins = grid.bin_count
    shadows = directions = hidden = scratch.array("no_bits", (1,), np.uint32)
    count = 0
    if shadowed:
        shadows = fresh_mask(device, scratch, casters, "shadows", bins, 1, own)
        cast(device, scratch, grid, casters, own, np.inf, shadows)
    if occluded:
        lights = sphere_lamps(shading.occlusion, camera)
        if lighting.sky is not None:
            axes = lighting.light.axes() @ camera.rotation.T
            lights[:, 4:7] = sky_lamps(lighting.sky, lights[:, 1:4].astype(np.float64) @ axes.T)
        count = len(lights)
        directions = device.upload(lights)
        device.check_memory(hidden=8 * count * bins)
        hidden = fresh_mask(device, scratch, casters, "hidden", bins, count // 32, lights)
        reach = shading.occlusion_reach
        if reach is None:
            reach = REACH * float(np.linalg.norm(np.nan_to_num(scene.bounds[1] - scene.bounds[0], nan=np.inf)))
        cast(device, scratch, grid, casters, lights, reach, hidden)
    light_bins(device, scratch, grid, camera, lamps, lighting, shadows, shadowed, directions, hidden, count)


def shadow_lamps(floats: NDArray) -> NDArray:
    """Return the lamps (n, 8) float32 of a shading buffer as rays want them: kind and vector; a spot is a point."""
    lamps = floats[HEAD_FLOATS:].reshape(-1, LIGHT_FLOATS)
    out = np.zeros((len(lamps), LAMP_FLOATS), np.float32)
    out[:, :4] = lamps[:, :4]
    out[lamps[:, 0] == KINDS["spot"], 0] = KINDS["point"]
    return out
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
