"""Cells of a regular grid near a surface, found from coarse to fine: nothing is stored for the empty rest of its box.

A cell is the Morton key of its lowest corner, 21 bits an axis, and so is a node. Keys sort along the curve, so that
what is worked on together lies together; a neighbour's key follows by adding to every third bit.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import Cancelled, InputError
from .morton import AXIS_BITS, morton, unmorton
from .project import project

CHUNK = 1 << 20  # points that are projected together
TOP_CELLS = 24  # along the longest side of the coarsest grid
# A cell is near a surface where its middle is: half a cell's diagonal is sqrt(3) / 2 = 0.866 edges, and what `project`
# finds from far is not always the nearest place. With 1.5 the bunny's mesh has 2 of 87,643 vertices more, the dragon's
# 1 of 389,013, at their borders; those of a torus and of fandisk are the same.
NEAR = 1.1
_X = sum(1 << 3 * bit for bit in range(AXIS_BITS))
_AXIS = (_X, _X << 1, _X << 2)


@dataclass(frozen=True, eq=False)
class SparseGrid:
    """The cells near a surface and their corners.

    Attributes
    ----------
    low : (3,) float64
        World position of node 0.
    spacing : float
        Edge of a cell, world units.
    cells, nodes : (c,), (n,) int64
        Keys, ascending; nodes are all corners of the cells.
    """

    low: NDArray
    spacing: float
    cells: NDArray
    nodes: NDArray

    def positions(self, nodes: NDArray) -> NDArray:
        """Return the world positions (n, 3) float64 of nodes (n,), keys."""
        return coordinates(nodes) * self.spacing + self.low

    def find(self, nodes: NDArray) -> NDArray:
        """Return the numbers of `nodes`, keys which the grid has."""
        return np.searchsorted(self.nodes, nodes)


def coordinates(keys: NDArray) -> NDArray:
    """Return the three coordinates (n, 3) int64 of keys (n,)."""
    return unmorton(keys.astype(np.uint64))


def keys_of(places: NDArray) -> NDArray:
    """Return the keys (n,) int64 of coordinates (n, 3), the inverse of `coordinates`."""
    return morton(places).astype(np.int64)


def stepped(keys: NDArray, axis: int) -> NDArray:
    """Return the keys one further along an axis: the other bits, filled with ones, pass the carry on."""
    mask = _AXIS[axis]
    return (((keys | ~mask) + 1) & mask) | (keys & ~mask)


def corner(keys: NDArray, number: int) -> NDArray:
    """Return the keys of corner `number` (bits: along x, y, z) of cells."""
    for axis in range(3):
        if number >> axis & 1:
            keys = stepped(keys, axis)
    return keys


def reporter(name: str, progress):
    """Return a function (stage, done) that passes progress on, and raises Cancelled where the callback says False."""
    def report(stage: str, done: float) -> None:
        if progress is not None and progress(stage, done) is False:
            raise Cancelled(f"{name}: stopped by the progress callback")
    return report


def projected(surface, points: NDArray, device: Device, report, stage: str):
    """Yield (rows, projection) of world points (n, 3), chunk by chunk: it takes a few hundred bytes a point."""
    count = len(points)
    for start in range(0, count, CHUNK):
        report(stage, start / count)
        rows = slice(start, min(start + CHUNK, count))
        yield rows, project(surface, points[rows], device)


@dataclass(frozen=True, eq=False)
class _Places:
    """Positions of keys, made where they are asked for."""

    low: NDArray
    spacing: float
    keys: NDArray

    def __len__(self):
        return len(self.keys)

    def __getitem__(self, rows):
        return coordinates(self.keys[rows]) * self.spacing + self.low


def distances(surface, low: NDArray, spacing: float, keys: NDArray, device: Device, report, stage: str) -> NDArray:
    """Return the signed distances (n,) float32, world units, of nodes; of the cells' middles where `low` is moved."""
    out = np.empty(len(keys), np.float32)
    for rows, near in projected(surface, _Places(low, spacing, keys), device, report, stage):
        out[rows] = near.distance
    return out


