"""Pictures of surroundings: those that are built in, files and arrays, as linear light; where directions are in them.

Equirectangular, the top row is up. A direction (x, y, z) of a picture has y up, z out of the picture's middle, x to the
right of it.
"""

import collections
import os
import threading
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..io.images import read_image
from ..surface.srgb import LINEAR_OF_BYTE, to_linear

BUILT_IN_SIZE = (256, 512)
LARGEST_LIGHT = 65504.0  # of a pixel: what a half float holds
KEPT = 8  # pictures that stay read

_kept: collections.OrderedDict = collections.OrderedDict()
_lock = threading.Lock()


def picture_key(picture):
    """Return what a picture is known by: its name, its file as it is now, or the array itself."""
    if isinstance(picture, np.ndarray):
        return id(picture)
    try:
        stat = os.stat(picture)
        return str(picture), stat.st_mtime_ns, stat.st_size
    except (OSError, TypeError, ValueError):
        return str(picture)


def linear_picture(name: str, picture, built_in) -> NDArray:
    """Return a picture as (h, w, 3) float32 linear light, its alpha laid over black; the last few stay in memory.

    An array is taken as it is when it is first seen.

    Parameters
    ----------
    name : str
        For messages.
    picture : str, path or array
    built_in : dict of str to callable
        What gives the pictures that have names.

    Raises
    ------
    InputError, FileFormatError
        No such name or file, or something that is no picture.
    """
    key = picture_key(picture), *built_in
    with _lock:
        if key not in _kept:
            _kept[key] = _linear(name, picture, built_in), picture
            while len(_kept) > KEPT:
                _kept.popitem(last=False)
        _kept.move_to_end(key)
        return _kept[key][0]


def _linear(name: str, picture, built_in) -> NDArray:
    if isinstance(picture, str) and picture in built_in:
        return np.ascontiguousarray(built_in[picture](), np.float32)
    if isinstance(picture, str | PathLike):
        try:
            picture = read_image(picture)
        except InputError as error:
            raise InputError(f"{name}: {error}; built in are {', '.join(built_in)}") from None
    pixels = np.asarray(picture)
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4) or 0 in pixels.shape:
        raise InputError(f"{name}: expected a picture (h, w, 3 or 4), got {pixels.shape}")
    if pixels.dtype == np.uint8:
        light = LINEAR_OF_BYTE[pixels[..., :3]]
    elif pixels.dtype == np.uint16:
        light = to_linear(pixels[..., :3] / 65535)
    elif pixels.dtype.kind == "f":
        light = np.clip(np.nan_to_num(pixels[..., :3], nan=0.0, posinf=LARGEST_LIGHT), 0, LARGEST_LIGHT)
    else:
        raise InputError(f"{name}: expected float, uint8 or uint16 pixels, got {pixels.dtype}")
    if pixels.shape[2] == 4 and pixels.dtype.kind == "u":
        light = light * (pixels[..., 3:] / np.iinfo(pixels.dtype).max)
    return np.ascontiguousarray(np.broadcast_to(light, (*light.shape[:2], 3)), np.float32)


def directions_of(height: int, width: int) -> NDArray:
    """Return the unit directions (h, w, 3) float64 of the middles of an equirectangular picture's pixels."""
    down, around = np.pi * (np.arange(height) + 0.5) / height, 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    flat = np.sin(down)[:, None]
    return np.stack([flat * np.sin(around), np.broadcast_to(np.cos(down)[:, None], (height, width)),
                     flat * np.cos(around)], axis=-1)


def look_up(picture: NDArray, directions: NDArray) -> NDArray:
    """Return the light (..., 3) that a picture has at unit directions (..., 3): bilinear, seamless around."""
    height, width = picture.shape[:2]
    x = (np.arctan2(directions[..., 0], directions[..., 2]) / (2 * np.pi) + 0.5) * width - 0.5
    y = np.clip(np.arccos(np.clip(directions[..., 1], -1, 1)) / np.pi * height - 0.5, 0, height - 1)
    i, j = np.floor(x).astype(int), np.minimum(y.astype(int), max(height - 2, 0))
    u, v = (x - i)[..., None], (y - j)[..., None]
    below = np.minimum(j + 1, height - 1)
    top = picture[j, i % width] * (1 - u) + picture[j, (i + 1) % width] * u
    return top * (1 - v) + (picture[below, i % width] * (1 - u) + picture[below, (i + 1) % width] * u) * v


