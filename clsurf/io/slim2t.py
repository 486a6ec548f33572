"""SLIM trees of other programs (.slim2t): balls with a general polynomial each, in a tree.

Layout, little-endian: int32 degree (negative: unoriented), int32 balls, int32 user values a ball; then for each ball
float32 centre (3), coefficients in x, y, z relative to the centre, radius, parent (1-based, -1: none), user values, of
which the first is the error. The order of the coefficients is cubic xxx yyy zzz xxy yyz zzx xyy yzz zxx xyz, quadratic
xx yy zz xy yz zx, linear x y z, and 1. The radius is that of the shrunken ball of the first rendering pass
(paper, section 3): 0.8 of the full one, as kernels/render/tile_slim.cl has it.
"""

import dataclasses
import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import FileFormatError, InputError
from clsurf.surface.slim import COEFFICIENTS, SlimSurface, frame_of_normals

from ..surface.arrays import lengths_of
from .files import existing_file, replacing, write_array

log = logging.getLogger("clsurf")

# Radius of the first pass over the radius of the ball (paper, section 3). That of kernels/render/tile_slim.cl, so that
# discs are drawn as large as the file has them: with the paper's 2/3 they overran pai's silhouettes by 2,600 px a view
# of 1024 x 1024 (1.4 % of its picture), with 2 instead of 3 px of holes.
ALPHA = 0.8
_POWERS = {1: "x y z 1", 2: "xx yy zz xy yz zx x y z 1",
           3: "xxx yyy zzz xxy yyz zzx xyy yzz zxx xyz xx yy zz xy yz zx x y z 1"}
_ANNIHILATED = 1e-5  # share of the curvature along an axis that float32 coefficients leave of an exact zero
_BLOCK = 2048  # balls converted at once: pai in 0.43 s, in one go 0.53 s


def load_slim2t(path) -> SlimSurface:
    """Read a .slim2t file; the error of each ball becomes its `fit_error`, the tree its links.

    A polynomial that is linear along some direction (all those that clsurf writes, and planes) is converted exactly;
    others are fitted to their zero set over the shrunken ball.

    Raises
    ------
    InputError
        No such file.
    FileFormatError
        Truncated, or not such a file.
    """
    path = existing_file(path)
    size = path.stat().st_size
    head = np.fromfile(path, "<i4", 3)
    if len(head) < 3 or abs(int(head[0])) not in COEFFICIENTS or head[1] < 1 or not 0 <= head[2] <= 1024:
        raise FileFormatError(f"{path}: not a .slim2t file: expected degree, balls and user values, "
                              f"got {head.tolist()}")
    degree, count, users = abs(int(head[0])), int(head[1]), int(head[2])
    monomials = len(_POWERS[degree].split())
    width = 5 + monomials + users
    if size != 12 + 4 * width * count:
        raise FileFormatError(f"{path}: truncated or damaged: {count:,} balls of {width} floats need "
                              f"{12 + 4 * width * count:,} bytes, got {size:,}")
    rows = np.fromfile(path, "<f4", offset=12).reshape(count, width)
    if not np.isfinite(rows).all() or (rows[:, 3 + monomials] <= 0).any():
        raise FileFormatError(f"{path}: damaged: numbers that are not finite, or radii that are not positive")
    parent = _parents(path, rows[:, 4 + monomials])
    level = _levels(path, parent)
    order = np.argsort(level, kind="stable")
    place = np.empty(count, np.int64)
    place[order] = np.arange(count)
    rows, parent, level = rows[order], np.where(parent[order] < 0, -1, place[parent[order]]), level[order]
    inner = parent >= 0
    children = np.flatnonzero(inner)[np.argsort(parent[inner], kind="stable")]
    child_offset = np.append(0, np.cumsum(np.bincount(parent[inner], minlength=count)))
    shrunken = rows[:, 3 + monomials].astype(np.float64)
    with np.errstate(all="ignore"):
        parts = [_height_forms(rows[at:at + _BLOCK, 3:3 + monomials].astype(np.float64), shrunken[at:at + _BLOCK],
                               degree) for at in range(0, count, _BLOCK)]
        normals, coefficients = (np.concatenate(part).astype(np.float32) for part in zip(*parts, strict=True))
    if not (np.isfinite(normals).all() and np.isfinite(coefficients).all()):
        raise FileFormatError(f"{path}: damaged: polynomials that overflow float32")
    centers, leaf = rows[:, :3].copy(), np.diff(child_offset) == 0
    box = centers[leaf]
    return SlimSurface(
        degree=degree, error=float("nan"), centers=centers, radii=shrunken / ALPHA, normals=normals,
        coefficients=coefficients, level=level, leaf=leaf, child_offset=child_offset, children=children,
        fit_error=rows[:, 5 + monomials] if users else np.zeros(count), oriented=bool(head[0] > 0),
        diagonal=float(np.linalg.norm(box.max(axis=0).astype(np.float64) - box.min(axis=0))) or 1.0)


