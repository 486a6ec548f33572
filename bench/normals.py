"""The job `normals`: time and quality of `estimate_normals`, beside SciPy and, where it is installed, Open3D."""

import time

import numpy as np

from clsurf.build.normals import estimate_normals
from clsurf.device import Profile
from clsurf.surface.cloud import PointCloud

from . import peers, scenes
from .build import WrongAnswer
from .happy import load_happy
from .table import print_table, profile_rows

HAPPY = "range_scans/happy/happyStandRight.conf"


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of normals; `device` is an opened one.

    Returns
    -------
    dict
        Per scene: count, seconds (median of three after a first run) and quality. Angles are in degrees; ``wrong`` is
        the share of normals whose sign disagrees with the mesh's normal, or, for the raw scans of happy, with the
        direction to the sensor of their own range image.
    """
    repeats = 1 if quick else 3
    name = scenes.chosen(("dragon",), quick)[0]
    figures = {name: _vertices(scenes.scene(name).scan, device, repeats, with_peers=not quick)}
    if not quick and (scenes.data_folder() / HAPPY).exists():
        figures["happy"] = _happy(device, repeats)
    elif not quick:
        print("scans missing: happy (CLSURF_DATA names their folder)")
    for label, found in figures.items():
        if not found["wrong"] < 0.2:
            raise WrongAnswer(f"bench normals {label}: expected under 20 % of wrong signs, got {found['wrong']:.1%}: "
                              "mend the orientation before timing it")
    show(figures)
    if profile:
        device.profile = Profile()
        try:
            estimate_normals(PointCloud(scenes.scene(name).scan.vertices), device=device)
            print(f"\nstages of the normals of {name} (each launch waits for the one before)")
            print_table(("kernel or stage", "calls", "min ms", "median ms", "share"), profile_rows(device.profile))
        finally:
            device.profile = None
    return figures


def show(figures: dict) -> None:
    """Print the figures."""
    rows = []
    for name, found in figures.items():
        for label, part in ((name, found), *((f"  {peer}", part) for peer, part in found.get("peers", {}).items())):
            whole, bare, angle = (part.get(key) for key in ("seconds", "seconds_without_orientation", "median_angle"))
            rows.append((label, f"{found['count']:,}", f"{whole:.2f}" if whole else "-", f"{bare:.2f}" if bare else "-",
                         f"{part['wrong']:.2%}" if whole else "-", f"{angle:.2f}" if angle is not None else "-"))
    print_table(("scene", "points", "s", "s unoriented", "wrong", "median deg"), rows)


def _timed(function, repeats):
    """Return the median seconds of `repeats` runs after a first one, and the last result."""
    function()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)), result


def _vertices(mesh, device, repeats, with_peers) -> dict:
    points, truth = np.asarray(mesh.vertices), np.asarray(mesh.normals, np.float64)
    cloud = PointCloud(points)
    seconds, result = _timed(lambda: estimate_normals(cloud, device=device), repeats)
    bare, _ = _timed(lambda: estimate_normals(cloud, orient=None, device=device), repeats)
    out = {"count": len(points), "seconds": seconds, "seconds_without_orientation": bare,
           **_compared(result.normals, truth)}
    if with_peers:
        out["peers"] = {"scipy": _scipy(points, truth), **_open3d(points, truth, repeats)}
    return out


def _compared(normals, truth) -> dict:
    dot = np.einsum("ij,ij->i", normals, truth)
    angle = np.degrees(np.arccos(np.clip(np.abs(dot), 0, 1)))
    return {"wrong": float((dot < 0).mean()),
            "mean_angle": float(angle.mean()), "median_angle": float(np.median(angle))}


def _happy(device, repeats) -> dict:
    points, sensor = load_happy()
    cloud = PointCloud(points)
    seconds, result = _timed(lambda: estimate_normals(cloud, device=device), repeats)
    wrong = np.einsum("ij,ij->i", result.normals, sensor) < 0
    return {"count": len(points), "seconds": seconds, "wrong": float(wrong.mean())}


def _scipy(points, truth) -> dict:
    """Measure the same estimate with a k-d tree and NumPy; no orientation."""
    from scipy.spatial import cKDTree

    start = time.perf_counter()
    near = points[cKDTree(points).query(points, 16, workers=-1)[1]].astype(np.float64)
    near -= near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    return {"seconds_without_orientation": time.perf_counter() - start, **_compared(normals, truth)}


def _open3d(points, truth, repeats) -> dict:
    open3d = peers.open3d()
    if open3d is None:
        print("peer Open3D: not installed (pip install clsurf[bench])")
        return {}
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    search = open3d.geometry.KDTreeSearchParamKNN(16)
    bare, _ = _timed(lambda: cloud.estimate_normals(search), min(repeats, 2))
    start = time.perf_counter()
    cloud.orient_normals_consistent_tangent_plane(16)
    orientation = time.perf_counter() - start
    return {"open3d": {"seconds_without_orientation": bare, "seconds": bare + orientation,
                       **_compared(np.asarray(cloud.normals), truth)}}
