"""Range images directly to spatial patches: no mesh, and no surface where there was no sample.

Every image is divided into fragments (range_fragments), each of which becomes a patch in the plane of its mean normal,
its nodes taken from the image's own cells. Where images overlap, nodes are the weighted mean of those that agree, and
patches that others cover are left out. (The paper on spatial patches calls this direct way from scanner to screen its
motive, and future work: section 6.)
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..device import Device
from ..errors import InputError
from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface
from ..surface.ranges import RangeScan
from .quantize import quantized
from .range_fields import RangeField, coarser, range_field, raw_samples, sample_spacing
from .range_fragments import SPACING, Fragments, find_fragments, margin_of

log = logging.getLogger("clsurf")

PLACE = 13  # floats of patch_place.clh
REACH = 4  # cells around its fragment that a patch of a single image looks at
# Heights that agree, over the node spacing: the bunny's scans lie 0.3 spacings apart, its ears are 6 thick.
TOLERANCE = 2.0
NOISE_TOLERANCE = 3.0  # the same over the sensor's noise
INSIDE = 0.6  # nodes by which a patch goes on around a sample that counts as covered by it
# Share of a patch's samples that may be lost with it. 0, 1, 3 %: 4529, 4104, 3526 patches of the happy scans; 119, 146,
# 187 pixels of pinholes in three views; coverage 99.92 % with each.
LOST = 0.01
BATCH = 2048  # patches resampled at once
CELL_TURNS = 12  # of resample_ranges.cl's loops for a cell of a rect
BOUND_SHARE = 0.99  # of the samples within the tolerance of a patch: the share of them that the bound is given for
LEAST_NODES = 4  # a patch whose nodes all lie on the border of its fragment would have none on it
TRIALS, COUNT_SLACK = 4, 0.05  # where a number of patches is asked for, and how near to it is near enough
COARSENINGS = (8, 4, 2, 1)  # spacings tried where an error is asked for
FULL = 100  # code of a distance that equals the tolerance (range_distances.cl)


@dataclass(eq=False)
class Places:
    """Frames of patches: node (0, 0) at height 0 (p, 3), unit axes (p, 3, 3), steps (p, 2), tolerance (p,)."""

    corner: NDArray
    axes: NDArray
    steps: NDArray
    tolerance: NDArray

    def __getitem__(self, which) -> "Places":
        return Places(self.corner[which], self.axes[which], self.steps[which], self.tolerance[which])

    def packed(self) -> NDArray:
        """Return (p, 13) float32 as patch_place.clh has them."""
        return np.concatenate([self.corner, self.axes[:, 0] / self.steps[:, :1], self.axes[:, 1] / self.steps[:, 1:],
                               self.axes[:, 2], self.tolerance[:, None]], axis=1).astype(np.float32)


def convert(scan: RangeScan, request, device: Device, progress) -> PatchSurface:
    """Return the patches of range images; see `clsurf.build.patches.build_patches`."""
    if not isinstance(scan, RangeScan):
        raise InputError(f"scan: method 'ranges' expects a RangeScan, got a {type(scan).__name__}")
    if not scan.sample_count:
        raise InputError("scan: expected range images with samples, got only empty ones")
    if min(request.nodes) < LEAST_NODES:
        raise InputError(f"nodes: expected at least {LEAST_NODES} each way for range images, got {min(request.nodes)}")
    gap = sample_spacing(scan)
    if request.spacing is not None or (request.patches is None and request.error is None) or not gap > 0:
        return _converted(scan, request, request.spacing or SPACING * gap, device, progress)
    if request.patches is not None:
        return _with_count(scan, request, SPACING * gap, device, progress)
    return _with_error(scan, request, SPACING * gap, device, progress)


def _with_count(scan, request, spacing: float, device, progress) -> PatchSurface:
    """Return the surface whose number of patches comes nearest to the one asked for, of four trials."""
    best = None
    for trial in range(TRIALS):
        surface = _converted(scan, request, spacing, device, lambda f, what, t=trial: progress((t + f) / TRIALS, what))
        if best is None or abs(len(surface) - request.patches) < abs(len(best) - request.patches):
            best = surface
        if abs(len(surface) - request.patches) <= COUNT_SLACK * request.patches:
            break
        spacing *= (len(surface) / request.patches) ** 0.5
    return best


def _with_error(scan, request, spacing: float, device, progress) -> PatchSurface:
    """Return the coarsest surface, of nodes 8, 4, 2 and 1 spacings apart, that keeps the error, or the finest."""
    for trial, times in enumerate(COARSENINGS):
        step = lambda f, what, t=trial: progress((t + f) / len(COARSENINGS), what)  # noqa: E731
        try:
            surface, error = _measured(scan, request, times * spacing, device, step)
        except InputError:
            if times == COARSENINGS[-1]:
                raise
            continue
        if error <= request.error:
            return surface
    log.warning("error: %.3g of the diagonal was asked for, the samples allow %.3g", request.error, error)
    return surface


def _converted(scan, request, spacing, device, progress) -> PatchSurface:
    return _measured(scan, request, spacing, device, progress)[0]


def _measured(scan: RangeScan, request, spacing: float, device: Device, progress) -> tuple[PatchSurface, float]:
    """Return the patches with nodes `spacing` apart, and their root mean square distance over the diagonal."""
    progress(0.0, "samples")
    gap, nodes = sample_spacing(scan), request.nodes
    times = max(1, round(spacing / (SPACING * gap))) if gap > 0 else 1
    scan = coarser(scan, times)
    ratio = spacing / (times * gap) if gap > 0 else SPACING
    field = range_field(scan, device, lambda done: progress(0.3 * done, "samples"))
    progress(0.3, "fragments")
    fragments = find_fragments(field, nodes, ratio, device)
    places = places_of(field, fragments, nodes, ratio)
    if len(fragments) and request.spacing is not None:  # slanted views stretch samples: once more, by how much they do
        ratio *= min(1.0, spacing / float(np.median(places.steps)))
        fragments = find_fragments(field, nodes, ratio, device)
        places = places_of(field, fragments, nodes, ratio)
    if not len(fragments):
        raise InputError("scan: expected samples that form a surface, got only scattered ones")
    progress(0.5, "nodes")
    kept = np.arange(len(fragments))
    own = own_rects(field, fragments, kept)
    heights, colors = resampled(field, fragments, places, kept, own, nodes, device)
    pairs = np.column_stack([kept, fragments.rects, kept]).astype(np.int32)
    if len(scan) > 1:
        progress(0.6, "overlaps")
        pairs = fragment_pairs(fragments, places, nodes)
        kept = np.flatnonzero(needed(field, fragments, places, pairs, heights, nodes, device))
        progress(0.8, "blending")
        pairs = pairs[np.isin(pairs[:, 0], kept)]
        pairs[:, 0] = np.searchsorted(kept, pairs[:, 0])
        others = pairs[pairs[:, 1] != fragments.rects[kept[pairs[:, 0]], 0]]
        around = np.concatenate([own_rects(field, fragments, kept), others])
        places, around = places[kept], around[np.argsort(around[:, 0], kind="stable")]
        heights, colors = resampled(field, fragments, places, kept, around, nodes, device)
    bound = bound_of(scan, field, fragments, places, pairs, heights, nodes, device)
    drawn = np.isfinite(heights).any(axis=1)
    places, heights = places[drawn], heights[drawn]
    if colors is not None:
        colors = colors[drawn].reshape(-1, 4)[:, :4 if request.precise else 3]
    axes = places.axes[:, :2] * places.steps[..., None]
    surface = quantized(places.corner, axes[:, 0], axes[:, 1], heights.ravel().astype(np.float64), nodes, colors,
                        request.precise, origin=field.origin, diagonal=field.diagonal, bound_share=bound.share)
    rounding = float(surface.axis_z_length.max(initial=0)) / 2
    progress(1.0, "done")
    return replace(surface, bound=bound.distance + rounding, bound_all=bound.largest + rounding), \
        bound.mean_square ** 0.5 / field.diagonal


def places_of(field: RangeField, fragments: Fragments, nodes, ratio: float) -> Places:
    """Return the frames of the fragments' patches, each centred over its fragment."""
    inner = np.array([count - 1 - 2 * margin_of(count) for count in nodes])
    z, x = fragments.normal.astype(np.float64), fragments.along.astype(np.float64)
    z /= lengths_of(z, keepdims=True)
    x -= np.einsum("ij,ij->i", x, z)[:, None] * z
    x /= lengths_of(x, keepdims=True)
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    extent = fragments.extent[:, :2].astype(np.float64)
    steps = np.maximum(np.ptp(extent, axis=2) / inner, ratio * fragments.sample_steps.min(axis=1, keepdims=True))
    start = extent.mean(axis=2) - steps * (np.array(nodes) - 1) / 2
    corner = fragments.center + start[:, :1] * axes[:, 0] + start[:, 1:] * axes[:, 1]
    image = fragments.rects[:, 0]
    distance = np.where(field.squared[image], lengths_of(fragments.center - field.eyes[image]), 1.0)
    tolerance = np.maximum(TOLERANCE * np.sqrt(steps.prod(axis=1)), NOISE_TOLERANCE * field.noise[image] * distance**2)
    return Places(corner, axes, steps, tolerance)


