"""SLIM surfaces in the renderer: upload, level of detail, projection and the tile stage.

Source: Ohtake, Belyaev, Alexa, SGP 2005, section 3. Kernels: kernels/render/*slim.cl.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from ..surface.arrays import box_of, finite_rows, lengths_of
from ..surface.slim import SlimSurface
from ..surface.slim_bounds import height_bounds, scaled_coefficients
from ..surface.srgb import LINEAR_OF_BYTE, to_linear
from .shade import Look, Shading
from .slim_drawing import SlimDrawing
from .tiles import Footprints, Grid, PairLists, Scratch, bin_pairs, new_footprints, view_floats

RECORD_FLOATS = 32  # kernels/common/slim.clh
PLANES = 21  # kernels/common/select_slim.clh: 11 + up to 10 coefficients
COEFFICIENT_PLANE = 11
IS_LEAF, IS_ROOT = 1, 2
SIZE_PLANE = 4
PINK, BLUE = (0.95, 0.55, 0.65), (0.35, 0.50, 0.90)  # leaves and internal surfels, as in the paper's figure 7
INTERNAL_SCALE = 1.5  # internal surfels are not alpha-covered: drawn at their own radius they leave holes
# Internal surfels count as large while their fit error is over 1/64 of the threshold: 32 times it counts as the radius.
# Without that limit their balls show as blobs at 8 px: the lion 105 px high had 1366 px outside its 4857, now 218, the
# dragon 250 of 8918, now 61, at 16.1K instead of 2.6K and 31.3K instead of 22.8K drawn. A limit of 1/16 left 1252.
ERROR_RADII = 32
LARGEST_COUNT = 1 << 30  # an index leaves two bits of a pair


@dataclass(frozen=True, eq=False)
class SlimUpload:
    """A `SlimSurface` on a device, in planes of `stride` floats (kernels/common/select_slim.clh)."""

    degree: int
    oriented: bool
    count: int
    stride: int
    planes: DeviceArray  # (PLANES, stride) float32
    flags: DeviceArray  # (count,) uint8
    footprint: DeviceArray  # (count, 2) uint32
    child_offset: DeviceArray
    children: DeviceArray
    colors: DeviceArray | None  # (count, 4) float32, linear
    levels: DeviceArray  # (count,) int32
    level_end: NDArray  # (levels + 1,) int: surfels of levels[0:i] end at level_end[i]
    least_internal: NDArray  # (levels,) smallest size (SIZE_PLANE) of an internal surfel of each level, inf: none
    radius_range: tuple[float, float]  # of the leaves; for "ball_size"
    origin: NDArray  # (3,) float64
    center: NDArray  # (3,) float64, relative to origin
    reach: float  # every ball lies within this of `center`


def upload_slim(device: Device, surface: SlimSurface) -> SlimUpload:
    """Put a surface on the device; surfels that are not finite or have no radius are left undrawn.

    Raises
    ------
    InputError
        More surfels than an index holds.
    DeviceMemoryError
    """
    n = len(surface)
    if n > LARGEST_COUNT:
        raise InputError(f"surface: expected at most {LARGEST_COUNT:,} surfels to draw, got {n:,}: split it")
    stride = max(-(-n // 64) * 64, 64)
    device.check_memory(surfels=4 * PLANES * stride, hierarchy=4 * (n + len(surface.children)), footprints=8 * n,
                        colors=0 if surface.colors is None else 16 * n)
    order = np.arange(n)
    if n and np.any(np.diff(surface.level) < 0):
        order = np.argsort(surface.level, kind="stable")
    level, leaf = surface.level[order], surface.leaf[order]
    child_count = np.diff(surface.child_offset)[order]
    child_offset = np.concatenate([[0], np.cumsum(child_count)]).astype(np.int32)
    place = np.empty(n, np.int32)
    place[order] = np.arange(n, dtype=np.int32)
    starts = np.repeat(surface.child_offset[:-1][order] - child_offset[:-1], child_count)
    children = place[surface.children[starts + np.arange(len(starts))]] if len(starts) else np.zeros(1, np.int32)

    own_radius = surface.radii[order].astype(np.float64)
    radius = own_radius * np.where(leaf, 1.0, INTERNAL_SCALE)
    error = np.nan_to_num(surface.fit_error[order].astype(np.float64), nan=np.inf)
    size_radius = np.where(leaf, own_radius, np.maximum(own_radius, np.minimum(ERROR_RADII * error, 1e30)))
    normals, centers = surface.normals[order], surface.centers[order]
    with np.errstate(all="ignore"):
        k = scaled_coefficients(surface.degree, surface.coefficients[order], radius)
        full = k.copy()
        if surface.degree >= 2:
            full[:, 4] *= 2
        low, high, slope = height_bounds(surface.degree, full)
    usable = (finite_rows(k) & finite_rows(centers) & finite_rows(normals)
              & (radius > 0) & np.isfinite(radius))
    planes = np.zeros((PLANES, stride), np.float32)
    for i, values in enumerate([*centers.T, radius, size_radius, *normals.T, low, high, slope, *k.T]):
        planes[i, :n] = np.where(usable, values, 0)
    planes[3, :n][~usable] = 1.0
    planes[5:8, :n][:, ~usable] = np.array([[0], [0], [1]])
    # low > high: nothing is drawn.
    planes[8, :n][~usable], planes[9, :n][~usable] = 1.0, -1.0
    planes[3, n:], planes[7, n:], planes[8, n:], planes[9, n:] = 1.0, 1.0, 1.0, -1.0

    root = np.ones(n, bool)
    root[children[:len(starts)]] = False
    footprint = np.full((n, 2), 0xFFFFFFFF, np.uint32)
    if surface.footprint is not None and n:
        footprint[leaf] = np.ascontiguousarray(surface.footprint[order]).view("<u4")[leaf]
    values = np.unique(level)
    level_end = np.concatenate([[0], np.searchsorted(level, values, side="right")])
    least = [np.min(size_radius[a:b][~leaf[a:b] & usable[a:b]], initial=np.inf)
             for a, b in itertools.pairwise(level_end)]
    colors = None
    if surface.colors is not None:
        colors = np.ones((n, 4), np.float32)
        colors[:, :3] = LINEAR_OF_BYTE[surface.colors[order, :3]]
    use = usable if usable.any() else np.zeros(n, bool)
    points = centers[use].astype(np.float64)
    center = sum(box_of(points)) / 2 if len(points) else np.zeros(3)
    reach = float((lengths_of(points - center) + radius[use]).max()) if len(points) else 0.0
    drawn = own_radius[usable & leaf] if np.any(usable & leaf) else own_radius[usable]
    return SlimUpload(
        surface.degree, surface.oriented, n, stride, device.upload(planes),
        device.upload((IS_LEAF * leaf + IS_ROOT * root).astype(np.uint8)), device.upload(footprint),
        device.upload(child_offset), device.upload(children.astype(np.int32)),
        None if colors is None else device.upload(colors), device.upload(level.astype(np.int32)), level_end,
        np.array(least), (float(drawn.min()), float(drawn.max())) if len(drawn) else (1.0, 1.0), surface.origin, center,
        reach)


def surfel_colors(device: Device, upload: SlimUpload, shading: Shading) -> DeviceArray:
    """Return the linear colours (count, 4) float32 that a surface is drawn with."""
    if not shading.look.startswith("ball"):
        if shading.model_colors and upload.colors is not None:
            return upload.colors
        srgb = np.broadcast_to(np.asarray(shading.color, np.float64), (upload.count, 3))
    elif shading.look == "ball_size":
        small, large = np.log(upload.radius_range)
        radius = np.log(np.maximum(device.download(upload.planes)[SIZE_PLANE, :upload.count], 1e-30))
        srgb = rainbow((large - radius) / max(large - small, 1e-9))
    elif shading.level is not None:
        leaf = device.download(upload.flags) & IS_LEAF
        srgb = np.where(leaf[:, None], PINK, BLUE)
    else:
        level = device.download(upload.levels)
        srgb = rainbow((level - level.min()) / max(np.ptp(level), 1))
    out = np.ones((upload.count, 4), np.float32)
    out[:, :3] = to_linear(srgb)
    return device.upload(out)


def rainbow(t: NDArray) -> NDArray:
    """Return sRGB colours (n, 3) from blue at 0 over green to red at 1."""
    t = np.clip(np.asarray(t, np.float64), 0, 1)[:, None]
    return np.clip(1.5 - np.abs(4 * t - np.array([3.0, 2.0, 1.0])), 0.1, 1)


def level_flags(device: Device, upload: SlimUpload, level: int) -> DeviceArray:
    """Return flags (count,) uint8 that draw the leaves up to `level` and its internal surfels, and nothing else."""
    levels, leaf = device.download(upload.levels), device.download(upload.flags) & IS_LEAF > 0
    shown = np.where(leaf, levels <= level, levels == level)
    return device.upload(((IS_LEAF | IS_ROOT) * shown).astype(np.uint8))


def place_slim(upload: SlimUpload, matrix: NDArray | None, camera, size, lod: float) -> tuple[NDArray, int]:
    """Return the view buffer of a placed surface, and the number of surfels that are visited without a search.

    All surfels of the coarse levels whose internal surfels all appear larger than `lod` are visited, and so are those
    of the next level.
    """
    matrix = np.eye(4) if matrix is None else matrix
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rotation = camera.rotation @ (matrix[:3, :3] / scale)
    zero = matrix[:3, :3] @ upload.origin + matrix[:3, 3]
    offset = camera.rotation @ (zero - camera.eye)
    p = camera.projection(size)
    middle, reach = -(scale * rotation[2] @ upload.center + offset[2]), scale * upload.reach
    farthest = middle + reach
    view = view_floats(camera, size, rotation, offset, scale, lod, (middle - reach, farthest))
    limit = lod * (farthest if p.perspective else 1.0) * (1 + 1e-4)  # float32 rounding in the kernel
    large = 2 * scale * max(p.fx, p.fy) * upload.least_internal > limit
    levels = len(large) if large.all() else int(np.argmin(large))
    return view, int(upload.level_end[min(levels + 1, len(large))]) if len(large) else 0


def select_slim(device: Device, scratch: Scratch, upload: SlimUpload, view: DeviceArray,
                visited_end: int) -> DeviceArray:
    """Walk the hierarchy level by level; return which surfels the walk reaches, (count,) uint8."""
    visited = scratch.array("visited", (upload.count,), np.uint8)
    device.fill(visited, 0)
    if visited_end >= upload.count:
        return visited
    kernel = device.kernel("render/select_slim.cl", constants={"VW": scratch.lanes})
    # Levels before the one that ends at visited_end need no search: their children are visited anyway.
    start = int(np.searchsorted(upload.level_end, visited_end)) - 1
    for begin, end in zip(upload.level_end[start:-2], upload.level_end[start + 1:-1], strict=True):
        items = -(-int(end) // scratch.lanes) - int(begin) // scratch.lanes
        kernel((items,), (min(64, items),), view, upload.planes, upload.stride, upload.flags, upload.child_offset,
               upload.children, visited, int(begin), int(end), visited_end)
    return visited


def project_slim(device: Device, scratch: Scratch, upload: SlimUpload, view: DeviceArray, flags: DeviceArray,
                 visited: DeviceArray, visited_end: int, balls: bool) -> tuple[DeviceArray, Footprints]:
    """Cut, cull and project all surfels; return their records (count, 32) float32 and where they touch the picture."""
    n = upload.count
    device.check_memory(records=4 * RECORD_FLOATS * n)
    records, touch = scratch.array("records", (n, RECORD_FLOATS), np.float32), new_footprints(device, scratch, n)
    items = -(-n // scratch.lanes)
    device.kernel("render/project_slim.cl", constants={"VW": scratch.lanes, "DEGREE": upload.degree,
                                                            "BALLS": balls})(
        (items,), (min(16, items),), view, upload.planes, upload.stride, n, flags, upload.footprint, visited,
        visited_end, records, touch.full, touch.core, touch.keys, touch.buckets)
    return records, touch


def tile_slim(device: Device, scratch: Scratch, grid: Grid, upload: SlimUpload, view: DeviceArray,
              records: DeviceArray, pairs: PairLists, colors: DeviceArray | None, number: int,
              balls: bool, drawing: SlimDrawing) -> None:
    """Draw the surfels of every bin into its planes, the paper's two passes, or their balls.

    `number` is the surface's place in the scene, for the channel "id".
    """
    constants = grid.layout.constants | {"VW": scratch.lanes, "DEGREE": upload.degree, "TILE_BINS": grid.tile_bins}
    if not balls:
        constants |= {"ORIENTED": upload.oriented, "HAS_COLOR": colors is not None,
                      "FUNCTION": drawing.derivatives == "function"}
    group = 64 if scratch.lanes == 1 else 1
    device.kernel("render/tile_balls.cl" if balls else "render/tile_slim.cl", constants=constants)(
        (grid.tile_count * group,), (group,), view, pairs.pairs, pairs.offsets, records,
        view if colors is None else colors, upload.levels, number, grid.tiles_x, grid.tile_count, grid.bins_x,
        grid.bins_y, grid.touched, grid.planes)


def draw_slim(device: Device, scratch: Scratch, grid: Grid, upload: SlimUpload, matrix, camera, look: Look,
              number: int) -> None:
    """Run all stages of one placed surface: select, project, bin, tile."""
    if upload.count == 0:
        return
    shading, lod = look.shading, look.lod
    balls = shading.look.startswith("ball")
    one_level = balls and shading.level is not None
    floats, visited_end = place_slim(upload, matrix, camera, grid.size, 0.0 if one_level else lod)
    view = device.upload(grid.clip_into(floats))
    visited = select_slim(device, scratch, upload, view, visited_end)
    flags, visited_end = (level_flags(device, upload, shading.level), 0) if one_level else (upload.flags, visited_end)
    records, footprints = project_slim(device, scratch, upload, view, flags, visited, visited_end, balls)
    pairs = bin_pairs(device, scratch, grid, footprints, upload.count)
    if pairs is not None:
        colors = surfel_colors(device, upload, shading) if balls or grid.layout.color else None
        tile_slim(device, scratch, grid, upload, view, records, pairs, colors, number, balls, look.slim)
