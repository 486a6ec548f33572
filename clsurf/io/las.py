"""LAS, LAZ and COPC point clouds through laspy."""

import contextlib
import struct
from pathlib import Path

import laspy
import lazrs
import numpy as np
from numpy.typing import NDArray

from clsurf.errors import FileFormatError, InputError
from clsurf.surface.cloud import PointCloud

from ..surface.arrays import box_of
from .colors import as_rgba8
from .files import one_line

_KEPT = ("intensity", "classification")  # other dimensions are dropped: nothing here reads them
_SMALLEST_LAZ_POINT = 1 / 64  # bytes; laszip's chunks of equal points do not go below
_SMALLEST_CHUNK = 20  # bytes; a chunk starts with a point as it is
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of point, colour, colour + infrared, wave packet; 14, bytes: one for each
_LARGEST_CHUNK = 1 << 28  # bytes: the parallel decoder takes them at once, and where it can't ends the process
_BLOCK = 2_000_000  # points decoded at once: autzen's 10.7 million peak at 0.6 GB instead of 1.1


def read_las(path: Path) -> PointCloud:
    """Read a LAS, LAZ or COPC file; intensity and classification are kept as attributes.

    Positions are offsets from an origin in the middle of the file's integer lattice, so that coordinates like
    637,291.00 keep their millimetres. Colours are scaled from 16 bits; 8-bit values in 16-bit fields are recognised.

    Raises
    ------
    FileFormatError
        A damaged or truncated file.
    """
    with opened(path) as reader:
        header = reader.header
        if not header.point_count:
            return PointCloud(np.zeros((0, 3), np.float32))
        blocks, first = [], 0
        for block in reader.chunk_iterator(_BLOCK):
            if not first:
                names = set(block.point_format.dimension_names)
                middle = _middle(header, block)
            blocks.append(_columns(block, names, middle, header.scales))
            first += len(block)
    if first < header.point_count:
        raise FileFormatError(f"{path}: truncated: its header counts {header.point_count:,} points, got {first:,}")
    columns = {}
    for name in list(blocks[0]):
        columns[name] = np.concatenate([block.pop(name) for block in blocks])
    points, colors, normals = (columns.pop(name, None) for name in ("points", "colors", "normals"))
    colors = as_rgba8(colors) if colors is not None and colors.any() else None  # all black: the scan has none
    attributes = {name: value for name, value in columns.items() if value.any()}
    return PointCloud(points, normals, colors, origin=middle * header.scales + header.offsets, attributes=attributes)


def checked_backend(path: Path) -> laspy.LazBackend:
    """Return the decoder for a file whose counts the file has room for; raises FileFormatError."""
    _check_records(path)
    with _told(path), laspy.open(path) as reader:
        largest = _check_counts(path, reader.header)
    return laspy.LazBackend.LazrsParallel if largest <= _LARGEST_CHUNK else laspy.LazBackend.Lazrs


@contextlib.contextmanager
def opened(path: Path, backend: laspy.LazBackend | None = None):
    """Yield laspy's reader of a file; `backend`: what `checked_backend` returned for it before.

    Raises
    ------
    FileFormatError
        A damaged or truncated file, also where the decoder fails meanwhile.
    """
    backend = checked_backend(path) if backend is None else backend
    with _told(path), laspy.open(path, laz_backend=backend) as reader:
        yield reader


@contextlib.contextmanager
def _told(path: Path):
    """Turn the decoder's failure into FileFormatError."""
    try:
        yield
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # how the decoder's Rust code fails; not an Exception
            raise
        raise FileFormatError(f"{path}: damaged: {one_line(error)}") from None


def _columns(block, names: set[str], middle: NDArray, scales: NDArray) -> dict[str, NDArray]:
    """Return what is kept of a block of points; positions are float32 offsets from the lattice point `middle`."""
    out = {"points": np.empty((len(block), 3), np.float32)}
    for axis, name in enumerate("XYZ"):
        out["points"][:, axis] = (np.asarray(block[name]) - middle[axis]) * float(scales[axis])
    if {"red", "green", "blue"} <= names:
        out["colors"] = np.stack([block.red, block.green, block.blue], axis=1)
    for axes in (("NormalX", "NormalY", "NormalZ"), ("nx", "ny", "nz")):
        if set(axes) <= names:
            out["normals"] = np.stack([np.asarray(block[axis], np.float32) for axis in axes], axis=1)
    return out | {name: np.ascontiguousarray(block[name]) for name in _KEPT if name in names}


def _middle(header, block) -> NDArray:
    """Return the middle (3,) int64 of the integer lattice, from the header's box or, where that is wrong, a block."""
    lattice = np.stack([np.asarray(block[name], np.int64) for name in "XYZ"], axis=1)
    low, high = box_of(lattice)
    with np.errstate(all="ignore"):
        middle = ((np.asarray(header.mins) + header.maxs) / 2 - header.offsets) / header.scales
    near = np.isfinite(middle).all() and (np.abs(middle) < 2**31).all()
    near = near and (np.abs(middle - (low + high) / 2) <= 1e3 * (high - low + 1)).all()
    return np.rint(middle).astype(np.int64) if near else (low + high) // 2


