"""LAS, LAZ and COPC point clouds through laspy."""

from pathlib import Path

import laspy
import numpy as np

from clsurf.errors import FileFormatError, InputError
from clsurf.surface.cloud import PointCloud

from .colors import as_rgba8

_KEPT = ("intensity", "classification")  # other dimensions are dropped: nothing here reads them
_SMALLEST_LAZ_POINT = 1 / 64  # bytes; laszip's chunks of equal points do not go below


def read_las(path: Path) -> PointCloud:
    """Read a LAS, LAZ or COPC file; intensity and classification are kept as attributes.

    Positions are offsets from an origin in the middle of the file's integer lattice, so that coordinates like
    637,291.00 keep their millimetres. Colours are scaled from 16 bits; 8-bit values in 16-bit fields are recognised.

    Raises
    ------
    FileFormatError
        A damaged or truncated file.
    """
    size = path.stat().st_size
    with laspy.open(path) as reader:
        header = reader.header
        width = header.point_format.size if not header.are_points_compressed else _SMALLEST_LAZ_POINT
        if header.point_count * width > size:
            raise FileFormatError(f"{path}: truncated: {header.point_count:,} points do not fit in {size:,} bytes")
        las = reader.read()
    if len(las.points) < header.point_count:
        raise FileFormatError(f"{path}: truncated: its header counts {header.point_count:,} points, got {len(las):,}")
    if not len(las):
        return PointCloud(np.zeros((0, 3), np.float32))
    points = np.empty((len(las), 3), np.float32)
    origin = np.empty(3)
    for axis, name in enumerate("XYZ"):
        lattice = np.asarray(las[name])
        middle = int(lattice.min()) // 2 + int(lattice.max()) // 2
        scale, offset = float(header.scales[axis]), float(header.offsets[axis])
        points[:, axis] = (lattice - np.int64(middle)) * scale
        origin[axis] = middle * scale + offset
    names = set(las.point_format.dimension_names)
    colors = normals = None
    if {"red", "green", "blue"} <= names:
        colors = np.stack([las.red, las.green, las.blue], axis=1)
        colors = as_rgba8(colors) if colors.any() else None  # all black: the format has colours, the scan has not
    for axes in (("NormalX", "NormalY", "NormalZ"), ("nx", "ny", "nz")):
        if set(axes) <= names:
            normals = np.stack([np.asarray(las[axis], np.float32) for axis in axes], axis=1)
    attributes = {n: np.ascontiguousarray(las[n]) for n in _KEPT if n in names and np.any(las[n])}
    return PointCloud(points, normals, colors, origin=origin, attributes=attributes)


def write_las(scan, path: Path) -> None:
    """Write positions, colours (16 bits), normals (extra dimensions), intensity and classification as LAS 1.4 or LAZ.

    The lattice step is a power of ten of at most 1e-8 of the extent, finer than the float32 offsets.
    """
    header = laspy.LasHeader(version="1.4", point_format=7 if scan.colors is not None else 6)
    points = scan.points.astype(np.float64)
    extent = max(float(np.abs(points).max()), 1e-30) if len(points) else 1.0
    header.scales = np.full(3, 10.0 ** np.floor(np.log10(extent * 1e-8)))
    header.offsets = scan.origin
    if scan.normals is not None:
        header.add_extra_dims([laspy.ExtraBytesParams(name=f"Normal{axis}", type=np.float32) for axis in "XYZ"])
    las = laspy.LasData(header)
    las.points = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    las.X, las.Y, las.Z = np.rint(points / header.scales).astype(np.int32).T
    if scan.colors is not None:
        las.red, las.green, las.blue = scan.colors[:, :3].astype(np.uint16).T * 257
    if scan.normals is not None:
        las.NormalX, las.NormalY, las.NormalZ = scan.normals.T
    if "intensity" in scan.attributes:
        las.intensity = _to_integers(scan.attributes["intensity"], 65535)
    if "classification" in scan.attributes:
        las.classification = _to_integers(scan.attributes["classification"], 255)
    with open(path, "wb") as file:
        las.write(file, do_compress=path.suffix.lower() == ".laz")


def _to_integers(values, largest: int):
    values = np.nan_to_num(np.asarray(values, np.float64))
    if values.min(initial=0) < 0 or values.max(initial=0) > largest:
        raise InputError(f"attributes: expected values from 0 to {largest} for a LAS field, got {values.min()} to "
                         f"{values.max()}")
    if largest == 65535 and 0 < values.max(initial=0) <= 1 and (values != np.floor(values)).any():
        values = values * largest  # shares of one
    return np.rint(values).astype(np.uint16)
