"""Curvature at points of scans and surfaces.

Source: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces with Applications to High Quality Rendering,
Feature Extraction, and Smoothing", SGP 2005, section 3, equation 8 (left side): derivatives of the local surfaces are
blended.
"""

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..build.neighbours import nearest
from ..build.point_tree import BLOCK, PointTree, build_point_tree, morton_order
from ..build.project import leaf_tree, project
from ..build.radius import robust_box
from ..device import Device, open_device
from ..errors import Cancelled, InputError
from ..io import load
from ..io.stored import StoredSurface
from ..surface.arrays import lengths_of
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.patch_mesh import patch_mesh
from ..surface.placed import Placed
from ..surface.ranges import RangeScan
from ..surface.scale_map import ScaleMap
from ..surface.scale_mesh import scale_mesh
from ..surface.slim import SlimSurface
from ..surface.surfel import SurfelHierarchy, finest_scan
from . import risk
from .quartics import RADIUS_RATIO, SurfelTree, evaluate, fit_surfels
from .scan_points import scan_points

NOISY = (0.05, 0.3)  # point spacings of noise above which normals are averaged, and averaged again
NORMAL_REACH = 4.0  # point spacings that they are averaged over
AROUND = 8  # known points that a normal is taken from where a point's own is of no use
FAR = 1e6  # coordinate beyond which a query is as good as infinitely far, in the tree's units
# Newton steps onto the blend: a scan's own points lie within the noise of it, other points come from a tangent plane.
OWN_STEPS, QUERY_STEPS = 1, 3


@dataclass(frozen=True, eq=False, repr=False)
class Curvature:
    """Curvature at n points, float64, world space. A sphere of radius R with outward normals has mean curvature +1/R.

    Attributes
    ----------
    mean, k1, k2 : (n,)
        Mean and principal curvatures, k1 >= k2, 1 / length. NaN where nothing is known: points that are not finite or
        have no normal, and strays with fewer than 5 other points around them.
    gaussian : (n,)
        1 / length^2.
    direction1, direction2 : (n, 3)
        Unit principal directions of k1 and k2, tangential; with the normal right-handed, their signs without meaning.
    position, normal : (n, 3)
        Where the surface was measured: the point moved onto it, and its unit normal there.
    """

    mean: NDArray
    gaussian: NDArray
    k1: NDArray
    k2: NDArray
    direction1: NDArray
    direction2: NDArray
    position: NDArray
    normal: NDArray

    def __post_init__(self):
        for array in vars(self).values():
            array.flags.writeable = False

    def __len__(self):
        return len(self.mean)

    def __repr__(self):
        known = self.mean[np.isfinite(self.mean)]
        if not len(known):
            return f"Curvature({len(self):,} points, none known)"
        low, middle, high = np.quantile(known, (0.05, 0.5, 0.95))
        return f"Curvature({len(self):,} points, mean {middle:.4g}, {low:.4g} to {high:.4g} for 90 % of them)"