def save_slim2t(surface: SlimSurface, path) -> None:
    """Write a .slim2t file: the surfels, each linked to one of its parents, its fit error as the user value.

    The format holds neither colours nor footprints nor a float64 origin; centres are float32 world positions.

    Raises
    ------
    InputError
        More than 2^24 surfels (parents are float32), or a place that cannot be written.
    """
    if not 0 < len(surface) <= 2**24:
        raise InputError(f"{path}: .slim2t holds 1 to {2**24:,} surfels, got {len(surface):,}")
    lost = [name for name in ("colors", "footprint") if getattr(surface, name) is not None]
    surface, parent = _as_tree(surface)
    count = len(surface)
    monomials = _POWERS[surface.degree].split()
    rows = np.empty((count, 6 + len(monomials)), "<f4")
    rows[:, :3] = surface.centers + surface.origin
    rows[:, 3:3 + len(monomials)] = _general_forms(surface, monomials)
    rows[:, 3 + len(monomials)] = surface.radii * ALPHA
    rows[:, 4 + len(monomials)] = np.where(parent < 0, -1, parent + 1)
    rows[:, 5 + len(monomials)] = surface.fit_error
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(np.array([surface.degree if surface.oriented else -surface.degree, count, 1], "<i4").tobytes())
        write_array(file, rows)
    if lost:
        log.info("%s: .slim2t cannot hold %s", Path(path).name, " and ".join(lost))


def _as_tree(surface: SlimSurface) -> tuple[SlimSurface, NDArray]:
    """Return the surface without its links, and one parent (n,) int64 a surfel, -1 at the roots.

    In a tree a surfel without children is a leaf, so an internal one must keep a child. One that cannot is left out.
    """
    owner = np.repeat(np.arange(len(surface)), np.diff(surface.child_offset))
    parent = np.full(len(surface), -1, np.int64)
    parent[surface.children[::-1]] = owner[::-1]  # the last assignment stays: the first parent
    count = np.bincount(parent[parent >= 0], minlength=len(surface))
    keep = np.ones(len(surface), bool)
    for internal in np.flatnonzero(~surface.leaf)[::-1]:  # children stand behind their parents
        if count[internal]:
            continue
        mine = surface.children[surface.child_offset[internal]:surface.child_offset[internal + 1]]
        spare = mine[keep[mine] & (count[parent[mine]] > 1)]
        keep[internal] = len(spare) > 0
        if len(spare):
            count[parent[spare[0]]] -= 1
            count[internal] = 1
            parent[spare[0]] = internal
        elif parent[internal] >= 0:
            count[parent[internal]] -= 1
    number = np.cumsum(keep) - 1
    kept = {name: getattr(surface, name)[keep]
            for name in ("centers", "radii", "normals", "coefficients", "level", "leaf", "fit_error")}
    bare = dataclasses.replace(surface, **kept, child_offset=np.zeros(keep.sum() + 1, np.int32),
                               children=np.zeros(0, np.int32), footprint=None, colors=None)
    return bare, np.where(parent < 0, -1, number[parent])[keep]


def _parents(path, column: NDArray) -> NDArray:
    count = len(column)
    parent = np.rint(np.clip(column, -2, count + 1)).astype(np.int64)
    bad = (parent != column) | (parent > count) | ((parent < 1) & (parent != -1)) | (parent == np.arange(1, count + 1))
    if bad.any():
        raise FileFormatError(f"{path}: damaged: ball {int(np.flatnonzero(bad)[0]) + 1:,} has the parent "
                              f"{column[bad][0]:g}; expected -1 or 1 to {count:,}")
    return np.where(parent < 0, -1, parent - 1)


