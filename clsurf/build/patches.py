"""Spatial patches from meshes, point clouds and range images: the public function and the choice of the method."""

import importlib
from dataclasses import dataclass
from os import PathLike

import numpy as np

from ..device import open_device
from ..errors import Cancelled, InputError
from ..sizes import parse_bytes
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface

METHODS = {"areas": "patch_areas", "global_views": "patch_views", "local": "patch_local", "ranges": "patch_ranges"}


@dataclass(frozen=True)
class PatchRequest:
    """What the user asked of a conversion; at most one of `patches`, `spacing` and `error` is given."""

    nodes: tuple[int, int] = (17, 17)  # m, n
    patches: int | None = None  # how many
    spacing: float | None = None  # world units between nodes
    error: float | None = None  # root mean square distance, relative to the diagonal
    views: int | None = None  # "global_views" only
    precise: bool = False  # 8 bytes a node in place of 4


def build_patches(scan, nodes=17, patches=None, spacing=None, error=None, views=None, method=None, precise=False,
                  progress=None, device=None, memory_limit=None, out=None, scheduler=None) -> PatchSurface:
    """Turn a scan into spatial patches.

    Parameters
    ----------
    scan : Mesh, PointCloud, RangeScan or path-like
    nodes : int or (int, int)
        Nodes of a patch along its two axes, 2 to 256.
    patches : int, optional
        Number of patches, those along the sharp edges of meshes included; with `spacing` these come in addition.
    spacing : float, optional
        Distance between nodes, world units.
    error : float, optional
        Root mean square distance between scan and patches, relative to the bounding-box diagonal.
    views : int, optional
        Number of views of "global_views".
    method : str, optional
        "areas" (meshes), "local" or "global_views" (point clouds), "ranges" (range images); by default the first that
        fits the scan.
    precise : bool
        RGBA and 32-bit displacements, 8 bytes a node in place of 4.
    progress : callable, optional
        Called as progress(stage, done) with done from 0 to 1; returning False stops the build.
    device : str, Device, ..., optional
    memory_limit, out, scheduler : optional
        As of `build_slim`: a LAS, LAZ, COPC, PLY (without faces) or text scan is streamed to the .clsurf `out`, cell by
        cell, within the memory; patches end where cells do. What is returned is read from there.

    Returns
    -------
    PatchSurface

    Raises
    ------
    InputError
        An option or a scan that cannot be used; more than one of `patches`, `spacing`, `error`.
    Cancelled
        `progress` returned False.

    Notes
    -----
    The paper on spatial patches, sections 4.1, 4.4 and 4.5; "local" and "ranges" are its future work.
    """
    request = checked_request(nodes, patches, spacing, error, views, precise)
    if isinstance(scan, str | PathLike) and method in (None, "local"):
        from .slim import streamed_scan, wants_stream
        limit = parse_bytes(memory_limit)
        if wants_stream(scan, limit, out):
            return streamed_scan(scan, out, limit, progress, device, patches=request, scheduler=scheduler)
    if not isinstance(scan, Mesh | PointCloud) and not hasattr(scan, "images"):
        scan = _loaded(scan)
    if out is not None:
        from ..io import save
        surface = build_patches(scan, nodes, patches, spacing, error, views, method, precise, progress, device)
        save(surface, out)
        return surface
    method = _method_of(scan) if method is None else method
    if method not in METHODS:
        raise InputError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    if views is not None and method != "global_views":
        raise InputError(f"views: expected with method global_views only, got {method}")
    scan = _fitting(scan, method)
    module = importlib.import_module(f"{__package__}.{METHODS[method]}")
    return module.convert(scan, request, open_device(device), _step(progress))


def _step(progress):
    """Return the function step(fraction, what) that a conversion calls; it stops the build where the caller wants."""
    def step(fraction, what):
        if progress is not None and progress(what, fraction) is False:
            raise Cancelled("build_patches: stopped by the progress callback")
    return step


def _fitting(scan, method):
    """Return what `method` takes: range images as points where it wants points. Raise InputError where nothing fits."""
    if method == "ranges" and not hasattr(scan, "images"):
        raise InputError(f"method ranges: expected range images, got a {type(scan).__name__}: use local")
    if method == "areas" and not (isinstance(scan, Mesh) and len(scan.faces)):
        raise InputError("method areas: expected a mesh with faces, got none: use local")
    return scan.to_points() if method in ("local", "global_views") and hasattr(scan, "images") else scan


def _loaded(path):
    from ..io import load
    scan = load(path) if isinstance(path, str | PathLike) else path
    if not isinstance(scan, Mesh | PointCloud) and not hasattr(scan, "images"):
        raise InputError("scan: expected a Mesh, a PointCloud, a RangeScan or the path of a scan, got "
                         f"{type(scan).__name__}")
    return scan


def _method_of(scan) -> str:
    if hasattr(scan, "images"):
        return "ranges"
    return "areas" if isinstance(scan, Mesh) and len(scan.faces) else "local"


def checked_request(nodes, patches, spacing, error, views, precise) -> PatchRequest:
    """Return the request, or raise InputError."""
    try:
        m, n = (nodes, nodes) if np.ndim(nodes) == 0 else nodes
        whole = int(m) == m and int(n) == n
    except (TypeError, ValueError):
        whole = False
    if not whole or not (2 <= m <= 256 and 2 <= n <= 256):
        raise InputError(f"nodes: expected a number, or two, from 2 to 256, got {nodes!r}")
    one_of = (("patches", patches), ("spacing", spacing), ("error", error))
    given = [name for name, value in one_of if value is not None]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)}: expected only one of patches, spacing and error")
    for name, value in (*one_of, ("views", views)):
        if value is None:
            continue
        number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not number or not 0 < value < np.inf or (name in ("patches", "views") and int(value) != value):
            kind = "whole number" if name in ("patches", "views") else "number"
            raise InputError(f"{name}: expected a positive {kind}, got {value!r}")
    return PatchRequest((int(m), int(n)), None if patches is None else int(patches), spacing, error,
                        None if views is None else int(views), bool(precise))
