"""The subdivision of cells into points: the paper's own way to fill them, bilinear or C1-smooth (section 3).

Kernel: kernels/render/tile_lattice.cl.
"""

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..surface.patch import PatchSurface
from .normal_table import half_steps, node_differences
from .tiles import BIN, Grid, Scratch

CELLS = ("bilinear", "smooth")


def node_twists(surface: PatchSurface) -> NDArray:
    """Return the mixed differences (N,) float32 of the displacements, steps per node and node: smooth cells need them.

    The slopes along x, differenced along y by the same rule as the slopes themselves.
    """
    return (node_differences(surface, half_steps(surface)[0], 1) / 4).astype(np.float32)


def tile_lattice(device: Device, scratch: Scratch, grid: Grid, upload, constants: dict, view: DeviceArray,
                 records: DeviceArray, rectangles: DeviceArray, lit: DeviceArray | None,
                 number: int, drawing) -> None:
    """Draw the patches of every tile into its planes by subdividing their cells.

    Parameters
    ----------
    upload : PatchUpload
    constants : dict
        Those of the grid's layout and of the patches' nodes.
    lit : (N, 4) float32, optional
        Lit colours of the nodes, in place of unlit ones.
    number : int
        The surface's place in the scene.
    drawing : PatchDrawing
    """
    tile, lanes = grid.tile_bins * BIN, scratch.lanes
    smooth = drawing.cells == "smooth"
    twists = upload.slopes
    if smooth or drawing.normals == "smooth":
        twists = upload.once("twists", lambda surface: device.upload(node_twists(surface)))
    slots = scratch.array("patch_slots", (grid.tile_count, tile * tile, 2), np.uint32)
    constants = constants | {"VW": lanes, "TILE_BINS": grid.tile_bins, "SMOOTH": smooth,
                             "SMOOTH_NORMALS": drawing.normals == "smooth", "LIT_NODES": lit is not None}
    group = 64 if lanes == 1 else 1
    device.kernel("render/tile_lattice.cl", constants=constants)(
        (grid.tile_count * group,), (group,), view, rectangles, records, upload.sizes, upload.offsets, upload.count,
        upload.heights, upload.cells, upload.borders, upload.slopes, twists, upload.cells, upload.colors,
        upload.linear, upload.linear if lit is None else lit, number, grid.tiles_x, grid.tile_count, grid.bins_x,
        grid.bins_y, slots, grid.touched, grid.planes)
