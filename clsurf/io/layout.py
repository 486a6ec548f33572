"""Surfaces and scans as named plain arrays: what the .clsurf store keeps, and how it becomes an object again.

A further kind of surface registers with one line in `KINDS`; where its arrays should be stored otherwise than they are
held, with a pair of functions in `_PACKING`.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import InputError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh
from clsurf.surface.patch import PatchSurface
from clsurf.surface.ranges import RangeImage, RangeScan
from clsurf.surface.scale_map import ScaleMap
from clsurf.surface.slim import SlimSurface
from clsurf.surface.surfel import SurfelHierarchy

KINDS = {"slim": SlimSurface, "patches": PatchSurface, "surfels": SurfelHierarchy, "scale_map": ScaleMap, "mesh": Mesh,
         "points": PointCloud, "ranges": RangeScan}


def to_arrays(thing) -> tuple[str, dict[str, NDArray], dict[str, Any]]:
    """Split a surface or scan into its kind, its arrays by name, and its numbers and flags by name.

    Per-point attributes are called ``attributes/NAME``. Fields that are None are left out.

    Raises
    ------
    InputError
        Something else.
    """
    kind = next((kind for kind, cls in KINDS.items() if type(thing) is cls), None)
    if kind is None:
        raise InputError(f"expected a surface or scan ({', '.join(c.__name__ for c in KINDS.values())}), "
                         f"got {type(thing).__name__}")
    if isinstance(thing, RangeScan):
        return kind, *_range_arrays(thing)
    arrays: dict[str, NDArray] = {}
    scalars: dict[str, Any] = {}
    for field in dataclasses.fields(thing):
        value = getattr(thing, field.name)
        if isinstance(value, np.ndarray):
            arrays[field.name] = value
        elif isinstance(value, dict):
            arrays.update({f"{field.name}/{name}": np.asarray(array) for name, array in value.items()
                           if np.asarray(array).dtype.kind in "biuf"})
        elif isinstance(value, float | np.floating):
            # JSON has no NaN and no infinity; None is NaN on the way back.
            scalars[field.name] = float(value) if math.isfinite(value) else None
        elif value is not None:
            scalars[field.name] = value if isinstance(value, str) else \
                bool(value) if isinstance(value, bool | np.bool_) else int(value)
    if kind in _PACKING:
        arrays = _PACKING[kind][0](arrays)
    return kind, arrays, scalars


def from_arrays(kind: str, arrays: dict[str, NDArray], scalars: dict[str, Any]):
    """Make the surface or scan of `to_arrays`; names that this version does not know are ignored.

    Raises
    ------
    KeyError, ValueError, TypeError
        An unknown kind, or arrays that do not fit together.
    """
    cls = KINDS[kind]
    if cls is RangeScan:
        return _range_scan(arrays)
    if kind in _PACKING:
        arrays = _PACKING[kind][1](arrays)
    values: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        if field.name in arrays:
            values[field.name] = arrays[field.name]
        elif field.name in scalars:
            value = scalars[field.name]
            values[field.name] = float("nan") if value is None else value
        elif field.default_factory is dict:
            prefix = field.name + "/"
            values[field.name] = {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)}
    return cls(**values)


def _range_arrays(scan: RangeScan) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Return the arrays of each image under its number, such as 0/depth; names are bytes."""
    arrays = {}
    for k, image in enumerate(scan.images):
        for name in _RANGE_FIELDS:
            if getattr(image, name) is not None:
                arrays[f"{k}/{name}"] = getattr(image, name)
        if image.name:
            arrays[f"{k}/name"] = np.frombuffer(image.name.encode(), np.uint8)
    return arrays, {}


def _range_scan(arrays: dict[str, NDArray]) -> RangeScan:
    images: dict[int, dict] = {}
    for key, array in arrays.items():
        number, _, name = key.partition("/")
        if name in (*_RANGE_FIELDS, "name"):
            images.setdefault(int(number), {})[name] = bytes(array).decode() if name == "name" else array
    return RangeScan([RangeImage(**images[number]) for number in sorted(images)])


_RANGE_FIELDS = ("depth", "intrinsics", "points", "color", "pose", "eye")


def _pack_slim(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    """Replace the normals by two floats and a code each: 7, 12 or 16 floats a surfel (paper, section 4)."""
    arrays = dict(arrays)
    arrays["normals"], arrays["normal_codes"] = pack_normals(arrays["normals"])
    return arrays


def _unpack_slim(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    arrays = dict(arrays)
    arrays["normals"] = unpack_normals(arrays["normals"], arrays.pop("normal_codes"))
    return arrays


def _pack_patches(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    """Store one size where all patches have the same."""
    size = arrays["size"]
    return arrays | {"size": size[:1] if len(size) and (size == size[0]).all() else size}


def _unpack_patches(arrays: dict[str, NDArray]) -> dict[str, NDArray]:
    size, count = arrays["size"], len(arrays["origins"])
    return arrays | {"size": size[0] if len(size) == 1 and count > 1 else size}


_PACKING = {"slim": (_pack_slim, _unpack_slim), "patches": (_pack_patches, _unpack_patches)}


def pack_normals(normals) -> tuple[NDArray, NDArray]:
    """Store unit normals (n, 3) as two of their components, unchanged, and a code for the third.

    The third is one whose square is at least 1/4, so that it follows from the others to the last bits. What
    `unpack_normals` gives packs to the same numbers again.

    Returns
    -------
    components : (n, 2) float32
        Those after the left-out one, in cyclic order.
    codes : (n,) uint8
        Axis of the left-out component (0, 1, 2), plus 4 where it is negative.
    """
    normals = np.asarray(normals, np.float32).reshape(-1, 3)
    for _ in range(4):  # a component within a rounding of 1/2 may change the axis once
        axis = np.where(np.abs(normals[:, 2]) >= 0.5, 2, np.where(np.abs(normals[:, 0]) >= 0.5, 0, 1))
        row = np.arange(len(normals))
        components = np.stack([normals[row, (axis + 1) % 3], normals[row, (axis + 2) % 3]], axis=1)
        codes = (axis + 4 * (normals[row, axis] < 0)).astype(np.uint8)
        again = unpack_normals(components, codes)
        if (again == normals).all():
            break
        normals = again
    return components, codes


def unpack_normals(components, codes) -> NDArray:
    """Return unit normals (n, 3) float32 from what `pack_normals` gives."""
    components = np.asarray(components, np.float32).reshape(-1, 2)
    codes = np.asarray(codes, np.uint8)
    axis = np.minimum(codes & 3, 2).astype(np.int64)
    rest = 1 - np.einsum("ij,ij->i", components, components, dtype=np.float64)
    row = np.arange(len(components))
    normals = np.empty((len(components), 3), np.float32)
    normals[row, axis] = np.sqrt(np.maximum(rest, 0)) * np.where(codes & 4, -1, 1)
    normals[row, (axis + 1) % 3], normals[row, (axis + 2) % 3] = components.T
    return normals
