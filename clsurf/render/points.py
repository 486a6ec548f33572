"""Point clouds and range images in the renderer: upload, spacing, projection and the tile stage.

Kernels: kernels/render/point_spacing.cl, project_points.cl, tile_points.cl.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from ..surface.arrays import box_of, finite_rows
from ..surface.cloud import PointCloud
from ..surface.ranges import RangeScan
from ..surface.srgb import LINEAR_OF_BYTE, to_linear
from .point_drawing import PointDrawing
from .shade import Look, Shading
from .slim import rainbow
from .tiles import BIN, Grid, PairLists, Scratch, bin_pairs, new_footprints, view_floats

RUN, ASKED, RUN_FLOATS = 256, 16, 8  # kernels/render/points.clh, point_spacing.cl
RADIUS_PX, RADIUS_FIXED, FLAT_COLOR = 24, 25, 26  # of the view buffer
MORTON_BITS = 10  # an axis, of the order of the points
# Radius over the distance to the sixth neighbour, of which a run takes the upper quartile. On a square grid that
# distance is 1.4 spacings and 0.7 close the gaps; points at random need 1.5 to leave one pixel in 1000 open.
RADIUS_SHARE = 0.85
LARGEST_SHARE = 4.0  # of the median radius: strays do not become plates
WIDEST_SHARE = 0.5  # of `lod`: pixels that the discs of thinned runs may be wide


@dataclass(frozen=True, eq=False)
class CloudUpload:
    """Points on a device, in planes of `stride` floats (kernels/render/points.clh)."""

    count: int  # runs
    stride: int
    planes: DeviceArray  # (4 or 7, stride) float32
    runs: DeviceArray  # (count, RUN_FLOATS) float32
    has_normals: bool
    colors: DeviceArray | None  # (stride, 4) uint8 sRGB
    linear: DeviceArray  # (256,) float32: of bytes
    origin: NDArray  # (3,) float64
    center: NDArray  # (3,) float64, relative to origin
    reach: float
    order: NDArray  # (stride,) int64: the cloud's numbers of the points; -1: none
    attributes: dict = field(default_factory=dict)  # of the cloud
    made: dict = field(default_factory=dict)  # colours by attribute
    ranges: dict = field(default_factory=dict)  # of attributes, where they are not those of these points alone


def upload_cloud(device: Device, cloud: PointCloud | RangeScan) -> CloudUpload:
    """Put points on the device, sorted in space; those that are not finite are left out.

    Raises
    ------
    DeviceMemoryError
    """
    if isinstance(cloud, RangeScan):
        cloud = cloud.to_points()
    usable = np.flatnonzero(finite_rows(cloud.points))
    n = len(usable)
    runs = -(-n // RUN)
    stride = max(runs, 1) * RUN
    floats = 4 if cloud.normals is None else 7
    device.check_memory(points=4 * floats * stride, colors=0 if cloud.colors is None else 4 * stride)
    order = np.full(stride, -1, np.int64)
    order[:n] = usable[space_order(cloud.points[usable])]
    order = order.reshape(-1, RUN)[:, spread_places()].reshape(-1)
    there = order >= 0
    planes = device.empty((floats, stride), np.float32)
    host = np.full((floats, stride), np.nan, np.float32)
    host[:3, there] = cloud.points[order[there]].T
    if cloud.normals is not None:
        host[4:7, there] = cloud.normals[order[there]].T
    points = host[:3].reshape(3, -1, RUN)
    low, high = np.fmin.reduce(points, axis=2), np.fmax.reduce(points, axis=2)
    device.write(planes, host)
    radius = run_radii(device, planes, stride, runs, low, high)
    host[3] = np.repeat(radius, RUN)
    device.write(planes, host)
    boxes = np.zeros((max(runs, 1), RUN_FLOATS), np.float32)
    boxes[:, :3], boxes[:, 3:6], boxes[:, 6] = low.T, high.T, radius
    colors = None
    if cloud.colors is not None:
        colors = np.zeros((stride, 4), np.uint8)
        colors[there] = cloud.colors[order[there]]
        colors = device.upload(colors)
    low, high = (low.min(axis=1), high.max(axis=1)) if n else (np.zeros(3), np.zeros(3))
    center = (low.astype(np.float64) + high) / 2
    reach = float(np.linalg.norm(high - center) + (radius.max() if n else 0))
    return CloudUpload(runs, stride, planes, device.upload(boxes), cloud.normals is not None, colors,
                       device.upload(LINEAR_OF_BYTE.astype(np.float32)), cloud.origin, center, reach, order,
                       cloud.attributes)


def space_order(points: NDArray) -> NDArray:
    """Return the order (n,) of points (n, 3) float32 along a Morton curve."""
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = box_of(points)
    extent = max(float((high - low).max()), 1e-30)
    code = np.zeros(len(points), np.uint32)
    for axis in range(3):
        cell = ((points[:, axis] - low[axis]) * np.float32(((1 << MORTON_BITS) - 1) / extent)).astype(np.uint32)
        code |= spread_bits(cell) << np.uint32(axis)
    # Two passes over halves: NumPy sorts 16 bits by radix (10M points: 1.1 s instead of 2.3).
    first = np.argsort((code & np.uint32(0xFFFF)).astype(np.uint16), kind="stable")
    return first[np.argsort((code[first] >> np.uint32(16)).astype(np.uint16), kind="stable")]


def spread_bits(x: NDArray) -> NDArray:
    """Return the low 10 bits of x (n,) uint32 with two free bits between each."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        x = (x | x << np.uint32(shift)) & np.uint32(mask)
    return x


