"""Colours of surfaces at places on them."""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..io.stored import StoredSurface
from ..surface.mesh import Mesh
from ..surface.slim import SlimSurface
from ..surface.srgb import premultiplied, straight
from ..surface.surfel import SurfelHierarchy
from .neighbours import nearest
from .slim import vertex_colors
from .triangles import barycentric_foot, nearest_triangles

NEIGHBOURS = 12  # leaves that are blended
BATCH = 1 << 18  # places at a time


def colors_at(surface, positions: NDArray, normals: NDArray, device: Device) -> NDArray | None:
    """Return the colours (n, 4) uint8 sRGB of world places (n, 3) with normals (n, 3); None: it has none.

    Of leaves and discs blended by (1 - t^2)^3 of the distance over the radius, as they are drawn; of triangles those of
    the corners.
    """
    if isinstance(surface, StoredSurface):
        if not surface.colored:
            return None
        out, leaves = np.zeros((len(positions), 4), np.uint8), surface.leaves()
        for rows, parts in leaves.groups(positions):
            if len(parts):
                some = colors_at(leaves.surface(parts)[0], positions[rows], normals[rows], device)
                out[rows] = 255 if some is None else some
        return out
    if isinstance(surface, SlimSurface):
        balls = np.flatnonzero(surface.leaf), surface.centers, surface.radii, surface.normals, surface.colors
    elif isinstance(surface, SurfelHierarchy) and not surface.hybrid:
        balls = surface.base, surface.positions, surface.radii, surface.normals, surface.colors
    elif isinstance(surface, Mesh | SurfelHierarchy):
        mesh = surface.mesh if isinstance(surface, SurfelHierarchy) else surface
        colors = vertex_colors(mesh)
        return None if colors is None else _of_triangles(mesh, colors, positions, device)
    else:
        return None
    if balls[-1] is None:
        return None
    centers, radii, axes, colors = (array[balls[0]] for array in balls[1:])
    local = (positions - surface.origin).astype(np.float32)
    out = np.empty((len(positions), 4), np.uint8)
    for start in range(0, len(positions), BATCH):
        part = slice(start, start + BATCH)
        out[part] = _blended(centers, radii, axes, premultiplied(colors), local[part], normals[part], device)
    return out


def _blended(centers, radii, axes, light, places, normals, device) -> NDArray:
    at, away = nearest(centers, min(NEIGHBOURS, len(centers)), places, device)
    weight = np.maximum(1 - (away / radii[at]) ** 2, 0) ** 3
    weight *= np.einsum("nkj,nj->nk", axes[at], normals) > 0  # the other side of a thin sheet has its own colours
    weight[weight.sum(axis=1) <= 0, 0] = 1
    return straight(np.einsum("nk,nkj->nj", weight, light[at]) / weight.sum(axis=1, keepdims=True))


def _of_triangles(mesh: Mesh, colors: NDArray, positions: NDArray, device: Device) -> NDArray:
    local = positions - mesh.origin
    _, face = nearest_triangles(mesh.vertices, mesh.faces, local, device)
    corners = mesh.faces[face]
    _, weights = barycentric_foot(local, mesh.vertices[corners].astype(np.float64))
    return straight(np.einsum("nk,nkj->nj", weights, premultiplied(colors[corners])))
