"""The job `build`: scan to SLIM surface. Time, size, distance of the points to the surface, overlap, memory."""

import json
import pickle
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from clsurf.build.project import project
from clsurf.build.slim import build_slim
from clsurf.device import Profile
from clsurf.errors import Error

from . import peers, record, scenes
from .table import print_table

T_MDL = 0.01
ALPHA = 2 / 3  # the paper's share of a ball's radius that covers and carries the surface
SHARP = 30.0  # degrees between the facets of an edge that counts as sharp


class WrongAnswer(Error):
    """A benchmark whose answer is wrong: its figures would mean nothing."""


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of building; `device` is an opened one."""
    names = scenes.chosen(("bunny", "dragon"), quick)
    cases = [(name, degree) for name in names for degree in (2, 3)]
    surfaces, figures = {}, {}
    for name, degree in cases:
        surfaces[name, degree] = built(scenes.scene(name), degree, device)
    for name in names:
        figures[name] = answer(scenes.scene(name), surfaces[name, 2], device)
        figures[name]["cubic"] = answer(scenes.scene(name), surfaces[name, 3], device)
        figures[name]["cubic_leaf_ratio"] = figures[name]["cubic"]["leaves"] / figures[name]["leaves"]
    for (name, degree), seconds in times(cases, device, 3 if quick else 7).items():
        (figures[name] if degree == 2 else figures[name]["cubic"])["build"] = record.timing(seconds)
    for name in names:
        figures[name] |= {"memory": memory(scenes.scene(name), 2, device), "stages": stages(scenes.scene(name), device)}
    if not quick:
        if "bunny" in names:  # a grid fine enough for the dragon takes MeshLab minutes
            figures["bunny"]["apss"] = peers.apss(scenes.scene("bunny").scan)
        if scenes.available("fandisk"):
            figures["fandisk"] = edges(scenes.scene("fandisk"), device)
    show(figures, profile)
    return figures


def built(scene, degree, device):
    """Return the surface of `scene`, the answer that the job's times belong to."""
    return build_slim(scene.scan, degree=degree, error=T_MDL, device=device)


def times(cases, device, runs: int) -> dict:
    """Return seconds of `runs` builds of every (scene, degree), in turns, so that a slow minute meets all of them."""
    seconds = {case: [] for case in cases}
    for _ in range(runs):
        for name, degree in cases:
            scene = scenes.scene(name)
            start = time.perf_counter()
            built(scene, degree, device)
            seconds[name, degree].append(time.perf_counter() - start)
    return seconds


def answer(scene, surface, device) -> dict:
    """Return size and error of a surface, every length in % of the diagonal.

    Raises
    ------
    WrongAnswer
        Points far from the surface, or points that no leaf covers.
    """
    points = world_points(scene.scan)
    distance = np.abs(project(surface, points, device=device).distance) * 100 / scene.diagonal
    reached = np.isfinite(distance)
    covered = overlap(surface, points)
    figures = {"points": len(points), "leaves": int(surface.leaf.sum()), "surfels": len(surface),
               "links": len(surface.children), "bytes": surface.nbytes,
               "rms_percent": float(np.sqrt(np.mean(distance[reached] ** 2))),
               "p999_percent": float(np.percentile(distance[reached], 99.9)),
               "not_reached": int((~reached).sum()), "overlap_min": float(covered.min()),
               "overlap_below_0.1": int((covered < 0.1).sum()), "bound_percent": 100 * surface.bound / scene.diagonal}
    if not figures["rms_percent"] < 0.1 or figures["not_reached"] > 0.001 * len(points) or covered.min() <= 0:
        raise WrongAnswer(f"bench build {scene.name}: expected points within 0.1 % of the surface and all covered, got "
                          f"{figures['rms_percent']:.4f} % RMS, {figures['not_reached']} without a surface, overlap "
                          f"{covered.min():.3f}: mend the builder before timing it")
    return figures


def world_points(scan) -> np.ndarray:
    """Return the scan's points (n, 3) float64 in world space."""
    return np.asarray(scan.points, np.float64) + scan.origin


