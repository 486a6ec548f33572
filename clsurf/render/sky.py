"""Image lights on a device: octahedral maps of what surfaces of every roughness mirror of a picture around them.

Kernels: kernels/render/prefilter_sky.cl, kernels/render/texels.clh.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..surface.arrays import lengths_of
from .skies import directions_of, look_up

FIRST_LEVEL, LAST_LEVEL = 4, 9  # of the quadtree: 16 x 16 to 512 x 512 cells
# Cells of the mirror image's levels, roughness from 0 to 1 in equal steps; the first one's are the picture's.
MIRROR_CELLS = (128, 128, 64, 64, 64, 64, 64, 64)
LARGEST_MIRROR_CELLS = 512
MATTE_CELLS = 64


@dataclass(frozen=True, eq=False)
class Sky:
    """A picture of the surroundings as the light kernels want it."""

    picture: NDArray  # (h, w, 3) float32
    texels: NDArray  # (n, 4) float32: octahedral maps one after another
    mirror: tuple[tuple[int, int], ...]  # (first texel, cells) of each level of roughness
    matte: tuple[int, int]
    coarse: NDArray  # (1024, 4) float32: cells of 32 x 32, mean light and solid angle


def prepared_sky(device: Device, picture: NDArray) -> Sky:
    """Return the maps of an equirectangular picture (h, w, 3) of linear light."""
    levels = sky_tree(picture)
    tree = device.upload(np.concatenate([level.reshape(-1, 4) for level in levels]))
    last = FIRST_LEVEL + len(levels) - 1
    sharp = min(2 ** int(np.ceil(np.log2(max(picture.shape[0], 64)))), LARGEST_MIRROR_CELLS)
    maps = [mirror_image(picture, sharp)]
    for i, cells in enumerate(MIRROR_CELLS):
        roughness = (i + 1) / len(MIRROR_CELLS)
        maps.append(prefilter_sky(device, tree, last, roughness**2, min(cells, sharp)))
    maps.append(prefilter_sky(device, tree, last, None, MATTE_CELLS))
    starts = np.cumsum([0, *(len(m) for m in maps)])
    places = [(int(start), round(len(m) ** 0.5) - 1) for start, m in zip(starts, maps, strict=False)]
    return Sky(picture, np.concatenate(maps), tuple(places[:-1]), places[-1], levels[1].reshape(-1, 4))


def prefilter_sky(device: Device, tree, last_level: int, alpha: float | None, cells: int) -> NDArray:
    """Return an octahedral map ((cells + 1)^2, 4) float32 for GGX's `alpha`; None: for a matte surface."""
    count = (cells + 1) ** 2
    out = device.empty((count, 4), np.float32)
    lanes = device.lanes
    items = -(-count // lanes)
    device.kernel("render/prefilter_sky.cl", constants={"VW": lanes, "MATTE": alpha is None, "FIRST": FIRST_LEVEL})(
        (items,), (1,), tree, last_level, alpha or 1.0, cells, out)
    return device.download(out)


def sky_tree(picture: NDArray) -> list[NDArray]:
    """Return the levels (2^k, 2^k, 4) float32 of a picture's quadtree: mean light and solid angle of octahedral cells.

    Where pixels are finer than cells, each one's light goes into the cell that its middle lies in, so that none is
    lost, however small its source; otherwise cells look up the picture at 3 x 3 places.
    """
    height, width = picture.shape[:2]
    size = 2**LAST_LEVEL if height >= 3 * 2**LAST_LEVEL else 2 ** (LAST_LEVEL - 1)
    if height >= 3 * size and width >= 6 * size:
        u, v = unfolded(directions_of(height, width).reshape(-1, 3))
        column, row = (np.clip(((c + 1) * 0.5 * size).astype(np.int32), 0, size - 1) for c in (u, v))
        edges = np.cos(np.pi * np.arange(height + 1) / height)
        solid = np.repeat((edges[:-1] - edges[1:]) * 2 * np.pi / width, width)
        sums = np.stack([np.bincount(row * size + column, solid * part, size * size)
                         for part in (*picture.reshape(-1, 3).T, 1.0)], axis=-1)
    else:
        n = 3 * size
        at = 2 * (np.arange(n) + 0.5) / n - 1
        u, v = np.tile(at, n), np.repeat(at, n)
        d = folded(u, v)
        # dA / |p|^3 of places p on the octahedron, whose faces are as far from its middle everywhere.
        solid = np.abs(d).sum(axis=1, keepdims=True) ** 3
        solid *= 4 * np.pi / solid.sum()
        samples = np.concatenate([look_up(picture, d) * solid, solid], axis=1)
        sums = samples.reshape(size, 3, size, 3, 4).sum(axis=(1, 3))
    levels = [sums.reshape(size, size, 4)]
    while len(levels[0]) > 2**FIRST_LEVEL:
        levels.insert(0, levels[0].reshape(len(levels[0]) // 2, 2, len(levels[0]) // 2, 2, 4).sum(axis=(1, 3)))
    out = []
    for level in levels:
        light = np.divide(level[..., :3], level[..., 3:], out=np.zeros_like(level[..., :3]), where=level[..., 3:] > 0)
        out.append(np.concatenate([light, level[..., 3:]], axis=-1).astype(np.float32))
    return out


def mirror_image(picture: NDArray, cells: int) -> NDArray:
    """Return the octahedral map ((cells + 1)^2, 4) float32 of a picture itself."""
    step = max(1, picture.shape[0] // (2 * cells))
    height, width = (n // step * step for n in picture.shape[:2])
    small = picture[:height, :width].reshape(height // step, step, width // step, step, 3).mean(axis=(1, 3))
    at = np.linspace(-1, 1, cells + 1)
    out = np.zeros(((cells + 1) ** 2, 4), np.float32)
    out[:, :3] = look_up(small, folded(np.tile(at, cells + 1), np.repeat(at, cells + 1)))
    return out


def sky_lamps(sky: Sky, directions: NDArray) -> NDArray:
    """Return the light (n, 3) that comes from nearest to each of the unit `directions` (n, 3), picture axes."""
    size = round(len(sky.coarse) ** 0.5)
    at = (2 * np.arange(size) + 1) / size - 1
    cells = folded(np.tile(at, size), np.repeat(at, size))
    nearest = np.argmax(cells @ np.asarray(directions, np.float64).T, axis=1)
    out = np.zeros((len(directions), 3))
    np.add.at(out, nearest, sky.coarse[:, :3].astype(np.float64) * sky.coarse[:, 3:])
    return out


def unfolded(d: NDArray) -> tuple[NDArray, NDArray]:
    """Return where directions (n, 3) are in the octahedral square, u and v from -1 to 1."""
    x, y, z = (d / np.abs(d).sum(axis=1, keepdims=True)).T
    below = y < 0
    return (np.where(below, (1 - np.abs(z)) * np.where(x < 0, -1, 1), x),
            np.where(below, (1 - np.abs(x)) * np.where(z < 0, -1, 1), z))


def folded(u: NDArray, v: NDArray) -> NDArray:
    """Return the unit directions (n, 3) of places in the octahedral square."""
    y = 1 - np.abs(u) - np.abs(v)
    x = np.where(y < 0, (1 - np.abs(v)) * np.where(u < 0, -1, 1), u)
    z = np.where(y < 0, (1 - np.abs(u)) * np.where(v < 0, -1, 1), v)
    d = np.stack([x, y, z], axis=-1)
    return d / lengths_of(d, keepdims=True)
