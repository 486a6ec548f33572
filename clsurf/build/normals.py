"""Normals of point clouds: estimated from exact nearest neighbours and oriented."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..device import open_device
from ..errors import Cancelled, InputError
from ..surface.cloud import PointCloud
from .neighbours import box_tree, covariance
from .orientation import oriented_to, signs_of, voxel_means

ORIENTS = ("auto", "scanners", "graph", "up")
LIDAR_ATTRIBUTES = {"classification", "return_number", "number_of_returns", "scan_angle", "scan_angle_rank"}
FLAT = 0.3  # height over extent below which a lidar cloud is seen from above


def estimate_normals(cloud: PointCloud, k=16, orient="auto", progress=None, device=None) -> PointCloud:
    """Return `cloud` with unit normals estimated from the k nearest distinct points of each, and oriented.

    The normal is the direction in which the k nearest points (the point itself counted) spread least.

    Parameters
    ----------
    cloud : PointCloud
        Points, finite; their order, colours and attributes are kept, normals already there are replaced.
    k : int
        Neighbours, 3 to 128; all points where there are fewer.
    orient : str, (3,) array_like or None
        "scanners": toward `cloud.scanners`. "up": +z. "graph": consistent between neighbours and outward. A (3,)
        position in world space: toward that viewpoint. None: signs without meaning. "auto": "scanners" where they are
        known, "up" for flat lidar clouds, otherwise "graph".
    progress : callable, optional
        Called as progress(stage, share done); returning False stops the work.
    device : optional
        See `clsurf.device.open_device`.

    Returns
    -------
    PointCloud
        With normals (n, 3) float32. Where the surface is not defined (one point, identical or collinear points) they
        are unit vectors all the same.

    Raises
    ------
    InputError
        NaN or infinity among the points, k out of range, or an unknown `orient`.
    Cancelled
        `progress` returned False.
    """
    orient = _checked_orient(cloud, orient)
    if k < 3:
        raise InputError(f"k: expected at least 3 neighbours for a normal, got {k}")
    if len(cloud.points) == 0:
        return dataclasses.replace(cloud, normals=np.zeros((0, 3), np.float32))
    device = open_device(device)
    report = lambda share: _report(progress, share)  # noqa: E731
    report(0.0)
    points, inverse = distinct(cloud.points)
    found = covariance(box_tree(points, device), k)
    report(0.3)
    normals = found.normals.copy()
    if isinstance(orient, str) and orient == "graph":
        _orient_by_graph(points, normals, found.reach, device)
    if inverse is not None:
        normals = normals[inverse]
    if isinstance(orient, str) and orient == "scanners":
        oriented_to(normals, cloud.scanners - cloud.points)
    elif isinstance(orient, str) and orient == "up":
        oriented_to(normals, np.array([0, 0, 1], np.float32))
    elif isinstance(orient, np.ndarray):
        oriented_to(normals, (orient - cloud.origin).astype(np.float32) - cloud.points)
    report(1.0)
    return dataclasses.replace(cloud, normals=normals)


def _report(progress, share) -> None:
    if progress is not None and progress("normals", share) is False:
        raise Cancelled("normals: stopped by the caller")


def _checked_orient(cloud, orient):
    """Return "scanners", "graph", "up", a (3,) float64 viewpoint, or None."""
    if orient is None:
        return None
    if not isinstance(orient, str):
        viewpoint = np.asarray(orient, np.float64)
        if viewpoint.shape != (3,) or not np.isfinite(viewpoint).all():
            raise InputError(f"orient: expected a viewpoint of 3 finite numbers, got {orient!r}")
        return viewpoint
    if orient not in ORIENTS:
        raise InputError(f"orient: expected {', '.join(ORIENTS)}, a viewpoint or None, got {orient!r}")
    if orient == "scanners" and cloud.scanners is None:
        raise InputError("orient: expected a cloud with scanner positions, got one without: use orient='auto'")
    if orient != "auto":
        return orient
    if cloud.scanners is not None:
        return "scanners"
    extent = np.ptp(cloud.points, axis=0) if len(cloud.points) else np.zeros(3)
    flat = extent[2] < FLAT * max(extent[0], extent[1])
    return "up" if flat and LIDAR_ATTRIBUTES & set(cloud.attributes) else "graph"


def distinct(points) -> tuple[NDArray, NDArray | None]:
    """Return the distinct rows of `points` (n, 3) float32, and the row (n,) of each point; None where all differ.

    Scans rounded to a lattice repeat points: k neighbours at one place would have no normal.
    """
    words = (points + np.float32(0)).view(np.uint32)  # -0 becomes 0
    key = words[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    key ^= (words[:, 1] + (key >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    key ^= (words[:, 2] + (key >> np.uint64(31))) * np.uint64(0x94D049BB133111EB)
    sort = np.sort(key)
    if not (sort[1:] == sort[:-1]).any():
        return points, None
    kept, inverse = np.unique(points + np.float32(0), axis=0, return_inverse=True)
    return (kept, inverse.ravel()) if len(kept) < len(points) else (points, None)


def _orient_by_graph(points, normals, reach, device) -> None:
    """Orient `normals` (n, 3) in place through voxels of 1.5 times the median distance to the k-th neighbour."""
    voxel, means, axes = voxel_means(points, normals, 1.5 * float(np.median(reach)))
    axes *= signs_of(means, axes, 8, device)[:, None]
    oriented_to(normals, axes[voxel])
