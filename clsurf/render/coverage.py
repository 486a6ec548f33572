"""Anti-aliasing by coverage: pixels that hold an edge are drawn with 4 x 4 samples, all others with one.

Kernels: mark_edges.cl, cover_edges.cl. What draws them is the same tile stages, which leave out the bins that hold no
edge: against `supersampling=4`, edges are as good and frames several times faster.
"""

from dataclasses import replace

import numpy as np

from ..device import Device, DeviceArray
from ..errors import InputError
from .average import checked_supersampling
from .tiles import BIN, Grid, Layout, Scratch

ANTIALIAS = ("none", "coverage", "supersample")
FACTOR = 4  # samples along each side of an edge's pixel
SPAN = 64
PATCH_BINS = 4  # across a tile of patches: an edge's tile is drawn whole


def checked_antialias(antialias, supersampling) -> tuple[int, bool]:
    """Return the samples along each side of all pixels, and whether edges get more, or raise InputError."""
    factor = checked_supersampling(supersampling)
    if antialias not in ANTIALIAS:
        raise InputError(f"antialias: expected one of {', '.join(ANTIALIAS)}, got {antialias!r}")
    if antialias == "coverage" and factor > 1:
        raise InputError(f"antialias 'coverage': expected supersampling=1, got {factor}: it draws edges with 4 x 4 "
                         "samples")
    return (FACTOR if antialias == "supersample" and factor == 1 else factor), antialias == "coverage"


def edge_channels(channels, surfaces: int) -> list[str]:
    """Return the channels of a picture whose edges are to be found."""
    return list(dict.fromkeys([*channels, "depth", "normal", *(["id"] if surfaces > 1 else [])]))


def edge_layout(layout: Layout, materials: int) -> Layout:
    """Return the planes of the picture of the edges of one with the planes `layout`."""
    return replace(layout, color=True, id=materials > 1, count=False, level=False, traced=True, differentials=())


def mark_edges(device: Device, scratch: Scratch, grid: Grid, view: DeviceArray, arrays: dict[str, DeviceArray],
               layout: Layout) -> tuple[DeviceArray, Grid]:
    """Return which pixels hold an edge, (h, w) uint8, and the bins of the picture 4 times as large that are wanted.

    Parameters
    ----------
    grid : Grid
        Of the picture.
    view : DeviceArray
        Its view buffer, world to view.
    arrays : dict of str to DeviceArray
        Its channels: depth, normal and, with several surfaces, id.
    """
    width, height = grid.size
    large = FACTOR * width, FACTOR * height
    bins_x, bins_y = -(-large[0] // BIN), -(-large[1] // BIN)
    fields = layout.constants["FIELDS"]
    device.check_memory(planes=4 * 64 * fields * bins_x * bins_y)
    edges = scratch.array("edges", (height, width), np.uint8)
    touched = scratch.array("touched", (bins_x * bins_y,), np.int32)
    device.kernel("render/mark_edges.cl", constants={
        "VW": scratch.lanes, "FACTOR": FACTOR, "SPAN": SPAN, "HAS_ID": "id" in arrays})(
        (-(-width // SPAN), bins_y), None, view, arrays["depth"], arrays["normal"], arrays.get("id", arrays["depth"]),
        width, height, bins_x, bins_y, edges, touched)
    planes = scratch.array("planes", (bins_x * bins_y, fields, 64), np.float32)
    return edges, replace(grid, size=large, layout=layout, touched=touched, planes=planes, patch_bins=PATCH_BINS,
                          masked=True)


def cover_edges(device: Device, large: Grid, edges: DeviceArray, background: DeviceArray, color: DeviceArray) -> None:
    """Put the means of the samples of pixels that hold an edge into `color` (h, w, 4).

    `background` (4,) float32 is linear and premultiplied.
    """
    height, width = color.shape[:2]
    device.kernel("render/cover_edges.cl", constants=large.layout.constants | {"VW": 1, "SPAN": SPAN})(
        (-(-width // SPAN), height), None, edges, large.touched, large.planes, background, large.bins_x, width, height,
        color)
