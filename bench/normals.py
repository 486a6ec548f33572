"""Normals: time and quality of `estimate_normals`, beside Open3D and SciPy where asked.

Run alone: python -m bench.normals [device]
"""

import json
import sys
import time

import numpy as np

from bench.happy import data_folder, load_happy
from clsurf.build.normals import estimate_normals
from clsurf.device import open_device
from clsurf.surface.cloud import PointCloud


def run(device=None, quick=False, peers=False) -> dict:
    """Measure normals of the dragon's vertices and of the raw happy scans.

    Parameters
    ----------
    device : optional
    quick : bool
        One run instead of the median of three.
    peers : bool
        Measure SciPy, and Open3D where it is installed, on the dragon as well.

    Returns
    -------
    dict
        Per scene: count, seconds, points per second and quality. Angles are in degrees; `wrong` is the share of normals
        whose sign disagrees with the mesh's normal (dragon) or the own range image's sensor direction (happy).
    """
    device = open_device(device)
    repeats = 1 if quick else 3
    return {"dragon": _dragon(device, repeats, peers), "happy": _happy(device, repeats)}


def _timed(function, repeats):
    """Return the median seconds of `repeats` runs after a first one, and the last result."""
    function()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)), result


def _dragon(device, repeats, peers) -> dict:
    import trimesh

    mesh = trimesh.load(data_folder() / "dragon" / "dragon.ply", process=False)
    points, truth = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.vertex_normals)
    cloud = PointCloud(points)
    seconds, result = _timed(lambda: estimate_normals(cloud, device=device), repeats)
    bare, _ = _timed(lambda: estimate_normals(cloud, orient=None, device=device), repeats)
    out = {"scene": "dragon, vertices", "count": len(points), "seconds": seconds, "seconds_without_orientation": bare,
           **_compared(result.normals, truth)}
    if peers:
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
    return {"scene": "happy, 15 raw range images", "count": len(points), "seconds": seconds,
            "wrong": float(wrong.mean())}


def _scipy(points, truth) -> dict:
    """Measure the same estimate with a k-d tree and NumPy; no orientation."""
    from scipy.spatial import cKDTree

    start = time.perf_counter()
    near = points[cKDTree(points).query(points, 16, workers=-1)[1]].astype(np.float64)
    near -= near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]
    return {"seconds_without_orientation": time.perf_counter() - start, **_compared(normals, truth)}


def _open3d(points, truth, repeats) -> dict:
    try:
        import open3d
    except ImportError:
        return {}
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    search = open3d.geometry.KDTreeSearchParamKNN(16)
    bare, _ = _timed(lambda: cloud.estimate_normals(search), min(repeats, 2))
    start = time.perf_counter()
    cloud.orient_normals_consistent_tangent_plane(16)
    orientation = time.perf_counter() - start
    return {"open3d": {"seconds_without_orientation": bare, "seconds": bare + orientation,
                       **_compared(np.asarray(cloud.normals), truth)}}


if __name__ == "__main__":
    print(json.dumps(run(sys.argv[1] if len(sys.argv) > 1 else None, peers="--peers" in sys.argv), indent=1))
