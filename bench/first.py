"""The job `first`: what one waits for. The import, first pictures of scans and surfaces, surfaces as meshes and points.

A first picture is that of a new renderer, kernels built before; nothing is known of the scan or surface but its arrays.
"""

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from clsurf.build.places import spacing_of
from clsurf.build.project import project
from clsurf.build.to_mesh import to_mesh
from clsurf.build.to_points import to_points
from clsurf.render.renderer import Renderer

from . import record, scenes
from .build import WrongAnswer, built, world_points
from .table import print_table

SIZE = (1024, 1024)
FURTHER = 3.0  # times the surface's own distance from the points that its mesh may have


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of first steps; `device` is an opened one."""
    figures = {"import": record.timing(import_seconds(3 if quick else 7))}
    for name in scenes.chosen(("bunny", "dragon"), quick):
        scene = scenes.scene(name)
        surface = built(scene, 2, device)
        figures[name] = {"mesh": answer(scene, surface, to_mesh(surface, device=device), device),
                         "points": spread(surface, to_points(surface, device=device), device)}
        for what, seconds in times(scene.scan, surface, device, 2 if quick else 5).items():
            figures[name].setdefault(what, {})["time"] = record.timing(seconds)
    show(figures)
    return figures


def import_seconds(runs: int) -> list[float]:
    """Return the seconds of a Python that imports clsurf, without those of one that imports NumPy."""
    import clsurf
    root = str(Path(clsurf.__file__).resolve().parents[1])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))}
    taken = {}
    for _ in range(runs + 1):  # the first reads the files
        for name in ("numpy", "clsurf"):
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", f"import {name}"], check=True, env=environment, timeout=120)
            taken.setdefault(name, []).append(time.perf_counter() - start)
    return [b - a for a, b in zip(taken["numpy"][1:], taken["clsurf"][1:], strict=True)]


def times(scan, surface, device, runs: int) -> dict:
    """Return seconds of each first step, in turns."""
    def picture(thing):
        thing = replace(thing)  # a new one, of which nothing is known
        start = time.perf_counter()
        with Renderer(device) as renderer:
            renderer.render(thing, size=SIZE)
        return time.perf_counter() - start

    def made(make):
        start = time.perf_counter()
        make(surface, device=device)
        return time.perf_counter() - start

    steps = {"picture of the scan": lambda: picture(scan), "picture of the surface": lambda: picture(surface),
             "mesh": lambda: made(to_mesh), "points": lambda: made(to_points)}
    for step in steps.values():
        step()
    return {what: [step() for _ in range(runs)] for what, step in steps.items()}


def answer(scene, surface, mesh, device) -> dict:
    """Return size and distance of the scan's points from a surface's mesh, % of the diagonal.

    Raises
    ------
    WrongAnswer
        A mesh much further from the points than its surface, or an edge of more than two faces.
    """
    points = world_points(scene.scan)
    own, found = (rms_percent(scene, project(thing, points, device=device).distance) for thing in (surface, mesh))
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    shared = np.unique(edges[:, 0] * np.int64(len(mesh.vertices)) + edges[:, 1], return_counts=True)[1]
    if found > FURTHER * own or shared.max() > 2:
        raise WrongAnswer(f"bench first {scene.name}: expected a mesh as near to the points as its surface, {own:.4f} "
                          f"%, and at most 2 faces an edge, got {found:.4f} % and {shared.max()}: mend to_mesh")
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "open_edges": int((shared == 1).sum()),
            "rms_percent": found, "surface_rms_percent": own}


def rms_percent(scene, distance) -> float:
    """Return the root mean square of finite distances in % of a scene's diagonal."""
    return float(np.sqrt(np.mean(distance[np.isfinite(distance)] ** 2)) * 100 / scene.diagonal)


def spread(surface, cloud, device) -> dict:
    """Return how even the points of a surface are, in spacings.

    Raises
    ------
    WrongAnswer
        Two points on one side nearer than a spacing, or a place without one within two.
    """
    spacing = spacing_of(surface)
    points = np.asarray(cloud.points, np.float64)
    away, near = cKDTree(points).query(points, k=2)
    alike = np.einsum("ij,ij->i", cloud.normals, cloud.normals[near[:, 1]]) > 0
    least = float(away[alike, 1].min() / spacing)
    mesh = to_mesh(surface, device=device)
    most = float(cKDTree(points).query(mesh.vertices + (mesh.origin - cloud.origin))[0].max() / spacing)
    if least < 0.999 or most > 2:
        raise WrongAnswer("bench first: expected points a spacing apart and within two of every place, got "
                          f"{least:.3f} and {most:.3f}: mend to_points")
    return {"points": len(points), "least_spacings": least, "most_spacings": most}


def show(figures: dict) -> None:
    """Print the figures."""
    print(f"import clsurf, beyond NumPy's: {figures['import']['median_s']:.2f} s")
    rows = []
    for name, f in figures.items():
        if name == "import":
            continue
        mesh, points = f["mesh"], f["points"]
        said = {"mesh": f"{mesh['vertices']:,} vertices, {mesh['open_edges']:,} open edges, RMS "
                        f"{mesh['rms_percent']:.4f} % (surface {mesh['surface_rms_percent']:.4f} %)",
                "points": f"{points['points']:,}, {points['least_spacings']:.2f} to {points['most_spacings']:.2f} "
                          "spacings"}
        rows += [(f"{name}: {what}", f"{part['time']['median_s']:.3f}", f"{part['time']['min_s']:.3f}",
                  said.get(what, "")) for what, part in f.items()]
    print_table(("first steps", "s", "min s", ""), rows)
