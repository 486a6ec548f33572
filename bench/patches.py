"""The job `patches`: spatial patches. Faults of pictures, conversions, frames and their modes, VTK, the paper's tables.

A frame time is `Renderer.render` to host arrays of colour, depth and normal, the camera orbiting by 1 degree a frame on
the orbit of the job `tiles`, nothing view-dependent kept; "filling" frames the nodes more closely than their box does.
All cases, modes and VTK take turns within one run, in blocks of frames.
"""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from clsurf import models
from clsurf.device import Profile
from clsurf.render.camera import Camera
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.renderer import Renderer
from clsurf.surface.patch_mesh import patch_mesh

from . import patch_conversions, patch_pictures, patch_tables, peers, record, scenes, views
from .build import WrongAnswer
from .table import print_table
from .tiles import CHANNELS, WARM, in_turns
from .truth import vertex_normals

PAPER = (500, 500)
SMALL = (150, 150)
FULL_HD = (1920, 1080)
CHECKED = {False: FULL_HD, True: PAPER}  # size of the pictures that faults are counted in, by `quick`
VIEWS = ((0, 20), (90, -20), (200, 50), (300, -89))  # azimuth and elevation, degrees: the last sees a pole
MODES = {
    "quads": {}, "triangles": {"cells": "triangles"}, "bilinear": {"cells": "bilinear"}, "smooth": {"cells": "smooth"},
    "trilinear nodes": {"nodes": "trilinear"}, "homogeneous nodes": {"nodes": "homogeneous"},
    "gouraud": {"shading": "gouraud"}, "smooth normals": {"normals": "smooth"}, "normal table": {"normal_table": True},
    "normal table, ordered": {"normal_table": "ordered"}, "alpha": {"alpha": True}, "culled": {"cull": True}}
# What only shows where nothing is magnified is compared in the small picture.
SMALL_MODES = {"quads": {}, "no direct writes": {"direct": False}, "no coarser levels": {"mip": False},
               "neither": {"direct": False, "mip": False}}


