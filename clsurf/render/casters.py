"""What hides lamps from the points of a picture: everything that can be traced casts.

Kinds with packets (`clsurf.trace.kinds.Traced.packets`) cast by packets from the lamps, all others by a single ray from
each point. Kernels: kernels/trace/trace_lights.cl; kernels/trace/lamp_rays.cl, lamp_bits.cl.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..trace.kinds import ANY, Traced, traceable
from ..trace.packets import packet_lanes, trace_lights
from ..trace.pieces import Held, held
from ..trace.single import HIT_FLOATS, RAY_FLOATS, placement
from .tiles import Grid, Scratch, view_floats

HEADLIGHT = 0  # a lamp's kind: at the eye
STEPS = 1.5  # grains of a caster that single rays start above the points: in a cell of patches they meet two triangles
CHUNK = 1 << 17  # rays of one launch


@dataclass(frozen=True, eq=False)
class Caster:
    """One surface of a scene as an obstacle, placed, seen by the picture's camera."""

    held: Held
    matrix: NDArray  # (4, 4) float64, model to world
    step: float  # world units within which the surface's own points are no obstacles


@dataclass(frozen=True, eq=False)
class Casters:
    """All obstacles of a picture, those with packets first; `pixels`: where it shows something."""

    packets: list[Caster]
    singles: list[Caster]
    camera: object
    view: DeviceArray  # of the camera
    pixels: DeviceArray  # int32: bin * 64 + pixel; filled for `singles` only


def casters_of(device: Device, grid: Grid, scene, camera) -> Casters:
    """Return what casts in a scene whose bins are drawn."""
    packets, singles = [], []
    for surface, matrix in scene.placed:
        if not traceable(surface):
            continue
        one = held(device, surface)
        if one.empty:
            continue
        matrix = np.eye(4) if matrix is None else matrix
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        (packets if one.packets else singles).append(Caster(one, matrix, STEPS * scale * one.grain))
    pixels = np.zeros(0, np.int32)
    if singles:
        depth = device.download(grid.planes, copy=False)[:, 0]
        seen = (depth < np.inf) & (device.download(grid.touched, copy=False) >= 0)[:, None]
        pixels = np.flatnonzero(seen).astype(np.int32)
    return Casters(packets, singles, camera, device.upload(view_floats(camera, grid.size)), device.upload(pixels))


def fresh_mask(device: Device, scratch: Scratch, casters: Casters, name: str, bins: int, words: int,
               lamps: NDArray) -> DeviceArray:
    """Return a mask (bins, words, 64) uint32 for `cast`: of nothing hidden, but where packets write all of it."""
    mask = scratch.array(name, (bins, words, 64), np.uint32)
    if not casters.packets or not len(lamps) or casters.packets[0].held.whole is None:
        device.fill(mask, 0)
    return mask


def cast(device: Device, scratch: Scratch, grid: Grid, casters: Casters, lamps: NDArray, reach: float,
         mask: DeviceArray) -> None:
    """Fill the mask (bins, words, 64) uint32 with the lamps that are hidden by any of the casters, 32 a word.

    Without packets, what is in the mask stays (`fresh_mask`).

    Parameters
    ----------
    lamps : (n, 8) float32
        Kind (0: at the eye, 1: directional, 2: point), then the direction to it or its place, view space.
    reach : float
        World units: what lies farther than this before a point does not count; inf: everything counts.
    """
    if not len(lamps):
        return
    parts = [lamps[first:first + 32] for first in range(0, len(lamps), 32)]
    parts = [(part, device.upload(np.ascontiguousarray(part, np.float32))) for part in parts]
    stride = 64 * mask.shape[1]
    for i, caster in enumerate(casters.packets):
        fresh = i == 0 and caster.held.whole is not None

        def hide(traced, _, caster=caster, fresh=fresh):
            view = device.upload(occluder_view(traced.packets.origin, caster.matrix, casters.camera, grid.size))
            for word, (part, on_device) in enumerate(parts):
                trace_lights(device, packet_lanes(scratch.lanes), traced.packets, view, grid.layout.constants,
                             on_device, len(part), reach, fresh, grid.bins_x, grid.bins_y, grid.touched, grid.planes,
                             mask, stride, 64 * word)

        caster.held.each(hide, rays=False)
    if casters.pixels.shape[0]:
        for caster in casters.singles:
            cast_singly(device, scratch, grid, casters, caster, parts, reach, mask)


def cast_singly(device: Device, scratch: Scratch, grid: Grid, casters: Casters, caster: Caster, parts: list,
                reach: float, mask: DeviceArray) -> None:
    """Do `cast` for one caster by single rays; `parts`: the lamps of each word, here and on the device."""
    count, stride = casters.pixels.shape[0], 64 * mask.shape[1]
    chunk = min(count, CHUNK, max(device.largest_buffer_bytes // (4 * RAY_FLOATS), 64))
    rays = scratch.array("lamp_rays", (chunk, RAY_FLOATS), np.float32)
    hits = scratch.array("lamp_hits", (chunk, HIT_FLOATS), np.float32)
    make = device.kernel("trace/lamp_rays.cl", constants=grid.layout.constants)
    take = device.kernel("trace/lamp_bits.cl")

    def hide(traced, _):
        place = device.upload(view_placement(traced, caster.matrix, casters.camera))
        for first in range(0, count, chunk):
            some = min(chunk, count - first)
            for word, (lamps, on_device) in enumerate(parts):
                for lamp in np.flatnonzero(lamps[:, 0] != HEADLIGHT):
                    make((some,), (64,), some, first, casters.pixels, casters.view, place, on_device, lamp, caster.step,
                         reach, grid.bins_x, grid.planes, mask, stride, 64 * word, rays)
                    traced.launch(ANY, some, rays, hits)
                    take((some,), (64,), some, first, casters.pixels, hits, lamp, mask, stride, 64 * word)

    caster.held.each(hide)


def view_placement(traced: Traced, matrix: NDArray, camera) -> NDArray:
    """Return 13 float32: view space to a placed surface's frame, row by row; the world length of a frame's unit."""
    back = placement(traced, matrix)
    linear, zero = back[:12].reshape(3, 4)[:, :3], back[:12].reshape(3, 4)[:, 3]
    place = np.hstack([linear @ camera.rotation.T, (linear @ camera.eye + zero)[:, None]])
    return np.append(place.ravel(), back[12]).astype(np.float32)


def occluder_view(origin: NDArray, matrix: NDArray | None, camera, size) -> NDArray:
    """Return the view buffer (kernels/common/view.clh) of a placed surface, `origin` its model's zero, that casts."""
    matrix = np.eye(4) if matrix is None else matrix
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    zero = matrix[:3, :3] @ origin + matrix[:3, 3]
    return view_floats(camera, size, camera.rotation @ (matrix[:3, :3] / scale), camera.rotation @ (zero - camera.eye),
                       scale)
