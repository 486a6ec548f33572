"""Scale maps in the renderer: nodes on a net of texels or on a geosphere, projection of cells and the tile stage.

Source: Reiter, "Spherical Scale Mapping", 2005, section 3. Kernels: kernels/render/scale_normals.cl, displace_nodes.cl,
project_cells.cl, tile_cells.cl.
"""

import weakref
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import DeviceMemoryError, InputError
from ..surface.arrays import lengths_of
from ..surface.cube import border_directions, bordered
from ..surface.geosphere import geosphere_directions
from ..surface.scale_map import ScaleMap
from ..surface.srgb import to_linear
from .scale_map_drawing import ScaleMapDrawing
from .shade import Look
from .tiles import Footprints, Grid, PairLists, Scratch, bin_pairs, new_footprints, view_floats

BLOCK_SIDE = 4  # kernels/render/cells.clh
RECORD_FLOATS = 16 + 32 * 16
COLOR = 26  # of the view buffer
LARGEST_NODES = 1 << 24  # whole numbers of a float: kernels/render/cells_shown.clh
LARGEST_BLOCKS = 1 << 22


@dataclass(frozen=True, eq=False)
class ScaleMapUpload:
    """A `ScaleMap` on a device; lengths in radii, relative to the centre."""

    size: int
    layers: int
    origin: NDArray  # (3,) float64
    radius: float
    reach: float  # the surface's largest distance from the centre, radii
    closed: bool  # one layer without holes
    rho: NDArray  # (layers, 6, size + 2, size + 2) float32, -1: a hole; on the host
    directions: DeviceArray  # (6, size + 2, size + 2, 3) float32
    surface: weakref.ref
    made: dict = field(default_factory=dict)

    def once(self, name, make):
        """Return ``make()``, called the first time that a frame needs it."""
        if name not in self.made:
            self.made[name] = make()
        return self.made[name]


