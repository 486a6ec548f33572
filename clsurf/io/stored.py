"""Surfaces that stay in their store: read in parts, from disk or over the network."""

import json
import warnings
import weakref
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import Error, FileFormatError, InputError
from clsurf.sizes import checked_budget
from clsurf.surface.placed import Placed, placed
from clsurf.surface.slim import COEFFICIENTS, SlimSurface

from . import parts, store_arrays
from .files import one_line
from .layout import from_arrays
from .store_arrays import FolderMembers, Members
from .stored_leaves import StoredLeaves

if TYPE_CHECKING:
    import zarr  # as in store_arrays

# A store on the web cannot be listed.
NAMES = ("centers", "radii", "normals", "normal_codes", "coefficients", "level", "leaf", "child_offset", "children",
         "fit_error", "origin")
OPTIONAL = ("footprint", "colors")
# What zarr, its codecs and the data types raise for damaged parts; a server that fails raises others.
_DAMAGED = (ValueError, TypeError, KeyError, IndexError, AttributeError, RuntimeError)
BUDGET = "1GB"
# Where files cannot be measured before they are read, as on the web; 600 MB of floats. Parts have 30M or fewer.
_MOST_NUMBERS = 150_000_000


class StoredSurface:
    """A SLIM surface in a .clsurf store, of which parts are read as they are needed.

    Parameters
    ----------
    place : path-like
        A .clsurf folder or zip, or a URL of a folder that fsspec reads, such as "https://host/name.clsurf".
    budget : int or str
        Bytes that its leaves may take in memory in `project`, `trace`, `curvature` and `error`, such as "1GB"; pictures
        have the renderer's budget.

    Attributes
    ----------
    degree, error, diagonal, bound, bound_share, bound_all
        As those of `SlimSurface`.
    part_bounds : (k, 2, 3) float64
        World boxes of the parts; part 0 holds the coarse levels of all.
    surfels : (k, levels) int
        How many each part has of every level.

    Raises
    ------
    InputError, FileFormatError
        No such store, or one that cannot be read.
    """

    def __init__(self, place, budget: int | str = BUDGET):
        self.place, self.budget = str(place), checked_budget(budget)
        import zarr
        self._leaves: StoredLeaves | None = None
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                self._group = zarr.open_group(_store(self.place), mode="r", zarr_format=3)
                about = dict(self._group.attrs)
                self._single = about.get("kind") == "slim"
                if about.get("format") != "clsurf" or about.get("kind") not in ("slim_parts", "slim"):
                    raise FileFormatError(f"{place}: expected a SLIM surface in a .clsurf store, got "
                                          f"{about.get('kind')!r}")
                self._values = dict(about["values"])
                self._describe()
        except Error:
            raise
        except FileNotFoundError:
            raise InputError(f"{place}: no such .clsurf store") from None
        except Exception as error:
            raise FileFormatError(f"{place}: damaged or no .clsurf store: {one_line(error)}") from error

    def _describe(self) -> None:
        values = self._values
        self.degree, self.error, self.diagonal = int(values["degree"]), values["error"], float(values["diagonal"])
        self.bound, self.bound_all = (float("nan") if values.get(name) is None else float(values[name])
                                      for name in ("bound", "bound_all"))
        self.bound_share = float(values.get("bound_share", 1.0))
        if self._single:
            whole = self.read(0)
            self.part_bounds = whole.bounds[None]
            self.surfels = np.bincount(whole.level, minlength=26)[None, 1:]
            self.colored, self.origin = whole.colors is not None, whole.origin
        else:
            count = int(values["parts"])
            self.part_bounds = self._checked("bounds", (count, 2, 3))[...]
            self.surfels = self._checked("surfels", (count, -1))[...]
            if self.surfels.dtype.kind not in "iu" or not ((self.surfels >= 0) & (self.surfels < 1 << 40)).all():
                raise FileFormatError(f"{self.place}: surfels: expected counts, got {self.surfels.min()} to "
                                      f"{self.surfels.max()}: damaged")
            self.colored = bool(values.get("colored"))
            self.origin = self._checked("parts/00000/origin", (3,))[...]

    @property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64, world space."""
        return np.stack([np.nanmin(self.part_bounds[:, 0], axis=0), np.nanmax(self.part_bounds[:, 1], axis=0)])

    def __len__(self):
        return int(self.surfels.sum())

    def read(self, part: int, levels: int | None = None) -> SlimSurface:
        """Return a part as a surface of its own, or its surfels of the levels up to `levels` only.

        Raises
        ------
        FileFormatError
            A damaged part.
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return self._read(part, levels)
        except Error:
            raise
        except (*_DAMAGED, MemoryError) as error:
            raise FileFormatError(f"{self.place}: part {part} is damaged: {one_line(error)}") from error

    def _read(self, part: int, levels: int | None) -> SlimSurface:
        group = self._group if self._single else self._group[f"parts/{part:05d}"]
        values = dict(group.attrs["values"])
        rows = None if levels is None or self._single else int(self.surfels[part, :levels].sum())
        names = [*NAMES, *(name for name in OPTIONAL if name in group)]
        held = self._part_arrays(part, names)
        if rows is None:
            return from_arrays("slim", {name: array[...] for name, array in held.items()}, values)
        whole = ("origin", "child_offset", "children")
        arrays = {name: array[...] if name == "origin" else array[:rows]
                  for name, array in held.items() if name not in whole[1:]}
        offset = held["child_offset"][:rows + 1]
        children = held["children"][:int(offset[-1])]
        keep = children < rows
        arrays["child_offset"] = np.concatenate([[0], np.cumsum(keep)])[offset].astype(np.int32)
        arrays["children"] = children[keep]
        return from_arrays("slim", arrays, values)

    def _part_arrays(self, part: int, names: list[str]) -> dict[str, "zarr.Array"]:
        """Return the arrays of a part, refused before they are read where they do not fit its surfels."""
        prefix = "" if self._single else f"parts/{part:05d}/"
        count = int(self._group["radii"].shape[0] if self._single else self.surfels[part].sum())
        members = self._members(prefix)
        try:
            out = {}
            for name in names:
                wide = {"origin": (3,), "child_offset": (count + 1,), "children": (-1,), "centers": (count, 3),
                        "normals": (count, 2), "coefficients": (count, COEFFICIENTS[self.degree]),
                        "footprint": (count, 8), "colors": (count, 4)}.get(name, (count,))
                out[name] = self._checked(prefix + name, wide, members)
            return out
        finally:
            if members is not None:
                members.close()

    def _members(self, inside: str) -> Members | None:
        """Return the sizes of the files in the folder `inside`, of all where it is empty; None: not known."""
        if "://" in self.place:
            return None
        path = Path(self.place).expanduser()
        return FolderMembers(path, inside) if path.is_dir() else store_arrays.zip_members(path)

    def _checked(self, name: str, shape: tuple, members: Members | None = None) -> "zarr.Array":
        """Return an array of the store, refused where it has another shape (-1: any) or cannot have it."""
        import zarr
        array = self._group[name]
        if not isinstance(array, zarr.Array) or array.ndim != len(shape) or any(
                want not in (-1, got) for got, want in zip(array.shape, shape, strict=True)):
            raise FileFormatError(f"{self.place}: {name}: expected the shape {shape}, got "
                                  f"{getattr(array, 'shape', 'a group')}: damaged")
        own = members is None
        members = self._members(name) if members is None else members
        if members is None:
            store_arrays.check_plain(self.place, name, array)
            if array.size > _MOST_NUMBERS:
                raise FileFormatError(f"{self.place}: {name}: the shape {array.shape} is absurd: damaged")
            return array
        try:
            store_arrays.check_array(Path(self.place), name, array, members)
        finally:
            if own:
                members.close()
        return array

    def leaves(self) -> StoredLeaves:
        """Return the leaves, which are read where they are asked for; those used last stay in memory."""
        if self._leaves is None:
            self._leaves = StoredLeaves(weakref.proxy(self), self.budget)
        return self._leaves

    def moved(self, matrix) -> Placed:
        """Return this surface placed by the similarity `matrix` (4, 4)."""
        return placed(self, matrix)

    def load(self) -> SlimSurface:
        """Return the whole surface."""
        if self._single:
            return self.read(0)
        return parts.joined([self.read(part) for part in range(len(self.surfels))], self._values)

    def __repr__(self):
        low, high = self.bounds
        return (f"StoredSurface(degree {self.degree}, {len(self):,} surfels in {len(self.surfels)} parts, "
                f"{self.place!r}, bounds {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()})")

    def __reduce__(self):
        return StoredSurface, (self.place, self.budget)


