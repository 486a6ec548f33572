"""The middles of faces that are large against their neighbours, and of edges of coarse meshes, as points.

No vertex tells of the surface there.
"""

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import lengths_of

# Longest edges over the median one. Where a mesh's holes were closed by large faces, leaves cover its vertices and
# little between them: the dragon at T 0.005 showed its inside in 13 places of a picture of 1024 x 1024, with the
# middles of 2 % of its faces in one or none, for 1.2 % more leaves. 2.0 takes 8 % more, 3.0 leaves 3 places.
LARGE = 2.5
SAMPLE = 20_000  # faces that give the median
# Meshes of fewer vertices, of whose edges more than the share BENT join normals over 25 degrees apart, are coarse for
# what they show: a ball of 14 vertices about an ear's rim or an eyelid's edge holds both of its sides, and the textured
# head (9,212 vertices, 15 % of its edges) had fringes there. The bunny has 34,834 and 2.4 %. Middles of the bent edges
# alone are no remedy: where the density jumps the head had holes.
FEW, BENT, COSINE = 20_000, 0.05, 0.906


def large_faces(points: NDArray, faces: NDArray) -> NDArray:
    """Return the faces (k, 3) whose longest edge is over LARGE times the median longest edge.

    Parameters
    ----------
    points : (v, 3) float32
    faces : (f, 3) int32
    """
    if not len(faces) or not np.isfinite(points).any():
        return faces[:0]
    limit2 = LARGE**2 * np.nanmedian(longest2(points, faces[::max(1, len(faces) // SAMPLE)]))
    with np.errstate(over="ignore", invalid="ignore"):
        return faces[longest2(points, faces) > limit2] if np.isfinite(limit2) else faces[:0]


def coarse_edges(points: NDArray, normals: NDArray, faces: NDArray) -> NDArray:
    """Return all edges (k, 2) of a mesh that is coarse for its curvature, see FEW, otherwise none.

    Parameters
    ----------
    points : (v, 3) float32
    normals : (v, 3) float32
        Not necessarily unit.
    faces : (f, 3) int32
    """
    if len(points) >= FEW or not len(faces):
        return np.zeros((0, 2), faces.dtype)
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        a, b = (normals[edges[:, k]].astype(np.float64) for k in range(2))
        bent = (a * b).sum(axis=1) < COSINE * lengths_of(a) * lengths_of(b)
    return edges if bent.mean() > BENT else edges[:0]


def with_edges(position, normals, colors, weights, edges) -> tuple:
    """Return the arrays of the vertices, those that are not None with the middles of `edges` (k, 2) at their end.

    The middles have the mean normal and colour of their ends and the least weight.
    """
    if not len(edges):
        return position, normals, colors, weights
    with np.errstate(over="ignore", invalid="ignore"):
        mean = unit(normals[edges].sum(axis=1))
    return with_means(position, normals, colors, weights, edges, mean)


def longest2(points: NDArray, faces: NDArray) -> NDArray:
    """Return the squared length (f,) of every face's longest edge; column by column, four times as fast as by rows."""
    longest = np.zeros(len(faces), points.dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        columns = [[points[:, axis][faces[:, corner]] for corner in range(3)] for axis in range(3)]
        for a, b in ((0, 1), (1, 2), (2, 0)):
            np.maximum(longest, sum((column[a] - column[b]) ** 2 for column in columns), out=longest)
    return longest


def with_middles(position, normals, colors, weights, faces) -> tuple:
    """Return the arrays of the vertices, those that are not None with the middles of `faces` (k, 3) at their end.

    The middles have their face's normal on the side of its vertices' normals, the mean colour and the least weight.
    """
    if not len(faces):
        return position, normals, colors, weights
    normal = None
    if normals is not None:
        corners = position[faces]
        with np.errstate(over="ignore", invalid="ignore"):
            normal = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
            normal *= np.where((normals[faces].sum(axis=1) * normal).sum(axis=1, keepdims=True) < 0, -1, 1)
    return with_means(position, normals, colors, weights, faces, normal)


def unit(vectors: NDArray) -> NDArray:
    """Return vectors (n, 3) over their length; 0 stays."""
    return vectors / np.maximum(lengths_of(vectors, keepdims=True), np.finfo(np.float32).tiny)


def with_means(position, normals, colors, weights, rows, own) -> tuple:
    """Return the arrays with the means of `rows` (k, m) of them at their end: those have the normals `own` (k, 3)."""
    if normals is not None:
        normals = np.concatenate([normals, own.astype(np.float32)])
    if colors is not None:
        colors = np.concatenate([colors, np.round(colors[rows].mean(axis=1)).astype(colors.dtype)])
    if weights is not None:
        weights = np.concatenate([weights, weights[rows].min(axis=1)])
    return np.concatenate([position, position[rows].mean(axis=1, dtype=np.float32)]), normals, colors, weights
