"""Scans read in chunks, for builds that never hold them whole: LAS, LAZ, COPC, PLY and text.

A chunk is a fixed part of the file, so that chunks can be read in any order, by several machines, and again.
"""

import mmap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import Error, FileFormatError, InputError

from ..surface.arrays import finite_rows
from .files import existing_file, one_line

STREAMED = (".las", ".laz", ".ply", ".xyz", ".txt", ".asc", ".pts", ".csv")
AIRBORNE = {"classification", "return_number", "number_of_returns", "scan_angle", "scan_angle_rank"}
_HEAD = 1 << 20  # bytes of a text file that say what its columns are
_BYTES_PER_POINT = 24  # of text, at least: chunks of text have as many bytes as this many for each point


@dataclass
class Chunk:
    """A part of a scan.

    Attributes
    ----------
    points : (n, 3) float64
        World positions, finite.
    colors : (n, 3 or 4) or None
        As the file has them; their scale is decided over the whole file.
    normals : (n, 3) float32 or None
    """

    points: NDArray
    colors: NDArray | None
    normals: NDArray | None


class Source:
    """A scan's file and its chunks.

    Attributes
    ----------
    path : Path
    chunks : int
        How many; `read(i)` gives one.
    count : int or None
        Points, where the file says so.
    airborne : bool
        Whether the file is one of airborne lidar by its attributes.
    faces : bool
        Whether it is a mesh, of which the chunks are the vertices only.
    """

    def __init__(self, path: Path, chunk_points: int):
        self.path, self.chunk_points, self.count = path, chunk_points, None
        self.airborne = self.faces = False

    def read(self, number: int) -> Chunk:
        """Return one chunk; raises FileFormatError where the file is damaged."""
        try:
            chunk = self._read(number)
        except Error:
            raise
        except BaseException as error:
            if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
                raise
            raise FileFormatError(f"{self.path}: damaged: {one_line(error)}") from None
        keep = finite_rows(chunk.points)
        if chunk.normals is not None:
            with np.errstate(over="ignore", invalid="ignore"):
                length2 = np.einsum("ij,ij->i", chunk.normals, chunk.normals)
            keep &= np.isfinite(length2) & (length2 > 0)
        if keep.all():
            return chunk
        take = lambda array: None if array is None else array[keep]  # noqa: E731
        return Chunk(chunk.points[keep], take(chunk.colors), take(chunk.normals))

    def _read(self, number: int) -> Chunk:
        raise InputError(f"{self.path}: cannot be read in chunks")


def open_source(path, chunk_points: int = 2_000_000) -> Source:
    """Return the chunks of a scan's file.

    Raises
    ------
    InputError
        No such file, or one of a format that is only read whole.
    FileFormatError
        A damaged file.
    """
    ending = Path(path).suffix.lower()
    if ending not in STREAMED:
        raise InputError(f"{path}: expected a scan that can be read in parts ({' '.join(STREAMED)}), got "
                         f"{ending or '(no ending)'}: convert it first (clsurf convert), or leave out the memory limit")
    path = existing_file(path)
    kind = _Las if ending in (".las", ".laz") else _Ply if ending == ".ply" else _Text
    try:
        return kind(path, chunk_points)
    except Error:
        raise
    except Exception as error:
        raise FileFormatError(f"{path}: damaged or not a {ending} file: {one_line(error)}") from error


