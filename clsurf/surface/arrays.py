"""Checks and conversions shared by the plain data types."""

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError


def frozen(name: str, value, shape: tuple, dtype) -> NDArray:
    """Return `value` as a read-only, C-contiguous array of `dtype`, after checking its shape.

    Parameters
    ----------
    name : str
        Used in the message of a ValueError.
    shape : tuple of int or str
        Expected shape; a string stands for a free length and names it in the message.
    """
    array = np.ascontiguousarray(value, dtype=dtype)
    fits = array.ndim == len(shape) and all(isinstance(want, str) or got == want
                                            for got, want in zip(array.shape, shape, strict=True))
    if not fits:
        wanted = "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"{name}: expected an array of shape {wanted}, got {np.shape(value)}")
    if array is value and array.flags.writeable:
        array = array.view()  # the caller's own array stays writeable
    array.flags.writeable = False
    return array


def box_of(points: NDArray) -> tuple[NDArray, NDArray]:
    """Return the least and the largest values (k,) of the columns of `points` (n, k), n > 0; NaN where one is NaN."""
    # NumPy reduces long rows 20 times faster than rows of three: 2 million points 8 ms, not 160.
    n, k = points.shape
    whole = n // 64 * 64
    if not whole:
        return points.min(axis=0), points.max(axis=0)
    rows, rest = points[:whole].reshape(-1, 64 * k), points[whole:]
    return (np.concatenate([rows.min(axis=0).reshape(64, k), rest]).min(axis=0),
            np.concatenate([rows.max(axis=0).reshape(64, k), rest]).max(axis=0))


def extent_of(points: NDArray) -> NDArray:
    """Return how far the columns of `points` (n, k) reach, n > 0: (k,)."""
    low, high = box_of(points)
    return high - low


def squared_lengths(vectors: NDArray) -> NDArray:
    """Return the squared lengths (...,) of `vectors` (..., k), k below 8; sum(axis=1) takes 5 times as long."""
    out = vectors[..., 0] * vectors[..., 0]
    for k in range(1, vectors.shape[-1]):
        out += vectors[..., k] * vectors[..., k]
    return out


def lengths_of(vectors: NDArray, keepdims: bool = False) -> NDArray:
    """Return the lengths (...,) of `vectors` (..., k) of floats, k below 8; (..., 1) with `keepdims`.

    The same bits as np.linalg.norm's, whose sums of three take 8 times as long.
    """
    out = squared_lengths(np.asarray(vectors))
    out = np.sqrt(out, out=out) if out.ndim else np.sqrt(out)
    return out[..., None] if keepdims else out


def finite_rows(points: NDArray) -> NDArray:
    """Return which rows (n,) bool of `points` (n, k) are finite; all(axis=1) takes 10 times as long."""
    out = np.isfinite(points[:, 0])
    for column in range(1, points.shape[1]):
        out &= np.isfinite(points[:, column])
    return out


def used_numbers(numbers: NDArray, count: int) -> NDArray:
    """Return which of 0 to `count` - 1 are among `numbers`, ascending; of millions np.unique takes 20 times as long."""
    used = np.zeros(count, bool)
    used[numbers] = True
    return np.flatnonzero(used)


def whole_faces(faces: NDArray, usable: NDArray) -> NDArray:
    """Return which of `faces` (f, 3) have only corners that are `usable` (v,): (f,) bool."""
    if usable.all():
        return np.ones(len(faces), bool)
    return usable[faces[:, 0]] & usable[faces[:, 1]] & usable[faces[:, 2]]


def bounds_of(points: NDArray, origin: NDArray) -> NDArray:
    """Return the bounding box (2, 3) float64 in world space of `points` (n, 3) relative to `origin`."""
    if len(points) == 0:
        return np.full((2, 3), np.nan)
    return np.stack(box_of(points)).astype(np.float64) + origin


def recentred(points, origin) -> tuple[NDArray, NDArray]:
    """Split world positions into float32 offsets and a float64 origin.

    float64 input without an origin is moved to the centre of its box, so that a survey coordinate keeps its
    millimetres; float32 input is kept as it is.

    Parameters
    ----------
    points : array_like
        (n, 3) positions, any real dtype; with `origin` given, relative to it.
    origin : array_like or None
        (3,) float64.

    Returns
    -------
    points : (n, 3) float32
    origin : (3,) float64

    Raises
    ------
    InputError
        An extent beyond float32.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"positions: expected an array of shape (n, 3), got {points.shape}")
    if origin is not None:
        return np.ascontiguousarray(points, np.float32), np.asarray(origin, np.float64)
    if points.dtype == np.float32 or len(points) == 0:
        return np.ascontiguousarray(points, np.float32), np.zeros(3)
    points = points.astype(np.float64, copy=False)
    finite = finite_rows(points)
    if not finite.any():
        return points.astype(np.float32), np.zeros(3)
    # Halving before adding keeps the centre of a box near the largest float64 finite.
    low, high = box_of(points if finite.all() else points[finite])
    origin = low / 2 + high / 2
    if (high / 2 - low / 2).max() > np.finfo(np.float32).max:
        raise InputError(f"positions: expected an extent that float32 holds, got {low.tolist()} to {high.tolist()}: "
                         "drop the outliers or scale the scan down")
    return (points - origin).astype(np.float32), origin
