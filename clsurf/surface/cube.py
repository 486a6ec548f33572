"""The cube that directions are mapped to, and interpolation across its edges. Kernels: kernels/common/cube.clh.

A direction d falls on the face of its largest component; there d ~ axis + a s + b t with a, b from -1 to 1. Faces come
in the order +X -X +Y -Y +Z -Z in OpenGL's orientation: columns of texels run along s, rows along t, texel (row i,
column j) has its centre at a = (2 j + 1) / size - 1, b = (2 i + 1) / size - 1.

Between texel centres values are interpolated on one closed net: the centres, joined to squares within each face,
across each edge to the opposite texel of the neighbouring face, and at each corner to a triangle, whose middle has the
mean of its three values. Every face keeps, as border, what it shares with the others (`border_index`). In the outer
half texel of a face the net's lines are not those of the texels' grid: a line from a texel to its partner on the next
face is straight between the two directions, and fans out (`net_coordinates`). That makes the interpolation continuous
over all edges, and its error of second order there too, where clamping or copying neighbours leaves first order.
"""

import functools

import numpy as np
from numpy.typing import NDArray

from .arrays import lengths_of

# (6, 3, 3): axis, s, t of each face.
FACES = np.array([[[1, 0, 0], [0, 0, -1], [0, -1, 0]], [[-1, 0, 0], [0, 0, 1], [0, -1, 0]],
                  [[0, 1, 0], [1, 0, 0], [0, 0, 1]], [[0, -1, 0], [1, 0, 0], [0, 0, -1]],
                  [[0, 0, 1], [1, 0, 0], [0, -1, 0]], [[0, 0, -1], [-1, 0, 0], [0, -1, 0]]], np.float64)
FACES.flags.writeable = False


@functools.lru_cache(maxsize=8)
def texel_directions(size: int) -> NDArray:
    """Return the unit directions (6, size, size, 3) float64 of all texels."""
    d = _directions((2 * np.arange(size) + 1) / size - 1)
    d.flags.writeable = False
    return d


@functools.lru_cache(maxsize=8)
def texel_angles(size: int) -> NDArray:
    """Return each texel's share (size, size) of the sphere's solid angle; six times their sum is 1."""
    edge = 2 * np.arange(size + 1) / size - 1
    a, b = edge[None], edge[:, None]
    area = np.arctan2(a * b, np.sqrt(a * a + b * b + 1))
    out = (area[1:, 1:] - area[1:, :-1] - area[:-1, 1:] + area[:-1, :-1]) / (4 * np.pi)
    out.flags.writeable = False
    return out


@functools.lru_cache(maxsize=8)
def border_directions(size: int) -> NDArray:
    """Return the directions (6, size + 2, size + 2, 3) of all texels, and of the border's partners, unit."""
    index = border_index(size)
    d = texel_directions(size).reshape(-1, 3)[np.maximum(index, 0)]
    for f in range(6):
        for i in (0, -1):
            for j in (0, -1):
                a, b = (-1.0 if j == 0 else 1.0), (-1.0 if i == 0 else 1.0)
                d[f, i, j] = (FACES[f, 0] + a * FACES[f, 1] + b * FACES[f, 2]) / np.sqrt(3)
    d.flags.writeable = False
    return d


@functools.lru_cache(maxsize=8)
def border_index(size: int) -> NDArray:
    """Return the texels (6, size + 2, size + 2) int64 of all faces with a border of one, as indices into (6 size size).

    The border holds each edge texel's partner on the neighbouring face; -1 in the corners (see `bordered`).
    """
    along = (2 * np.arange(size) + 1) / size - 1
    out = np.full((6, size + 2, size + 2), -1, np.int64)
    out[:, 1:-1, 1:-1] = np.arange(6 * size * size).reshape(6, size, size)
    inner = 1 - 1 / size
    for f, (axis, s, t) in enumerate(FACES):
        for side, at in ((-1.0, 0), (1.0, size + 1)):
            # The partner of a texel has the components along the axis and across the edge exchanged.
            column = inner * axis + side * s + along[:, None] * t
            row = inner * axis + side * t + along[:, None] * s
            out[f, 1:-1, at], out[f, at, 1:-1] = _texel_of(column, size), _texel_of(row, size)
    out.flags.writeable = False
    return out