class CloudSource(Source):
    """Points in memory, for builds that a device holds only in parts.

    Parameters
    ----------
    points, normals : (n, 3) float32
    colors : (n, 4) uint8 or None
    origin : (3,) float64
    """

    def __init__(self, points: NDArray, normals: NDArray, colors: NDArray | None, origin: NDArray, chunk_points: int):
        super().__init__(Path("scan"), chunk_points)
        self._arrays, self._origin, self.count = (points, colors, normals), origin, len(points)
        self.chunks = -(-self.count // chunk_points)

    def _read(self, number: int) -> Chunk:
        rows = slice(number * self.chunk_points, (number + 1) * self.chunk_points)
        points, colors, normals = (None if array is None else array[rows] for array in self._arrays)
        return Chunk(points + self._origin, colors, normals)


class _Las(Source):
    def __init__(self, path: Path, chunk_points: int):
        super().__init__(path, chunk_points)
        from .las import checked_backend, opened
        self._backend = checked_backend(path)  # its checks look at every chunk: once a file
        with opened(path, self._backend) as reader:
            self.count = reader.header.point_count
            self._names = set(reader.header.point_format.dimension_names)
        self.chunks = -(-self.count // chunk_points)
        self.airborne = bool(AIRBORNE & self._names)

    def _read(self, number: int) -> Chunk:
        from .las import opened
        with opened(self.path, self._backend) as reader:
            reader.seek(number * self.chunk_points)
            wanted = min(self.chunk_points, self.count - number * self.chunk_points)
            block = reader.read_points(wanted)
            if len(block) < wanted:
                raise FileFormatError(f"{self.path}: truncated: its header counts {self.count:,} points, got "
                                      f"{number * self.chunk_points + len(block):,}")
            header, names = reader.header, self._names
            points = np.empty((len(block), 3))
            for axis, name in enumerate("XYZ"):
                points[:, axis] = block[name]
                points[:, axis] *= header.scales[axis]
                points[:, axis] += header.offsets[axis]
            colors = normals = None
            if {"red", "green", "blue"} <= names:
                colors = np.stack([block.red, block.green, block.blue], axis=1)
            for axes in (("NormalX", "NormalY", "NormalZ"), ("nx", "ny", "nz")):
                if set(axes) <= names:
                    normals = np.stack([np.asarray(block[axis], np.float32) for axis in axes], axis=1)
            return Chunk(points, colors, normals)


class _Ply(Source):
    def __init__(self, path: Path, chunk_points: int):
        super().__init__(path, chunk_points)
        from .ply import _check_room, _read_header
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            self._order, elements, self._start = _read_header(path, data)
            size = len(data)
        before = []
        for element in elements:
            if element.name == "vertex":
                break
            before.append(element)
        else:
            raise FileFormatError(f"{path}: expected an element vertex, got none")
        if any(p.count_kind for e in (*before, element) for p in e.properties) or (before and self._order is None):
            raise InputError(f"{path}: expected a PLY file that starts with its vertices, got lists before them: "
                             "convert it first (clsurf convert)")
        self._properties = element.properties
        self.count = element.count
        self.faces = any(e.count for e in elements if e.name in ("face", "tristrips"))
        self._alone = not any(e.count and e.properties for e in elements[len(before) + 1:])
        if self._order is not None:
            self._dtype = np.dtype([(p.name, self._order + p.kind) for p in element.properties])
            self._start += sum(e.count * sum(np.dtype(p.kind).itemsize for p in e.properties) for e in before)
            _check_room(path, element, self._dtype.itemsize * self.count, size - self._start)
            self.chunks = -(-self.count // chunk_points)
        else:
            self._dtype = None
            self._bytes = chunk_points * _BYTES_PER_POINT
            self.chunks = -(-(size - self._start) // self._bytes)

    def _read(self, number: int) -> Chunk:
        from .ply import _scan_of
        if self._dtype is None:
            columns = self._rows(number)
        else:
            first = number * self.chunk_points
            rows = np.fromfile(self.path, self._dtype, min(self.chunk_points, self.count - first),
                               offset=self._start + first * self._dtype.itemsize)
            columns = {p.name: rows[p.name] for p in self._properties}
        return _as_chunk(_scan_of(self.path, columns, None), columns)

    def _rows(self, number: int) -> dict[str, NDArray]:
        """Return the vertices of a part of an ascii file: lines with a number for each of their properties."""
        from .rows import numbers_in
        text, names = _lines_of(self.path, self._start, number, self._bytes), [p.name for p in self._properties]
        wide = len(names)
        lines = text.splitlines()
        if not self._alone:  # faces follow: where the vertices end is known from counting all lines before
            lines = lines[:max(0, self.count - _lines_before(self.path, self._start, number, self._bytes))]
        values = numbers_in(b"\n".join(lines))
        if len(values) != wide * len(lines):
            raise FileFormatError(f"{self.path}: expected {wide} numbers in each of {len(lines):,} lines, got "
                                  f"{len(values):,} numbers")
        return dict(zip(names, values.reshape(-1, wide).T, strict=True))


class _Text(Source):
    def __init__(self, path: Path, chunk_points: int):
        super().__init__(path, chunk_points)
        from .columns import _guess, _look, _parse
        size = path.stat().st_size
        with open(path, "rb") as file:
            head = file.read(_HEAD)
        if head[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in head[:1 << 16]:
            raise FileFormatError(f"{path}: expected text in ASCII or UTF-8 to read it in parts, got other bytes")
        if size > _HEAD:
            head = head[:head.rfind(b"\n") + 1]
        self._start, self._separator, names, count = _look(path, head)
        self.count, self._counted = count, count is not None
        body = head[self._start:]
        self._commas = self._separator == ";" and b"," in body
        table = _parse(path, body.replace(b",", b".") if self._commas else body, self._separator, names, self._counted)
        self._names = names if names is not None else _guess(table)
        self._bytes = chunk_points * _BYTES_PER_POINT
        self.chunks = -(-(size - self._start) // self._bytes)

    def _read(self, number: int) -> Chunk:
        from .columns import _parse, cloud_of_table
        text = _lines_of(self.path, self._start, number, self._bytes)
        if not text.strip():
            return Chunk(np.zeros((0, 3)), None, None)
        if self._commas:
            text = text.replace(b",", b".")
        table = _parse(self.path, text, self._separator, self._names, self._counted)
        columns = _named(table, self._names)
        return _as_chunk(cloud_of_table(self.path, table, self._names), columns)


def _lines_of(path: Path, start: int, number: int, size: int) -> bytes:
    """Return the lines that begin in part `number`, of `size` bytes each, of what follows byte `start`."""
    with open(path, "rb") as file:
        at = start + number * size
        if number:
            file.seek(at - 1)
            if file.read(1) != b"\n":
                file.readline()
        else:
            file.seek(at)
        begin = file.tell()
        end = start + (number + 1) * size
        if begin >= end:
            return b""
        text = file.read(end - begin)
        return text if text.endswith(b"\n") else text + file.readline()


def _lines_before(path: Path, start: int, number: int, size: int) -> int:
    """Return the number of lines before the ones of part `number`."""
    return sum(_lines_of(path, start, k, size).count(b"\n") for k in range(number))


def _named(table: NDArray, names) -> dict[str, NDArray]:
    from .columns import _NAMES, _plain
    return {_NAMES.get(_plain(name), name): column for name, column in zip(names, table.T, strict=False) if name}


def _as_chunk(cloud, columns: dict[str, NDArray]) -> Chunk:
    """Return a cloud as a chunk, with the colours as the file has them: a part of it does not tell their scale."""
    from .ply import _COLORS
    colors = None
    if cloud.colors is not None:
        names = next(names for names in (*_COLORS, ("red", "green", "blue")) if all(n in columns for n in names))
        alpha = next((n for n in ("alpha", "a") if n in columns), None)
        raw = [np.asarray(columns[n]) for n in (*names, *([alpha] if alpha else []))]
        if raw[0].dtype.kind == "f":
            raw = [np.nan_to_num(c).astype(np.float32) for c in raw]
        colors = np.stack(raw, axis=1)
    return Chunk(cloud.points.astype(np.float64) + cloud.origin, colors, cloud.normals)
