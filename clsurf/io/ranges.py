"""Range images from files: Stanford's .conf of posed range grids, and folders of depth and colour frames."""

import json
import logging
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import FileFormatError, InputError
from clsurf.surface.ranges import RangeImage, RangeScan

from . import ply
from .files import existing_file
from .images import read_channels, read_image
from .rows import numbers_in

log = logging.getLogger("clsurf")

DEPTH_SCALE = 1000.0  # steps of a 16-bit depth image per world unit: millimetres to metres
DEPTH_ENDINGS, COLOR_ENDINGS = (".png", ".exr", ".tif", ".tiff"), (".jpg", ".jpeg", ".png")
DEPTH_FOLDERS, COLOR_FOLDERS = ("depth",), ("color", "colour", "image", "rgb")
POSE_FILES = ("trajectory.log", "odometry.log")


def load_conf(path) -> RangeScan:
    """Read a .conf file of the Stanford scanning repository: range grids and their poses.

    Each line ``bmesh FILE tx ty tz qx qy qz qw`` (or ``mesh``) names a PLY file beside it. The rotation is that of the
    *conjugated* quaternion: with it the bunny's ten images lie 0.24 mm apart, otherwise 4.1 mm.

    Files that are named but missing are left out, which the log says; at least one must be there.

    Raises
    ------
    InputError, FileFormatError
        No such file, a damaged line, or none of the files it names.
    """
    path = existing_file(path)
    entries = []
    for number, line in enumerate(path.read_text("latin-1").splitlines(), 1):
        words = line.split()
        if not words or words[0] not in ("bmesh", "mesh"):
            continue
        try:
            numbers = np.array([float(word) for word in words[2:9]])
        except ValueError:
            numbers = np.zeros(0)
        if len(words) < 9 or not np.isfinite(numbers).all() or not np.linalg.norm(numbers[3:]) > 0:
            raise FileFormatError(f"{path}: line {number}: expected '{words[0]} FILE tx ty tz qx qy qz qw', got "
                                  f"{line[:80]!r}")
        entries.append((words[1], conf_pose(numbers[:3], numbers[3:])))
    if not entries:
        raise FileFormatError(f"{path}: expected lines 'bmesh FILE tx ty tz qx qy qz qw', got none")
    images, missing = [], []
    for name, pose in entries:
        file = path.parent / name
        if not file.is_file():
            missing.append(name)
            continue
        images.append(RangeImage(points=read_range_grid(file), pose=pose, name=name))
    if missing:
        log.warning("%s: %d of %d range images are missing and left out: %s", path.name, len(missing), len(entries),
                    " ".join(missing))
    if not images:
        raise InputError(f"{path}: none of its {len(entries)} range images is there: put {entries[0][0]} ... beside it")
    return RangeScan(images)


def conf_pose(translation, quaternion) -> NDArray:
    """Return the pose (4, 4) float64 of a .conf line: translation, and quaternion (x, y, z, w) to be conjugated."""
    x, y, z, w = np.asarray(quaternion, np.float64) * (-1, -1, -1, 1) / np.linalg.norm(quaternion)
    pose = np.eye(4)
    pose[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    pose[:3, 3] = translation
    return pose


def read_range_grid(path) -> NDArray:
    """Read a PLY file with an element ``range_grid``: points (rows, columns, 3) float32, NaN for none.

    The grid's size stands in the header's ``obj_info num_cols`` and ``num_rows``; its scanner stands far along +z.

    Raises
    ------
    InputError, FileFormatError
        No such file, a PLY file without a range grid, truncated, or with impossible numbers.
    """
    path = existing_file(path)
    data = path.read_bytes()
    order, elements, start = ply._read_header(path, data)
    info = dict(re.findall(rb"obj_info\s+(num_cols|num_rows)\s+(\d+)", data[:start]))
    if not any(e.name == "range_grid" for e in elements) or len(info) != 2:
        raise FileFormatError(f"{path}: expected a range image (element range_grid, obj_info num_cols and num_rows), "
                              f"got {', '.join(e.name for e in elements) or 'no element'}")
    columns, rows = int(info[b"num_cols"]), int(info[b"num_rows"])
    vertex, lengths, values = _grid_elements(path, data, order, elements, start)
    if columns * rows != len(lengths):
        raise FileFormatError(f"{path}: damaged: {columns} x {rows} samples, but {len(lengths):,} of element "
                              "range_grid")
    if not set("xyz") <= vertex.keys():
        raise FileFormatError(f"{path}: expected properties x, y, z of element vertex, got {', '.join(vertex)}")
    positions = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float32)
    index = np.full(len(lengths), -1, np.int64)
    offset = np.cumsum(lengths) - lengths
    index[lengths > 0] = values[offset[lengths > 0]]
    if index.max(initial=-1) >= len(positions) or (index[lengths > 0] < 0).any():
        raise FileFormatError(f"{path}: damaged: its grid names a point outside the {len(positions):,} there are")
    grid = np.full((rows * columns, 3), np.nan, np.float32)
    grid[index >= 0] = positions[index[index >= 0]]
    return grid.reshape(rows, columns, 3)


