"""Scale maps for single rays: blocks of 4 x 4 cells of the net of texels. Kernel: kernels/trace/ray_scale_map.cl."""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..surface.cube import border_directions, bordered
from ..surface.scale_map import ScaleMap
from .kinds import NOTHING, Plan, Traced, items, register
from .tree import WIDTH, node_boxes, plant, room

SIDE = 4  # cells along a side of a block
NODES = (SIDE + 1) ** 2
BLOCK_FLOATS = 32  # face, first row and column of cells, then the 25 nodes' distances; kernels/trace/ray_scale_map.cl
SAME = 2e-5  # radii: neighbouring cells both find a hit on their border; twice OVERLAP of the kernel
SWELL = 1.02  # how far cells may bulge beyond the box of their nodes, over that box's own bulge


@register(ScaleMap)
def plan_scale_map(surface: ScaleMap) -> Plan:
    """Plan blocks of cells, every layer; a hit's primitive is the texel at its cell's first corner.

    The frame is in radii around the centre. Texels count layer by layer through `scales`; on a face's border, the
    nearest texel of the face.
    """
    size, layers = surface.size, surface.layers
    blocks_side = -(-(size + 1) // SIDE)
    padded = SIDE * blocks_side + 1
    rho = np.full((layers, 6, padded, padded), np.nan, np.float32)
    for k in range(layers):
        values, valid = bordered(np.nan_to_num(surface.lambdas[k]), surface.valid[k], size)
        rho[k, :, :size + 2, :size + 2] = np.where(valid, values, np.nan)
    directions = np.full((6, padded, padded, 3), np.nan)
    directions[:, :size + 2, :size + 2] = border_directions(size)
    at = np.arange(blocks_side)[:, None] * SIDE + np.arange(SIDE + 1)
    windows = lambda a, axis: a.take(at.ravel(), axis=axis).reshape(  # noqa: E731
        *a.shape[:axis], blocks_side, SIDE + 1, *a.shape[axis + 1:])
    cut = windows(windows(rho, 3), 2)  # layers, 6, by, 5, bx, 5
    heights = cut.transpose(0, 1, 2, 4, 3, 5).reshape(-1, NODES)
    aims = windows(windows(directions, 2), 1).transpose(0, 1, 3, 2, 4, 5).reshape(-1, NODES, 3)
    points = heights[..., None] * np.tile(aims, (layers, 1, 1))
    usable = np.isfinite(points[..., 0]).reshape(-1, SIDE + 1, SIDE + 1)
    whole = usable[:, 1:, 1:] & usable[:, :-1, 1:] & usable[:, 1:, :-1] & usable[:, :-1, :-1]
    kept = np.flatnonzero(whole.any(axis=(1, 2)))
    if not len(kept):
        nothing = Traced(surface.center, surface.radius, NOTHING, lambda *_: None)
        return Plan(lambda *_: nothing, lambda: (np.zeros((0, 3)), np.zeros((0, 3))), nothing.grain)
    low, high = _boxes(points[kept], size, float(np.nanmax(heights)))
    grid, row, column = kept // blocks_side**2, kept // blocks_side % blocks_side, kept % blocks_side
    blocks = np.zeros((len(kept), BLOCK_FLOATS), np.float32)
    blocks[:, 0], blocks[:, 1], blocks[:, 2], blocks[:, 3] = grid % 6, SIDE * row, SIDE * column, grid // 6
    blocks[:, 4:4 + NODES] = np.nan_to_num(heights[kept], nan=-1)
    box = np.stack([low.min(axis=0), high.max(axis=0)]) + 1e-4 * np.array([[-1.0], [1.0]])
    center, radius = surface.center, surface.radius

    def hold(device, rows):
        some = slice(None) if rows is None else rows
        return Traced(center, radius, box, hold_blocks(device, low[some], high[some], blocks[some], size))

    return Plan(hold, lambda: (low, high), 2 * radius / size, same=SAME)


def hold_blocks(device: Device, low: NDArray, high: NDArray, blocks: NDArray, size: int):
    """Put blocks (n, 32) of cells with the boxes `low`, `high` (n, 3) on the device; return what launches rays."""
    slots, nodes = room(len(blocks))
    device.check_memory(blocks=4 * BLOCK_FLOATS * slots, nodes=24 * WIDTH * nodes)
    tree = plant(device, low, high)
    arrays = [device.upload(node_boxes(tree, low, high)), device.upload(tree.in_slots(blocks, -1))]

    def launch(mode, count, rays, hits):
        group_size, group, batch = items(device, count)
        device.kernel("trace/ray_scale_map.cl", constants={"VW": device.lanes, "MODE": mode})(
            group_size, group, count, batch, size, tree.roots, tree.first_bottom, *arrays, rays, hits)

    return launch


def _boxes(points, size, largest):
    """Return boxes (n, 3), (n, 3) around the surface over blocks of nodes (n, 25, 3), holes NaN.

    Between nodes the surface bulges out of their hull by at most the sagitta of the arcs between them.
    """
    low, high = np.nanmin(points, axis=1), np.nanmax(points, axis=1)
    reach = np.sqrt(np.nanmax((points**2).sum(axis=2), axis=1))[:, None]
    bulge = reach * (1 - np.cos(min(1.5 * 2 / size, np.pi / 3))) * SWELL + 1e-6 * largest
    return low - bulge, high + bulge
