"""The levels of a SLIM surface: centres, fits and coverage level by level, and the surface that they make.

Source: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces with Applications to High Quality Rendering,
Feature Extraction, and Smoothing", SGP 2005, section 2.
"""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..device.arrays import DeviceArray
from ..surface.slim import COEFFICIENTS, SlimSurface, segment_end
from ..surface.srgb import premultiplied, straight
from .point_tree import BLOCK, FAR_POINT, PointTree, lane_form
from .project import leaf_tree, project_sorted
from .radius import Noise

GAMMA = 0.1  # overlap that every point must have (paper: 0.1)
OVERLAP_ONE = 1 << 20  # fixed point of the overlap sums (cover_points.cl)
COVERED = int(GAMMA * OVERLAP_ONE * 1.001) + 1  # overlap of a covered point
LEVELS = 25  # the last one's balls are 1e-6 of the diagonal, the rounding of the coordinates
ALL_LEVELS = range(1, LEVELS + 1)
CENTER = 2  # state of a chosen point (choose_centers.cl)
# Centres of a level's rounds stand so far apart, over r_r: the first round's balls hold or cover most points, the later
# ones fill the gaps between leaves. r_r throughout gave 5 % more leaves at the same error and three times the rounds.
SPACINGS = (1.0, 0.5, 0.4, 0.3, 0.2)
RECORD = 16  # floats a fitted surfel (fit_surfels.cl)
BOUND_SHARE = 0.999  # of the scan's points lie within `bound` of the surface
BOUND_SAMPLES = 1 << 16  # points that the bound is taken from
ROUNDING = 2.0**-22  # diagonals: positions of a model in float32, and of what is drawn
SEGMENT, FORCED, FIXED = 0, 1, 2  # modes of fit_surfels.cl


@dataclass
class Points:
    """The usable points of a scan, relative to its origin."""

    position: NDArray  # (n, 3) float32
    normals: NDArray  # (n, 3) float32
    colors: NDArray | None  # (n, 4) uint8
    weights: NDArray | None  # (n,) float32


@dataclass
class Level:
    """The surfels of one level, unit-diagonal units."""

    number: int  # 1 is the coarsest
    center: NDArray  # (m,) int32, index among the sorted points
    record: NDArray  # (m, RECORD) float32: radius, normal, e, leaf, coefficients


def build_levels(tree: PointTree, degree: int, penalty: float, noise: Noise, report,
                 fixed_radius: float | None = None, tolerance: float = math.inf, levels: range = ALL_LEVELS,
                 overlap: DeviceArray | None = None, away: NDArray | None = None) -> list[Level]:
    """Cover the points level by level until every point is covered by leaves.

    Parameters
    ----------
    penalty : float
        lambda T^2, over diagonal^4.
    report : callable
        report(stage, done).
    fixed_radius : float, optional
        One level of leaves of this radius (over the diagonal): for measuring orders of approximation.
    tolerance : float
        Over the diagonal: points that their leaf does not come so near stay uncovered, and get leaves of their own.
    levels : range
        Those to make; without the last one of all, points may stay uncovered.
    overlap : DeviceArray, optional
        (padded,) uint32, the coverage so far (cover_points.cl); the leaves' is added.
    away : (count,) float32, optional
        Of the sorted points: at least so far from those that must be covered, over the diagonal. Points that a level's
        balls do not reach from there are fitted to, but get no surfels of their own.
    """
    device = tree.device
    terms = (degree + 1) * (degree + 2) // 2
    need = min(2 * min(terms, COEFFICIENTS[2]) + 2, tree.count)  # fewer over-fit; cubics become quadratics before
    choose = device.kernel("build/choose_centers.cl")
    weighted = {"WEIGHTED": 1} if tree.weighted else {}
    fit = device.kernel("build/fit_surfels.cl", constants={"DEGREE": degree, **lane_form(device), **weighted})
    cover = device.kernel("build/cover_points.cl")
    mark_open = device.kernel("build/open_points.cl")
    blocks = tree.padded // BLOCK
    overlap = device.zeros(tree.padded, np.uint32) if overlap is None else overlap
    held = device.empty(tree.padded, np.uint8)
    state = device.empty(tree.padded, np.uint8)
    made = []
    for number in levels:
        r_r = fixed_radius or segment_end(number)
        mode = FIXED if fixed_radius else FORCED if number == LEVELS else SEGMENT
        device.fill(held, 0)
        if away is not None:
            leave_out(device, overlap, away > r_r)
        centers, records = [], []
        while True:
            mark_open((blocks,), (16,), tree.count, blocks, COVERED, overlap, held, state)
            open_points = np.flatnonzero(device.download(state, copy=False) == 0)
            if len(open_points) == 0:
                break
            spacing = r_r * SPACINGS[min(len(centers), len(SPACINGS) - 1)]
            first, end, colors = tree.cells(spacing * 1.001, open_points)
            first, end = device.upload(first), device.upload(end)
            for start, stop in itertools.pairwise(colors):
                choose((stop - start,), (1,), stop - start, start, first, end, spacing, *tree.arguments, state)
            chosen = np.flatnonzero(device.download(state, copy=False) == CENTER).astype(np.int32)
            center = device.upload(chosen)
            record = device.empty((len(chosen), RECORD), np.float32)
            fit((len(chosen),), (1,), len(chosen), center, r_r, noise.variance, penalty, noise.spacing, need, mode,
                tolerance, *tree.arguments, record)
            cover((len(chosen),), (1,), len(chosen), center, record, tolerance, COEFFICIENTS[degree],
                  *tree.arguments, overlap, held)
            centers.append(chosen)
            records.append(record)
        if not centers:
            break
        records = [device.download(r, copy=False) for r in records]
        made.append(Level(number, np.concatenate(centers), np.concatenate(records)))
        covered = np.count_nonzero(device.download(overlap, copy=False)[:tree.count] >= COVERED)
        report("levels", covered / tree.count)
    return made


