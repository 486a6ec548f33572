"""Rays against surfaces on a device, one after the other, in batches of rays; what is found is merged.

Kernels: kernels/trace/start_rays.cl, finish_rays.cl, and those of the kinds.
"""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from .kinds import ANY, CLOSEST, NEXT, Traced
from .rays import Hits, Rays
from .single import (
    HIT_FLOATS,
    HIT_PRIMITIVE,
    RAY_FLOATS,
    finish_rays_host,
    has_doubles,
    start_rays_host,
)

QUERIES = {"closest": CLOSEST, "any": ANY, "all": NEXT}
CHUNK = 1 << 17  # rays of one launch: what is kept of them, 72 bytes each, stays in the caches
SLAB = 1 << 22  # rays on the device at a time
SHARE = 8  # of the device's memory, what rays may take: the rest is the surfaces'


def batches(device: Device) -> tuple[int, int]:
    """Return how many rays are on the device at a time, and how many go to one launch."""
    slab = min(SLAB, max(min(device.largest_buffer_bytes // 24, device.memory_bytes // SHARE // 136), 64))
    return slab, min(CHUNK, max(device.largest_buffer_bytes // (4 * RAY_FLOATS), 64))


class Nearest:
    """The closest hit, or any, of every ray; the surfaces come one after the other and keep what is nearer."""

    def __init__(self, device: Device, rays: Rays, mode: int):
        self.device, self.rays, self.mode = device, rays, mode
        self.slab, self.chunk = batches(device)
        self.doubles = has_doubles(device)
        self.done: list[tuple] = []

    def open(self, start: int, stop: int, empty: bool) -> None:
        """Make room for the hits of rays `start` to `stop`, and put the rays there where the device has float64.

        `empty`: no surface will be traced, so that nothing but this fills the room.
        """
        count, device = stop - start, self.device
        chunk = min(self.chunk, count)
        if self.doubles:
            device.check_memory(origins=24 * count, directions=24 * count, limits=16 * count, distances=8 * count,
                                positions=24 * count, normals=24 * count, numbers=8 * count,
                                rays=4 * RAY_FLOATS * chunk, hits=4 * HIT_FLOATS * chunk, starts=8 * chunk)
            self.arguments = []
            for name in ("origins", "directions", "near", "far"):
                self.arguments += [device.upload(self.rays.rows(name, start, stop)), self.rays.step(name)]
        else:
            device.check_memory(rays=4 * RAY_FLOATS * chunk, hits=4 * HIT_FLOATS * chunk)
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

    def run(self, number: int, held: Traced, place: NDArray, first: int, count: int, fresh: bool,
            sift=lambda *_: None) -> None:
        """Trace `count` rays from ray `first` on against one surface.

        Parameters
        ----------
        fresh : bool
            Whether it is the first surface.
        sift : function
            ``sift(first, count, hits, starts)`` may change hits (count, 8) of the frame before they are taken.
        """
        device, at = self.device, first - self.start
        rays, hits = self.on_device
        if not self.doubles:
            return self._run_host(number, held, place, first, count, sift)
        on_device = device.upload(place)
        device.kernel("trace/start_rays.cl")((count,), (64,), count, at, *self.arguments, self.out[0], int(not fresh),
                                             on_device, device.upload(held.box.ravel()), rays, self.starts)
        held.launch(self.mode, count, rays, hits)
        sift(first, count, hits, self.starts)
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

    def _run_host(self, number, held, place, first, count, sift) -> None:
        device, hits = self.device, self.on_device[1]
        span = slice(first - self.start, first - self.start + count)
        rows = [np.broadcast_to(a, (count, *a.shape[1:])) for a in
                (self.rays.rows(name, first, first + count) for name in ("origins", "directions", "near", "far"))]
        distance, position, normal, surface, primitive = self.out
        started, starts = start_rays_host(*rows[:3], np.minimum(rows[3], distance[span]), place, held.box)
        part = device.upload(started)
        held.launch(self.mode, count, part, hits)
        sift(first, count, hits, starts)
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


class All:
    """Every hit of every ray: the closest one behind the last, again and again, until no ray hits anything."""

    def __init__(self, device: Device, rays: Rays):
        self.device, self.rays = device, rays
        self.slab, self.chunk = batches(device)
        self.found: list[tuple] = []  # ray, distance, position, normal, surface, primitive

    def open(self, start: int, stop: int, empty: bool) -> None:
        """Nothing is prepared."""

    def run(self, number: int, held: Traced, place: NDArray, first: int, count: int, fresh: bool,
            keep=lambda started, hits: np.arange(len(hits))) -> None:
        """Trace `count` rays from ray `first` on against one surface.

        ``keep(started, hits)`` gives the hits that count, of rays and hits (n, 8) in the frame.
        """
        device = self.device
        device.check_memory(rays=4 * RAY_FLOATS * count, hits=4 * HIT_FLOATS * count)
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
            at = at[keep(started[at], found[at])]
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


def new_tracer(device: Device, rays: Rays, query: str):
    """Return what traces rays for a query."""
    return All(device, rays) if query == "all" else Nearest(device, rays, QUERIES[query])
