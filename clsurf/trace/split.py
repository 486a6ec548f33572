"""Rays against surfaces that the device does not hold at once: piece by piece, one surface after the other.

The hits are those of the whole: pieces look for hits behind what was found before, and of what several pieces find on
both sides of a cut one stays. A hit of a SLIM surface that too few surfels support is *weak*: it counts only where
nothing with support lies behind it (kernels/trace/ray_slim.cl). The rim of a disc, hit alone, *waits*: it counts only
where what lies behind it is seen from behind (kernels/trace/ray_surfels.cl). Either may be in another piece.
"""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import Cancelled
from .pieces import Held, Piece, forget, held
from .rays import Hits, Rays
from .single import HIT_PRIMITIVE, finish_rays_host, placement
from .tracers import All, Nearest, new_tracer

HIT_SIDE, WEAK, WAITS = 5, 2, 3  # kernels/trace/ray_walk.clh, and sides beyond 1 and -1


def trace_pieces(device: Device, rays: Rays, parts: list, query: str, progress) -> Hits:
    """Return the hits of checked rays.

    Parameters
    ----------
    parts : list of (number, surface, matrix or None)
    """
    tracer = new_tracer(device, rays, query)
    for start in range(0, rays.count, tracer.slab):
        stop = min(start + tracer.slab, rays.count)
        if len(parts) > 1 or not start:
            forget(device)  # room for the rays
        tracer.open(start, stop, empty=True)
        for i, (number, surface, matrix) in enumerate(parts):
            if i:
                forget(device)  # room for the next
            one = held(device, surface)
            if query == "all":
                _all(tracer, number, one, matrix, start, stop)
            else:
                _nearest(tracer, number, one, matrix, start, stop)
            share = (start + (stop - start) * (i + 1) / len(parts)) / rays.count
            if progress is not None and progress("trace", share) is False:
                raise Cancelled("trace: stopped")
        tracer.close(start, stop)
    return tracer.result()


def _chunks(tracer, start: int, stop: int):
    for first in range(start, stop, tracer.chunk):
        yield first, min(tracer.chunk, stop - first)


def _nearest(tracer: Nearest, number: int, one: Held, matrix, start: int, stop: int) -> None:
    opened = OpenHits(tracer)

    def use(traced, piece: Piece) -> None:
        place = placement(traced, matrix)
        opened.place = place
        for first, count in _chunks(tracer, start, stop):
            tracer.run(number, traced, place, first, count, False, opened.sift)

    one.each(use, blending=tracer.mode == 0)
    opened.settle(number)


