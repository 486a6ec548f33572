"""Scale maps for single rays: blocks of 4 x 4 cells of the net of texels. Kernel: kernels/trace/ray_scale_map.cl."""

import numpy as np

from ..device import Device
from ..surface.cube import border_directions, bordered
from ..surface.scale_map import ScaleMap
from .kinds import NOTHING, Traced, items, register
from .tree import node_boxes, plant

SIDE = 4  # cells along a side of a block
NODES = (SIDE + 1) ** 2
BLOCK_FLOATS = 32  # face, first row and column of cells, then the 25 nodes' distances; kernels/trace/ray_scale_map.cl
SWELL = 1.02  # how far cells may bulge beyond the box of their nodes, over that box's own bulge


@register(ScaleMap)
def trace_scale_map(device: Device, surface: ScaleMap) -> Traced:
    """Put the cells on the device, every layer; a hit's primitive is the texel at its cell's first corner.

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
        return Traced(surface.center, surface.radius, NOTHING, lambda *_: None)
    low, high = _boxes(points[kept], size, float(np.nanmax(heights)))
    tree = plant(low, high)
    number = np.arange(len(heights))
    grid, row, column = number // blocks_side**2, number // blocks_side % blocks_side, number % blocks_side
    rows = np.zeros((len(heights), BLOCK_FLOATS), np.float32)
    rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = grid % 6, SIDE * row, SIDE * column, grid // 6
    rows[:, 4:4 + NODES] = np.nan_to_num(heights, nan=-1)
    arrays = [device.upload(node_boxes(tree, low, high)), device.upload(tree.in_slots(rows[kept], -1))]

    def launch(mode, count, rays, hits):
        group_size, group, batch = items(device, count)
        device.kernel("trace/ray_scale_map.cl", constants={"VW": device.lanes, "MODE": mode})(
            group_size, group, count, batch, size, tree.roots, tree.first_bottom, *arrays, rays, hits)

    box = np.stack([low.min(axis=0), high.max(axis=0)])
    return Traced(surface.center, surface.radius, box + 1e-4 * np.array([[-1.0], [1.0]]), launch)


def _boxes(points, size, largest):
    """Return boxes (n, 3), (n, 3) around the surface over blocks of nodes (n, 25, 3), holes NaN.

    Between nodes the surface bulges out of their hull by at most the sagitta of the arcs between them.
    """
    low, high = np.nanmin(points, axis=1), np.nanmax(points, axis=1)
    reach = np.sqrt(np.nanmax((points**2).sum(axis=2), axis=1))[:, None]
    bulge = reach * (1 - np.cos(min(1.5 * 2 / size, np.pi / 3))) * SWELL + 1e-6 * largest
    return low - bulge, high + bulge
