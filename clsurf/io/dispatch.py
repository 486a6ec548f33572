"""One name for reading any file and one for writing: the ending decides."""

from pathlib import Path

from clsurf.errors import InputError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh
from clsurf.surface.slim import SlimSurface

from . import scans
from .stored import StoredSurface

SURFACES = (".clsurf", ".slim2t")
RANGES = (".conf", ".json")  # and folders of frames
WRITES = (*scans.WRITES, *SURFACES)


def load(path, texture=None):
    """Read a scan or a surface.

    Parameters
    ----------
    path : path-like
        A scan (.ply .obj .stl .off .glb .gltf .xyz .txt .asc .pts .csv .npy .npz .las .laz), cleaned as `clean_scan`
        does, or what `save` wrote: .clsurf, .slim2t. Range images: .conf (Stanford's, with its .ply files beside it),
        or a folder of depth and colour frames or its .json file of intrinsics, as `load_frames` reads them.
    texture : path-like or (h, w, 1 to 4) array, optional
        A picture for a mesh whose file has texture coordinates but names no picture, row 0 on top. Where it comes out
        upside down (glTF counts from the top, and not every program knows), flip the array.

    Returns
    -------
    Mesh, PointCloud, RangeScan, SlimSurface, PatchSurface or ScaleMap

    Raises
    ------
    InputError
        No such file, an unknown ending, or a `texture` for something without texture coordinates.
    FileFormatError
        An empty, truncated, damaged or foreign file.
    """
    if texture is not None:
        from .meshes import with_texture
        return with_texture(load(path), texture, path)
    ending = _ending(path)
    if ending == ".clsurf":
        from .store import load_store
        return load_store(path)
    if ending == ".slim2t":
        from .slim2t import load_slim2t
        return load_slim2t(path)
    if ending == ".conf":
        from .ranges import load_conf
        return load_conf(path)
    if ending == ".json" or (ending not in scans.READS and Path(path).is_dir()):
        from .ranges import load_frames
        return load_frames(path)
    if ending not in scans.READS:
        raise InputError(f"{path}: unknown format {ending or '(no ending)'}: expected one of "
                         f"{' '.join((*scans.READS, *RANGES, *SURFACES))}")
    return scans.load_scan(path)


def save(thing, path) -> None:
    """Write a scan or a surface in the format of the ending; the file appears whole or not at all.

    Parameters
    ----------
    thing : Mesh, PointCloud, RangeScan or surface
    path : path-like
        .clsurf for anything, .slim2t for a SlimSurface, and for scans what `load` reads, except .gltf.

    Raises
    ------
    InputError
        An unknown ending, one that does not fit the kind of `thing`, or a place that cannot be written.
    """
    ending = _ending(path)
    if isinstance(thing, StoredSurface):
        thing = thing.load()
    if ending == ".clsurf":
        from .store import save_store
        save_store(thing, path)
    elif ending == ".slim2t" and isinstance(thing, SlimSurface):
        from .slim2t import save_slim2t
        save_slim2t(thing, path)
    elif ending in scans.WRITES and isinstance(thing, Mesh | PointCloud):
        scans.save_scan(thing, path)
    else:
        allowed = ((*scans.WRITES, ".clsurf") if isinstance(thing, Mesh | PointCloud) else
                   SURFACES if isinstance(thing, SlimSurface) else (".clsurf",))
        raise InputError(f"{path}: a {type(thing).__name__} cannot be written as {ending or '(no ending)'}: expected "
                         f"one of {' '.join(allowed)}")


def _ending(path) -> str:
    try:
        return Path(path).suffix.lower()
    except TypeError:
        raise InputError(f"path: expected a file name, got {type(path).__name__}") from None
