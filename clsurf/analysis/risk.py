"""Noise of a scan, and the radius at which a local fit errs least: the two-degree risk.

A fit of degree 2 over a disc of radius rho errs by what it smooths away (more with a larger rho) and by the noise (less
with a larger rho). The former shows in its difference from a fit of degree 4 at the same place, averaged over
neighbouring samples and less the part that the noise has in the difference; the latter is known from the noise level.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from ..build.point_tree import BLOCK, PointTree, lane_form
from ..build.radius import neighbour_spreads

SAMPLES = (1000, 8000)  # least and most, where there are so many points
POINTS_PER_SAMPLE = 48
RADII = 2.6 * 1.25 ** np.arange(11)  # over the point spacing, up to 24
WIDE = (9.0, 17.0)  # radii from which half of the samples and a quarter will do: wide balls overlap
NOISE_RADIUS = 4.0  # point spacings: the fit of degree 3 whose residual is the noise
NEIGHBORS = 24  # samples whose differences of degree 2 and 4 are averaged
# Variance of a fit over n points of a ball of radius rho under the weight (1 - d^2/rho^2)^3, in sigma^2 / (n rho^4) for
# the mean curvature and sigma^2 / n for the height: of degree 2 and of degree 4.
VARIANCE = {"curvature": (228.0, 2642.0), "height": (7.13, 14.08)}
OUT = 6  # sample_fits.cl


@dataclass(frozen=True, eq=False)
class Samples:
    """Points spread evenly over a scan, in the units of its tree.

    Attributes
    ----------
    index : (s,) int32
        Among the tree's sorted points.
    position, normals : (s, 3) float64
    spacing : (s,) float64
        Of the points around each sample: the side of an even grid of the same density.
    """

    index: NDArray
    position: NDArray
    normals: NDArray
    spacing: NDArray


@dataclass(frozen=True, eq=False)
class Fits:
    """Fits of degree 2 and 4 at samples with several radii each, in the tree's units.

    Attributes
    ----------
    radius, count : (s, r)
        Of the balls, and their points.
    curvature, height : (2, s, r)
        Mean curvature, and height over the sample along its normal, of degree 2 and 4.
    """

    radius: NDArray
    count: NDArray
    curvature: NDArray
    height: NDArray


def spread_samples(tree: PointTree, wanted: int | None = None) -> Samples:
    """Return about `wanted` samples (all points of a smaller scan), evenly spread along the Morton curve.

    By default one for every 48 points, 1000 to 8000.
    """
    if wanted is None:
        wanted = min(max(tree.count // POINTS_PER_SAMPLE, SAMPLES[0]), SAMPLES[1])
    blocks = tree.padded // BLOCK
    chosen = (np.arange(min(wanted, blocks)) * blocks // min(wanted, blocks)).astype(np.int32)
    spacing = local_spacings(tree, chosen)
    if wanted > blocks:  # every point, with the spacing of its block
        index = np.arange(tree.count) if tree.count <= wanted else np.arange(wanted) * tree.count // wanted
        spacing = spacing[index // BLOCK]
    else:
        index = np.minimum(chosen.astype(np.int64) * BLOCK + BLOCK // 2, tree.count - 1)
    rows = tree.device.download(tree.sorted, copy=False)[:6, index].astype(np.float64)
    return Samples(index.astype(np.int32), np.ascontiguousarray(rows[:3].T), np.ascontiguousarray(rows[3:].T), spacing)


def local_spacings(tree: PointTree, blocks: NDArray) -> NDArray:
    """Return the point spacing (b,) around `blocks` (b,) int32 of 16 points each: from their tenth neighbours."""
    neighbors = min(10, tree.count - 1)
    if neighbors < 3:
        return np.ones(len(blocks))
    spread, furthest2 = neighbour_spreads(tree, blocks)
    far2 = np.where(spread >= 0, furthest2, np.nan)
    spacing = np.sqrt(np.nanmedian(far2.astype(np.float64), axis=1) * np.pi / (neighbors + 0.5))
    typical = np.median(spacing)
    # Strays have no spacing of their own; copies of one point have none either.
    return np.clip(spacing, typical / 8, typical * 8) if typical > 0 else np.full(len(blocks), 1e-6)


def fit_samples(tree: PointTree, samples: Samples, radius: NDArray, residual: bool = False, skips: NDArray | None = None
                ) -> NDArray:
    """Return (s, r, 6) float64: points, mean curvature of degree 2 and 4, height of degree 2 and 4, squared residual.

    Parameters
    ----------
    radius : (s, r) float
        Of the balls.
    residual : bool
        Find the weighted mean square residual of degree 3 too (else 0).
    skips : (r,) int, optional
        Samples whose number has one of these bits are left out with that radius (0 points): 1 takes half, 3 a quarter.
    """
    device = tree.device
    skips = np.zeros(radius.shape[1], np.int32) if skips is None else np.asarray(skips, np.int32)
    out = device.empty((*radius.shape, OUT), np.float32)
    device.kernel("analysis/sample_fits.cl", constants={"RESIDUAL": int(residual), **lane_form(device)})(
        (radius.size,), (1,), len(radius), radius.shape[1], device.upload(samples.index),
        device.upload(np.ascontiguousarray(radius, np.float32)), device.upload(skips), *tree.arguments, out)
    return device.download(out).astype(np.float64)


def noise_level(tree: PointTree, samples: Samples) -> float:
    """Return the standard deviation sigma of the noise along the normal, in the tree's units.

    From the residuals of fits of degree 3 over 4 point spacings, the median of the samples; 0 where no sample has
    enough points.
    """
    found = fit_samples(tree, samples, (NOISE_RADIUS * samples.spacing)[:, None], residual=True)[:, 0]
    count, residual2 = found[:, 0], found[:, 5]
    enough = count > 18
    if not enough.any():
        return 0.0
    return float(np.sqrt(np.median(residual2[enough] * count[enough] / (count[enough] - 9))))


def two_degree_fits(tree: PointTree, samples: Samples, radii: NDArray = RADII) -> Fits:
    """Return the fits at all samples with `radii` (r,) over each one's spacing."""
    radius = samples.spacing[:, None] * radii
    found = fit_samples(tree, samples, radius, skips=np.select([radii < r for r in WIDE], (0, 1), 3))
    return Fits(radius, found[..., 0], np.moveaxis(found[..., 1:3], -1, 0), np.moveaxis(found[..., 3:5], -1, 0))