def own_rects(field: RangeField, fragments: Fragments, which: NDArray) -> NDArray:
    """Return what patches see of their own image: (k, 7) int32 as `fragment_pairs` has them, patches by `which`."""
    rects = fragments.rects[which]
    low = np.maximum(rects[:, 1:3] - REACH, 0)
    high = np.minimum(rects[:, 1:3] + rects[:, 3:] + REACH, field.shapes[rects[:, 0]] - 1)
    return np.concatenate([np.arange(len(which))[:, None], rects[:, :1], low, high - low, np.full((len(which), 1), -1)],
                          axis=1).astype(np.int32)


def fragment_pairs(fragments: Fragments, places: Places, nodes) -> NDArray:
    """Return which fragments lie at which patches.

    Returns
    -------
    (k, 7) int32
        Patch, and the fragment's image, first row, first column, rows, columns and number; sorted in this order.
    """
    extent = fragments.extent.astype(np.float64)
    middle = fragments.center + np.einsum("fa,fai->fi", extent.mean(axis=2), places.axes)
    half = np.ptp(extent, axis=2) / 2
    # The patch's box: its nodes, and the heights of its own fragment with those within the tolerance of them.
    box = np.column_stack([places.steps * (np.array(nodes) - 1) / 2, half[:, 2] + places.tolerance])
    reach, radius = lengths_of(box), lengths_of(half)
    found = []
    for ours, theirs in ((a, b) for a in _by_size(reach) for b in _by_size(radius)):
        near = cKDTree(middle[ours]).sparse_distance_matrix(
            cKDTree(middle[theirs]), reach[ours].max() + radius[theirs].max(), output_type="ndarray")
        patch, fragment = ours[near["i"]], theirs[near["j"]]
        within = near["v"] <= reach[patch] + radius[fragment]
        patch, fragment = patch[within], fragment[within]
        offset = np.einsum("pi,pai->pa", middle[fragment] - middle[patch], places.axes[patch])
        within = (np.abs(offset) <= box[patch] + radius[fragment, None]).all(axis=1)
        found.append(np.stack([patch[within], fragment[within]], axis=1))
    patch, fragment = np.concatenate(found).T
    order = np.lexsort((fragment, fragments.rects[fragment, 0], patch))
    patch, fragment = patch[order], fragment[order]
    return np.concatenate([patch[:, None], fragments.rects[fragment], fragment[:, None]], axis=1).astype(np.int32)


