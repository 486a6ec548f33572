"""Sparse low-degree implicits from scattered points (SLIM).

Source: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces with Applications to High Quality Rendering,
Feature Extraction, and Smoothing", SGP 2005, section 2.
"""

import math
import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..device import open_device
from ..errors import Cancelled, DeviceMemoryError, InputError
from ..io import load, save
from ..io.cleaning import first_of_duplicates
from ..sizes import parse_bytes
from ..surface.arrays import finite_rows, lengths_of
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.ranges import RangeScan
from ..surface.slim import COEFFICIENTS
from .large_faces import coarse_edges, large_faces, with_edges, with_middles
from .point_tree import build_point_tree
from .radius import LEAST_PENALTY, automatic_error, measure_noise, robust_box
from .slim_levels import Points, assemble, build_levels, with_bound

LOADED_BYTES, BYTES_PER_LOADED_POINT = 330_000_000, 200  # of a process that loads and builds, normals estimated
LEAST_LINE = 20  # bytes of a point in text
BYTES_PER_POINT, FIXED_BYTES = 64, 20_000_000  # of a build's memory beyond the scan


def build_slim(scan, degree=2, error=None, weight=None, memory_limit=None, progress=None, device=None, tolerance=None,
               out=None, scheduler=None):
    """Build a multi-scale SLIM surface from a scan.

    Parameters
    ----------
    scan : Mesh, PointCloud, RangeScan, str or PathLike
        A path is read with `clsurf.load`. Normals are taken from the scan, computed from the faces, or estimated, in
        this order; those of range images face the sensors. Points that are not finite or have no normal are left out.
    degree : int
        Of the local polynomials: 1, 2 or 3.
    error : float or "auto", optional
        T_MDL (paper, equation 3), the trade-off between accuracy and sparseness, relative to the diagonal of the
        bounding box without outliers; "auto": from the scan's noise and spacing. By default 0.01, or "auto" where the
        scan is streamed.
    weight : (n,) array_like, optional
        Confidence of every point, 0 or more; 0 leaves a point out.
    memory_limit : int or str, optional
        Bytes that the build may take beyond the scan, such as "2GB"; for a path, those of the whole process: a scan
        that does not fit is streamed.
    progress : callable, optional
        Called as progress(stage, done) with done from 0 to 1; returning False stops the build.
    device : None, str or Device
    tolerance : float, optional
        World units: points that the surface does not come so near get surfels of their own, down to a disc each.
        Vegetation and wires in airborne lidar need it; a quarter of the point spacing is kept by 99 % of the points.
    out : path-like, optional
        A .clsurf to write. With a path to LAS, LAZ, COPC, PLY or text as `scan`, the scan is streamed: read once in
        chunks, cut into cells and written cell by cell into the folder OUT.part, which gets its name when it is whole.
        The same call goes on with an unfinished one. Faces are ignored then.
    scheduler : str or distributed.Client, optional
        With `out`: a Dask scheduler whose workers build the cells, "tcp://host:8786", or "local" for processes of this
        machine. The workers see the same files.

    Returns
    -------
    SlimSurface, or StoredSurface where it was streamed to `out`
        `bound` holds for `bound_share` of the scan's points. The same input gives the same bytes on one device.

    Raises
    ------
    InputError
        No usable point, a file that is missing, damaged or holds a surface instead of a scan, a scan without extent,
        or an option out of range.
    DeviceMemoryError
        More memory needed than the limit or the device allows.
    Cancelled
        `progress` returned False; nothing is left behind, except for the OUT.part of a streamed build.
    """
    if degree not in COEFFICIENTS:
        raise InputError(f"degree: expected 1, 2 or 3, got {degree!r}")
    if error not in ("auto", None) and not (isinstance(error, int | float | np.number) and 0 < error < 1):
        raise InputError(f"error: expected a share of the diagonal between 0 and 1, or 'auto', got {error!r}")
    if tolerance is not None and not (isinstance(tolerance, int | float | np.number) and 0 < tolerance < math.inf):
        raise InputError(f"tolerance: expected a distance in world units above 0, got {tolerance!r}")
    if isinstance(scan, str | os.PathLike):
        limit = parse_bytes(memory_limit)
        if weight is None and wants_stream(scan, limit, out):
            return streamed_scan(scan, out, limit, progress, device, degree=degree, error=error or "auto",
                                 tolerance=tolerance, scheduler=scheduler)
        scan = load(scan)
    if scheduler is not None:
        raise InputError("scheduler: expected the path of a LAS, LAZ, COPC, PLY or text scan and out=, got a "
                         f"{type(scan).__name__}")
    if out is not None:
        surface = build_slim(scan, degree, error, weight, memory_limit, progress, device, tolerance)
        save(surface, out)
        return surface
    error = 0.01 if error is None else error
    if isinstance(scan, RangeScan):
        scan = scan.to_points()
    if not isinstance(scan, Mesh | PointCloud):
        raise InputError("scan: expected a Mesh, a PointCloud, a RangeScan or the path of a scan, got "
                         f"{type(scan).__name__}")
    device = open_device(device)
    report = Reporter(progress)
    report("points", 0.0)
    points = usable_points(scan, weight, device)
    try:
        check_room(device, len(points.position), memory_limit, points)
    except DeviceMemoryError:
        if points.weights is not None or parse_bytes(memory_limit) is not None:
            raise
        return in_parts(points, scan.origin, degree, error, tolerance, report, device)
    box = robust_box(points.position)
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    if not diagonal > 0:
        raise InputError("scan: expected points with some extent, got all of them at one place")
    middle = box.mean(axis=0).astype(np.float32)
    tree = build_point_tree(points.position, points.normals, middle, 1.0 / diagonal, device, points.weights)
    noise = measure_noise(tree)
    error = automatic_error(noise) if error == "auto" else float(error)
    report("points", 1.0)
    levels = build_levels(tree, degree, max(noise.variance * error**2, LEAST_PENALTY), noise, report,
                          tolerance=math.inf if tolerance is None else tolerance / diagonal)
    surface = assemble(levels, points, tree, degree, error, diagonal, scan.origin)
    report("bound", 0.0)
    surface = with_bound(surface, tree, middle)
    report("bound", 1.0)
    return surface


