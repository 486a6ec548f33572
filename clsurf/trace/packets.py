"""Packets: rays of the pixels of a bin, which share an origin or a direction, against SLIM surfaces.

Kernels: kernels/trace/packet.clh. What the packets find goes into the planes of a picture's bins (8x8 pixels,
kernels/common/planes.clh), so that the shading of a traced picture is that of any other.
"""

from ..device import Device, DeviceArray
from .slim import TracedSlim

TILE_BINS = 4  # a work-item traces a square of so many bins


def packet_lanes(lanes: int) -> int:
    """Return the kernel form for a renderer's lanes: packets come in 16 lanes or in single rays."""
    return 1 if lanes == 1 else 16


def work_items(lanes: int, bins_x: int, bins_y: int) -> tuple[tuple[int], tuple[int]]:
    """Return global and local sizes of a kernel over all bins of a picture."""
    if lanes == 1:
        return (64 * bins_x * bins_y,), (64,)
    return (-(-bins_x // TILE_BINS) * -(-bins_y // TILE_BINS),), (1,)


def trace_pixels(device: Device, lanes: int, traced: TracedSlim, view: DeviceArray, layout: dict[str, int], number: int,
                 colors: DeviceArray | None, bins_x: int, bins_y: int, touched: DeviceArray,
                 planes: DeviceArray) -> None:
    """Trace the ray of every pixel into the planes of its bin, with the visibility and blending of the tile renderer.

    Parameters
    ----------
    lanes : int
        Kernel form: 16 or 1.
    view : (32,) float32
        The placed surface seen by the camera (kernels/common/view.clh).
    layout : dict
        ``FIELDS`` and ``FIELD_X`` of the planes (kernels/common/planes.clh).
    number : int
        The surface's place in the scene, for the plane of ids.
    colors : (slots, 4) float32, optional
        Linear colours to blend.
    touched : (bins_y * bins_x,) int32
        Surfel evaluations so far, -1 where nothing came yet.
    planes : (bins_y * bins_x, FIELDS, 64) float32
    """
    tree = traced.tree
    constants = {**layout, **traced.constants, "VW": lanes, "TILE_BINS": TILE_BINS, "HAS_COLOR": colors is not None}
    device.kernel("trace/trace_pixels.cl", constants=constants)(
        *work_items(lanes, bins_x, bins_y), view, traced.boxes, traced.balls, tree.roots, tree.first_bottom,
        traced.surfels, traced.tails, view if colors is None else colors, number, bins_x, bins_y, touched, planes)


def trace_lights(device: Device, lanes: int, traced: TracedSlim, view: DeviceArray, layout: dict[str, int],
                 lamps: DeviceArray, lamp_count: int, reach: float, fresh: bool, bins_x: int, bins_y: int,
                 touched: DeviceArray, planes: DeviceArray, mask: DeviceArray, stride: int = 64,
                 offset: int = 0) -> None:
    """Set the bits of the lamps that the points of a picture do not see because of one surface.

    Parameters
    ----------
    view : (32,) float32
        The surface that throws the shadow, placed, seen by the picture's camera.
    lamps : (lamp_count, 8) float32
        Kind (0: at the eye, 1: directional, 2: point), then the direction to the lamp or its place, in view space;
        at most 32.
    reach : float
        World units: what lies farther than this before a point does not count; inf: everything counts.
    fresh : bool
        Whether the mask holds nothing yet.
    planes : (bins, FIELDS, 64) float32
        Depth and normals of the points.
    mask : uint32
        Bit l of word ``bin * stride + offset + pixel`` is lamp l's. Points that face away from a lamp keep 0.
    """
    tree = traced.tree
    constants = {**layout, **traced.constants, "VW": lanes, "TILE_BINS": TILE_BINS}
    device.kernel("trace/trace_lights.cl", constants=constants)(
        *work_items(lanes, bins_x, bins_y), view, traced.boxes, tree.roots, tree.first_bottom,
        traced.surfels, traced.tails, lamps, lamp_count, reach, int(fresh), bins_x, bins_y, touched, planes, mask,
        stride, offset)
