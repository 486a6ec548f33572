"""A large surface in parts: a .clsurf folder whose group `parts` holds one surface each, with an index of their boxes.

Attributes of the root: `format`, `version`, kind "slim_parts" and `values`, the numbers that all parts share. Arrays of
the root: `bounds` (k, 2, 3), the world boxes of the parts, and `surfels` (k, levels), how many each has of every level,
in which order its rows stand. Part 0 is the coarse one: the levels above all cells. A part can be read alone, and of it
the first levels alone.
"""

import os
import shutil
import uuid
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsurf.errors import FileFormatError
from clsurf.surface.patch import PatchSurface
from clsurf.surface.slim import SlimSurface

from .layout import from_arrays, to_arrays
from .store_arrays import VERSION, create_array, read_arrays

if TYPE_CHECKING:
    import zarr  # as in store_arrays

KINDS = {"slim_parts": "slim", "patches_parts": "patches"}  # and the kind of their parts
SHARED = ("degree", "error", "diagonal", "bound", "bound_share", "bound_all", "oriented")
CHUNK_BYTES = 1 << 20


def write_part(folder: Path, number: int, surface: SlimSurface) -> None:
    """Write part `number` of the surface in `folder`; it appears whole or not at all."""
    target = part_folder(folder, number)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex[:12]}")
    kind, arrays, values = to_arrays(surface)
    try:
        group = _new_group(temporary, {"format": "clsurf", "version": VERSION, "kind": kind, "values": values})
        for name, array in arrays.items():
            create_array(group, name, array, CHUNK_BYTES, "lz4")
        if target.exists():
            shutil.rmtree(target)
        os.replace(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _new_group(folder: Path, attributes: dict) -> "zarr.Group":
    import zarr
    from zarr.storage import LocalStore
    return zarr.create_group(LocalStore(folder), attributes=attributes)


def part_folder(folder: Path, number: int) -> Path:
    """Return where part `number` lies."""
    return folder / "parts" / f"{number:05d}"


def write_index(folder: Path, values: dict, bounds: NDArray, surfels: NDArray, kind: str = "slim") -> None:
    """Write the root of a surface whose parts are there, all of `kind`: after this the folder is a store."""
    for left in (folder / "parts").glob(".*"):  # of a worker that was killed while it wrote
        shutil.rmtree(left, ignore_errors=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _new_group(folder / "parts", {})
        group = _new_group(folder, {"format": "clsurf", "version": VERSION, "kind": f"{kind}_parts", "values": values})
        create_array(group, "bounds", np.asarray(bounds, np.float64), CHUNK_BYTES, "lz4")
        create_array(group, "surfels", np.asarray(surfels, np.int64), CHUNK_BYTES, "lz4")


def joined(parts: list[SlimSurface], shared: dict) -> SlimSurface:
    """Return the parts as one surface; `shared` are values (SHARED) that it has instead of the first part's.

    Surfels without a parent are linked to the internal surfels of the level before whose balls hold them, across parts;
    a coarse leaf that was taken back keeps what lies in its ball.
    """
    whole = [part for part in parts if len(part)] or parts[:1]
    origin = parts[0].origin
    count = np.array([len(part) for part in whole])
    level = np.concatenate([part.level for part in whole])
    order = np.argsort(level, kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    first = np.concatenate([[0], np.cumsum(count)])
    gather = lambda name: np.concatenate([getattr(part, name) for part in whole])[order]  # noqa: E731
    centers = np.concatenate([part.centers + (part.origin - origin) for part in whole])[order].astype(np.float32)
    parent = np.concatenate([np.repeat(np.arange(len(p)), np.diff(p.child_offset)) + f
                             for p, f in zip(whole, first[:-1], strict=True)])
    child = np.concatenate([p.children.astype(np.int64) + f for p, f in zip(whole, first[:-1], strict=True)])
    level, leaf, radii = level[order], gather("leaf"), gather("radii")
    links = [(place[parent], place[child]), *_adopted(centers, radii, level, leaf, place[child])]
    parent, child = (np.concatenate([pair[k] for pair in links]) for k in (0, 1))
    by_parent = np.lexsort((child, parent))
    offset = np.concatenate([[0], np.cumsum(np.bincount(parent, minlength=len(order)))])
    optional = {}
    if any(part.footprint is not None for part in whole):
        optional["footprint"] = np.concatenate([
            np.full((len(p), 8), 255, np.uint8) if p.footprint is None else p.footprint for p in whole])[order]
    if all(part.colors is not None for part in whole):
        optional["colors"] = gather("colors")
    values = {name: shared.get(name, getattr(parts[0], name)) for name in SHARED}
    values = {name: float("nan") if value is None else value for name, value in values.items()}
    return SlimSurface(**values, origin=origin, centers=centers, radii=radii, normals=gather("normals"),
                       coefficients=gather("coefficients"), level=level, leaf=leaf,
                       child_offset=offset.astype(np.int32), children=child[by_parent].astype(np.int32),
                       fit_error=gather("fit_error"), **optional)


def _adopted(centers, radii, level, leaf, child) -> list[tuple[NDArray, NDArray]]:
    """Return parents and children of the surfels that are nobody's child, level by level."""
    orphan = np.ones(len(centers), bool)
    orphan[child] = False
    out = []
    childless = np.flatnonzero(~leaf)
    for number in np.unique(level)[1:]:
        rows = np.flatnonzero(orphan & (level == number))
        inner = childless[level[childless] < number]
        # Internal surfels of the level before; of earlier ones where that one has none (cells start at their level).
        inner = inner[level[inner] == level[inner].max(initial=0)]
        if not len(rows) or not len(inner):
            continue
        pairs = cKDTree(centers[inner]).sparse_distance_matrix(
            cKDTree(centers[rows]), float(radii[inner].max()) * (1 + 1e-6), output_type="ndarray")
        held = pairs["v"] <= radii[inner[pairs["i"]]] * (1 + 1e-6)
        out.append((inner[pairs["i"][held]], rows[pairs["j"][held]]))
    return out


def joined_patches(parts: list[PatchSurface], shared: dict) -> PatchSurface:
    """Return the patches of all parts as one surface."""
    whole = [part for part in parts if len(part)] or parts[:1]
    gather = lambda name: np.concatenate([getattr(part, name) for part in whole])  # noqa: E731
    origin = parts[0].origin
    number = lambda name: float("nan") if shared.get(name) is None else float(shared[name])  # noqa: E731
    return PatchSurface(np.concatenate([part.origins + (part.origin - origin) for part in whole]), gather("axis_x"),
                        gather("axis_y"), gather("axis_z_length"), gather("size"), gather("displacements"),
                        None if whole[0].colors is None else gather("colors"), origin=origin,
                        diagonal=float(shared["diagonal"]), bound=number("bound"),
                        bound_share=float(shared["bound_share"]), bound_all=number("bound_all"),
                        oriented=all(part.oriented for part in whole))


def read_parts(path: Path, group: "zarr.Group", members) -> SlimSurface | PatchSurface:
    """Return the surface of a store in parts, whole."""
    values, kind = dict(group.attrs["values"]), KINDS[group.attrs["kind"]]
    parts = []
    for number in range(int(values["parts"])):
        name = f"parts/{number:05d}"
        if f"{name}/zarr.json" not in members.sizes:
            raise FileFormatError(f"{path}: part {number} of {values['parts']} is missing: truncated or damaged")
        part = group[name]
        parts.append(from_arrays(kind, read_arrays(path, part, members, name + "/"), dict(part.attrs["values"])))
    return joined(parts, values) if kind == "slim" else joined_patches(parts, values)