@dataclass(frozen=True, eq=False)
class Cells:
    """Grids of nodes on the device."""

    cast: bool  # they are the map's texels
    side: int  # nodes along a side of a grid
    grids: int
    stride: int
    positions: DeviceArray  # (3, stride) float32, radii; NaN: a hole
    nodes: DeviceArray  # (grids * side^2, 4) float32: normal, distance in radii
    first_layer: int = 0  # of the map

    @property
    def blocks_side(self) -> int:
        """Blocks of 4 x 4 cells along a side of a grid."""
        return -(-(self.side - 1) // BLOCK_SIDE)

    @property
    def blocks(self) -> int:
        """All blocks."""
        return self.grids * self.blocks_side**2


def upload_scale_map(device: Device, surface: ScaleMap) -> ScaleMapUpload:
    """Put a map's distances on the device, with the border of every face.

    Raises
    ------
    InputError
        More nodes than a picture's numbers hold.
    DeviceMemoryError
    """
    size, layers = surface.size, surface.layers
    nodes = 6 * layers * (size + 2) ** 2
    if nodes > LARGEST_NODES:
        raise InputError(f"surface: expected a scale map of at most {LARGEST_NODES:,} texels to draw, got {nodes:,}: "
                         "build it with a smaller size or fewer layers")
    device.check_memory(directions=72 * (size + 2) ** 2)
    rho = np.empty((layers, 6, size + 2, size + 2), np.float32)
    for k in range(layers):
        values, valid = bordered(np.nan_to_num(surface.lambdas[k]), surface.valid[k], size)
        rho[k] = np.where(valid, values, -1)
    directions = np.ascontiguousarray(border_directions(size), np.float32)
    return ScaleMapUpload(size, layers, surface.center, surface.radius, max(float(rho.max()), 1e-6),
                          layers == 1 and bool(surface.valid.all()), rho, device.upload(directions),
                          weakref.ref(surface))


def scale_normals(device: Device, upload: ScaleMapUpload, layer: int, drawing: ScaleMapDrawing) -> NDArray:
    """Return normals and distances (6, size, size, 4) float32 at a layer's texels, as `drawing` wants them.

    Raises
    ------
    InputError
        Stored normals asked for where the map has none.
    """
    surface, size = upload.surface(), upload.size
    kind = drawing.normals
    if kind == "auto":
        kind = "gradient" if surface.normals is None else "stored"
    if kind == "stored":
        if surface.normals is None:
            raise InputError("scale map normals: expected a map with stored normals, got one without: build it with "
                             "normals=True, or draw it with normals=\"gradient\"")
        return np.concatenate([surface.unit_normals()[layer], np.nan_to_num(surface.lambdas[layer])[..., None]], axis=3)
    out = device.empty((6 * size * size, 4), np.float32)
    part = device.upload(upload.rho[layer])
    epsilon = 2 / size if drawing.epsilon is None else drawing.epsilon
    items = -(-6 * size * size // device.lanes)
    device.kernel("render/scale_normals.cl", constants={"VW": device.lanes, "GRADIENT": kind == "gradient"})(
        (items,), (min(16, items),), size, epsilon, part, upload.directions, out)
    return device.download(out).reshape(6, size, size, 4)


def bordered_normals(device: Device, upload: ScaleMapUpload, layer: int, drawing: ScaleMapDrawing) -> NDArray:
    """Return the normals of `scale_normals` with the border, (6, size + 2, size + 2, 4) float32."""
    normals, _ = bordered(scale_normals(device, upload, layer, drawing), upload.surface().valid[layer], upload.size)
    normals[..., :3] /= np.maximum(lengths_of(normals[..., :3], keepdims=True), 1e-20)
    normals[..., 3] = upload.rho[layer]
    return normals


def cells_of(device: Device, upload: ScaleMapUpload, drawing: ScaleMapDrawing, layers: range | None = None) -> Cells:
    """Return the nodes that a map, or some of its layers, are drawn with; all of them are made once for each way."""
    make = _geosphere_cells if drawing.form == "geosphere" else _texel_cells
    if layers is not None:
        return make(device, upload, drawing, layers)
    key = (drawing.form, drawing.level if drawing.form == "geosphere" else 0, drawing.normals, drawing.epsilon)
    return upload.once(key, lambda: make(device, upload, drawing, range(upload.layers)))


def _texel_cells(device, upload, drawing, layers) -> Cells:
    side = upload.size + 2
    _check_nodes(device, 6 * len(layers) * side**2)
    nodes = np.concatenate([bordered_normals(device, upload, k, drawing).reshape(-1, 4) for k in layers])
    rho = nodes[:, 3:]
    points = np.where(rho < 0, np.nan, rho) * np.tile(border_directions(upload.size).reshape(-1, 3), (len(layers), 1))
    return _cells(device, True, side, layers, 6, points, nodes)


def _geosphere_cells(device, upload, drawing, layers) -> Cells:
    steps = 2**drawing.level
    directions = geosphere_directions(steps)
    count, side = directions.size // 3, steps + 1
    if count * upload.layers > LARGEST_NODES:
        raise InputError(f"scale map level: expected at most {LARGEST_NODES:,} nodes over all layers, got "
                         f"{count * upload.layers:,}: use a lower level")
    _check_nodes(device, count * len(layers))
    host, points = [], []
    aimed = device.upload(np.ascontiguousarray(directions.reshape(-1, 3), np.float32))
    for k in layers:
        rho = device.upload(upload.rho[k])
        normals = device.upload(np.ascontiguousarray(bordered_normals(device, upload, k, drawing), np.float32))
        positions, nodes = device.empty((3, count), np.float32), device.empty((count, 4), np.float32)
        items = -(-count // device.lanes)
        device.kernel("render/displace_nodes.cl", constants={"VW": device.lanes})(
            (items,), (min(16, items),), count, upload.size, rho, normals, aimed, count, positions, nodes)
        points.append(device.download(positions).T)
        host.append(device.download(nodes))
    return _cells(device, False, side, layers, 10, np.concatenate(points), np.concatenate(host))


def _check_nodes(device: Device, count: int) -> None:
    device.check_memory(positions=12 * count, nodes=16 * count)


def _cells(device, cast, side, layers, grids, points, nodes) -> Cells:
    count = len(points)
    stride = -(-(count + BLOCK_SIDE * side + BLOCK_SIDE) // 64) * 64  # blocks read past the last node
    positions = np.full((3, stride), np.nan, np.float32)
    positions[:, :count] = points.T
    nodes = np.ascontiguousarray(nodes, np.float32)
    cells = Cells(cast, side, grids * len(layers), stride, device.upload(positions), device.upload(nodes), layers[0])
    if cells.blocks > LARGEST_BLOCKS:
        raise InputError(f"scale map: expected at most {LARGEST_BLOCKS:,} blocks of cells, got {cells.blocks:,}: use a "
                         "smaller size or a lower level")
    return cells


def place_scale_map(upload: ScaleMapUpload, matrix: NDArray | None, camera, size, color) -> tuple[NDArray, bool]:
    """Return the view buffer of a placed map, its lengths in radii, and whether its far side can be left out."""
    matrix = np.eye(4) if matrix is None else matrix
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rotation = camera.rotation @ (matrix[:3, :3] / scale)
    offset = camera.rotation @ (matrix[:3, :3] @ upload.origin + matrix[:3, 3] - camera.eye)
    unit = scale * upload.radius
    reach = unit * upload.reach
    middle = -offset[2]
    nearest = max(camera.near, 0.0) if camera.projection(size).perspective else camera.near
    view = view_floats(camera, size, rotation, offset, unit, 0.0, (max(middle - reach, nearest), middle + reach))
    view[COLOR:COLOR + 3] = to_linear(color)
    # Seen from outside and not cut open by the near plane, a closed surface hides its far side.
    return view, upload.closed and bool(middle - reach > nearest)


def project_cells(device: Device, scratch: Scratch, cells: Cells, view: DeviceArray, cull: bool,
                  blocks: range | None = None) -> tuple[DeviceArray, Footprints]:
    """Return the records of some blocks, None: all, and where they touch the picture."""
    blocks = range(cells.blocks) if blocks is None else blocks
    count = len(blocks)
    device.check_memory(records=4 * RECORD_FLOATS * count)
    records = scratch.array("records", (count, RECORD_FLOATS), np.float32)
    touch = new_footprints(device, scratch, count)
    device.kernel("render/project_cells.cl", constants={"VW": scratch.lanes, "CULL": cull, "WHOLE": cells.cast})(
        (count,), (min(64, count),), view, cells.positions, cells.stride, cells.side, cells.blocks_side, blocks.start,
        count, records, touch.full, touch.core, touch.keys, touch.buckets)
    return records, touch


def tile_cells(device: Device, scratch: Scratch, grid: Grid, cells: Cells, view: DeviceArray, records: DeviceArray,
               pairs: PairLists, number: int) -> None:
    """Draw the cells of every bin into its planes; `number` is the surface's place in the scene."""
    group = 64 if scratch.lanes == 1 else 1
    constants = grid.layout.constants | {"VW": scratch.lanes, "CAST": cells.cast, "TILE_BINS": grid.tile_bins}
    device.kernel("render/tile_cells.cl", constants=constants)(
        (grid.tile_count * group,), (group,), view, pairs.pairs, pairs.offsets, records, cells.nodes, cells.side,
        cells.side**2, cells.first_layer, number, grid.tiles_x, grid.tile_count, grid.bins_x, grid.bins_y, grid.touched,
        grid.planes)


def draw_scale_map(device: Device, scratch: Scratch, grid: Grid, upload: ScaleMapUpload, matrix, camera, look: Look,
                   number: int) -> None:
    """Draw one placed map; layers and blocks that the device does not hold at once, one after the other."""
    floats, cull = place_scale_map(upload, matrix, camera, grid.size, look.shading.color)
    view, cull = device.upload(grid.clip_into(floats)), cull and not grid.layout.clip_planes

    def draw(cells: Cells, blocks: range) -> None:
        try:
            records, footprints = project_cells(device, scratch, cells, view, cull, blocks)
            pairs = bin_pairs(device, scratch, grid, footprints, len(blocks))
        except DeviceMemoryError:
            if len(blocks) < 2:
                raise
        else:
            if pairs is not None:
                tile_cells(device, scratch, grid, cells, view, records, pairs, number)
            return
        for half in (blocks[:len(blocks) // 2], blocks[len(blocks) // 2:]):
            draw(cells, half)

    try:
        cells = cells_of(device, upload, look.scale_map)
    except DeviceMemoryError:
        if upload.layers < 2:
            raise
    else:
        draw(cells, range(cells.blocks))
        return
    for k in range(upload.layers):
        cells = cells_of(device, upload, look.scale_map, range(k, k + 1))
        draw(cells, range(cells.blocks))
        device.finish()  # what still runs keeps its memory
        cells = None  # room for the next
