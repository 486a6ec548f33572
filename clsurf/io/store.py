"""The .clsurf store: a Zarr v3 group of plain arrays in a zip file or a folder.

Attributes of the group: `format` "clsurf", `version`, `kind` ("slim", "mesh", "points") and `values`, the numbers and
flags. Arrays are named as the fields of the data types, chunked by rows and compressed losslessly (zstd with bit
shuffling). Any Zarr library reads them.
"""

import warnings
from pathlib import Path

import zarr
from zarr.storage import LocalStore, ZipStore

from clsurf.errors import Error, FileFormatError

from . import parts
from .files import existing_file, one_line, replacing
from .layout import KINDS, from_arrays, to_arrays
from .store_arrays import VERSION, FolderMembers, Members, create_array, read_arrays, zip_members


def save_store(thing, path) -> None:
    """Write a surface or scan as a .clsurf zip; the file appears whole or not at all.

    Raises
    ------
    InputError
        Something that is neither, or a place that cannot be written.
    """
    kind, arrays, values = to_arrays(thing)
    attributes = {"format": "clsurf", "version": VERSION, "kind": kind, "values": values}
    with replacing(path) as temporary:
        temporary.touch()  # a place that cannot be written is told here: closing a store that never opened fails
        store = ZipStore(temporary, mode="w")
        try:
            # Attributes are given here: a later update would put a second zarr.json into the zip.
            group = zarr.create_group(store, attributes=attributes)
            for name, array in arrays.items():
                create_array(group, name, array)
        finally:
            store.close()


def load_store(path):
    """Read a surface or scan from a .clsurf zip or folder.

    Raises
    ------
    InputError
        No such file.
    FileFormatError
        Not such a store, damaged, truncated, or written by a newer version of the format.
    """
    folder = Path(path)
    members: Members
    if folder.is_dir():
        members, path = FolderMembers(folder), folder
    else:
        path = existing_file(path)
        members = zip_members(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            store = LocalStore(path, read_only=True) if path.is_dir() else ZipStore(path, mode="r")
            try:
                return _read_group(path, zarr.open_group(store, mode="r", zarr_format=3), members)
            finally:
                store.close()
    except Error:
        raise
    except MemoryError:
        raise FileFormatError(f"{path}: too large for this machine's memory, or damaged") from None
    except Exception as error:  # zarr, its codecs and the data types raise anything for a damaged store
        raise FileFormatError(f"{path}: damaged .clsurf store: {one_line(error)}") from error
    finally:
        members.close()


def _read_group(path: Path, group: zarr.Group, members: "Members"):
    about = dict(group.attrs)
    if about.get("format") != "clsurf":
        raise FileFormatError(f"{path}: a Zarr group, but not a clsurf store (its format is {about.get('format')!r})")
    version, kind = about.get("version"), about.get("kind")
    if not isinstance(version, int) or version < 1:
        raise FileFormatError(f"{path}: damaged: expected a version number, got {version!r}")
    if version > VERSION:
        raise FileFormatError(f"{path}: written in version {version} of the .clsurf format, this clsurf reads up to "
                              f"version {VERSION}: install a newer clsurf")
    if kind in parts.KINDS:
        return parts.read_parts(path, group, members)
    if kind not in KINDS:
        raise FileFormatError(f"{path}: holds the unknown kind {kind!r}: expected {', '.join(KINDS)}")
    return from_arrays(kind, read_arrays(path, group, members), dict(about["values"]))
