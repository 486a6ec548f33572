"""How far a surface is from a scan, and the scan from the surface.

Source: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces with Applications to High Quality Rendering,
Feature Extraction, and Smoothing", SGP 2005, section 4, "Sparsity analysis": the scan's points are projected onto the
surface, and the squares of the distances averaged.
"""

import os
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..build.project import project
from ..build.radius import robust_box
from ..build.triangles import triangle_distances
from ..device import open_device
from ..errors import InputError
from ..io import load
from ..io.stored import StoredSurface
from ..surface.arrays import finite_rows, lengths_of
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.patch_mesh import patch_mesh
from ..surface.placed import Placed
from ..surface.ranges import RangeScan
from ..surface.scale_map import ScaleMap
from ..surface.scale_mesh import scale_mesh
from ..surface.slim import SlimSurface, frame_of_normals, powers
from ..surface.surfel import SurfelHierarchy

MEASURED = SlimSurface | StoredSurface | PatchSurface | SurfelHierarchy | ScaleMap
ALPHA = 2 / 3  # of a ball's radius: the part that carries the surface


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceError:
    """Distances between a scan and a surface, world units.

    Attributes
    ----------
    distance : (n,) float64
        From every finite point of the scan to the surface. From SLIM surfaces and surfel hierarchies signed, positive
        on the side that the normals point to; from meshes and patches 0 or more.
    diagonal : float
        Of the scan's bounding box without outliers, world units: what `relative` divides by.
    backward : SurfaceError or None
        From samples of the surface to the scan's triangles, where asked for.
    """

    distance: NDArray
    diagonal: float
    backward: "SurfaceError | None" = None

    @property
    def rms(self) -> float:
        """L2 error: the root of the mean squared distance."""
        return float(np.sqrt(np.mean(self.distance**2)))

    @property
    def mean(self) -> float:
        """Mean of the distances with their signs: 0 where the surface runs through the middle of the points."""
        return float(np.mean(self.distance))

    @property
    def max(self) -> float:
        """Largest distance."""
        return float(np.abs(self.distance).max())

    @property
    def median(self) -> float:
        """Median distance."""
        return self.percentile(50)

    def percentile(self, percent: float) -> float:
        """Return the distance that `percent` of the points keep."""
        return float(np.percentile(np.abs(self.distance), percent))

    def within(self, length: float) -> float:
        """Return the share of the points (0 to 1) that are no further than `length` away."""
        return float(np.mean(np.abs(self.distance) <= length))

    @property
    def relative(self) -> "SurfaceError":
        """The same over the diagonal: `error.relative.rms` is 0.0001 for 0.01 %."""
        back = None if self.backward is None else replace(self.backward, distance=self.backward.distance
                                                          / self.diagonal, diagonal=1.0)
        return SurfaceError(self.distance / self.diagonal, 1.0, back)

    def __repr__(self):
        return (f"SurfaceError(L2 {self.rms:.4g} or {self.rms / self.diagonal:.4%} of the diagonal, max "
                f"{self.max:.4g}, {len(self.distance):,} points)")


def error(surface, scan, both: bool = False, samples: int = 100_000, device=None) -> SurfaceError:
    """Measure the distances of a scan's points to a surface.

    Parameters
    ----------
    surface : SlimSurface, StoredSurface, PatchSurface, SurfelHierarchy, ScaleMap, Mesh or Placed
        SLIM surfaces and hierarchies are projected onto (see `project`); of patches, the triangles between opaque nodes
        count, of scale maps those between valid texels.
    scan : Mesh, PointCloud, RangeScan, (n, 3) array_like of world positions, or the path of a scan
        Points that are not finite are left out.
    both : bool
        Also measure `samples` points of the surface, evenly spread over its area, against the scan's triangles.
    samples : int
    device : None, str or Device

    Returns
    -------
    SurfaceError
        L2 error, maximum, percentiles; in world units, and over the diagonal as `.relative`.

    Raises
    ------
    InputError
        A scan without finite points, a surface without leaves or faces, or `both` without triangles in the scan.
    """
    scan = _as_scan(scan)
    if not isinstance(surface.surface if isinstance(surface, Placed) else surface, MEASURED | Mesh):
        raise InputError("surface: expected a SlimSurface, a StoredSurface, a PatchSurface, a SurfelHierarchy, a "
                         f"ScaleMap or a Mesh, got {type(surface).__name__}")
    if both and not (isinstance(scan, Mesh) and len(scan.faces)):
        raise InputError("both: expected a scan with faces to measure the surface's points against, got points only")
    device = open_device(device)
    points = scan.points[finite_rows(scan.points)]
    if not len(points):
        raise InputError("scan: expected at least one finite point, got none")
    diagonal = float(np.linalg.norm(np.subtract(*robust_box(points))))
    found = SurfaceError(distances(surface, points.astype(np.float64) + scan.origin, device), diagonal)
    if not both:
        return found
    placed_samples = surface_samples(surface, samples, device) - scan.origin
    back = triangle_distances(scan.vertices, scan.faces, placed_samples, device)
    return replace(found, backward=SurfaceError(back, diagonal))


