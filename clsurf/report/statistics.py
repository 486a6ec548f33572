"""What a view of spatial patches consists of, counted as the paper's simulator did (section 5, Table 3)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..render.camera import Camera, Projection
from ..render.normal_table import NormalStatistics, normal_statistics
from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface, facet_cones, opaque_nodes
from ..surface.placed import Placed
from .operations import Operations, counted_operations

BLOCK_NODES = 1 << 19  # counted at a time; the arrays of one block take about 100 MB
ONE_PIXEL = 1 + 1e-6  # a distance that still counts as one pixel: nodes exactly a pixel apart are rounded


@dataclass(frozen=True)
class PatchStatistics:
    """Counts of one view of a `PatchSurface`; see `patch_statistics` for their definitions."""

    size: tuple[int, int]  # width, height of the picture, pixels
    nbytes: int  # of the model
    patches: int
    visible_patches: int
    partial_patches: int
    facing_patches: int
    nodes: int
    opaque_nodes: int
    projected_nodes: int
    cells: int
    cells_touched: int
    interpolated_nodes: int
    plain_patches: int
    cheap_patches: int
    cell_levels: tuple[int, ...]  # touched cells by the number of halvings of their longer side
    parts: int  # touched cells and all parts of the recursive subdivision
    lines: int  # scan lines of the triangles of the touched cells
    pixels: float  # area of the touched cells inside the picture, each cell by itself
    operations: dict[str, Operations]  # by mode
    normals: NormalStatistics  # of the visible patches

    @property
    def plain_share(self) -> float:
        """Share of the visible patches that need no interpolation; NaN where none is visible."""
        return self.plain_patches / self.visible_patches if self.visible_patches else float("nan")

    @property
    def cheap_share(self) -> float:
        """Share of the patches without interpolation that the cheap test finds; NaN where there is none."""
        return self.cheap_patches / self.plain_patches if self.plain_patches else float("nan")


def patch_statistics(surface: PatchSurface | Placed, camera: Camera, size: tuple[int, int]) -> PatchStatistics:
    """Count what drawing `surface` takes (paper, section 5).

    Parameters
    ----------
    surface : PatchSurface or Placed
    camera : Camera
    size : (int, int)
        Width and height of the picture, pixels.

    Returns
    -------
    PatchStatistics

    Notes
    -----
    - *visible*: the patch's box meets the viewing frustum (all corners outside one plane: it does not); *partial*: not
      all corners lie inside; *facing*: visible, and not every facet shows its back. The paper culls no backs and
      neither do the other counts.
    - *projected nodes*: opaque nodes of visible patches.
    - *cells*: those with four opaque nodes; *touched*: in front of the eye with all four, and the box around their
      projections meets the picture.
    - *interpolated nodes*: a touched cell is halved along either side until neighbouring nodes are at most a pixel
      apart: 2^kx by 2^ky parts with the least kx and ky that bring the longer of two opposite projected edges to a
      pixel, at most as many as the picture's longer side has pixels. It creates (2^kx + 1)(2^ky + 1) - 4 nodes; cells
      are taken one by one, so a node on an edge between two counts twice.
    - *plain*: visible patches without any interpolated node.
    - *cheap*: visible patches that are found to be plain from the eight projected corners of their box alone: with the
      largest projected edge along each axis over its steps, L_x, L_y, L_z, the largest displacement differences
      D_x, D_y of neighbouring nodes (constants of the patch) and the ratio q of the corners' largest and least depth,
      q (L_x + D_x L_z) <= 1 and q (L_y + D_y L_z) <= 1 pixel. This suffices: a step s at depth z is f/z |s_xy - t s_z|
      pixels long, t the slope of the line of sight, which is convex in t, so a corner is worst up to the depths' ratio.
    """
    view = _View.of(surface, camera, size)
    seen = _visible(view)
    plain_found = _found_plain(view)
    totals, needs = _Totals(), np.zeros(len(view.patches), bool)
    for start, end in _blocks(view.patches.node_offset):
        _count_cells(view, start, end, seen.whole | seen.part, totals, needs)
    visible = seen.whole | seen.part
    count = int(visible.sum())
    return PatchStatistics(
        size=tuple(size), nbytes=view.patches.nbytes, patches=len(view.patches), visible_patches=count,
        partial_patches=int(seen.part.sum()), facing_patches=int((visible & ~seen.away).sum()),
        nodes=view.patches.node_count, opaque_nodes=totals.opaque, projected_nodes=totals.projected,
        cells=totals.cells, cells_touched=totals.touched, interpolated_nodes=totals.created,
        plain_patches=int((visible & ~needs).sum()), cheap_patches=int((visible & plain_found).sum()),
        cell_levels=tuple(int(v) for v in np.trim_zeros(totals.levels, "b")), parts=totals.parts, lines=totals.lines,
        pixels=totals.pixels,
        operations=counted_operations(count, totals.projected, totals.touched, totals.parts, totals.created,
                                      totals.lines, totals.pixels),
        normals=normal_statistics(view.patches, visible))


@dataclass(eq=False)
class _View:
    """Patches in view space."""

    patches: PatchSurface
    frames: NDArray  # (4, p, 3) float64: origin, axis_x, axis_y, axis_z in view space
    projection: Projection
    size: tuple[int, int]
    near: float

    @classmethod
    def of(cls, surface, camera, size):
        matrix = surface.matrix if isinstance(surface, Placed) else np.eye(4)
        patches = surface.surface if isinstance(surface, Placed) else surface
        turn = camera.rotation @ matrix[:3, :3]
        origin = (matrix[:3, :3] @ patches.origin + matrix[:3, 3] - camera.eye) @ camera.rotation.T
        frames = np.stack([a.astype(np.float64) @ turn.T
                           for a in (patches.origins, patches.axis_x, patches.axis_y, patches.axis_z)])
        frames[0] += origin
        projection = camera.projection(size)
        near = max(camera.near, 1e-300) if projection.perspective else camera.near
        return cls(patches, frames, projection, tuple(size), near)

    def pixels(self, points: NDArray) -> tuple[NDArray, NDArray]:
        """Return the places on the picture (..., 2) and the depths (...); places behind the eye mean nothing."""
        p, depth = self.projection, -points[..., 2]
        over = 1 / np.where(depth >= self.near, depth, 1) if p.perspective else 1.0
        return np.stack([p.cx + p.fx * points[..., 0] * over, p.cy - p.fy * points[..., 1] * over], axis=-1), depth

    def corners(self) -> NDArray:
        """Return the corners (p, 8, 3) of the patches' boxes in view space, in the order of `PatchSurface.boxes`."""
        c, (m, n), ranges = np.arange(8), self.patches.size.T, self.patches.displacement_ranges
        i, j, d = (c & 1) * (m[:, None] - 1), (c >> 1 & 1) * (n[:, None] - 1), ranges[:, c >> 2 & 1]
        origin, x, y, z = self.frames[:, :, None]
        return origin + i[..., None] * x + j[..., None] * y + d[..., None] * z


