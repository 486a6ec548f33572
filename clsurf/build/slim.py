"""Sparse low-degree implicits from scattered points (SLIM).

Source: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces with Applications to High Quality Rendering,
Feature Extraction, and Smoothing", SGP 2005, section 2.
"""

import itertools
import os
import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from ..device import open_device
from ..errors import Cancelled, DeviceMemoryError, InputError
from ..io import load
from ..io.cleaning import first_of_duplicates
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.ranges import RangeScan
from ..surface.slim import COEFFICIENTS, SlimSurface
from ..surface.srgb import premultiplied, straight
from .large_faces import large_faces, with_middles
from .point_tree import BLOCK, FAR_POINT, PointTree, build_point_tree
from .project import leaf_tree, project_sorted
from .radius import LEAST_PENALTY, Noise, automatic_error, measure_noise, robust_box, segment_end

GAMMA = 0.1  # overlap that every point must have (paper: 0.1)
OVERLAP_ONE = 1 << 20  # fixed point of the overlap sums (cover_points.cl)
LEVELS = 25  # the last one's balls are 1e-6 of the diagonal, the rounding of the coordinates
CENTER = 2  # state of a chosen point (choose_centers.cl)
# Centres of a level's rounds stand so far apart, over r_r: the first round's balls hold or cover most points, the later
# ones fill the gaps between leaves. r_r throughout gave 5 % more leaves at the same error and three times the rounds.
SPACINGS = (1.0, 0.5, 0.4, 0.3, 0.2)
RECORD = 16  # floats a fitted surfel (fit_surfels.cl)
BOUND_SHARE = 0.999  # of the scan's points lie within `bound` of the surface
BOUND_SAMPLES = 1 << 16  # points that the bound is taken from
BYTES_PER_POINT, FIXED_BYTES = 64, 20_000_000  # of a build's memory beyond the scan
SEGMENT, FORCED, FIXED = 0, 1, 2  # modes of fit_surfels.cl


def build_slim(scan, degree=2, error=0.01, weight=None, memory_limit=None, progress=None, device=None) -> SlimSurface:
    """Build a multi-scale SLIM surface from a scan.

    Parameters
    ----------
    scan : Mesh, PointCloud, RangeScan, str or PathLike
        A path is read with `clsurf.load`. Normals are taken from the scan, computed from the faces, or estimated, in
        this order; those of range images face the sensors. Points that are not finite or have no normal are left out.
    degree : int
        Of the local polynomials: 1, 2 or 3.
    error : float or "auto"
        T_MDL (paper, equation 3), the trade-off between accuracy and sparseness, relative to the diagonal of the
        bounding box without outliers; "auto": from the scan's noise and spacing.
    weight : (n,) array_like, optional
        Confidence of every point, 0 or more; 0 leaves a point out.
    memory_limit : int or str, optional
        Bytes that the build may take beyond the scan, such as "2GB".
    progress : callable, optional
        Called as progress(stage, done) with done from 0 to 1; returning False stops the build.
    device : None, str or Device

    Returns
    -------
    SlimSurface
        `bound` holds for `bound_share` of the scan's points. The same input gives the same bytes on one device.

    Raises
    ------
    InputError
        No usable point, a file that is missing, damaged or holds a surface instead of a scan, a scan without extent,
        or an option out of range.
    DeviceMemoryError
        More memory needed than the limit or the device allows.
    Cancelled
        `progress` returned False; nothing is left behind.
    """
    if degree not in COEFFICIENTS:
        raise InputError(f"degree: expected 1, 2 or 3, got {degree!r}")
    if error != "auto" and not (isinstance(error, int | float | np.number) and 0 < error < 1):
        raise InputError(f"error: expected a share of the diagonal between 0 and 1, or 'auto', got {error!r}")
    if isinstance(scan, str | os.PathLike):
        scan = load(scan)
    if isinstance(scan, RangeScan):
        scan = scan.to_points()
    if not isinstance(scan, Mesh | PointCloud):
        raise InputError("scan: expected a Mesh, a PointCloud, a RangeScan or the path of a scan, got "
                         f"{type(scan).__name__}")
    device = open_device(device)
    report = Reporter(progress)
    report("points", 0.0)
    points = usable_points(scan, weight, device)
    check_room(device, len(points.position), memory_limit, points)
    box = robust_box(points.position)
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    if not diagonal > 0:
        raise InputError("scan: expected points with some extent, got all of them at one place")
    middle = box.mean(axis=0).astype(np.float32)
    tree = build_point_tree(points.position, points.normals, middle, 1.0 / diagonal, device, points.weights)
    noise = measure_noise(tree)
    error = automatic_error(noise) if error == "auto" else float(error)
    report("points", 1.0)
    levels = build_levels(tree, degree, max(noise.variance * error**2, LEAST_PENALTY), noise, report)
    surface = assemble(levels, points, tree, degree, error, diagonal, scan.origin)
    report("bound", 0.0)
    surface = with_bound(surface, tree, middle)
    report("bound", 1.0)
    return surface


