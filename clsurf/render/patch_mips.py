"""Coarser levels of patches for minification: 2:1 averages of the nodes that keep the outline of every patch.

The paper names mip-mapping-like filtering as future work (section 6). A level is a `PatchSurface` again, with the
same patches in the same order, so that every mode draws it.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface, by_size, chosen_patches, opaque_nodes
from ..surface.srgb import LINEAR_OF_BYTE, to_srgb

OPAQUE = 1 / 8  # cover of a coarse node from which it is opaque; see `halved`
KEPT = 0.9  # a level's opaque area, of the patch's own, below which the level before stands for it


def mip_levels(surface: PatchSurface, most: int = 8) -> list[PatchSurface]:
    """Return the surface and its coarser levels, down to 2 x 2 nodes or `most` levels.

    m nodes become (m + 2) // 2, spread evenly between the same two ends: 17, 9, 5, 3, 2. A patch whose opaque part is
    too small for a level has the one before in its place: far away it is to cover what it covers near.
    """
    levels, own = [surface], opaque_area(surface)
    live = np.flatnonzero((surface.size > 2).any(axis=1))  # the patches that still become coarser
    part = chosen_patches(surface, live)
    while len(levels) < most and len(live):
        coarse = halved(part)
        goes_on = (opaque_area(coarse) >= KEPT * own[live]) & (coarse.size != part.size).any(axis=1)
        live, part = live[goes_on], chosen_patches(coarse, np.flatnonzero(goes_on))
        if len(live):
            levels.append(mixed(levels[-1], part, live))
    return levels


def opaque_area(surface: PatchSurface) -> NDArray:
    """Return the area (p,) float64, world units squared, of the cells between four opaque nodes of every patch."""
    opaque, out = opaque_nodes(surface.displacements, surface.colors), np.zeros(len(surface))
    for which, nodes, m, n in by_size(surface):
        grid = opaque[nodes].reshape(-1, n, m)
        out[which] = (grid[:, 1:, 1:] & grid[:, 1:, :-1] & grid[:, :-1, 1:] & grid[:, :-1, :-1]).sum(axis=(1, 2))
    return out * lengths_of(np.cross(surface.axis_x.astype(np.float64), surface.axis_y))


def mixed(fine: PatchSurface, coarse: PatchSurface, which: NDArray) -> PatchSurface:
    """Return the fine patches, with the coarse ones in the places `which` (q,), ascending."""
    if len(which) == len(fine):
        return coarse
    takes = np.zeros(len(fine), bool)
    takes[which] = True
    rows = {name: getattr(fine, name).copy() for name in ("axis_x", "axis_y", "size")}
    for name, values in rows.items():
        values[which] = getattr(coarse, name)
    goes = np.repeat(takes, rows["size"].prod(axis=1))
    # Where each node comes from in all fine ones and the coarse ones behind them. `take` is 3 times as fast as [...].
    source = np.empty(len(goes), np.int64)
    source[~goes] = np.flatnonzero(np.repeat(~takes, np.diff(fine.node_offset)))
    source[goes] = fine.node_count + np.arange(coarse.node_count)
    nodes = lambda a, b: np.concatenate([a, b]).take(source, 0)  # noqa: E731
    return replace(fine, **rows, displacements=nodes(fine.displacements, coarse.displacements),
                   colors=None if fine.colors is None else nodes(fine.colors, coarse.colors))


def with_levels(surface: PatchSurface, most: int) -> tuple[PatchSurface, int]:
    """Return one surface of all levels, patch after patch, and the number of levels.

    Level l of patch k is patch ``k * levels + l``; a patch's coarsest level stands for those beyond it.
    """
    levels = mip_levels(surface, most)
    count = len(levels)
    patch = np.concatenate([np.repeat(np.arange(len(s)), np.diff(s.node_offset)) for s in levels])
    order = np.argsort(patch, kind="stable")
    colors = None if surface.colors is None else np.concatenate([s.colors for s in levels]).take(order, 0)
    columns = {name: np.stack([getattr(s, name) for s in levels], axis=1).reshape(
        len(surface) * count, *getattr(surface, name).shape[1:])
        for name in ("origins", "axis_x", "axis_y", "axis_z_length", "size")}
    return replace(surface, **columns, displacements=np.concatenate([s.displacements for s in levels]).take(order),
                   colors=colors), count


def halved(surface: PatchSurface) -> PatchSurface:
    """Return the next coarser level of a surface.

    A coarse node is the tent-weighted mean of the opaque nodes less than one coarse step away; transparent where less
    than an eighth of that weight is opaque. A cell is drawn between four opaque nodes, so that an outline falls up to a
    coarse step inside of its outermost opaque nodes, half a step on average: where half a step outside of an outline
    the cover is an eighth, cells reach as far as the fine ones did. Nodes on a border average along it only, so that
    the outline of a patch and what it meets there stay (a mean across it would pull the rim inwards). Colours are
    averaged in linear light.
    """
    size = surface.size.astype(np.int64)
    coarse = (size + 2) // 2
    channels = 1 if surface.colors is None else 1 + surface.colors.shape[1]
    offset = np.concatenate([[0], np.cumsum(coarse.prod(axis=1))])
    values, cover = np.zeros((offset[-1], channels)), np.zeros(offset[-1])
    for which, nodes, m, n in by_size(surface):
        out = slice(None) if len(which) == len(surface) else \
            (offset[which][:, None] + np.arange(((m + 2) // 2) * ((n + 2) // 2))).ravel()
        values[out], cover[out] = _averaged(surface, nodes, m, n)
    kind = surface.displacements.dtype
    opaque, least = cover >= OPAQUE, np.iinfo(kind).min
    d = np.where(opaque, np.rint(values[:, 0]), least if surface.colors is None else 0).astype(kind)
    colors = None if surface.colors is None else _encoded(values[:, 1:], opaque)
    scale = (size - 1) / (coarse - 1)
    return replace(surface, axis_x=surface.axis_x * scale[:, :1], axis_y=surface.axis_y * scale[:, 1:], size=coarse,
                   displacements=d, colors=colors)


def tent(nodes: int) -> NDArray:
    """Return the weights (coarse, nodes) float64 of a row of nodes in its coarser row; straight lines stay."""
    coarse = (nodes + 2) // 2
    step = (nodes - 1) / (coarse - 1)
    weights = np.clip(1 - np.abs(np.arange(nodes) - np.arange(coarse)[:, None] * step) / step, 0, 1)
    weights[[0, -1]] = 0
    weights[0, 0] = weights[-1, -1] = 1
    weights /= weights.sum(axis=1, keepdims=True)
    # Where a coarse node falls between fine ones, their mean lies beside it: tilt the weights until it does not.
    places = np.arange(nodes) - (weights @ np.arange(nodes))[:, None]
    off = np.arange(coarse) * step - weights @ np.arange(nodes)
    return weights * (1 + places * (off / np.maximum((weights * places ** 2).sum(axis=1), 1e-9))[:, None])


def _averaged(surface, nodes, m, n):
    """Return the mean displacement and linear colours (q, channels) and the opaque share (q,) of coarse nodes."""
    d = surface.displacements[nodes]
    colors = None if surface.colors is None else surface.colors[nodes]
    opaque, channels = opaque_nodes(d, colors), 0 if colors is None else colors.shape[1]
    parts = np.empty((2 + channels, len(d)))
    np.multiply(d, opaque, out=parts[0])
    parts[-1] = opaque
    for c in range(min(channels, 3)):  # those of transparent nodes are 0, by their values or by their alpha
        LINEAR_OF_BYTE.take(colors[:, c], out=parts[1 + c])
    if channels == 4:
        np.divide(colors[:, 3], 255, out=parts[4])
        parts[1:4] *= parts[4]
    # One product for all rows: a product for each patch takes twice as long.
    rows = (parts.reshape(-1, m) @ tent(m).T).reshape(2 + channels, -1, n, (m + 2) // 2)
    sums = (tent(n) @ rows).reshape(2 + channels, -1)
    return (sums[:-1] / np.maximum(sums[-1], 1e-30)).T, sums[-1]


def _encoded(linear, opaque):
    """Return node colours (q, 3 or 4) uint8 from linear ones, premultiplied where there is an alpha."""
    if linear.shape[1] == 4:
        linear = linear.copy()
        linear[:, :3] /= np.maximum(linear[:, 3:], 1e-9)
    out = np.rint(255 * np.concatenate([to_srgb(linear[:, :3]), linear[:, 3:]], axis=1)).astype(np.uint8)
    if out.shape[1] == 4:
        out[:, 3] = np.maximum(out[:, 3], 1)
    else:
        out |= ((out[:, 0] | out[:, 1] | out[:, 2]) == 0)[:, None]  # pure black is transparent
    out *= opaque[:, None]
    return out
