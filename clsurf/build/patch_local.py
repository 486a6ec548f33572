"""Local range images: the default conversion of point clouds to spatial patches.

A cloud is divided into regions (patch_regions), each of which gets one patch in the plane of its mean normal. The
nodes' heights are fitted to the points of the region's own sheet; a node shows only where points support it. (The
paper on spatial patches, section 4.5, takes few global range images instead, which leave much uncovered: patch_views.)
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..device import Device
from ..errors import InputError
from ..surface.patch import PatchSurface
from ..surface.srgb import straight
from .patch_error import bound_of_all, patch_distances
from .patch_limits import widest_spacing
from .patch_points import SheetPoints, sheet_points
from .patch_regions import WIDEN, Regions, Sheet, beside, find_regions, missed_regions
from .patch_search import searched
from .quantize import quantized

SPACING = 1.25  # default distance between nodes, over the points'
FINEST = 1.2  # below it holes appear between points
REACH = 2.2  # of the points that a height is fitted to, over the node spacing (or 1.2 point spacings)
SUPPORT = 1.5  # distance from a node, or from the middle of a cell, to its nearest point, over the region's spacing
FARTHEST = 2.0  # the same, over the median distance between nearest points; or SUPPORT over the cloud's spacing
NOISY = 7.0  # the same over the noise: 15 raw range images that do not quite meet (0.6 spacings) become one surface
TOLERANCE = 1.0  # heights over the reference that count as the same sheet, over the node spacing (or as above)
SLACK = 1.0  # the same, added at the full reach
THICK = 4.0  # the same, over the noise
MISSED = 1.6  # distance of points from their patch, over the node spacing, from which they get one of their own
BOUND_SHARE = 0.999  # of the points lie within `bound` of the surface
BOUND_SAMPLES = 1 << 16
FRAME = 18  # floats a patch (fit_patch_nodes.cl)
TILES = {16: (4, 4), 8: (4, 2), 4: (2, 2), 1: (1, 1)}  # nodes that a work-item fits, by lanes


@dataclass(eq=False)
class Patches:
    """Fitted patches of some regions; lengths in the units of the points' tree.

    Attributes
    ----------
    regions : Regions
    corner : (p, 3) float64
        Node (0, 0) at height 0.
    axes : (p, 3, 3) float64
        Unit x, y, z.
    height : (p, n, m) float64
        NaN where a node does not show.
    light : (4, p, n, m) float32 or None
        Linear, premultiplied.
    """

    regions: Regions
    corner: NDArray
    axes: NDArray
    height: NDArray
    light: NDArray | None


def convert(scan, request, device: Device, step) -> PatchSurface:
    """Return the patches of a cloud (or of a mesh's vertices); see `clsurf.build.patches.build_patches`."""
    step(0.0, "points")
    points = sheet_points(scan, device)
    step(0.3, "regions")
    sheet = Sheet(points)
    finest = FINEST * points.spacing
    default = min(SPACING * points.spacing, widest_spacing(points.diagonal, finest, request.nodes))  # of few points
    surface = searched(lambda spacing, progress: patches_at(sheet, spacing, request, progress), request, len(points),
                       default, sheet.area, finest, points.diagonal,
                       lambda share, what: step(0.3 + 0.7 * share, what))
    step(1.0, "done")
    return surface


def patches_at(sheet: Sheet, spacing: float, request, progress) -> tuple[PatchSurface, float]:
    """Return the patches whose nodes stand `spacing` apart, and their root mean square error; world units."""
    points = sheet.points
    gap = spacing / points.diagonal
    m, n = request.nodes
    size = ((max(m, n) - 1) * gap, (min(m, n) - 1) * gap)
    regions = find_regions(sheet, size)
    progress(0.5, "nodes")
    parts = [fitted(sheet, regions, gap, (m, n))]
    progress(0.8, "missed points")
    distance = own_distance(sheet, parts[0], gap)
    regions = missed_regions(sheet, distance > MISSED * gap, size)
    parts.append(fitted(sheet, regions, gap, (m, n), thick=False))
    progress(0.9, "bound")
    return assembled(points, parts, spacing, request)


def assembled(points: SheetPoints, parts: list[Patches], spacing: float, request) -> tuple[PatchSurface, float]:
    """Return the surface, without the patches that show nothing, and its root mean square error; world units."""
    keep = np.concatenate([np.isfinite(part.height).any(axis=(1, 2)) for part in parts])
    if not keep.any():
        raise nothing_shows(points, spacing)
    height = np.concatenate([part.height for part in parts])[keep].astype(np.float64) * points.diagonal
    corner = np.concatenate([part.corner for part in parts])[keep] * points.diagonal + points.middle
    axes = np.concatenate([part.axes for part in parts])[keep]
    colors = None
    if points.light is not None:
        colors = np.zeros((height.size, 4 if request.precise else 3), np.uint8)
        shows = np.isfinite(height.ravel())
        light = np.concatenate([part.light for part in parts], axis=1)[:, keep].reshape(4, -1)
        colors[shows] = straight(light[:, shows].T)[:, :colors.shape[1]]
    surface = quantized(corner, axes[:, 0] * spacing, axes[:, 1] * spacing, height.ravel(), request.nodes, colors,
                        request.precise, origin=points.origin, diagonal=points.diagonal, oriented=points.oriented)
    first, missed = (part.regions.label for part in parts)
    number = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)
    patch = number[np.where(missed >= 0, missed + len(parts[0].regions), first)]
    return with_bound(surface, points, patch)