@dataclass
class _Seen:
    whole: NDArray  # (p,) bool: the box lies inside the frustum
    part: NDArray  # (p,) bool: it crosses its border
    away: NDArray  # (p,) bool: every facet shows its back


@dataclass
class _Totals:
    opaque: int = 0
    projected: int = 0
    cells: int = 0
    touched: int = 0
    created: int = 0
    parts: int = 0
    lines: int = 0
    pixels: float = 0.0
    levels: NDArray = None

    def __post_init__(self):
        self.levels = np.zeros(32, np.int64)


def _visible(view: _View) -> _Seen:
    p, (width, height) = view.projection, view.size
    corners, ranges = view.corners(), view.patches.displacement_ranges
    x, y, depth = corners[..., 0], corners[..., 1], -corners[..., 2]
    w = depth if p.perspective else np.ones_like(depth)
    inside = np.stack([p.fx * x + p.cx * w >= 0, p.fx * x + (p.cx - width) * w <= 0,
                       p.fy * y - p.cy * w <= 0, p.fy * y + (height - p.cy) * w >= 0, depth >= view.near])
    any_node = ranges[:, 0] <= ranges[:, 1]
    met = inside.any(axis=2).all(axis=0) & any_node
    whole = inside.all(axis=(0, 2)) & any_node
    return _Seen(whole, met & ~whole, _away(view, corners))


