"""Nearest points of meshes, and of patches as the triangles between their nodes.

Source of the sign: Baerentzen and Aanaes, "Signed distance computation using the angle weighted pseudonormal", IEEE
TVCG 11(3), 2005: right at edges and vertices too, where the nearest face alone can tell the wrong side.
"""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..io.cleaning import first_of_duplicates
from ..surface.arrays import finite_rows, lengths_of
from ..surface.mesh import Mesh
from .triangles import barycentric_foot, nearest_triangles

ON_EDGE = 1e-6  # share of a corner below which a foot lies on the opposite edge


def project_mesh(mesh: Mesh, points: NDArray, device: Device) -> tuple[NDArray, NDArray, NDArray]:
    """Return the nearest positions, normals (n, 3) and signed distances (n,) of world points (n, 3), float64.

    Normals are the nearest face's; on an edge the mean of its faces', on a vertex that of its faces' by their angles.
    """
    local = points - mesh.origin
    _, face = nearest_triangles(mesh.vertices, mesh.faces, local, device)
    vertices = mesh.vertices.astype(np.float64)
    corners = vertices[mesh.faces[face]]
    foot, weights = barycentric_foot(local, corners)
    normal = _pseudonormals(vertices, np.asarray(mesh.faces, np.int64), face, weights)
    apart = local - foot
    side = np.where(np.einsum("ij,ij->i", apart, normal) < 0, -1.0, 1.0)
    return foot + mesh.origin, normal, side * lengths_of(apart)


def _pseudonormals(vertices, faces, face, weights) -> NDArray:
    """Return unit normals (n, 3) at points of faces: a face's own, at edges and vertices the pseudonormals."""
    welded = first_of_duplicates(vertices.astype(np.float32))[1][faces]  # seams of textures are no edges
    touched = np.zeros(len(vertices), bool)
    touched[welded[face]] = True
    near = np.flatnonzero(touched[welded].any(axis=1))  # faces that share a corner with one that counts
    corners = vertices[faces[near]]
    own = np.full((len(faces), 3), np.nan)
    own[near] = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    normal = own[face]
    on_edge = weights < ON_EDGE
    edge = np.flatnonzero(on_edge.sum(axis=1) == 1)
    vertex = np.flatnonzero(on_edge.sum(axis=1) >= 2)
    if len(edge):
        key = lambda of, k: (np.sort(np.stack([of[:, (k + 1) % 3], of[:, (k + 2) % 3]]), axis=0)  # noqa: E731
                             * np.array([[len(vertices)], [1]])).sum(axis=0)
        keys, index = np.unique(np.concatenate([key(welded[near], k) for k in range(3)]), return_inverse=True)
        sums = _sums(np.nan_to_num(np.tile(own[near], (3, 1))), index, len(keys))
        opposite = on_edge[edge].argmax(axis=1)
        mine = np.stack([key(welded[face[edge]], k) for k in range(3)])[opposite, np.arange(len(edge))]
        normal[edge] = sums[np.searchsorted(keys, mine)]
    if len(vertex):
        from trimesh.triangles import angles  # a fifth of a second of every start
        by_angle = np.nan_to_num(angles(corners)[:, :, None] * own[near][:, None]).reshape(-1, 3)
        sums = _sums(by_angle, welded[near].ravel(), len(vertices))
        corner = weights[vertex].argmax(axis=1)
        normal[vertex] = sums[welded[face[vertex], corner]]
    # Faces without an area, and opposite ones that cancel out, have no direction: any will do.
    out = _unit(normal)
    out[~finite_rows(out)] = (0, 0, 1)
    return out


def _sums(rows, index, count) -> NDArray:
    return np.stack([np.bincount(index.ravel(), rows[:, axis], count) for axis in range(3)], axis=1)


def _unit(vectors) -> NDArray:
    length = lengths_of(vectors, keepdims=True)
    return np.divide(vectors, length, out=np.full(vectors.shape, np.nan), where=length > 0)
