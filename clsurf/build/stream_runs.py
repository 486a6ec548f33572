"""A scan on disk as sorted runs: the points of one chunk each, by the Morton number of a fine cell.

A run is one file of records (`Records`), a file of the occupied fine cells with their counts, and every THINNED-th of
its records. The points of a region are then a few slices of every run, read with `pread`: mapped pages would count as
memory. Positions are float32 offsets from their fine cell's corner, so that a survey of any extent keeps its
millimetres.
"""

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..device.arrays import give_back
from ..io.chunks import Chunk, Source
from ..io.colors import as_rgba8
from ..io.files import write_array
from ..surface.arrays import box_of
from .morton import AXIS_BITS, morton, unmorton
from .neighbours import box_tree, sampled_covariance

FINE = 4.0  # width of a fine cell, point spacings
BLOCK_BITS = 5  # blocks of 32 fine cells across are looked through together
THINNED = 16  # every 16th point stands for the others at coarse levels: twice the spacing twice over
_SAMPLES = 20_000


@dataclass(frozen=True)
class Lattice:
    """Fine cells: cell (i, j, k) spans zero + width (i, j, k) to zero + width (i + 1, j + 1, k + 1).

    Attributes
    ----------
    zero : (float, float, float)
        World.
    width : float
    colors, color_kind, normals
        What a record holds: number of colour values, their dtype, and whether there are normals.
    """

    zero: tuple[float, float, float]
    width: float
    colors: int
    color_kind: str
    normals: bool

    @property
    def record(self) -> np.dtype:
        """What is kept of a point."""
        fields = [("offset", "<f4", (3,))]
        if self.colors:
            fields.append(("color", self.color_kind, (self.colors,)))
        if self.normals:
            fields.append(("normal", "<f4", (3,)))
        return np.dtype(fields)

    def write(self, path: Path) -> None:
        """Write this as JSON."""
        write_whole(path, json.dumps(asdict(self)).encode())

    @classmethod
    def read(cls, path: Path) -> "Lattice":
        """Read what `write` wrote."""
        values = json.loads(path.read_bytes())
        return cls(**{**values, "zero": tuple(values["zero"])})


def lattice_of(chunk: Chunk, device: Device) -> Lattice:
    """Return the lattice for a scan from its first chunk: fine cells of FINE of its point spacings."""
    low, high = box_of(chunk.points)
    middle = (low + high) / 2
    points = (chunk.points - middle).astype(np.float32)
    count = min(10, len(points))
    tree = box_tree(points, device)
    reach = float(np.median(sampled_covariance(tree, count, _SAMPLES).reach))
    extent = float((high - low).max())
    width = FINE * reach * np.sqrt(np.pi / (count + 0.5)) if reach > 0 else extent / 64
    width = max(width, extent / (1 << (AXIS_BITS - 4)), 1e-30)  # room for the rest of the scan around the first chunk
    width = 2.0 ** np.round(np.log2(width))  # exact in binary: positions relative to a cell's corner round once
    # The scan begins at a corner of the octree's large nodes: in their middle it would be cut through, and above all
    # thin layers (hills that reach over a horizontal cut) would become cells with more halo than points.
    corner = low - extent / 16
    zero = np.floor(corner / width) * width - width * (1 << (AXIS_BITS - 1))
    colors = chunk.colors
    return Lattice(tuple(map(float, zero)), float(width), 0 if colors is None else colors.shape[1],
                   "<f4" if colors is None else colors.dtype.newbyteorder("<").str, chunk.normals is not None)