def _as_scan(scan) -> Mesh | PointCloud:
    """Return `scan` as a Mesh or a PointCloud."""
    if isinstance(scan, str | os.PathLike):
        scan = load(scan)
    if isinstance(scan, RangeScan):
        return scan.to_points()
    if isinstance(scan, Mesh | PointCloud):
        return scan
    if isinstance(scan, MEASURED | Placed):
        raise InputError(f"scan: expected a scan, got a surface ({type(scan).__name__})")
    try:
        points = np.asarray(scan, np.float64)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError("scan: expected a Mesh, a PointCloud, a RangeScan, an array of shape (n, 3) or the path of a "
                         f"scan, got {type(scan).__name__} {'' if not points.size else points.shape}".rstrip())
    return PointCloud(points[finite_rows(points)])


def distances(surface, points: NDArray, device) -> NDArray:
    """Return the distances (n,) float64 of world `points` (n, 3) to a surface; signed for SLIM surfaces."""
    if isinstance(surface, Placed):
        linear, scale = surface.matrix[:3, :3], surface.scale
        return scale * distances(surface.surface, (points - surface.matrix[:3, 3]) @ linear / scale**2, device)
    if isinstance(surface, SlimSurface | StoredSurface | SurfelHierarchy):
        return project(surface, points, device=device).distance
    mesh = _as_mesh(surface)
    return triangle_distances(mesh.vertices, mesh.faces, points - mesh.origin, device)


def _as_mesh(surface) -> Mesh:
    mesh = patch_mesh(surface) if isinstance(surface, PatchSurface) else \
        scale_mesh(surface) if isinstance(surface, ScaleMap) else getattr(surface, "mesh", surface)
    if not len(mesh.faces):
        raise InputError("surface: expected a mesh with faces, got none")
    return mesh


def surface_samples(surface, count: int, device) -> NDArray:
    """Return about `count` world points (n, 3) float64 on a surface, evenly spread over its area, the same each time.

    Of a SLIM surface: random points of the leaves' discs of alpha r, within their footprints, moved onto the blend.
    """
    if isinstance(surface, Placed):
        local = surface_samples(surface.surface, count, device)
        return local @ surface.matrix[:3, :3].T + surface.matrix[:3, 3]
    random = np.random.default_rng(0)
    if isinstance(surface, SlimSurface):
        return project(surface, _disc_points(surface, count, random), device=device).position
    if isinstance(surface, StoredSurface):
        return project(surface, _stored_points(surface, count, random), device=device).position
    if isinstance(surface, SurfelHierarchy) and not surface.hybrid:
        return project(surface, _base_points(surface, count, random), device=device).position
    mesh = _as_mesh(surface)
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    area = np.nan_to_num(lengths_of(np.cross(b - a, c - a)))
    if not area.sum() > 0:
        raise InputError("surface: expected faces with some area, got none")
    face = random.choice(len(area), count, p=area / area.sum())
    u, v = random.uniform(size=(2, count, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face] + mesh.origin


def _base_points(surface: SurfelHierarchy, count: int, random) -> NDArray:
    """Return random world points (n, 3) of the base surfels' discs of alpha r, as many a unit of area everywhere."""
    base = surface.base
    area = np.nan_to_num(surface.radii[base]).astype(np.float64) ** 2
    if not area.sum() > 0:
        raise InputError("surface: expected at least one base surfel, got none")
    chosen = base[random.choice(len(base), count, p=area / area.sum())]
    reach = ALPHA * surface.radii[chosen] * np.sqrt(random.uniform(size=count))
    angle = random.uniform(0, 2 * np.pi, count)
    u, v = frame_of_normals(surface.normals[chosen].astype(np.float64))
    return (surface.positions[chosen] + (reach * np.cos(angle))[:, None] * u + (reach * np.sin(angle))[:, None] * v
            + surface.origin)


def _stored_points(stored: StoredSurface, count: int, random) -> NDArray:
    """Return random world points (n, 3) of the discs of a surface in its store, part by part."""
    leaves = stored.leaves()
    area = np.array([(leaves.leaves(part)[0].radii.astype(np.float64) ** 2).sum() for part in range(len(leaves))])
    counts = random.multinomial(count, area / area.sum())
    return np.concatenate([_disc_points(leaves.leaves(part)[0], int(counts[part]), random)
                           for part in np.flatnonzero(counts)])


def _disc_points(surface: SlimSurface, count: int, random) -> NDArray:
    """Return random world points (n, 3) of the leaves' discs, as many a unit of area everywhere."""
    leaf = np.flatnonzero(surface.leaf)
    if not len(leaf):
        raise InputError("surface: expected at least one leaf, got none")
    area = surface.radii[leaf].astype(np.float64) ** 2
    chosen = leaf[random.choice(len(leaf), count, p=area / area.sum())]
    share, angle = ALPHA * np.sqrt(random.uniform(size=count)), random.uniform(0, 2 * np.pi, count)
    u, v = share * np.cos(angle), share * np.sin(angle)
    if surface.footprint is not None:
        eighth = np.arange(8) * np.pi / 4
        inside = (u[:, None] * np.cos(eighth) + v[:, None] * np.sin(eighth)
                  <= surface.footprint[chosen] / 255.0).all(axis=1)
        chosen, u, v = chosen[inside], u[inside], v[inside]
    radius = surface.radii[chosen].astype(np.float64)
    u, v = u * radius, v * radius
    coefficients = surface.coefficients[chosen].astype(np.float64)
    w = (powers(u, v)[:, :coefficients.shape[1]] * coefficients).sum(axis=1)
    normal = surface.normals[chosen].astype(np.float64)
    axis_u, axis_v = frame_of_normals(normal)
    return (surface.centers[chosen] + u[:, None] * axis_u + v[:, None] * axis_v
            + np.clip(w, -radius, radius)[:, None] * normal + surface.origin)