def overlap(surface, points) -> np.ndarray:
    """Return the paper's overlap o(p) (n,) of the leaves at world `points`, by a k-d tree on the host.

    o(p) = sum of G(|p - c| / (alpha r)) over the leaves, G(t) = (1 - t^2)^3 (section 2, "overlap measure").
    """
    centers = np.asarray(surface.centers[surface.leaf], np.float64)
    reach = ALPHA * np.asarray(surface.radii[surface.leaf], np.float64)
    local = points - surface.origin
    tree = cKDTree(local)
    total = np.zeros(len(local))
    # Balls of a like size together: a query of its own radius for each, without one list per leaf of millions.
    for part in np.array_split(np.argsort(reach), max(1, len(reach) // 4096)):
        inside = tree.query_ball_point(centers[part], reach[part], return_sorted=False)
        count = np.array([len(found) for found in inside])
        point = np.concatenate([np.asarray(found, np.int64) for found in inside]) if count.sum() else np.zeros(0, int)
        leaf = np.repeat(part, count)
        t2 = ((local[point] - centers[leaf]) ** 2).sum(axis=1) / reach[leaf] ** 2
        total += np.bincount(point, np.maximum(1 - t2, 0) ** 3, len(local))
    return total


def memory(scene, degree, device) -> dict | None:
    """Return the rise of peak resident memory in the second build, in a process of its own; None where unknown."""
    if not Path("/proc/self/clear_refs").exists():
        print("memory: not measured (needs Linux's /proc)")
        return None
    import os

    import clsurf
    root = str(Path(clsurf.__file__).resolve().parents[1])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}
    selector = selector_of(device)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.pickle"
        path.write_bytes(pickle.dumps(scene.scan))
        done = subprocess.run([sys.executable, str(Path(__file__).with_name("memory.py")), str(path), str(degree),
                               str(T_MDL), selector], capture_output=True, text=True, timeout=600, env=environment)
    if done.returncode:
        raise WrongAnswer(f"bench build {scene.name}: the build in a process of its own failed: {done.stderr[-800:]}")
    found = json.loads(done.stdout.splitlines()[-1])
    return found | {"mb_per_million_points": found["rise_bytes"] / found["points"]}


def selector_of(device) -> str:
    """Return a `device=` text that opens the same device in another process."""
    from clsurf.device import all_devices
    kind = [d for d in all_devices() if d.platform.name == device.cl_device.platform.name]
    return f"{device.platform_name.lower()}:{kind.index(device.cl_device)}"


def stages(scene, device) -> dict:
    """Return the time of every labelled launch of one build: label to calls, minimum and median in ms, share."""
    device.profile = Profile()
    try:
        built(scene, 2, device)
        return {label: {"calls": calls, "min_ms": low, "median_ms": median, "share": share}
                for label, calls, low, median, share in device.profile.rows()}
    finally:
        device.profile = None


# The paper's open question: sharp edges ------------------------------------------------------------------------------


def sharp_edges(mesh) -> np.ndarray:
    """Return the end points (k, 2, 3) float64, world space, of edges whose facets meet at more than `SHARP` degrees."""
    import trimesh
    shape = trimesh.Trimesh(np.asarray(mesh.vertices, np.float64) + mesh.origin, mesh.faces, process=True)
    return shape.vertices[shape.face_adjacency_edges[np.degrees(shape.face_adjacency_angles) > SHARP]]


def distance_to_segments(points, segments, samples: int = 5) -> np.ndarray:
    """Return the distance (n,) of `points` to `segments` (k, 2, 3), each stood for by `samples` points on it."""
    t = np.linspace(0, 1, samples)[:, None, None]
    on = (segments[:, 0] * (1 - t) + segments[:, 1] * t).reshape(-1, 3)
    return cKDTree(on).query(points)[0]


def edges(scene, device) -> dict:
    """Return the errors near the sharp edges of a clean shape and elsewhere, % of the diagonal, for both degrees."""
    points = world_points(scene.scan)
    spacing = float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))
    away = distance_to_segments(points, sharp_edges(scene.scan)) / spacing
    figures = {"spacing_percent": 100 * spacing / scene.diagonal, "near_points": int((away <= 2).sum())}
    for degree, label in ((2, "quadratic"), (3, "cubic")):
        surface = built(scene, degree, device)
        error = np.abs(project(surface, points, device=device).distance) * 100 / scene.diagonal
        reached = np.isfinite(error)
        figures[label] = {"leaves": int(surface.leaf.sum()), "not_reached": int((~reached).sum())}
        for name, where in (("edge", away <= 2), ("elsewhere", away > 6)):
            e = error[where & reached]
            figures[label][f"{name}_rms_percent"] = float(np.sqrt(np.mean(e**2)))
            figures[label][f"{name}_max_percent"] = float(e.max())
    return figures


# Printing ------------------------------------------------------------------------------------------------------------


def show(figures: dict, profile: bool) -> None:
    """Print the figures."""
    rows, lines = [], []
    for name, f in figures.items():
        if name == "fandisk":
            for label in ("quadratic", "cubic"):
                e = f[label]
                lines.append(f"fandisk, {label}: RMS within 2 spacings of edges sharper than {SHARP:.0f} degrees "
                             f"{e['edge_rms_percent']:.4f} %, further than 6 away {e['elsewhere_rms_percent']:.4f} %")
            continue
        for label, part in (("quadratic", f), ("cubic", f["cubic"])):
            t = part["build"]
            rows.append((f"{name} {label}", f"{t['median_s']:.3f}", f"{t['min_s']:.3f}", part["leaves"],
                         part["surfels"], f"{part['rms_percent']:.4f}",
                         f"{part['p999_percent']:.3f}", f"{part['overlap_min']:.3f}"))
        lines.append(f"{name}: cubic/quadratic leaves {f['cubic_leaf_ratio']:.2f}")
        if f["memory"]:
            lines[-1] += (f", memory of a build {f['memory']['rise_bytes'] / 1e6:.1f} MB, "
                          f"{f['memory']['mb_per_million_points']:.0f} MB per million points")
        if f.get("apss"):
            lines.append(f"{name}: MeshLab APSS, marching cubes to {f['apss']['vertices']:,} vertices: "
                         f"{f['apss']['seconds']:.2f} s, RMS of the points "
                         f"{100 * f['apss']['rms'] / scenes.scene(name).diagonal:.4f} %")
    print_table(("T 0.01", "s", "min s", "leaves", "surfels", "RMS %", "99.9 % at", "overlap"), rows)
    print("\n".join(lines))
    if profile:
        for name, f in figures.items():
            if "stages" in f:
                print(f"\nstages of the build of {name}, ms (each launch waits for the one before)")
                print_table(("kernel or stage", "calls", "min", "median", "share"),
                            [(label, s["calls"], f"{s['min_ms']:.3f}", f"{s['median_ms']:.3f}", f"{s['share']:.1%}")
                             for label, s in f["stages"].items()])