def _away(view: _View, corners: NDArray) -> NDArray:
    """Return which patches (p,) show nothing but backs, from the cones of their facets."""
    if not view.patches.oriented or not len(view.patches):
        return np.zeros(len(view.patches), bool)
    axes, cosines = facet_cones(view.patches)
    # The cone's axis in view space by way of the patch's own frame, which `frames` has turned and placed.
    own = np.stack([view.patches.axis_x, view.patches.axis_y, view.patches.axis_z], axis=1).astype(np.float64)
    own /= lengths_of(own, keepdims=True)
    turned = view.frames[1:].transpose(1, 0, 2)
    turned = turned / lengths_of(turned, keepdims=True)
    axes = np.einsum("pk,pkx->px", np.einsum("px,pkx->pk", axes, own), turned)
    sight = corners if view.projection.perspective else np.broadcast_to([0.0, 0.0, -1.0], corners.shape)
    # n . s >= 0 for every normal within the cone; linear in s, so the corners decide for the whole box.
    sine = np.sqrt(np.clip(1 - cosines ** 2, 0, 1))
    reach = np.einsum("pcx,px->pc", sight, axes) - sine[:, None] * lengths_of(sight)
    return (cosines > 0) & (reach >= 0).all(axis=1)


def _found_plain(view: _View) -> NDArray:
    """Return which patches (p,) the cheap test finds to need no interpolation."""
    if not len(view.patches):
        return np.zeros(0, bool)
    place, depth = view.pixels(view.corners())
    c, steps, ranges = np.arange(8), _largest_steps(view.patches), view.patches.displacement_ranges
    longest = []  # projected box edges along each axis
    for bit, parts in zip((1, 2, 4), (*(view.patches.size.T - 1), ranges[:, 1] - ranges[:, 0]), strict=True):
        low = c[(c & bit) == 0]
        edges = lengths_of(place[:, low | bit] - place[:, low]).max(axis=1)
        longest.append(edges / np.maximum(parts, 1))
    front = (depth >= view.near).all(axis=1)
    ratio = depth.max(axis=1) / np.where(front, depth.min(axis=1), 1) if view.projection.perspective else 1.0
    x, y, z = longest
    return front & (np.maximum(x + steps[:, 0] * z, y + steps[:, 1] * z) * ratio <= 1) & (ranges[:, 0] <= ranges[:, 1])


