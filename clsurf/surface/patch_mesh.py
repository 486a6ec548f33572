"""Spatial patches as a triangle mesh: for programs that know meshes only."""

import numpy as np

from .mesh import Mesh
from .patch import PatchSurface


def patch_mesh(surface: PatchSurface) -> Mesh:
    """Return the opaque nodes as vertices, and two triangles for every cell whose four nodes are opaque.

    Patches stay apart as they are: overlaps overlap, and nothing is stitched.

    Parameters
    ----------
    surface : PatchSurface

    Returns
    -------
    Mesh
        With the nodes' colours, or the surface's one colour, where it has any. Faces are counter-clockwise seen from
        the side that axis_z points to, cut along the diagonal from node (i, j) to (i + 1, j + 1).
    """
    opaque = surface.opaque
    patch, i, j = surface.node_patches()
    m, n = surface.size[patch].T.astype(np.int64)
    first = np.flatnonzero((i < m - 1) & (j < n - 1))
    a, b, c, d = corners = np.stack([first, first + 1, first + m[first], first + m[first] + 1])
    number = np.cumsum(opaque) - 1
    faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    faces = faces[np.tile(opaque[corners].all(axis=0), 2)]
    colors = None
    if surface.colors is not None or surface.color is not None:
        colors = np.full((int(opaque.sum()), 4), 255, np.uint8)
        colors[:, :3] = surface.color if surface.colors is None else surface.colors[opaque, :3]
        if surface.colors is not None and surface.colors.shape[1] == 4:
            colors[:, 3] = surface.colors[opaque, 3]
    return Mesh(surface.positions()[opaque], number[faces], colors=colors)
