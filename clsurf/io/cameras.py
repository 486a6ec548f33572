"""Files of cameras: JSON of intrinsics and poses (read and written), and COLMAP's text and binary models (read).

Axes are those of computer vision, x right, y down, z forward; a pose turns camera coordinates into world coordinates;
pixel (0, 0) is the top left one and its centre is (0.5, 0.5), in both.

The JSON file::

    {"cameras": [{"name": "front",                          text, each its own; by default its place in the list
                  "pose": [[...], [...], [...], [...]],     4 x 4, camera to world
                  "size": [640, 480],                       pixels, width and height
                  "intrinsics": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],    pixels of "size"
                  "near": 0.0,                              optional: nothing nearer is drawn, world units
                  "time": 0.0}],                            optional: when a path is there; all or none
     "closed": false}                                       optional: whether a path returns to its first camera

In place of "intrinsics" (and then without need of "size"): "fov", vertical in degrees, or "height", that of an
orthographic picture in world units.
"""

import itertools
import json
import logging
import math
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import FileFormatError, InputError

from .files import existing_file, one_line, replacing

# COLMAP's models: name, number of parameters, of focal lengths; the centre follows, then the distortion.
MODELS = {0: ("SIMPLE_PINHOLE", 3, 1), 1: ("PINHOLE", 4, 2), 2: ("SIMPLE_RADIAL", 4, 1), 3: ("RADIAL", 5, 1),
          4: ("OPENCV", 8, 2), 5: ("OPENCV_FISHEYE", 8, 2), 6: ("FULL_OPENCV", 12, 2), 7: ("FOV", 5, 2),
          8: ("SIMPLE_RADIAL_FISHEYE", 4, 1), 9: ("RADIAL_FISHEYE", 5, 1), 10: ("THIN_PRISM_FISHEYE", 12, 2)}
PINHOLE_LIKE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
DISTORTIONS = ("refuse", "ignore")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class CameraRecord:
    """A camera as files hold it: one of `intrinsics`, `fov`, `height` is given."""

    name: str
    pose: NDArray  # (4, 4) float64, camera to world, y down, z forward
    size: tuple[int, int] | None = None  # (width, height), pixels
    intrinsics: NDArray | None = None  # (3, 3) float64, pixels of size
    fov: float | None = None  # vertical, degrees
    height: float | None = None  # world units
    near: float | None = None  # world units
    time: float | None = None


@dataclass(frozen=True, eq=False)
class CameraFile:
    """The cameras of a file, in its order (COLMAP's: by name), and whether a path along them is closed."""

    records: tuple[CameraRecord, ...]
    closed: bool = False


def read_cameras(path, distortion: str = "refuse") -> CameraFile:
    """Read a file of cameras.

    Parameters
    ----------
    path : path-like
        A .json file (see the module), or COLMAP's model: its folder, or the cameras or images file of it, .txt or .bin.
    distortion : str
        What to do with cameras whose lens bends straight lines: "refuse", or "ignore" it with a logged line that says
        by how many pixels at most.

    Raises
    ------
    InputError
        No such file, or distortion where it is refused.
    FileFormatError
        A malformed file.
    """
    if distortion not in DISTORTIONS:
        raise InputError(f"distortion: expected one of {', '.join(DISTORTIONS)}, got {distortion!r}")
    path = Path(path)
    if path.suffix.lower() == ".json":
        return _read_json(existing_file(path))
    return _read_colmap(*_colmap_files(path), distortion)


def write_cameras(path, file: CameraFile) -> None:
    """Write cameras as .json; the file appears whole or not at all."""
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise InputError(f"{path}: unknown format of cameras {path.suffix or '(no ending)'}: expected .json")
    entries = []
    for record in file.records:
        entry = {"name": record.name, "pose": record.pose.tolist()}
        if record.size is not None:
            entry["size"] = list(record.size)
        if record.intrinsics is not None:
            entry["intrinsics"] = record.intrinsics.tolist()
        for name in ("fov", "height", "near", "time"):
            if getattr(record, name) is not None:
                entry[name] = float(getattr(record, name))
        entries.append(entry)
    rows = ",\n".join(" " + json.dumps(entry, allow_nan=False) for entry in entries)
    with replacing(path) as temporary:
        temporary.write_text(f'{{"cameras": [\n{rows}],\n"closed": {json.dumps(bool(file.closed))}}}\n',
                             encoding="utf-8")


# JSON -----------------------------------------------------------------------------------------------------------------


def _read_json(path: Path) -> CameraFile:
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: not JSON: {error}") from None
    entries = tree.get("cameras") if isinstance(tree, dict) else tree
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise FileFormatError(f'{path}: expected {{"cameras": [{{"pose": ..., "intrinsics": ..., "size": ...}}, ...]}} '
                              "with at least one camera")
    closed = tree.get("closed", False) if isinstance(tree, dict) else False
    if not isinstance(closed, bool):
        raise FileFormatError(f"{path}: closed: expected true or false, got {closed!r}")
    records = tuple(_json_record(f"{path}: camera {i}", entry, i) for i, entry in enumerate(entries))
    _check_names(path, records)
    timed = [record.time for record in records if record.time is not None]
    if timed and (len(timed) != len(records) or any(b <= a for a, b in itertools.pairwise(timed))):
        raise FileFormatError(f"{path}: time: expected one that grows from camera to camera, or none at all")
    return CameraFile(records, closed)