def _levels(path, parent: NDArray) -> NDArray:
    """Return the depth of each ball, 1 for roots."""
    level = np.ones(len(parent), np.int64)
    above = parent.copy()
    for _ in range(len(parent) + 1):  # pointer doubling: rounds are the logarithm of the depth
        inner = above >= 0
        if not inner.any():
            return level
        if level.max() > len(parent):
            break
        level = np.where(inner, level + level[above], level)
        above = np.where(inner, above[above], -1)
    raise FileFormatError(f"{path}: damaged: the balls' parents run in a circle")


def _height_forms(q: NDArray, radius: NDArray, degree: int) -> tuple[NDArray, NDArray]:
    """Turn general polynomials F(x, y, z) into height functions.

    Parameters
    ----------
    q : (n, monomials) float64
        Coefficients of F relative to the ball's centre.
    radius : (n,) float64
        Of the shrunken ball.

    Returns
    -------
    normals : (n, 3) float32
    coefficients : (n, 1, 6 or 10) float64
        Of h in the frame of the rounded normals, so that F = 0 where w = h(u, v).
    """
    flat = (q[:, :-4] == 0).all(axis=1)
    if flat.any():
        length = lengths_of(q[:, -4:-1], keepdims=True)
        normals = np.where(length > 0, q[:, -4:-1] / np.maximum(length, 1e-300), (0.0, 0.0, 1.0)).astype(np.float32)
        coefficients = np.zeros((len(q), COEFFICIENTS[degree]))
        coefficients[:, 0] = np.where(length > 0, -q[:, -1:] / np.maximum(length, 1e-300), 0)[:, 0]
        if not flat.all():
            normals[~flat], coefficients[~flat] = _height_forms(q[~flat], radius[~flat], degree)
        return normals, coefficients
    normals = _axes(q, radius, degree).astype(np.float32)
    u, v = frame_of_normals(normals.astype(np.float64))
    w = normals.astype(np.float64)
    s, t, weight = _disc()
    heights, usable = np.zeros((len(q), len(s))), np.ones((len(q), len(s)), bool)
    plane = s[:, None] * (radius[:, None, None] * u[:, None]) + t[:, None] * (radius[:, None, None] * v[:, None])
    for _ in range(6):  # Newton along w; one step is exact where F is linear in w
        p = plane + heights[..., None] * w[:, None]
        slope = np.einsum("nsi,ni->ns", _gradient(q, p, degree), w)
        scale = np.abs(slope).max(axis=1, keepdims=True) + 1e-300
        usable &= slope > 0.05 * scale
        heights -= np.where(usable, _values(q, p, degree) / np.where(usable, slope, 1), 0)
        usable &= np.abs(heights) <= 2 * radius[:, None]
        heights = np.where(usable, heights, 0)
    exact = np.abs(_values(q, plane + heights[..., None] * w[:, None], degree)) <= 1e-6 * scale * radius[:, None]
    weights = np.where(usable & exact, weight, 0)
    basis = np.stack([s**i * t**j for i, j in _exponents(degree)], axis=1)
    normal_matrix = np.einsum("ns,si,sj->nij", weights, basis, basis)
    normal_matrix += 1e-12 * np.eye(basis.shape[1])  # a ball that its surface misses gets zeros, not an error
    right = np.einsum("ns,ns,si->ni", weights, heights / radius[:, None], basis)
    fit = np.linalg.solve(normal_matrix, right[..., None])[..., 0]
    powers = np.array([1 - i - j for i, j in _exponents(degree)])
    return normals, fit * radius[:, None] ** powers