def _store(place: str):
    if "://" in place:
        try:
            from zarr.storage import FsspecStore
            return FsspecStore.from_url(place, read_only=True)
        except ImportError as error:
            raise InputError(f"{place}: needs fsspec: pip install clsurf[scale] ({one_line(error)})") from None
    from zarr.storage import LocalStore, ZipStore
    path = Path(place).expanduser()
    if not path.exists():
        raise InputError(f"{place}: no such .clsurf store")
    return LocalStore(path, read_only=True) if path.is_dir() else ZipStore(path, mode="r")


def in_parts(path) -> bool:
    """Return whether `path` is the folder of a SLIM surface in parts."""
    try:
        about = json.loads((Path(path) / "zarr.json").read_text())
        return about["attributes"]["kind"] == "slim_parts"
    except (OSError, ValueError, KeyError, TypeError):
        return False


def open_surface(place, budget: int | str = BUDGET) -> StoredSurface:
    """Open a SLIM surface in a .clsurf store without reading it whole; see `StoredSurface`.

    Parameters
    ----------
    place : path-like or str
        A folder, a zip file, or an address that fsspec reads, such as https://host/survey.clsurf (extra ``scale``).
    budget : int or str
        See `StoredSurface`.

    Returns
    -------
    StoredSurface

    Raises
    ------
    InputError, FileFormatError
        Nothing there, or something else than the store of a SLIM surface.
    """
    return StoredSurface(place, budget)
