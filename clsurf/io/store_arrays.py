"""The arrays of .clsurf stores: how they are chunked and compressed, and what is checked before they are read."""

import math
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from clsurf.errors import FileFormatError, InputError

from .files import one_line

if TYPE_CHECKING:
    import zarr  # functions that need it import it: a fifth of a second of every start

VERSION = 1
_CHUNK_BYTES = 1 << 21  # of one chunk: parts can be read remotely, yet a surface has few files
_LARGEST_CHUNK = 1 << 30  # that is read
_MOST_COMPRESSED = 20_000  # array bytes per stored byte: zstd on a constant chunk of 2 MB reaches 10,000
_BLOSC_HEADER = 16


def create_array(group: "zarr.Group", name: str, array, chunk_bytes: int = _CHUNK_BYTES, codec: str = "zstd") -> None:
    """Write `array` into a group as its member `name`, in chunks of rows."""
    from zarr.codecs import BloscCodec, BytesCodec
    array = np.ascontiguousarray(array)
    row_bytes = max(1, array.dtype.itemsize * math.prod(array.shape[1:]))
    rows = min(max(1, chunk_bytes // row_bytes), max(1, array.shape[0] if array.ndim else 1))
    shuffled = BloscCodec(typesize=array.dtype.itemsize, cname=codec, clevel=5, shuffle="bitshuffle")
    # Chunks of zeros are written too: a missing chunk is then always a damaged store.
    group.create_array(name, data=array, chunks=(rows, *(max(1, n) for n in array.shape[1:])), compressors=shuffled,
                       serializer=BytesCodec(endian="little"), filters=None, config={"write_empty_chunks": True})


def read_arrays(path: Path, group: "zarr.Group", members: "Members", prefix: str = "") -> dict:
    """Return all arrays of `group`, whose members' names start with `prefix`, after checking what they declare."""
    import zarr
    # One by one: zarr's concurrent listing of members writes the traceback of a damaged one to the terminal.
    keys = [key.removeprefix(prefix) for key in sorted(members.sizes) if key.startswith(prefix)]
    names = [key.removesuffix("/zarr.json") for key in keys if key.endswith("/zarr.json")]
    found = {name: item for name, item in ((name, group[name]) for name in names) if isinstance(item, zarr.Array)}
    for name, array in found.items():
        check_array(path, prefix + name, array, members)
    return {name: np.asarray(array[...]) for name, array in found.items()}


def check_plain(path, name: str, array: "zarr.Array") -> int:
    """Refuse an array of another type or encoding than is written, or with absurd chunks; return a chunk's bytes."""
    from zarr.codecs import BloscCodec, BytesCodec
    codecs = array.metadata.codecs
    plain = array.dtype.kind in "biuf" and all(isinstance(codec, BytesCodec | BloscCodec) for codec in codecs)
    if not plain or len(codecs) != 2:
        raise FileFormatError(f"{path}: {name}: unexpected type {array.dtype} or encoding {codecs!r}")
    chunk_bytes = array.dtype.itemsize * math.prod(array.chunks)
    if chunk_bytes > _LARGEST_CHUNK:
        raise FileFormatError(f"{path}: {name}: chunks of {chunk_bytes:,} bytes: damaged")
    return chunk_bytes


def check_array(path: Path, name: str, array: "zarr.Array", members: "Members") -> None:
    """Refuse an array whose chunks are missing or cannot hold what it declares, before memory is taken."""
    chunk_bytes = check_plain(path, name, array)
    count = math.prod(-(-n // c) for n, c in zip(array.shape, array.chunks, strict=True))
    prefix = f"{name}/c/" if array.shape else f"{name}/c"
    chunks = [key for key in members.sizes if key.startswith(prefix)]
    stored = sum(members.sizes[key] for key in chunks)
    if len(chunks) != count:
        raise FileFormatError(f"{path}: {name}: expected {count:,} chunks, got {len(chunks):,}: truncated or damaged")
    if array.nbytes > _MOST_COMPRESSED * (stored + 4096):
        raise FileFormatError(f"{path}: {name}: shape {array.shape} does not fit in {stored:,} stored bytes: damaged")
    for key in chunks:
        head = members.head(key)
        if len(head) < _BLOSC_HEADER or int.from_bytes(head[4:8], "little") != chunk_bytes or (
                int.from_bytes(head[12:16], "little") != members.sizes[key]):
            raise FileFormatError(f"{path}: {name}: damaged chunk {key}")


class Members:
    """Sizes of the files in a store by name, and their first bytes."""

    sizes: dict[str, int]

    def head(self, key: str) -> bytes:
        """Return the first bytes of a member."""
        raise InputError(f"no such member {key}")

    def close(self) -> None:
        """Let the file go."""


class ZipMembers(Members):
    """Those of a zip file."""

    def __init__(self, path: Path):
        self._zip = zipfile.ZipFile(path)
        self.sizes = {item.filename: item.file_size for item in self._zip.infolist()}

    def head(self, key: str) -> bytes:
        """Return the first bytes of a member."""
        with self._zip.open(key) as file:
            return file.read(_BLOSC_HEADER)

    def close(self) -> None:
        """Let the file go."""
        self._zip.close()


class FolderMembers(Members):
    """Those of a folder, or of the folder `inside` it alone."""

    def __init__(self, path: Path, inside: str = ""):
        self._path = path
        found = (path / inside).rglob("*")
        self.sizes = {p.relative_to(path).as_posix(): p.stat().st_size for p in found if p.is_file()}
        if not inside and "zarr.json" not in self.sizes:
            raise FileFormatError(f"{path}: a folder, but not a .clsurf store: it has no zarr.json")

    def head(self, key: str) -> bytes:
        """Return the first bytes of a member."""
        with open(self._path / key, "rb") as file:
            return file.read(_BLOSC_HEADER)


def zip_members(path: Path) -> Members:
    """Return the members of a store in a zip file, or raise FileFormatError."""
    size = path.stat().st_size
    try:
        members = ZipMembers(path)
    except Exception as error:  # zipfile raises more than BadZipFile on garbage
        raise FileFormatError(f"{path}: not a .clsurf store (a zip file): {one_line(error)}: truncated?") from None
    total = sum(members.sizes.values())
    if total > 4 * size + 4096 or "zarr.json" not in members.sizes:
        members.close()
        raise FileFormatError(f"{path}: a zip file, but not a .clsurf store" if "zarr.json" not in members.sizes else
                              f"{path}: damaged: {total:,} bytes claimed in a file of {size:,}")
    return members