def wants_stream(path, limit: int | None, out) -> bool:
    """Return whether a scan's file is to be streamed: where there is a place to stream to, or where memory lacks."""
    from ..io.chunks import STREAMED, open_source
    if Path(path).suffix.lower() not in STREAMED or (out is None and limit is None):
        return False
    source = open_source(path)
    if out is not None and not source.faces:
        return True
    count = source.count or Path(path).stat().st_size // LEAST_LINE
    return limit is not None and LOADED_BYTES + count * BYTES_PER_LOADED_POINT > limit


def streamed_scan(path, out, limit: int | None, progress, device, **options):
    """Return the surface of a streamed scan: opened where `out` names its place, otherwise whole in memory."""
    from ..io.stored import StoredSurface
    from .streamed import build_streamed
    report = Reporter(progress)
    if out is not None:
        place = build_streamed(path, out, memory_limit=limit, report=report, device=device, **options)
        return load(place) if "patches" in options else StoredSurface(place)
    with tempfile.TemporaryDirectory(prefix="clsurf-") as folder:
        place = build_streamed(path, Path(folder) / "surface.clsurf", memory_limit=limit, report=report, device=device,
                               **options)
        return load(place)


def in_parts(points: Points, origin, degree: int, error, tolerance, report, device):
    """Return the surface of points that the device does not hold at once, built cell by cell in a temporary folder."""
    from ..io.chunks import CloudSource
    from .stream_sizes import sizes_for
    from .streamed import build_streamed
    sizes = sizes_for(device)
    source = CloudSource(points.position, points.normals, points.colors, origin, sizes.chunk)
    with tempfile.TemporaryDirectory(prefix="clsurf-") as folder:
        return load(build_streamed(source, Path(folder) / "surface.clsurf", degree, error, tolerance, report=report,
                                   device=device, sizes=sizes))


class Reporter:
    """Passes progress on to the caller's callback, and stops the build where that returns False."""

    def __init__(self, progress=None):
        self.progress = progress

    def __call__(self, stage: str, done: float) -> None:
        """Report `done` (0 to 1) of `stage`; raises Cancelled."""
        if self.progress is not None and self.progress(stage, done) is False:
            raise Cancelled("build_slim: stopped by the progress callback")


