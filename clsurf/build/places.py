"""What meshes and points of a surface are made by: what they are asked for, how fine it is, where it is drawn."""

import math

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import InputError
from ..io.stored import StoredSurface
from ..surface.arrays import lengths_of
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.ranges import RangeScan
from ..surface.scale_map import ScaleMap
from ..surface.scale_mesh import scale_mesh
from ..surface.slim import SlimSurface
from ..surface.surfel import SurfelHierarchy
from ..trace.hits import trace

OF_RADIUS = 0.25  # the default spacing over the median radius of the leaves
SAMPLED_PARTS = 16  # of a surface in its store, whose radii stand for all


def checked_spacing(spacing) -> float | None:
    """Return a spacing, or None for one that is to be chosen; raises InputError."""
    if spacing is None:
        return None
    if isinstance(spacing, bool) or not isinstance(spacing, int | float | np.number) or not 0 < spacing < math.inf:
        raise InputError(f"spacing: expected a length in world units above 0, got {spacing!r:.60}")
    return float(spacing)


def check_surface(surface) -> None:
    """Raise InputError for what is no surface."""
    if isinstance(surface, PointCloud | RangeScan):
        raise InputError(f"surface: expected a surface, got a {type(surface).__name__}: make one with build_slim")
    if not isinstance(surface, SlimSurface | StoredSurface | PatchSurface | SurfelHierarchy | ScaleMap | Mesh):
        raise InputError("surface: expected a SlimSurface, StoredSurface, PatchSurface, SurfelHierarchy, ScaleMap or "
                         f"Mesh, or one of these placed, got {type(surface).__name__}")


def in_memory(surface):
    """Return a surface in its store as one in memory where its budget allows: five times as fast."""
    if isinstance(surface, StoredSurface):
        leaves = surface.leaves()
        parts = np.flatnonzero(np.isfinite(leaves.boxes).all(axis=(1, 2)))
        if leaves.cost(parts) <= surface.budget:
            return surface.load()
    return surface


def spacing_of(surface) -> float:
    """Return the spacing (world units) that shows what a surface holds; see `to_mesh`."""
    if isinstance(surface, StoredSurface):
        leaves = surface.leaves()
        full = np.flatnonzero(np.isfinite(leaves.boxes).all(axis=(1, 2)))
        some = full[np.linspace(0, len(full) - 1, min(len(full), SAMPLED_PARTS)).astype(int)]
        radii = np.concatenate([leaves.leaves(int(part))[0].radii for part in some])
    elif isinstance(surface, SlimSurface):
        radii = surface.radii[surface.leaf]
    elif isinstance(surface, SurfelHierarchy) and not surface.hybrid:
        if surface.spacing > 0:
            return float(surface.spacing)
        radii = surface.radii[surface.base] * 2
    else:
        return _edge_of(scale_mesh(surface) if isinstance(surface, ScaleMap) else getattr(surface, "mesh", surface))
    radii = radii[np.isfinite(radii) & (radii > 0)]
    if not len(radii):
        raise InputError("surface: expected at least one leaf, got none")
    return OF_RADIUS * float(np.median(radii))


def _edge_of(mesh: Mesh) -> float:
    """Return the root of twice the mean area of a mesh's faces: the edge of right angles of that area."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    area = np.nan_to_num(lengths_of(np.cross(b - a, c - a)))
    if not area.sum() > 0:
        raise InputError("surface: expected faces with some area, got none")
    return float(np.sqrt(area.mean()))


def oriented(surface) -> bool:
    """Return whether a surface's normals have a side."""
    if isinstance(surface, StoredSurface):
        return surface.read(0).oriented
    return getattr(surface, "oriented", True)


def drawn_at(surface, positions: NDArray, normals: NDArray, reach: float, device: Device) -> NDArray:
    """Return whether (n,) a surface is drawn within `reach` (world units) of places (n, 3) along their normals (n, 3).

    Projection knows the leaves' balls only, which go on beyond borders; what is drawn and traced ends with the leaves'
    footprints.
    """
    hits = trace(surface, positions + reach * normals, -normals, query="any", far=2 * reach, device=device)
    return hits.hit