class OpenHits:
    """Weak and waiting hits, kept aside until it is known what the rays hit behind them."""

    def __init__(self, tracer: Nearest):
        self.tracer, self.place, self.found, self.behind = tracer, None, [], []

    def sift(self, first: int, count: int, hits, starts) -> None:
        """Take the open hits of rays from `first` on out of `hits` on the device; note those seen from behind."""
        device = self.tracer.device
        host = device.download(hits)
        hit, side = np.isfinite(host[:count, 0]), host[:count, HIT_SIDE]
        begins = starts if isinstance(starts, np.ndarray) else device.download(starts)
        for rows, found in ((hit & (np.abs(side) > 1), self.found), (hit & (side == -1), self.behind)):
            at = np.flatnonzero(rows)
            if len(at):
                found.append((first + at, host[at], begins[at]))
        if (hit & (np.abs(side) > 1)).any():
            host[:count][hit & (np.abs(side) > 1), 0] = np.inf
            device.write(hits, host)

    def settle(self, number: int) -> None:
        """Give rays their open hits on surface `number` that count."""
        if not self.found:
            return
        tracer = self.tracer
        ray, distance, position, normal, hits = self._world(self.found)
        waits = np.abs(hits[:, HIT_SIDE]) == WAITS
        order = np.lexsort((np.where(waits, -distance, distance), ray))  # the last weak, the first that waits
        order = order[np.append(np.diff(ray[order]) > 0, True)]
        row = ray[order] - tracer.start
        out = [np.array(tracer.device.download(array)) if tracer.doubles else array for array in tracer.out]
        behind = np.full(len(out[0]), np.inf)
        if self.behind:
            back_ray, back_distance, *_ = self._world(self.behind)
            np.minimum.at(behind, back_ray - tracer.start, back_distance)
        own = out[3][row] == number
        use = np.where(waits[order], own & (behind[row] <= out[0][row] * (1 + 1e-9)), ~own)
        use &= distance[order] < out[0][row]
        row, order = row[use], order[use]
        numbers = np.full(len(row), number), hits[order, HIT_PRIMITIVE].view(np.int32)
        for array, values in zip(out, (distance[order], position[order], normal[order], *numbers), strict=True):
            array[row] = values
        if tracer.doubles:
            for array, values in zip(tracer.out, out, strict=True):
                tracer.device.write(array, values)

    def _world(self, found: list[tuple]) -> tuple[NDArray, ...]:
        """Return ray, distance, position, normal and hit of what was noted."""
        rays = self.tracer.rays
        ray, hits, starts = (np.concatenate(columns) for columns in zip(*found, strict=True))
        o, d = (np.broadcast_to(a, (rays.count, 3))[ray] for a in (rays.origins, rays.directions))
        return ray, *finish_rays_host(o, d, self.place, starts, hits), hits


def _all(tracer: All, number: int, one: Held, matrix, start: int, stop: int) -> None:
    others, tracer.found = tracer.found, []
    pieces, sides = [], []
    scale = 1.0

    def use(traced, piece: Piece) -> None:
        nonlocal scale
        place = placement(traced, matrix)
        scale = place[12]

        def keep(started, hits):
            at = _own(piece.region, one.plan.same if one.plan else 0.0, started, hits)
            sides.append(hits[at, HIT_SIDE])
            return at

        for first, count in _chunks(tracer, start, stop):
            tracer.run(number, traced, place, first, count, False, keep)
        pieces.extend([len(pieces)] * (len(tracer.found) - len(pieces)))

    one.each(use, blending=True)
    if tracer.found:
        columns = [np.concatenate(column) for column in zip(*tracer.found, strict=True)]
        piece = np.repeat(pieces, [len(column[0]) for column in tracer.found])
        rows = _once(columns[0], columns[1], piece, np.concatenate(sides), scale * (one.plan.same if one.plan else 0.0))
        others.append(tuple(column[rows] for column in columns))
    tracer.found = others


def _own(region: NDArray | None, slack: float, started: NDArray, hits: NDArray) -> NDArray:
    """Return which hits of rays (n, 8) lie in a region of the frame."""
    if region is None:
        return np.arange(len(hits))
    places = started[:, :3].astype(np.float64) + hits[:, :1].astype(np.float64) * started[:, 4:7]
    return np.flatnonzero(((places >= region[0] - slack) & (places <= region[1] + slack)).all(axis=1))


def _once(ray: NDArray, distance: NDArray, piece: NDArray, side: NDArray, same: float) -> NDArray:
    """Return the hits of one surface that count: those of two pieces once, open ones by what comes behind them."""
    order = np.lexsort((distance, ray))
    again = (np.diff(ray[order]) == 0) & (np.diff(piece[order]) != 0) & (np.diff(distance[order]) < same)
    # Of a hit that one piece was sure of and the other was not, the sure one stays.
    open_first = again & (np.abs(side[order][:-1]) > np.abs(side[order][1:]))
    order = np.delete(order, np.flatnonzero(again) + ~open_first[again])
    followed = np.append(np.diff(ray[order]) == 0, False)
    next_side = np.append(side[order][1:], 0)
    kind = np.abs(side[order])
    return order[~((kind == WEAK) & followed) & ~((kind == WAITS) & ~(followed & (next_side < 0)))]