def with_bound(surface: PatchSurface, points: SheetPoints, patch: NDArray) -> tuple[PatchSurface, float]:
    """Return `surface` with the distance that BOUND_SHARE of the points keep, and their root mean square error.

    `patch` (n,) int is the number of the patch that shows each point, -1 for none; see `distances`.
    """
    distance = distances(surface, points, patch)
    bound = float(np.quantile(distance, BOUND_SHARE, method="higher"))
    near = distance[distance <= bound]  # strays say nothing about the fit
    return replace(surface, bound=bound, bound_share=BOUND_SHARE, bound_all=bound_of_all(surface, distance)), \
        float(np.sqrt(np.mean(near**2)))


def nothing_shows(points: SheetPoints, spacing: float, advice: str = "") -> InputError:
    """Return the error of patches without a node near enough to points."""
    if spacing > 2 * SPACING * points.spacing:
        return InputError(f"spacing: expected nodes about as close together as the points, {points.spacing:.3g}, got "
                          f"{spacing:.3g}, where nothing of the scan shows: use a smaller spacing, or more patches")
    return InputError(f"scan: expected points that form a surface, got only scattered ones{advice}")


def own_distance(sheet: Sheet, patches: Patches, gap: float) -> NDArray:
    """Return the distance (n,) of each point to the cell of its own patch over or under it, tree units.

    Infinity where that cell does not show, and where a point has no patch.
    """
    label = patches.regions.label
    rows = np.flatnonzero(label >= 0)
    label = label[rows]
    offset = sheet.position[rows] - patches.corner[label]
    u, v, w = (np.einsum("ij,ij->i", offset, patches.axes[label, k]) for k in range(3))
    n, m = patches.height.shape[1:]
    i, j = (np.clip((a / gap).astype(np.int64), 0, k - 2) for a, k in ((u, m), (v, n)))
    s, t = u / gap - i, v / gap - j
    flat, first = patches.height.ravel(), (label * n + j) * m + i
    a, b, c, d = (flat[first + k].astype(np.float64) for k in (0, 1, m, m + 1))
    du, dv = (1 - t) * (b - a) + t * (d - c), (1 - s) * (c - a) + s * (d - b)
    away = np.abs((1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * c + s * d) - w)
    out = np.full(len(sheet), np.inf)
    away /= np.sqrt(1 + (du * du + dv * dv) / gap**2)
    out[rows] = np.where(np.isfinite(away), away, np.inf)
    return out