class Reporter:
    """Passes progress on to the caller's callback, and stops the build where that returns False."""

    def __init__(self, progress=None):
        self.progress = progress

    def __call__(self, stage: str, done: float) -> None:
        """Report `done` (0 to 1) of `stage`; raises Cancelled."""
        if self.progress is not None and self.progress(stage, done) is False:
            raise Cancelled("build_slim: stopped by the progress callback")


@dataclass
class Points:
    """The usable points of a scan, relative to its origin."""

    position: NDArray  # (n, 3) float32
    normals: NDArray  # (n, 3) float32
    colors: NDArray | None  # (n, 4) uint8
    weights: NDArray | None  # (n,) float32


def usable_points(scan, weight, device) -> Points:
    """Return the points of `scan` that are finite and have a normal and a weight, with what belongs to them.

    The middles of a mesh's large faces are points too.
    """
    weights = None
    if weight is not None:
        weights = np.ascontiguousarray(weight, np.float32)
        if weights.shape != (len(scan.points),) or not (np.isfinite(weights) & (weights >= 0)).all():
            raise InputError(f"weight: expected {len(scan.points)} numbers of 0 or more, got shape {weights.shape}")
    position, normals = scan.points, scan.normals
    colors = vertex_colors(scan)
    if normals is None and isinstance(scan, Mesh) and len(scan.faces):
        normals = face_normals(position, scan.faces)
    if isinstance(scan, Mesh):
        position, normals, colors, weights = with_middles(position, normals, colors, weights,
                                                          large_faces(position, scan.faces))
    usable = np.ones(len(position), bool)
    if not np.isfinite(position).all():
        usable &= np.isfinite(position).all(axis=1)
    if weights is not None:
        usable &= weights > 0
    if normals is None and usable.any():
        normals = estimated_normals(scan, usable, device)
    if normals is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            length2 = np.einsum("ij,ij->i", normals, normals)
        usable &= (length2 > 0) & np.isfinite(length2)
    if not usable.any():
        raise InputError("scan: expected at least one point with a normal, got none")
    if usable.all():
        return Points(position, normals, colors, weights)
    pick = lambda array: None if array is None else array[usable]  # noqa: E731
    return Points(position[usable], normals[usable], pick(colors), pick(weights))


def estimated_normals(scan, usable, device) -> NDArray:
    """Return normals (n, 3) estimated from the usable points; 0 for the others."""
    from .normals import estimate_normals

    scanners = getattr(scan, "scanners", None)
    cloud = PointCloud(scan.points[usable], origin=scan.origin,
                       scanners=None if scanners is None else scanners[usable])
    found = estimate_normals(cloud, device=device)
    normals = np.zeros((len(scan.points), 3), np.float32)
    normals[usable] = found.normals
    return normals


def vertex_colors(scan) -> NDArray | None:
    """Return the colours (n, 4) uint8 of the scan's points: its own, or those of its texture; None without."""
    if scan.colors is not None:
        return scan.colors
    if not isinstance(scan, Mesh) or scan.uv is None or scan.texture is None:
        return None
    height, width = scan.texture.shape[:2]
    u, v = np.nan_to_num(scan.uv, posinf=0, neginf=0).T % 1.0
    return scan.texture[np.minimum(((1 - v) * height).astype(int), height - 1),
                        np.minimum((u * width).astype(int), width - 1)]


def check_room(device, count: int, memory_limit, points: Points):
    """Raise DeviceMemoryError where building from `count` points takes more than the limit or the device has."""
    per_point = BYTES_PER_POINT + (16 if points.colors is not None else 0) + (4 if points.weights is not None else 0)
    needed = FIXED_BYTES + count * per_point
    limit = parse_bytes(memory_limit)
    if limit is not None and needed > limit:
        raise DeviceMemoryError(f"memory_limit: the build of {count:,} points needs {needed / 1e6:.0f} MB, got "
                                f"{limit / 1e6:.0f} MB: raise the limit or build from fewer points")
    device.check_memory(points=24 * count, tree=needed - 24 * count)


