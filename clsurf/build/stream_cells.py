"""One cell of a streamed SLIM build: points with a halo, normals, the coarse leaves' coverage, its own levels.

A cell keeps the surfels whose centres are its own, and those leaves of the halo without which a point of its own
would be uncovered: what a neighbour makes there may differ. So cells need nothing of each other, and the seams are
covered. Coarse levels come from a thinned copy of the whole scan, made first; all points check their leaves.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..device import Device
from ..device.arrays import DeviceArray
from ..io.cleaning import first_of_duplicates
from ..surface.arrays import box_of
from ..surface.cloud import PointCloud
from ..surface.patch import PatchSurface
from ..surface.slim import COEFFICIENTS, SlimSurface
from .neighbours import box_tree, covariance, nearest
from .normals import estimate_normals
from .orientation import oriented_to
from .point_tree import PointTree, build_point_tree
from .project import leaf_tree, project_sorted
from .radius import LEAST_PENALTY
from .slim_levels import COVERED, Level, Points, assemble, build_levels
from .stream_plan import Plan, cell_middle, halo_of
from .stream_runs import Runs

ALPHA = 2 / 3  # cover.clh
# A coarse leaf fits the scan where the mean square over all points is at most so many times that over the thinned ones,
# or what condition (4) lets pass as noise and penalty.
WORSE, ALLOWED_PENALTY, ALLOWED_NOISE = 2.0, 4.0, 3.0
ERROR_SHARE = 0.5  # of the tolerance: WITHIN_ERROR of fit_surfels.cl
OVERLAP = 1.5  # node spacings (or twice the points' where none is given) that patches go over a cell's border
ORIENTED = 200_000  # points of the copy that are oriented together
DISTANCES = 64  # every so many of the points is measured for `bound`


@dataclass(frozen=True)
class Options:
    """What the user asked for, checked."""

    degree: int
    error: float | str
    tolerance: float | None  # world units
    orient: str  # "up", "graph" or "given"
    patches: tuple | None = None  # of patches in place of surfels: the fields of their request


@dataclass(eq=False)
class Coarse:
    """The thinned copy and the levels made from it.

    Attributes
    ----------
    surface : SlimSurface
        Its leaves are leaves until `check` says otherwise.
    points, normals : (n, 3) float32
        Of the copy, relative to the plan's origin; they orient the cells' normals.
    """

    surface: SlimSurface
    points: NDArray
    normals: NDArray


def penalty_of(plan: Plan) -> float:
    """Return lambda T^2, over diagonal^4."""
    return max(plan.noise.variance * plan.error**2, LEAST_PENALTY)


def tolerance_of(plan: Plan, options: Options) -> float:
    """Return the tolerance over the diagonal; infinite without."""
    return math.inf if options.tolerance is None else options.tolerance / plan.diagonal


def build_coarse(runs: Runs, plan: Plan, options: Options, device: Device) -> Coarse:
    """Thin the scan and build the levels before the cells' first."""
    points = runs.thin(plan.thin // 16, plan.origin)
    first, _ = first_of_duplicates(points.position)
    take = lambda array: array if array is None or len(first) == len(array) else array[first]  # noqa: E731
    position, normals, colors = take(points.position), take(points.normals), take(points.colors)
    if normals is None:
        normals = copy_normals(position, plan, "up" if options.orient == "up" else "graph", device)
    tree = build_point_tree(position, normals, np.zeros(3, np.float32), 1 / plan.diagonal, device)
    levels = build_levels(tree, options.degree, penalty_of(plan), plan.noise, lambda *_: None,
                          tolerance=tolerance_of(plan, options), levels=range(1, plan.first))
    usable = Points(position, normals, colors, None)
    surface = assemble(levels, usable, tree, options.degree, plan.error, plan.diagonal, plan.origin)
    return Coarse(surface, position, normals)


def copy_normals(position: NDArray, plan: Plan, orient: str, device: Device) -> NDArray:
    """Return oriented normals (n, 3) of the thinned copy; a large one takes its sides from every so many of its points.

    (The graph of 1.6M points of the copy of 50M took 17 s of 160, and half a gigabyte.)
    """
    step = -(-len(position) // ORIENTED) if orient == "graph" else 1
    some = np.ascontiguousarray(position[::step])
    known = estimate_normals(PointCloud(some, origin=plan.origin), k=plan.neighbours, orient=orient,
                             device=device).normals
    if step == 1:
        return known
    normals = covariance(box_tree(position, device), plan.neighbours).normals.copy()
    index, _ = nearest(some, 1, position, device)
    return oriented_to(normals, known[index[:, 0]])


def records_of(surface: SlimSurface, rows: NDArray, origin: NDArray) -> tuple[NDArray, NDArray]:
    """Return places (m, 3) and records (m, 16) float32 (fit_surfels.cl) of surfels, over the diagonal.

    `origin` (3,) float64, world, is the zero of the places.
    """
    unit, terms = surface.diagonal, surface.coefficients.shape[1]
    place = (surface.centers[rows] + (surface.origin - origin)) / unit
    record = np.zeros((len(rows), 16), np.float32)
    record[:, 0], record[:, 1:4] = surface.radii[rows] / unit, surface.normals[rows]
    record[:, 4], record[:, 5] = surface.fit_error[rows] / unit, surface.leaf[rows]
    order = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])[:terms]
    record[:, 6:6 + terms] = surface.coefficients[rows] * unit ** (order - 1.0)
    return np.ascontiguousarray(place, np.float32), record


