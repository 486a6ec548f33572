"""Sparse low-degree implicits from scattered points (SLIM).

Source: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces with Applications to High Quality Rendering,
Feature Extraction, and Smoothing", SGP 2005, section 2.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from ..device import open_device
from ..errors import Cancelled, InputError
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.slim import COEFFICIENTS, SlimSurface
from .point_tree import BLOCK, PointTree, build_point_tree
from .radius import LEAST_PENALTY, noise_lambda, robust_box, segment_end

GAMMA = 0.1  # overlap that every point must have (paper: 0.1)
OVERLAP_ONE = 1 << 20  # fixed point of the overlap sums (cover_points.cl)
LEVELS = 25  # the last one's balls are 1e-6 of the diagonal, the rounding of the coordinates
CENTER = 2  # state of a chosen point (choose_centers.cl)
# Centres of a level's first round stand r_r apart; those that fill the gaps between leaves r_r / 2: 5 % fewer leaves
# than with r_r throughout, at the same error, in a third of the rounds.
NEXT_SPACING = 0.5
RECORD = 16  # floats a fitted surfel (fit_surfels.cl)
SEGMENT, FORCED, FIXED = 0, 1, 2  # modes of fit_surfels.cl


def build_slim(scan, degree=2, error=0.01, weight=None, memory_limit=None, progress=None, device=None) -> SlimSurface:
    """Build a multi-scale SLIM surface from a scan.

    Parameters
    ----------
    scan : Mesh or PointCloud
        Normals are taken from the scan, computed from the faces, or estimated, in this order.
    degree : int
        Of the local polynomials: 1, 2 or 3.
    error : float
        T_MDL, the trade-off between accuracy and sparseness, relative to the bounding-box diagonal.
    device : None, str or Device

    Returns
    -------
    SlimSurface

    Raises
    ------
    InputError
        An empty scan, or a degree or error out of range.
    Cancelled
        `progress` raised the wish to stop by returning False.
    """
    if degree not in COEFFICIENTS:
        raise InputError(f"degree: expected 1, 2 or 3, got {degree!r}")
    device = open_device(device)
    points, normals, _ = usable_points(scan, device)
    box = robust_box(points)
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    if diagonal == 0:
        diagonal = 1.0
    middle = box.mean(axis=0).astype(np.float32)
    tree = build_point_tree(points, normals, middle, 1.0 / diagonal, device)
    penalty = max(noise_lambda(tree) * error**2, LEAST_PENALTY)
    levels = build_levels(tree, degree, penalty, progress)
    return assemble(levels, points, tree, degree, error, diagonal, scan)


def usable_points(scan, device) -> tuple[NDArray, NDArray, NDArray | None]:
    """Return positions and normals (n, 3) float32 of the scan's usable points, and their colours or None."""
    if not isinstance(scan, Mesh | PointCloud):
        raise InputError(f"scan: expected a Mesh or a PointCloud, got {type(scan).__name__}")
    points = scan.points
    if scan.normals is not None:
        normals = scan.normals
    elif isinstance(scan, Mesh) and len(scan.faces):
        normals = face_normals(points, scan.faces)
    else:
        from .normals import estimate_normals
        scan = estimate_normals(PointCloud(points, origin=scan.origin, colors=scan.colors), device=device)
        points, normals = scan.points, scan.normals
    usable = np.isfinite(points).all(axis=1) & ((normals * normals).sum(axis=1) > 0)
    colors = scan.colors
    if not usable.all():
        points, normals = points[usable], normals[usable]
        colors = None if colors is None else colors[usable]
    if len(points) == 0:
        raise InputError("scan: expected at least one point with a normal, got none")
    return points, normals, colors


