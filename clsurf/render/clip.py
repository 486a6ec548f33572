"""Clip planes: what lies beyond them is not drawn, so that the inside is seen; kernels/common/clip.clh."""

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface.arrays import lengths_of

CLIP = 32  # kernels/common/view.clh
MOST_CLIP_PLANES = 8


def checked_clip(clip) -> NDArray:
    """Return clip planes as (n, 4) float64, unit normals first, or raise InputError.

    Parameters
    ----------
    clip : None, (4,) or (n, 4) array_like
        a, b, c, d: what has a x + b y + c z + d >= 0 is kept, world space.
    """
    if clip is None:
        return np.zeros((0, 4))
    try:
        planes = np.array(clip, np.float64)
    except (TypeError, ValueError):
        planes = np.zeros(1)
    planes = planes.reshape(-1, 4) if planes.shape in ((4,), (0,)) else planes
    if planes.ndim != 2 or planes.shape[1] != 4 or not np.isfinite(planes).all():
        raise InputError("clip: expected planes of four finite numbers a, b, c, d (kept: a x + b y + c z + d >= 0), "
                         f"got {clip!r}")
    if len(planes) > MOST_CLIP_PLANES:
        raise InputError(f"clip: expected at most {MOST_CLIP_PLANES} planes, got {len(planes)}")
    lengths = lengths_of(planes[:, :3], keepdims=True)
    if not ((lengths > 1e-150) & (lengths < 1e150)).all():
        raise InputError(f"clip: expected planes with a normal (a, b, c) that is not 0, got {clip!r}")
    return planes / lengths


def view_clip(planes: NDArray, camera) -> NDArray:
    """Return the planes (n, 4) float64 in the camera's view space."""
    if not len(planes):
        return planes
    return np.concatenate([planes[:, :3] @ camera.rotation.T, (planes[:, :3] @ camera.eye + planes[:, 3])[:, None]],
                          axis=1)