def _grid_elements(path, data, order, elements, start):
    """Return the vertex columns by name, and the lengths and values of the grid's lists."""
    if order is not None:
        found = ply._read_binary(path, data, start, elements, {"vertex", "range_grid"}, order)
        if not isinstance(found.get("range_grid"), tuple) or "vertex" not in found:
            raise FileFormatError(f"{path}: expected an element vertex and a list in element range_grid")
        return found["vertex"], *(np.asarray(a).astype(np.int64) for a in found["range_grid"])
    try:
        tokens = numbers_in(data[start:])
    except ValueError:
        raise FileFormatError(f"{path}: expected numbers after the header, got other text") from None
    if [e.name for e in elements[:2]] != ["vertex", "range_grid"] or len(elements[1].properties) != 1:
        raise FileFormatError(f"{path}: expected the elements vertex and range_grid with one list, in this order")
    names = [p.name for p in elements[0].properties]
    end = elements[0].count * len(names)
    if end > len(tokens):
        raise FileFormatError(f"{path}: truncated: {elements[0].count:,} of element vertex need {end:,} numbers, got "
                              f"{len(tokens):,}")
    vertex = dict(zip(names, tokens[:end].reshape(-1, len(names)).T, strict=True))
    return vertex, *_lists(path, tokens[end:], elements[1].count)


def _lists(path, tokens: NDArray, count: int) -> tuple[NDArray, NDArray]:
    """Return lengths (count,) and values of lists written as 'length value ...' one after the other.

    Where the next list begins follows from where this one does; doubling the stride finds all in log2(count) steps
    (240,000 lists: 20 ms; one by one 150 ms).
    """
    size = len(tokens)
    with np.errstate(invalid="ignore"):
        follow = np.arange(size + 1) + 1
        follow[:size] += np.clip(np.nan_to_num(tokens), 0, size).astype(np.int64)
    np.minimum(follow, size, out=follow)
    begins = np.zeros(1, np.int64)
    while len(begins) < count:
        begins = np.concatenate([begins, follow[begins]])
        follow = follow[follow]
    begins = begins[:count]
    if size < count or begins.max(initial=0) >= size or (tokens[begins] < 0).any():
        raise FileFormatError(f"{path}: truncated or damaged in element range_grid of {count:,}")
    lengths = tokens[begins].astype(np.int64)
    if count and begins[-1] + lengths[-1] >= size:
        raise FileFormatError(f"{path}: truncated in the last of element range_grid")
    keep = np.ones(size, bool)
    keep[begins] = False
    keep[begins[-1] + lengths[-1] + 1 if count else 0:] = False
    return lengths, tokens[keep].astype(np.int64)


def load_frames(folder=None, depth=None, color=None, intrinsics=None, poses=None, depth_scale=None) -> RangeScan:
    """Read depth frames, with or without colour, as one scan.

    Parameters
    ----------
    folder : path-like, optional
        A folder with a .json file of intrinsics, depth/ (16-bit PNG or EXR), color/ and a trajectory.log, as Open3D and
        the Redwood scans have them, or that .json file. What is given below replaces what it holds.
    depth : sequence of path-like or (h, w) array, optional
        Depth images; integers are divided by `depth_scale`, EXR holds world units in its channel Z or its only one.
    color : sequence of path-like or (H, W, 3 or 4) uint8, optional
        As many colour images, seen from the same place.
    intrinsics : (3, 3) array or path-like, optional
        Of the depth images, or a .json file with ``intrinsic_matrix`` (column by column), as Open3D writes it.
    poses : sequence of (4, 4) array, or path-like, optional
        From each camera to the world, or a .log file of them; the identity for a single frame.
    depth_scale : float, optional
        Steps of integer depth per world unit, 1000 by default: millimetres to metres.

    Returns
    -------
    RangeScan

    Raises
    ------
    InputError, FileFormatError
        Files that are missing or damaged, or do not fit together.
    """
    if folder is not None:
        found = _frames_of_folder(folder)
        depth = found["depth"] if depth is None else depth
        color = found["color"] if color is None else color
        intrinsics = found["intrinsics"] if intrinsics is None else intrinsics
        poses = found["poses"] if poses is None else poses
    depth, color = _as_list(depth), _as_list(color)
    if not depth:
        raise InputError("depth: expected at least one depth image, got none")
    if color and len(color) != len(depth):
        raise InputError(f"color: expected as many images as depth images ({len(depth)}), got {len(color)}")
    if intrinsics is None:
        raise InputError("intrinsics: expected a (3, 3) matrix or a .json file with one, got none")
    matrix = read_intrinsics(intrinsics) if _is_path(intrinsics) else intrinsics
    poses = read_trajectory(poses) if _is_path(poses) else poses
    if poses is None:
        if len(depth) > 1:
            raise InputError(f"poses: expected one for each of the {len(depth)} frames, got none")
        poses = [np.eye(4)]
    if len(poses) < len(depth):
        raise InputError(f"poses: expected one for each of the {len(depth)} frames, got {len(poses)}")
    images = []
    for k, source in enumerate(depth):
        name = Path(source).name if _is_path(source) else f"frame {k}"
        images.append(RangeImage(depth=_depth_of(source, depth_scale), intrinsics=matrix, pose=poses[k], name=name,
                                 color=_color_of(color[k]) if color else None))
    return RangeScan(images)