def face_normals(points: NDArray, faces: NDArray) -> NDArray:
    """Return vertex normals (n, 3) float32: area-weighted means over the faces, 0 for unused vertices."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    scale = np.abs(cross).max()
    cross = (cross / (scale if scale > 0 else 1)).astype(np.float32)
    rows = sparse.csr_matrix((np.ones(faces.size, np.float32), faces.ravel(), np.arange(0, faces.size + 1, 3)),
                             shape=(len(faces), len(points)))
    normals = rows.T @ cross
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)


@dataclass
class Level:
    """The surfels of one level, unit-diagonal units."""

    center: NDArray  # (m,) int32, index among the sorted points
    record: NDArray  # (m, RECORD) float32: radius, normal, e, leaf, coefficients


def build_levels(tree: PointTree, degree: int, penalty: float, progress=None, fixed_radius: float | None = None
                 ) -> list[Level]:
    """Cover the points level by level until every point is covered by leaves.

    Parameters
    ----------
    penalty : float
        lambda T^2, over diagonal^4.
    fixed_radius : float, optional
        One level of leaves of this radius (over the diagonal): for measuring orders of approximation.
    """
    device = tree.device
    terms = (degree + 1) * (degree + 2) // 2
    need = min(2 * terms + 2, tree.count)
    choose = device.kernel("build/choose_centers.cl")
    fit = device.kernel("build/fit_surfels.cl", constants={"DEGREE": degree})
    cover = device.kernel("build/cover_points.cl")
    mark_open = device.kernel("build/open_points.cl")
    blocks = tree.padded // BLOCK
    overlap, held = device.zeros(tree.padded, np.uint32), device.empty(tree.padded, np.uint8)
    state, blocks_open = device.empty(tree.padded, np.uint8), device.empty(blocks, np.uint8)
    threshold = int(GAMMA * OVERLAP_ONE * 1.001) + 1
    levels = []
    for number in range(1, LEVELS + 1):
        r_r = fixed_radius or segment_end(number)
        mode = FIXED if fixed_radius else FORCED if number == LEVELS else SEGMENT
        device.fill(held, 0)
        centers, records = [], []
        while True:
            mark_open((blocks,), (64,), tree.count, blocks, threshold, overlap, held, state, blocks_open)
            spacing = r_r * (NEXT_SPACING if centers else 1.0)
            for start, end in tree.cells(spacing * 1.001):
                choose((len(start),), (1,), len(start), start, end, spacing, *tree.arguments, blocks_open, state)
            chosen = np.flatnonzero(device.download(state, copy=False) == CENTER).astype(np.int32)
            if len(chosen) == 0:
                break
            center = device.upload(chosen)
            record = device.empty((len(chosen), RECORD), np.float32)
            fit((len(chosen),), (1,), len(chosen), center, r_r, penalty, need, mode, *tree.arguments, record)
            cover((len(chosen),), (1,), len(chosen), center, record, *tree.arguments, overlap, held)
            centers.append(chosen)
            records.append(record)
        if not centers:
            break
        levels.append(Level(np.concatenate(centers), np.concatenate([device.download(r, copy=False) for r in records])))
        if progress is not None:
            covered = np.count_nonzero(device.download(overlap, copy=False)[:tree.count] >= threshold) / tree.count
            if progress("build", covered) is False:
                raise Cancelled("build_slim: stopped by the progress callback")
    return levels


def link_levels(levels: list[Level], position: list[NDArray]) -> tuple[NDArray, NDArray]:
    """Return child_offset and children: the children of an internal surfel are the next level's centres in its ball."""
    first = np.concatenate([[0], np.cumsum([len(level.center) for level in levels])])
    offsets, children = [np.zeros(1, np.int64)], []
    for k, level in enumerate(levels):
        inner = np.flatnonzero(level.record[:, 5] == 0)
        count = np.zeros(len(level.center), np.int64)
        if k + 1 < len(levels) and len(inner):
            radius = float(level.record[inner[0], 0])
            pairs = cKDTree(position[k][inner]).sparse_distance_matrix(cKDTree(position[k + 1]), radius * (1 + 1e-6),
                                                                       output_type="ndarray")
            order = np.lexsort((pairs["j"], pairs["i"]))
            count[inner] = np.bincount(pairs["i"], minlength=len(inner))
            children.append(pairs["j"][order] + first[k + 1])
        offsets.append(count)
    child_offset = np.cumsum(np.concatenate(offsets))
    return child_offset.astype(np.int32), np.concatenate([np.zeros(0, np.int64), *children]).astype(np.int32)


def assemble(levels, points, tree, degree, error, diagonal, scan) -> SlimSurface:
    """Return the surface in world units."""
    position = [points[tree.order[level.center]] for level in levels]
    scaled = [p.astype(np.float64) / diagonal for p in position]
    child_offset, children = link_levels(levels, scaled)
    record = np.concatenate([level.record for level in levels])
    order = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])  # of the monomials
    terms = COEFFICIENTS[degree]
    return SlimSurface(
        degree=degree, error=error, origin=scan.origin, centers=np.concatenate(position),
        radii=record[:, 0] * diagonal, normals=record[:, 1:4],
        coefficients=record[:, 6:6 + terms] * diagonal ** (1.0 - order[:terms]),
        level=np.repeat(np.arange(1, len(levels) + 1), [len(level.center) for level in levels]),
        leaf=record[:, 5] > 0, child_offset=child_offset, children=children, fit_error=record[:, 4] * diagonal,
        diagonal=diagonal)
