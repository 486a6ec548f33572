"""How much of a streamed scan is taken at once, from the memory that a build may have."""

from dataclasses import dataclass

import numpy as np

from ..device import Device
from ..errors import InputError

FIXED_BYTES = 620_000_000  # of a process with its driver, which compiles kernels at first (PoCL: 140 MB of these)
BYTES_PER_CELL_POINT = 1100  # at the peak of a cell's build, halo and the next cell's points counted in
BYTES_PER_CHUNK_POINT = 400  # of the chunk at hand and the one read ahead
MOST_CHUNK = 1_000_000
HALO_ALLOWED = 1.35  # points with their halo, over those that BYTES_PER_CELL_POINT counts
BYTES_PER_THIN_POINT = 350
MOST_THIN = 3_000_000
KEPT_PER_POINT = 60  # bytes of the device's memory that are kept from cell to cell
LEAST_POINTS, MOST_POINTS = 50_000, 1_000_000  # of a cell; larger ones have less halo, but nothing is gained beyond
DEVICE_BYTES = 160  # of a device's largest buffer, for each point of a cell with its halo
LEAST_CELL = 2_000  # points of a cell on the smallest device


@dataclass(frozen=True)
class Sizes:
    """How much is taken at once, from the memory limit."""

    chunk: int  # points read at once
    cell: int  # points of a cell, without halo
    thin: int  # points of the copy for the coarse levels


def sizes_of(limit: int | None) -> Sizes:
    """Return what fits in `limit` bytes; raises InputError where nothing does."""
    limit = 2_000_000_000 if limit is None else limit
    room = limit - FIXED_BYTES
    cell = min(MOST_POINTS, room // BYTES_PER_CELL_POINT)
    if cell < LEAST_POINTS:
        least = FIXED_BYTES + LEAST_POINTS * BYTES_PER_CELL_POINT
        raise InputError(f"memory_limit: expected at least {least / 1e6:.0f} MB, of which drivers and kernels take "
                         f"{FIXED_BYTES / 1e6:.0f}, got {limit / 1e6:.0f} MB")
    return Sizes(int(min(MOST_CHUNK, room // BYTES_PER_CHUNK_POINT)), int(cell),
                 int(min(MOST_THIN, room // BYTES_PER_THIN_POINT)))


def with_halo(most: int, halo: float) -> int:
    """Return the points of a square cell that with a halo so many spacings wide holds no more than memory allows."""
    return min(most, max(LEAST_CELL, most // 2, int(max(np.sqrt(HALO_ALLOWED * most) - 2 * halo, 0) ** 2)))


def sizes_for(device: Device) -> Sizes:
    """Return what fits on a device that does not hold a scan at once."""
    cell = min(MOST_POINTS, device.largest_buffer_bytes // DEVICE_BYTES)
    return Sizes(MOST_CHUNK, max(cell, LEAST_CELL), max(cell, LEAST_CELL))
