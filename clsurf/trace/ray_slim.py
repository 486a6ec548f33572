"""SLIM surfaces for single rays: a record for each leaf. Kernel: kernels/trace/ray_slim.cl."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..io.stored_leaves import only
from ..surface.slim import COEFFICIENTS, SlimSurface
from ..surface.srgb import LINEAR_OF_BYTE
from .kinds import NOTHING, Plan, Traced, items, register
from .slim import TracedSlim, leaves_of, upload_traced
from .tree import EMPTY, WIDTH, Tree

FAR = 1e15  # where the ball of an empty slot lies


@register(SlimSurface)
def plan_slim(surface: SlimSurface) -> Plan:
    """Plan the leaves; the frame is the model's, relative to its origin. Shadows take packets alone."""
    leaves = np.flatnonzero(surface.leaf) if surface.leaf.any() else np.arange(len(surface))
    own, origin, colors = replace(leaves_of(surface)), surface.origin, surface.colors  # not the surface itself

    def hold(device, rows):
        part, numbers = (own, leaves) if rows is None else (only(own, rows), leaves[rows])
        return hold_slim(device, upload_traced(device, part), numbers, origin)

    def reaches():
        centers, radii = own.centers.astype(np.float64), own.radii.astype(np.float64)[:, None]
        slack = 2e-6 * (radii + np.abs(centers))
        return centers - radii - slack, centers + radii + slack

    return Plan(hold, reaches, float(np.median(surface.radii[leaves])) if len(leaves) else 0.0,
                None if colors is None else lambda primitives: LINEAR_OF_BYTE[colors[primitives, :3]],
                radii=own.radii, same=2e-6 * surface.diagonal, packets=True)


def hold_slim(device: Device, base: TracedSlim, numbers: NDArray, origin: NDArray) -> Traced:
    """Return leaves on the device, numbered `numbers` (n,), for rays."""
    if not (base.tree.order >= 0).any():
        return Traced(origin, 1.0, NOTHING, lambda *_: None)
    top = device.download(base.boxes)[0]
    box = np.stack([top[:3].min(axis=1), top[3:].max(axis=1)]).astype(np.float64)
    margin = 1e-3 * float((box[1] - box[0]).max())
    order = device.upload(np.where(base.tree.order >= 0, numbers[base.tree.order], -1).astype(np.int32))
    for_rays: list[DeviceArray] = []  # from the first single ray on

    def ready():
        if not for_rays:
            for_rays.extend(single_arrays(device, base, order))

    def launch(mode, rays_count, rays, hits):
        ready()
        size, group, batch = items(device, rays_count)
        constants = {"VW": device.lanes, "DEGREE": base.degree, "ORIENTED": base.oriented, "MODE": mode}
        device.kernel("trace/ray_slim.cl", constants=constants)(
            size, group, rays_count, batch, base.tree.roots, base.tree.first_bottom, base.boxes, *for_rays, rays, hits)

    return Traced(origin, 1.0, box + margin * np.array([[-1.0], [1.0]]), launch, packets=base, order=order, ready=ready)


def single_arrays(device: Device, base: TracedSlim, order: DeviceArray) -> list[DeviceArray]:
    """Return what single rays need beside the boxes: records, balls, numbers, neighbour lists (ray_slim.cl)."""
    tree, count = base.tree, COEFFICIENTS[base.degree]
    planes = device.download(base.surfels)  # x y z r r, normal, low high slope, coefficients
    balls = planes[:, :4].copy()
    balls[:, :3] = np.where((tree.order < 0).reshape(-1, 1, WIDTH), FAR, balls[:, :3])
    in_slots = planes.transpose(0, 2, 1).reshape(len(tree.order), -1)
    records = np.zeros((len(tree.order), 16 if base.degree < 3 else 32), np.float32)
    records[:, :7], records[:, 7] = in_slots[:, [0, 1, 2, 3, 5, 6, 7]], 1 / in_slots[:, 3]
    records[:, 8:8 + min(count, 6)] = in_slots[:, 11:11 + min(count, 6)]
    records[:, 14:16] = device.download(base.tails)[:, 8:10]
    if count > 6:
        records[:, 16:20] = in_slots[:, 17:21]
    first, *near = neighbour_lists(tree, device.download(base.boxes), device.download(base.balls))
    device.check_memory(records=records.nbytes, balls=balls.nbytes, boxes=near[0].nbytes)
    records, balls, first, *near = (device.upload(array) for array in (records, balls, first, *near))
    return [records, balls, order, first, *near]


def neighbour_lists(tree: Tree, boxes: NDArray, balls: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return for each bottom node those whose balls reach into its piece of surface.

    A point's blend asks the boxes of its own bottom node's list, 1.2 vectors of 16 on the dragon, where a walk from the
    top took 3 nodes one after the other (4.4 against 4.7 Mrays/s).

    Parameters
    ----------
    boxes, balls : (nodes, 6, 16) float32
        Of a tree's pieces of surface, and of its whole balls.

    Returns
    -------
    first : (bottom nodes + 1,) int32
        The groups of bottom node i are first[i] to first[i + 1] - 1.
    near_boxes : (groups, 6, 16) float32
        Boxes of balls, `EMPTY` where a group has fewer than 16.
    near_nodes : (groups, 16) int32
        Bottom nodes, counted from 0.
    """
    pieces, whole = boxes[tree.first_bottom:], balls[tree.first_bottom:]
    low, high = pieces[:, :3].min(axis=2), pieces[:, 3:].max(axis=2)
    parts = [_pairs(tree, balls, low, high, start) for start in range(0, len(pieces), 4096)]
    bottom, near = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    count = np.bincount(bottom, minlength=len(pieces))
    first = np.concatenate([[0], np.cumsum(-(-count // WIDTH))]).astype(np.int32)
    place = np.arange(len(near)) - (np.cumsum(count) - count)[bottom]
    group, lane = first[bottom] + place // WIDTH, place % WIDTH
    near_boxes = np.empty((max(int(first[-1]), 1), 6, WIDTH), np.float32)
    near_boxes[:, :3], near_boxes[:, 3:] = EMPTY, -EMPTY
    near_boxes[group, :3, lane], near_boxes[group, 3:, lane] = whole[near, :3].min(axis=2), whole[near, 3:].max(axis=2)
    near_nodes = np.zeros((len(near_boxes), WIDTH), np.int32)
    near_nodes[group, lane] = near
    return first, near_boxes, near_nodes


def _pairs(tree: Tree, balls: NDArray, low: NDArray, high: NDArray, start: int) -> tuple[NDArray, NDArray]:
    """Return pairs (bottom node, one whose balls reach into its box) for 4096 bottom nodes from `start` on."""
    bottom = np.arange(start, min(start + 4096, len(low)))
    node = np.zeros(len(bottom), np.int64)
    while len(node) and node[0] < tree.first_bottom:
        meets = (balls[node, :3] <= high[bottom][:, :, None]) & (balls[node, 3:] >= low[bottom][:, :, None])
        row, child = np.nonzero(meets.all(axis=1))
        first = np.where(node == 0, 1, WIDTH * node + tree.roots - (WIDTH - 1))
        bottom, node = bottom[row], first[row] + child
    order = np.lexsort((node, bottom))
    return bottom[order], node[order] - tree.first_bottom
