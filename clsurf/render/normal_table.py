"""The table of normals that patches share, and what it would save (paper, section 3 and table 3).

In patch space the normal at a node is (-h_x r_x / 2, -h_y r_y / 2, 1) scaled to unit length: h_x and h_y are the
differences of the displacements of its neighbours, in half displacement steps per node, and r_x = |a_z| / |a_x|,
r_y = |a_z| / |a_y|. Patches of equal ratios therefore share their normals. By symmetry only |h_x| and |h_y| matter:
256 x 256 entries of 8 bytes (3 components of 16 bits, 2 bytes that say whose entry it is) are the paper's 512 KB.
Steeper differences, which int8 nodes have at borders only, are computed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface

SIDE = 256  # entries each way
TABLE_BYTES = SIDE * SIDE * 8  # 512 KB
RATIO_STEPS = 1024  # groups of ratios are 2^(1/1024) apart: slopes within 0.034 %, normals within 0.17 mrad


@dataclass(frozen=True)
class NormalStatistics:
    """How many node normals are computed, by technique (paper, table 3).

    Attributes
    ----------
    normals : int
        Normals wanted, one per opaque node: computed without a buffer.
    buffered, ordered : int
        Computed where a table holds the normals of one group of axis ratios at a time and is emptied when the group
        changes, with the patches in the order of the surface, and ordered by group.
    precomputed : int
        Computed per frame where the table is filled beforehand: only those that it cannot hold. That needs patches of
        one group; otherwise it equals `ordered`.
    groups : int
        Different pairs of axis ratios.
    """

    normals: int
    buffered: int
    ordered: int
    precomputed: int
    groups: int

    @property
    def shares(self) -> dict[str, float]:
        """The share of the normals that each technique computes, 0 to 1, by its name."""
        return {name: getattr(self, name) / max(self.normals, 1) for name in ("buffered", "ordered", "precomputed")}


def half_steps(surface: PatchSurface) -> tuple[NDArray, NDArray]:
    """Return h_x and h_y of every node, two (N,) int64 arrays: displacement steps per two nodes.

    Central differences; twice the one-sided ones at borders and beside transparent nodes, 0 without a neighbour. Of
    transparent nodes the values mean nothing.
    """
    d, opaque = surface.displacements.astype(np.int64), surface.opaque
    return node_differences(surface, d, 0, opaque), node_differences(surface, d, 1, opaque)


def node_differences(surface: PatchSurface, values: NDArray, axis: int, opaque: NDArray | None = None) -> NDArray:
    """Return the differences (N,) int64 of a whole number per node along x (axis 0) or y, per two nodes."""
    opaque = surface.opaque if opaque is None else opaque
    if surface.equal_sizes and len(surface):  # all patches at once
        m, n = (int(v) for v in surface.size[0])
        return _differences(values.reshape(-1, n, m), opaque.reshape(-1, n, m), 2 - axis).ravel()
    parts = [_differences(values[a:b].reshape(1, n, m), opaque[a:b].reshape(1, n, m), 2 - axis).ravel()
             for a, b, (m, n) in zip(surface.node_offset[:-1], surface.node_offset[1:], surface.size, strict=True)]
    return np.concatenate([np.zeros(0, np.int64), *parts])


def _differences(d, opaque, axis):
    """Return the differences (p, n, m) along one axis, in half steps."""
    d, opaque = np.moveaxis(d, axis, 0), np.moveaxis(opaque, axis, 0)
    step = np.where(opaque[1:] & opaque[:-1], d[1:] - d[:-1], 0)
    known = opaque[1:] & opaque[:-1]
    h, sides = np.zeros_like(d), np.zeros(d.shape, np.int64)
    h[:-1] += step
    h[1:] += step
    sides[:-1] += known
    sides[1:] += known
    return np.moveaxis(np.where(sides == 1, 2 * h, h), 0, axis)


def ratio_groups(surface: PatchSurface) -> tuple[NDArray, NDArray]:
    """Return the group (p,) int64 of every patch, and the groups' ratios (g, 2) float64, r_x and r_y."""
    lengths = [lengths_of(a.astype(np.float64)) for a in (surface.axis_x, surface.axis_y)]
    ratios = surface.axis_z_length[:, None] / np.stack(lengths, axis=1)
    steps, group = np.unique(np.rint(np.log2(ratios) * RATIO_STEPS), axis=0, return_inverse=True)
    return group.ravel(), 2.0 ** (steps.reshape(-1, 2) / RATIO_STEPS)


def table_order(group: NDArray) -> NDArray:
    """Return the patches ordered by group, then by number, (p,) int64."""
    return np.argsort(group, kind="stable")


def normal_statistics(surface: PatchSurface, patches: NDArray | None = None) -> NormalStatistics:
    """Count the node normals that a frame computes with and without a table, exactly.

    Parameters
    ----------
    patches : (p,) bool, optional
        The patches that the frame draws; by default all.

    Returns
    -------
    NormalStatistics
    """
    counts = np.diff(surface.node_offset)
    drawn = np.ones(len(surface), bool) if patches is None else np.asarray(patches, bool)
    shown = surface.opaque & np.repeat(drawn, counts)
    hx, hy = (np.abs(h[shown]) for h in half_steps(surface))
    group, _ = ratio_groups(surface)
    runs = np.zeros(len(surface), np.int64)  # number of the run of equal groups among the drawn patches
    runs[drawn] = np.concatenate([[0], np.cumsum(np.diff(group[drawn]) != 0)])[:int(drawn.sum())]
    held = (hx < SIDE) & (hy < SIDE)
    outside, keys = int((~held).sum()), (hx * SIDE + hy)[held]
    entries = [len(np.unique(np.repeat(which, counts)[shown][held] * SIDE ** 2 + keys)) for which in (runs, group)]
    groups = len(np.unique(group[drawn]))
    ordered = outside + entries[1]
    return NormalStatistics(len(hx), outside + entries[0], ordered, outside if groups <= 1 else ordered, groups)
