"""Morton numbers of cells: those along a curve through space, on the host. On devices: build/morton_codes.cl."""

import numpy as np
from numpy.typing import NDArray

AXIS_BITS = 21  # of a cell's coordinate
_LOW = 11  # bits that the table spreads at once


def _spread_table() -> NDArray:
    value, out = np.arange(1 << _LOW, dtype=np.uint64), np.zeros(1 << _LOW, np.uint64)
    for bit in range(_LOW):
        out |= ((value >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit)
    return out


_SPREAD = _spread_table()


def morton(cell: NDArray) -> NDArray:
    """Return the Morton numbers (n,) uint64 of cells (n, 3), AXIS_BITS bits an axis; x is the lowest bit of three."""
    out = np.zeros(len(cell), np.uint64)
    for axis in range(3):
        value = cell[:, axis]
        out |= (_SPREAD[value & ((1 << _LOW) - 1)] | _SPREAD[value >> _LOW] << np.uint64(3 * _LOW)) << np.uint64(axis)
    return out


def unmorton(keys: NDArray) -> NDArray:
    """Return the cells (n, 3) int64 of Morton numbers."""
    out = np.empty((len(keys), 3), np.int64)
    masks = (0x1249249249249249, 0x10C30C30C30C30C3, 0x100F00F00F00F00F, 0x1F0000FF0000FF, 0x1F00000000FFFF, 0x1FFFFF)
    for axis in range(3):
        value = (keys >> np.uint64(axis)) & np.uint64(masks[0])
        for shift, mask in zip((2, 4, 8, 16, 32), masks[1:], strict=True):
            value = (value | value >> np.uint64(shift)) & np.uint64(mask)
        out[:, axis] = value
    return out