def distances(surface: PatchSurface, points: SheetPoints, patch: NDArray) -> NDArray:
    """Return the distances (s,) of a sample of the points to the surface, world units, never too small.

    Parameters
    ----------
    patch : (n,) int
        Patch of each point; -1 for none.
    """
    rows = np.arange(0, len(points), max(1, len(points) // BOUND_SAMPLES))
    patch, place = patch[rows], points.position[rows].astype(np.float64)
    distance = np.full(len(rows), np.inf)
    own = patch >= 0
    distance[own] = patch_distances(surface, patch[own], place[own])[0]
    far = np.flatnonzero(distance > np.linalg.norm(surface.axis_x[0]))  # perhaps nearer to another patch
    nodes = surface.positions() - surface.origin
    nodes = nodes[np.isfinite(nodes[:, 0])]
    if len(far) and len(nodes):
        distance[far] = np.minimum(distance[far], cKDTree(nodes).query(place[far])[0])
    return distance


def fitted(sheet: Sheet, regions: Regions, gap: float, size, thick: bool = True) -> Patches:
    """Fit the nodes of every region's patch.

    Parameters
    ----------
    gap : float
        Between nodes, tree units.
    size : (int, int)
        Nodes of a patch along x and y.
    thick : bool
        Noise widens what counts as one sheet.
    """
    points = sheet.points
    tree = points.tree
    device = tree.device
    m, n = size
    axes = regions.axes if m >= n else np.stack([regions.axes[:, 1], -regions.axes[:, 0], regions.axes[:, 2]], axis=1)
    corner = regions.center - gap * ((m - 1) / 2 * axes[:, 0] + (n - 1) / 2 * axes[:, 1])
    frames = np.zeros((len(regions), FRAME), np.float32)
    frames[:, :3], frames[:, 3:12] = corner, axes.reshape(-1, 9)
    frames[:, 12], frames[:, 13] = regions.low, regions.high
    coarse, noise = np.maximum(gap, FINEST * regions.spacing), regions.noise * thick
    frames[:, 14], frames[:, 15] = np.maximum(REACH * coarse, NOISY * noise), WIDEN * regions.spacing
    frames[:, 16], frames[:, 17] = np.maximum(TOLERANCE * coarse, THICK * noise), SLACK * coarse
    region = np.full((3, tree.padded), -1, np.int32)
    region[:, :len(points)] = beside(sheet, regions.label)
    colored = points.light is not None
    lanes = device.lanes
    tiles = [-(-k // side) for k, side in zip(size, TILES[lanes], strict=True)]
    if not len(regions):
        return Patches(regions, corner, axes, np.zeros((0, n, m), np.float32),
                       np.zeros((4, 0, n, m), np.float32) if colored else None)
    device.check_memory(nodes=(32 if colored else 16) * len(regions) * m * n)
    out = device.empty((8 if colored else 4, len(regions), n, m), np.float32)
    kernel = device.kernel("build/fit_patch_nodes.cl", constants={"VW": lanes, "COLORED": int(colored)})
    light = device.upload(points.light) if colored else tree.sorted
    kernel((len(regions) * tiles[0] * tiles[1],), (1,), len(regions), m, n, *tiles, device.upload(frames), gap,
           *tree.arguments, device.upload(region), light, out)
    height, near2, cell2, known, *light = device.download(out)
    farthest = max(FARTHEST * points.nearest, SUPPORT * points.spacing) / points.diagonal
    # Half a diagonal: of the few points of a tiny cloud, whose spacing is their extent.
    support = np.maximum(np.minimum(SUPPORT * regions.spacing, min(farthest, 0.5)), 0.75 * gap)
    shows = supported(known > 0, near2, cell2, support)
    return Patches(regions, corner, axes, np.where(shows, height, np.float32("nan")),
                   np.stack(light) if colored else None)


def supported(known: NDArray, near2: NDArray, cell2: NDArray, support: NDArray) -> NDArray:
    """Return which nodes (p, n, m) bool show: those near a point, less one of every cell whose middle is not.

    Nodes of no whole cell would not be drawn and do not show either.

    Parameters
    ----------
    known : (p, n, m) bool
        Nodes with a height.
    near2, cell2 : (p, n, m) float32
        Squared distance to the nearest point of the sheet from the node, and from the middle of the cell after it.
    support : (p,) float
        Largest distance to a point.
    """
    far2 = support[:, None, None] ** 2
    shows = known & (near2 <= far2)
    n, m = shows.shape[1:]
    corners = [(slice(None), slice(j, n - 1 + j), slice(i, m - 1 + i)) for j in (0, 1) for i in (0, 1)]
    bridging = np.logical_and.reduce([shows[c] for c in corners]) & ~(cell2[:, :-1, :-1] <= far2)
    worst = np.argmax(np.stack([near2[c] for c in corners]), axis=0)
    out = shows.copy()
    for k, c in enumerate(corners):
        out[c] &= ~(bridging & (worst == k))
    return in_whole_cells(out)


def in_whole_cells(shows: NDArray) -> NDArray:
    """Return which of the nodes `shows` (p, n, m) belong to a cell of four that all show."""
    n, m = shows.shape[1:]
    corners = [(slice(None), slice(j, n - 1 + j), slice(i, m - 1 + i)) for j in (0, 1) for i in (0, 1)]
    whole = np.logical_and.reduce([shows[c] for c in corners])
    out = np.zeros_like(shows)
    for c in corners:
        out[c] |= whole
    return out