@dataclass(eq=False)
class CellPoints:
    """The points of a cell and its halo, relative to `origin`."""

    position: NDArray  # (n, 3) float32
    colors: NDArray | None
    normals: NDArray | None  # as the file has them
    own: NDArray  # (n,) bool: not of the halo
    away: NDArray  # (n,) float32: at least so far from the cell's own points, world units
    origin: NDArray  # (3,) float64, world

    def near(self, surface: SlimSurface) -> NDArray:
        """Return which leaves of `surface` have balls that reach these points' box."""
        low, high = (end + (self.origin - surface.origin) for end in box_of(self.position))
        away = np.maximum(np.maximum(low - surface.centers, surface.centers - high), 0)
        return np.flatnonzero(surface.leaf & (np.einsum("ij,ij->i", away, away) < surface.radii.astype(np.float64)**2))


def cell_points(runs: Runs, plan: Plan, number: int, halo: bool = True) -> CellPoints:
    """Return the distinct points of a cell, with its halo or without."""
    first, last = plan.cuts[number:number + 2]
    wanted, ring = halo_of(runs, first, last, plan.rings if halo else 0)
    origin = cell_middle(runs, first, last)
    points = runs.fetch(wanted, origin)
    own = (ring == 0)[points.cell]
    away = (np.maximum(ring - 1, 0) * np.float32(runs.lattice.width))[points.cell]
    if halo:
        kept, _ = first_of_duplicates(points.position)
        if len(kept) < len(own):
            take = lambda array: None if array is None else array[kept]  # noqa: E731
            return CellPoints(points.position[kept], take(points.colors), take(points.normals), own[kept], away[kept],
                              origin)
    return CellPoints(points.position, points.colors, points.normals, own, away, origin)


def check_cell(points: CellPoints, plan: Plan, coarse: Coarse, device: Device) -> tuple[NDArray, NDArray]:
    """Return the leaves of the coarse surface that reach a cell, and their sums (m, 2) over its own points."""
    near = points.near(coarse.surface)
    if not len(near):
        return near, np.zeros((0, 2), np.float32)
    tree = build_point_tree(points.position, np.zeros_like(points.position), np.zeros(3, np.float32), 1 / plan.diagonal,
                            device)
    own = np.zeros(tree.padded, np.uint8)
    own[:tree.count] = points.own[tree.order]
    place, record = records_of(coarse.surface, near, points.origin)
    sums = device.empty((len(near), 2), np.float32)
    device.kernel("build/check_leaves.cl")(
        (len(near),), (1,), len(near), device.upload(place), device.upload(record),
        COEFFICIENTS[coarse.surface.degree], tree.padded, tree.sorted, device.upload(own), *tree.arguments[2:], sums)
    return near, device.download(sums)


