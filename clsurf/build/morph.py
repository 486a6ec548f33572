"""Between shapes: scale maps blended direction by direction.

Source: Reiter, "Spherical Scale Mapping", 2005, sections 1 and 3: models with different vertices and faces have a
bounding sphere in common, and blending two scale maps is interpolating between two models.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..device import open_device
from ..errors import InputError
from ..surface.arrays import lengths_of
from ..surface.cube import bordered, interpolated, texel_directions
from ..surface.placed import Placed
from ..surface.scale_map import ScaleMap, encoded, encoded_normals
from .scale_map import build_scale_map

STEEPEST = 0.05  # least cosine between normal and ray that a blend of normals takes


def morph(a, b=None, t: float | None = None, bits: int | None = None, device=None) -> ScaleMap:
    """Return the shape between two models, or among several.

    ``morph(a, b, t)`` is `a` at t = 0 and `b` at t = 1; ``morph([(model, weight), ...])`` takes any number of models
    and their weights, which are divided by their sum. In every direction from the centre the distances of the models
    from their own centres are averaged by weight, in world units; so are the centres.

    Parameters
    ----------
    a, b : ScaleMap, Mesh or another surface
        What is no scale map is built as one with `build_scale_map`'s defaults. Of several layers the first counts.
        Placed scale maps may be moved and scaled, not turned.
    t : float
        0 to 1.
    bits : int, optional
        8, 16 or 32; by default the most that any model has.
    device : None, str or Device

    Returns
    -------
    ScaleMap
        With the largest size among the models. A direction is a hole where models with more than half of the weight
        have one; in its holes a model goes on as at their rims. Where all models have normals the result has those of
        the blended shape: with the normals n of the models of distance r in direction d, n r / (n.d) adds up by weight.

    Raises
    ------
    InputError
        Weights that are negative or all zero, a t outside 0 to 1, or something that cannot be built.
    """
    models, weights = _request(a, b, t)
    return blend(prepared(models, device), weights, bits)


def morph_frames(a, b, count: int, ease: bool = False, device=None) -> Iterator[ScaleMap]:
    """Yield `count` shapes from `a` to `b`, at least 2; with `ease` slower at both ends.

    The models are built and brought to one size once.
    """
    if not isinstance(count, int | np.integer) or count < 2:
        raise InputError(f"frames: expected a whole number of at least 2, got {count!r}")
    parts = prepared([a, b], device)
    for k in range(count):
        t = k / (count - 1)
        t = t * t * (3 - 2 * t) if ease else t
        yield blend(parts, np.array([1 - t, t]))


def prepared(models, device=None) -> list[dict]:
    """Return the models as arrays of one size: what `blend` takes."""
    device = open_device(device)
    maps = [_as_map(model, device) for model in models]
    size = max(surface.size for surface, _, _ in maps)
    return [_resampled(surface, scale, center, size) for surface, scale, center in maps]


def blend(parts: list[dict], weights: NDArray, bits: int | None = None) -> ScaleMap:
    """Return the map among the models of `prepared`, by weights that add up to 1."""
    weights = np.asarray(weights, np.float64)
    known = sum(w * p["valid"] for w, p in zip(weights, parts, strict=True))
    valid = known >= 0.5 - 1e-9
    distance = sum(w * p["distance"] for w, p in zip(weights, parts, strict=True))
    radius = float(weights @ [p["radius"] for p in parts])
    normals = None
    if all(p["normals"] is not None for p in parts):
        d = texel_directions(distance.shape[-1])
        normals = 0.0
        for w, p in zip(weights, parts, strict=True):
            along = np.maximum((p["normals"] * d).sum(axis=-1, keepdims=True), STEEPEST)
            normals = normals + w * p["distance"][..., None] * p["normals"] / along
        normals = encoded_normals(normals / np.maximum(lengths_of(normals, keepdims=True), 1e-12))
    lambdas = np.where(valid, np.minimum(distance / radius, 1), 0)
    used = [p for w, p in zip(weights, parts, strict=True) if w > 0]
    bits = max(p["bits"] for p in used) if bits is None else bits
    return ScaleMap(sum(w * p["center"] for w, p in zip(weights, parts, strict=True)), radius,
                    encoded(lambdas, bits)[None], valid[None], normals,
                    used[0]["hit"], float(weights @ [p["share"] for p in parts]),
                    float(weights @ [p["diagonal"] for p in parts]))


def _request(a, b, t) -> tuple[list, NDArray]:
    if b is None and isinstance(a, list | tuple):
        try:
            models, weights = [model for model, _ in a], np.array([float(w) for _, w in a])
        except (TypeError, ValueError):
            raise InputError("morph: expected (model, weight) pairs, or two models and t") from None
        if not len(models) or not np.isfinite(weights).all() or (weights < 0).any() or not weights.sum() > 0:
            raise InputError(f"morph: expected weights of at least 0 that are not all 0, got {weights.tolist()}")
        return models, weights / weights.sum()
    if b is None or t is None:
        raise InputError("morph: expected two models and t, or a list of (model, weight)")
    if not isinstance(t, int | float | np.number) or not 0 <= t <= 1:
        raise InputError(f"t: expected a number from 0 to 1, got {t!r}")
    return [a, b], np.array([1.0 - t, float(t)])


def _as_map(model, device) -> tuple[ScaleMap, float, NDArray]:
    """Return a model as a scale map, its scale and its centre in the world."""
    if isinstance(model, Placed) and isinstance(model.surface, ScaleMap):
        matrix, scale = model.matrix, model.scale
        if not np.allclose(matrix[:3, :3], scale * np.eye(3), atol=1e-9 * scale):
            raise InputError("morph: expected scale maps that are moved and scaled only, got a turned one: build the "
                             "map from the turned model")
        return model.surface, scale, matrix[:3, :3] @ model.surface.center + matrix[:3, 3]
    if not isinstance(model, ScaleMap):
        model = build_scale_map(model, device=device)
    return model, 1.0, model.center


def _resampled(surface: ScaleMap, scale: float, center: NDArray, size: int) -> dict:
    """Return layer 0 at size x size texels a face; lengths in world units."""
    valid, values = surface.valid[0], np.nan_to_num(surface.lambdas[0].astype(np.float64))
    normals = surface.unit_normals()
    normals = None if normals is None else normals[0].astype(np.float64)
    if size != surface.size:
        d = texel_directions(size).reshape(-1, 3)
        if normals is not None:
            normals = interpolated(normals, valid, d)[0].reshape(6, size, size, 3)
            normals /= np.maximum(lengths_of(normals, keepdims=True), 1e-12)
        values, known = interpolated(values, valid, d)
        values, valid = values.reshape(6, size, size), known.reshape(6, size, size)
    if not valid.all() and valid.any():
        values = _without_holes(values, valid)
        if normals is not None:
            normals = _without_holes(normals, valid)
            normals /= np.maximum(lengths_of(normals, keepdims=True), 1e-12)
    share = surface.multiple_share
    return {"center": center, "radius": scale * surface.radius, "distance": scale * surface.radius * values,
            "valid": valid, "normals": normals, "bits": surface.bits, "hit": surface.hit,
            "share": 0.0 if np.isnan(share) else share, "diagonal": scale * surface.diagonal}


def _without_holes(values: NDArray, valid: NDArray) -> NDArray:
    """Return values (6, s, s, ...) that go on from the rims of the holes inward, the mean of the texels around each."""
    values, known, size = np.array(values), valid.copy(), valid.shape[-1]
    while not known.all():
        around, ok = bordered(values, known, size)
        total, count = np.zeros_like(values), np.zeros((*known.shape, *[1] * (values.ndim - 3)), int)
        for i, j in ((0, 1), (2, 1), (1, 0), (1, 2)):
            part = np.s_[:, i:i + size, j:j + size]
            use = ok[part].reshape(*ok[part].shape, *[1] * (values.ndim - 3))
            total, count = total + np.where(use, around[part], 0), count + use
        rim = ~known & (count.reshape(known.shape) > 0)
        values[rim] = (total / np.maximum(count, 1))[rim]
        known |= rim
    return values
