"""A meteoroid: a bumpy rock with craters and rough ground, from a seed."""

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface.arrays import lengths_of
from ..surface.mesh import Mesh
from .lattice import GOLDEN

LUMPS = ((0.35, 0.15), (0.8, 0.07), (1.8, 0.028))  # cycles a radius and height over the radius, of the shape
ROUGH = ((5.0, 0.008), (11.0, 0.004), (24.0, 0.0018), (52.0, 0.0008))  # of the ground
WAVES = 24  # directions that every size of relief is a sum over


def meteoroid(seed: int = 0, faces: int = 320_000, craters: int = 60, radius: float = 1.0) -> Mesh:
    """Return a rock about the origin with relief of many sizes: lumps, craters with rims, rough ground.

    The same seed gives the same rock, whatever `faces` it is sampled at.

    Parameters
    ----------
    seed : int
    faces : int
        About as many triangles: an icosahedron whose edges are cut into equal parts.
    craters : int
        Their sizes are spread as those on the moon: few large ones, many small ones.
    radius : float
        World units, on average.

    Returns
    -------
    Mesh
        Closed, with normals.
    """
    if not isinstance(faces, int | np.integer) or not 20 <= faces <= 50_000_000:
        raise InputError(f"faces: expected a whole number from 20 to 50,000,000, got {faces!r}")
    if not isinstance(craters, int | np.integer) or craters < 0:
        raise InputError(f"craters: expected a whole number of at least 0, got {craters!r}")
    if not isinstance(radius, int | float | np.number) or not 0 < radius < np.inf:
        raise InputError(f"radius: expected a positive length, got {radius!r}")
    random = np.random.default_rng(seed)
    directions, triangles = icosphere(max(1, round(np.sqrt(faces / 20))))
    height = np.ones(len(directions))
    for frequency, amount in LUMPS:
        height += amount * relief(directions, frequency, random)
    height += crater_field(directions, craters, random)
    for frequency, amount in ROUGH:
        height += amount * relief(directions, frequency, random)
    # Stretched a little: no rock is round.
    points = radius * height[:, None] * directions * random.uniform(0.8, 1.15, 3)
    from ..build.slim import face_normals
    normals = face_normals(points.astype(np.float32), triangles)
    return Mesh(points.astype(np.float32), triangles, normals, origin=np.zeros(3))


def relief(directions: NDArray, frequency: float, random) -> NDArray:
    """Return smooth noise (n,) of about unit range: waves in random directions, folded so that ridges are sharp."""
    out = np.zeros(len(directions))
    for _ in range(WAVES):
        wave = random.normal(size=3)
        phase = frequency * np.pi * (directions @ wave) + random.uniform(0, 2 * np.pi)
        out += np.sin(phase)
    out /= np.sqrt(WAVES / 2)
    return 0.6 * out + 0.4 * (1 - 2 * np.abs(np.tanh(out)))


def crater_field(directions: NDArray, count: int, random) -> NDArray:
    """Return heights (n,) over the radius: bowls with raised rims; later ones cut into earlier ones."""
    out = np.zeros(len(directions))
    for size in 0.45 * random.uniform(0.02, 1, count) ** 1.6 + 0.03:
        middle = random.normal(size=3)
        middle /= np.linalg.norm(middle)
        near = np.flatnonzero(directions @ middle > np.cos(min(2.2 * size, np.pi)))
        t = np.arccos(np.clip(directions[near] @ middle, -1, 1)) / size
        bowl = np.where(t < 1, t * t - 1, 0) + 0.28 * np.exp(-((t - 1) / 0.22) ** 2)
        keep = np.clip((t - 0.7) / 0.6, 0, 1)  # inside, what was there before is gone
        out[near] = out[near] * keep + 0.28 * size * bowl
    return out


def icosphere(parts: int) -> tuple[NDArray, NDArray]:
    """Return unit vertices (v, 3) float64 and triangles (20 parts^2, 3) int32 of an icosahedron with cut edges."""
    phi = 1 + GOLDEN
    a, b = np.array([[-1, phi], [1, phi], [-1, -phi], [1, -phi]]).T, np.zeros(4)
    corners = np.concatenate([np.stack([a[0], a[1], b], 1), np.stack([b, a[0], a[1]], 1), np.stack([a[1], b, a[0]], 1)])
    first = np.array([[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2],
                      [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5],
                      [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]])
    i, j = (t.ravel() for t in np.meshgrid(np.arange(parts + 1), np.arange(parts + 1), indexing="ij"))
    i, j = i[i + j <= parts], j[i + j <= parts]
    number = np.full((parts + 1, parts + 1), -1)
    number[i, j] = np.arange(len(i))
    up, down = i + j < parts, i + j < parts - 1
    small = np.concatenate([
        np.stack([number[i[up], j[up]], number[i[up] + 1, j[up]], number[i[up], j[up] + 1]], axis=1),
        np.stack([number[i[down] + 1, j[down]], number[i[down] + 1, j[down] + 1], number[i[down], j[down] + 1]],
                 axis=1)])
    weights = np.stack([parts - i - j, i, j], axis=1) / parts
    points = np.einsum("pc,fcd->fpd", weights, corners[first]).reshape(-1, 3)
    points /= lengths_of(points, keepdims=True)
    triangles = (small + len(i) * np.arange(20)[:, None, None]).reshape(-1, 3)
    # Vertices on the edges of the icosahedron are named once.
    _, keep, names = np.unique(np.round(points * 2**20).astype(np.int64), axis=0, return_index=True,
                               return_inverse=True)
    return points[keep], names.ravel()[triangles].astype(np.int32)