def spread_places() -> NDArray:
    """Return the order (RUN,) of a run's points in which the first 16, 32, ... are spread over it: reversed bits."""
    places, out = np.arange(RUN), np.zeros(RUN, int)
    for _ in range(RUN.bit_length() - 1):
        out, places = out << 1 | places & 1, places >> 1
    return out


def run_radii(device: Device, planes: DeviceArray, stride: int, runs: int, low: NDArray, high: NDArray) -> NDArray:
    """Return the radius (at least 1,) float32 of the discs of each run; `low`, `high` (3, runs) are the boxes."""
    if not runs:
        return np.zeros(1, np.float32)
    spacing = device.empty((runs, ASKED), np.float32)
    lanes = device.lanes
    device.kernel("render/point_spacing.cl", constants={"VW": lanes})((runs * ASKED // lanes,), None, planes, stride,
                                                                       runs, spacing)
    with np.errstate(all="ignore"):
        found = np.sqrt(device.download(spacing))
        found[~np.isfinite(found)] = np.nan
        known = np.isfinite(found).any(axis=1)
        radius = np.full(runs, np.nan, np.float32)
        if known.any():
            radius[known] = RADIUS_SHARE * np.nanquantile(found[known], 0.75, axis=1)
        size = np.linalg.norm(high - low, axis=0)
        # Fewer than seven places: a share of their box, and of nothing a share of all.
        some = np.nanmedian(radius) if known.any() else max(float(np.nanmax(size)) / 4, 0.0)
        radius = np.where(known, np.minimum(radius, LARGEST_SHARE * some), some)
    return np.where(radius > 0, radius, 1.0).astype(np.float32)


def is_unlit(surface, drawing: PointDrawing, shading: Shading) -> bool:
    """Return whether `surface` is drawn in its own colours, with or without eye-dome lighting, under the look."""
    if not isinstance(surface, PointCloud | RangeScan) or shading.look != "phong":
        return False
    return bool(drawing.eye_dome) or getattr(surface, "normals", None) is None


def place_points(upload: CloudUpload, matrix: NDArray | None, camera, size, look: Look) -> NDArray:
    """Return the view buffer of placed points (kernels/common/view.clh, kernels/render/points.clh)."""
    if matrix is None:
        scale, rotation, offset = 1.0, camera.rotation, camera.rotation @ (upload.origin - camera.eye)
    else:
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        rotation = camera.rotation @ (matrix[:3, :3] / scale)
        offset = camera.rotation @ (matrix[:3, :3] @ upload.origin + matrix[:3, 3] - camera.eye)
    middle, reach = -(scale * rotation[2] @ upload.center + offset[2]), scale * upload.reach
    first = max(middle - reach, 0.0) if camera.projection(size).perspective else middle - reach
    view = view_floats(camera, size, rotation, offset, scale, depths=(first, middle + reach))
    if look.points.size is not None:
        pixels = look.points.unit == "pixels"
        view[RADIUS_PX if pixels else RADIUS_FIXED] = look.points.size / 2 / (1.0 if pixels else scale)
    view[FLAT_COLOR:FLAT_COLOR + 3] = to_linear(look.shading.color)
    return view


def attribute_range(values: NDArray) -> tuple[float, float]:
    """Return the values (n,) that the first and the last colour stand for."""
    values = np.asarray(values, np.float64)
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, (1, 99)) if len(finite) else (0.0, 1.0)
    return (low, high) if high > low else (values.min(initial=0), values.max(initial=1))


