"""The stages of feature lines on the device: from a frame's channels to the points where lines cross pixel edges."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from ..render.tiles import Scratch

MARGIN_X, MARGIN_Y = 16, 8  # pixels around the planes; kernels/analysis/line_planes.clh
CAMERA_FLOATS = 16
ROWS = 32  # rows that one work-item of smooth_lines smooths


@dataclass(frozen=True)
class Field:
    """What a kind of line is found in.

    Parameters
    ----------
    field, strength : str
        Channels: lines are the zeros of the first, their strength is the second.
    sign : int
        The strength is sign times its channel, or the channel's size where sign is 0.
    axis : str
        Channel of the direction that `field` is a derivative along.
    extremum : int
        With `axis`: 1 keeps the zeros where the field falls along it, -1 those where it rises.
    other : str
        Channel that must not exceed the strength in size.
    sines : bool
        Multiply field and strength by the squared sine between normal and ray.
    power : int
        The strength's unit is the median of the mean curvature's size, to this power.
    least, peak, full : float
        In that unit: lines are cut where weaker than `least`, dropped where nowhere as strong as `peak`, and drawn with
        full strength from `full` on.
    """

    field: str
    strength: str
    sign: int = 1
    axis: str = ""
    extremum: int = 1
    other: str = ""
    sines: bool = False
    power: int = 1
    least: float = 1.0
    peak: float = 2.0
    full: float = 4.0

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of a frame that it needs, beside depth and normal."""
        return tuple(dict.fromkeys(name for name in (self.field, self.strength, self.axis, self.other, "mean") if name))


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where lines of one kind cross the edges between pixels."""

    edges: NDArray  # (n,) int64, ascending: 2 * pixel, + 1 for the edge downwards
    points: NDArray  # (n, 4) float32: x, y (pixels), depth, strength
    columns: int  # pixels in a row of edge numbers
    height: int

    def chosen(self, mask: NDArray) -> "Crossings":
        """Return those where `mask` (n,) bool holds."""
        return Crossings(self.edges[mask], self.points[mask], self.columns, self.height)


def camera_floats(camera, size) -> NDArray:
    """Return the camera buffer (16,) float32 of kernels/analysis/line_planes.clh."""
    p = camera.projection(size)
    right, up, back = camera.rotation
    out = np.zeros(CAMERA_FLOATS)
    out[3:6], out[6:9], out[9:12], out[12] = right / p.fx, -up / p.fy, -back, p.perspective
    out[0:3] = (0.5 - p.cx) * out[3:6] + (0.5 - p.cy) * out[6:9] + (out[9:12] if p.perspective else 0)
    return out.astype(np.float32)


class LinePlanes:
    """The planes of one frame on a device; the stages read and write them."""

    def __init__(self, device: Device, frame, lanes: int | None = None):
        self.device, self.frame = device, frame
        self.scratch = shared_scratch(device, device.lanes if lanes is None else lanes)
        self.lanes = self.scratch.lanes
        self.width, self.height = frame.size
        self.columns = -(-self.width // 16) * 16
        self.stride = self.columns + 2 * MARGIN_X
        self.rows = self.height + 2 * MARGIN_Y
        self.plane = self.stride * self.rows
        if 2 * self.columns * self.height >= 2**31:
            raise InputError(f"frame: expected less than 2^30 pixels to find lines in, got {frame.size}: render a "
                             "smaller picture")
        device.check_memory(planes=4 * 14 * self.plane)
        self.camera = device.upload(camera_floats(frame.camera, frame.size))
        self._uploads: dict[str, DeviceArray] = {}
        self.depths, self.sine2, self.links = self._geometry()

    def _array(self, name: str, planes: int = 1, dtype=np.float32) -> DeviceArray:
        return self.scratch.array(name, (planes, self.plane), dtype)

    def _channel(self, name: str) -> DeviceArray:
        if name not in self._uploads:
            self._uploads[name] = self.device.upload(getattr(self.frame, name), np.float32)
        return self._uploads[name]

    def _run(self, name: str, arguments, constants=(), padded: bool = True):
        """Launch a kernel with a work-item per `lanes` pixels of the picture or of the padded planes."""
        constants = {"VW": self.lanes} | dict(constants)
        across, down = (self.stride, self.rows) if padded else (self.width, self.height)
        items = (-(-across // self.lanes), down)
        local = (8, 8) if self.lanes == 1 else (1, min(8, down))
        self.device.kernel(f"analysis/{name}.cl", constants=constants)(items, local, *arguments)

    def _geometry(self):
        """Find slopes, and which neighbouring pixels belong together."""
        depths, sine2, links = self._array("depths"), self._array("sine2"), self._array("links", dtype=np.int32)
        slope_x, slope_y = self._array("slope_x"), self._array("slope_y")
        self._run("line_slopes", (self.width, self.height, self.stride, self.camera, self._channel("depth"),
                                  self._channel("normal"), depths, slope_x, slope_y, sine2))
        self._run("line_links", (self.height, self.stride, self.camera, depths, slope_x, slope_y, links))
        return depths, sine2, links

    def field_crossings(self, field: Field, sigma: float, least: float) -> Callable[[], Crossings]:
        """Smooth a field by a Gaussian of `sigma` pixels, and find its zeros where the strength is at least `least`.

        The device begins at once; what is returned waits for it, once, and must be called before the next search.
        """
        axis = bool(field.axis)
        values = self._array("values", 7 if axis else 2)
        unused = self._channel(field.field)
        self._run("line_values", (
            self.width, self.height, self.stride, self.plane, float(field.sign), self.links, self.sine2,
            self._channel(field.field), self._channel(field.strength),
            self._channel(field.other) if field.other else unused,
            self._channel(field.axis) if axis else unused, values),
            {"AXIS": axis, "SINES": field.sines, "OTHER": bool(field.other)})
        smooth, strength = self._array("field"), self._array("strength")
        weights = gaussian_weights(sigma)
        self.device.kernel("analysis/smooth_lines.cl", constants={
            "VW": self.lanes, "AXIS": axis, "RADIUS": len(weights) - 1, "ROWS": ROWS})(
            (self.stride // self.lanes, -(-self.height // ROWS)), (1, 1) if self.lanes > 1 else (16, 1), self.height,
            self.stride, self.plane, self.links, values, self.device.upload(weights), smooth, strength)
        codes = self._codes()
        self._run("line_edges", (self.width, self.height, self.stride, self.plane, float(least), self.camera,
                                 self.depths, smooth, strength, values, codes),
                  {"AXIS": axis, "EXTREMUM": field.extremum}, padded=False)
        self.device.queue.flush()
        return lambda: self._points(codes, smooth, strength, values, {"AXIS": axis})

    def contour_crossings(self) -> Callable[[], Crossings]:
        """Find where the surface seen ends; as `field_crossings`."""
        codes = self._codes()
        self._run("contour_edges", (self.width, self.height, self.stride, self.links, self.depths, codes),
                  padded=False)
        self.device.queue.flush()
        return lambda: self._points(codes, self.sine2, self.sine2, self.sine2, {"CONTOUR": True})

    def _codes(self) -> DeviceArray:
        # Rounded up for lanes that reach beyond the last row's end.
        codes = self.scratch.array("codes", (self.height, self.columns), np.uint8)
        self.device.fill(codes, 0)
        return codes

    def _points(self, codes, field, strength, values, constants) -> Crossings:
        found = self.device.download(codes, copy=False)
        edges = edge_numbers(found)
        points = np.empty((0, 4), np.float32)
        if len(edges):
            out = self.scratch.array("points", (len(edges), 4), np.float32)
            self.device.kernel("analysis/line_points.cl", constants=constants)(
                (len(edges),), (min(64, len(edges)),), len(edges), self.stride, self.plane,
                self.device.upload(edges.astype(np.int32)), self.links, self.depths, self.sine2, field, strength,
                values, out)
            points = self.device.download(out)
        return Crossings(edges, points, self.columns, self.height)


def edge_numbers(codes: NDArray) -> NDArray:
    """Return the ascending numbers (n,) int64 of the edges that the bytes `codes` (h, columns) name."""
    # Eight bytes at a time: nearly all are 0.
    words = np.flatnonzero(codes.reshape(-1).view(np.uint64))
    pixels = (8 * words[:, None] + np.arange(8)).ravel()
    here = codes.reshape(-1)[pixels]
    both = np.stack([here & 1, here >> 1], axis=1).ravel() > 0
    return (2 * pixels[:, None] + np.arange(2)).ravel()[both]


def gaussian_weights(sigma: float) -> NDArray:
    """Return the weights (radius + 1,) float32 of a Gaussian from its middle on, cut at 3 sigma, at least one pixel."""
    radius = int(np.clip(np.ceil(3 * sigma), 2, MARGIN_Y))
    return np.exp(-0.5 * (np.arange(radius + 1) / max(sigma, 1e-3))**2).astype(np.float32)


_shared = threading.local()


def shared_scratch(device: Device, lanes: int) -> Scratch:
    """Return this thread's buffers for lines on `device`."""
    kept = _shared.__dict__.setdefault("scratch", {})
    if (id(device), lanes) not in kept:
        kept[id(device), lanes] = Scratch(device, lanes)
    return kept[id(device), lanes]
