"""Frames drawn by the workers of a Dask scheduler. A task's arguments are a path and a camera, never arrays."""

import functools
import os
from pathlib import Path

from ..cluster import connect
from ..errors import InputError

AHEAD = 4  # frames asked for at once, over the workers: their pictures wait in memory


def remote_frames(place, cameras, size, device, scheduler, options, draw=None):
    """Yield the frames of `cameras` in their order; see `camera_path.render_frames`.

    `draw`, something that pickles, makes a frame of the surface, a camera, the size and the device, as `render` does.
    """
    if not isinstance(place, str | os.PathLike):
        raise InputError("scene: expected the path of a surface where a scheduler is given (its workers read it), got "
                         f"{type(place).__name__}: save it first")
    place = str(place) if "://" in str(place) else str(Path(place).expanduser().resolve())
    client, own = connect(scheduler)
    waiting = []
    try:
        threads = max(1, sum(client.nthreads().values()))
        for camera in cameras:
            waiting.append(client.submit(draw_frame, place, camera, size, device, options, draw, pure=False,
                                         retries=2))
            if len(waiting) >= AHEAD * threads:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        client.cancel(waiting)
        for one in own:
            one.close()


def draw_frame(place: str, camera, size, device, options: dict, draw=None):
    """Draw one frame on this worker."""
    from .renderer import render
    thing = _loaded(place, _stamp(place))
    if draw is not None:
        return draw(thing, camera, size, device)
    return render(thing, camera, size, device=device, **options)


@functools.lru_cache(maxsize=2)
def _loaded(place: str, stamp):
    """Return the surface, read once by each worker while its file stays what it is."""
    from ..io import load
    from ..io.stored import in_parts, open_surface
    return open_surface(place) if "://" in place or in_parts(place) else load(place)


def _stamp(place: str):
    return None if "://" in place else os.stat(place).st_mtime_ns