def _json_record(where: str, entry: dict, number: int) -> CameraRecord:
    given = [name for name in ("intrinsics", "fov", "height") if entry.get(name) is not None]
    if len(given) != 1:
        raise FileFormatError(f"{where}: expected one of intrinsics, fov and height, got {', '.join(given) or 'none'}")
    name = entry.get("name", str(number))
    if not isinstance(name, str) or not name:
        raise FileFormatError(f"{where}: name: expected text, got {name!r}")
    if "pose" not in entry:
        raise FileFormatError(f"{where}: pose: expected a 4 x 4 matrix, got none")
    pose = _array(where, "pose", entry["pose"], (4, 4))
    size = None
    if entry.get("size") is not None:
        pair = _array(where, "size", entry["size"], (2,))
        if not (pair > 0).all() or (pair != np.floor(pair)).any():
            raise FileFormatError(f"{where}: size: expected two positive whole numbers, got {entry['size']}")
        size = (int(pair[0]), int(pair[1]))
    elif given == ["intrinsics"]:
        raise FileFormatError(f"{where}: size: expected the picture's [width, height] beside intrinsics, got none")
    matrix = _array(where, "intrinsics", entry["intrinsics"], (3, 3)) if given == ["intrinsics"] else None
    numbers = {key: float(_array(where, key, entry[key], ())) for key in ("fov", "height", "near", "time")
               if entry.get(key) is not None}
    return CameraRecord(name, _checked_pose(where, pose), size, matrix, **numbers)


def _array(where: str, name: str, value, shape: tuple) -> NDArray:
    try:
        out = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        out = np.zeros(99)
    if isinstance(value, str | bool) or out.shape != shape or not np.isfinite(out).all():
        kind = " x ".join(map(str, shape)) or "a single"
        raise FileFormatError(f"{where}: {name}: expected {kind} finite number{'s' * bool(shape)}")
    return out


def _checked_pose(where: str, pose: NDArray) -> NDArray:
    turn = pose[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) or np.linalg.det(turn) < 0 \
            or not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-9):
        raise FileFormatError(f"{where}: pose: expected a rotation and a position, camera to world, without scale or "
                              "mirroring")
    u, _, v = np.linalg.svd(turn)  # rounded in the file: to the nearest rotation
    pose = pose.copy()
    pose[:3, :3] = u @ v if not np.allclose(turn @ turn.T, np.eye(3), rtol=0, atol=1e-12) else turn
    return pose


def _check_names(path: Path, records) -> None:
    seen = set()
    for record in records:
        if record.name in seen:
            raise FileFormatError(f"{path}: name: expected each once, got {record.name!r} twice")
        seen.add(record.name)


# COLMAP: https://colmap.github.io/format.html -------------------------------------------------------------------------


def _colmap_files(path: Path) -> tuple[Path, Path]:
    """Return the files of cameras and images that `path` means."""
    if path.is_dir():
        for folder in (path, path / "sparse" / "0", path / "sparse"):
            for ending in (".bin", ".txt"):
                pair = folder / f"cameras{ending}", folder / f"images{ending}"
                if all(p.is_file() for p in pair):
                    return pair
        raise InputError(f"{path}: expected COLMAP's cameras.bin and images.bin, or .txt, in this folder")
    if path.stem not in ("cameras", "images") or path.suffix not in (".txt", ".bin"):
        raise InputError(f"{path}: unknown format of cameras: expected .json, or the folder of a COLMAP model")
    return tuple(existing_file(path.with_name(f"{stem}{path.suffix}")) for stem in ("cameras", "images"))