def _is_path(value) -> bool:
    return isinstance(value, str) or hasattr(value, "__fspath__")


def _as_list(value) -> list:
    if value is None:
        return []
    depth_array = isinstance(value, np.ndarray) and value.ndim == 2
    color_array = isinstance(value, np.ndarray) and value.ndim == 3 and value.dtype == np.uint8
    return [value] if _is_path(value) or depth_array or color_array else list(value)


def _frames_of_folder(folder) -> dict:
    """Return the files of a folder of frames by what they are."""
    folder = Path(folder).expanduser()
    intrinsics = None
    if folder.suffix.lower() == ".json":
        intrinsics, folder = existing_file(folder), folder.parent
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    if intrinsics is None:
        intrinsics = next(iter(sorted(folder.glob("*.json"))), None)
    depth = _pictures(folder, DEPTH_FOLDERS, DEPTH_ENDINGS)
    if intrinsics is None or not depth:
        lacks = "a folder depth/ with .png or .exr files" if not depth else "a .json file of intrinsics"
        raise InputError(f"{folder}: a folder without {lacks}: expected depth/, a .json file of intrinsics and, for "
                         "more than one frame, trajectory.log")
    poses = next((folder / name for name in POSE_FILES if (folder / name).is_file()), None)
    return {"depth": depth, "color": _pictures(folder, COLOR_FOLDERS, COLOR_ENDINGS), "intrinsics": intrinsics,
            "poses": poses}


def _pictures(folder: Path, names, endings) -> list[Path]:
    for name in names:
        if (folder / name).is_dir():
            return sorted(p for p in (folder / name).iterdir() if p.suffix.lower() in endings)
    return []


def read_intrinsics(path) -> NDArray:
    """Read the matrix (3, 3) float64 of a .json file with ``intrinsic_matrix``, nine numbers column by column."""
    path = existing_file(path)
    try:
        values = np.array(json.loads(path.read_text("utf-8"))["intrinsic_matrix"], np.float64)
    except (ValueError, KeyError, TypeError):
        values = np.zeros(0)
    if values.size != 9 or not np.isfinite(values).all():
        raise FileFormatError(f"{path}: expected a .json file with intrinsic_matrix, nine numbers column by column")
    return values.reshape(3, 3).T if values.ndim == 1 else values


def read_trajectory(path) -> list[NDArray]:
    """Read a .log file of poses: three whole numbers and a (4, 4) matrix, camera to world, for each frame."""
    path = existing_file(path)
    try:
        numbers = numbers_in(path.read_bytes())
    except ValueError:
        raise FileFormatError(f"{path}: expected numbers, got other text") from None
    if len(numbers) == 0 or len(numbers) % 19:
        raise FileFormatError(f"{path}: expected 3 + 16 numbers a frame, got {len(numbers)}: truncated?")
    return list(numbers.reshape(-1, 19)[:, 3:].reshape(-1, 4, 4))


def _depth_of(source, scale) -> NDArray:
    """Return a depth image (h, w) float32 in world units from a file or an array."""
    name = "depth"
    if _is_path(source):
        name = str(source)
        if Path(source).suffix.lower() == ".exr":
            planes = read_channels(source)
            chosen = next((planes[c] for c in ("Z", "Y", "R") if c in planes), next(iter(planes.values())))
            source = np.asarray(chosen)
        else:
            source = read_image(source)
            if source.shape[2] != 1 or source.dtype == np.uint8:
                raise FileFormatError(f"{name}: expected a depth image of one channel with 16 bits, got "
                                      f"{source.shape[2]} of {source.dtype}")
            source = source[..., 0]
    source = np.asarray(source)
    if source.ndim != 2 or source.dtype.kind not in "iuf":
        raise InputError(f"{name}: expected a depth image (h, w), got {source.shape} {source.dtype}")
    if source.dtype.kind == "f":
        return source / np.float32(1 if scale is None else scale)
    return source.astype(np.float32) / np.float32(DEPTH_SCALE if scale is None else scale)


def _color_of(source) -> NDArray:
    """Return a colour image (H, W, 4) uint8 from a file or an array."""
    name = str(source) if _is_path(source) else "color"
    pixels = read_image(source) if _is_path(source) else np.asarray(source)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4) or pixels.dtype != np.uint8:
        raise InputError(f"{name}: expected a colour image (h, w, 3) of 8 or 16 bits, got {pixels.shape} "
                         f"{pixels.dtype}")
    out = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    out[..., :pixels.shape[2] if pixels.shape[2] > 1 else 3] = pixels
    return out