def checked(coarse: SlimSurface, sums: NDArray, plan: Plan, options: Options) -> SlimSurface:
    """Return the coarse surface with the leaves that fit the scan; `sums` (n, 2) are those of all cells together.

    A leaf that does not becomes an internal surfel; its fit error is that over all points.
    """
    error2 = sums[:, 1] / np.maximum(sums[:, 0], 1e-30)
    radius, thin2 = coarse.radii / plan.diagonal, (coarse.fit_error / plan.diagonal) ** 2
    allowed = np.maximum(WORSE * thin2, ALLOWED_PENALTY * penalty_of(plan) / radius**2
                         + ALLOWED_NOISE * plan.noise.variance)
    allowed = np.minimum(allowed, (1.1 * ERROR_SHARE * tolerance_of(plan, options)) ** 2)
    measured = coarse.leaf & (sums[:, 0] > 0)
    error = np.where(measured, np.sqrt(error2) * plan.diagonal, coarse.fit_error).astype(np.float32)
    return replace(coarse, leaf=coarse.leaf & (sums[:, 0] > 0) & (error2 <= allowed), fit_error=error)


def normals_of(points: CellPoints, plan: Plan, options: Options, coarse: Coarse, device: Device) -> NDArray:
    """Return unit normals (n, 3): those of the file, or estimated and turned as the thinned copy's nearest one is."""
    if points.normals is not None:
        return points.normals
    normals = covariance(box_tree(points.position, device), plan.neighbours).normals.copy()
    if options.orient == "up":
        return oriented_to(normals, np.array([0, 0, 1], np.float32))
    shift = (points.origin - plan.origin).astype(np.float32)
    low, high = (end + shift for end in box_of(points.position))
    reach = 0.1 * (high - low).max()
    close = ((coarse.points >= low - reach) & (coarse.points <= high + reach)).all(axis=1)
    close = close if close.any() else np.ones(len(close), bool)
    index, _ = nearest(coarse.points[close] - shift, 1, points.position, device)
    return oriented_to(normals, coarse.normals[close][index[:, 0]])


def build_cell(points: CellPoints, plan: Plan, options: Options, coarse: Coarse, device: Device, total: int
               ) -> tuple[SlimSurface | PatchSurface, NDArray]:
    """Return a cell's surface and the distances of a sample of its own points to it, world units.

    `total` is the number of the scan's points.
    """
    normals = normals_of(points, plan, options, coarse, device)
    if options.patches is not None:
        from .patches import PatchRequest
        from .stream_patches import build_patch_cell
        request = PatchRequest(*options.patches)
        own = with_rim(points, OVERLAP * max(request.spacing or 0.0, 2 * plan.noise.spacing * plan.diagonal), device)
        return build_patch_cell(points.position[own], normals[own], None if points.colors is None else
                                points.colors[own], points.origin, plan, request, total, device)
    tree = build_point_tree(points.position, normals, np.zeros(3, np.float32), 1 / plan.diagonal, device)
    tolerance = tolerance_of(plan, options)
    near = points.near(coarse.surface)
    place, record = records_of(coarse.surface, near, points.origin)
    overlap = covered_by(tree, place, record, tolerance, options.degree)
    before = device.download(overlap)
    levels = build_levels(tree, options.degree, penalty_of(plan), plan.noise, lambda *_: None, tolerance=tolerance,
                          levels=range(plan.first, 26), overlap=overlap,
                          away=points.away[tree.order] / np.float32(plan.diagonal))
    levels = kept_levels(tree, levels, points.own[tree.order], device.upload(before), tolerance, options.degree)
    usable = Points(points.position, normals, points.colors, None)
    surface = assemble(levels, usable, tree, options.degree, plan.error, plan.diagonal, points.origin)
    return surface, own_distances(tree, points, surface, coarse.surface, near)


def with_rim(points: CellPoints, reach: float, device: Device) -> NDArray:
    """Return which points (n,) bool are the cell's own or at most `reach` away from those."""
    halo = np.flatnonzero(~points.own)
    if not len(halo) or len(halo) == len(points.own):
        return points.own
    out = points.own.copy()
    _, distance = nearest(points.position[points.own], 1, points.position[halo], device)
    out[halo] = distance[:, 0] <= reach
    return out


