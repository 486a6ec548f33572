"""Surfels guided by normals: fits, their blend, and the radius of least risk at every point.

Fits and blend weigh points by distance and by the angle between normals, so that neither reaches over an edge. The
radius follows from the residuals alone (Stein's unbiased estimate of risk): the mean squared residual around a point,
plus twice the part of its noise that a point carries into the fit at its own place.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..build.point_tree import BLOCK, build_boxes, lane_form
from ..device import Device
from ..device.arrays import DeviceArray

SURFEL = 16  # floats a surfel (guided.clh)
ITEMS = (64,)  # work-group of kernels whose items share nothing and hold little
RADII = 2.2 * 1.22 ** np.arange(13)  # over the spacing, up to 24
FIRST_RADII = 7  # up to 7.3; larger ones are tried where more than LARGE_SHARE of the points take the largest
LARGE_SHARE = 0.25
NOISE_RADIUS = 2  # index of the radius (3.3 spacings) whose residuals give the noise level
# Leverage of a point on the blended surface at its own place, by the effective samples of the surfels there, measured
# on noisy planes: for scattered points, and for vertices whose faces are the samples. Below 7 and 14 samples by hand: a
# fit of few points passes through all of them.
LEVERAGE = {1.0: ([1.0, 3.0, 7.3, 11.2, 16.8, 25.0, 37.5, 56.0, 83.0, 124.0],
                  [1.0, 0.8, 0.45, 0.329, 0.224, 0.152, 0.1023, 0.0678, 0.0431, 0.0278]),
            2.0: ([1.0, 4.0, 8.0, 14.2, 21.2, 31.5, 46.1, 69.1, 103.5, 152.9],
                  [1.0, 0.9, 0.55, 0.335, 0.2605, 0.1937, 0.1404, 0.0965, 0.0648, 0.0438])}
SOFT = 0.01  # risks that differ by this much of the noise's variance count by 1 : 1/e in the mean radius
# Of means over neighbours: of squared residuals, of those that limit outliers, of radii.
RISK_ROUNDS, OUTLIER_ROUNDS, RADIUS_ROUNDS = 16, 6, 5
RADIUS_SHARE = 0.84  # of the radius of least risk of heights: normals ask for a little less bias
OUTLIER = 5.0  # times the residuals around; larger ones count as this
CLEARLY = (2.0, 4.0)  # ratios of noise variances
LEAST_NOISE = 1e-14  # of a scan of diagonal 1: float32 rounds to 6e-8
FIT_SHARE = 1.31  # residuals have 1 - FIT_SHARE leverage of the noise's variance: the fit itself 0.69 of its leverage
# Shapes with sharp edges: the excess of squared residuals at 4 spacings under weights that fall with the angle, over
# that under weights that hardly do, was 0.05 on fandisk, 0.1 on a noisy cube, 0.74 to 0.93 on five scans of statues.
EDGE_RADIUS, EDGE_BLIND, EDGE_SHARE = 3, 2.0, 0.4
NOISE_SHARE = 0.9  # of the noise's variance that is surely noise: the estimate is 0 to 15 % high
SHARP = 6.0  # of the weights of fits and blend, of shapes without sharp edges
# Every STEP k^2-th independent point is a centre, k the radius over the spacing: 15 surfels overlap at each point.
STEP, LAST_STEP = 0.25, 0.1  # while radii are chosen; for the result, 0.5 % less error


@dataclass(eq=False)
class Samples:
    """Points with normals and weights on a device, sorted along a curve, with the tree over them.

    Attributes
    ----------
    sorted : DeviceArray (7, padded) float32
        Position, unit normal, weight; the last block is padded far away.
    spacing : (n,) float32
        Edge length of an even triangle mesh as dense as the points around each.
    points_per_vertex : float
        Samples that one independent measurement makes: 2 for the faces of a mesh, 1 for scattered points.
    """

    device: Device
    count: int
    padded: int
    sorted: DeviceArray
    boxes: DeviceArray
    node_offset: DeviceArray
    top_level: int
    spacing: NDArray
    points_per_vertex: float

    @property
    def arguments(self) -> tuple:
        """The kernel arguments of a ball query."""
        return self.padded, self.sorted, self.boxes, self.node_offset, self.top_level


@dataclass(eq=False)
class Rings:
    """Lists of the neighbours of every point, on a device."""

    device: Device
    count: int
    offset: DeviceArray  # (n + 1,) int32
    near: DeviceArray  # int32

    def means(self, values: NDArray, rounds: int) -> NDArray:
        """Return `values` (c, n), c at most 16, averaged over neighbours `rounds` times, (c, n) float32."""
        device, rows = self.device, len(values)
        wide = np.zeros((self.count, 16), np.float32)
        wide[:, :rows] = values.T
        a, b = device.upload(wide), device.empty(wide.shape, np.float32)
        kernel = device.kernel("analysis/ring_means.cl")
        for _ in range(rounds):
            kernel((self.count,), ITEMS, self.count, self.offset, self.near, a, b)
            a, b = b, a
        return np.ascontiguousarray(device.download(a, copy=False)[:, :rows].T)


@dataclass(eq=False)
class Fits:
    """Surfels on a device, with the tree over their balls."""

    device: Device
    sharp: float
    records: DeviceArray  # (m, SURFEL) float32
    balls: DeviceArray  # (4, padded) float32
    padded: int
    boxes: DeviceArray
    node_offset: DeviceArray
    top_level: int


@dataclass(eq=False)
class Queries:
    """Points with normals where fits are blended; neighbours stand together."""

    count: int
    stride: int
    arrays: DeviceArray  # at least (6, stride) float32: position, unit normal


def lanes_size(device: Device) -> tuple[int]:
    """Return a work-group size for kernels of VW lanes: those with large private arrays need 1 on CPUs."""
    return (64,) if device.lanes == 1 and device.kind != "cpu" else (1,)


def packets(device: Device, count: int) -> int:
    """Return how many work-items `count` points take."""
    return -(-count // lane_form(device)["VW"])


def queries_of(points: NDArray, normals: NDArray, device: Device) -> Queries:
    """Put points and unit normals (n, 3) on the device."""
    stride = -(-len(points) // BLOCK) * BLOCK
    arrays = np.zeros((6, stride), np.float32)
    arrays[:3, :len(points)], arrays[3:, :len(points)] = points.T, normals.T
    return Queries(len(points), stride, device.upload(arrays))


def centers_of(samples: Samples, radii: NDArray, step: float = STEP) -> NDArray:
    """Return indices (m,) int32 of samples as centres of balls of `radii` (n,)."""
    share = 1.0 / np.maximum(step * samples.points_per_vertex * (radii / samples.spacing) ** 2, 1.0)
    steps = np.floor(np.cumsum(share, dtype=np.float64))
    chosen = np.flatnonzero(np.diff(steps, prepend=-1.0) > 0)
    return chosen.astype(np.int32)


def guided_fits(samples: Samples, radii: NDArray, sharp: float, step: float = STEP) -> Fits:
    """Fit surfels of `radii` (n,), given at every sample, at a sparse choice of the samples.

    Parameters
    ----------
    sharp : float
        Weights fall with exp(-sharp (1 - cosine of the normals)).
    step : float
        Density of the centres, see `STEP`.
    """
    device = samples.device
    center = centers_of(samples, radii, step)
    radius = np.ascontiguousarray(radii[center], np.float32)
    count, padded = len(center), -(-len(center) // BLOCK) * BLOCK
    records = device.empty((padded, SURFEL), np.float32)
    device.kernel("analysis/guided_fits.cl", constants=lane_form(device))(
        (packets(device, count),), lanes_size(device), count, device.upload(center), device.upload(radius), sharp / 8,
        *samples.arguments, records)
    balls = device.empty((4, padded), np.float32)
    device.kernel("analysis/guided_balls.cl")((padded,), ITEMS, count, padded, records, balls)
    radius_of = np.full(padded, -1, np.float32)
    radius_of[:count] = radius
    boxes, node_offset, top_level = build_boxes(balls, padded, device, radius=device.upload(radius_of))
    return Fits(device, sharp, records, balls, padded, boxes, node_offset, top_level)


def blended(fits: Fits, queries: Queries) -> NDArray:
    """Return (5, n) float32: signed offset from the blended surface, unit normal, effective points."""
    device = fits.device
    out = device.empty((5, queries.count), np.float32)
    device.kernel("analysis/guided_blend.cl", constants=lane_form(device))(
        (packets(device, queries.count),), lanes_size(device), queries.count, queries.stride, queries.arrays,
        fits.sharp / 8, fits.records, fits.padded, fits.balls, fits.boxes, fits.node_offset, fits.top_level,
        queries.count, out)
    return device.download(out, copy=False)


def leverage(points: NDArray, points_per_vertex: float) -> NDArray:
    """Return the share of a point's own noise in the blended surface there, for effective samples (n,)."""
    samples, share = LEVERAGE[points_per_vertex]
    beyond = share[-1] * samples[-1] / np.maximum(points, 1.0)
    return np.where(points > samples[-1], beyond, np.interp(points, samples, share)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Choice:
    """The radius of least risk at every query, over the spacing there, and the noise level."""

    factor: NDArray  # (n,) float32
    noise: float
    excess: float  # see `excess_of`


def choose_radii(samples: Samples, queries: Queries, rings: Rings, sharp: float) -> Choice:
    """Estimate the noise and find the radius of least risk at every query.

    Parameters
    ----------
    queries : Queries
        The independent measurements: vertices of a mesh, or the scattered points.
    rings : Rings
        Neighbours of the queries.
    """
    residual2, own = [], []
    for k, factor in enumerate(RADII):
        offset, _, _, _, points = blended(guided_fits(samples, factor * samples.spacing, sharp), queries)
        residual2.append(offset * offset)
        own.append(leverage(points, samples.points_per_vertex))
        if k < FIRST_RADII - 1:
            continue
        if k == FIRST_RADII - 1:
            noise2 = noise_variance(residual2[NOISE_RADIUS], own[NOISE_RADIUS])
            limit = OUTLIER**2 * rings.means(residual2[NOISE_RADIUS][None], OUTLIER_ROUNDS)
        mean2, share = rings.means(np.minimum(np.stack(residual2), limit), RISK_ROUNDS), np.stack(own)
        risk = mean2 / local_noise(mean2, share, noise2) + 2 * share
        weight = np.exp((risk.min(axis=0) - risk) / np.float32(SOFT))
        weight /= weight.sum(axis=0)
        if weight[-1].mean() < LARGE_SHARE:
            break
    factor = np.exp(rings.means((np.log(RADII[:len(weight)]) @ weight)[None], RADIUS_ROUNDS)[0])
    return Choice(RADIUS_SHARE * factor, float(np.sqrt(noise2)),
                  excess_of(residual2[EDGE_RADIUS], own[EDGE_RADIUS], noise2))


def local_noise(mean2: NDArray, own: NDArray, noise2: float) -> NDArray:
    """Return the noise variance (n,) at every query: the scan's, unless the place speaks clearly against it.

    Generalised cross-validation tells the noise from mean squared residuals (r, n) of fits with leverage `own`. Taken
    everywhere it costs 1 % of error on evenly noisy meshes; so the scan's noise stands where the two agree to
    CLEARLY[0], and the place's own where they differ by more than CLEARLY[1].
    """
    here = np.maximum((mean2 / np.maximum(1 - own, 0.2) ** 2).min(axis=0), LEAST_NOISE)
    away = np.log(here / noise2)
    low, high = np.log(CLEARLY)
    return noise2 * np.exp(away * np.clip((np.abs(away) - low) / (high - low), 0, 1))


def excess_of(residual2: NDArray, own: NDArray, noise2: float) -> float:
    """Return the mean squared residual beyond what noise leaves of itself, over the noise variance; at least 0."""
    left = NOISE_SHARE * (1 - FIT_SHARE * own.mean())
    return max(float(np.minimum(residual2, OUTLIER**2 * noise2).mean() / noise2 - left), 0.0)


def has_edges(samples: Samples, queries: Queries, choice: Choice) -> bool:
    """Whether most of what smooth fits cannot follow goes when weights fall with the angle: sharp edges, flat faces."""
    fits = guided_fits(samples, RADII[EDGE_RADIUS] * samples.spacing, EDGE_BLIND)
    offset, _, _, _, points = blended(fits, queries)
    own = leverage(points, samples.points_per_vertex)
    return choice.excess < EDGE_SHARE * excess_of(offset * offset, own, choice.noise**2)


def noise_variance(residual2: NDArray, own: NDArray) -> float:
    """Return the noise variance from squared residuals (n,) of fits with leverage `own`; never 0."""
    # 0.455: the median of a squared unit normal variable.
    found = float(np.median(residual2 / np.maximum(1 - FIT_SHARE * own, 0.1))) / 0.455
    return max(found, LEAST_NOISE)
