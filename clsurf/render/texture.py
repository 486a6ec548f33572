"""Textures on a device: levels of half the size each, averaged in linear light. Kernel: kernels/render/texture.clh."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..surface.srgb import LINEAR_OF_BYTE, to_srgb


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture and its smaller versions on a device."""

    texels: DeviceArray  # (n, 4) uint8 sRGB, all levels one after the other
    levels: DeviceArray  # (levels, 4) int32: first texel, width, height
    linear: DeviceArray  # (256,) float32: of bytes
    size: tuple[int, int]  # width, height of the first level


def upload_texture(device: Device, picture: NDArray) -> Texture:
    """Put a picture (h, w, 4) uint8, sRGB, on the device.

    Raises
    ------
    DeviceMemoryError
    """
    height, width = picture.shape[:2]
    device.check_memory(texture=4 * height * width * 4 // 3 + 64)
    levels = texture_levels(picture)
    counts = [level.shape[0] * level.shape[1] for level in levels]
    rows = np.zeros((len(levels), 4), np.int32)
    rows[:, 0] = np.cumsum([0, *counts[:-1]])
    rows[:, 1], rows[:, 2] = [level.shape[1] for level in levels], [level.shape[0] for level in levels]
    return Texture(device.upload(np.concatenate([level.reshape(-1, 4) for level in levels])), device.upload(rows),
                   device.upload(LINEAR_OF_BYTE.astype(np.float32)), (width, height))


def texture_levels(picture: NDArray) -> list[NDArray]:
    """Return `picture` (h, w, 4) uint8 and its halves down to one texel; each texel is the mean of those below it."""
    levels = [np.ascontiguousarray(picture)]
    now = LINEAR_OF_BYTE.astype(np.float32)[picture[..., :3]]
    while max(now.shape[:2]) > 1:
        for axis in (0, 1):
            n = now.shape[axis]
            if n > 1:
                # An odd last row goes into the one before it.
                starts = np.arange(0, n - 1, 2)
                now = np.add.reduceat(now, starts, axis=axis)
                counts = np.diff(np.append(starts, n)).astype(np.float32)
                now /= counts.reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        level = np.full((*now.shape[:2], 4), 255, np.uint8)
        level[..., :3] = np.rint(255 * to_srgb(now))
        levels.append(level)
    return levels
