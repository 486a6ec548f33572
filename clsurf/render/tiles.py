"""The grid of a picture: bins of 8x8 pixels with planes of depth and attributes, and the lists of what may touch them.

A tile, the unit of work of the tile stages, is a square of bins. Every representation fills lists of pairs (primitive,
bin) with `bin_pairs` and writes the same planes, so that surfaces of all kinds meet in one z-buffer.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray

BIN = 8  # pixels; kernels/common/bins.clh
VIEW_FLOATS = 32  # kernels/common/view.clh


@dataclass(frozen=True)
class Layout:
    """Which planes a bin has; `constants` go into the kernels that read or write them."""

    color: bool = False
    id: bool = False
    count: bool = False
    level: bool = False

    @property
    def constants(self) -> dict[str, int]:
        """``FIELDS`` and ``FIELD_X`` as the kernels want them (kernels/common/planes.clh)."""
        out, at = {}, 4
        for name, planes in (("color", 3), ("id", 1), ("count", 1), ("level", 1)):
            out[f"FIELD_{name.upper()}"] = at if getattr(self, name) else -1
            at += planes if getattr(self, name) else 0
        return out | {"FIELDS": at}


@dataclass(frozen=True, eq=False)
class Grid:
    """The bins of one picture on a device."""

    size: tuple[int, int]  # (width, height), pixels
    tile_bins: int  # a tile is tile_bins x tile_bins bins
    layout: Layout
    touched: DeviceArray  # (bins,) int32: pixel evaluations of the tile stages, -1 where nothing came
    planes: DeviceArray  # (bins, FIELDS, 64) float32

    @property
    def bins_x(self) -> int:
        """Bins in a row."""
        return -(-self.size[0] // BIN)

    @property
    def bins_y(self) -> int:
        """Rows of bins."""
        return -(-self.size[1] // BIN)

    @property
    def bin_count(self) -> int:
        """All bins."""
        return self.bins_x * self.bins_y

    @property
    def tiles_x(self) -> int:
        """Tiles in a row."""
        return -(-self.bins_x // self.tile_bins)

    @property
    def tile_count(self) -> int:
        """All tiles."""
        return self.tiles_x * -(-self.bins_y // self.tile_bins)


@dataclass(frozen=True, eq=False)
class PairLists:
    """The primitives that may touch each bin: ``pairs[offsets[b]:offsets[b + 1]]``, front to back."""

    offsets: DeviceArray  # (bins + 1,) uint32
    pairs: DeviceArray  # (n, 2) uint32: kernels/common/bins.clh
    total: int


def view_floats(camera, size, rotation=None, offset=None, scale=1.0, lod=0.0) -> NDArray:
    """Return the view buffer (32,) float32 of kernels/common/view.clh.

    Parameters
    ----------
    rotation : (3, 3) float64, optional
        Model axes to view axes; by default world to view.
    offset : (3,) float64, optional
        The model's zero in view space, world units.
    scale : float
        Model units to world units.
    lod : float
        Projected diameter in pixels up to which internal surfels are drawn.
    """
    p = camera.projection(size)
    out = np.zeros(VIEW_FLOATS, np.float32)
    out[:9] = (camera.rotation if rotation is None else rotation).ravel()
    out[9] = scale
    out[10:13] = 0 if offset is None else offset
    out[13:17] = p.fx, p.fy, p.cx, p.cy
    out[17:22] = p.perspective, max(camera.near, np.finfo(np.float32).min), size[0], size[1], lod
    return out


def bin_pairs(device: Device, scratch, grid: Grid, full: DeviceArray, core: DeviceArray, keys: DeviceArray,
              count: int) -> PairLists | None:
    """Count, scan, fill and sort the pairs of `count` primitives; None where nothing touches the picture.

    Parameters
    ----------
    scratch : Scratch
        Keeps buffers between frames.
    full, core : (count, 4) int16
        First and last block of 4x4 pixels in x and y that pass 2 and pass 1 may touch; x first > x last: none.
    keys : (count,) uint32
        Front-to-back order in the high 24 bits; bit 0: seen from the front, bit 1: from behind.
    """
    bins, lanes = grid.bin_count, scratch.lanes
    # Each part of the primitives counts for itself, so more parts than workers only cost memory and scanning.
    parts = min(4 * device.units if device.kind == "cpu" else 64 * device.units, -(-count // 256),
                max(1, (256 << 20) // (4 * bins)))
    chunk = -(-count // parts)
    device.check_memory(bin_counts=4 * bins * parts, bin_offsets=8 * (bins + 1))
    counts = scratch.array("bin_counts", (parts, bins), np.uint32)
    totals = scratch.array("bin_totals", (bins,), np.uint32)
    device.kernel("render/count_bins.cl")((parts,), None, full, keys, count, chunk, grid.bins_x, bins, counts)
    device.kernel("render/scan_bins.cl")((bins,), (64,), counts, parts, bins, totals)
    host_offsets = np.zeros(bins + 1, np.uint64)
    np.cumsum(device.download(totals, copy=False), out=host_offsets[1:])
    total = int(host_offsets[-1])
    if total == 0:
        return None
    device.check_memory(pairs=8 * total, sorted_pairs=8 * total)
    offsets = scratch.array("bin_offsets", (bins + 1,), np.uint32)
    device.write(offsets, host_offsets.astype(np.uint32))
    pairs = scratch.array("pairs", (total, 2), np.uint32)
    ordered = scratch.array("sorted_pairs", (total, 2), np.uint32)
    device.kernel("render/fill_bins.cl")((parts,), None, full, core, keys, count, chunk, grid.bins_x, bins, counts,
                                         offsets, pairs)
    device.kernel("render/sort_bins.cl", constants={"VW": lanes})((bins,), (16,), pairs, offsets, bins, ordered)
    return PairLists(offsets, ordered, total)


class Scratch:
    """Device buffers kept from frame to frame by name, grown where a frame needs more."""

    def __init__(self, device: Device, lanes: int):
        self.device, self.lanes = device, lanes
        self._kept: dict[str, DeviceArray] = {}

    def array(self, name: str, shape: tuple, dtype) -> DeviceArray:
        """Return an array of undefined content, valid until the same name is asked for again."""
        nbytes = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        kept = self._kept.get(name)
        if kept is None or kept.nbytes < nbytes:
            self._kept.pop(name, None)
            # An eighth more, so that a turning camera does not allocate every frame.
            kept = self._kept[name] = self.device.empty((nbytes + nbytes // 8,), np.uint8)
        host = None if kept.host is None else kept.host[:nbytes].view(dtype).reshape(shape)
        return DeviceArray(kept.buffer, shape, dtype, host)

    def clear(self) -> None:
        """Give all buffers back."""
        self._kept.clear()
