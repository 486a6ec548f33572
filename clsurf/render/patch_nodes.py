"""What a frame works out at the nodes of patches: their light (Gouraud), their normals by a table; paper, section 3."""

import numpy as np

from ..device import Device, DeviceArray
from .tiles import Scratch


def light_nodes(device: Device, scratch: Scratch, upload, constants: dict, view: DeviceArray, lamps: DeviceArray,
                rectangles: DeviceArray, slopes: DeviceArray) -> DeviceArray:
    """Return the lit linear colours (N, 4) float32 of the nodes of all patches in the picture."""
    lit = scratch.array("lit_nodes", (upload.heights.shape[0], 4), np.float32)
    group = 64 if scratch.lanes == 1 else 1
    device.kernel("render/light_nodes.cl", constants=constants | {"VW": scratch.lanes})(
        (upload.count * group,), (group,), view, lamps, rectangles, upload.frames, upload.sizes, upload.offsets,
        upload.count, upload.heights, slopes, upload.colors, upload.linear, lit)
    return lit