def _axes(q: NDArray, radius: NDArray, degree: int) -> NDArray:
    """Return unit normals (n, 3) float64: the direction along which F is linear, where there is one.

    F = w - h(u, v) has no second and third derivatives along w, so w is where they vanish; in a plane or a cylinder,
    where many directions do, the one nearest to the gradient. Otherwise it is the gradient at the surface.
    """
    p = np.zeros((len(q), 1, 3))
    for _ in range(4):
        gradient = _gradient(q, p, degree)
        step = _values(q, p, degree)[..., None] * gradient
        p = p - step / np.maximum(np.einsum("nsi,nsi->ns", gradient, gradient), 1e-300)[..., None]
        p = np.where(lengths_of(p, keepdims=True) <= radius[:, None, None], p, 0)
    gradient = _gradient(q, p, degree)[:, 0]
    central = _gradient(q, np.zeros((len(q), 1, 3)), degree)[:, 0]
    length = lengths_of(gradient, keepdims=True)
    normals = np.where(length > 0, gradient / np.maximum(length, 1e-300), (0.0, 0.0, 1.0))
    # Central differences of a gradient that is at most quadratic are exact.
    hessians = [_hessian(q, at, degree) for at in (np.zeros(3), *np.eye(3))]
    bending = np.einsum("nij,nik->njk", hessians[0], hessians[0])
    for at in hessians[1:]:
        third = (at - hessians[0]) * radius[:, None, None]
        bending = bending + np.einsum("nij,nik->njk", third, third)
    size, vectors = np.linalg.eigh(bending)
    flat = size <= _ANNIHILATED**2 * size[:, -1:]
    along = np.einsum("nij,ni->nj", vectors, central) * flat  # the gradient's share in the flat directions
    axis = np.einsum("nij,nj->ni", vectors, along)
    length = lengths_of(axis, keepdims=True)
    linear = length > 0.05 * lengths_of(central, keepdims=True)
    return np.where(linear, axis / np.maximum(length, 1e-300), normals)


def _hessian(q: NDArray, at: NDArray, degree: int) -> NDArray:
    steps = np.stack([at + e for e in np.eye(3)] + [at - e for e in np.eye(3)])
    gradient = _gradient(q, np.broadcast_to(steps, (len(q), 6, 3)), degree)
    return (gradient[:, :3] - gradient[:, 3:]) / 2


def _disc() -> tuple[NDArray, NDArray, NDArray]:
    """Return 33 samples s, t of the unit disc and their weights: the centre and four rings of eight."""
    ring = np.repeat((0.3, 0.55, 0.8, 1.0), 8)
    turn = (np.tile(np.arange(8), 4) + 0.5 * np.repeat(np.arange(4) % 2, 8)) * np.pi / 4
    s, t = np.append(0, ring * np.cos(turn)), np.append(0, ring * np.sin(turn))
    return s, t, np.append(0.3, ring * (1 - 0.6 * ring**2))


def _exponents(degree: int) -> list[tuple[int, int]]:
    """Return the exponents of u and v in the order of `SlimSurface.coefficients`; degree 1 has the constant only."""
    return [(total - j, j) for total in range(degree + 1 if degree > 1 else 1) for j in range(total + 1)]


def _monomial(name: str, p: NDArray) -> NDArray:
    value = np.ones(p.shape[:-1])
    for letter in name.replace("1", ""):
        value = value * p[..., "xyz".index(letter)]
    return value


def _values(q: NDArray, p: NDArray, degree: int) -> NDArray:
    """Return F (n, s) at points p (n, s, 3)."""
    return sum(q[:, k, None] * _monomial(name, p) for k, name in enumerate(_POWERS[degree].split()))


def _gradient(q: NDArray, p: NDArray, degree: int) -> NDArray:
    """Return the gradient of F (n, s, 3) at points p (n, s, 3)."""
    out = np.zeros(p.shape)
    for k, name in enumerate(_POWERS[degree].split()):
        for axis, letter in enumerate("xyz"):
            times = name.count(letter)
            if times:
                out[..., axis] += q[:, k, None] * times * _monomial(name.replace(letter, "", 1), p)
    return out


def _general_forms(surface: SlimSurface, monomials: list[str]) -> NDArray:
    """Return F = w - h(u, v) as coefficients (n, monomials) float64 in x, y, z relative to the centre."""
    n = surface.normals.astype(np.float64)
    u, v = frame_of_normals(n)
    c = surface.coefficients.astype(np.float64)
    out = np.zeros((len(surface), len(monomials)))
    place = {"".join(sorted(name)): k for k, name in enumerate(monomials)}
    for axis in range(3):
        out[:, place["xyz"[axis]]] += n[:, axis]
    for k, (i, j) in enumerate(_exponents(surface.degree)):
        product = {"": -c[:, k]}
        for factor in [u] * i + [v] * j:
            longer: dict[str, NDArray] = {}
            for name, value in product.items():
                for axis in range(3):
                    key = "".join(sorted(name + "xyz"[axis]))
                    longer[key] = longer.get(key, 0) + value * factor[:, axis]
            product = longer
        for name, value in product.items():
            out[:, place[name or "1"]] += value
    return out
