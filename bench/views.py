"""The views that every measurement of pictures uses, and the orbit that frame times are taken on."""

import numpy as np

from clsurf.render.camera import Camera

AZIMUTHS = tuple(range(0, 360, 45))  # degrees about +y, 0 looks from +z
ELEVATION = 20.0  # degrees, alternating in sign
FOV = 40.0  # vertical, degrees


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Return the unit vector (3,) from the target to the eye; both angles in degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


def views(box, count: int = 8) -> list[Camera]:
    """Return the 8 views of a (2, 3) world box: 45 degree steps, elevation +20, -20, +20, ... degrees.

    The scan's own box frames them, never a surface's: pictures of different surfaces then compare pixel by pixel.
    """
    return [Camera.framing(box, direction(azimuth, ELEVATION if i % 2 == 0 else -ELEVATION), FOV)
            for i, azimuth in enumerate(AZIMUTHS[:count])]


def orbit(box, frames: int, height_px: float | None = None, picture_px: int = 1024,
          start: float = 30.0) -> list[Camera]:
    """Return `frames` cameras that go around a (2, 3) box, 1 degree a frame.

    Parameters
    ----------
    height_px : float, optional
        Draw the box about this many pixels high in a picture of `picture_px` instead of filling the picture.
    """
    box = np.asarray(box, np.float64)
    target = box.mean(axis=0)
    first = Camera.framing(box, direction(start, ELEVATION), FOV)
    if height_px is not None:
        # Size on the picture goes with 1 / distance once the box is small.
        focal = picture_px / (2 * np.tan(np.radians(FOV) / 2))
        distance = focal * (box[1, 1] - box[0, 1]) / height_px
        first = Camera.look_at(target + distance * direction(start, ELEVATION), target, fov=FOV)
    return [first.orbited(target, float(i)) for i in range(frames)]
