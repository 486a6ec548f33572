"""The tile stage of spatial patches: quadrilaterals, triangles and nodes; kernels/render/tile_patches.cl."""

import numpy as np

from ..device import Device, DeviceArray
from .patch_drawing import PatchDrawing
from .shade import CHANNELS
from .tiles import Grid, Scratch

NODES = {"exact": 0, "trilinear": 1, "homogeneous": 2}  # kernels/render/patch_cells.clh


def tile_patches(device: Device, scratch: Scratch, grid: Grid, upload, constants: dict, view: DeviceArray, projected,
                 number: int, drawing: PatchDrawing) -> None:
    """Draw the patches of every tile into its planes; `number` is the surface's place in the scene."""
    group = 64 if scratch.lanes == 1 else 1
    constants = constants | {"VW": scratch.lanes, "TILE_BINS": grid.tile_bins, "NODES": NODES[drawing.nodes],
                             "TRIANGLES": drawing.cells == "triangles", "EQUAL_NODES": upload.equal_nodes}
    unused = scratch.array("unused", (4,), np.float32)
    device.kernel("render/tile_patches.cl", constants=constants)(
        (grid.tile_count * group,), (group,), view, projected.boxes, projected.records, upload.sizes, upload.offsets,
        upload.count, upload.steps, upload.rims, upload.nodes, number, grid.tiles_x, grid.tile_count, grid.bins_x,
        grid.bins_y, grid.touched, grid.planes, *(unused for _ in CHANNELS))