def curvature(thing, points=None, radius="auto", progress=None, device=None) -> Curvature:
    """Measure the curvature of a scan or a surface.

    A scan is covered by sparse surfels of degree 4 whose derivatives are blended; their radius follows from the scan's
    noise and shape. A SLIM surface is measured by the blended derivatives of its own surfels.

    Parameters
    ----------
    thing : Mesh, PointCloud, RangeScan, SlimSurface, StoredSurface, PatchSurface, SurfelHierarchy, ScaleMap, Placed or
        str or PathLike: a path is read with `clsurf.load`. Normals say which way is out: they are taken from the scan,
        computed from the faces, or estimated, in this order. Of a PatchSurface its opaque nodes, of a SurfelHierarchy
        its base surfels or its mesh, of a ScaleMap its valid texels are taken as a scan.
    points : (n, 3) array_like, optional
        World positions; the nearest place of the surface is measured. By default the scan's own points in their order,
        or the centres of a SLIM surface's leaves.
    radius : float or "auto"
        Of the surfels of degree 4 fitted to a scan, world units; they grow where they hold too few points.
    progress : callable, optional
        Called as progress(stage, done) with done from 0 to 1; returning False stops the work.
    device : None, str or Device

    Returns
    -------
    Curvature
        The sign follows the orientation, and is without meaning for surfaces that are not oriented.

    Raises
    ------
    InputError
        Something without curvature (SLIM of degree 1, fewer than 6 points, no extent), a file that cannot be read,
        positions of another shape or not finite, or a radius that is not positive.
    DeviceMemoryError
        More memory needed than the device has.
    Cancelled
        `progress` returned False.
    """
    if isinstance(thing, str | os.PathLike):
        thing = load(thing)
    points = _checked_points(points)
    number = isinstance(radius, int | float | np.number) and not isinstance(radius, bool)
    if radius != "auto" if isinstance(radius, str) else not (number and 0 < radius < np.inf):
        raise InputError(f"radius: expected a positive length or 'auto', got {radius!r}")
    device = open_device(device)
    report = _Reporter(progress)
    if isinstance(thing, Placed):
        return _of_placed(thing, points, radius, progress, device)
    if isinstance(thing, SlimSurface):
        return _of_slim(thing, points, radius, report, device)
    if isinstance(thing, StoredSurface):
        return _of_stored(thing, points, radius, report, device)
    if isinstance(thing, PatchSurface):
        thing = patch_mesh(thing)
    if isinstance(thing, SurfelHierarchy):
        thing = finest_scan(thing)
    if isinstance(thing, ScaleMap):
        thing = scale_mesh(thing)
    if isinstance(thing, RangeScan):
        thing = thing.to_points()
    if not isinstance(thing, Mesh | PointCloud):
        raise InputError("curvature: expected a Mesh, PointCloud, RangeScan, SlimSurface, StoredSurface, PatchSurface, "
                         f"SurfelHierarchy, ScaleMap, one of these placed, or a path, got {type(thing).__name__}")
    return _of_scan(thing, points, radius, report, device)


class _Reporter:
    """Passes progress on, and stops the work where the callback returns False."""

    def __init__(self, progress):
        self.progress = progress

    def __call__(self, stage: str, done: float) -> None:
        if self.progress is not None and self.progress(stage, done) is False:
            raise Cancelled("curvature: stopped by the progress callback")


def _checked_points(points) -> NDArray | None:
    if points is None:
        return None
    try:
        points = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"points: expected an array of numbers of shape (n, 3), got {points!r:.60}") from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points: expected an array of shape (n, 3), got {points.shape}")
    if not np.isfinite(points).all():
        raise InputError("points: expected finite positions, got NaN or infinity: leave those out")
    return points


def _of_placed(thing: Placed, points, radius, progress, device) -> Curvature:
    linear, scale, shift = thing.matrix[:3, :3], thing.scale, thing.matrix[:3, 3]
    if points is not None:
        points = (points - shift) @ linear / scale**2  # the inverse of a similarity
    own = curvature(thing.surface, points, radius if radius == "auto" else radius / scale, progress, device)
    turned = lambda vectors: vectors @ linear.T / scale  # noqa: E731
    return Curvature(own.mean / scale, own.gaussian / scale**2, own.k1 / scale, own.k2 / scale, turned(own.direction1),
                     turned(own.direction2), own.position @ linear.T + shift, turned(own.normal))


