"""Spatial patches in the renderer: upload, projection and the tile stage.

Source: the paper on spatial patches, section 3. Kernels: kernels/render/*patch*.cl, kernels/common/patch.clh.
"""

import weakref
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface
from ..surface.srgb import LINEAR_OF_BYTE, linear_color, to_linear
from .patch_drawing import PatchDrawing
from .patch_forms import WIDEST_SPACING_PX, cull_patches, surface_form
from .patch_lattice import CELLS
from .patch_nodes import LIT_UNIT, light_nodes, table_normals
from .patch_tiles import NODES, PAD, tile_patches
from .shade import Look, Shading, new_channels, shade_constants
from .tiles import Grid, Scratch, view_floats

FRAME_FLOATS, PATCH_FLOATS = 16, 24  # kernels/common/patch.clh
LAYERS = (1 << 20) - 2  # kernels/render/patch_cells.clh
LAYER_SPACINGS = 0.25  # samples of one surface within this many node spacings of depth are one layer
LARGEST_RIM = 16383.0  # kernels/common/patch.clh
LARGEST_COUNT = (1 << 32) - 2  # a node's number is a payload of 32 bits


@dataclass(frozen=True, eq=False)
class PatchUpload:
    """A `PatchSurface` on a device (kernels/common/patch.clh)."""

    count: int
    channels: int  # bytes of a node's colour: 0, 3, 4
    precise: bool
    frames: DeviceArray  # (count, FRAME_FLOATS) float32
    sizes: DeviceArray  # (count, 2) int32
    offsets: DeviceArray  # (count + 1,) uint32
    heights: DeviceArray  # (N,) int8 or int32
    colors: DeviceArray  # (N * channels,) uint8
    color: NDArray | None  # (3,) float64, linear
    largest_border: float  # model units
    spacing: float  # median node spacing, model units
    origin: NDArray  # (3,) float64
    center: NDArray  # (3,) float64, relative to origin
    reach: float  # everything lies within this of `center`
    steps: DeviceArray  # (N + PAD,) float32: displacements
    rims: DeviceArray  # (N + PAD,) uint16: distance to the border, and what is drawn
    nodes: DeviceArray  # (N + PAD, 4) uint32: displacement, linear colour, slopes
    equal_nodes: int  # nodes of every patch, 0: they differ
    surface: weakref.ref  # for what only some modes need: a strong one would keep the surface for ever
    made: dict = field(default_factory=dict)

    def once(self, name: str, make):
        """Return ``make(surface)``, called the first time that a frame needs it."""
        if name not in self.made:
            self.made[name] = make(self.surface())
        return self.made[name]


@dataclass(frozen=True, eq=False)
class Projected:
    """The patches of one surface as one camera sees them."""

    records: DeviceArray  # (count, PATCH_FLOATS, with trilinear nodes 24 more) float32: kernels/common/patch.clh
    rectangles: DeviceArray  # (count, 4) int32: first and last pixel that a patch may touch; first > last: none
    boxes: DeviceArray  # (4, at least count) int16: the same in bins, all first x, all first y, all last x, all last y
    upload: PatchUpload  # of the patches that are drawn: where patches have levels, of the chosen ones
    levels: DeviceArray | None  # (count,) int32: those levels


def patch_constants(upload: PatchUpload) -> dict[str, int]:
    """Return the constants of every kernel that reads patches."""
    return {"CHANNELS": upload.channels, "PRECISE": upload.precise}