@dataclass(frozen=True, eq=False)
class NearCells:
    """Cells of twice the edge `spacing` near a surface, whose eight parts make up a grid of that edge.

    Attributes
    ----------
    low : (3,) float64
        World position of the corner of cell 0.
    spacing : float
        World units.
    parents : (p,) int64
        Keys, ascending.
    """

    low: NDArray
    spacing: float
    parents: NDArray

    def cells(self, rows=slice(None)) -> NDArray:
        """Return the keys (8 p,) int64 of the parts of some parents, ascending."""
        return ((self.parents[rows] << 3)[:, None] | np.arange(8)).ravel()

    def grid(self) -> SparseGrid:
        """Return all parts with their corners."""
        cells = self.cells()
        return SparseGrid(self.low, self.spacing, cells, _corners(self.parents))


def near_cells(surface, spacing: float, device: Device, report, most_cells: float, coarser: bool = False) -> NearCells:
    """Return the cells near a surface that `project` takes.

    Parameters
    ----------
    spacing : float
        Edge of the finest cells, world units.
    most_cells : float
        About as many of those as there may be.
    coarser : bool
        Where there would be more, take a larger spacing instead of refusing.

    Raises
    ------
    InputError
        More cells than may be, or more than 2^20 along a side; a surface without extent.
    """
    while True:
        found = _refined(surface, spacing, device, report, most_cells)
        if isinstance(found, NearCells):
            return found
        if not coarser:
            raise InputError(f"spacing: expected at least {found:.4g} on this surface, where a finer grid has more "
                             f"than {most_cells:,.0f} cells, got {spacing:.4g}")
        spacing = found


def _refined(surface, spacing, device, report, most_cells) -> NearCells | float:
    """Return the cells, or the spacing at which they are few enough."""
    box = surface.bounds
    if not np.isfinite(box).all():
        raise InputError("surface: expected at least one leaf, disc or face, got none")
    extent = float(np.ptp(box, axis=0).max())
    margin = 2 * spacing + 0.02 * extent
    low, size = box[0] - margin, np.ptp(box, axis=0) + 2 * margin
    finest = max(spacing, size.max() / (1 << AXIS_BITS - 1))  # that keys have room for
    level = max(1, int(np.ceil(np.log2(size.max() / finest / TOP_CELLS))))
    count = np.ceil(size / (finest * 2**level)).astype(int)
    keys = np.sort(keys_of(np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, 3)))
    expected = np.inf
    while True:
        edge = finest * 2**level
        away = distances(surface, low + edge / 2, edge, keys, device, report, "cells near the surface")
        keys = keys[np.abs(away) <= NEAR * edge]
        before, expected = expected, 2.0 * len(keys) * (edge / spacing) ** 2
        growth = np.clip(expected / max(before, 1), 1, 1.5)
        if expected > most_cells:
            # Areas grow by four a level; vegetation and noise by more, as they did by the last one.
            return float(spacing * max(1.05, np.sqrt(expected * growth ** (level - 1) / most_cells)))
        if level == 1:
            return NearCells(low, spacing, keys) if finest == spacing else finest
        level -= 1
        keys = ((keys << 3)[:, None] | np.arange(8)).ravel()


def _corners(parents: NDArray) -> NDArray:
    """Return the keys of all corners of the eight parts of each parent, ascending."""
    steps = np.arange(3)
    inside = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    all_of_them = []
    for x, y, z in inside:
        base = parents
        for axis, step in enumerate((x, y, z)):  # 2 along an axis is the next parent's first
            base = stepped(base, axis) if step == 2 else base
        all_of_them.append((base << 3) | int((x & 1) | (y & 1) << 1 | (z & 1) << 2))
    nodes = np.sort(np.concatenate(all_of_them))
    return nodes[np.append(True, nodes[1:] != nodes[:-1])] if len(nodes) else nodes
