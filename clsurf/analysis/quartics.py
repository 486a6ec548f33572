"""Sparse surfels of degree 4 that cover a scan, and the blending of their derivatives."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..build.point_tree import BLOCK, PointTree, build_boxes, lane_form
from ..device import Device
from ..device.arrays import DeviceArray

DEGREE = 4
# Radius of the surfels over the best one of degree 2. 1.5, 1.65, 1.7: torus with 0.1 % noise 0.0226, 0.0186, 0.0173, a
# sheet with ridges and waves 0.154, 0.211, 0.223.
RADIUS_RATIO = 1.65
# Distance between their centres over their radius, of exact points and of noisy ones. Closer ones average more (torus
# with 0.1 % noise 0.0197 and 0.0187) for twice the fits, which are few where there is noise.
SPACING = (0.35, 0.25)
NOISY = 0.1  # point spacings of noise from which on points count as noisy, gradually
PLAIN = (3.0, 0.02)  # times the noise, and point spacings: a fit that leaves no more has no outliers
GROWTH = 3.0  # times that a ball with too few points may grow
TINY = 100  # points of a scan whose balls may grow to hold all of it
# Added to the terms of degree 3 and 4 of noisy points on the diagonal, over the sum of weights: at rims, where the
# points hardly show these terms, the noise in them grows a hundredfold. Part of a torus with 0.1 % noise: RMS 0.0251 to
# 0.0233, largest error 0.35 to 0.25; inside no difference.
RIDGE = (0.003, 0.008)
OUT = 16  # floats a point of point_curvature.cl
SURFEL, LEAF = 32, 24  # floats a record of fit_quartics.cl, and of a SLIM surface's leaf (build/project.py)


@dataclass(eq=False)
class SurfelTree:
    """Local surfaces on a device and a tree over their balls; coordinates (x - middle) / unit.

    Attributes
    ----------
    degree : int
        4: records of fit_quartics.cl, coefficients over the radius; 2 or 3: those of `build.project.leaf_tree`.
    """

    device: Device
    degree: int
    records: DeviceArray  # (n, SURFEL or LEAF) float32
    padded: int
    balls: DeviceArray  # (4, padded) float32: centre and radius, -1 for what is no surfel
    boxes: DeviceArray
    node_offset: DeviceArray
    top_level: int


def fit_surfels(tree: PointTree, block_radius: NDArray, noise: float = 0.0, spacing: float = 1.0) -> SurfelTree:
    """Return surfels of degree 4 that cover the points.

    Parameters
    ----------
    block_radius : (blocks,) float32
        Of the surfels in every block of 16 points, in the tree's units.
    noise : float
        Its standard deviation over the point spacing.
    spacing : float
        Of the points, in the tree's units.
    """
    device = tree.device
    noisy = min(1.0, noise / NOISY) ** 2
    share = SPACING[0] + noisy * (SPACING[1] - SPACING[0])
    centers = device.upload(spread_centers(tree, share * block_radius))
    count = len(centers)
    padded = -(-count // BLOCK) * BLOCK
    growth = max(GROWTH, 2 / float(block_radius.min())) if tree.count < TINY else GROWTH
    records, balls = device.empty((padded, SURFEL), np.float32), device.empty((4, padded), np.float32)
    device.kernel("analysis/fit_quartics.cl", constants=lane_form(device))(
        (padded,), (1,), count, padded, centers, device.upload(block_radius), growth, noisy * RIDGE[0],
        noisy * RIDGE[1], max(PLAIN[0] * noise, PLAIN[1]) * spacing, *tree.arguments, records, balls)
    radius = device.upload(device.download(balls)[3])
    return SurfelTree(device, DEGREE, records, padded, balls, *build_boxes(balls, padded, device, radius=radius))


def spread_centers(tree: PointTree, spacing: NDArray) -> NDArray:
    """Return the sorted points (m,) int32, ascending, that are centres; `spacing` (blocks,) float32."""
    device = tree.device
    first, end, colors = tree.cells(float(spacing.max()) * 1.001)
    first, end, spacing = device.upload(first), device.upload(end), device.upload(spacing)
    covered, chosen = device.zeros(tree.padded, np.uint8), device.zeros(tree.padded, np.uint8)
    choose = device.kernel("analysis/spread_centers.cl")
    for start, stop in itertools.pairwise(colors):
        choose((stop - start,), (1,), stop - start, start, first, end, spacing, *tree.arguments, covered, chosen)
    return np.flatnonzero(device.download(chosen, copy=False)[:tree.count]).astype(np.int32)


def evaluate(surfels: SurfelTree, queries: DeviceArray, order: NDArray, stride: int, steps: int) -> NDArray:
    """Return position, normal and curvature (n, 16) float32 at points (point_curvature.cl), in the rows `order` (n,).

    Parameters
    ----------
    queries : DeviceArray
        At least (6, stride) float32, of which n columns count: positions and normals; neighbours should stand
        together.
    steps : int
        Newton steps onto the blend first.
    """
    quartic = surfels.degree == DEGREE
    constants = {"DEGREE": surfels.degree, "SURFEL": SURFEL if quartic else LEAF, "RADIUS_UNITS": int(quartic),
                 "STEPS": steps}
    device = surfels.device
    kernel, rows = device.kernel("analysis/point_curvature.cl", constants=constants), device.rows_at_once(4 * OUT)

    def values_of(first: int, order: NDArray) -> NDArray:
        out = device.empty((len(order), OUT), np.float32)
        kernel((-(-len(order) // BLOCK),), (1,), len(order), first // BLOCK, stride, queries, device.upload(order),
               surfels.records, surfels.padded, surfels.balls, surfels.boxes, surfels.node_offset, surfels.top_level,
               out)
        return device.download(out)

    if len(order) <= rows:
        return values_of(0, order)
    values = np.empty((len(order), OUT), np.float32)
    for first in range(0, len(order), rows):
        own = order[first:first + rows]
        values[own] = values_of(first, np.arange(len(own), dtype=np.int32))
    return values