def _read_colmap(cameras_path: Path, images_path: Path, distortion: str) -> CameraFile:
    binary = cameras_path.suffix == ".bin"
    try:
        lenses = (_binary_lenses if binary else _text_lenses)(cameras_path)
    except (struct.error, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise FileFormatError(f"{cameras_path}: damaged: {error}") from None
    try:
        images = (_binary_images if binary else _text_images)(images_path)
    except (struct.error, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise FileFormatError(f"{images_path}: damaged: {error}") from None
    if not images:
        raise FileFormatError(f"{images_path}: expected at least one image, got none")
    pinholes, records = {}, []
    for name, lens, quaternion, translation in sorted(images):
        where = f"{images_path}: image {one_line(name)}"
        if lens not in lenses:
            raise FileFormatError(f"{where}: camera {lens} is not in {cameras_path.name}")
        if lens not in pinholes:
            pinholes[lens] = _pinhole(f"{cameras_path}: camera {lens}", *lenses[lens], distortion)
        matrix, size = pinholes[lens]
        records.append(CameraRecord(name, _colmap_pose(where, quaternion, translation), size, matrix))
    _check_names(images_path, records)
    return CameraFile(tuple(records))


def _colmap_pose(where: str, quaternion, translation) -> NDArray:
    """Return camera to world (4, 4) of COLMAP's world to camera."""
    q, t = np.array(quaternion, np.float64), np.array(translation, np.float64)
    length = np.linalg.norm(q)
    if not np.isfinite(t).all() or not 1e-6 < length < 1e6:
        raise FileFormatError(f"{where}: expected a rotation as quaternion and a translation, got {quaternion}, "
                              f"{translation}")
    w, x, y, z = q / length
    turn = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.T, -turn.T @ t
    return pose


def _pinhole(where: str, model: str, size, parameters, distortion: str):
    """Return the matrix (3, 3) and the size of a lens, its distortion refused or ignored."""
    focals, count = next((focals, count) for name, count, focals in MODELS.values() if name == model)
    if model not in PINHOLE_LIKE:
        raise InputError(f"{where}: {model} is no pinhole: undistort the pictures first (colmap image_undistorter)")
    values = np.array(parameters, np.float64)
    if len(values) != count or not np.isfinite(values).all():
        raise FileFormatError(f"{where}: expected {count} finite parameters of {model}, got {len(values)}")
    fx, fy, (cx, cy) = values[0], values[focals - 1], values[focals:focals + 2]
    if not (fx > 0 and fy > 0 and min(size) > 0):
        raise FileFormatError(f"{where}: expected positive focal lengths and sizes, got {fx:g}, {fy:g}, {size}")
    bends = values[focals + 2:]
    if np.any(bends != 0):
        pixels = _most_bent(bends, fx, fy, cx, cy, size)
        if distortion == "refuse":
            raise InputError(f"{where}: the lens bends straight lines by up to {pixels:.3g} pixels ({model}): "
                             "undistort the pictures first, or ignore it (distortion=\"ignore\", --ignore-distortion)")
        _log.warning("%s: the lens bends straight lines by up to %.3g pixels (%s), which is ignored", where, pixels,
                     model)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), size


def _most_bent(bends, fx, fy, cx, cy, size) -> float:
    """Return by how many pixels the corners move (COLMAP's models up to FULL_OPENCV)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(bends, (0, 8 - len(bends)))
    corners = np.array([[x, y] for x in (0, size[0]) for y in (0, size[1])], np.float64)
    u, v = (corners[:, 0] - cx) / fx, (corners[:, 1] - cy) / fy
    r = u * u + v * v
    radial = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    du = u * radial + 2 * p1 * u * v + p2 * (r + 2 * u * u) - u
    dv = v * radial + 2 * p2 * u * v + p1 * (r + 2 * v * v) - v
    return float(np.hypot(du * fx, dv * fy).max())


def _text_lenses(path: Path) -> dict:
    lenses, names = {}, {name for name, _, _ in MODELS.values()}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5 or words[1] not in names:
            raise FileFormatError(f"{path}: line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS with a "
                                  f"known model, got {line[:60]!r}")
        try:
            lenses[int(words[0])] = words[1], (int(words[2]), int(words[3])), [float(word) for word in words[4:]]
        except ValueError:
            raise FileFormatError(f"{path}: line {number}: expected numbers, got {line[:60]!r}") from None
    return lenses


def _text_images(path: Path) -> list:
    images, points_next = [], False
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if line.startswith("#"):
            continue
        if points_next:  # a line of the image's points, often empty
            points_next = False
            continue
        words = line.split(maxsplit=9)
        if not words:
            continue
        try:
            numbers = [float(word) for word in words[1:8]]
            if len(words) < 10:
                raise ValueError
            images.append((words[9].strip(), int(words[8]), numbers[:4], numbers[4:]))
        except ValueError:
            raise FileFormatError(f"{path}: line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got "
                                  f"{line[:60]!r}") from None
        points_next = True
    return images


def _binary_lenses(path: Path) -> dict:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    lenses = {}
    for _ in range(count):
        lens, model, width, height = struct.unpack_from("<iiQQ", data, at)
        if model not in MODELS:
            raise FileFormatError(f"{path}: camera {lens}: unknown model {model}")
        name, parameters, _ = MODELS[model]
        lenses[lens] = name, (width, height), struct.unpack_from(f"<{parameters}d", data, at + 24)
        at += 24 + 8 * parameters
    return lenses


def _binary_images(path: Path) -> list:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    images = []
    for _ in range(count):
        _, *numbers, lens = struct.unpack_from("<i7di", data, at)
        end = data.find(b"\0", at + 64)
        if end < 0:
            raise FileFormatError(f"{path}: truncated: image {len(images)} has no name's end")
        images.append((data[at + 64:end].decode(errors="replace"), lens, numbers[:4], numbers[4:]))
        (points,), at = struct.unpack_from("<Q", data, end + 1), end + 9
        at += 24 * points
        if at > len(data):
            raise FileFormatError(f"{path}: truncated: {points:,} points of image {one_line(images[-1][0])} do not fit "
                                  f"in {math.ceil(len(data) / 1024):,} KB")
    return images
