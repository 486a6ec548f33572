"""Cells with transparent nodes, drawn up to where their interpolated alpha is 1/2 (paper, sections 4.4 and 2).

The transparent nodes of such a cell get a displacement and a colour carried on from the opaque ones; the alpha
between the nodes is bilinear, and what has at least 1/2 of it is drawn, opaque. A z-buffer cannot blend without order:
a surface hides what is behind a sample or is not there, and the smooth edge comes from supersampling, where every
sample decides for itself. Nodes of RGBA colours take part with their own alpha.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..surface.patch import PatchSurface, by_size

DIRECTIONS = [(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1) if i or j]


def extended(surface: PatchSurface) -> tuple[PatchSurface, NDArray]:
    """Return a surface whose opaque nodes are surrounded by carried-on ones, and the alpha of every node.

    A carried-on node is the mean over its eight directions of the straight line through the two next opaque nodes
    there, or, where no direction has two, of the single opaque neighbours; colours are those neighbours' mean.

    Returns
    -------
    surface : PatchSurface
        The same patches; nodes beside opaque ones are opaque as well.
    alphas : (N,) uint8
        255, or an RGBA node's own; 0 for the carried-on nodes and those still transparent.
    """
    opaque, d = surface.opaque, surface.displacements.copy()
    colors = None if surface.colors is None else surface.colors.copy()
    alphas = np.where(opaque, 255 if colors is None or colors.shape[1] == 3 else colors[:, -1], 0).astype(np.uint8)
    limit = np.iinfo(d.dtype).max
    for _, nodes, m, n in by_size(surface):
        shown = opaque[nodes].reshape(-1, n, m)
        height, near = _carried_on(d[nodes].reshape(-1, n, m).astype(np.float64), shown)
        new = (near > 0) & ~shown
        part = d[nodes].reshape(-1, n, m)
        part[new] = np.clip(np.rint(height[new]), -limit, limit)
        d[nodes] = part.ravel()
        if colors is None:
            continue
        own = colors[nodes].reshape(-1, n, m, colors.shape[1])
        sums = np.zeros((*shown.shape, 3))
        for i, j in DIRECTIONS:
            sums += _shifted(np.where(shown[..., None], own[..., :3], 0).astype(np.float64), i, j)
        own[new, :3] = np.maximum(np.rint(sums[new] / near[new][:, None]), 1)  # never pure black
        own[..., 3:][new | shown] = 255
        colors[nodes] = own.reshape(-1, colors.shape[1])
    return replace(surface, displacements=d, colors=colors), alphas


def _carried_on(d, shown):
    """Return the heights (p, n, m) that opaque nodes suggest to their neighbours, and how many of those are opaque."""
    lines, line_count, steps, near = (np.zeros(d.shape) for _ in range(4))
    for i, j in DIRECTIONS:
        one, two = _shifted(shown, i, j), _shifted(shown, 2 * i, 2 * j)
        first = _shifted(d, i, j)
        lines += np.where(one & two, 2 * first - _shifted(d, 2 * i, 2 * j), 0)
        line_count += one & two
        steps += np.where(one, first, 0)
        near += one
    return np.where(line_count > 0, lines / np.maximum(line_count, 1), steps / np.maximum(near, 1)), near


def _shifted(a, i, j):
    """Return what lies (i, j) nodes further in an array (p, n, m, ...), zero outside."""
    out = np.zeros_like(a)
    n, m = a.shape[1:3]
    rows, columns = slice(max(-j, 0), n - max(j, 0)), slice(max(-i, 0), m - max(i, 0))
    if abs(j) < n and abs(i) < m:
        out[:, rows, columns] = a[:, max(j, 0):n + min(j, 0), max(i, 0):m + min(i, 0)]
    return out
