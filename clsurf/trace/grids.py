"""Rays on a picture's grid: one origin and a plane of directions, or one direction and a plane of origins, row by row.

Such rays, as `Camera.rays` gives them, go to the packets (clsurf/trace/packets.py). Kernels: kernels/trace/on_grid.cl,
grid_hits.cl.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from .kinds import Traced
from .packets import packet_lanes, trace_pixels

FEWEST = 4096  # rays; fewer are traced one by one
FARTHEST = 16.0  # diagonals of a surface: from farther away float32 depth tells less than single rays do
WIDEST = 1 << 16  # rays of a row
LAYOUT = {"FIELDS": 5, "FIELD_SLOT": 4}  # depth, normal, slot
VIEW_FLOATS = 64  # kernels/common/view.clh


@dataclass(frozen=True, eq=False)
class Grid:
    """Ray (x, y), counted from 0, runs from `origin` along corner + x right + y down, or from there along `origin`.

    All are world space, float64 (3,).
    """

    width: int
    height: int
    origin: NDArray  # of all rays, or the direction of all, unit
    corner: NDArray
    right: NDArray
    down: NDArray
    perspective: bool

    @property
    def axes(self) -> tuple[NDArray, float, float]:
        """Unit axes right, up, back (3, 3) of the picture, and the lengths of one step right and down."""
        across, along = np.linalg.norm(self.right), np.linalg.norm(self.down)
        x, y = self.right / across, -self.down / along
        return np.stack([x, y, np.cross(x, y)]), float(across), float(along)


def grid_of(device: Device, rays) -> Grid | None:
    """Return the grid that rays (`clsurf.trace.hits.Rays`) lie on, to a thousandth of its steps; None: on none."""
    o, d = rays.origins, rays.directions
    if rays.count < FEWEST or rays.near.any() or not np.isposinf(rays.far).all():
        return None
    perspective = len(o) == 1 or bool((o[0] == o[[1, -1]]).all())
    if (len(d) != rays.count and perspective) or (len(o) != rays.count and not perspective):
        return None
    with np.errstate(all="ignore"):
        found = _perspective(o[0], d) if perspective else _parallel(o, d[0])
    if found is None or not all(np.isfinite(array).all() for array in (found.corner, found.right, found.down)):
        return None
    # Steps at right angles, the handedness of a picture, and nothing behind the eye.
    axes, across, along = found.axes
    middle = found.corner if perspective else -found.origin
    if abs(axes[0] @ axes[1]) > 1e-9 or (perspective and not axes[2] @ middle < 0):
        return None
    if not perspective and not axes[2] @ middle > 1 - 1e-12:
        return None
    off = device.upload(np.zeros(1, np.int32))
    numbers = np.concatenate([found.origin, found.corner, found.right, found.down])
    device.kernel("trace/on_grid.cl")((rays.count,), (64,), rays.count, found.width, int(perspective),
                                      device.upload(numbers), 1e-3 * min(across, along), device.upload(o),
                                      rays.step("origins"), device.upload(d), rays.step("directions"), off)
    return None if device.download(off)[0] else found


def _perspective(origin: NDArray, directions: NDArray) -> Grid | None:
    """Return the grid through the corners of directions (n, 3): the first row lies in one plane with the origin."""
    d = directions[:WIDEST + 1]
    normal = np.cross(d[0], d[1])
    away = np.abs(d @ (normal / np.linalg.norm(normal))) > 1e-6 * np.sqrt((d * d).sum(axis=1))
    width = int(away.argmax())
    if not away.any() or width < 2 or len(directions) % width:
        return None
    a, b, c, e = directions[[0, width - 1, -width, -1]]
    try:
        right, down, _ = np.linalg.solve(np.stack([b, c, -e], axis=1), a)
    except np.linalg.LinAlgError:
        return None
    height = len(directions) // width
    grid = Grid(width, height, origin, a, (right * b - a) / (width - 1), (down * c - a) / max(height - 1, 1), True)
    return grid if right > 0 and down > 0 else None


def _parallel(origins: NDArray, direction: NDArray) -> Grid | None:
    """Return the grid of origins (n, 3): the first row lies on a line."""
    o = origins[:WIDEST + 1] - origins[0]
    step = o[1] / np.linalg.norm(o[1])
    apart = np.abs(o - (o @ step)[:, None] * step).max(axis=1) > 1e-3 * np.linalg.norm(o[1])
    width = int(apart.argmax())
    if not apart.any() or width < 2 or len(origins) % width:
        return None
    height = len(origins) // width
    return Grid(width, height, direction / np.linalg.norm(direction), origins[0], o[width - 1] / (width - 1),
                (origins[-width] - origins[0]) / max(height - 1, 1), False)


def grid_view(grid: Grid, held: Traced, matrix: NDArray | None) -> NDArray | None:
    """Return the view buffer (kernels/common/view.clh) of a placed surface; None: too far away for float32."""
    matrix = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    axes, across, along = grid.axes
    eye = grid.origin if grid.perspective else grid.corner
    corner = axes @ grid.corner
    zero = axes @ (matrix[:3, :3] @ held.packets.origin + matrix[:3, 3] - eye)
    box = scale * held.unit * held.box
    diagonal, reach = np.linalg.norm(box[1] - box[0]), np.linalg.norm(zero) + np.abs(box).max()
    if not reach < FARTHEST * diagonal:
        return None
    out = np.zeros(VIEW_FLOATS, np.float32)
    out[:9] = (axes @ matrix[:3, :3] / scale).ravel()
    out[9], out[10:13] = scale, zero
    depth = -corner[2] if grid.perspective else 1.0
    out[13:15] = depth / across, depth / along
    # The centre of pixel (x, y) is at x + 0.5.
    out[15:17] = (0.5 - corner[0] / across, 0.5 + corner[1] / along) if grid.perspective else (0.5, 0.5)
    out[17:21] = grid.perspective, 0.0, grid.width, grid.height
    return out


def trace_grid(device: Device, grid: Grid, held: Traced, view: NDArray):
    """Trace all rays of a grid; return hits (rays, 8) float32 as single rays have them (kernels/trace/ray_walk.clh)."""
    bins_x, bins_y = -(-grid.width // 8), -(-grid.height // 8)
    touched = device.empty((bins_x * bins_y,), np.int32)
    planes = device.empty((bins_x * bins_y, LAYOUT["FIELDS"], 64), np.float32)
    device.fill(touched, -1)
    on_device, count = device.upload(view), grid.width * grid.height
    trace_pixels(device, packet_lanes(device.lanes), held.packets, on_device, LAYOUT, 0, None, bins_x, bins_y, touched,
                 planes)
    hits = device.empty((count, 8), np.float32)
    device.kernel("trace/grid_hits.cl", constants=LAYOUT)(
        (count,), (64,), count, grid.width, bins_x, on_device, touched, planes, held.order, 1 / held.unit, hits)
    return hits
