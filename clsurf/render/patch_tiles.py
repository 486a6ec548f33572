"""The tile stage of spatial patches: quadrilaterals, triangles and nodes; kernels/render/tile_patches.cl."""

import numpy as np

from ..device import Device, DeviceArray
from .patch_lattice import CELLS, node_twists
from .shade import CHANNELS, Look
from .tiles import Grid, Scratch

PAD = 64  # nodes that lanes may read past the last one
NODES = {"exact": 0, "trilinear": 1, "homogeneous": 2}  # kernels/render/patch_cells.clh


def tile_patches(device: Device, scratch: Scratch, grid: Grid, upload, constants: dict, view: DeviceArray, projected,
                 number: int, look: Look, out: dict[str, DeviceArray] | None = None) -> None:
    """Draw the patches of every tile into its planes, or, given the channels `out`, shade them into the picture.

    `number` is the surface's place in the scene.
    """
    group = 64 if scratch.lanes == 1 else 1
    constants = constants | {
        "VW": scratch.lanes, "TILE_BINS": grid.tile_bins, "NODES": NODES[look.patches.nodes],
        "TRIANGLES": look.patches.cells == "triangles", "EQUAL_NODES": upload.equal_nodes, "FUSED": out is not None,
        "LATTICE": look.patches.cells in CELLS, "SMOOTH": look.patches.cells == "smooth",
        "SMOOTH_NORMALS": look.patches.normals == "smooth", "ALPHA_TEST": look.patches.alpha,
        "COUNT_COST": look.cost or (out is not None and "cost" in out)}
    twists = upload.steps
    if constants["SMOOTH"] or constants["SMOOTH_NORMALS"]:
        twists = upload.once("twists", lambda surface: device.upload(np.pad(node_twists(surface), (0, PAD))))
    unused = scratch.array("unused", (4,), np.float32)
    channels = out or {}
    device.kernel("render/tile_patches.cl", constants=constants)(
        (grid.tile_count * group,), (group,), view, projected.boxes, projected.records, upload.sizes, upload.offsets,
        upload.count, upload.steps, upload.rims, upload.nodes, twists, number, grid.tiles_x, grid.tile_count,
        grid.bins_x, grid.bins_y, grid.touched or unused, grid.planes or unused,
        *(channels.get(name, unused) for name in CHANNELS))