def _check_records(path: Path) -> None:
    """Refuse a header with more variable-length records than the file has room for: laspy would read on for hours.

    Offsets are those of the LAS 1.4 specification, table 3.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(375)
    if head[:4] != b"LASF" or len(head) < 227:
        raise FileFormatError(f"{path}: expected a LAS file (it starts with LASF), got {head[:8]!r}, {size:,} bytes")
    header_size, points_at, records = struct.unpack("<HII", head[94:104])
    extended_at, extended = struct.unpack("<QI", head[235:247]) if head[25] >= 4 and len(head) >= 247 else (0, 0)
    if header_size + 54 * records > points_at or points_at > size:
        raise FileFormatError(f"{path}: damaged or truncated: {records:,} records before the points at byte "
                              f"{points_at:,} of {size:,}")
    if extended and extended_at + 60 * extended > size:
        raise FileFormatError(f"{path}: damaged or truncated: {extended:,} records after the points do not fit in "
                              f"{size:,} bytes")


def _check_counts(path: Path, header) -> int:
    """Refuse counts that the file is too short for: the decoder takes memory for them and ends the process.

    Returns the bytes of the largest chunk when decoded, by the file's own word.
    """
    size = path.stat().st_size
    width = _SMALLEST_LAZ_POINT if header.are_points_compressed else header.point_format.size
    if header.point_count * width > size:
        raise FileFormatError(f"{path}: truncated: {header.point_count:,} points do not fit in {size:,} bytes")
    if not header.are_points_compressed:
        return 0
    with open(path, "rb") as file:
        file.seek(header.offset_to_point_data)
        at = int.from_bytes(file.read(8), "little", signed=True)
        if at == -1:  # written as a stream: the place of the table is at the end
            file.seek(size - 8)
            at = int.from_bytes(file.read(8), "little", signed=True)
        if not header.offset_to_point_data <= at <= size - 8:
            raise FileFormatError(f"{path}: truncated: its chunk table should be at byte {at:,} of {size:,}")
        file.seek(at + 4)
        chunks = int.from_bytes(file.read(4), "little")
    if chunks * _SMALLEST_CHUNK > size:
        raise FileFormatError(f"{path}: damaged: {chunks:,} chunks of points do not fit in {size:,} bytes")
    return _check_chunks(path, header, size)


def _check_chunks(path: Path, header, size: int) -> int:
    """Refuse chunks, and layers within them (point formats 6 to 10), whose lengths add up to more than the file.

    Returns the bytes of the largest chunk when decoded; the last one may say more points than are left for it.
    """
    record = next(vlr for vlr in header.vlrs if vlr.record_id == 22204).record_data_bytes()
    compressor, items = struct.unpack("<H", record[:2])[0], struct.unpack("<H", record[32:34])[0]
    kinds = [struct.unpack("<HH", record[34 + 6 * i:38 + 6 * i]) for i in range(items)]
    layers = sum(width if kind == 14 else _LAYERS.get(kind, 0) for kind, width in kinds) if compressor == 3 else 0
    width, at = sum(width for _, width in kinds), header.offset_to_point_data
    with open(path, "rb") as file:
        file.seek(at)
        table = lazrs.read_chunk_table(file, lazrs.LazVlr(record)) or []
        at += 8
        if at + sum(length for _, length in table) > size or sum(points for points, _ in table) < header.point_count:
            raise FileFormatError(f"{path}: truncated: its {len(table):,} chunks do not hold the "
                                  f"{header.point_count:,} points of its header in {size:,} bytes")
        for _, length in table if layers else ():
            file.seek(at + width)
            sizes = np.frombuffer(file.read(4 * layers + 4), "<u4")[1:]
            if len(sizes) < layers or int(sizes.sum(dtype=np.int64)) > length:
                raise FileFormatError(f"{path}: damaged: a chunk of {length:,} bytes has layers of "
                                      f"{int(sizes.sum(dtype=np.int64)):,} bytes")
            at += length
    return width * max((points for points, _ in table), default=0)


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
        try:
            las.write(file, do_compress=path.suffix.lower() == ".laz")
        except lazrs.LazrsError as error:  # a full disk, in the words of the compressor
            raise OSError(None, str(error)) from None


def _to_integers(values, largest: int) -> NDArray:
    values = np.nan_to_num(np.asarray(values, np.float64))
    if values.min(initial=0) < 0 or values.max(initial=0) > largest:
        raise InputError(f"attributes: expected values from 0 to {largest} for a LAS field, got {values.min()} to "
                         f"{values.max()}")
    if largest == 65535 and 0 < values.max(initial=0) <= 1 and (values != np.floor(values)).any():
        values = values * largest  # shares of one
    return np.rint(values).astype(np.uint16)