@dataclass(frozen=True)
class Case:
    """A surface in pictures of one size; the camera frames it and goes around."""

    scene: str
    size: tuple[int, int]
    drawing: dict = field(default_factory=dict)
    vtk: bool = False
    filling: bool = False

    @property
    def name(self) -> str:
        return f"{self.scene} {self.size[0]}x{self.size[1]}" + (" filling" if self.filling else "")


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of spatial patches; `device` is an opened one."""
    surfaces = made(quick)
    figures = {"models": {name: sizes_of(surface) for name, surface in surfaces.items()}}
    closed = {name: surfaces[name] for name in ("sphere", main_earth(surfaces))}
    figures["pictures"] = pictures(closed, device, CHECKED[quick], VIEWS[:1] if quick else VIEWS)
    if not quick:
        figures["conversions"], converted = patch_conversions.measure(device)
        surfaces |= converted
        figures["models"] |= {name: sizes_of(surface) for name, surface in converted.items()}
    cases = chosen_cases(surfaces, quick)
    figures["frames"] = frames(cases, surfaces, device, 8 if quick else 24)
    earth = main_earth(surfaces)
    figures["modes"] = modes(earth, surfaces[earth], device, 8 if quick else 16, SMALL if quick else PAPER)
    figures["tables"] = patch_tables.measure(surfaces, PAPER, SMALL)
    if profile:
        figures["stages"] = {case.name: stages(case, surfaces[case.scene], device) for case in cases}
    show(figures)
    return figures


# Models --------------------------------------------------------------------------------------------------------------


def made(quick: bool) -> dict:
    """Return the generated surfaces by name; the Earth from the colour map where the data is, else made up."""
    path = scenes.data_folder() / "earth" / "bmng.jpg"
    color = path if path.exists() and not quick else None
    if color is None and not quick:
        print("earth: the colour map earth/bmng.jpg is missing (CLSURF_DATA names its folder); continents are made up")
    counts = (383,) if quick else (383, 1128, 2712)
    return {"sphere": models.perfect_sphere()} | {f"earth {n}": models.earth(n, color=color) for n in counts}


def sizes_of(surface) -> dict:
    """Return what a surface consists of."""
    return {"patches": len(surface), "nodes": surface.node_count, "nbytes": surface.nbytes}


def main_earth(surfaces) -> str:
    """Return the name of the Earth that frames are measured with."""
    return "earth 1128" if "earth 1128" in surfaces else "earth 383"


def chosen_cases(surfaces, quick: bool) -> list[Case]:
    """Return what frames are timed of."""
    earth = main_earth(surfaces)
    if quick:
        return [Case(earth, PAPER, vtk=True), Case("sphere", SMALL)]
    found = [Case(earth, size, vtk=True) for size in (PAPER, SMALL, FULL_HD)]
    found += [Case(earth, size, filling=True) for size in (PAPER, FULL_HD)]
    found += [Case("sphere", PAPER, vtk=True), Case("sphere", FULL_HD)]
    return found + [Case(name, PAPER) for name in ("bunny",) if name in surfaces]


def orbit(surface, frames: int, case: Case, start: float = 30.0) -> list[Camera]:
    """Return `frames` cameras that go around the surface, 1 degree a frame."""
    if not case.filling:
        return views.orbit(surface.bounds, frames, start=start)
    first = Camera.framing(surface, views.direction(start, views.ELEVATION), views.FOV,
                           aspect=case.size[0] / case.size[1])
    return [first.orbited(surface.bounds.mean(axis=0), float(i)) for i in range(frames)]


# The answer ----------------------------------------------------------------------------------------------------------


def pictures(surfaces, device, size, angles) -> dict:
    """Return the faults of pictures of the closed models: the worst view, by model.

    Raises
    ------
    WrongAnswer
        A sphere that is none, or holes.
    """
    found = {}
    with Renderer(device) as renderer:
        for name, surface in surfaces.items():
            spacing = float(np.median(np.linalg.norm(surface.axis_x, axis=1)))
            rows = []
            for angle in angles:
                camera = Camera.framing(surface, views.direction(*angle), views.FOV, aspect=size[0] / size[1])
                frame = renderer.render(surface, camera, size, channels=CHANNELS)
                rows.append(patch_pictures.faults(frame, spacing))
                if name == "sphere":
                    rows[-1] |= patch_pictures.sphere_faults(frame, camera, size, 128.0)
            found[name] = {key: max(row[key] for row in rows) for key in rows[0]}
            if found[name]["pinholes"] or found[name].get("radial", 0) > patch_pictures.DEPTH_LIMIT:
                raise WrongAnswer(f"bench patches {name}: expected a closed surface, got {found[name]['pinholes']} "
                                  "pinholes or a sphere off its formula: mend the renderer before timing it")
    return found


# Times ---------------------------------------------------------------------------------------------------------------


def frames(cases, surfaces, device, count: int) -> dict:
    """Return the frame times of every case, then, in turns with VTK on the same cameras, how much faster they are.

    ``frame`` is measured before VTK is loaded, ``frame_beside_vtk`` is what the ratio is made of. ``cores`` is
    processor time over wall time.
    """
    orbits = {case.name: orbit(surfaces[case.scene], count + WARM, case) for case in cases}
    with Renderer(device) as renderer:
        runners = {case.name: _runner(renderer, surfaces[case.scene], case) for case in cases}
        seconds, cores = in_turns(runners, orbits, count)
        found = {case.name: {"frame": record.timing(seconds[case.name]), "cores": cores[case.name]} for case in cases}
        windows, together = {}, {}
        for case in (case for case in cases if case.vtk):
            windows[case.name] = vtk_window(surfaces[case.scene], case.size)
            if windows[case.name] is not None:
                together |= {case.name: runners[case.name],
                             (case.name, "vtk"): lambda camera, w=windows[case.name], s=case.size: w.seconds(camera, s)}
        seconds, _ = in_turns(together, orbits, min(count, 8)) if together else ({}, None)
    for name, window in windows.items():
        if window is None:
            continue
        window.close()
        mine, theirs = record.timing(seconds[name]), record.timing(seconds[name, "vtk"])
        found[name] |= {"frame_beside_vtk": mine, "vtk": theirs,
                        "times_faster_than_vtk": theirs["median_s"] / mine["median_s"]}
    return found


def vtk_window(surface, size):
    """Return VTK's rasteriser with the same nodes as a mesh of triangles, their colours, and smooth normals."""
    mesh = patch_mesh(surface)
    mesh = replace(mesh, normals=vertex_normals(mesh.vertices, mesh.faces))
    return peers.vtk_window(mesh, size)


