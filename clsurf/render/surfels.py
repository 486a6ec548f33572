"""Surfel hierarchies in the renderer: upload, level of detail, projection and the tile stage.

Source: Holst, Schumann, "Normal Mapping for Surfel-Based Rendering", Journal of WSCG 15, 2007, section 5. Kernels:
kernels/render/*surfels.cl.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from ..surface.arrays import box_of, finite_rows, lengths_of, whole_faces
from ..surface.srgb import LINEAR_OF_BYTE, to_linear
from ..surface.surfel import SurfelHierarchy
from .shade import Look, Shading
from .slim import LARGEST_COUNT, rainbow
from .tiles import Footprints, Grid, PairLists, Scratch, bin_pairs, view_floats
from .triangles import Triangles, draw_triangles, place_triangles

SURFEL_FLOATS, RECORD_FLOATS = 16, 32  # kernels/common/surfel.clh
IS_BASE, IS_ROOT, IS_LAST, HAS_TRIANGLES = 0x100, 0x200, 0x400, 0x800
VISITED, DRAWN, BY_TRIANGLES = 1, 2, 3
# Discs blend where their planes are less than so many radii apart, plus the relief below them. Neighbours on a bend of
# the surface of two radii are 1/4 apart.
SLAB = 0.3
LEAN = 0.25  # kernels/render/project_surfels.cl


@dataclass(frozen=True, eq=False)
class SurfelUpload:
    """A `SurfelHierarchy` on a device (kernels/common/surfel.clh)."""

    count: int
    surfels: DeviceArray  # (count, 16) float32
    state: NDArray  # (count,) uint8 at the start of the search: the roots are visited, or drawn
    atlas: DeviceArray  # (texels,) uint32
    color_atlas: DeviceArray | None
    colors: DeviceArray | None  # (count, 4) float32, linear
    levels: DeviceArray  # (count,) int32
    level_end: NDArray  # (k + 1,) surfels of levels[0:i] end at level_end[i]; the levels that have to be looked at
    radii: NDArray  # (count,) float32
    origin: NDArray  # (3,) float64
    slabs: NDArray  # (count,) float32, model units: kernels/common/surfel.clh, S_SLAB
    center: NDArray  # (3,) float64, relative to origin
    reach: float  # every surfel lies within this of `center`
    triangle_offset: NDArray | None = None
    faces: NDArray | None = None  # (f, 3) int32
    triangles: Triangles | None = None  # vertices; the faces are those of a frame


def upload_surfels(device: Device, surface: SurfelHierarchy) -> SurfelUpload:
    """Put a hierarchy on the device; surfels that are not finite or have no radius are left undrawn.

    Raises
    ------
    InputError
        More surfels than an index holds.
    DeviceMemoryError
    """
    n, texels = len(surface), len(surface.normal_atlas)
    if n > LARGEST_COUNT:
        raise InputError(f"surface: expected at most {LARGEST_COUNT:,} surfels to draw, got {n:,}: split it")
    device.check_memory(surfels=4 * SURFEL_FLOATS * n, normal_maps=4 * texels, levels=5 * n,
                        color_maps=0 if surface.color_atlas is None else 4 * texels,
                        colors=0 if surface.colors is None else 16 * n)
    usable = (finite_rows(surface.positions) & finite_rows(surface.normals)
              & np.isfinite(surface.radii) & (surface.radii > 0))
    flags, state, level_end = ways_down(surface)
    records = np.zeros((n, SURFEL_FLOATS), np.float32)
    radius = np.where(usable, surface.radii, 0)
    columns = [*surface.positions.T, radius, *surface.normals.T, surface.spreads, surface.heights, surface.spheres,
               SLAB * radius + surface.heights]
    for i, values in enumerate(columns):
        records[:, i] = np.where(usable, values, 0)
    records[~usable, 6] = 1
    whole = records.view(np.int32)
    whole[:, 12], whole[:, 13] = surface.map_offset, flags
    child = np.append(surface.children, 0)
    whole[:, 14] = child[np.minimum(surface.child_offset[:-1], len(child) - 1)]
    whole[:, 15] = np.diff(surface.child_offset)
    points = surface.positions[usable].astype(np.float64)
    center = sum(box_of(points)) / 2 if len(points) else np.zeros(3)
    reach = float((lengths_of(points - center) + surface.radii[usable]).max()) if len(points) else 0.0
    colors = None
    if surface.colors is not None:
        colors = np.ones((n, 4), np.float32)
        colors[:, :3] = LINEAR_OF_BYTE[surface.colors[:, :3]]
    atlas = lambda texels: device.upload(np.ascontiguousarray(texels).view(np.uint32).ravel())  # noqa: E731
    surfels, normal_atlas = device.upload(records), atlas(surface.normal_atlas)
    device.kernel("render/plain_cosines.cl", constants={"VW": device.lanes})(
        (n,), (min(64, n),), n, normal_atlas, surfels)
    return SurfelUpload(
        n, surfels, state, normal_atlas,
        None if surface.color_atlas is None else atlas(surface.color_atlas),
        None if colors is None else device.upload(colors), device.upload(surface.level), level_end, surface.radii,
        surface.origin, np.ascontiguousarray(records[:, 10]), center, reach, *below_of(device, surface))


def ways_down(surface: SurfelHierarchy) -> tuple[NDArray, NDArray, NDArray]:
    """Return flags and first state of all surfels, and the ends of the levels that the search has to look at."""
    n, below = len(surface), np.diff(surface.child_offset)
    root, direct = np.ones(n, bool), np.zeros(n, bool)
    root[surface.children] = False
    base = below == 0
    flags = surface.map_size.astype(np.int32) | IS_ROOT * root
    if surface.hybrid:
        own = np.diff(surface.triangle_offset) > 0
        flags |= HAS_TRIANGLES * own
        base &= ~own
    bases = np.concatenate([[0], np.cumsum(base[surface.children])])
    last = (below > 0) & (np.diff(bases[surface.child_offset]) == below)
    direct[surface.children] = np.repeat(last, below)
    direct |= root & base
    flags |= IS_BASE * base | IS_LAST * last
    state = np.where(root, np.where(base, DRAWN, VISITED), 0).astype(np.uint8)
    looked = surface.level[~direct]
    level_end = np.searchsorted(surface.level, np.unique(looked), side="right")
    return flags, state, np.concatenate([[0], level_end])


def below_of(device: Device, surface: SurfelHierarchy) -> tuple:
    """Return what draws the triangles of the hybrid form; nothing of the pure one."""
    if not surface.hybrid:
        return ()
    device.check_memory(positions=16 * len(surface.vertices), normals=16 * len(surface.vertices))
    fours = lambda rows: device.upload(np.pad(np.asarray(rows, np.float32), ((0, 0), (0, 1))))  # noqa: E731
    light = None if surface.vertex_colors is None else fours(LINEAR_OF_BYTE[surface.vertex_colors[:, :3]])
    finite = finite_rows(surface.vertices)
    faces = np.where(whole_faces(surface.triangles, finite)[:, None], surface.triangles, 0)  # one vertex: not drawn
    triangles = Triangles(fours(surface.vertices), device.upload(faces[:1]), fours(surface.vertex_normals), light)
    return surface.triangle_offset, faces, triangles


def place_surfels(upload: SurfelUpload, matrix: NDArray | None, camera, size, lod: float) -> NDArray:
    """Return the view buffer of a placed surface."""
    matrix = np.eye(4) if matrix is None else matrix
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rotation = camera.rotation @ (matrix[:3, :3] / scale)
    offset = camera.rotation @ (matrix[:3, :3] @ upload.origin + matrix[:3, 3] - camera.eye)
    middle, reach = -(scale * rotation[2] @ upload.center + offset[2]), scale * upload.reach
    return view_floats(camera, size, rotation, offset, scale, lod, (middle - reach, middle + reach))


def select_surfels(device: Device, scratch: Scratch, upload: SurfelUpload, view: DeviceArray,
                   interior: float, relief: float) -> NDArray:
    """Walk the hierarchy level by level; return what becomes of every surfel, (count,) uint8, on the host."""
    state = scratch.array("surfel_state", (upload.count,), np.uint8)
    device.write(state, upload.state)
    kernel = device.kernel("render/select_surfels.cl", constants={"VW": scratch.lanes})
    for begin, end in itertools.pairwise(upload.level_end.tolist()):
        items = -(-end // scratch.lanes) - begin // scratch.lanes
        kernel((items,), (min(64, items),), view, upload.surfels, interior, relief, begin, end,
               state)
    return device.download(state, copy=False)


def project_surfels(device: Device, scratch: Scratch, upload: SurfelUpload, view: DeviceArray,
                    drawn: NDArray) -> tuple[DeviceArray, Footprints]:
    """Project the surfels `drawn`; return their records (n, 32) float32 and where they touch the picture."""
    n = len(drawn)
    device.check_memory(records=4 * RECORD_FLOATS * n, blocks=8 * n, keys=4 * n, buckets=2 * n)
    records = scratch.array("records", (n, RECORD_FLOATS), np.float32)
    full = scratch.array("full", (n, 4), np.int16)
    touch = Footprints(full, full, scratch.array("keys", (n,), np.uint32), scratch.array("buckets", (n,), np.uint16))
    items = -(-n // scratch.lanes)
    device.kernel("render/project_surfels.cl", constants={"VW": scratch.lanes})(
        (items,), (min(16, items),), view, upload.surfels, device.upload(drawn), n, records, full, touch.keys,
        touch.buckets)
    return records, touch


def tile_surfels(device: Device, scratch: Scratch, grid: Grid, upload: SurfelUpload, view: DeviceArray,
                 records: DeviceArray, pairs: PairLists, colors: DeviceArray | None, color_maps: bool, maps: bool,
                 perspective: bool, slack: float, number: int) -> None:
    """Draw the surfels of every bin into its planes; `number` is the surface's place in the scene.

    Discs that lie `slack` or more apart in depth are never blended.
    """
    constants = grid.layout.constants | {
        "VW": scratch.lanes, "TILE_BINS": grid.tile_bins, "IS_PERSPECTIVE": perspective, "MAPS": maps,
        "COLOR_MAPS": color_maps and grid.layout.color, "ONE_COLOR": colors is not None and len(colors) == 1}
    group = 64 if scratch.lanes == 1 else 1
    device.kernel("render/tile_surfels.cl", constants=constants)(
        (grid.tile_count * group,), (group,), view, pairs.pairs, pairs.offsets, records, upload.atlas,
        upload.color_atlas if color_maps else upload.atlas, view if colors is None else colors, upload.levels, number,
        slack, grid.tiles_x, grid.tile_count, grid.bins_x, grid.bins_y, grid.touched, grid.planes)


def surfel_colors(device: Device, upload: SurfelUpload, shading: Shading) -> tuple[DeviceArray, bool]:
    """Return the linear colours that a surface is drawn with, and whether its colour maps count.

    The colours are (count, 4) float32, or (1, 4): one for all.
    """
    if shading.look == "ball_size":
        radius = np.log(np.maximum(upload.radii, 1e-30))
        low, high = (float(v) for v in (radius.min(), radius.max()))
        srgb = rainbow((high - radius) / max(high - low, 1e-9))
    elif shading.look == "ball_level":
        level = device.download(upload.levels)
        srgb = rainbow((level - level.min()) / max(np.ptp(level), 1))
    elif shading.model_colors and upload.colors is not None:
        return upload.colors, upload.color_atlas is not None
    else:
        srgb = np.asarray(shading.color, np.float64)[None]
    out = np.ones((len(srgb), 4), np.float32)
    out[:, :3] = to_linear(srgb)
    return device.upload(out), False


def draw_surfels(device: Device, scratch: Scratch, grid: Grid, upload: SurfelUpload, matrix, camera, look: Look,
                 number: int) -> None:
    """Run all stages of one placed hierarchy: select, project, bin, tile."""
    if upload.count == 0:
        return
    drawing = look.surfels
    interior, lod = (drawing.interior, min(look.lod, drawing.interior))
    floats = place_surfels(upload, matrix, camera, grid.size, lod)
    view = device.upload(grid.clip_into(floats))
    state = select_surfels(device, scratch, upload, view, interior if lod > 0 else 0.0, drawing.relief)
    drawn = np.flatnonzero(state == DRAWN).astype(np.int32)
    if upload.triangles is not None:
        below = np.flatnonzero(state == BY_TRIANGLES)
        if len(below):
            draw_below(device, scratch, grid, upload, below, matrix, camera, look, number)
    if not len(drawn):
        return
    records, footprints = project_surfels(device, scratch, upload, view, drawn)
    pairs = bin_pairs(device, scratch, grid, footprints, len(drawn))
    if pairs is None:
        return
    colors, color_maps = surfel_colors(device, upload, look.shading) if grid.layout.color else (None, False)
    # Depths of blended discs differ by a slab over the least cosine; lists are in order up to a bucket.
    slack = float(1.05 / LEAN * floats[9] * upload.slabs.take(drawn).max() + floats[23])
    perspective = camera.projection(grid.size).perspective
    maps = drawing.maps and not look.shading.look.startswith("ball")
    tile_surfels(device, scratch, grid, upload, view, records, pairs, colors, color_maps, maps, bool(perspective),
                 slack, number)


def draw_below(device: Device, scratch: Scratch, grid: Grid, upload: SurfelUpload, chosen: NDArray, matrix, camera,
               look: Look, number: int) -> None:
    """Draw the triangles right below the surfels `chosen`."""
    first = upload.triangle_offset[chosen].astype(np.int64)
    count = upload.triangle_offset[chosen + 1] - first
    at = np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())
    triangles = replace(upload.triangles, faces=device.upload(upload.faces[at]))
    floats = place_triangles(camera, grid.size, matrix, upload.origin, upload.center, upload.reach, look.shading.color)
    draw_triangles(device, scratch, grid, triangles, floats, look, number)