# Built in -------------------------------------------------------------------------------------------------------------


def sky() -> NDArray:
    """Return a clear sky in the afternoon: blue, paler to the horizon, with a soft sun, over a sandy ground."""
    d = directions_of(*BUILT_IN_SIZE)
    sun = np.array([-0.60, 0.62, -0.55])
    near = (d @ (sun / np.linalg.norm(sun)))[..., None]
    height = np.clip(d[..., 1:2], 0, 1)
    blue = _mixed((0.86, 0.92, 1.0), (0.24, 0.42, 0.76), 1 - (1 - height) ** 3)
    blue = blue + np.array([1.0, 0.86, 0.62]) * (0.35 * np.clip(near, 0, 1) ** 12 + 45 * _step(near, 0.985, 0.9965))
    ground = np.array([0.34, 0.30, 0.25]) * (1 + 0.3 * d[..., 1:2])
    return _balanced(_mixed(ground, blue, _step(d[..., 1:2], -0.02, 0.03)), d)


def overcast() -> NDArray:
    """Return an overcast sky (CIE standard: three times as bright overhead as at the horizon) over a grey ground."""
    d = directions_of(*BUILT_IN_SIZE)
    above = (1 + 2 * np.clip(d[..., 1:2], 0, 1)) / 3 * np.array([0.96, 0.98, 1.0])
    return _balanced(_mixed((0.16, 0.155, 0.15), above, _step(d[..., 1:2], -0.03, 0.03)), d)


def studio() -> NDArray:
    """Return a grey room with a large warm lamp on the left, a cool one on the right and one behind the camera."""
    d = directions_of(*BUILT_IN_SIZE)
    room = _mixed((0.22, 0.22, 0.23), (0.34, 0.34, 0.35), _step(d[..., 1:2], -0.3, 0.8)) * np.ones_like(d)
    for middle, size, color in (((-1.0, 0.75, -0.55), (0.5, 0.42), (4.6, 4.2, 3.7)),
                                ((1.0, 0.35, -0.35), (0.30, 0.5), (1.5, 1.7, 2.0)),
                                ((0.15, 0.9, -1.0), (0.6, 0.16), (2.4, 2.4, 2.4))):
        out = np.array(middle) / np.linalg.norm(middle)
        right = np.cross((0, 1, 0), out)
        right /= np.linalg.norm(right)
        depth = np.maximum(d @ out, 1e-6)
        x, y = np.abs(d @ right) / depth, np.abs(d @ np.cross(out, right)) / depth
        lamp = _step(size[0] - x, -0.05, 0.05) * _step(size[1] - y, -0.05, 0.05) * (d @ out > 0)
        room = _mixed(room, np.array(color), lamp[..., None])
    return _balanced(room, d)


SKIES = {"sky": sky, "overcast": overcast, "studio": studio}


def _mixed(a, b, part) -> NDArray:
    return np.asarray(a) * (1 - part) + np.asarray(b) * part


def _step(x, low: float, high: float) -> NDArray:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _balanced(light: NDArray, d: NDArray) -> NDArray:
    """Return `light` so bright that a white matte surface that faces up, or the brightest way, is as bright as 1."""
    weight = np.sin(np.pi * (np.arange(len(d)) + 0.5) / len(d))[:, None, None]
    luminance = light @ np.array([0.2126, 0.7152, 0.0722])
    toward = (d * luminance[..., None] * weight).sum(axis=(0, 1))
    facing = np.clip(d @ (toward / np.linalg.norm(toward)), 0, None)[..., None] * weight
    return light * facing.sum() / (facing * luminance[..., None]).sum()