def _of_slim(surface: SlimSurface, points, radius, report, device: Device) -> Curvature:
    if surface.degree == 1:
        raise InputError("surface: expected a SLIM surface of degree 2 or 3, got one of planes: build it with degree=2")
    if radius != "auto":
        raise InputError("radius: expected 'auto' for a surface, whose surfels have radii of their own, got "
                         f"{radius:g}")
    if points is None:
        points = surface.centers[surface.leaf].astype(np.float64) + surface.origin
    report("surfels", 0.0)
    leaves = leaf_tree(surface, device)
    middle = surface.origin + leaves.middle
    near = project(surface, points, device)
    report("surfels", 1.0)
    local = np.concatenate([(near.position - middle) / leaves.unit, near.normal], axis=1).astype(np.float32)
    surfels = SurfelTree(device, surface.degree, leaves.records, leaves.padded, leaves.balls, leaves.boxes,
                         leaves.node_offset, leaves.top_level)
    return _in_world(_at_positions(surfels, local, 0, report), leaves.unit, middle)


def _of_stored(stored: StoredSurface, points, radius, report, device: Device) -> Curvature:
    """Measure a surface that stays in its store, with the parts around the points at hand."""
    leaves = stored.leaves()
    if points is None:
        centers = [own.centers.astype(np.float64) + own.origin for own, _ in map(leaves.leaves, range(len(leaves)))]
        points = places = np.concatenate(centers)
    else:
        places = project(stored, points, device).position
    columns: dict[str, NDArray] = {}
    for rows, parts in leaves.groups(places):
        found = _of_slim(leaves.surface(parts)[0], points[rows], radius, report, device)
        for name, array in vars(found).items():
            columns.setdefault(name, np.full((len(points), *array.shape[1:]), np.nan))[rows] = array
    if not columns:
        return _of_slim(leaves.surface(range(len(leaves)))[0], points, radius, report, device)
    return Curvature(**columns)


def _of_scan(scan, points, radius, report, device: Device) -> Curvature:
    report("points", 0.0)
    found = scan_points(scan, device)
    box = robust_box(found.position)
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    if not diagonal > 0:
        raise InputError("scan: expected points with some extent, got all of them at one place")
    # A power of two: scaling rounds no coordinate.
    unit, middle = 2.0 ** np.ceil(np.log2(diagonal)), box.mean(axis=0).astype(np.float32)
    device.check_memory(points=24 * len(found.position))
    tree = build_point_tree(found.position, found.normals, middle, 1 / unit, device)
    report("points", 1.0)
    plan = _plan(tree, None if radius == "auto" else float(radius) / unit, report)
    tree = plan.tree
    report("surfels", 0.0)
    surfels = fit_surfels(tree, plan.block_radius, plan.noise, plan.spacing)
    if radius != "auto" and not (device.download(surfels.balls, copy=False)[3] > 0).any():
        raise InputError(f"radius: expected balls that hold a piece of the surface, got {radius:g}: the spacing is "
                         f"{plan.spacing * unit:.3g}, the diagonal {diagonal:.3g}: take 'auto'")
    report("surfels", 1.0)
    world_middle = middle + scan.origin
    if points is not None:
        local = _near_scan(tree, (points - world_middle) / unit, device)
        return _in_world(_at_positions(surfels, local, QUERY_STEPS, report), unit, world_middle)
    report("curvature", 0.0)
    values = evaluate(surfels, tree.sorted, tree.order, tree.padded, OWN_STEPS)
    values = _with_mean_normals(surfels, (found.position - middle) / unit, values)
    report("curvature", 1.0)
    return _in_world(found.spread(values), unit, world_middle)


@dataclass(eq=False)
class _Plan:
    """How a scan is fitted: its tree, its normals averaged where the points are noisy, and more."""

    tree: PointTree
    block_radius: NDArray  # (blocks,) float32, of the surfels in every block of 16 points
    noise: float  # over the point spacing
    spacing: float  # of the points, in the tree's units


