"""The points of a scan that have a surface around them: finite, distinct, with a normal."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..build.normals import distinct
from ..build.slim import estimated_normals, face_normals
from ..errors import InputError
from ..surface.arrays import finite_rows, lengths_of
from ..surface.mesh import Mesh

LEAST_POINTS = 6  # coefficients of a quadratic


@dataclass(frozen=True, eq=False)
class ScanPoints:
    """Distinct usable points, relative to the scan's origin, and which of the scan's points they are.

    Attributes
    ----------
    position, normals : (m, 3) float32
        Normals of any positive length.
    total : int
        The scan's points.
    kept : (k,) int or None
        Those that are usable; None: all.
    inverse : (k,) int or None
        The distinct point at the place of each of them; None: all are distinct.
    """

    position: NDArray
    normals: NDArray
    total: int
    kept: NDArray | None
    inverse: NDArray | None

    def spread(self, values: NDArray) -> NDArray:
        """Return `values` (m, ...) of the distinct points for all of the scan's (total, ...), NaN where not usable."""
        if self.inverse is not None:
            values = values[self.inverse]
        if self.kept is None:
            return values
        out = np.full((self.total, *values.shape[1:]), np.nan, values.dtype)
        out[self.kept] = values
        return out


def scan_points(scan, device) -> ScanPoints:
    """Return the usable points of a Mesh or PointCloud; raises InputError where fewer than 6 are left."""
    position, normals, total = scan.points, scan.normals, len(scan.points)
    usable = finite_rows(position)
    if np.count_nonzero(usable) < LEAST_POINTS:
        raise InputError(f"scan: expected at least {LEAST_POINTS} finite points for a curvature, got "
                         f"{np.count_nonzero(usable)}")
    if normals is None and isinstance(scan, Mesh) and len(scan.faces):
        normals = face_normals(position, scan.faces)
    if normals is None:
        normals = estimated_normals(scan, usable, device)
    with np.errstate(over="ignore", invalid="ignore"):
        length2 = np.einsum("ij,ij->i", normals, normals)
    usable &= (length2 > 0) & np.isfinite(length2)
    kept = None
    if not usable.all():
        kept = np.flatnonzero(usable)
        position, normals = position[kept], normals[kept]
    position, normals, inverse = _distinct(position, normals)
    if len(position) < LEAST_POINTS:
        raise InputError(f"scan: expected at least {LEAST_POINTS} different points with normals for a curvature, got "
                         f"{len(position)}")
    return ScanPoints(np.ascontiguousarray(position), np.ascontiguousarray(normals, np.float32), total, kept, inverse)


def _distinct(position, normals) -> tuple[NDArray, NDArray, NDArray | None]:
    """Return the distinct positions, the sums of their unit normals, and the place of each point among them."""
    places, inverse = distinct(position)
    if inverse is None:
        return position, normals, None
    unit = normals / lengths_of(normals, keepdims=True)
    sums = np.stack([np.bincount(inverse, unit[:, k], len(places)) for k in range(3)], axis=1)
    first = np.zeros(len(places), np.int64)
    first[inverse[::-1]] = np.arange(len(inverse))[::-1]
    opposed = np.einsum("ij,ij->i", sums, sums) < 1e-6  # two sheets that touch: the first one's normal
    sums[opposed] = unit[first[opposed]]
    return places, sums.astype(np.float32), inverse
