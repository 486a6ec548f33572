"""Scale maps as meshes: the closed net of texels in triangles."""

import numpy as np

from .cube import border_index
from .mesh import Mesh
from .scale_map import ScaleMap


def scale_mesh(surface: ScaleMap) -> Mesh:
    """Return the points of all layers' texels joined by triangles, counter-clockwise from outside, holes left out.

    Squares of the net (clsurf/surface/cube.py) become two triangles, the corners of the cube one. Vertex k is the k-th
    valid texel.
    """
    size, layers = surface.size, surface.layers
    index = border_index(size)
    a, b, c, d = index[:, :-1, :-1], index[:, :-1, 1:], index[:, 1:, :-1], index[:, 1:, 1:]
    # Every square across an edge stands in two faces' borders; the first one keeps it.
    inner = np.zeros((6, size + 1, size + 1), bool)
    inner[:, 1:-1, 1:-1] = True
    quads = np.stack([x[inner] for x in (a, b, c, d)], axis=1)
    border = ~inner
    over = np.stack([x[border] for x in (a, b, c, d)], axis=1)
    corner = (over < 0).any(axis=1)
    once = np.unique(np.sort(over[~corner], axis=1), axis=0, return_index=True)[1]
    quads = np.concatenate([quads, over[~corner][once]])
    # Seen from outside, rows and columns run clockwise.
    faces = [quads[:, [0, 2, 1]], quads[:, [3, 1, 2]]]
    three = np.array([_without_gap(row) for row in over[corner]], np.int64).reshape(-1, 3)
    faces.append(three[np.unique(np.sort(three, axis=1), axis=0, return_index=True)[1]])
    faces = np.concatenate(faces)
    valid = surface.valid.reshape(layers, -1)
    number = (np.cumsum(valid) - 1).reshape(layers, -1)
    kept = [number[k][faces[valid[k][faces].all(axis=1)]] for k in range(layers)]
    points = (surface.positions() - surface.center).reshape(-1, 3)[valid.ravel()].astype(np.float32)
    normals = surface.unit_normals()
    return Mesh(points, np.concatenate(kept), origin=surface.center,
                normals=None if normals is None else normals.reshape(-1, 3)[valid.ravel()])


def _without_gap(row) -> list[int]:
    """Return the three texels of a corner's square (A, B, C, D with one -1), counter-clockwise from outside."""
    around = [row[0], row[2], row[3], row[1]]
    return [v for v in around if v >= 0]
