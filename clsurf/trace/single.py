"""Single rays: from the world into a surface's frame and back, on the device where it has float64.

Kernels: kernels/trace/start_rays.cl, finish_rays.cl. The functions that end in `_host` are the same in NumPy, for
devices without float64.
"""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..surface.arrays import finite_rows, lengths_of
from .kinds import Traced

RAY_FLOATS = HIT_FLOATS = 8  # kernels/trace/ray_walk.clh
HIT_PRIMITIVE = 4


def has_doubles(device: Device) -> bool:
    """Return whether the device computes in float64."""
    return "cl_khr_fp64" in device.cl_device.extensions


def placement(traced: Traced, matrix: NDArray | None) -> NDArray:
    """Return the 13 float64 numbers of a traced surface placed by `matrix`, model to world (start_rays.cl)."""
    matrix = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    back = matrix[:3, :3].T / scale**2 / traced.unit
    zero = matrix[:3, :3] @ traced.center + matrix[:3, 3]
    return np.concatenate([np.hstack([back, -(back @ zero)[:, None]]).ravel(), [scale * traced.unit]])


def unit_vectors(directions: NDArray) -> NDArray:
    """Return directions (n, 3) float64 of length 1; NaN where they are zero or not finite."""
    with np.errstate(all="ignore"):
        d = directions / np.abs(directions).max(axis=1, keepdims=True)  # its square may not be a number
        return d / np.sqrt((d * d).sum(axis=1, keepdims=True))


def start_rays_host(origins: NDArray, directions: NDArray, nearest: NDArray, farthest: NDArray, place: NDArray,
                    box: NDArray) -> tuple[NDArray, NDArray]:
    """Return rays (n, 8) float32 in the frame of `place`, clipped to `box`, and where they start (n,), frame units.

    `origins`, `directions` (n, 3) and the limits `nearest`, `farthest` (n,) are float64, world.
    """
    linear, scale = place[:12].reshape(3, 4), place[12]
    with np.errstate(all="ignore"):
        d = unit_vectors(directions) @ linear[:, :3].T * scale
        o = origins @ linear[:, :3].T + linear[:, 3]
        a, b = (box[0] - o) / d, (box[1] - o) / d
        along = d == 0
        outside = (along & ~((o >= box[0]) & (o <= box[1]))).any(axis=1)
        enters, leaves = np.where(along, -np.inf, np.minimum(a, b)), np.where(along, np.inf, np.maximum(a, b))
        near = np.maximum(np.maximum(nearest, 0) / scale, enters.max(axis=1))
        far = np.minimum(farthest / scale, leaves.min(axis=1))
        good = (near <= far) & ~outside & finite_rows(d) & finite_rows(o)
        rays = np.zeros((len(o), RAY_FLOATS), np.float32)
        rays[:, :3], rays[:, 4:7] = o + near[:, None] * d, d
        rays[:, 7] = far - near
    rays[~good] = 0, 0, 0, 0, 1, 0, 0, -1
    return rays, near


def finish_rays_host(origins: NDArray, directions: NDArray, place: NDArray, starts: NDArray,
                     hits: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return distance (n,), position and normal (n, 3), world float64, of hits (n, 8) in the frame of `place`."""
    linear, scale = place[:12].reshape(3, 4), place[12]
    distance = (starts + hits[:, 0].astype(np.float64)) * scale
    d = unit_vectors(directions)
    normal = hits[:, 1:4].astype(np.float64) @ linear[:, :3]
    length = lengths_of(normal, keepdims=True)
    with np.errstate(all="ignore"):
        normal = np.where(length > 0, normal / length, -d)
        normal = np.where((normal * d).sum(axis=1, keepdims=True) > 0, -normal, normal)
        return distance, origins + distance[:, None] * d, normal  # not a number where nothing was hit
