"""Supersampling: pictures drawn several times as large and averaged on the device, for every representation."""

import numpy as np

from ..device import Device, DeviceArray
from ..errors import InputError
from .differentials import NAME, plane_counts
from .shade import CHANNELS

FACTORS = (1, 2, 3, 4)
SPAN = 64  # pixels of a row that one work-item averages


def checked_supersampling(factor) -> int:
    """Return the samples per pixel along each side, or raise InputError."""
    if isinstance(factor, bool) or factor not in FACTORS:
        raise InputError(f"supersampling: expected 1, 2, 3 or 4 samples along each side of a pixel, got {factor!r}")
    return int(factor)


def fine_channels(channels, factor: int) -> tuple[str, ...]:
    """Return the channels that the large picture needs: the depth chooses among samples where none is at the centre."""
    extra = ("depth",) if factor % 2 == 0 and "depth" not in channels and set(channels) != {"color"} else ()
    return (*channels, *extra)


def average(device: Device, fine: dict[str, DeviceArray], size: tuple[int, int], factor: int, channels,
            differentials, lanes: int) -> dict[str, DeviceArray]:
    """Return the channels of a picture of `size` (width, height) from those of one `factor` times as large.

    The colour is the mean (linear light, premultiplied); the other channels are the centre sample's, or for an even
    `factor` those of the nearest sample in depth among the four around the pixel's centre. `channels` are
    of `clsurf.render.shade.CHANNELS`, `differentials` the names of those of curvature.
    """
    width, height = size
    out = {name: device.empty((height, width, CHANNELS[name][0]) if CHANNELS[name][0] else (height, width),
                              CHANNELS[name][1]) for name in channels}
    span, (scalars, vectors) = 1 if lanes == 1 else SPAN, plane_counts(differentials)
    if differentials:
        out[NAME] = device.empty((scalars + 3 * vectors, height, width), np.float32)
    constants = {"FACTOR": factor, "SPAN": span, "DIFFERENTIAL_SCALARS": scalars, "DIFFERENTIAL_VECTORS": vectors} | {
        f"WRITE_{name.upper()}": name in out for name in CHANNELS}
    some = next(iter(fine.values()))
    device.kernel("render/average.cl", constants=constants)(
        (-(-width // span), height), (8, 8) if lanes == 1 else (1, 1), width, height,
        *(fine.get(name, some) for name in (*CHANNELS, NAME)), *(out.get(name, some) for name in (*CHANNELS, NAME)))
    return out