def write_run(folder: Path, number: int, chunk: Chunk, lattice: Lattice) -> None:
    """Sort a chunk by fine cell and write it as run `number`; its last file appears when all of it is there."""
    points = chunk.points
    cell = np.empty((len(points), 3), np.int64)
    record = np.empty(len(points), lattice.record)
    for axis in range(3):
        place = (points[:, axis] - lattice.zero[axis]) / lattice.width
        cell[:, axis] = np.clip(np.floor(place), 0, (1 << AXIS_BITS) - 1)
        record["offset"][:, axis] = points[:, axis] - (lattice.zero[axis] + cell[:, axis] * lattice.width)
    most, whole = 0.0, True
    if lattice.colors:
        colors = chunk.colors if chunk.colors is not None else np.zeros((len(points), lattice.colors))
        record["color"] = colors[:, :lattice.colors]
        most = float(colors.max(initial=0))
        whole = colors.dtype.kind != "f" or bool((colors == np.floor(colors)).all())
    if lattice.normals:
        record["normal"] = chunk.normals
    keys = morton(cell)
    order = sorted_order(keys)
    keys, record = keys[order], record[order]
    cells, counts = runs_of(keys)
    write_whole(folder / f"{number:05d}.points", record)
    write_whole(folder / f"{number:05d}.thin", record[::THINNED])
    write_whole(folder / f"{number:05d}.thin_cells", keys[::THINNED])
    write_whole(folder / f"{number:05d}.json", json.dumps({"most": most, "whole": whole}).encode())
    write_whole(folder / f"{number:05d}.cells", np.stack([cells, counts.astype(np.uint64)]))


def runs_of(keys: NDArray) -> tuple[NDArray, NDArray]:
    """Return the distinct values of ascending `keys` and how often each stands there."""
    if not len(keys):
        return keys, np.zeros(0, np.int64)
    first = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    return keys[first], np.diff(first, append=len(keys))


def sorted_order(keys: NDArray) -> NDArray:
    """Return the stable order of `keys` (n,) uint64; where index and key fit in 64 bits, by one plain sort."""
    if not len(keys):
        return np.zeros(0, np.int64)
    low, bits = keys.min(), max(1, (len(keys) - 1).bit_length())
    if int(keys.max() - low) >> (64 - bits):
        return np.argsort(keys, kind="stable")
    packed = ((keys - low) << np.uint64(bits)) | np.arange(len(keys), dtype=np.uint64)
    packed.sort()
    return (packed & np.uint64((1 << bits) - 1)).astype(np.int64)


@dataclass(eq=False)
class Points:
    """Points from runs: float32 positions relative to `origin`, colours as sRGB bytes."""

    position: NDArray  # (n, 3) float32
    colors: NDArray | None  # (n, 4) uint8
    normals: NDArray | None  # (n, 3) float32
    origin: NDArray  # (3,) float64, world
    cell: NDArray  # (n,) place of each point's fine cell among those that were asked for


