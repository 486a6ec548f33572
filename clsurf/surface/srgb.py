"""sRGB and linear light: the one home of the curve (IEC 61966-2-1) and of what files' bytes mean."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


def to_linear(srgb) -> NDArray:
    """Return the linear light, float64, of sRGB values from 0 to 1."""
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def linear_color(srgb) -> NDArray:
    """Return the linear light of a colour, read-only; those that came before are looked up: 3 a frame, 10 us each."""
    return _linear_color(tuple(map(float, srgb)))


@lru_cache(maxsize=1024)
def _linear_color(srgb):
    out = to_linear(srgb)
    out.flags.writeable = False
    return out


def to_srgb(linear) -> NDArray:
    """Return the sRGB values of linear light, clipped to 0 to 1 (NaN: 0); floats keep their precision."""
    linear = np.clip(np.nan_to_num(linear), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


# Linear light of the 256 values of a byte, float64.
LINEAR_OF_BYTE = to_linear(np.arange(256) / 255)
LINEAR_OF_BYTE.flags.writeable = False


def premultiplied(rgba8: NDArray) -> NDArray:
    """Return linear light premultiplied by alpha, (..., 4) float32, of sRGB with straight alpha, (..., 4) uint8."""
    alpha = rgba8[..., 3:] / np.float32(255)
    return np.concatenate([LINEAR_OF_BYTE.astype(np.float32)[rgba8[..., :3]] * alpha, alpha], axis=-1)


def straight(light: NDArray) -> NDArray:
    """Return sRGB with straight alpha, (..., 4) uint8, of linear light premultiplied by alpha, (..., 4) float."""
    alpha = np.clip(light[..., 3:], 0, 1)
    rgb = np.divide(light[..., :3], alpha, out=np.zeros_like(light[..., :3]), where=alpha > 0)
    return np.rint(255 * np.concatenate([to_srgb(rgb), alpha], axis=-1)).astype(np.uint8)
