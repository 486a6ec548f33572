"""Normals of point clouds: estimated from exact nearest neighbours and oriented."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..device import open_device
from ..errors import Cancelled, InputError
from ..surface.arrays import extent_of
from ..surface.cloud import PointCloud
from ..surface.ranges import RangeScan
from .neighbours import LARGEST_K, box_tree, covariance, sampled_covariance
from .orientation import oriented_to, signs_of, voxel_means

ORIENTS = ("auto", "scanners", "graph", "up")
LIDAR_ATTRIBUTES = {"classification", "return_number", "number_of_returns", "scan_angle", "scan_angle_rank"}
NOISY = 0.38  # see suitable_k
# Side of a voxel over (k-th distance / sqrt(k)): about 2.8 point spacings, 1.25 times the 16th distance. 4, 5, 6, 8:
# raw scans 0.97, 0.99, 1.02, 1.10 % wrong with 385, 250, 174, 97 thousand voxels.
VOXEL = 5.0
FLAT = 0.3  # height over extent below which a lidar cloud is seen from above


def estimate_normals(cloud: PointCloud, k="auto", orient="auto", progress=None, device=None) -> PointCloud:
    """Return `cloud` with unit normals estimated from the k nearest distinct points of each, and oriented.

    The normal is the direction in which the k nearest points (the point itself counted) spread least.

    Parameters
    ----------
    cloud : PointCloud or RangeScan
        Points, finite; range images become a cloud with scanner positions first. Their order, colours and
        attributes are kept, normals already there are replaced.
    k : int or "auto"
        Neighbours, 3 to 128; all points where there are fewer. "auto": 16, or 48 where the noise of neighbouring
        points is as large as their spacing.
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
    if isinstance(cloud, RangeScan):
        cloud = cloud.to_points()
    if not hasattr(cloud, "points"):
        raise InputError(f"cloud: expected a PointCloud, got {cloud!r:.60}: clsurf.load reads one from a file")
    orient = _checked_orient(cloud, orient)
    if k != "auto" and not (isinstance(k, int | np.integer) and 3 <= k <= LARGEST_K):
        raise InputError(f"k: expected 'auto' or 3 to {LARGEST_K} neighbours, got {k!r}")
    if len(cloud.points) == 0:
        return dataclasses.replace(cloud, normals=np.zeros((0, 3), np.float32))
    device = open_device(device)
    report = lambda share: _report(progress, share)  # noqa: E731
    report(0.0)
    points, inverse = distinct(cloud.points)
    tree = box_tree(points, device)
    k = suitable_k(tree) if k == "auto" else k
    found = covariance(tree, k)
    report(0.3)
    normals = found.normals.copy()
    if isinstance(orient, str) and orient == "graph":
        _orient_by_graph(points, normals, VOXEL * float(np.median(found.reach)) / np.sqrt(k), device)
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
        try:
            viewpoint = np.asarray(orient, np.float64)
        except (TypeError, ValueError):
            viewpoint = np.empty(0)
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
    extent = extent_of(cloud.points) if len(cloud.points) else np.zeros(3)
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


def suitable_k(tree) -> int:
    """Return 16, or 48 where 16 points spread across the surface nearly as much as along it.

    The median ratio of the two spreads is 0.03-0.13 on clean scans, 0.2-0.34 on scans with noise added for tests of
    smoothing, and 0.45 on 15 raw range images laid over each other, where 48 instead of 16 neighbours halve the wrong
    signs.
    """
    spread = sampled_covariance(tree, 16, 5000).eigenvalues
    with np.errstate(invalid="ignore"):  # squares of huge coordinates are infinite
        ratio = np.sqrt(np.median(spread[:, 0] / np.maximum(spread[:, 1], np.finfo(np.float32).tiny)))
    return 48 if ratio > NOISY else 16


def _orient_by_graph(points, normals, size, device) -> None:
    """Orient `normals` (n, 3) in place through voxels of side `size`."""
    if not size > 0:
        return  # all points at one place
    voxel, means, axes = voxel_means(points, normals, size)
    axes *= signs_of(means, axes, size, device=device)[:, None]
    oriented_to(normals, axes[voxel])