class Runs:
    """All runs of a folder, opened for reading.

    Attributes
    ----------
    cells : (m,) uint64
        Occupied fine cells, ascending.
    counts : (m,) int64
        Points in each.
    """

    def __init__(self, folder: Path, lattice: Lattice):
        self.folder, self.lattice = folder, lattice
        self.names = sorted(path.stem for path in folder.glob("*.cells"))
        each, self._starts, about = [], [], []
        for name in self.names:
            cells, counts = np.fromfile(folder / f"{name}.cells", np.uint64).reshape(2, -1)
            each.append(cells)
            self._starts.append(np.concatenate([[0], np.cumsum(counts)]).astype(np.int32))
            about.append(json.loads((folder / f"{name}.json").read_bytes()))
        self.most = max((one["most"] for one in about), default=0.0)
        self.whole = all(one["whole"] for one in about)
        every = np.concatenate([np.zeros(0, np.uint64), *each])
        every.sort()
        self.cells = runs_of(every)[0]
        del every
        self.counts = np.zeros(len(self.cells), np.int64)
        self._place = []  # of a run's cells among all
        for number, starts in enumerate(self._starts):
            place = np.searchsorted(self.cells, each[number])
            each[number] = None
            self.counts[place] += np.diff(starts)
            self._place.append(place.astype(np.int32))
        give_back()
        self._blocks, lengths = runs_of(self.cells >> np.uint64(3 * BLOCK_BITS))
        self._block_first = np.concatenate([[0], np.cumsum(lengths)])

    def inside(self, low: NDArray, high: NDArray) -> NDArray:
        """Return the ascending indices of the fine cells with coordinates (3,) from `low` to `high`, both included.

        Only blocks of cells that the box touches are looked at: a survey has millions of cells, and every part of it
        asks for its own surroundings.
        """
        block = unmorton(self._blocks)
        near = ((block >= low >> BLOCK_BITS) & (block <= high >> BLOCK_BITS)).all(axis=1)
        ranges = zip(self._block_first[:-1][near], self._block_first[1:][near], strict=True)
        found = np.concatenate([np.zeros(0, np.int64), *(np.arange(a, b) for a, b in ranges)])
        cell = unmorton(self.cells[found])
        return found[((cell >= low) & (cell <= high)).all(axis=1)]

    def fetch(self, wanted: NDArray, origin: NDArray) -> Points:
        """Return the points of the fine cells `wanted`, ascending indices of `cells`, run by run.

        Parameters
        ----------
        origin : (3,) float64
            World position that the points are to be relative to.
        """
        dtype = self.lattice.record
        record = np.empty(int(self.counts[wanted].sum()), dtype)
        owner = np.empty(len(record), np.int32)
        begin = np.flatnonzero(np.diff(wanted, prepend=-2) != 1)  # where ranges of consecutive cells begin
        low, high = wanted[begin], wanted[np.append(begin[1:], len(wanted)) - 1]
        at = 0
        for name, place, starts in zip(self.names, self._place, self._starts, strict=True):
            first, last = np.searchsorted(place, low), np.searchsorted(place, high, side="right")
            some = np.flatnonzero(first < last)
            if not len(some):
                continue
            rows = np.concatenate([np.arange(a, b) for a, b in zip(first[some], last[some], strict=True)])
            counts = starts[rows + 1] - starts[rows]
            owner[at:at + counts.sum()] = np.repeat(np.searchsorted(wanted, place[rows]), counts)
            first = np.flatnonzero(np.diff(rows, prepend=-2) != 1)
            last = np.append(first[1:], len(rows)) - 1
            with open(self.folder / f"{name}.points", "rb", buffering=0) as file:
                for begin, end in zip(starts[rows[first]].tolist(), starts[rows[last] + 1].tolist(), strict=True):
                    _read_into(file, record[at:at + end - begin], begin * dtype.itemsize)
                    at += end - begin
        return self._points(record, self.cells[wanted], owner, origin)

    def thin(self, step: int, origin: NDArray) -> Points:
        """Return every step-th of the thinned points."""
        every = lambda ending, dtype: np.concatenate([  # noqa: E731  copies: the rest of a file need not stay
            np.fromfile(self.folder / f"{name}.{ending}", dtype)[::step].copy() for name in self.names])
        record, keys = every("thin", self.lattice.record), every("thin_cells", np.uint64)
        cells, owner = np.unique(keys, return_inverse=True)
        return self._points(record, cells, owner.ravel(), origin)

    def _points(self, record, cells, owner, origin) -> Points:
        corner = unmorton(cells) * self.lattice.width + (np.array(self.lattice.zero) - origin)
        position = np.empty((len(record), 3), np.float32)
        for axis in range(3):
            position[:, axis] = corner[owner, axis] + record["offset"][:, axis]
        colors = self._rgba(record["color"]) if self.lattice.colors and self.most > 0 else None
        normals = np.ascontiguousarray(record["normal"]) if self.lattice.normals else None
        return Points(position, colors, normals, np.asarray(origin, np.float64), owner)

    def _rgba(self, values: NDArray) -> NDArray:
        """Return colours (n, 4) uint8; the largest value of the whole scan decides their scale."""
        if values.dtype.kind == "f" and self.whole:
            values = values.clip(0, 65535).astype(np.uint16)
        scale = np.full((1, values.shape[1]), self.most, values.dtype)
        return as_rgba8(np.concatenate([values, scale]))[:-1]


def _read_into(file, rows: NDArray, at: int) -> None:
    view = memoryview(rows).cast("B")
    while len(view):
        got = os.preadv(file.fileno(), [view], at)
        if got <= 0:
            raise OSError(f"{file.name}: shorter than expected")
        view, at = view[got:], at + got


def write_whole(path: Path, content) -> None:
    """Write bytes or an array so that the file appears whole or not at all."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(temporary, "wb") as file:
            if isinstance(content, np.ndarray):
                write_array(file, np.ascontiguousarray(content))
            else:
                file.write(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def chunk_written(folder: Path, number: int) -> bool:
    """Return whether run `number` is there."""
    return (folder / f"{number:05d}.cells").exists()


def make_run(folder: Path, number: int, source: Source, lattice: Lattice, chunk: Chunk | None = None) -> None:
    """Read chunk `number` and write it as a run, if that has not been done."""
    if not chunk_written(folder, number):
        write_run(folder, number, source.read(number) if chunk is None else chunk, lattice)
