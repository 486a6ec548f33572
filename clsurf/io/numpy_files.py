"""NumPy's own files: .npy tables and .npz archives."""

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import FileFormatError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh

from .colors import as_rgba8
from .columns import cloud_of_table

_POINTS = ("points", "vertices", "positions", "xyz")
_MOST_COMPRESSED = 1100  # deflate's limit is 1032


def read_numpy(path: Path) -> Mesh | PointCloud:
    """Read .npy: (n, k) numbers as a text table would be, or records named x, y, z ...; or .npz.

    An .npz archive holds `points` (or `vertices`, `positions`, `xyz`) and, where wanted, `faces`, `normals`, `colors`,
    `uv`, `texture`, `scanners` and `origin`; further arrays of the same length are attributes.

    Raises
    ------
    FileFormatError
        Damaged, without points, or with Python objects (pickles are not read).
    """
    if path.suffix.lower() == ".npz":
        return _read_npz(path)
    with open(path, "rb") as file:
        _check_size(path, file, path.stat().st_size)
        file.seek(0)
        table = np.load(file, allow_pickle=False)
    if table.dtype.names:
        names = [n for n in table.dtype.names if table.dtype[n].kind in "iufb"]
        kind = np.result_type(*(table.dtype[n] for n in names)) if names else np.float64
        table = np.stack([table[n].ravel() for n in names], axis=1).astype(_floats(kind)) if names else np.zeros((0, 0))
        return cloud_of_table(path, table, names)
    if table.dtype.kind not in "iufb":
        raise FileFormatError(f"{path}: expected numbers, got {table.dtype}")
    if table.ndim == 3:
        table = table.reshape(-1, table.shape[2])  # an organised scan
    return cloud_of_table(path, table.astype(_floats(table.dtype), copy=False))


def _read_npz(path: Path) -> Mesh | PointCloud:
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        for item in archive.infolist():
            if item.file_size > _MOST_COMPRESSED * size:
                raise FileFormatError(f"{path}: damaged: {item.filename} does not fit in {size:,} bytes")
            with archive.open(item) as file:
                _check_size(path, file, item.file_size)
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    key = next((name for name in _POINTS if name in arrays), None)
    if key is None:
        raise FileFormatError(f"{path}: expected an array {' or '.join(_POINTS)}, got {', '.join(arrays) or 'none'}")
    points = arrays.pop(key)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "iuf":
        raise FileFormatError(f"{path}: {key}: expected numbers of shape (n, 3), got {points.shape} {points.dtype}")
    known = {name: arrays.pop(name, None)
             for name in ("normals", "colors", "scanners", "faces", "uv", "texture", "origin")}
    if known["colors"] is not None:
        known["colors"] = as_rgba8(known["colors"])
    faces, uv, texture = (known.pop(name) for name in ("faces", "uv", "texture"))
    known["attributes"] = {n: a for n, a in arrays.items() if a.ndim and len(a) == len(points)}
    points = points.astype(_floats(points.dtype), copy=False)
    if faces is None or not len(faces):
        return PointCloud(points, **known)
    known.pop("scanners")
    return Mesh(points, faces, uv=uv, texture=texture, **known)


def _check_size(path: Path, file, size: int) -> None:
    """Read only the header of an array and refuse one that claims more than `size` bytes, or Python objects."""
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if read is None:
        raise FileFormatError(f"{path}: unknown version {version} of the .npy format")
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise FileFormatError(f"{path}: holds Python objects, which are not read: save plain numbers")
    count = 1
    for length in shape:
        count *= int(length)
    if count < 0 or count * dtype.itemsize > size:
        raise FileFormatError(f"{path}: truncated: shape {shape} of {dtype} does not fit in {size:,} bytes")


def _floats(dtype) -> type:
    return np.float32 if dtype == np.float32 else np.float64


def write_numpy(scan: Mesh | PointCloud, path: Path) -> None:
    """Write .npz with every array, or .npy with columns x y z, normals and red green blue as records of one table."""
    with open(path, "wb") as file:
        if path.suffix.lower() == ".npz":
            arrays = {"points": scan.points, "origin": scan.origin}
            for name in ("faces", "normals", "colors", "uv", "texture", "scanners"):
                value = getattr(scan, name, None)
                if value is not None:
                    arrays[name] = value
            rest = {n: np.asarray(a) for n, a in scan.attributes.items() if n not in arrays}
            np.savez(file, **arrays, **{n: a for n, a in rest.items() if not a.dtype.hasobject})
            return
        world: NDArray = scan.points + scan.origin if scan.origin.any() else scan.points
        columns = [world]
        if scan.normals is not None:
            columns.append(scan.normals)
        if scan.colors is not None:
            columns.append(scan.colors[:, :3])
        if len(columns) == 1:
            np.save(file, world)
            return
        table = np.concatenate([c.astype(world.dtype) for c in columns], axis=1)
        names = ["x", "y", "z"] + (["nx", "ny", "nz"] if scan.normals is not None else []) + (
            ["red", "green", "blue"] if scan.colors is not None else [])
        np.save(file, np.ascontiguousarray(table).view([(n, world.dtype) for n in names])[:, 0])
