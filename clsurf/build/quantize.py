"""From heights over planes to the nodes of patches: displacement steps, transparent nodes, colours."""

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface

STEPS = 127  # a patch uses displacements -127...127; -128 is transparent where there are no colours
PRECISE_STEPS = 1 << 22  # more than float32 heights resolve


def quantized(origins: NDArray, axis_x: NDArray, axis_y: NDArray, heights: NDArray, size, colors: NDArray | None = None,
              precise: bool = False, **rest) -> PatchSurface:
    """Return patches whose nodes lie at `heights` over the planes of their axes.

    The displacement step of a patch is the smallest power of two times the node spacing that its heights fit in, so
    that most patches of a model share the ratio |a_z| / |a_x| and with it a table of normals (paper, section 3).

    Parameters
    ----------
    origins : (p, 3) float64
        Node (0, 0) at height 0, relative to the surface's origin.
    axis_x, axis_y : (p, 3) float64
        World units per node step, perpendicular.
    heights : (N,) float64
        World units along axis_x x axis_y, row by row (i fastest), patch after patch; NaN: transparent.
    size : (2,) or (p, 2) int
        Nodes along axis_x and axis_y.
    colors : (N, 3) or (N, 4) uint8, optional
        sRGB; pure black becomes (1, 1, 1), since that stands for transparent nodes.
    precise : bool
        32-bit displacements and RGBA, 8 bytes a node in place of 4.
    **rest
        Further fields of `PatchSurface`.
    """
    count = len(origins)
    size = np.broadcast_to(np.asarray(size, np.int32), (count, 2))
    counts = size.astype(np.int64).prod(axis=1)
    starts, opaque = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64), np.isfinite(heights)
    patch = np.repeat(np.arange(count), counts)
    low = np.minimum.reduceat(np.where(opaque, heights, np.inf), starts) if count else np.zeros(0)
    high = np.maximum.reduceat(np.where(opaque, heights, -np.inf), starts) if count else np.zeros(0)
    empty = ~(low <= high)
    low, high = np.where(empty, 0, low), np.where(empty, 0, high)
    spacing = lengths_of(axis_x)
    steps = PRECISE_STEPS if precise else STEPS
    ratio = np.maximum((high - low) / 2 / steps / np.maximum(spacing, 1e-300), 2.0 ** -24)
    z_length = (spacing * 2.0 ** np.ceil(np.log2(ratio) - 1e-9)).astype(np.float32)
    normals = np.cross(axis_x, axis_y)
    normals /= lengths_of(normals, keepdims=True)
    middle = (low + high) / 2
    d = np.rint((np.where(opaque, heights, 0) - middle[patch]) / z_length[patch].astype(np.float64))
    kind = np.int32 if precise else np.int8
    d = np.where(opaque, np.clip(d, -steps, steps), np.iinfo(kind).min if colors is None else 0).astype(kind)
    return PatchSurface(origins=origins + middle[:, None] * normals, axis_x=axis_x, axis_y=axis_y,
                        axis_z_length=z_length, size=size, displacements=d,
                        colors=_node_colors(colors, opaque, precise), **rest)


def _node_colors(colors, opaque, precise):
    if colors is None:
        return None
    out = np.array(colors, np.uint8)
    if precise and out.shape[1] == 3:
        out = np.concatenate([out, np.full((len(out), 1), 255, np.uint8)], axis=1)
    if out.shape[1] == 3:
        out |= ((out[:, 0] | out[:, 1] | out[:, 2]) == 0)[:, None]
    out *= opaque[:, None]  # out[~opaque] = 0 takes 5 times as long
    return out
