"""SLIM surfaces for single rays: leaves in blocks of 16, one lane each. Kernel: kernels/trace/ray_slim.cl."""

import numpy as np

from ..device import Device
from ..surface.slim import COEFFICIENTS, SlimSurface
from .kinds import NOTHING, Traced, items, register
from .slim import upload_traced
from .tree import WIDTH

FAR = 1e15  # where the ball of an empty slot lies


@register(SlimSurface)
def trace_slim(device: Device, surface: SlimSurface) -> Traced:
    """Put the leaves on the device; the frame is the model's, relative to its origin."""
    base = upload_traced(device, surface)
    tree, count = base.tree, COEFFICIENTS[surface.degree]
    if not (tree.order >= 0).any():
        return Traced(surface.origin, 1.0, NOTHING, lambda *_: None)
    planes = device.download(base.surfels)  # x y z r r, normal, low high slope, coefficients
    empty = tree.order.reshape(-1, WIDTH) < 0
    z = planes[:, 7].astype(np.float64)
    turn = -1 / (np.copysign(1.0, z) + z)
    blocks = np.concatenate([planes[:, :3], planes[:, 5:8], turn[:, None], 1 / planes[:, 3:4], planes[:, 3:4],
                             planes[:, 11:11 + count]], axis=1).astype(np.float32)
    blocks[:, :3] = np.where(empty[:, None], FAR, blocks[:, :3])
    feet = np.ascontiguousarray(device.download(base.tails)[:, 8:10]).view(np.uint32)
    feet = np.ascontiguousarray(feet.reshape(-1, WIDTH, 2).transpose(0, 2, 1))
    limited = (feet != 0xFFFFFFFF).any(axis=(1, 2)).astype(np.uint8)
    top = device.download(base.boxes)[0]
    box = np.stack([top[:3].min(axis=1), top[3:].max(axis=1)]).astype(np.float64)
    margin = 1e-3 * float((box[1] - box[0]).max())
    leaves = np.flatnonzero(surface.leaf) if surface.leaf.any() else np.arange(len(surface))  # what the tree holds
    numbers = np.where(tree.order >= 0, leaves[tree.order], -1).astype(np.int32)
    arrays = [device.upload(array) for array in (blocks, feet, limited, numbers)]

    def launch(mode, rays_count, rays, hits):
        size, group, batch = items(device, rays_count)
        constants = {"VW": device.lanes, "DEGREE": surface.degree, "ORIENTED": surface.oriented, "MODE": mode}
        device.kernel("trace/ray_slim.cl", constants=constants)(
            size, group, rays_count, batch, tree.roots, tree.first_bottom, base.boxes, base.balls, *arrays, rays, hits)

    return Traced(surface.origin, 1.0, box + margin * np.array([[-1.0], [1.0]]), launch)