def attribute_colors(device: Device, upload: CloudUpload, name: str) -> DeviceArray:
    """Return colours (stride, 4) uint8 by an attribute, made the first time that a frame needs it."""
    if name not in upload.made:
        values = upload.attributes.get(name)
        if values is None or np.ndim(values) != 1 or np.asarray(values).dtype.kind not in "fiub":
            names = [key for key, value in upload.attributes.items() if np.ndim(value) == 1]
            raise InputError(f"points attribute: expected one of {', '.join(names) or 'none (the cloud has none)'}, "
                             f"got {name!r}")
        values = np.asarray(values, np.float64)
        low, high = upload.ranges[name] if name in upload.ranges else attribute_range(values)
        colors = np.full((upload.stride, 4), 255, np.uint8)
        there = upload.order >= 0
        share = np.nan_to_num((values[upload.order[there]] - low) / max(high - low, 1e-300))
        colors[there, :3] = np.rint(255 * rainbow(share))
        upload.made[name] = device.upload(colors)
    return upload.made[name]


def project_points(device: Device, scratch: Scratch, grid: Grid, upload: CloudUpload, view: DeviceArray,
                   lod: float) -> tuple[DeviceArray, DeviceArray, PairLists | None]:
    """Sort runs of points into tiles.

    Returns
    -------
    drawn : (runs,) int32
        How many points of each run are drawn.
    boxes : (runs, 4) int16
        First and last bin that each run may touch, in x and y.
    pairs : PairLists or None
        The runs that may touch each tile of ``grid.patch_bins`` bins; None where nothing touches the picture.
    """
    drawn = scratch.array("points_drawn", (upload.count,), np.int32)
    touch = new_footprints(device, scratch, upload.count)
    device.kernel("render/project_points.cl", constants={"TILE_BINS": grid.patch_bins})(
        (upload.count,), (16,), view, upload.runs, upload.count, WIDEST_SHARE * lod, drawn, touch.full, touch.core,
        touch.keys, touch.buckets)
    tiles = [-(-n // grid.patch_bins) for n in (grid.bins_x, grid.bins_y)]
    coarse = replace(grid, size=(tiles[0] * BIN, tiles[1] * BIN), masked=False)
    return drawn, touch.core, bin_pairs(device, scratch, coarse, touch, upload.count)


def draw_points(device: Device, scratch: Scratch, grid: Grid, upload: CloudUpload, matrix, camera, look: Look,
                number: int) -> None:
    """Draw placed points into the planes of a grid."""
    if not upload.count:
        return
    drawing, shading = look.points, look.shading
    colors = None
    if grid.layout.color and drawing.attribute is not None:
        colors = attribute_colors(device, upload, drawing.attribute)
    elif grid.layout.color and shading.model_colors:
        colors = upload.colors
    view = device.upload(grid.clip_into(place_points(upload, matrix, camera, grid.size, look)))
    drawn, boxes, pairs = project_points(device, scratch, grid, upload, view, look.lod)
    if pairs is None:
        return
    unlit = shading.look == "phong" and (bool(drawing.eye_dome) or not upload.has_normals)
    constants = grid.layout.constants | {
        "VW": scratch.lanes, "TILE_BINS": grid.patch_bins, "HAS_NORMALS": upload.has_normals,
        "HAS_COLOR": colors is not None, "COUNT_COST": look.cost, "UNLIT": unlit,
        "MASKED": int(grid.masked)}
    tiles_x, group = -(-grid.bins_x // grid.patch_bins), 64 if scratch.lanes == 1 else 1
    tiles = tiles_x * -(-grid.bins_y // grid.patch_bins)
    device.kernel("render/tile_points.cl", constants=constants)(
        (tiles * group,), (group,), view, pairs.pairs, pairs.offsets, boxes, upload.planes, upload.stride,
        upload.count, drawn, colors or view, upload.linear, number, tiles_x, tiles, grid.bins_x, grid.bins_y,
        grid.touched, grid.planes)
