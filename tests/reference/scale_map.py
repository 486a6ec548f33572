"""Plain float64 twins of the kernels of scale maps: every ray against every triangle, every node by itself."""

import numpy as np

from clsurf.surface.cube import interpolated, texel_directions
from clsurf.surface.slim import frame_of_normals

from .trace_rays import ray_triangles, unit


def scale_hits(vertices, faces, size):
    """Lists of (distance, triangle) of every texel, in the texels' order, for vertices relative to the centre."""
    found = []
    for direction in texel_directions(size).reshape(-1, 3):
        t, triangle = ray_triangles(vertices, faces, np.zeros(3), direction)
        found.append(sorted(zip(t.tolist(), triangle.tolist(), strict=True)))
    return found


def pick_scale_hits(lists, layers, outermost):
    """Distances and triangles (layers, texels), NaN and -1 for holes, of sorted lists."""
    distance, triangle = np.full((layers, len(lists)), np.nan), np.full((layers, len(lists)), -1)
    for texel, hits in enumerate(lists):
        for k, (t, number) in enumerate((hits[::-1] if outermost else hits)[:layers]):
            distance[k, texel], triangle[k, texel] = t, number
    return distance, triangle


def icosphere(level):
    """Vertices (n, 3) on the unit sphere and faces, counter-clockwise from outside, of a subdivided icosahedron."""
    g = (1 + 5**0.5) / 2
    v = unit(np.array([[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g], [0, -1, -g], [0, 1, -g],
                       [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]], float))
    f = np.array([[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2],
                  [10, 7, 6],
                  [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10],
                  [8, 6, 7], [9, 8, 1]])
    for _ in range(level):
        edges = np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        once, at = np.unique(edges, axis=0, return_inverse=True)
        a, b, c = len(v) + at.reshape(-1, 3).T
        v = np.concatenate([v, unit(v[once].sum(axis=1))])
        parts = (f[:, 0], a, c), (f[:, 1], b, a), (f[:, 2], c, b), (a, b, c)
        f = np.concatenate([np.stack(x, axis=1) for x in parts])
    return v, f


def sphere_distance(directions, center, radius=1.0):
    """Distance from zero, inside, to a sphere in unit directions (..., 3)."""
    b = directions @ np.asarray(center, float)
    return b + np.sqrt(b * b - np.dot(center, center) + radius**2)


def ellipsoid_distance(directions, axes):
    """Distance from zero to the ellipsoid about it."""
    return 1 / np.linalg.norm(directions / np.asarray(axes, float), axis=-1)


def filtered(surface, directions, layer=0):
    """Lambda (n,) of a map in directions (n, 3), NaN in holes."""
    value, known = interpolated(np.nan_to_num(surface.lambdas[layer].astype(float)), surface.valid[layer], directions)
    return np.where(known, value, np.nan)


def smooth_map(size, center=(0.0, 0, 0), bits=32, layers=1, normals=None, f=None, **more):
    """A map of the exact distances f(directions), by default of the unit sphere about `center`, seen from zero."""
    from clsurf.surface.scale_map import ScaleMap, encoded
    d = texel_directions(size)
    values = sphere_distance(d, center) if f is None else f(d)
    radius = float(values.max())
    values = np.broadcast_to(values / radius, (layers, 6, size, size))
    return ScaleMap((0, 0, 0), radius, encoded(values, bits), np.ones(values.shape, bool), normals, **more)


def net_mesh(surface, layer=0):
    """The closed net of texels as vertices (n, 3), radii, and triangles, cells with holes left out."""
    from clsurf.surface.cube import border_directions, bordered
    size = surface.size
    value, valid = bordered(np.nan_to_num(surface.lambdas[layer].astype(float)), surface.valid[layer], size)
    points = (value[..., None] * border_directions(size)).reshape(-1, 3)
    at = np.arange(6 * (size + 2) ** 2).reshape(6, size + 2, size + 2)
    a, b, c, d = at[:, :-1, :-1], at[:, :-1, 1:], at[:, 1:, :-1], at[:, 1:, 1:]
    whole = valid[:, :-1, :-1] & valid[:, :-1, 1:] & valid[:, 1:, :-1] & valid[:, 1:, 1:]
    a, b, c, d = (x[whole] for x in (a, b, c, d))
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([d, c, b], 1)])


def scale_normals(surface, gradient=True, epsilon=None):
    """Normals (6, s, s, 3) from numerical derivatives of the interpolated map, as the kernel defines them."""
    size = surface.size
    d = texel_directions(size).reshape(-1, 3)
    u, v = frame_of_normals(d)
    e = 2 / size if epsilon is None else epsilon
    p = []
    for step in (u, -u, v, -v):
        q = d + e * step
        p.append(filtered(surface, q)[:, None] * unit(q))
    return unit(np.cross(p[0] - p[1], p[2] - p[3])).reshape(6, size, size, 3)


def ray_scale_map(surface, origin, direction, samples=20000):
    """Distances of one ray's hits, ascending: changes of sign of |p| - R lambda(p) at many points, then bisection."""
    d = unit(direction)
    reach = surface.radius * 1.01
    o = np.asarray(origin, float) - surface.center
    b = o @ d
    disc = b * b - o @ o + reach**2
    if disc <= 0:
        return np.zeros(0)
    t = np.linspace(max(-b - np.sqrt(disc), 0), -b + np.sqrt(disc), samples)

    def outside(t):
        p = o + np.asarray(t)[:, None] * d
        return np.linalg.norm(p, axis=1) - surface.radius * filtered(surface, p)

    f = outside(t)
    at = np.flatnonzero((f[:-1] > 0) != (f[1:] > 0))
    low, high = t[at], t[at + 1]
    for _ in range(40):
        if not len(at):
            break
        middle = (low + high) / 2
        same = (outside(middle) > 0) == (f[at] > 0)
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return (low + high) / 2