def modes(name: str, surface, device, count: int, size) -> dict:
    """Return the frame time of every mode, in turns, and its ratio to the default's; unsupported modes are left out."""
    cases = {mode: Case(name, size, drawing) for mode, drawing in MODES.items()}
    cases |= {f"{mode} {SMALL[0]}x{SMALL[1]}": Case(name, SMALL, drawing) for mode, drawing in SMALL_MODES.items()}
    with Renderer(device) as renderer:
        runners = {mode: _runner(renderer, surface, case) for mode, case in cases.items()}
        orbits = {mode: orbit(surface, count + WARM, case) for mode, case in cases.items()}
        seconds, _ = in_turns(runners, orbits, count)
    found = {mode: {"frame": record.timing(seconds[mode])} for mode in runners}
    small = f"quads {SMALL[0]}x{SMALL[1]}"
    for mode, figures in found.items():
        base = found["quads" if cases[mode].size == size and mode in MODES else small]
        figures["ratio"] = figures["frame"]["median_s"] / base["frame"]["median_s"]
    return found


def _runner(renderer, surface, case: Case):
    drawing = PatchDrawing(**case.drawing)

    def run(camera) -> float:
        start = time.perf_counter()
        renderer.render(surface, camera, case.size, channels=CHANNELS, patches=drawing)
        return time.perf_counter() - start

    return run


def stages(case: Case, surface, device) -> dict:
    """Return the time of each launch of a frame; timed launches wait for each other."""
    with Renderer(device) as renderer:
        cameras = orbit(surface, 8, case)
        renderer.render(surface, cameras[0], case.size, channels=CHANNELS)
        device.profile = Profile()
        try:
            for camera in cameras[1:]:
                renderer.render(surface, camera, case.size, channels=CHANNELS)
            rows = device.profile.rows()
        finally:
            device.profile = None
    return {label: {"calls": calls // 7, "min_ms": low, "median_ms": median, "share": share}
            for label, calls, low, median, share in rows}


# Printing ------------------------------------------------------------------------------------------------------------


def show(figures: dict) -> None:
    """Print the figures."""
    print("\npictures, worst view: pixels of faults; the sphere's distance from its formula, largest error along the "
          f"axis where seen at up to 70 degrees, pixels more than {patch_pictures.DEPTH_LIMIT} off there / at all")
    print_table(("model", "pinholes", "specks: depth", "colour", "normal", "radial", "depth", "off"),
                [(name, f["pinholes"], f["depth_speckle"], f["color_speckle"], f["normal_speckle"],
                  *((f"{f['radial']:.4f}", f"{f['depth_facing']:.4f}", f"{f['off_facing']} / {f['off']}")
                    if "radial" in f else ("-", "-", "-"))) for name, f in figures["pictures"].items()])
    if "conversions" in figures:
        patch_conversions.show(figures["conversions"])
    print("\nframes to host arrays of colour, depth and normal")
    print_table(("case", "ms", "min ms", "cores", "VTK ms", "times faster"),
                [(name, f"{1e3 * f['frame']['median_s']:.2f}", f"{1e3 * f['frame']['min_s']:.2f}", f"{f['cores']:.1f}",
                  *((f"{1e3 * f['vtk']['median_s']:.1f}", f"{f['times_faster_than_vtk']:.0f}x") if "vtk" in f
                    else ("-", "-"))) for name, f in figures["frames"].items()])
    print("\nmodes")
    print_table(("mode", "ms", "ratio"), [(name, f"{1e3 * f['frame']['median_s']:.2f}", f"{f['ratio']:.2f}")
                                          for name, f in figures["modes"].items()])
    patch_tables.show(figures["tables"])
    for name, rows in figures.get("stages", {}).items():
        print(f"\nstages of a frame of {name} (each launch waits for the one before)")
        print_table(("kernel or stage", "calls", "min ms", "median ms", "share"),
                    [(label, s["calls"], f"{s['min_ms']:.3f}", f"{s['median_ms']:.3f}", f"{s['share']:.1%}")
                     for label, s in rows.items()])
