"""Eye-dome lighting: a stage between the tile stages and the last one. Kernels: gather_depths.cl, eye_dome.cl."""

import math

import numpy as np

from ..device import Device
from .point_drawing import PointDrawing
from .tiles import BIN, Grid, Scratch

# Twice as dark at these differences of depth, over the depth, between a pixel and the mean of those around it: 1 / 430.
STRENGTH = 300.0
NEIGHBOURS = 8


def eye_dome(device: Device, scratch: Scratch, grid: Grid, drawing: PointDrawing, camera, factor: int) -> None:
    """Darken what is drawn in its own colours where its neighbours in the picture are nearer.

    Parameters
    ----------
    factor : int
        Samples along a side of a pixel, by which the reach is multiplied.
    """
    angles = 2 * math.pi * np.arange(NEIGHBOURS) / NEIGHBOURS
    steps = np.rint(max(drawing.reach * factor, 1.0) * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    rim = int(np.abs(steps).max())
    width, height = grid.bins_x * BIN, grid.bins_y * BIN
    pitch = width + 2 * rim
    device.check_memory(depths=4 * pitch * (height + 2 * rim))
    depths = scratch.array("depths", (height + 2 * rim, pitch), np.float32)
    device.fill(depths, np.inf)
    constants = grid.layout.constants | {"VW": scratch.lanes}
    device.kernel("render/gather_depths.cl", constants=constants)(
        (grid.bins_x, height), (1, 8), grid.planes, grid.touched, grid.bins_x, height, rim, pitch, depths)
    projection = camera.projection(grid.size)
    # An orthographic picture is measured by the depth from which a camera of 40 degrees sees it as large.
    reference = 0.0 if projection.perspective else grid.size[1] / projection.fy / (2 * math.tan(math.radians(20)))
    items = grid.bin_count * (BIN * BIN if scratch.lanes == 1 else 1)
    device.kernel("render/eye_dome.cl", constants=constants)(
        (items,), (64 if scratch.lanes == 1 else 1,), depths, pitch, rim, device.upload(steps.astype(np.int32)),
        NEIGHBOURS, STRENGTH * drawing.strength * math.log2(math.e), reference, grid.bins_x, grid.bin_count,
        grid.touched, grid.planes)