def leave_out(device, overlap: DeviceArray, rows: NDArray) -> None:
    """Count sorted points (count,) bool as covered: no surfels are made for them."""
    if rows.any():
        values = device.download(overlap)
        values[:len(rows)][rows] = np.maximum(values[:len(rows)][rows], COVERED)
        device.write(overlap, values)


def link_levels(levels: list[Level], position: list[NDArray]) -> tuple[NDArray, NDArray]:
    """Return child_offset and children: the children of an internal surfel are the next level's centres in its ball."""
    first = np.concatenate([[0], np.cumsum([len(level.center) for level in levels])])
    offsets, children = [np.zeros(1, np.int64)], []
    for k, level in enumerate(levels):
        inner = np.flatnonzero(level.record[:, 5] == 0)
        count = np.zeros(len(level.center), np.int64)
        if k + 1 < len(levels) and len(inner):
            radius = float(level.record[inner[0], 0])
            pairs = cKDTree(position[k][inner]).sparse_distance_matrix(cKDTree(position[k + 1]), radius + 2e-7,
                                                                       output_type="ndarray")
            order = np.lexsort((pairs["j"], pairs["i"]))
            count[inner] = np.bincount(pairs["i"], minlength=len(inner))
            children.append(pairs["j"][order] + first[k + 1])
        offsets.append(count)
    child_offset = np.cumsum(np.concatenate(offsets))
    return child_offset.astype(np.int32), np.concatenate([np.zeros(0, np.int64), *children]).astype(np.int32)


def assemble(levels, points: Points, tree, degree, error, diagonal, origin) -> SlimSurface:
    """Return the surface in world units, its bound still unknown."""
    levels = levels or [Level(1, np.zeros(0, np.int32), np.zeros((0, RECORD), np.float32))]
    position = [points.position[tree.order[level.center]] for level in levels]
    child_offset, children = link_levels(levels, [p.astype(np.float64) / diagonal for p in position])
    center = np.concatenate([level.center for level in levels])
    record = np.concatenate([level.record for level in levels])
    order = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])  # of the monomials
    terms = COEFFICIENTS[degree]
    with np.errstate(over="ignore"):
        coefficients = (record[:, 6:6 + terms] * diagonal ** (1.0 - order[:terms])).astype(np.float32)
    coefficients[~np.isfinite(coefficients)] = 0  # a diagonal below 1e-19 bends more than float32 can say
    footprint = surfel_footprints(tree, center, record, terms)
    return SlimSurface(
        degree=degree, error=error, origin=origin, centers=np.concatenate(position),
        radii=record[:, 0] * diagonal, normals=record[:, 1:4], coefficients=coefficients,
        level=np.repeat([level.number for level in levels], [len(level.center) for level in levels]),
        leaf=record[:, 5] > 0, child_offset=child_offset, children=children, fit_error=record[:, 4] * diagonal,
        footprint=footprint if (footprint < 255).any() else None,
        colors=None if points.colors is None else surfel_colors(tree, center, record, points.colors),
        diagonal=diagonal)


def surfel_footprints(tree: PointTree, center: NDArray, record: NDArray, terms: int) -> NDArray:
    """Return the octagons (m, 8) uint8 around the leaves' own points; 255: not limited."""
    device = tree.device
    out = device.empty((len(center), 8), np.uint8)
    device.kernel("build/surfel_footprints.cl")((len(center),), (1,), len(center), device.upload(center),
                                                device.upload(record), terms, *tree.arguments, out)
    return device.download(out)


def surfel_colors(tree: PointTree, center: NDArray, record: NDArray, colors: NDArray) -> NDArray:
    """Return colours (m, 4) uint8 sRGB with straight alpha: weighted means in premultiplied linear light."""
    device = tree.device
    sorted_colors = np.zeros((4, tree.padded), np.float32)
    sorted_colors[:, :tree.count] = premultiplied(colors[tree.order]).T
    out = device.empty((len(center), 4), np.float32)
    device.kernel("build/surfel_colors.cl")((len(center),), (1,), len(center), device.upload(center),
                                            device.upload(record), device.upload(sorted_colors), *tree.arguments, out)
    return straight(device.download(out).astype(np.float64))


def with_bound(surface: SlimSurface, tree: PointTree, middle: NDArray) -> SlimSurface:
    """Return `surface` with the distances that BOUND_SHARE and all of an even sample of the scan's points keep."""
    device = tree.device
    blocks = tree.padded // BLOCK
    wanted = min(blocks, BOUND_SAMPLES // BLOCK)
    chosen = np.arange(wanted) * blocks // wanted
    host = device.download(tree.sorted, copy=False)[:3].reshape(3, blocks, BLOCK)
    queries = np.ascontiguousarray(host[:, chosen]).reshape(3, -1)
    real = queries[0] < FAR_POINT / 2
    queries[:, ~real] = queries[:, :1]
    leaves = leaf_tree(surface, device, middle.astype(np.float64))
    result = project_sorted(leaves, device.upload(queries), queries.shape[1], queries.shape[1])
    distance = np.abs(device.download(result, copy=False)[6, real])
    return replace(surface, bound=float(np.quantile(distance, BOUND_SHARE)) * surface.diagonal,
                   bound_share=BOUND_SHARE, bound_all=float(distance.max() + ROUNDING) * surface.diagonal)
