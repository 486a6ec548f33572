"""Reading and writing scans: meshes and point clouds in every common format, chosen by the file's ending."""

import importlib
import logging
import warnings
from pathlib import Path

import numpy as np

from clsurf.errors import Error, FileFormatError, InputError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh

from .cleaning import clean_scan
from .files import existing_file, one_line, replacing

log = logging.getLogger("clsurf")


def load_scan(path, clean: bool = True) -> Mesh | PointCloud:
    """Read a scan.

    PLY, OBJ, STL, OFF, GLB and glTF give a Mesh, or a PointCloud where they hold no faces; XYZ, PTS, CSV, TXT, ASC,
    NPY, LAS and LAZ (COPC) a PointCloud; NPZ either. Vertices keep their order.

    Parameters
    ----------
    path : path-like
    clean : bool
        Drop what is not finite, duplicate, unreferenced or has a zero normal, as `clean_scan` does.

    Returns
    -------
    Mesh or PointCloud
        Positions float32 relative to a float64 origin, which is zero for files that hold float32.

    Raises
    ------
    InputError
        No such file, a folder, no permission, or an unknown ending.
    FileFormatError
        An empty, truncated, damaged or foreign file, or one without points.
    """
    reader = _format_of(path, "read")
    path = existing_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the libraries about the damage that is reported below
            scan = reader(path)
    except Error:
        raise
    except MemoryError:
        raise FileFormatError(f"{path}: too large for this machine's memory, or a damaged header") from None
    except Exception as error:  # the libraries raise anything for a damaged file
        raise FileFormatError(f"{path}: damaged or not a {path.suffix} file: {one_line(error)}") from error
    if not len(scan.points):
        raise FileFormatError(f"{path}: holds no points")
    if clean:
        scan = clean_scan(scan, path.name)
        if not len(scan.points):
            raise FileFormatError(f"{path}: holds no finite points")
    return scan


def save_scan(scan: Mesh | PointCloud, path) -> None:
    """Write a scan in the format of `path`'s ending; the file appears whole or not at all.

    World positions are written. What a format cannot hold (colours in STL, say) is left out and named in one log line;
    STL is float32: a survey coordinate of 7,691,239.553 is rounded to the half metre there, which is said too. OBJ with
    a texture also writes NAME.mtl and NAME.png.

    Parameters
    ----------
    scan : Mesh or PointCloud
    path : path-like
        .ply .obj .stl .off .glb .xyz .txt .asc .pts .csv .npy .npz .las .laz

    Raises
    ------
    InputError
        An unknown ending, a cloud for a format of meshes, or a place that cannot be written.
    """
    writer = _format_of(path, "write")
    if not isinstance(scan, Mesh | PointCloud):
        raise InputError(f"scan: expected a Mesh or PointCloud, got {type(scan).__name__}")
    ending = Path(path).suffix.lower()
    if ending == ".stl" and not (isinstance(scan, Mesh) and len(scan.faces)):
        raise InputError(f"{path}: .stl holds triangles, got points only: write .ply, .xyz or .laz")
    lost = [name for name in ("faces", "normals", "colors", "uv", "texture", "scanners", "attributes")
            if name not in _HOLDS[ending] and _has(scan, name)]
    with replacing(path) as temporary:
        writer(scan, temporary)
    if lost:
        log.info("%s: %s cannot hold %s", Path(path).name, ending, ", ".join(lost))
    if ending == ".stl":
        step = float(np.spacing(np.float32(np.abs(scan.bounds).max())))
        if step > 1e-5 * np.ptp(scan.bounds, axis=0).max():
            log.warning("%s: .stl is float32: positions are rounded by up to %.3g, write .ply or .obj", Path(path).name,
                        step / 2)


def _has(scan, name: str) -> bool:
    value = getattr(scan, name, None)
    return value is not None and len(value) > 0


# Format: module, reader, writer. Modules are imported by the format that needs them: laspy and trimesh take 0.3 s each.
_MESH, _LAS = ("meshes", "read_mesh", "write_mesh"), ("las", "read_las", "write_las")
_TEXT, _NUMPY = ("columns", "read_text", "write_text"), ("numpy_files", "read_numpy", "write_numpy")
_FORMATS = {".ply": ("ply", "read_ply", "write_ply"), ".obj": _MESH, ".stl": _MESH, ".glb": _MESH,
            ".gltf": ("meshes", "read_mesh", None), ".off": ("off", "read_off", "write_off"), ".xyz": _TEXT,
            ".txt": _TEXT, ".asc": _TEXT, ".pts": _TEXT, ".csv": _TEXT, ".npy": _NUMPY, ".npz": _NUMPY, ".las": _LAS,
            ".laz": _LAS}
_HOLDS = {".ply": "faces normals colors uv attributes", ".obj": "faces normals colors uv texture", ".stl": "faces",
          ".off": "faces colors", ".glb": "faces normals colors uv texture", ".xyz": "normals colors attributes",
          ".txt": "normals colors attributes", ".asc": "normals colors attributes", ".pts": "colors attributes",
          ".csv": "normals colors attributes", ".npy": "normals colors",
          ".npz": "faces normals colors uv texture scanners attributes", ".las": "normals colors attributes",
          ".laz": "normals colors attributes"}

READS = tuple(_FORMATS)
WRITES = tuple(ending for ending, (*_, writer) in _FORMATS.items() if writer)
POINTS = tuple(ending for ending in WRITES if "faces" not in _HOLDS[ending].split())  # formats without triangles


def _format_of(path, purpose: str):
    try:
        ending = Path(path).suffix.lower()
    except TypeError:
        raise InputError(f"path: expected a file name, got {type(path).__name__}") from None
    known = READS if purpose == "read" else WRITES
    if ending not in known:
        raise InputError(f"{path}: unknown scan format {ending or '(no ending)'}: expected one of {' '.join(known)}")
    module, reader, writer = _FORMATS[ending]
    return getattr(importlib.import_module(f"{__package__}.{module}"), reader if purpose == "read" else writer)