def least_risk_radius(samples: Samples, fits: Fits, sigma: float, quantity: str = "curvature") -> NDArray:
    """Return the radius (s,) of a degree-2 fit that errs least in `quantity`, "curvature" (mean) or "height".

    Radii are smoothed over the neighbouring samples. For the curvature a fit of degree 3 takes 1.25 times as much, one
    of degree 4 1.7 times on smooth surfaces (less where there is detail).
    """
    low, high = VARIANCE[quantity]
    values = fits.curvature if quantity == "curvature" else fits.height
    taken = fits.count > 0
    difference = np.abs(values[0] - values[1])
    usable = (fits.count >= 20) & np.isfinite(difference)
    mean = sample_means(samples)
    around = mean @ usable
    with np.errstate(divide="ignore", invalid="ignore"):
        count = np.where(taken, fits.count, (mean @ (fits.count * usable)) / around)
        scale = sigma**2 / count
        if quantity == "curvature":
            scale = scale / fits.radius**4
        # Of the mean absolute value, as if normally distributed: one crease must not decide for its neighbours.
        mean2 = (mean @ np.where(usable, difference, 0) / around) ** 2 * (np.pi / 2)
        risk = np.maximum(mean2 - (high - low) * scale, 0) + low * scale
    risk[(taken & ~usable) | ~np.isfinite(risk)] = np.inf
    best = np.argmin(risk, axis=1)
    log_radius = np.log(fits.radius[np.arange(len(best)), best])
    return np.exp(mean @ log_radius)


def sample_means(samples: Samples) -> sparse.csr_matrix:
    """Return the matrix (s, s) that averages values of the samples over each one's neighbours on its own sheet."""
    each, count = len(samples.index), min(NEIGHBORS, len(samples.index))
    near = cKDTree(samples.position).query(samples.position, count)[1].reshape(each, count)
    near[:, 0] = np.arange(each)  # copies of one point may have found each other
    weight = (np.einsum("ij,ikj->ik", samples.normals, samples.normals[near]) > 0.2).astype(np.float64)
    weight[:, 0] = 1
    weight /= weight.sum(axis=1, keepdims=True)
    return sparse.csr_matrix((weight.ravel(), near.ravel(), np.arange(0, weight.size + 1, count)), shape=(each, each))


def block_radii(tree: PointTree, samples: Samples, radius: NDArray) -> NDArray:
    """Return the radius (blocks,) float32 of every block of 16 sorted points, from the `radius` (s,) at samples."""
    blocks = tree.padded // BLOCK
    middle = np.minimum(np.arange(blocks) * BLOCK + BLOCK // 2, tree.count - 1)
    position = tree.device.download(tree.sorted, copy=False)[:3, middle].T
    count = min(4, len(samples.index))
    distance, near = cKDTree(samples.position).query(position, count)
    distance, near = distance.reshape(blocks, count), near.reshape(blocks, count)
    weight = 1 / np.maximum(distance, 1e-3 * distance.max(initial=0) + 1e-12)
    return np.exp((np.log(radius)[near] * weight).sum(axis=1) / weight.sum(axis=1)).astype(np.float32)


def with_mean_normals(tree: PointTree, reach: float) -> PointTree:
    """Return `tree` with normals averaged over `reach` (the tree's unit) on each point's own sheet."""
    device = tree.device
    out = device.empty((6, tree.padded), np.float32)
    device.kernel("analysis/average_normals.cl")((tree.padded // BLOCK,), (1,), *tree.arguments, reach, out)
    return replace(tree, sorted=out)
