"""The grid of a picture: bins of 8x8 pixels with planes of depth and attributes, and the lists of what may touch them.

A tile, the unit of work of the tile stages, is a square of bins. Every representation fills lists of pairs (primitive,
bin) with `bin_pairs` and writes the same planes, so that surfaces of all kinds meet in one z-buffer.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from .clip import CLIP
from .differentials import field_constants, plane_counts

BIN = 8  # pixels; kernels/common/bins.clh
VIEW_FLOATS = 64  # kernels/common/view.clh
DEPTH_BUCKETS = 2048  # kernels/common/bins.clh
LEAST_FLOAT = float(np.finfo(np.float32).min)


@dataclass(frozen=True)
class Layout:
    """Which planes a bin has; `constants` go into the kernels that read or write them."""

    color: bool = False
    id: bool = False
    count: bool = False
    level: bool = False
    lit: bool = False  # colours of patches are lit at their nodes
    traced: bool = False  # colours are lit before the last stage, where rays decide over the light
    unlit: bool = False  # some colours are final and take no light
    clip_planes: int = 0
    differentials: tuple[str, ...] = ()  # channels of curvature, in the order of their planes

    @property
    def differential_planes(self) -> int:
        """Planes of all channels of curvature."""
        scalars, vectors = plane_counts(self.differentials)
        return scalars + 3 * vectors

    @cached_property
    def constants(self) -> dict[str, int]:
        """``FIELDS`` and ``FIELD_X`` as the kernels want them (kernels/common/planes.clh)."""
        out, at = {}, 4
        for name, planes in (("color", 3), ("id", 1), ("count", 1), ("level", 1)):
            out[f"FIELD_{name.upper()}"] = at if getattr(self, name) else -1
            at += planes if getattr(self, name) else 0
        if self.differentials:
            out |= field_constants(self.differentials, at)
            at += self.differential_planes
        lit = 2 if self.traced else int(self.lit or self.unlit)
        return out | {"FIELDS": at, "LIT_COLORS": lit, "CLIP_PLANES": self.clip_planes}


same_layout = lru_cache(maxsize=256)(Layout)  # a layout with its constants takes 15 us, and every frame needs one


@dataclass(frozen=True, eq=False)
class Grid:
    """The bins of one picture on a device."""

    size: tuple[int, int]  # (width, height), pixels
    tile_bins: int  # a tile is tile_bins x tile_bins bins
    layout: Layout
    touched: DeviceArray | None  # (bins,) int32: pixel evaluations of the tile stages, -1 where nothing came
    planes: DeviceArray | None  # (bins, FIELDS, 64) float32; None where the picture is shaded without them
    patch_bins: int = 4  # bins across a tile of patches
    clip: NDArray | None = None  # (n, 4) float64: clip planes, view space
    masked: bool = False  # whether `touched` is -2 where a bin is not wanted: stages may leave it out

    def clip_into(self, view: NDArray) -> NDArray:
        """Write the clip planes into a view buffer (VIEW_FLOATS,) float32 and return it."""
        if self.clip is not None and len(self.clip):
            view[CLIP:CLIP + self.clip.size] = self.clip.ravel()
        return view

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


def view_floats(camera, size, rotation=None, offset=None, scale=1.0, lod=0.0, depths=(0.0, 1.0)) -> NDArray:
    """Return the view buffer (64,) float32 of kernels/common/view.clh.

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
    depths : (float, float)
        Range of depths that the front-to-back order resolves; others fall into the first and last bucket.
    """
    p = camera.projection(size)
    out = np.zeros(VIEW_FLOATS, np.float32)
    out[:9] = (camera.rotation if rotation is None else rotation).ravel()
    offset = (0.0, 0.0, 0.0) if offset is None else np.asarray(offset).tolist()
    # One assignment of plain numbers: each takes some microseconds of every frame.
    out[9:24] = (scale, *offset, p.fx, p.fy, p.cx, p.cy, p.perspective, max(camera.near, LEAST_FLOAT), size[0], size[1],
                 lod, depths[0], max((depths[1] - depths[0]) / DEPTH_BUCKETS, 1e-30))
    return out


@dataclass(frozen=True, eq=False)
class Footprints:
    """Where the primitives of one surface may touch the picture, for `bin_pairs`.

    Ranges are the first and last block of 4x4 pixels in x and y; first x > last x: nowhere.
    """

    full: DeviceArray  # (count, 4) int16: range of pass 2
    core: DeviceArray  # (count, 4) int16: range of pass 1
    keys: DeviceArray  # (count,) uint32: least depth in the high 24 bits; bit 0: may be seen from the front, 1: behind
    buckets: DeviceArray  # (count,) uint16: depth bucket


def new_footprints(device: Device, scratch: "Scratch", count: int) -> Footprints:
    """Return room for the footprints of `count` primitives."""
    device.check_memory(blocks=16 * count, keys=4 * count, buckets=2 * count)
    return Footprints(scratch.array("full", (count, 4), np.int16), scratch.array("core", (count, 4), np.int16),
                      scratch.array("keys", (count,), np.uint32), scratch.array("buckets", (count,), np.uint16))


def order_depths(device: Device, scratch: "Scratch", footprints: Footprints, count: int):
    """Return the drawn primitives front to back, (count,) uint32, and the offsets of the depth buckets.

    The last offset is the number of drawn primitives.
    """
    parts = max(1, min(4 * device.units, -(-count // 4096)))
    chunk = -(-count // parts)
    counts = scratch.array("depth_counts", (parts, DEPTH_BUCKETS), np.uint32)
    totals = scratch.array("depth_totals", (DEPTH_BUCKETS,), np.uint32)
    offsets = scratch.array("depth_offsets", (DEPTH_BUCKETS + 1,), np.uint32)
    order = scratch.array("order", (count,), np.uint32)
    device.kernel("render/count_depths.cl")((parts,), None, footprints.full, footprints.buckets, count, chunk,
                                            DEPTH_BUCKETS, counts)
    scan(device, counts, parts, DEPTH_BUCKETS, totals, offsets)
    device.kernel("render/order_depths.cl")((parts,), None, footprints.full, footprints.buckets, count, chunk,
                                            DEPTH_BUCKETS, counts, offsets, order)
    return order, offsets


def scan(device: Device, counts: DeviceArray, parts: int, bins: int, totals: DeviceArray, offsets: DeviceArray) -> None:
    """Turn counts (parts, bins) into offsets within each bin, and write the bins' own offsets (bins + 1,)."""
    device.kernel("render/scan_bins.cl")((bins,), (64,), counts, parts, bins, totals)
    device.kernel("render/scan_totals.cl", constants={"GROUP": 64})((64,), (64,), totals, bins, offsets)