def _plan(tree: PointTree, radius: float | None, report) -> _Plan:
    report("noise", 0.0)
    samples = risk.spread_samples(tree)
    spacing = float(np.median(samples.spacing))
    sigma = risk.noise_level(tree, samples)
    for least in NOISY:
        if sigma > least * spacing:
            tree = risk.with_mean_normals(tree, NORMAL_REACH * spacing)
    report("noise", 0.3)
    if radius is not None:
        return _Plan(tree, np.full(tree.padded // BLOCK, radius, np.float32), sigma / spacing, spacing)
    fits = risk.two_degree_fits(tree, samples)
    found = RADIUS_RATIO * risk.least_risk_radius(samples, fits, sigma)
    report("noise", 1.0)
    return _Plan(tree, risk.block_radii(tree, samples, found), sigma / spacing, spacing)


def _with_mean_normals(surfels: SurfelTree, position: NDArray, values: NDArray) -> NDArray:
    """Return the values (n, 16), unknown ones once more with the mean normal of the nearest known points.

    A normal that contradicts all surfels is one of a sliver among the faces, or a turned one.
    """
    known = np.isfinite(values[:, 6])
    if known.all() or not known.any():
        return values
    unknown = np.flatnonzero(~known)
    index = nearest(position[known], min(AROUND, np.count_nonzero(known)), position[unknown], surfels.device)[0]
    normal = values[known][index, 3:6].mean(axis=1)
    normal /= np.maximum(lengths_of(normal, keepdims=True), 1e-30)
    local = np.concatenate([position[unknown], normal], axis=1).astype(np.float32)
    values[unknown] = _at_positions(surfels, local, OWN_STEPS, lambda *_: None)
    return values


def _near_scan(tree: PointTree, queries: NDArray, device: Device) -> NDArray:
    """Return (n, 6) float32: each query's foot in the tangent plane of the nearest scan point, and that point's normal.

    `queries` (n, 3) in the tree's units. Beyond a rim the foot stays within two spacings of the scan.
    """
    if not len(queries):
        return np.zeros((0, 6), np.float32)
    queries = np.clip(queries, -FAR, FAR).astype(np.float32)
    host = device.download(tree.sorted, copy=False)[:6, :tree.count].T
    index = nearest(np.ascontiguousarray(host[:, :3]), 1, queries, device)[0][:, 0]
    point, normal = host[index, :3].astype(np.float64), host[index, 3:].astype(np.float64)
    offset = queries - point
    along = offset - np.einsum("ij,ij->i", offset, normal)[:, None] * normal
    length = lengths_of(along, keepdims=True)
    reach = 2 * float(np.median(risk.local_spacings(tree, np.unique(index // BLOCK).astype(np.int32))))
    along *= np.minimum(1, reach / np.maximum(length, 1e-30))
    return np.concatenate([point + along, normal], axis=1).astype(np.float32)


def _at_positions(surfels: SurfelTree, local: NDArray, steps: int, report) -> NDArray:
    """Return the values (n, 16) float32 at positions and normals `local` (n, 6) float32 in the surfels' units."""
    device, count = surfels.device, len(local)
    report("curvature", 0.0)
    if count == 0:
        return np.zeros((0, 16), np.float32)
    device.check_memory(queries=24 * count)
    order, _, _ = morton_order(np.ascontiguousarray(local[:, :3]), device)
    padded = -(-count // BLOCK) * BLOCK
    queries = np.zeros((6, padded), np.float32)
    queries[:, :count] = local[order].T
    values = evaluate(surfels, device.upload(queries), order, padded, steps)
    report("curvature", 1.0)
    return values


def _in_world(values: NDArray, unit: float, middle: NDArray) -> Curvature:
    """Return rows (n, 16) of point_curvature.cl in world units."""
    part = lambda *columns: np.ascontiguousarray(values[:, slice(*columns)], np.float64)  # noqa: E731
    number = lambda column: values[:, column].astype(np.float64)  # noqa: E731
    return Curvature(number(6) / unit, number(7) / unit / unit, number(8) / unit, number(9) / unit, part(10, 13),
                     part(13, 16), part(0, 3) * unit + middle, part(3, 6))