def upload_patches(device: Device, surface: PatchSurface) -> PatchUpload:
    """Put a surface on the device, with what the renderer needs to know of its nodes.

    Raises
    ------
    InputError
        More nodes than an index holds.
    DeviceMemoryError
    """
    p, nodes = len(surface), surface.node_count
    if nodes > LARGEST_COUNT:
        raise InputError(f"surface: expected at most {LARGEST_COUNT:,} nodes to draw, got {nodes:,}: split it")
    device.check_memory(nodes=surface.displacements.nbytes + 35 * nodes, patches=4 * FRAME_FLOATS * p)
    frames = np.zeros((max(p, 1), FRAME_FLOATS), np.float32)
    for i, values in enumerate((surface.origins, surface.axis_x, surface.axis_y, surface.axis_z)):
        frames[:p, 3 * i:3 * i + 3] = values
    frames[:p, 12:14] = surface.displacement_ranges
    shown = frames[:p, 12] <= frames[:p, 13]
    boxes = surface.boxes()[shown].reshape(-1, 3) - surface.origin
    center = (boxes.min(axis=0) + boxes.max(axis=0)) / 2 if len(boxes) else np.zeros(3)
    reach = float(lengths_of(boxes - center).max()) if len(boxes) else 0.0
    spacing = float(np.median(lengths_of(surface.axis_x))) if p else 1.0
    channels = 0 if surface.colors is None else surface.colors.shape[1]
    heights = device.upload(surface.displacements if nodes else np.zeros(1, np.int8))
    colors = device.upload(surface.colors.reshape(-1) if channels and nodes else np.zeros(4, np.uint8))
    sizes = device.upload(np.ascontiguousarray(surface.size))
    offsets = device.upload(surface.node_offset.astype(np.uint32))
    # pack_patches writes into the frames, and an upload may be read-only.
    host_frames, frames = frames, device.empty(frames.shape, np.float32)
    device.write(frames, host_frames)
    precise = surface.displacements.dtype == np.int32
    cells, borders, slopes = prepare_patches(device, {"CHANNELS": channels, "PRECISE": precise}, frames, sizes, offsets,
                                             p, colors, heights)
    largest = float(device.download(borders, copy=False)[:nodes].max(initial=0.0)) if nodes else 0.0
    color = None if surface.color is None else to_linear(surface.color / 255)
    linear = device.upload(LINEAR_OF_BYTE.astype(np.float32))
    steps, rims = device.zeros(nodes + PAD, np.float32), device.zeros(nodes + PAD, np.uint16)
    packed = device.zeros((nodes + PAD, 4), np.uint32)
    device.kernel("render/pack_patches.cl", constants={"CHANNELS": channels, "PRECISE": precise})(
        (p,), None, frames, sizes, offsets, p, colors, linear, heights, cells, borders, slopes,
        LARGEST_RIM / max(largest, 1e-30), steps, rims, packed)
    return PatchUpload(p, channels, precise, frames, sizes, offsets, heights, colors, color, largest, spacing,
                       surface.origin, center, reach, steps, rims, packed,
                       int(surface.size[0].prod()) if p and surface.equal_sizes else 0, weakref.ref(surface))


def prepare_patches(device: Device, constants: dict, frames: DeviceArray, sizes: DeviceArray, offsets: DeviceArray,
                    count: int, colors: DeviceArray, heights: DeviceArray) -> tuple[DeviceArray, ...]:
    """Work out what the packing of nodes needs to know of them.

    Returns
    -------
    cells : (N,) uint8
        1 where the cell is drawn.
    borders : (N,) float32
        Distance to the border of what is drawn, model units.
    slopes : (N, 2) float32
        Displacement steps per node.
    """
    nodes = heights.shape[0]
    out = device.empty(nodes, np.uint8), device.empty(nodes, np.float32), device.empty((nodes, 2), np.float32)
    device.kernel("render/prepare_patches.cl", constants=constants)(
        (count,), None, frames, sizes, offsets, count, colors, heights, *out)
    return out


def place_patches(upload: PatchUpload, matrix: NDArray | None, camera, size, shading: Shading) -> NDArray:
    """Return the view buffer of a placed surface, kernels/common/view.clh and patch.clh."""
    if matrix is None:
        scale, rotation, offset = 1.0, camera.rotation, camera.rotation @ (upload.origin - camera.eye)
    else:
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        rotation = camera.rotation @ (matrix[:3, :3] / scale)
        offset = camera.rotation @ (matrix[:3, :3] @ upload.origin + matrix[:3, 3] - camera.eye)
    middle, reach = -(scale * rotation[2] @ upload.center + offset[2]), scale * upload.reach
    first = middle - reach
    if camera.projection(size).perspective:
        first = max(first, 0.0)
    view = view_floats(camera, size, rotation, offset, scale)
    layer = max(LAYER_SPACINGS * scale * upload.spacing, (middle + reach - first) / LAYERS, 1e-30)
    view[22], view[24] = first, 1 / layer
    view[25] = 4095.99 / max(upload.largest_border, 1e-30)
    own = shading.model_colors and upload.color is not None
    view[26:29] = upload.color if own else linear_color(shading.color)
    return view


