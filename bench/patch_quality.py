"""How far spatial patches are from the mesh that they were made from, both ways, and the holes that pictures show.

Distances are exact to the triangles on the other side: a k-d tree of centroids gives candidates, and the search widens
until no other triangle can be nearer. Patches are taken as they are drawn, as bilinear quads, cut into triangles.
"""

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

SAMPLES = 200_000  # of each side
PARTS = 2          # a cell is measured as PARTS x PARTS quads of its bilinear surface, two triangles each


def triangle_distances(points: NDArray, triangles: NDArray, first: int = 8) -> NDArray:
    """Return the exact distances (n,) of `points` (n, 3) to the nearest of `triangles` (t, 3, 3), float64."""
    points, triangles = np.asarray(points, np.float64), np.asarray(triangles, np.float64)
    middle = triangles.mean(axis=1)
    radius = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
    best = np.full(len(points), np.inf)
    # One tree for each class of size: a few large triangles would make every search among the small ones wide.
    level = np.ceil(np.log2(np.maximum(radius, radius.max() * 1e-6))).astype(int)
    for size in np.unique(level):
        chosen = np.flatnonzero(level == size)
        reach = radius[chosen].max()
        tree = cKDTree(middle[chosen])
        rest, k = np.arange(len(points)), min(first, len(chosen))
        while len(rest):
            apart, near = tree.query(points[rest], k=k, distance_upper_bound=np.inf)
            apart, near = apart.reshape(len(rest), k), near.reshape(len(rest), k)
            for column in range(k):
                some = np.flatnonzero(apart[:, column] - reach < best[rest])
                found = point_triangle(points[rest[some]], triangles[chosen[near[some, column]]])
                best[rest[some]] = np.minimum(best[rest[some]], found)
            if k == len(chosen):
                break
            rest = rest[apart[:, -1] - reach < best[rest]]
            k = min(4 * k, len(chosen))
    return best


def point_triangle(p: NDArray, t: NDArray) -> NDArray:
    """Return the distances (n,) of points (n, 3) to triangles (n, 3, 3), row by row."""
    best = np.full(len(p), np.inf)
    for k in range(3):
        a, b = t[:, k], t[:, (k + 1) % 3]
        edge = b - a
        length2 = np.einsum("ij,ij->i", edge, edge)
        s = np.clip(np.einsum("ij,ij->i", p - a, edge) / np.where(length2 > 0, length2, 1), 0, 1)
        gap = p - a - s[:, None] * edge
        best = np.minimum(best, np.einsum("ij,ij->i", gap, gap))
    u, v = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    normal, q = np.cross(u, v), p - t[:, 0]
    n2 = np.einsum("ij,ij->i", normal, normal)
    safe = np.where(n2 > 0, n2, 1)
    w1 = np.einsum("ij,ij->i", np.cross(q, v), normal) / safe
    w2 = np.einsum("ij,ij->i", np.cross(u, q), normal) / safe
    inside = (n2 > 0) & (w1 >= 0) & (w2 >= 0) & (w1 + w2 <= 1)
    height2 = np.einsum("ij,ij->i", q, normal) ** 2 / safe
    return np.sqrt(np.where(inside, np.minimum(height2, best), best))


def cells(surface) -> NDArray:
    """Return the corners (c, 4, 3) float64 of all wholly opaque cells, the next along x and then the next row."""
    position = surface.positions()
    patch, i, j = surface.node_patches()
    m, n = surface.size[patch].T.astype(np.int64)
    at = np.flatnonzero((i < m - 1) & (j < n - 1))
    corners = position[np.stack([at, at + 1, at + m[at], at + m[at] + 1], axis=1)]
    return corners[np.isfinite(corners).all(axis=(1, 2))]


def bilinear(corners: NDArray, x, y) -> NDArray:
    """Return the points (c, 3) of cells at (x, y), each a number or (c,)."""
    x, y = np.asarray(x, float)[..., None], np.asarray(y, float)[..., None]
    return ((1 - y) * ((1 - x) * corners[:, 0] + x * corners[:, 1])
            + y * ((1 - x) * corners[:, 2] + x * corners[:, 3]))


def patch_triangles(surface, parts: int = PARTS) -> NDArray:
    """Return the bilinear cells as triangles (t, 3, 3) float64."""
    corners = cells(surface)
    steps = np.arange(parts + 1) / parts
    grid = {(x, y): bilinear(corners, x, y) for x in steps for y in steps}
    out = []
    for x0, x1 in itertools.pairwise(steps):
        for y0, y1 in itertools.pairwise(steps):
            a, b, c, d = grid[x0, y0], grid[x1, y0], grid[x0, y1], grid[x1, y1]
            out += [np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]
    return np.concatenate(out)


def quality(surface, mesh, samples: int = SAMPLES, parts: int = PARTS) -> dict[str, float]:
    """Return distances between a surface and its mesh in % of the diagonal of the mesh's box.

    Returns
    -------
    dict
        ``rms`` (both ways: of all samples of either side, equally weighted), ``rms_surface`` (nodes and points within
        cells to the mesh), ``rms_mesh`` (points spread by area to the patches), ``max_vertices`` (the farthest original
        vertex), ``max_surface``, and ``patches``, ``nodes``, ``megabytes``.
    """
    generator = np.random.default_rng(1)
    vertices = mesh.vertices.astype(np.float64) + mesh.origin
    diagonal = np.linalg.norm(np.ptp(mesh.bounds, axis=0))
    triangles = vertices[mesh.faces]
    corners = cells(surface)
    chosen = corners[generator.integers(0, len(corners), samples // 2)]
    nodes = surface.positions()
    nodes = nodes[np.isfinite(nodes[:, 0])]
    of_surface = np.concatenate([nodes[generator.integers(0, len(nodes), samples // 2)],
                                 bilinear(chosen, generator.random(len(chosen)), generator.random(len(chosen)))])
    to_mesh = triangle_distances(of_surface, triangles)
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    face = np.searchsorted(np.cumsum(area), generator.random(samples) * area.sum()).clip(max=len(area) - 1)
    r, s = np.sqrt(generator.random(samples)), generator.random(samples)
    weights = np.stack([1 - r, r * (1 - s), r * s], axis=1)
    of_mesh = np.concatenate([(weights[:, :, None] * triangles[face]).sum(axis=1), vertices])
    to_patches = triangle_distances(of_mesh, patch_triangles(surface, parts))
    percent, rms = 100 / diagonal, lambda d: float(np.sqrt(np.mean(d ** 2)))
    there, back, at_vertices = to_mesh * percent, to_patches[:samples] * percent, to_patches[samples:] * percent
    both = float(np.sqrt((rms(there) ** 2 + rms(back) ** 2) / 2))
    return {"rms": both, "rms_surface": rms(there), "rms_mesh": rms(back),
            "max_vertices": float(at_vertices.max()), "max_surface": float(there.max()), "patches": len(surface),
            "nodes": surface.node_count, "megabytes": surface.nbytes / 1e6}
