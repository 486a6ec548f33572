"""How well patches cover the points of a scan, and whether points support what they show.

Two shares: of the scan's points that lie within two node spacings of the drawn surface, and of the drawn nodes that lie
within two point spacings of a point. The first falls where patches leave something out, the second where they invent
something. Both are counted over everything: no point and no patch is left out as an outlier.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

REACH = 2.0  # spacings
FINE = 8  # samples along a side of a cell where its corners alone do not decide


@dataclass(frozen=True)
class Coverage:
    """Figures of `coverage`; lengths in world units.

    Attributes
    ----------
    points_covered : float
        Share of the points within two node spacings of an opaque cell (one whose four nodes are opaque).
    nodes_supported : float
        Share of the opaque nodes within two point spacings of a point.
    node_spacing, point_spacing : float
        Median |a_x|, and median distance from a distinct point to the nearest other one.
    patches, nodes, opaque : int
        `nodes` counts the transparent ones too.
    nbytes : int
    """

    points_covered: float
    nodes_supported: float
    node_spacing: float
    point_spacing: float
    patches: int
    nodes: int
    opaque: int
    nbytes: int

    def __str__(self):
        return (f"points covered {self.points_covered:.3%}, nodes supported {self.nodes_supported:.3%}, node spacing "
                f"{self.node_spacing:.4g} = {self.node_spacing / self.point_spacing:.2f} point spacings, "
                f"{self.patches:,} patches, {self.nodes:,} nodes ({self.opaque:,} opaque), {self.nbytes / 1e6:.2f} MB")


def coverage(surface, points: NDArray, spacing: float | None = None) -> Coverage:
    """Measure how patches and points agree.

    Parameters
    ----------
    surface : PatchSurface
    points : (n, 3) float64
        World space, finite.
    spacing : float, optional
        The point spacing, where the scan knows it (range grids); `point_spacing` of the points by default.
    """
    points = np.asarray(points, np.float64) - surface.origin
    spacing = point_spacing(points) if spacing is None else float(spacing)
    step = node_spacing(surface)
    nodes = surface.positions() - surface.origin
    opaque = np.flatnonzero(np.isfinite(nodes[:, 0]))
    covered = np.isfinite(distance_to_cells(points, nodes, opaque_cells(surface), REACH * step))
    supported = cKDTree(points).query(nodes[opaque], distance_upper_bound=REACH * spacing)[0]
    return Coverage(float(covered.mean()), float(np.isfinite(supported).mean()) if len(opaque) else 1.0, step, spacing,
                    len(surface), surface.node_count, len(opaque), surface.nbytes)


def node_spacing(surface) -> float:
    """Return the median over the patches of |a_x|, world units."""
    return float(np.median(np.linalg.norm(surface.axis_x.astype(np.float64), axis=1)))


def point_spacing(points: NDArray) -> float:
    """Return the median distance from each distinct point of (n, 3) to the nearest other one."""
    points = np.unique(points, axis=0)
    return float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))


def opaque_cells(surface) -> NDArray:
    """Return the four nodes (c, 4) of every cell that is drawn, in the order (0, 0), (1, 0), (0, 1), (1, 1)."""
    patch, i, j = surface.node_patches()
    m, n = surface.size[patch].T.astype(np.int64)
    first = np.flatnonzero((i < m - 1) & (j < n - 1))
    step = m[first]
    corners = np.stack([first, first + 1, first + step, first + step + 1], axis=1)
    return corners[surface.opaque[corners].all(axis=1)]


def distance_to_cells(points: NDArray, nodes: NDArray, cells: NDArray, limit: float) -> NDArray:
    """Return the distance (n,) from `points` to bilinear cells, up to `limit`; infinity beyond it.

    The distance is that to the nearest of the cells' corners; where that is beyond the limit, to the nearest of 8 x 8
    samples of the cells around. It is never less than the true one.

    Parameters
    ----------
    points : (n, 3) float64
    nodes : (N, 3) float64
    cells : (c, 4) int
        Nodes of each cell, as from `opaque_cells`.
    """
    if not len(cells):
        return np.full(len(points), np.inf)
    used = np.unique(cells)
    distance = cKDTree(nodes[used]).query(points, distance_upper_bound=limit)[0]
    rest = np.flatnonzero(~np.isfinite(distance))
    if not len(rest):
        return distance
    corners = nodes[cells]
    middle = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    # Only cells near one of these points are sampled.
    gap = cKDTree(points[rest]).query(middle, distance_upper_bound=limit + reach.max())[0]
    corners = corners[gap <= limit + reach]
    if not len(corners):
        return distance
    s, t = (a.reshape(-1, 1) for a in np.meshgrid(np.linspace(0, 1, FINE), np.linspace(0, 1, FINE)))
    weights = np.concatenate([(1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t], axis=1)
    samples = np.einsum("sk,ckd->csd", weights, corners).reshape(-1, 3)
    distance[rest] = cKDTree(samples).query(points[rest], distance_upper_bound=limit)[0]
    return distance
