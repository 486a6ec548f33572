"""What sets a surfel's radius: the diagonal, lambda of paper 003 (equation 3), and the golden-ratio segments."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from .point_tree import BLOCK, PointTree, column_bounds

SAMPLES = 24_000  # points whose neighbours give lambda; fewer than 20 thousand scatter by several percent
LEAST_PENALTY = 1e-15  # of lambda T^2 over diagonal^4: above the rounding of e^2, so that exact data falls monotonously


def robust_box(points: NDArray) -> NDArray:
    """Return the bounding box (2, 3) float64 of `points` (n, 3) without far outliers.

    Where the box is much larger than that of the middle 99.8 % of a sample, the occupied cells of a 32^3 grid are
    joined to pieces; pieces with less than 0.1 % of the points are left out, and so on until nothing changes.
    """
    sample = points[:: max(1, len(points) // 20_000)]
    keep = points
    for _ in range(8):
        box = column_bounds(keep).astype(np.float64)
        if len(points) < 1000:
            return box
        middle = np.quantile(sample, (0.001, 0.999), axis=0)
        if np.linalg.norm(box[1] - box[0]) <= 1.3 * np.linalg.norm(middle[1] - middle[0]):
            return box
        width = max(float((box[1] - box[0]).max()), 1e-300)
        cell = np.minimum(((keep - box[0]) * (32 / width)).astype(np.int64), 31)
        flat = (cell[:, 0] * 32 + cell[:, 1]) * 32 + cell[:, 2]
        counts = np.bincount(flat, minlength=32**3)
        pieces, number = ndimage.label((counts > 0).reshape(32, 32, 32), structure=np.ones((3, 3, 3)))
        size = np.bincount(pieces.ravel(), counts, minlength=number + 1)
        inside = (size >= 0.001 * len(points))[pieces.ravel()[flat]]
        if inside.all() or not inside.any():
            return box
        keep = keep[inside]
    return column_bounds(keep).astype(np.float64)


@dataclass(frozen=True)
class Noise:
    """What the neighbourhoods of a scan say about it, over the diagonal (variance: squared).

    Attributes
    ----------
    variance : float
        lambda of the paper: the mean smallest eigenvalue of the covariance of ten neighbours.
    spacing : float
        Distance between neighbours of an even grid with the median density.
    """

    variance: float
    spacing: float


def measure_noise(tree: PointTree) -> Noise:
    """Return lambda and the point spacing from a sample of at least 20 thousand points, ten exact neighbours each."""
    blocks = tree.padded // BLOCK
    wanted = min(blocks, -(-SAMPLES // BLOCK))
    # Evenly spread blocks of the Morton order are spread over the surface.
    chosen = (np.arange(wanted) * blocks // wanted).astype(np.int32)
    neighbors = min(10, tree.count - 1)
    if neighbors < 3:
        return Noise(0.0, 1.0)
    spread, furthest2 = neighbour_spreads(tree, chosen)
    real = spread >= 0
    return noise_of(spread[real], furthest2[real], neighbors)


def neighbour_spreads(tree: PointTree, chosen: NDArray) -> tuple[NDArray, NDArray]:
    """Return the smallest eigenvalue of ten neighbours' covariance and the square of their reach, (c, BLOCK) each.

    `chosen` (c,) int32 are blocks of the tree, whose points are looked at; the first is -1 where there is none.
    """
    device = tree.device
    if device.loop_turns is not None:  # looking through the blocks may take more
        return _spreads_on_host(tree, chosen)
    spread, furthest2 = device.empty((len(chosen), BLOCK), np.float32), device.empty((len(chosen), BLOCK), np.float32)
    kernel = device.kernel("build/neighbor_spread.cl", constants={"NEIGHBORS": min(10, tree.count - 1)})
    kernel((len(chosen),), (1,), len(chosen), device.upload(chosen), *tree.arguments, 2.0 / math.sqrt(tree.count),
           spread, furthest2)
    return device.download(spread), device.download(furthest2)


def _spreads_on_host(tree: PointTree, chosen: NDArray) -> tuple[NDArray, NDArray]:
    points = tree.device.download(tree.sorted)[:3, :tree.count].T.astype(np.float64)
    index = chosen[:, None].astype(np.int64) * BLOCK + np.arange(BLOCK)
    real = index < tree.count
    apart, near = cKDTree(points).query(points[index[real]], min(10, tree.count - 1) + 1)
    local = points[near] - points[near].mean(axis=1, keepdims=True)
    spread, furthest2 = np.full(index.shape, -1, np.float32), np.zeros(index.shape, np.float32)
    spread[real] = np.maximum(np.linalg.eigvalsh(np.einsum("nki,nkj->nij", local, local) / near.shape[1])[:, 0], 0)
    furthest2[real] = apart[:, -1] ** 2
    return spread, furthest2


def noise_of(spread: NDArray, furthest2: NDArray, neighbors: int) -> Noise:
    """Return the noise of a scan from the points' values of `neighbour_spreads`."""
    median2 = float(np.median(furthest2))
    return Noise(float(spread.astype(np.float64).mean()), math.sqrt(median2 * math.pi / (neighbors + 0.5)))


def automatic_error(noise: Noise) -> float:
    """Return T_MDL for a scan of this noise: 3.5 point spacings.

    lambda already follows the noise, so that the penalty lambda T^2 / r^2 has the form of the noise that a fit of
    radius r leaves, sigma^2 (terms / points in the ball): T is a multiple of the spacing. 3.5 was the best for noisy
    scans (vertices projected onto the surface against the clean mesh).
    """
    return float(np.clip(3.5 * noise.spacing, 1e-4, 0.05))
