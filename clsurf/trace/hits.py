"""Rays against surfaces: where they hit. The public function `trace` and its result.

The tree and the kernels: clsurf/trace/tree.py, kernels/trace. What can be traced: clsurf/trace/kinds.py.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, open_device
from ..errors import Cancelled, InputError
from ..io.stored import StoredSurface
from ..surface.placed import Placed
from . import ray_scale_map, ray_slim, ray_surfels, ray_triangles  # noqa: F401  they register their kinds
from .grids import grid_of, grid_view, trace_grid
from .kinds import ANY, CLOSEST, NEXT, traced
from .single import (
    HIT_FLOATS,
    HIT_PRIMITIVE,
    RAY_FLOATS,
    finish_rays_host,
    has_doubles,
    placement,
    start_rays_host,
)
from .stored import merged, trace_stored

QUERIES = {"closest": CLOSEST, "any": ANY, "all": NEXT}
CHUNK = 1 << 17  # rays of one launch: what is kept of them, 72 bytes each, stays in the caches
SLAB = 1 << 22  # rays on the device at a time


@dataclass(frozen=True, eq=False, repr=False)
class Hits:
    """Where rays hit, world space.

    For the queries "closest" and "any" the arrays have the shape of the rays (here: n); for "all" they hold the hits of
    all rays, nearest first within each, and those of ray i (counted through the rays' shape) are
    ``offsets[i]:offsets[i + 1]``.

    Attributes
    ----------
    distance : (n,) float64
        From the ray's origin, world units whatever the direction's length; inf: missed.
    position : (n, 3) float64
        NaN: missed.
    normal : (n, 3) float64
        Unit, toward the side that the ray comes from; NaN: missed. Of meshes, patches and hybrid hierarchies the
        triangle's own, which the renderer's smooth normals are near to.
    surface : (n,) int32
        Number of the surface in the scene or list, 0 for a single surface; -1: missed.
    primitive : (n,) int32
        What was hit of it: a mesh's face, a SLIM surface's or hierarchy's frontmost surfel, a patch; -1: missed.
    offsets : (rays + 1,) int64 or None
        Only for "all".
    """

    distance: NDArray
    position: NDArray
    normal: NDArray
    surface: NDArray
    primitive: NDArray
    offsets: NDArray | None = None

    @property
    def hit(self) -> NDArray:
        """Which rays hit something: bool, in the rays' shape (for "all": (rays,))."""
        return np.isfinite(self.distance) if self.offsets is None else np.diff(self.offsets) > 0

    def __repr__(self):
        if self.offsets is not None:
            return f"Hits({len(self.distance):,} of {len(self.offsets) - 1:,} rays)"
        return f"Hits({int(self.hit.sum()):,} of {self.distance.size:,} rays hit)"


def trace(thing, origins, directions, query: str = "closest", near=0.0, far=np.inf, device=None,
          progress=None) -> Hits:
    """Return where rays hit a surface, a mesh, or the surfaces of a scene.

    A SLIM surface is hit where the renderer draws it without level of detail: frontmost surfels, blended. A mesh and
    the cells of spatial patches (two triangles each; cells with a transparent node are no obstacle) are hit without
    leaks along edges and at vertices. Of a surfel hierarchy the finest level is hit: base surfels, blended, or
    triangles.

    Parameters
    ----------
    thing : SlimSurface, StoredSurface, PatchSurface, SurfelHierarchy, ScaleMap, Mesh, a placed one, a Scene, or a list
        Of a StoredSurface the parts on the rays' way are read, within its budget.
    origins, directions : (..., 3) array_like
        World space, float64; broadcast against each other. Directions need not be unit; a ray whose direction is zero
        or whose numbers are not finite misses.
    query : str
        "closest"; "any": some hit, not always the nearest, and not blended, which is faster; "all": where spatial
        patches overlap, each of them is hit.
    near, far : float or (...) array_like
        Hits are looked for between these distances (world units), `near` itself left out: for rays that start on the
        surface. Rays that start at a hit of SLIM surfels, discs or patches meet their neighbours there: start them
        1/20 of a median radius (of patches: of a node's spacing) up `Hits.normal`, with `near` half of it.
    device : None, str or Device
    progress : function, optional
        ``progress(stage, share done)``; False stops the work.

    Returns
    -------
    Hits

    Raises
    ------
    InputError
        Something that cannot be traced, another query, arrays of the wrong shape or limits that are not numbers.
    DeviceMemoryError
    """
    if query not in QUERIES:
        raise InputError(f"query: expected one of {', '.join(QUERIES)}, got {query!r}")
    opened = open_device(device)
    rays = checked_rays(origins, directions, near, far)
    parts = [(number, *part) for number, part in enumerate(parts_of(thing))]
    if any(isinstance(surface, StoredSurface) for _, surface, _ in parts):
        return _with_stored(parts, rays, query, opened)
    # All surfaces are put on the device, and refused, before the first ray.
    parts = [(number, held, placement(held, matrix), matrix) for number, surface, matrix in parts
             for held in [traced(opened, surface)] if not held.empty]
    tracer = _All(opened, rays) if query == "all" else _Nearest(opened, rays, QUERIES[query])
    by_packets, parts = picture_parts(opened, rays, parts) if query != "all" else ([], [part[:3] for part in parts])
    for start in range(0, rays.count, SLAB):
        stop = min(start + SLAB, rays.count)
        tracer.open(start, stop, empty=not parts and not by_packets)
        for i, (number, hits, place) in enumerate(by_packets):
            tracer.merge(number, place, hits, start, stop - start, fresh=i == 0)
        for first in range(start, stop, CHUNK):
            for i, (number, held, place) in enumerate(parts):
                tracer.run(number, held, place, first, min(CHUNK, stop - first), fresh=i == 0 and not by_packets)
            if progress is not None and progress("trace", min(first + CHUNK, stop) / rays.count) is False:
                raise Cancelled("trace: stopped")
        tracer.close(start, stop)
    return tracer.result()


def _with_stored(parts: list, rays: "Rays", query: str, device: Device) -> Hits:
    """Trace surfaces of which some stay in their store: those one by one, all others together."""
    others = [(number, surface if matrix is None else Placed(surface, matrix)) for number, surface, matrix in parts
              if not isinstance(surface, StoredSurface)]
    hits, numbers = [], []
    for number, surface, matrix in parts:
        if isinstance(surface, StoredSurface):
            hits.append(trace_stored(surface, matrix, rays, query, device))
            numbers.append([number])
    if others:
        flat = [np.broadcast_to(array, (rays.count, *array.shape[1:])) for array in
                (rays.origins, rays.directions, rays.near, rays.far)]
        hits.append(trace([surface for _, surface in others], *flat[:2], query, *flat[2:], device))
        numbers.append([number for number, _ in others])
    return merged(hits, numbers, rays, query)


def picture_parts(device: Device, rays: "Rays", parts: list) -> tuple[list, list]:
    """Trace the parts that packets can, where the rays are those of a picture; return their hits, and other parts."""
    few = [part for part in parts if part[1].packets is not None] if rays.count <= SLAB and has_doubles(device) else []
    grid = grid_of(device, rays) if few else None
    done, left = [], []
    for number, held, place, matrix in parts:
        view = grid_view(grid, held, matrix) if grid is not None and held.packets is not None else None
        if view is None:
            left.append((number, held, place))
        else:
            done.append((number, trace_grid(device, grid, held, view), place))
    return done, left


def parts_of(thing) -> list[tuple[object, NDArray | None]]:
    """Return (surface, matrix model to world or None) of each surface of a scene, a list, or a single surface."""
    if hasattr(thing, "placed"):  # a scene, which lives a layer above
        return list(thing.placed)
    if isinstance(thing, list | tuple):
        return [part for one in thing for part in parts_of(one)]
    if hasattr(thing, "matrix") and hasattr(thing, "surface"):
        return [(thing.surface, thing.matrix)]
    return [(thing, None)]


@dataclass(frozen=True, eq=False)
class Rays:
    """Checked rays: arrays of `count` rows, or of 1 that serves all."""

    shape: tuple[int, ...]
    count: int
    origins: NDArray  # (count or 1, 3) float64
    directions: NDArray  # (count or 1, 3) float64
    near: NDArray  # (count or 1,) float64
    far: NDArray  # (count or 1,) float64

    def rows(self, name: str, first: int, stop: int) -> NDArray:
        """Return rows first to stop of an array, one row where that serves all."""
        array = getattr(self, name)
        return array if len(array) == 1 else array[first:stop]

    def step(self, name: str) -> int:
        """Return the elements from one ray's entry to the next."""
        array = getattr(self, name)
        return 0 if len(array) == 1 else array.size // max(len(array), 1)


def checked_rays(origins, directions, near, far) -> Rays:
    """Return rays as arrays, or raise InputError."""
    try:
        o, d = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
        limits = [np.asarray(near, np.float64), np.asarray(far, np.float64)]
    except (TypeError, ValueError):
        raise InputError("trace: expected origins, directions and limits as arrays of numbers") from None
    for name, array in (("origins", o), ("directions", d)):
        if array.ndim < 1 or array.shape[-1] != 3:
            raise InputError(f"{name}: expected an array of shape (..., 3), got {array.shape}")
    try:
        shape = np.broadcast_shapes(o.shape[:-1], d.shape[:-1], *(limit.shape for limit in limits))
    except ValueError:
        raise InputError("trace: expected origins, directions and limits that broadcast against each other, got "
                         f"{o.shape}, {d.shape}, {limits[0].shape}, {limits[1].shape}") from None
    if np.isnan(limits[0]).any() or np.isnan(limits[1]).any():
        raise InputError("trace: expected distances near and far, got NaN")
    count = int(np.prod(shape))
    spread = [_rows(a, (*shape, 3), (count, 3)) for a in (o, d)] + [_rows(a, shape, (count,)) for a in limits]
    return Rays(shape, count, *spread)


def _rows(array: NDArray, shape: tuple, rows: tuple) -> NDArray:
    """Return `array` broadcast to `shape` as rows; a single row stays one."""
    if array.size == int(np.prod(rows[1:])) and rows[0] != 1:
        return array.reshape(1, *rows[1:])
    return np.ascontiguousarray(np.broadcast_to(array, shape)).reshape(rows)


class _Nearest:
    """The closest hit, or any, of every ray; the surfaces come one after the other and keep what is nearer."""

    def __init__(self, device: Device, rays: Rays, mode: int):
        self.device, self.rays, self.mode = device, rays, mode
        self.doubles = has_doubles(device)
        self.done: list[tuple] = []

    def open(self, start: int, stop: int, empty: bool) -> None:
        """Make room for the hits of rays `start` to `stop`, and put the rays there where the device has float64.

        `empty`: no surface will be traced, so that nothing but this fills the room.
        """
        count, device = stop - start, self.device
        chunk = min(CHUNK, count)
        if self.doubles:
            device.check_memory(rays=64 * count, hits=64 * count, frame=(4 * (RAY_FLOATS + HIT_FLOATS) + 8) * chunk)
            self.arguments = []
            for name in ("origins", "directions", "near", "far"):
                self.arguments += [device.upload(self.rays.rows(name, start, stop)), self.rays.step(name)]
        else:
            device.check_memory(frame=(4 * (RAY_FLOATS + HIT_FLOATS)) * chunk)
        self.start = start
        self.on_device = device.empty((chunk, RAY_FLOATS), np.float32), device.empty((chunk, HIT_FLOATS), np.float32)
        self.starts = device.empty((chunk,), np.float64) if self.doubles else None
        self.out = None
        shapes = ((count,), np.float64), ((count, 3), np.float64), ((count, 3), np.float64), ((count,), np.int32), \
            ((count,), np.int32)
        if self.doubles:
            self.out = tuple(device.empty(*shape) for shape in shapes)
            for array, value in zip(self.out, (np.inf, np.nan, np.nan, -1, -1), strict=True):
                if empty:
                    device.fill(array, value)
        else:
            self.out = tuple(np.full(shape, value, dtype) for (shape, dtype), value
                             in zip(shapes, (np.inf, np.nan, np.nan, -1, -1), strict=True))

    def run(self, number: int, held, place: NDArray, first: int, count: int, fresh: bool) -> None:
        """Trace `count` rays from ray `first` on against one surface; `fresh`: it is the first one."""
        device, at = self.device, first - self.start
        rays, hits = self.on_device
        if not self.doubles:
            return self._run_host(number, held, place, first, count)
        on_device = device.upload(place)
        device.kernel("trace/start_rays.cl")((count,), (64,), count, at, *self.arguments, self.out[0], int(not fresh),
                                             on_device, device.upload(held.box.ravel()), rays, self.starts)
        held.launch(self.mode, count, rays, hits)
        device.kernel("trace/finish_rays.cl")((count,), (64,), count, at, *self.arguments[:4], on_device, self.starts,
                                              hits, number, int(fresh), *self.out)
        return None

    def merge(self, number: int, place: NDArray, hits, first: int, count: int, fresh: bool) -> None:
        """Take the hits (count, 8) of rays from ray `first` on, counted from the rays' origins."""
        device = self.device
        starts = device.empty((count,), np.float64)
        device.fill(starts, 0.0)
        device.kernel("trace/finish_rays.cl")((count,), (64,), count, first - self.start, *self.arguments[:4],
                                              device.upload(place), starts, hits, number, int(fresh), *self.out)

    def _run_host(self, number, held, place, first, count) -> None:
        device, hits = self.device, self.on_device[1]
        span = slice(first - self.start, first - self.start + count)
        rows = [np.broadcast_to(a, (count, *a.shape[1:])) for a in
                (self.rays.rows(name, first, first + count) for name in ("origins", "directions", "near", "far"))]
        distance, position, normal, surface, primitive = self.out
        started, starts = start_rays_host(*rows[:3], np.minimum(rows[3], distance[span]), place, held.box)
        part = device.upload(started)
        held.launch(self.mode, count, part, hits)
        found = device.download(hits)[:count]
        mine, there, normals = finish_rays_host(rows[0], rows[1], place, starts, found)
        near = np.flatnonzero(mine < distance[span])
        distance[span][near], position[span][near], normal[span][near] = mine[near], there[near], normals[near]
        surface[span][near], primitive[span][near] = number, found[near, HIT_PRIMITIVE].view(np.int32)

    def close(self, start: int, stop: int) -> None:
        """Take the hits of a slab."""
        download = (lambda array: self.device.download(array, copy=False)) if self.doubles else (lambda array: array)
        self.done.append(tuple(download(array) for array in self.out))
        self.out = None

    def result(self) -> Hits:
        """Return all hits in the rays' shape."""
        shape = self.rays.shape
        if not self.done:
            return Hits(np.full(shape, np.inf), np.full((*shape, 3), np.nan), np.full((*shape, 3), np.nan),
                        np.full(shape, -1, np.int32), np.full(shape, -1, np.int32))
        columns = [parts[0] if len(parts) == 1 else np.concatenate(parts)
                   for parts in zip(*self.done, strict=True)]
        return Hits(*(column.reshape((*shape, *column.shape[1:])) for column in columns))


class _All:
    """Every hit of every ray: the closest one behind the last, again and again, until no ray hits anything."""

    def __init__(self, device: Device, rays: Rays):
        self.device, self.rays = device, rays
        self.found: list[tuple] = []  # ray, distance, position, normal, surface, primitive

    def open(self, start: int, stop: int, empty: bool) -> None:
        """Nothing is prepared."""

    def run(self, number: int, held, place: NDArray, first: int, count: int, fresh: bool) -> None:
        """Trace `count` rays from ray `first` on against one surface."""
        device = self.device
        device.check_memory(frame=4 * (RAY_FLOATS + HIT_FLOATS) * count)
        o, d, near, far = (np.broadcast_to(a, (count, *a.shape[1:])) for a in
                           (self.rays.rows(name, first, first + count) for name in
                            ("origins", "directions", "near", "far")))
        started, starts = start_rays_host(o, d, near, far, place, held.box)
        before = np.zeros((count, HIT_FLOATS), np.float32)
        before[:, 6] = -1
        before[:, 7].view(np.int32)[:] = -1
        rays, hits = device.upload(started), device.empty(before.shape, np.float32)
        device.write(hits, before)
        last = np.full(count, -np.inf, np.float32)
        while True:
            held.launch(NEXT, count, rays, hits)
            found = device.download(hits)
            # Blending may move a hit in front of the one before it, where two sheets touch.
            found[:, 0] = last = np.maximum(found[:, 0], last)
            at = np.flatnonzero(np.isfinite(found[:, 0]))
            if not len(at):
                return
            self.found.append((first + at, *finish_rays_host(o[at], d[at], place, starts[at], found[at]),
                               np.full(len(at), number, np.int32), found[at, HIT_PRIMITIVE].view(np.int32)))

    def close(self, start: int, stop: int) -> None:
        """Nothing is kept."""

    def result(self) -> Hits:
        """Return the hits sorted by ray and distance."""
        empty = (np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.int32),
                 np.zeros(0, np.int32))
        ray, *columns = (np.concatenate(parts) for parts in zip(empty, *self.found, strict=True))
        order = np.lexsort((columns[0], ray))  # stable: hits at one distance stay in the order they were found in
        counts = np.bincount(ray, minlength=self.rays.count)
        return Hits(*(column[order] for column in columns), offsets=np.concatenate([[0], np.cumsum(counts)]))
