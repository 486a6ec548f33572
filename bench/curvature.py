"""The job `curvature`: error and time of `clsurf.curvature` where the truth is known, beside MeshLab's filters.

Errors are root mean squares of the mean curvature over that of the true one, on tori of 51,200 points, exact and with
noise relative to the diagonal. Nothing is set by hand; MeshLab's filters have their defaults but for the scale of APSS.
"""

import time

import numpy as np
from numpy.typing import NDArray

import clsurf
from clsurf.device import Profile
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh

from . import scenes
from .build import WrongAnswer
from .table import print_table, profile_rows

MAJOR, MINOR = 1.0, 0.4
NOISE = (0.0, 0.001, 0.003)
GOALS = {0.0: (0.0005, 0.00005), 0.001: (0.025, 0.02)}  # floor, aim
SECONDS = (0.4, 0.1)  # per 100K points on PoCL: floor, aim
SCANS = ("bunny", "dragon")
APSS_SCALES = (2.0, 8.0)  # the default; what does best with 0.1 % noise


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of curvature; `device` is an opened one.

    Returns
    -------
    dict
        ``torus`` (points with normals, evenly spread) and ``mesh`` (a grid of 320 x 160, normals from its faces): per
        noise ``rms``, ``largest`` (of the same), seconds per 100K points (median of five after a first run), and the
        ``peers`` of the mesh. ``scans``: points and seconds.
    """
    size = (96, 48) if quick else (320, 160)
    cloud = clsurf.models.torus(size[0] * size[1], MAJOR, MINOR)
    vertices, faces = torus_grid(*size)
    figures = {"torus": {}, "mesh": {}, "scans": {}}
    for noise in NOISE[:2] if quick else NOISE:
        points = noisy(cloud.points, noise)
        figures["torus"][str(noise)] = _measured(PointCloud(points, cloud.normals), mean_of_torus(cloud.points), device,
                                                 quick)
        scan = Mesh(noisy(vertices, noise), faces)
        figures["mesh"][str(noise)] = _measured(scan, mean_of_torus(vertices), device, quick)
        if not quick and noise in GOALS:
            figures["mesh"][str(noise)]["peers"] = meshlab(scan, mean_of_torus(vertices))
    for kind in ("torus", "mesh"):
        for noise, found in figures[kind].items():
            if not found["rms"] < (0.2 if quick or float(noise) not in GOALS else 4 * GOALS[float(noise)][0]):
                raise WrongAnswer(f"bench curvature {kind} {noise}: expected next to the true curvature, got an error "
                                  f"of {found['rms']:.2g} of it: mend it before timing it")
    if not quick:
        for name in SCANS:
            if scenes.available(name):
                scan = scenes.scene(name).scan
                figures["scans"][name] = {"points": len(scan.points), **_timed(scan, device, 3)}
    show(figures)
    if profile:
        device.profile = Profile()
        try:
            clsurf.curvature(cloud, device=device)
            print("\nstages of the curvature of the torus (each launch waits for the one before)")
            print_table(("kernel or stage", "calls", "min ms", "median ms", "share"), profile_rows(device.profile))
        finally:
            device.profile = None
    return figures


def torus_grid(around: int, across: int) -> tuple[NDArray, NDArray]:
    """Return vertices (v, 3) float32 and faces of a torus with so many vertices around the axis and the tube."""
    u, v = np.meshgrid(2 * np.pi * np.arange(around) / around, 2 * np.pi * np.arange(across) / across, indexing="ij")
    ring = MAJOR + MINOR * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), MINOR * np.sin(v)], axis=-1).reshape(-1, 3)
    i = np.arange(around * across).reshape(around, across)
    a, b, c, d = (np.roll(i, shift, (0, 1)).ravel() for shift in ((0, 0), (-1, 0), (-1, -1), (0, -1)))
    return vertices.astype(np.float32), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def mean_of_torus(points: NDArray) -> NDArray:
    """Return the mean curvature (n,) of the torus at `points` (n, 3) on it, outward normals."""
    x, y, z = np.asarray(points, np.float64).T
    ring = np.hypot(x, y)
    cosine = (ring - MAJOR) / np.hypot(ring - MAJOR, z)
    return (1 / MINOR + cosine / (MAJOR + MINOR * cosine)) / 2


def noisy(points: NDArray, noise: float) -> NDArray:
    """Return `points` with normally distributed noise of this share of the diagonal in each coordinate."""
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    moved = points + noise * diagonal * np.random.default_rng(1).standard_normal(points.shape)
    return moved.astype(np.float32) if noise else points


def _errors(mean: NDArray, truth: NDArray) -> dict:
    size = np.sqrt(np.mean(truth**2))
    return {"rms": float(np.sqrt(np.mean((mean - truth) ** 2)) / size),
            "largest": float(np.abs(mean - truth).max() / size)}


def _measured(scan, truth: NDArray, device, quick: bool) -> dict:
    errors = _errors(clsurf.curvature(scan, device=device).mean, truth)
    return {**errors, **_timed(scan, device, 2 if quick else 5)}


def _timed(scan, device, runs: int) -> dict:
    seconds = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        clsurf.curvature(scan, device=device)
        seconds.append(time.perf_counter() - start)
    per_100k = 1e5 / len(scan.points)
    return {"median_s": float(np.median(seconds[1:])) * per_100k, "min_s": min(seconds) * per_100k}


def meshlab(scan: Mesh, truth: NDArray) -> dict:
    """Return error and seconds per 100K points of MeshLab's filters; empty, after a line, where it is not installed."""
    try:
        import pymeshlab
    except (ImportError, OSError):
        print("peer MeshLab: not installed (pip install clsurf[bench])")
        return {}
    filters = {"discrete": ("compute_scalar_by_discrete_curvature_per_vertex", {}),
               "quadric fitting": ("compute_curvature_principal_directions_per_vertex", {"method": "Quadric Fitting"})}
    for scale in APSS_SCALES:
        filters[f"APSS, scale {scale:g}"] = ("compute_curvature_and_color_apss_per_vertex", {"filterscale": scale})
    found = {}
    for label, (name, options) in filters.items():
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(scan.vertices.astype(np.float64), scan.faces))
        start = time.perf_counter()
        try:
            meshes.apply_filter(name, **options)
        except pymeshlab.PyMeshLabException as error:
            print(f"peer MeshLab, {label}: {' '.join(str(error).split())[:100]}")
            continue
        seconds = time.perf_counter() - start
        values = meshes.current_mesh().vertex_scalar_array()
        # Signs and factors of two are each filter's own: the best of them counts.
        best = min((_errors(k * values, truth) for k in (1, -1, 2, -2, 0.5, -0.5)), key=lambda e: e["rms"])
        found[label] = {**best, "median_s": seconds * 1e5 / len(scan.vertices)}
    return found


def show(figures: dict) -> None:
    """Print the figures beside what is asked of them."""
    rows = []
    for kind in ("torus", "mesh"):
        for noise, found in figures[kind].items():
            floor, aim = GOALS.get(float(noise), ("", ""))
            rows.append((f"{kind}, {float(noise):.1%} noise", f"{found['rms']:.2g}", f"{found['largest']:.2g}", floor,
                         aim, f"{found['median_s']:.3f}"))
            rows += [(f"  MeshLab, {name}", f"{peer['rms']:.2g}", f"{peer['largest']:.2g}", "", "",
                      f"{peer['median_s']:.3f}") for name, peer in found.get("peers", {}).items()]
    rows += [(f"{name}, {found['points']:,} points", "", "", "", "", f"{found['median_s']:.3f}")
             for name, found in figures["scans"].items()]
    print_table(("scene", "RMS", "largest", "floor", "aim", f"s / 100K ({SECONDS[0]}, {SECONDS[1]})"), rows)
