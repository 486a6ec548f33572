"""Marching cubes over the cells of a sparse grid.

Source: Lorensen, Cline, "Marching Cubes: A High Resolution 3D Surface Construction Algorithm", SIGGRAPH 1987. The table
is made, not typed in: on each face of a cube every run of inside corners is cut off by one segment, which is the same
seen from both of its cells, and the loops of segments are triangulated without a diagonal that lies in a face. So no
edge has more than two triangles, and a surface that does not leave the cells is closed. scikit-image's takes dense
boxes: their seams would have to be welded, and a large thin surface has no room in one.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .sparse_grid import SparseGrid, corner

EDGES = [(number, axis) for axis in range(3) for number in range(8) if not number >> axis & 1]  # lower corner, axis
CHUNK = 1 << 20  # cells at a time


def marching_cubes(grid: SparseGrid, values: NDArray) -> NDArray:
    """Return the triangles of the zero set.

    Parameters
    ----------
    values : (n,) float
        Of the grid's nodes; inside is below 0.

    Returns
    -------
    (f, 3) int64
        Corners of triangles as edges of the grid, 3 x (number of the lower node) + axis; counter-clockwise seen from
        where values are positive.
    """
    table, inside = triangle_table(), values < 0
    lower, axis = (np.array([edge[k] for edge in EDGES]) for k in (0, 1))
    faces = [np.zeros((0, 3), np.int64)]
    for start in range(0, len(grid.cells), CHUNK):
        cells = grid.cells[start:start + CHUNK]
        at = np.stack([grid.find(corner(cells, number)) for number in range(8)], axis=1)
        case = (inside[at] << np.arange(8)).sum(axis=1)
        crossed = np.flatnonzero((case > 0) & (case < 255))
        at, edges = at[crossed], table[case[crossed]]
        cell, triangle = np.nonzero(edges[:, :, 0] >= 0)
        edges = edges[cell, triangle].astype(np.int64)
        faces.append(3 * at[cell[:, None], lower[edges]] + axis[edges])
    return np.concatenate(faces)


@lru_cache(maxsize=1)
def triangle_table() -> NDArray:
    """Return (256, most, 3) int8: for each pattern of inside corners the edges that its triangles join; -1: none."""
    triangles = [_triangles(case) for case in range(256)]
    table = np.full((256, max(map(len, triangles)), 3), -1, np.int8)
    for case, some in enumerate(triangles):
        table[case, :len(some)] = np.array(some, np.int8).reshape(-1, 3)
    table.flags.writeable = False
    return table


def _triangles(case: int) -> list[tuple[int, int, int]]:
    """Return the triangles of a pattern, corners as numbers of `EDGES`."""
    following = {}
    for face in _cube_faces():
        inside = [case >> number & 1 for number in face]
        for k in range(4):
            if inside[k] or not inside[(k + 1) % 4]:
                continue
            end = k + 1  # where the run of inside corners that begins there ends
            while inside[(end + 1) % 4]:
                end += 1
            into, out = (_edge(face[i % 4], face[(i + 1) % 4]) for i in (k, end))
            following[into] = out
    triangles = []
    while following:
        first, loop = next(iter(following)), []
        while first in following:
            loop.append(first)
            first = following.pop(first)
        triangles += _triangulated(loop)
    return triangles


def _triangulated(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Return triangles of a loop of edges without diagonals in the cube's faces; None: there is no such way."""
    if len(loop) == 3:
        return [tuple(loop)]
    first, last = loop[0], loop[-1]
    for k in range(1, len(loop) - 1):
        apex = loop[k]
        if (k > 1 and _share_face(first, apex)) or (k < len(loop) - 2 and _share_face(apex, last)):
            continue
        left = _triangulated(loop[:k + 1]) if k > 1 else []
        right = _triangulated(loop[k:]) if k < len(loop) - 2 else []
        if left is not None and right is not None:
            return [(first, apex, last), *left, *right]
    return None


def _cube_faces() -> list[list[int]]:
    """Return the corners of the six faces, counter-clockwise seen from outside."""
    faces = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        low = [0, v, u | v, u]
        faces += [low, [number | 1 << axis for number in low[::-1]]]
    return faces


def _edge(a: int, b: int) -> int:
    low = a & b
    return EDGES.index((low, (a ^ b).bit_length() - 1))


def _share_face(one: int, other: int) -> bool:
    """Return whether two edges of the cube lie in a common face."""
    ends = [{EDGES[edge][0], EDGES[edge][0] | 1 << EDGES[edge][1]} for edge in (one, other)]
    return any(ends[0] | ends[1] <= set(face) for face in _cube_faces())
