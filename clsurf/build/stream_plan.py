"""How a streamed scan is cut: octree ranges of fine cells of at most so many points, each with a halo around it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..device import Device
from ..surface.arrays import extent_of
from ..surface.slim import segment_end
from .morton import AXIS_BITS, unmorton
from .neighbours import box_tree
from .normals import suitable_k
from .point_tree import BLOCK, build_point_tree
from .radius import Noise, neighbour_spreads, noise_of, robust_box
from .slim_levels import LEVELS
from .stream_runs import THINNED, Runs

PIECES, PIECE_POINTS = 24, 1024  # places where noise and spacing are measured, and points of each
LARGEST = 16.0  # r_c: largest radius of a cell's surfels, point spacings (of 1/16 copies: 4 of the copy's)


@dataclass(frozen=True)
class Plan:
    """What all cells of a build agree on.

    Attributes
    ----------
    origin : (3,) float64
        World; of the surface.
    diagonal : float
        World units, outliers dropped.
    noise : Noise
    error : float
        T_MDL over the diagonal.
    thin : int
        The copy for the coarse levels has every thin-th point.
    first : int
        First level that the cells make; the copy makes those before.
    cuts : (c + 1,) int64
        Cell i holds the fine cells cuts[i] to cuts[i + 1].
    rings : int
        Fine cells of halo around a cell.
    neighbours : int
        k of the normals.
    """

    origin: NDArray
    diagonal: float
    noise: Noise
    error: float
    thin: int
    first: int
    cuts: NDArray
    rings: int
    neighbours: int

    @property
    def cells(self) -> int:
        """How many."""
        return len(self.cuts) - 1


def cut_cells(cells: NDArray, counts: NDArray, most: int) -> NDArray:
    """Return cuts (c + 1,) of ascending Morton numbers into octree ranges of at most `most` points.

    Ranges of the same node of the octree that together hold no more are joined. A single fine cell is never cut.
    """
    total = np.concatenate([[0], np.cumsum(counts)])

    def ranges(first: int, last: int, bits: int) -> list[int]:
        """Return the ends of the ranges between `first` and `last`, all within one node of 2^bits fine cells across."""
        if total[last] - total[first] <= most or last - first <= 1 or bits == 0:
            return [last]
        # Looked up, not compared: arrays of all cells at each of 21 depths were 370 MB of a scan of 50M points.
        node = int(cells[first]) >> 3 * bits
        after = np.array([8 * node + child + 1 << 3 * (bits - 1) for child in range(8)], np.uint64)
        ends = first + np.searchsorted(cells[first:last], after)
        out, start, joined = [], first, False
        for end in np.unique(ends[ends > first]).tolist():
            inner = ranges(start, end, bits - 1)
            held = total[end] - total[out[-2] if len(out) > 1 else first] if joined and out else 0
            if joined and len(inner) == 1 and held <= most:
                out[-1] = end  # a small sibling after a small one
            else:
                out += inner
            joined = len(inner) == 1
            start = end
        return out

    if not len(cells):
        return np.zeros(1, np.int64)
    return np.array([0, *ranges(0, len(cells), AXIS_BITS)], np.int64)


def halo_of(runs: Runs, first: int, last: int, rings: int) -> tuple[NDArray, NDArray]:
    """Return the ascending indices of the fine cells from first to last and of those at most `rings` cells away.

    The second array says how far: 0 for the cells themselves, 1 for those that touch one of them, and so on.
    """
    core = unmorton(runs.cells[first:last])
    candidates = runs.inside(core.min(axis=0) - rings, core.max(axis=0) + rings)
    outside = candidates[(candidates < first) | (candidates >= last)]
    away = np.zeros(0)
    if len(outside):
        away, _ = cKDTree(core).query(unmorton(runs.cells[outside]), p=np.inf, distance_upper_bound=rings + 0.5)
        outside, away = outside[np.isfinite(away)], away[np.isfinite(away)]
    before = int(np.searchsorted(outside, first))
    join = lambda array, own: np.concatenate([array[:before], own, array[before:]])  # noqa: E731
    return join(outside, np.arange(first, last)), join(away.astype(np.int32), np.zeros(last - first, np.int32))


def measure(runs: Runs, diagonal: float, device: Device) -> tuple[Noise, int]:
    """Return the scan's noise and spacing over the diagonal, and the k of its normals, from whole pieces of it."""
    total = np.concatenate([[0], np.cumsum(runs.counts)])
    step = max(1, int(total[-1]) // PIECES)
    spreads, furthest, k = [], [], []
    for piece in range(PIECES):
        begin = int(np.searchsorted(total, piece * step, side="right")) - 1
        end = min(len(runs.cells), max(begin + 1, int(np.searchsorted(total, piece * step + PIECE_POINTS))))
        if begin >= len(runs.cells):
            break
        wanted, away = halo_of(runs, begin, end, 1)
        origin = cell_middle(runs, begin, end)
        points = runs.fetch(wanted, origin)
        position, first = np.unique(points.position, axis=0, return_index=True)
        if len(position) < 4:
            continue
        core = (away == 0)[points.cell[first]]
        extent = float(np.linalg.norm(extent_of(position))) or 1.0
        tree = build_point_tree(position, np.zeros_like(position), np.zeros(3, np.float32), 1 / extent, device)
        spread, reach2 = neighbour_spreads(tree, np.arange(tree.padded // BLOCK, dtype=np.int32))
        own = np.zeros(tree.padded, bool)
        own[:tree.count] = core[tree.order]
        own &= spread.ravel() >= 0
        spreads.append(spread.ravel()[own] * (extent / diagonal) ** 2)
        furthest.append(reach2.ravel()[own] * (extent / diagonal) ** 2)
        k.append(suitable_k(box_tree(position, device)))
    if not spreads or not len(np.concatenate(spreads)):
        return Noise(0.0, 1.0), 16
    noise = noise_of(np.concatenate(spreads), np.concatenate(furthest), min(10, int(total[-1]) - 1))
    return noise, int(np.median(k) > 32) * 32 + 16


def cell_middle(runs: Runs, first: int, last: int) -> NDArray:
    """Return the world middle (3,) float64 of the box of fine cells."""
    core = unmorton(runs.cells[first:last])
    return np.array(runs.lattice.zero) + (core.min(axis=0) + core.max(axis=0) + 1) * (runs.lattice.width / 2)


def box_of(runs: Runs, step: int) -> tuple[NDArray, float]:
    """Return the middle (3,) of the scan's box without outliers, world, and its diagonal; `step`: see `Runs.thin`."""
    middle = cell_middle(runs, 0, len(runs.cells))
    box = robust_box(runs.thin(step, middle).position)
    return middle + box.mean(axis=0), float(np.linalg.norm(box[1] - box[0]))


def thinning(count: int, most: int) -> int:
    """Return the step of the copy for the coarse levels: 16, and twice as many while it holds more than `most`."""
    step = THINNED
    while count > most * step:
        step *= 2
    return step


def first_fine_level(spacing: float, thin: int) -> int:
    """Return the first level whose balls (r_r) are at most r_c; `spacing` over the diagonal."""
    largest = LARGEST * math.sqrt(thin / THINNED) * spacing
    return next((level for level in range(1, LEVELS) if segment_end(level) <= largest), LEVELS)