def usable_points(scan, weight, device) -> Points:
    """Return the points of `scan` that are finite and have a normal and a weight, with what belongs to them.

    The middles of a mesh's large faces, and of all edges of a coarse one, are points too.
    """
    weights = None
    if weight is not None:
        weights = np.ascontiguousarray(weight, np.float32)
        if weights.shape != (len(scan.points),) or not (np.isfinite(weights) & (weights >= 0)).all():
            raise InputError(f"weight: expected {len(scan.points)} numbers of 0 or more, got shape {weights.shape}")
    position, normals = scan.points, scan.normals
    colors = vertex_colors(scan)
    if normals is None and isinstance(scan, Mesh) and len(scan.faces):
        normals = face_normals(position, scan.faces)
    if isinstance(scan, Mesh) and len(scan.faces):
        edges = coarse_edges(position, normals, scan.faces)
        large = large_faces(position, scan.faces)
        position, normals, colors, weights = with_edges(position, normals, colors, weights, edges)
        position, normals, colors, weights = with_middles(position, normals, colors, weights, large)
    usable = np.ones(len(position), bool)
    if not np.isfinite(position).all():
        usable &= finite_rows(position)
    if weights is not None:
        usable &= weights > 0
    if normals is None and usable.any():
        normals = estimated_normals(scan, usable, device)
    if normals is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            length2 = np.einsum("ij,ij->i", normals, normals)
        usable &= (length2 > 0) & np.isfinite(length2)
    if not usable.any():
        raise InputError("scan: expected at least one point with a normal, got none")
    if usable.all():
        return Points(position, normals, colors, weights)
    pick = lambda array: None if array is None else array[usable]  # noqa: E731
    return Points(position[usable], normals[usable], pick(colors), pick(weights))


def estimated_normals(scan, usable, device) -> NDArray:
    """Return normals (n, 3) estimated from the usable points; 0 for the others."""
    from .normals import estimate_normals

    scanners = getattr(scan, "scanners", None)
    cloud = PointCloud(scan.points[usable], origin=scan.origin,
                       scanners=None if scanners is None else scanners[usable])
    found = estimate_normals(cloud, device=device)
    normals = np.zeros((len(scan.points), 3), np.float32)
    normals[usable] = found.normals
    return normals


def vertex_colors(scan) -> NDArray | None:
    """Return the colours (n, 4) uint8 of the scan's points: its own, or those of its texture; None without."""
    if scan.colors is not None:
        return scan.colors
    if not isinstance(scan, Mesh) or scan.uv is None or scan.texture is None:
        return None
    height, width = scan.texture.shape[:2]
    u, v = np.nan_to_num(scan.uv, posinf=0, neginf=0).T % 1.0
    return scan.texture[np.minimum(((1 - v) * height).astype(int), height - 1),
                        np.minimum((u * width).astype(int), width - 1)]


def check_room(device, count: int, memory_limit, points: Points):
    """Raise DeviceMemoryError where building from `count` points takes more than the limit or the device has."""
    per_point = BYTES_PER_POINT + (16 if points.colors is not None else 0) + (4 if points.weights is not None else 0)
    needed = FIXED_BYTES + count * per_point
    limit = parse_bytes(memory_limit)
    if limit is not None and needed > limit:
        raise DeviceMemoryError(f"memory_limit: the build of {count:,} points needs {needed / 1e6:.0f} MB, got "
                                f"{limit / 1e6:.0f} MB: raise the limit or build from fewer points")
    device.check_memory(points=24 * count, tree=needed - 24 * count)


def face_normals(points: NDArray, faces: NDArray) -> NDArray:
    """Return vertex normals (n, 3) float32: area-weighted means over the faces, 0 for unused vertices.

    Vertices at the same place (texture seams) share all their faces: of its own ones alone, a seam's vertex has a
    one-sided normal, up to 43 degrees off at 511 of the 3,225 vertices of spot.obj.
    """
    a, b, c = (points[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    scale = np.abs(cross).max()
    cross = (cross / (scale if scale > 0 else 1)).astype(np.float32)
    first, target = first_of_duplicates(points)
    split = len(first) < len(points)
    rows = sparse.csr_matrix((np.ones(faces.size, np.float32), (target[faces] if split else faces).ravel(),
                              np.arange(0, faces.size + 1, 3)), shape=(len(faces), len(first)))
    normals = rows.T @ cross
    length = lengths_of(normals, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    if not split:
        return normals
    used = np.zeros(len(points), bool)
    used[faces] = True
    return np.where(used[:, None], normals[target], np.float32(0))
