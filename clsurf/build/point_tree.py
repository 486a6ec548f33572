"""Points sorted along the Morton curve, with a 16-wide tree of boxes for ball queries on the device."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..device.arrays import DeviceArray

FAR_POINT = 1e6  # coordinate of the points that pad the last block (gather_points.cl)
BLOCK = 16  # points of a block, children of a node


@dataclass(eq=False)
class PointTree:
    """Sorted points on a device, unit-diagonal coordinates.

    Attributes
    ----------
    count, padded : int
        Points, and points padded to whole blocks.
    order : (count,) int32
        Index of every sorted point in the input.
    codes : (count,) uint64
        Morton codes, `bits` an axis, ascending.
    sorted : DeviceArray (6 or 7, padded) float32
        x, y, z, normal x, y, z, and weights where given.
    boxes, node_offset : DeviceArray
        See kernels/build/point_tree.clh.
    top_level : int
    scale : float
        Cells of the finest Morton grid per unit length.
    """

    device: Device
    count: int
    padded: int
    order: NDArray
    codes: NDArray
    bits: int
    sorted: DeviceArray
    boxes: DeviceArray
    node_offset: DeviceArray
    top_level: int
    scale: float

    @property
    def arguments(self) -> tuple:
        """The kernel arguments of a ball query: padded, sorted, boxes, node_offset, top_level."""
        return self.padded, self.sorted, self.boxes, self.node_offset, self.top_level

    @property
    def weighted(self) -> bool:
        """Whether the points have weights."""
        return self.sorted.shape[0] == 7

    def cells(self, width: float, points: NDArray | None = None) -> tuple[NDArray, NDArray, NDArray]:
        """Return the cells at least `width` wide that hold points, sorted by colour.

        Parameters
        ----------
        points : (m,) int, optional
            Ascending indices of the sorted points that count; all by default.

        Returns
        -------
        first, end : (c,) int32
            First counting point of every cell, and the last one + 1.
        colors : (9,) int
            Cells of colour k are colors[k] to colors[k + 1]; the colour is the parity of a cell's three coordinates.
        """
        step = min(max(0, math.ceil(math.log2(max(width * self.scale, 1.0)))), self.bits)
        cell = self.codes.copy() if points is None else self.codes[points]
        cell >>= np.uint64(3 * step)
        start = np.flatnonzero(np.concatenate([[True], cell[1:] != cell[:-1]]))
        last = np.append(start[1:], len(cell)) - 1
        color = (cell[start] & np.uint64(7)).astype(np.uint8)
        order = np.argsort(color, kind="stable")
        start, last = start[order], last[order]
        if points is not None:
            start, last = points[start], points[last]
        return start.astype(np.int32), (last + 1).astype(np.int32), np.searchsorted(color[order], np.arange(9))


def lane_form(device: Device) -> dict:
    """Return the constant that makes the kernels' form of 16 lanes, or that of single items."""
    return {"VW": 16 if device.lanes > 1 else 1}


def build_point_tree(points: NDArray, normals: NDArray, middle: NDArray, scale: float, device: Device,
                     weights: NDArray | None = None) -> PointTree:
    """Sort points along the Morton curve of their box and build the tree over them.

    Parameters
    ----------
    points, normals : (n, 3) float32
        n at least 1; normals of any positive length.
    middle : (3,) float32
    scale : float
        Sorted coordinates are (points - middle) * scale.
    """
    count = len(points)
    order, codes, grid = morton_order(points, device)
    padded = -(-count // BLOCK) * BLOCK
    out = device.empty((6 if weights is None else 7, padded), np.float32)
    on_device = device.upload(order)
    gather = device.kernel("build/gather_points.cl")
    for is_normal, vectors in enumerate((points, normals)):  # one after the other: 12 bytes a point less at the peak
        gather((padded,), (64,), count, padded, is_normal, device.upload(vectors), on_device, *map(float, middle),
               float(scale), out)
        device.finish()
    if weights is not None:
        device.kernel("build/gather_weights.cl")((padded,), (64,), count, padded, device.upload(weights),
                                                on_device, out)
    boxes, node_offset, top_level = build_boxes(out, padded, device)
    return PointTree(device, count, padded, order, codes, grid[0], out, boxes, node_offset, top_level,
                     grid[1] / scale)


def column_bounds(points: NDArray) -> NDArray:
    """Return the lowest and highest (2, 3) of points (n, 3): columns one by one, six times as fast as along axis 0."""
    return np.array([[points[:, k].min() for k in range(3)], [points[:, k].max() for k in range(3)]])


def morton_order(points: NDArray, device: Device) -> tuple[NDArray, NDArray, tuple[int, float]]:
    """Sort points (n, 3) float32 along the Morton curve of their box.

    Returns
    -------
    order : (n,) int32
    codes : (n,) uint64
        In that order.
    grid : tuple
        Bits an axis, and the number of cells per length.
    """
    count = len(points)
    index_bits = max(1, (count - 1).bit_length())
    bits = min(16, (64 - index_bits) // 3)
    low, high = column_bounds(points)
    width = max(float((high - low).max()), float(np.finfo(np.float32).tiny))
    cells_per_length = (1 << bits) / (width * (1 + 1e-6))
    codes = device.empty(count, np.uint64)
    kernel = device.kernel("build/morton_codes.cl", constants={"BITS": bits, "INDEX_BITS": index_bits})
    kernel((count,), (64,), count, device.upload(points), *map(float, low), cells_per_length, codes)
    # The index below each code makes all keys different, so that a plain sort of the keys gives the order.
    codes = device.download(codes, copy=False)
    codes.sort()
    order = (codes & np.uint64((1 << index_bits) - 1)).astype(np.int32)
    codes >>= np.uint64(index_bits)
    return order, codes, (bits, cells_per_length)


def build_boxes(coordinates: DeviceArray, padded: int, device: Device, radius: DeviceArray | None = None
                ) -> tuple[DeviceArray, DeviceArray, int]:
    """Return records, offsets and top level of the 16-wide tree over blocks of 16 points (point_tree.clh).

    With `radius` (padded,) the boxes are those of balls.
    """
    nodes = [padded // BLOCK]  # level 0: blocks
    while nodes[-1] > 1 or len(nodes) == 1:
        nodes.append(-(-nodes[-1] // BLOCK))
    offset = np.concatenate([[0, 0], np.cumsum(nodes[1:])]).astype(np.int32)  # level 0 has no records
    boxes = device.empty((int(offset[-1]), 6, BLOCK), np.float32)
    device.kernel("build/block_boxes.cl")((nodes[1],), (1,), nodes[1], nodes[0], padded, coordinates,
                                              coordinates if radius is None else radius, int(radius is not None), boxes)
    for level in range(2, len(nodes)):
        device.kernel("build/node_boxes.cl")((nodes[level],), (1,), nodes[level], nodes[level - 1], int(offset[level]),
                                             int(offset[level - 1]), boxes)
    return boxes, device.upload(offset), len(nodes) - 1
