"""Local range images: the default conversion of point clouds to spatial patches.

A cloud is divided into regions (patch_regions), each of which gets one patch in the plane of its mean normal. The
nodes' heights are fitted to the points of the region's own sheet; a node shows only where points support it. (The
paper on spatial patches, section 4.5, takes few global range images instead, which leave much uncovered: patch_views.)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import Cancelled, InputError
from ..surface.patch import PatchSurface
from .patch_points import SheetPoints, encoded, sheet_points
from .patch_regions import Regions, find_regions
from .quantize import quantized

SPACING = 1.25  # default distance between nodes, over the points'; below 1.2 holes appear between points
REACH = 2.2  # of the points that a height is fitted to, over the node spacing (or 1.2 point spacings)
SUPPORT = 1.5  # distance from a node, or from the middle of a cell, to its nearest point, over the point spacing
WIDEN = 0.9  # how far a patch goes beyond its region's points, over their spacing, before it is rounded up to nodes
TOLERANCE = 1.0  # heights over the reference that count as the same sheet, over the reach / 2.2
SLACK = 1.0  # the same, added at the full reach
FRAME = 20  # floats a patch (fit_patch_nodes.cl)


@dataclass(eq=False)
class Nodes:
    """What fit_patch_nodes gives: (p, n, m) arrays in the units of the points' tree."""

    height: NDArray
    near2: NDArray  # squared distance to the nearest point of the sheet
    cell2: NDArray  # the same from the middle of the cell between this node and (i + 1, j + 1)
    fitted: NDArray  # bool
    light: NDArray | None  # (4, p, n, m) linear, premultiplied


def convert(scan, request, device: Device, progress) -> PatchSurface:
    """Return the patches of a cloud (or of a mesh's vertices); see `clsurf.build.patches.build_patches`."""
    step(progress, 0.0, "normals")
    points = sheet_points(scan, device)
    step(progress, 0.4, "regions")
    spacing = SPACING * points.spacing if request.spacing is None else float(request.spacing)
    surface = patches_at(points, spacing, request, progress)
    step(progress, 1.0, "done")
    return surface


def step(progress, fraction: float, what: str) -> None:
    """Report progress; raises Cancelled where the callback returns False."""
    if progress(fraction, what) is False:
        raise Cancelled("build_patches: stopped by the progress callback")


def patches_at(points: SheetPoints, spacing: float, request, progress) -> PatchSurface:
    """Return the patches whose nodes stand `spacing` (world units) apart."""
    unit = points.diagonal
    gap = spacing / unit
    m, n = request.nodes
    loss = 2 * WIDEN * points.spacing / unit
    width = tuple(max(k * gap - loss, 0.5 * k * gap) for k in (max(m, n) - 1, min(m, n) - 1))
    regions = find_regions(points, width, gap)
    if not len(regions):
        raise InputError("scan: expected points that form a surface, got only scattered ones")
    step(progress, 0.7, "nodes")
    nodes, corner, axes = fitted_nodes(points, regions, gap, (m, n))
    opaque = supported(nodes, gap, points.spacing / unit)
    heights = np.where(opaque, nodes.height.astype(np.float64) * unit, np.nan).reshape(len(regions), -1)
    keep = opaque.any(axis=(1, 2))
    colors = None
    if nodes.light is not None:
        colors = encoded(nodes.light[:, keep].reshape(4, -1).T)
        if not request.precise:
            colors = colors[:, :3]
    return quantized((corner * unit + points.middle)[keep], axes[keep, 0] * spacing, axes[keep, 1] * spacing,
                     heights[keep].ravel(), (m, n), colors, request.precise, origin=points.origin,
                     diagonal=points.diagonal, oriented=points.oriented)


def fitted_nodes(points: SheetPoints, regions: Regions, gap: float, size) -> tuple[Nodes, NDArray, NDArray]:
    """Fit the nodes of every region's patch.

    Returns
    -------
    nodes : Nodes
    corner : (p, 3) float64
        Node (0, 0) at height 0, in the units of the points' tree.
    axes : (p, 3, 3) float64
        Unit x, y, z of the patches.
    """
    tree = points.tree
    device = tree.device
    m, n = size
    axes = regions.axes if m >= n else np.stack([regions.axes[:, 1], -regions.axes[:, 0], regions.axes[:, 2]], axis=1)
    corner = regions.center - gap * ((m - 1) / 2 * axes[:, 0] + (n - 1) / 2 * axes[:, 1])
    frames = np.zeros((len(regions), FRAME), np.float32)
    frames[:, :3], frames[:, 3:12] = corner, axes.reshape(-1, 9)
    frames[:, 12], frames[:, 13] = regions.low, regions.high
    region = np.full(tree.padded, -1, np.int32)
    region[:len(points)] = regions.label
    coarse = max(gap, 1.2 * points.spacing / points.diagonal)
    colored = points.light is not None
    lanes = device.lanes
    tiles = [-(-k // side) for k, side in zip(size, {16: (4, 4), 8: (4, 2), 4: (2, 2), 1: (1, 1)}[lanes], strict=True)]
    out = device.empty((8 if colored else 4, len(regions), n, m), np.float32)
    kernel = device.kernel("build/fit_patch_nodes.cl", constants={"VW": lanes, "COLORED": int(colored)})
    light = device.upload(points.light) if colored else tree.sorted
    kernel((len(regions) * tiles[0] * tiles[1],), (1,), len(regions), m, n, *tiles, device.upload(frames), gap,
           REACH * coarse, WIDEN * points.spacing / points.diagonal, TOLERANCE * coarse, SLACK * coarse,
           *tree.arguments, device.upload(region), light, out)
    result = device.download(out)
    return Nodes(result[0], result[1], result[2], result[3] > 0, result[4:] if colored else None), corner, axes


def supported(nodes: Nodes, gap: float, spacing: float) -> NDArray:
    """Return which nodes (p, n, m) bool show: those near a point, less one of every cell whose middle is not.

    Parameters
    ----------
    gap, spacing : float
        Of nodes and points, in the units of the nodes.
    """
    far2 = max(SUPPORT * spacing, 0.75 * gap) ** 2
    opaque = nodes.fitted & (nodes.near2 <= far2)
    corners = [(slice(None), slice(j, opaque.shape[1] - 1 + j), slice(i, opaque.shape[2] - 1 + i))
               for j in (0, 1) for i in (0, 1)]
    bridging = np.logical_and.reduce([opaque[c] for c in corners]) & ~(nodes.cell2[:, :-1, :-1] <= far2)
    near2 = np.stack([nodes.near2[c] for c in corners])
    worst = np.argmax(near2, axis=0)
    out = opaque.copy()
    for k, c in enumerate(corners):
        out[c] &= ~(bridging & (worst == k))
    return out