def covered_by(tree: PointTree, place: NDArray, record: NDArray, tolerance: float, degree: int) -> DeviceArray:
    """Return the coverage (padded,) uint32 of a tree's points by leaves at given places."""
    device = tree.device
    overlap, held = device.zeros(tree.padded, np.uint32), device.empty(tree.padded, np.uint8)
    if len(place):
        device.kernel("build/cover_leaves.cl")((len(place),), (1,), len(place), device.upload(place),
                                               device.upload(record), tolerance, COEFFICIENTS[degree], *tree.arguments,
                                               overlap, held)
    return overlap


def kept_levels(tree: PointTree, levels: list[Level], own: NDArray, overlap: DeviceArray, tolerance: float,
                degree: int) -> list[Level]:
    """Return the levels without the halo's surfels, except for leaves that a point of the cell's own needs.

    Parameters
    ----------
    own : (count,) bool
        Of the sorted points: not the halo's.
    overlap : DeviceArray
        (padded,) uint32, the coverage by the coarse leaves; changed.
    """
    device = tree.device
    held = device.empty(tree.padded, np.uint8)
    cover = device.kernel("build/cover_points.cl")
    for level in levels:
        rows = np.flatnonzero(own[level.center] & (level.record[:, 5] > 0))
        if len(rows):
            cover((len(rows),), (1,), len(rows), device.upload(level.center[rows]), device.upload(level.record[rows]),
                  tolerance, COEFFICIENTS[degree], *tree.arguments, overlap, held)
    sorted_points = device.download(tree.sorted, copy=False)[:3]
    lacking = np.flatnonzero(own & (device.download(overlap)[:tree.count] < COVERED))
    needy = cKDTree(sorted_points[:, lacking].T) if len(lacking) else None
    out = []
    for level in levels:
        keep = own[level.center].copy()
        others = np.flatnonzero(~keep & (level.record[:, 5] > 0))
        if needy is not None and len(others):
            distance, _ = needy.query(sorted_points[:, level.center[others]].T)
            keep[others] = distance < ALPHA * level.record[others, 0]
        if keep.any():
            out.append(Level(level.number, level.center[keep], level.record[keep]))
    return out


def own_distances(tree: PointTree, points: CellPoints, surface: SlimSurface, coarse: SlimSurface, near: NDArray
                  ) -> NDArray:
    """Return the ascending distances (s,) float32 of a sample of the cell's own points, world units."""
    leaves = joined_leaves(surface, coarse, near)
    rows = np.flatnonzero(points.own[tree.order])[::DISTANCES]
    if not len(rows) or not leaves.leaf.any():
        return np.zeros(0, np.float32)
    padded = -(-len(rows) // 16) * 16
    queries = np.zeros((3, padded), np.float32)
    queries[:, :len(rows)] = tree.device.download(tree.sorted, copy=False)[:3, rows]
    found = project_sorted(leaf_tree(leaves, tree.device, np.zeros(3)), tree.device.upload(queries), len(rows), padded)
    distance = np.abs(tree.device.download(found)[6, :len(rows)]) * surface.diagonal
    return np.sort(distance).astype(np.float32)


def joined_leaves(surface: SlimSurface, coarse: SlimSurface, near: NDArray) -> SlimSurface:
    """Return the leaves of a cell and the coarse ones `near` it as one surface without links."""
    own = np.flatnonzero(surface.leaf)
    shift = (coarse.origin - surface.origin).astype(np.float64)
    both = lambda name: np.concatenate([getattr(surface, name)[own], getattr(coarse, name)[near]])  # noqa: E731
    count = len(own) + len(near)
    return replace(surface, centers=np.concatenate([surface.centers[own], coarse.centers[near] + shift]),
                   **{name: both(name) for name in ("radii", "normals", "coefficients", "level", "leaf", "fit_error")},
                   child_offset=np.zeros(count + 1, np.int32), children=np.zeros(0, np.int32), footprint=None,
                   colors=None)
