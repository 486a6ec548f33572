"""Nearest points of a scale map."""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import InputError
from ..surface.arrays import lengths_of
from ..surface.cube import interpolated
from ..surface.scale_map import ScaleMap
from ..surface.scale_mesh import scale_mesh
from ..surface.slim import frame_of_normals
from .triangles import barycentric_foot, nearest_triangles


def project_scale_map(surface: ScaleMap, points: NDArray, device: Device) -> tuple[NDArray, NDArray, NDArray]:
    """Return the nearest positions, normals (n, 3) and signed distances (n,) of world points (n, 3), float64.

    The nearest point of the net of texels in triangles, moved along its ray from the centre onto the map's interpolated
    surface of the nearest layer: the nearest one to second order in the texels' size. Normals point outward.
    """
    mesh = scale_mesh(surface)
    if not len(mesh.faces):
        raise InputError("surface: expected a scale map with cells between four valid texels, got none")
    local = points - surface.center
    _, face = nearest_triangles(mesh.vertices, mesh.faces, local, device)
    corners = mesh.vertices.astype(np.float64)[mesh.faces[face]]
    foot, _ = barycentric_foot(local, corners)
    length = lengths_of(foot, keepdims=True)
    direction = foot / np.where(length > 0, length, 1)
    direction[length[:, 0] == 0] = (0, 0, 1)
    best = np.full(len(points), np.inf)
    normal = direction.copy()
    for k in range(surface.layers):
        rho, known = _radius(surface, k, direction)
        nearer = known & (np.abs(rho - length[:, 0]) < np.abs(best - length[:, 0]))
        best[nearer] = rho[nearer]
        normal[nearer] = _normals(surface, k, direction[nearer], rho[nearer])
    # Beside a hole the foot may lie where the map says nothing.
    best = np.where(np.isfinite(best), best, length[:, 0])
    position = direction * best[:, None]
    apart = local - position
    side = np.where((apart * normal).sum(axis=1) < 0, -1.0, 1.0)
    return position + surface.center, normal, side * lengths_of(apart)


def _radius(surface, layer, directions) -> tuple[NDArray, NDArray]:
    values = np.nan_to_num(surface.lambdas[layer].astype(np.float64))
    rho, known = interpolated(values, surface.valid[layer], directions)
    return surface.radius * rho, known


def _normals(surface, layer, directions, rho) -> NDArray:
    """Return outward normals (n, 3), n ~ rho d - grad rho, by differences over a texel."""
    u, v = frame_of_normals(directions)
    step = 1 / surface.size
    slopes = []
    for axis in (u, v):
        ends = [_radius(surface, layer, directions + sign * step * axis) for sign in (1, -1)]
        ends = [np.where(known, value, rho) for value, known in ends]
        slopes.append((ends[0] - ends[1]) / (2 * np.arctan(step)))
    n = rho[:, None] * directions - slopes[0][:, None] * u - slopes[1][:, None] * v
    return n / np.maximum(lengths_of(n, keepdims=True), 1e-300)