def _by_size(lengths: NDArray) -> list[NDArray]:
    """Return the indices of lengths that are alike within a factor of two: wide ones are searched for on their own."""
    size = np.floor(np.log2(np.maximum(lengths, 1e-30))).astype(int)
    return [np.flatnonzero(size == one) for one in np.unique(size)]


def resampled(field: RangeField, fragments: Fragments, places: Places, labels: NDArray, pairs: NDArray, nodes,
              device: Device) -> tuple[NDArray, NDArray | None]:
    """Resample patches, each from its own fragment (`labels`) and the cells of its `pairs` around.

    Return heights (p, nodes) float32, NaN where no cell is, and colours (p, nodes, 4) uint8 or None."""
    m, n = nodes
    count, colored = len(labels), field.colors is not None
    planes = 11 if colored else 5
    batch = max(1, min(count, BATCH, (1 << 28) // (4 * planes * m * n)))
    device.check_memory(nodes=count * m * n * (8 if colored else 4), scratch=4 * batch * planes * m * n)
    first = np.searchsorted(pairs[:, 0], np.arange(count + 1)).astype(np.int32)
    scratch = device.empty((batch, planes, n * m), np.float32)
    heights = device.empty((count, n * m), np.float32)
    colors = device.empty((count, n * m, 4) if colored else (1, 4), np.uint8)
    kernel = device.kernel("build/resample_ranges.cl", constants={"M": m, "N": n, "COLORED": int(colored)})
    arguments = (device.upload(places.packed()), device.upload(labels, np.int32), device.upload(first),
                 device.upload(pairs[:, 1:]), device.upload(field.image_table[:, :3]), field.samples,
                 device.upload(field.cells), device.upload(fragments.labels),
                 device.upload(field.colors) if colored else colors, scratch, heights, colors)
    launches = _launches(device, pairs, first)
    for start in range(0, count, batch):
        size = min(batch, count - start)
        for launch in launches:
            kernel((size,), (1,), size, start, *launch, *arguments)
    return device.download(heights), device.download(colors) if colored else None


def _launches(device: Device, pairs: NDArray, first: NDArray) -> list[tuple[int, int, int, int]]:
    """Return pass, first and last rect + 1, and whether it is the pass' last, of resample_ranges.cl's launches."""
    most = int(np.diff(first).max(initial=1))
    if device.loop_turns is None:
        return [(-1, 0, most, 1)]
    step = max(device.loop_turns // (CELL_TURNS * int(pairs[:, 4:6].prod(axis=1).max(initial=1))), 1)
    return [(only, begin, min(begin + step, most), int(begin + step >= most)) for only in (0, 1)
            for begin in range(0, most, step)]


def needed(field: RangeField, fragments: Fragments, places: Places, pairs: NDArray, heights: NDArray, nodes,
           device: Device) -> NDArray:
    """Return which patches (p,) bool stay.

    One after the other, the worst seen first, a patch goes if the others cover (nearly) all that it covers.

    A sample is covered by a patch that goes on around it, within the tolerance of it; at borders, where no patch does,
    by one that holds it at all.
    """
    codes, counts = distances(field, fragments, places, pairs, heights, nodes, field.samples, device)
    near = (codes & 127) <= FULL
    at = np.flatnonzero(near)
    pair, sample = _samples_at(field, pairs, counts, at)
    strict = codes[at] >= 128
    inside = np.zeros(len(field.cells), bool)
    inside[sample[strict]] = True
    counts = strict | ~inside[sample]
    sample, patch = sample[counts], pairs[pair[counts], 0]
    first = np.searchsorted(patch, np.arange(len(fragments) + 1))
    covered = np.bincount(sample, minlength=len(field.cells))
    keep = np.diff(first) > 0
    for p in np.argsort(fragments.weight, kind="stable"):
        own = sample[first[p]:first[p + 1]]
        if keep[p] and (covered[own] == 1).sum() <= LOST * len(own):
            keep[p] = False
            covered[own] -= 1
    return keep


def _samples_at(field: RangeField, pairs: NDArray, counts: NDArray, at: NDArray) -> tuple[NDArray, NDArray]:
    """Return the pair and the sample of the codes number `at`, ascending."""
    ends = np.cumsum(counts)
    pair = np.repeat(np.arange(len(pairs)), np.diff(np.searchsorted(at, np.concatenate([[0], ends]))))
    row, column = np.divmod(at - (ends - counts)[pair], pairs[pair, 5] + 1)
    image = pairs[pair, 1]
    return pair, field.first[image] + (pairs[pair, 2] + row) * field.shapes[image, 1] + pairs[pair, 3] + column


def distances(field: RangeField, fragments: Fragments, places: Places, pairs: NDArray, heights: NDArray, nodes,
              samples, device: Device) -> tuple[NDArray, NDArray]:
    """Return the codes (k,) uint8 of range_distances.cl, pair after pair, and how many each pair has."""
    m, n = nodes
    counts = (pairs[:, 4].astype(np.int64) + 1) * (pairs[:, 5] + 1)
    device.check_memory(distances=int(counts.sum()))
    out = device.empty(int(counts.sum()), np.uint8)
    device.kernel("build/range_distances.cl", constants={"M": m, "N": n})(
        (len(pairs),), (1,), len(pairs), INSIDE, device.upload(places.packed()), device.upload(heights),
        device.upload(pairs), device.upload(np.cumsum(counts) - counts), device.upload(field.image_table[:, :3]),
        samples, device.upload(fragments.labels), out)
    return device.download(out), counts


@dataclass(frozen=True)
class Bound:
    """`share` of the samples lie within `distance` (world units), all within `largest`; the mean square of theirs.

    `largest` is NaN where some have no patch within the tolerance.
    """

    distance: float
    largest: float
    share: float
    mean_square: float


def bound_of(scan: RangeScan, field: RangeField, fragments: Fragments, places: Places, pairs: NDArray,
             heights: NDArray, nodes, device: Device) -> Bound:
    """Return how far every other sample of the scan, as on a chess board, lies from the patches of `pairs`."""
    raw = raw_samples(scan, field, device)
    codes, counts = distances(field, fragments, places, pairs, heights, nodes, raw, device)
    at = np.flatnonzero((codes & 127) <= FULL)
    pair, sample = _samples_at(field, pairs, counts, at)
    nearest = np.full(len(field.cells), np.inf)
    np.minimum.at(nearest, sample, ((codes[at] & 127) / FULL) ** 2 * places.tolerance[pairs[pair, 0]])
    asked = np.concatenate([(image.valid & (np.add.outer(*map(np.arange, image.shape)) % 2 == 0)).ravel()
                            for image in scan.images])
    found = np.sort(nearest[asked & np.isfinite(nearest)])
    share = np.floor(1000 * BOUND_SHARE * len(found) / max(1, int(asked.sum()))) / 1000
    rank = min(len(found), max(1, int(np.ceil(share * asked.sum())))) - 1
    largest = float(found[-1]) if len(found) and len(found) == int(asked.sum()) else float("nan")
    return Bound(float(found[rank]) if len(found) else float("nan"), largest, float(share),
                 float(np.mean(found ** 2)) if len(found) else float("inf"))