def bin_pairs(device: Device, scratch: "Scratch", grid: Grid, footprints: Footprints, count: int) -> PairLists | None:
    """Order by depth, count, scan and fill the pairs of `count` primitives; None where nothing touches the picture."""
    bins = grid.bin_count
    order, depth_offsets = order_depths(device, scratch, footprints, count)
    # Each part of the primitives counts for itself, so more parts than workers only cost memory and scanning.
    workers, least = (4 * device.units if device.kind == "cpu" else 64 * device.units), 256
    if device.loop_turns is not None:  # the loops of a part must end by themselves
        workers, least = 512, 128
    parts = max(1, min(workers, -(-count // least), (256 << 20) // (4 * bins)))
    device.check_memory(bin_counts=4 * bins * parts, bin_offsets=8 * (bins + 1))
    counts = scratch.array("bin_counts", (parts, bins), np.uint32)
    offsets = scratch.array("bin_offsets", (bins + 1,), np.uint32)
    masked, touched = {"MASKED": int(grid.masked)}, grid.touched if grid.masked else offsets
    device.kernel("render/count_bins.cl", constants=masked)(
        (parts,), None, order, depth_offsets, footprints.full, parts, grid.bins_x, bins, touched, counts)
    scan(device, counts, parts, bins, scratch.array("bin_totals", (bins,), np.uint32), offsets)
    total = int(device.download(offsets, copy=False)[-1])
    if total == 0:
        return None
    device.check_memory(pairs=8 * total)
    pairs = scratch.array("pairs", (total, 2), np.uint32)
    device.kernel("render/fill_bins.cl", constants=masked)(
        (parts,), None, order, depth_offsets, footprints.full, footprints.core, footprints.keys, parts, grid.bins_x,
        bins, touched, counts, offsets, pairs)
    return PairLists(offsets, pairs, total)


class Scratch:
    """Device buffers kept from frame to frame by name, grown where a frame needs more."""

    def __init__(self, device: Device, lanes: int):
        self.device, self.lanes = device, lanes
        self._kept: dict[str, DeviceArray] = {}

    def array(self, name: str, shape: tuple, dtype) -> DeviceArray:
        """Return an array of undefined content, valid until the same name is asked for again."""
        nbytes = math.prod(shape) * np.dtype(dtype).itemsize
        kept = self._kept.get(name)
        if kept is None or kept.nbytes < nbytes:
            self._kept.pop(name, None)
            # An eighth more, where a buffer may have it, so that a turning camera does not allocate every frame.
            room = max(nbytes, min(nbytes + nbytes // 8, self.device.largest_buffer_bytes))
            kept = self._kept[name] = self.device.empty((room,), np.uint8)
        host = None if kept.host is None else kept.host[:nbytes].view(dtype).reshape(shape)
        return DeviceArray(kept.buffer, shape, dtype, host)

    def clear(self) -> None:
        """Give all buffers back."""
        self._kept.clear()
