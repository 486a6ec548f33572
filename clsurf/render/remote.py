"""Frames drawn by the workers of a Dask scheduler. A task's arguments are a path and a camera, never arrays."""

import functools
import os
from pathlib import Path

from ..cluster import connect
from ..errors import InputError

AHEAD = 4  # frames asked for at once, over the workers: their pictures wait in memory


def remote_frames(place, cameras, size, device, scheduler, options):
    """Yield the frames of `cameras` in their order; see `camera_path.render_frames`."""
    if not isinstance(place, str | os.PathLike):
        raise InputError("scene: expected the path of a surface where a scheduler is given (its workers read it), got "
                         f"{type(place).__name__}: save it first")
    place = str(place) if "://" in str(place) else str(Path(place).expanduser().resolve())
    client, own = connect(scheduler)
    waiting = []
    try:
        threads = max(1, sum(client.nthreads().values()))
        for camera in cameras:
            waiting.append(client.submit(draw_frame, place, camera, size, device, options, pure=False, retries=2))
            if len(waiting) >= AHEAD * threads:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        client.cancel(waiting)
        for one in own:
            one.close()


def draw_frame(place: str, camera, size, device, options: dict):
    """Draw one frame on this worker."""
    from .renderer import render
    return render(_loaded(place, _stamp(place)), camera, size, device=device, **options)


@functools.lru_cache(maxsize=2)
def _loaded(place: str, stamp):
    """Return the surface, read once by each worker while its file stays what it is."""
    from ..io import load
    return load(place)


def _stamp(place: str):
    return None if "://" in place else os.stat(place).st_mtime_ns