def bordered(values: NDArray, valid: NDArray, size: int) -> tuple[NDArray, NDArray]:
    """Return values (6, size, size, ...) float and their validity (6, size, size) with the border of `border_index`.

    The border's corners are the means of the three texels that meet there, holes left out.
    """
    index = border_index(size)
    flat, known = values.reshape(6 * size * size, *values.shape[3:]), valid.reshape(-1)
    out, ok = flat[np.maximum(index, 0)], known[np.maximum(index, 0)]
    for i, inner_i in ((0, 1), (-1, -2)):
        for j, inner_j in ((0, 1), (-1, -2)):
            three = np.stack([out[:, inner_i, inner_j], out[:, i, inner_j], out[:, inner_i, j]])
            use = np.stack([ok[:, inner_i, inner_j], ok[:, i, inner_j], ok[:, inner_i, j]])
            weight = use.reshape(*use.shape, *[1] * (three.ndim - 2)).astype(three.dtype)
            out[:, i, j] = (np.where(weight > 0, three, 0)).sum(axis=0) / np.maximum(weight.sum(axis=0), 1)
            ok[:, i, j] = use.any(axis=0)
    return out, ok


def face_coordinates(directions: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return face (n,) int64 and coordinates a, b (n,) from -1 to 1 of directions (n, 3), not zero."""
    d = np.asarray(directions, np.float64)
    axis = np.abs(d).argmax(axis=1)
    face = 2 * axis + (np.take_along_axis(d, axis[:, None], 1)[:, 0] < 0)
    w = np.abs(np.take_along_axis(d, axis[:, None], 1)[:, 0])
    a, b = ((d * FACES[face, k]).sum(axis=1) / w for k in (1, 2))
    return face, a, b


def net_coordinates(a: NDArray, b: NDArray, size: int) -> tuple[NDArray, NDArray]:
    """Return where a point of a face lies on the net, x and y in texels from the first centre: -1/2 to size - 1/2."""
    h = 1 / size
    fan = (h / 2) / (1 - h / 2)  # of a line's distance from the middle, at the edge
    p, q = np.maximum(np.abs(a) - (1 - h), 0) / h, np.maximum(np.abs(b) - (1 - h), 0) / h
    x, y = np.abs(a) / (1 + fan * q), np.abs(b) / (1 + fan * p)  # the lines that points across an edge lie on
    # Across both edges: the kite between texel, two edges' middles and the cube's corner, as a square.
    corner = (x > 1 - h) & (y > 1 - h)
    x, y = np.where((p > 0) & (y <= 1 - h), np.abs(a), x), np.where((q > 0) & (x <= 1 - h), np.abs(b), y)
    c = (1 - h) * fan / h
    sums, difference = p + q, (p - q) / (1 - c)
    with np.errstate(invalid="ignore"):
        root = (1 + c) ** 2 - 2 * c * (sums - c * difference**2 / 2)
        both = ((1 + c) - np.sqrt(np.maximum(root, 0))) / max(c, 1e-30)
    kite_x, kite_y = (np.clip((both + sign * difference) / 2, 0, 1) for sign in (1, -1))
    if size == 1:  # c is 0: the kite is the square
        kite_x, kite_y = p, q
    x = np.where(corner, 1 - h + h * kite_x, x)
    y = np.where(corner, 1 - h + h * kite_y, y)
    return (np.copysign(x, a) + 1) * size / 2 - 0.5, (np.copysign(y, b) + 1) * size / 2 - 0.5


def interpolated(values: NDArray, valid: NDArray, directions: NDArray) -> tuple[NDArray, NDArray]:
    """Return values (n, ...) float64 on the net in directions (n, 3), and whether there is one, (n,) bool.

    Parameters
    ----------
    values : (6, size, size, ...) float
    valid : (6, size, size) bool
        Holes take no part; where they have more than half of the weight, there is a hole.
    """
    size = values.shape[1]
    values, valid = bordered(values, valid, size)
    face, a, b = face_coordinates(directions)
    x, y = net_coordinates(a, b, size)
    x, y = x + 1, y + 1  # in the border's count
    j, i = (np.clip(np.floor(v).astype(np.int64), 0, size) for v in (x, y))
    x, y = x - j, y - i
    total, weight = 0.0, np.zeros(len(x))
    for di, dj, w in ((0, 0, (1 - x) * (1 - y)), (0, 1, x * (1 - y)), (1, 0, (1 - x) * y), (1, 1, x * y)):
        w = w * valid[face, i + di, j + dj]
        w_values = w.reshape(-1, *[1] * (values.ndim - 3))
        total = total + np.where(w_values > 0, values[face, i + di, j + dj], 0) * w_values
        weight += w
    return total / np.maximum(weight, 1e-30).reshape(-1, *[1] * (values.ndim - 3)), weight >= 0.5


def _directions(along: NDArray) -> NDArray:
    d = (FACES[:, None, None, 0] + along[None, None, :, None] * FACES[:, None, None, 1]
         + along[None, :, None, None] * FACES[:, None, None, 2])
    return d / lengths_of(d, keepdims=True)


def _texel_of(directions: NDArray, size: int) -> NDArray:
    face, a, b = face_coordinates(directions)
    column, row = (np.clip(((v + 1) * size / 2).astype(np.int64), 0, size - 1) for v in (a, b))
    return (face * size + row) * size + column