def _largest_steps(patches: PatchSurface) -> NDArray:
    """Return the largest difference (p, 2) float64 of neighbouring opaque displacements along each axis."""
    out = np.zeros((len(patches), 2))
    for start, end in _blocks(patches.node_offset):
        _, place, patch, (m, n), opaque, d = _block_nodes(patches, start, end)
        here = np.arange(len(d))
        for axis, (step, has) in enumerate(((np.ones_like(m), place % m < m - 1), (m, place // m < n - 1))):
            a = here[has]
            b = a + step[has]
            both = opaque[a] & opaque[b]
            np.maximum.at(out[:, axis], patch[a[both]], np.abs(d[b[both]] - d[a[both]]))
    return out


def _blocks(node_offset: NDArray):
    """Yield ranges of patches with at most about BLOCK_NODES nodes."""
    start, last = 0, len(node_offset) - 1
    while start < last:
        end = int(np.searchsorted(node_offset, node_offset[start] + BLOCK_NODES, side="right")) - 1
        end = min(max(end, start + 1), last)
        yield start, end
        start = end


def _block_nodes(patches: PatchSurface, start: int, end: int):
    """Return the nodes of patches start...end: slice, place in the patch, patch, (m, n), opaque, displacement."""
    offset = patches.node_offset
    part = slice(int(offset[start]), int(offset[end]))
    patch = np.repeat(np.arange(start, end), np.diff(offset[start:end + 1]))
    place = np.arange(part.start, part.stop) - offset[patch]
    d = patches.displacements[part]
    opaque = opaque_nodes(d, None if patches.colors is None else patches.colors[part])
    return part, place, patch, patches.size[patch].T.astype(np.int64), opaque, d.astype(np.float64)


def _count_cells(view: _View, start: int, end: int, visible: NDArray, totals: _Totals, needs: NDArray) -> None:
    """Add the nodes and cells of patches start...end to `totals`; mark in `needs` the patches that interpolate."""
    _, place, patch, (m, n), opaque, d = _block_nodes(view.patches, start, end)
    i, j = place % m, place // m
    totals.opaque += int(opaque.sum())
    totals.projected += int((opaque & visible[patch]).sum())
    first = np.flatnonzero((i < m - 1) & (j < n - 1))
    corners = np.stack([first, first + 1, first + m[first], first + m[first] + 1])  # by bits: x, y
    whole = opaque[corners].all(axis=0)
    totals.cells += int(whole.sum())
    corners = corners[:, whole & visible[patch[first]]]
    origin, x, y, z = view.frames[:, patch]
    pixel, depth = view.pixels(origin + i[:, None] * x + j[:, None] * y + d[:, None] * z)
    corners = corners[:, (depth[corners] >= view.near).all(axis=0)]
    quads = pixel[corners]  # (4, cells, 2)
    low, high, limit = quads.min(axis=0), quads.max(axis=0), np.array(view.size, np.float64)
    touched = ((high >= 0) & (low <= limit)).all(axis=1)
    corners, quads, low, high = corners[:, touched], quads[:, touched], low[touched], high[touched]
    length = lambda a, b: np.hypot(*(quads[b] - quads[a]).T)  # noqa: E731
    kx = _halvings(np.maximum(length(0, 1), length(2, 3)), max(view.size))
    ky = _halvings(np.maximum(length(0, 2), length(1, 3)), max(view.size))
    created = ((np.int64(1) << kx) + 1) * ((np.int64(1) << ky) + 1) - 4
    totals.touched += len(kx)
    totals.created += int(created.sum())
    most = np.maximum(kx, ky)
    totals.levels += np.bincount(most, minlength=32)
    for level in range(int(most.max(initial=-1)) + 1):
        deep = most >= level  # every side that is still too long is halved at once
        totals.parts += int((np.int64(1) << np.minimum(kx[deep], level) + np.minimum(ky[deep], level)).sum())
    needs[patch[corners[0][created > 0]]] = True
    _count_lines(quads, low, high, limit, totals)


def _halvings(length: NDArray, longest: int) -> NDArray:
    """Return the least k (int64) with length / 2^k at most a pixel; lengths count up to `longest` pixels."""
    mantissa, exponent = np.frexp(np.clip(length / ONE_PIXEL, 0, longest))
    return np.maximum(exponent - (mantissa == 0.5), 0).astype(np.int64)


def _count_lines(quads: NDArray, low: NDArray, high: NDArray, limit: NDArray, totals: _Totals) -> None:
    """Add the scan lines and the covered area of the triangles (0, 1, 3) and (0, 3, 2) of cells (4, cells, 2)."""
    box = np.maximum(high - low, 1e-300)
    shown = np.prod(np.clip(np.minimum(high, limit) - np.maximum(low, 0), 0, None) / box, axis=1)
    for a, b, c in ((0, 1, 3), (0, 3, 2)):
        one, two = quads[b] - quads[a], quads[c] - quads[a]
        totals.pixels += float((np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]) / 2 * shown).sum())
        y = quads[[a, b, c], :, 1]
        # Lines are pixel centres: row r at r + 0.5, from the first at or below the top to the last above the bottom.
        first = np.clip(np.ceil(y.min(axis=0) - 0.5), 0, limit[1])
        totals.lines += int(np.clip(np.clip(np.ceil(y.max(axis=0) - 0.5), 0, limit[1]) - first, 0, None).sum())
