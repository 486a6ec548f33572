"""Options of a picture, checked."""

import numpy as np

from ..errors import InputError
from .differentials import DIFFERENTIALS
from .shade import CHANNELS

LARGEST_SIZE = 65536  # pixels across; blocks of 4 pixels are counted in 16 bits


def checked_size(size) -> tuple[int, int]:
    """Return (width, height) as ints, or raise InputError."""
    try:
        width, height = (int(v) for v in size)
        whole = (width, height) == tuple(size)
    except (TypeError, ValueError):
        whole = False
    if not whole or not (1 <= width <= LARGEST_SIZE and 1 <= height <= LARGEST_SIZE):
        raise InputError(f"size: expected (width, height) in pixels from 1 to {LARGEST_SIZE}, got {size}")
    return width, height


def checked_channels(channels) -> tuple[str, ...]:
    """Return the channels' names, or raise InputError."""
    channels = (channels,) if isinstance(channels, str) else tuple(dict.fromkeys(channels))
    unknown = [name for name in channels if name not in CHANNELS and name not in DIFFERENTIALS]
    if unknown or not channels:
        got = ", ".join(map(str, channels)) or "none"
        raise InputError(f"channels: expected some of {', '.join((*CHANNELS, *DIFFERENTIALS))}, got {got}")
    return channels


def picture_bytes(size: tuple[int, int], channels) -> int:
    """Return the bytes of a picture's channels."""
    parts = [CHANNELS.get(name, (3 if name.startswith("direction") else 1, np.float32))[0] for name in channels]
    return 4 * size[0] * size[1] * sum(max(count, 1) for count in parts)


def checked_lod(lod) -> float:
    """Return the level-of-detail threshold in pixels, or raise InputError."""
    if not isinstance(lod, int | float | np.number) or not 0 <= lod < np.inf:
        raise InputError(f"lod: expected a projected diameter in pixels of at least 0, got {lod!r}")
    return float(lod)
