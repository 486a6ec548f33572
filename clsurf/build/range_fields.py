"""The samples of range images on the device: positions, which cells are surface, weights, colours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..device import Device, DeviceArray
from ..surface.arrays import lengths_of
from ..surface.ranges import RangeImage, RangeScan

# Depth over width of a step between samples that is a jump: surfaces seen flatter than 11 degrees are lost with it.
JUMP = 5.0
NOISE_STEPS = 2.5  # noise levels that are no jump
ROUGH = 0.25  # depth noise over sample spacing above which a depth image is smoothed
GATE = 3.0  # noise levels beyond which a sample does not count in smoothing
LARGEST_RADIUS = 6  # of smoothing, pixels
RAMP = 8.0  # samples from a border over which weights rise


@dataclass(eq=False)
class RangeField:
    """All images' samples one after the other; a cell is called by its least sample (row by row).

    Attributes
    ----------
    shapes : (k, 2) int
        Rows and columns of the images.
    first : (k + 1,) int
        First sample of each image.
    signs : (k,) int
        1 where the cross product of a row's and a column's direction faces the eye, otherwise -1.
    noise : (k,) float
        What two samples of one surface may differ by; world units, for depth images over the squared distance.
    eyes : (k, 3) float64
        Relative to `origin`.
    pitch : (k, 2) float
        Median distances of neighbours along rows and along columns of the image, world units.
    samples : (n, 4) float32 on the device
        Position relative to `origin`, weight.
    cells : (n,) uint8
    colors : (n, 4) uint8 or None
    origin : (3,) float64
    diagonal : float
    """

    shapes: NDArray
    first: NDArray
    signs: NDArray
    noise: NDArray
    squared: NDArray
    eyes: NDArray
    pitch: NDArray
    samples: DeviceArray
    cells: NDArray
    colors: NDArray | None
    origin: NDArray
    diagonal: float

    @property
    def image_table(self) -> NDArray:
        """(k, 4) int32: first sample, columns, sign, rows."""
        return np.stack([self.first[:-1], self.shapes[:, 1], self.signs, self.shapes[:, 0]], axis=1).astype(np.int32)


def range_field(scan: RangeScan, device: Device, step) -> RangeField:
    """Bring the samples of a scan to the device; `step(share)` is called after each image."""
    shapes = np.array([image.shape for image in scan.images])
    first = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))])
    device.check_memory(samples=16 * int(first[-1]), cells=int(first[-1]), labels=4 * int(first[-1]))
    eyes = np.array([image.eye_world() for image in scan.images])
    bounds, noise = scan.bounds, np.zeros(len(scan))
    origin = bounds.mean(axis=0)
    samples, cells = device.empty((int(first[-1]), 4), np.float32), device.zeros(int(first[-1]), np.uint8)
    squared = np.array([image.depth is not None for image in scan.images])
    pitch, signs = np.zeros((len(scan), 2)), np.ones(len(scan), np.int64)
    for k, image in enumerate(scan.images):
        values, noise[k] = _values(image, device)
        _place_samples(image, values, origin, int(first[k]), samples, device)
        pitch[k], signs[k] = _pitch(image)
        rows, columns = (int(n) for n in shapes[k])
        gap = 0.0 if squared[k] else float(pitch[k].prod() ** 0.5)
        device.kernel("build/range_cells.cl")(
            (columns, rows), (16, 1), rows, columns, int(first[k]), *(eyes[k] - origin), JUMP, NOISE_STEPS * noise[k],
            gap, int(squared[k]), samples, cells)
        step((k + 1) / len(scan))
    found = device.download(cells)
    border = _border(found, shapes, first)
    unit = float(np.median(pitch[pitch > 0])) if (pitch > 0).any() else 1.0
    weigh = device.kernel("build/range_weights.cl")
    border_there, cells_there = device.upload(border), device.upload(found)
    for k in range(len(scan)):
        rows, columns = (int(n) for n in shapes[k])
        weigh((columns, rows), (16, 1), rows, columns, int(first[k]), *(eyes[k] - origin), unit, RAMP, cells_there,
              border_there, samples)
    return RangeField(shapes, first, signs, noise, squared, eyes - origin, pitch, samples, found, _colors(scan), origin,
                      float(np.linalg.norm(bounds[1] - bounds[0])))


def raw_samples(scan: RangeScan, field: RangeField, device: Device) -> DeviceArray:
    """Return the samples (n, 4) as the scan has them, not smoothed, on the device."""
    samples = device.empty(field.samples.shape, np.float32)
    for k, image in enumerate(scan.images):
        values = device.upload(image.depth if image.points is None else image.points)
        _place_samples(image, values, field.origin, int(field.first[k]), samples, device)
    return samples


def sample_spacing(scan: RangeScan) -> float:
    """Return the distance of neighbouring samples, world units: the median over the images."""
    pitch = np.array([_pitch(image)[0] for image in scan.images])
    pitch = pitch[(pitch > 0).all(axis=1)]
    return float(np.median(np.sqrt(pitch.prod(axis=1)))) if len(pitch) else 0.0


def coarser(scan: RangeScan, times: int) -> RangeScan:
    """Return `scan` with one sample, the mean, in place of `times` x `times`; those beyond a depth jump do not count.

    A sample needs half of its own to be there.
    """
    return scan if times == 1 else RangeScan([_coarser(image, times) for image in scan.images])


def _coarser(image: RangeImage, times: int) -> RangeImage:
    rows, columns = (-(-n // times) for n in image.shape)

    def blocks(array, fill):
        wide = np.full((rows * times, columns * times, array.shape[2]), fill, array.dtype)
        wide[:array.shape[0], :array.shape[1]] = array
        return wide.reshape(rows, times, columns, times, -1).swapaxes(1, 2).reshape(rows, columns, times * times, -1)

    points = blocks(image.sensor_points(), np.nan)
    z = points[..., 2]
    ordered, count = np.sort(z, axis=2), np.isfinite(z).sum(axis=2)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[..., None] // 2, axis=2)
    pitch = np.sqrt(_pitch(image)[0].prod()) / _scale(image)
    kept = np.abs(z - middle) <= JUMP * times * pitch
    share = kept / np.maximum(kept.sum(axis=2, keepdims=True), 1)
    mean = np.einsum("hwki,hwk->hwi", np.nan_to_num(points), share)
    mean[kept.sum(axis=2) * 2 < times * times] = np.nan
    color = image.sample_colors()
    if color is not None:
        color = np.rint(np.einsum("hwki,hwk->hwi", blocks(color, 0).astype(np.float32), share)).astype(np.uint8)
    eye = np.zeros(3) if image.eye is None and image.depth is not None else image.eye
    return RangeImage(points=mean, color=color, pose=image.pose, eye=eye, name=image.name)


def _scale(image: RangeImage) -> float:
    """Return world units over the sensor's."""
    return float(np.cbrt(np.linalg.det(image.pose[:3, :3])))