def project_patches(device: Device, upload: PatchUpload, view: DeviceArray, drawing: PatchDrawing,
                    levels: int = 1) -> Projected:
    """Project the patches of an upload, with several `levels` a patch the coarsest that shows every pixel's detail.

    The arrays are the upload's own: valid until its patches are projected again.
    """
    nodes = NODES[drawing.nodes]
    out = upload.once(("projected", bool(nodes), levels), lambda _: _new_projected(device, upload, nodes, levels))
    chosen = out.upload
    device.kernel("render/project_patches.cl", constants=patch_constants(upload) | {
        "NODES": nodes, "OVERSHOOT": "0.3f" if drawing.cells == "smooth" else "0.0f", "LEVELS": levels > 1,
        "DIRECT": drawing.direct and drawing.cells not in CELLS and not drawing.alpha})(
        (chosen.count + 1,), (16,), view, upload.frames, upload.sizes, upload.offsets, chosen.count, levels,
        WIDEST_SPACING_PX, out.boxes.shape[1], out.records, out.rectangles, out.boxes, chosen.frames, chosen.sizes,
        chosen.offsets, chosen.sizes if out.levels is None else out.levels)
    return out


def _new_projected(device, upload, nodes, levels) -> Projected:
    count = upload.count // levels
    room, chosen = max(count, 1), None
    if levels > 1:
        upload = replace(upload, count=count, frames=device.empty((room, FRAME_FLOATS), np.float32), equal_nodes=0,
                         sizes=device.empty((room, 2), np.int32), offsets=device.empty((count + 1,), np.uint32))
        chosen = device.empty((room,), np.int32)
    return Projected(device.empty((room, PATCH_FLOATS + 24 * bool(nodes)), np.float32),
                     device.empty((room, 4), np.int32), device.empty((4, -(-room // PAD) * PAD), np.int16), upload,
                     chosen)


def draw_patches(device: Device, scratch: Scratch, grid: Grid, upload: PatchUpload, matrix, camera, look: Look,
                 number: int) -> None:
    """Draw one placed surface into the planes of a grid."""
    if upload.count:
        floats = grid.clip_into(place_patches(upload, matrix, camera, grid.size, look.shading))
        _stages(device, scratch, grid, upload, floats, device.upload(floats), look, look.lamps, number)


def shade_patches(device: Device, scratch: Scratch, grid: Grid, upload: PatchUpload, matrix, camera, look: Look,
                  whole: NDArray, lamps: NDArray, channels) -> dict[str, DeviceArray]:
    """Draw a frame of one surface, from projection to shading, without planes; return its channels on the device.

    `whole` is the view buffer of the frame, `lamps` the shading buffer.
    """
    floats = grid.clip_into(place_patches(upload, matrix, camera, grid.size, look.shading))
    view = device.upload(np.concatenate([floats, whole, lamps]))
    lamps = device.upload(lamps) if grid.layout.lit else None
    return _stages(device, scratch, grid, upload, floats, view, look, lamps, 0, channels)


def _stages(device, scratch, grid, upload, floats, view, look, lamps, number, channels=None) -> dict | None:
    """Run the stages of one surface: project, work at the nodes where a mode asks for it, tile.

    With `channels` the tiles are shaded into those of a picture, which are returned; else they go into the planes.
    """
    drawing = look.patches
    form = surface_form(device, upload, upload_patches, floats, drawing)
    whole, levels = (upload, 1) if form is None else (form.upload, form.levels)
    projected = project_patches(device, whole, view, drawing, levels)
    upload = projected.upload
    out = None if channels is None else new_channels(device, grid.size, channels)  # while the patches are projected
    if drawing.cull and drawing.cells != "smooth":  # the cones hold the normals of facets
        cull_patches(device, upload, whole, levels, projected.levels, view, projected)
    constants = patch_constants(upload)
    if drawing.normal_table:
        nodes, _ = table_normals(device, scratch, upload, constants, projected.rectangles, drawing.normal_table)
        upload = replace(upload, nodes=nodes)
    constants |= grid.layout.constants
    if not (grid.layout.color and look.shading.model_colors):
        constants["CHANNELS"] = 0
    if grid.layout.lit:
        nodes = light_nodes(device, scratch, upload, constants, view, lamps, projected.rectangles)
        upload = replace(upload, nodes=nodes)
        constants |= {"CHANNELS": 3, "COLOR_UNIT": LIT_UNIT}
    if out is not None:
        constants |= shade_constants(grid, look.shading.look, tuple(out))
    tile_patches(device, scratch, grid, upload, constants, view, projected, number, look, out)
    return out