def parse_bytes(value) -> int | None:
    """Return a number of bytes from a number or a text such as "500MB" or "2 GB"; None stays None."""
    if value is None:
        return None
    match = re.fullmatch(r"\s*([0-9.]+)\s*([kMGT]?)i?B?\s*", str(value))
    try:
        return int(float(match[1]) * 1000 ** " kMGT".index(match[2] or " "))
    except (TypeError, ValueError):
        raise InputError(f"memory_limit: expected bytes or a text such as '2GB', got {value!r}") from None


def face_normals(points: NDArray, faces: NDArray) -> NDArray:
    """Return vertex normals (n, 3) float32: area-weighted means over the faces, 0 for unused vertices.

    Vertices at the same place (texture seams) share all their faces: of its own ones alone, a seam's vertex has a
    one-sided normal, up to 43 degrees off at 511 of the 3,225 vertices of spot.obj.
    """
    a, b, c = (points[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    scale = np.abs(cross).max()
    cross = (cross / (scale if scale > 0 else 1)).astype(np.float32)
    first, target = first_of_duplicates(points)
    split = len(first) < len(points)
    rows = sparse.csr_matrix((np.ones(faces.size, np.float32), (target[faces] if split else faces).ravel(),
                              np.arange(0, faces.size + 1, 3)), shape=(len(faces), len(first)))
    normals = rows.T @ cross
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    if not split:
        return normals
    used = np.zeros(len(points), bool)
    used[faces] = True
    return np.where(used[:, None], normals[target], np.float32(0))


@dataclass
class Level:
    """The surfels of one level, unit-diagonal units."""

    center: NDArray  # (m,) int32, index among the sorted points
    record: NDArray  # (m, RECORD) float32: radius, normal, e, leaf, coefficients


def build_levels(tree: PointTree, degree: int, penalty: float, noise: Noise, report,
                 fixed_radius: float | None = None) -> list[Level]:
    """Cover the points level by level until every point is covered by leaves.

    Parameters
    ----------
    penalty : float
        lambda T^2, over diagonal^4.
    report : callable
        report(stage, done).
    fixed_radius : float, optional
        One level of leaves of this radius (over the diagonal): for measuring orders of approximation.
    """
    device = tree.device
    terms = (degree + 1) * (degree + 2) // 2
    need = min(2 * min(terms, COEFFICIENTS[2]) + 2, tree.count)  # fewer over-fit; cubics become quadratics before
    choose = device.kernel("build/choose_centers.cl")
    weighted = {"WEIGHTED": 1} if tree.weighted else {}
    fit = device.kernel("build/fit_surfels.cl", constants={"DEGREE": degree, **weighted})
    cover = device.kernel("build/cover_points.cl")
    mark_open = device.kernel("build/open_points.cl")
    blocks = tree.padded // BLOCK
    overlap, held = device.zeros(tree.padded, np.uint32), device.empty(tree.padded, np.uint8)
    state = device.empty(tree.padded, np.uint8)
    threshold = int(GAMMA * OVERLAP_ONE * 1.001) + 1
    levels = []
    for number in range(1, LEVELS + 1):
        r_r = fixed_radius or segment_end(number)
        mode = FIXED if fixed_radius else FORCED if number == LEVELS else SEGMENT
        device.fill(held, 0)
        centers, records = [], []
        while True:
            mark_open((blocks,), (16,), tree.count, blocks, threshold, overlap, held, state)
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
                *tree.arguments, record)
            cover((len(chosen),), (1,), len(chosen), center, record, *tree.arguments, overlap, held)
            centers.append(chosen)
            records.append(record)
        if not centers:
            break
        records = [device.download(r, copy=False) for r in records]
        levels.append(Level(np.concatenate(centers), np.concatenate(records)))
        covered = np.count_nonzero(device.download(overlap, copy=False)[:tree.count] >= threshold)
        report("levels", covered / tree.count)
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
        level=np.repeat(np.arange(1, len(levels) + 1), [len(level.center) for level in levels]),
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
    """Return `surface` with the distance that BOUND_SHARE of the scan's points keep, from an even sample of them."""
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
                   bound_share=BOUND_SHARE)