def _values(image: RangeImage, device: Device) -> tuple[DeviceArray, float]:
    """Return the depth (smoothed where it is noisy) or the points on the device, and the noise, world units."""
    scale = _scale(image)
    if image.depth is None:
        forward = image.points[::2, :, 2]
        return device.upload(image.points), scale * noise_of(forward)
    disparity = 1 / image.depth
    noise = noise_of(disparity[::2])
    focal = float(np.sqrt(image.intrinsics[0, 0] * image.intrinsics[1, 1]))
    rough = noise * focal * float(np.median(image.depth[image.valid])) if noise > 0 else 0.0
    if not rough > ROUGH:
        return device.upload(image.depth), noise / scale
    radius = min(LARGEST_RADIUS, max(1, round(2.6 * rough ** 0.5)))
    return smooth_depth(disparity, radius, GATE * noise, device), noise / scale


def smooth_depth(disparity: NDArray, radius: int, gate: float, device: Device) -> DeviceArray:
    """Return the depth (h, w) of smoothed `disparity` (h, w) float32 on the device; see smooth_depth.cl."""
    rows, columns = disparity.shape
    lanes = device.lanes
    stride = -(-columns // lanes) * lanes + 2 * radius
    padded = np.full((rows + 2 * radius, stride), 1e15, np.float32)
    padded[radius:-radius, radius:radius + columns] = np.nan_to_num(disparity, nan=1e15)
    out = device.empty((rows, columns), np.float32)
    device.kernel("build/smooth_depth.cl", constants={"VW": lanes, "RADIUS": radius})(
        (-(-columns // lanes), rows), (1, 1), rows, columns, stride, gate, device.upload(padded), out)
    return out


def noise_of(values: NDArray) -> float:
    """Return the noise along the rows of (h, w) as the 90th percentile of second differences, 0 where there are none.

    A quantised sensor gives its step. Of smooth surfaces the second differences are their bending: the fourth ones,
    scaled to what they are for white noise, are next to nothing there, so the smaller of both is taken.
    """
    second = values[:, :-2] - 2 * values[:, 1:-1] + values[:, 2:]
    fourth = second[:, :-2] - 2 * second[:, 1:-1] + second[:, 2:]
    return min(_percentile(second), _percentile(fourth) * (6 / 70) ** 0.5)


def _percentile(values: NDArray) -> float:
    values = np.abs(values[np.isfinite(values)])
    rank = int(0.9 * (len(values) - 1))
    return float(np.partition(values, rank)[rank]) if len(values) else 0.0


def _place_samples(image: RangeImage, values: DeviceArray, origin, first: int, samples: DeviceArray, device: Device):
    matrix = image.pose[:3].copy()
    matrix[:, 3] -= origin
    if image.depth is not None:
        matrix[:, :3] = matrix[:, :3] @ np.linalg.inv(image.intrinsics)
    count = int(np.prod(image.shape))
    kernel = device.kernel("build/range_samples.cl", constants={"DEPTH": int(image.depth is not None)})
    kernel((count,), (64,), count, image.shape[1], values, device.upload(matrix, np.float32), first, samples)


def _pitch(image: RangeImage) -> tuple[NDArray, int]:
    """Return the median distances of neighbours along rows and columns, world units, and the image's sign."""
    if image.depth is not None:
        middle = np.median(image.depth[image.valid]) if image.valid.any() else 0.0
        return _scale(image) * float(middle) / np.diag(image.intrinsics)[:2], -1
    points = image.points
    right, down = (np.diff(points, axis=axis) for axis in (1, 0))
    lengths = [lengths_of(d[np.isfinite(d[..., 2])]) for d in (right, down)]
    both = np.cross(right[:-1], down[:, :-1])
    eye = np.array([0, 0, 1.0]) if image.eye is None else image.eye - points[:-1, :-1]
    facing = np.einsum("hwi,hwi->hw", both, np.broadcast_to(eye, both.shape))
    facing = facing[np.isfinite(facing)]
    sign = -1 if (facing < 0).sum() > (facing > 0).sum() else 1
    return _scale(image) * np.array([float(np.median(n)) if len(n) else 0.0 for n in lengths]), sign


def _border(cells: NDArray, shapes: NDArray, first: NDArray) -> NDArray:
    """Return how many steps (n,) uint8 every sample is from one that is not inside its image's surface, up to 16."""
    out = np.zeros(len(cells), np.uint8)
    for k, (rows, columns) in enumerate(shapes):
        cell = cells[first[k]:first[k + 1]].reshape(rows, columns) > 0
        inside = np.zeros((rows, columns), bool)
        inside[1:, 1:] = cell[1:, 1:] & cell[:-1, 1:] & cell[1:, :-1] & cell[:-1, :-1]
        depth = ndimage.distance_transform_cdt(np.pad(inside, 1), metric="chessboard")[1:-1, 1:-1]
        out[first[k]:first[k + 1]] = np.minimum(depth, 16).ravel()
    return out


def _colors(scan: RangeScan) -> NDArray | None:
    """Return the colours (n, 4) uint8 of all samples, white in images without; None where no image has any."""
    if all(image.color is None for image in scan.images):
        return None
    white = [np.full((int(np.prod(image.shape)), 4), 255, np.uint8) if image.color is None else
             image.sample_colors().reshape(-1, 4) for image in scan.images]
    return np.concatenate(white)
