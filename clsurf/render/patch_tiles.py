"""The tile stage of spatial patches: quadrilaterals, triangles and nodes; kernels/render/tile_patches.cl."""

import numpy as np

from ..device import Device, DeviceArray
from .patch_lattice import CELLS, node_twists
from .shade import CHANNELS, Look
from .tiles import Grid, Scratch

PAD = 64  # nodes that lanes may read past the last one
NODES = {"exact": 0, "trilinear": 1, "homogeneous": 2}  # kernels/render/patch_cells.clh


def tile_bins_of_patches(size: tuple[int, int], lanes: int) -> int:
    """Return the bins across a tile: large tiles draw fewer patches twice, small pictures need tiles for all units.

    Earth 1128 on Intel's runtime, 48 / 64 / 96 / 128 px: 3.2 / 3.0 / 2.9 / 2.9 ms at 500x500, 12.4 / 11.8 / 10.4 / 10.4
    at 1920x1080; at 150x150 0.72 / 0.73 / 0.79 / 0.86. On PoCL, 24 / 32 / 40 / 48 px: 1.21 / 1.10 / 1.30 / 1.42 at
    150x150, where 48 left half a core idle.
    """
    if lanes == 1:
        return 4
    return 12 if size[0] * size[1] > 300 * 300 else 4


def tile_patches(device: Device, scratch: Scratch, grid: Grid, upload, constants: dict, view: DeviceArray, projected,
                 number: int, look: Look, out: dict[str, DeviceArray] | None = None) -> None:
    """Draw the patches of every tile into its planes, or, given the channels `out`, shade them into the picture.

    `number` is the surface's place in the scene.
    """
    group = 64 if scratch.lanes == 1 else 1
    constants = constants | {
        "VW": scratch.lanes, "TILE_BINS": grid.patch_bins, "NODES": NODES[look.patches.nodes],
        "TRIANGLES": look.patches.cells == "triangles", "EQUAL_NODES": upload.equal_nodes, "FUSED": out is not None,
        "LATTICE": look.patches.cells in CELLS, "SMOOTH": look.patches.cells == "smooth",
        "SMOOTH_NORMALS": look.patches.normals == "smooth", "ALPHA_TEST": look.patches.alpha,
        "COUNT_COST": look.cost or (out is not None and "cost" in out), "MASKED": int(grid.masked)}
    twists = upload.steps
    if constants["SMOOTH"] or constants["SMOOTH_NORMALS"]:
        twists = upload.once("twists", lambda surface: device.upload(np.pad(node_twists(surface), (0, PAD))))
    unused = scratch.array("unused", (4,), np.float32)
    channels = out or {}
    tiles_x, tiles_y = -(-grid.bins_x // grid.patch_bins), -(-grid.bins_y // grid.patch_bins)
    device.kernel("render/tile_patches.cl", constants=constants)(
        (tiles_x * tiles_y * group,), (group,), view, projected.boxes, projected.boxes.shape[1], projected.records,
        upload.sizes, upload.offsets, upload.count, upload.steps, upload.rims, upload.nodes, twists, number, tiles_x,
        tiles_x * tiles_y, grid.bins_x, grid.bins_y, grid.touched or unused, grid.planes or unused,
        *(channels.get(name, unused) for name in CHANNELS))
