"""The job `scans`: meshes and clouds drawn as they are. Errors against ray casting, frame times, VTK on the same scan.

Frames are timed as in the job `tiles`: to host arrays of colour, depth and normal, the camera orbiting.
"""

import time
from dataclasses import dataclass

import numpy as np

from clsurf.io.scans import load_scan
from clsurf.render.renderer import Renderer
from clsurf.surface.cloud import PointCloud

from . import peers, quality, record, scenes, truth, views
from .build import WrongAnswer
from .table import print_table
from .tiles import CHANNELS, WARM, in_turns

CLOUDS = {"lion": "coloured/lion_takanawa.copc.laz", "autzen": "clouds/autzen.laz"}


@dataclass(frozen=True)
class Case:
    """One scan whose frames are timed; a mesh's points alone where `points` is set."""

    name: str
    scene: str
    size: tuple[int, int] = (1024, 1024)
    points: bool = False


CASES = (Case("dragon mesh 1024", "dragon"), Case("bunny mesh 500", "bunny", (500, 500)),
         Case("dragon points 1024", "dragon", points=True), Case("lion points 1024", "lion"),
         Case("autzen points 1024", "autzen"))
QUICK_CASES = (Case("generated mesh 256", "generated", (256, 256)),
               Case("generated points 256", "generated", (256, 256), points=True))


def available(case: Case) -> bool:
    """Return whether the scan of `case` can be loaded here."""
    return (scenes.data_folder() / CLOUDS[case.scene]).exists() if case.scene in CLOUDS else \
        scenes.available(case.scene)


def scan_of(case: Case):
    """Return the scan that `case` draws."""
    if case.scene in CLOUDS:
        return load_scan(scenes.data_folder() / CLOUDS[case.scene])
    mesh = scenes.scene(case.scene).scan
    return PointCloud(mesh.vertices, normals=mesh.normals, colors=mesh.colors, origin=mesh.origin) if case.points \
        else mesh


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of drawing scans; `device` is an opened one."""
    cases = QUICK_CASES if quick else [case for case in CASES if available(case)] or list(QUICK_CASES)
    scans = {case.name: scan_of(case) for case in cases}
    figures, runners, closers = {}, {}, []
    orbits = {case.name: views.orbit(scans[case.name].bounds, (8 if quick else 24) + WARM) for case in cases}
    for case in cases:
        scan = scans[case.name]
        figures[case.name] = {"elements": len(scan.faces) if hasattr(scan, "faces") else len(scan.points)}
        figures[case.name] |= errors(case, scan, device, 2 if quick else 4)
        renderer = Renderer(device)
        start = time.perf_counter()
        renderer.render(scan, orbits[case.name][0], case.size, channels=CHANNELS)
        figures[case.name]["first_s"] = time.perf_counter() - start
        runners[case.name] = _runner(renderer, scan, case.size)
    seconds, cores = in_turns(runners, orbits, 8 if quick else 24)
    for case in cases:
        figures[case.name] |= {"frame": record.timing(seconds[case.name]), "cores": cores[case.name]}
    if not quick:
        for case in cases:
            window = peers.vtk_window(scans[case.name], case.size)
            if window is not None:
                runners[case.name, "vtk"] = lambda camera, window=window, size=case.size: window.seconds(camera, size)
                closers.append(window)
        seconds, _ = in_turns(runners, orbits, 16)
        for case in cases:
            if (case.name, "vtk") in seconds:
                mine, theirs = record.timing(seconds[case.name]), record.timing(seconds[case.name, "vtk"])
                figures[case.name] |= {"frame_beside_vtk": mine, "vtk": theirs,
                                       "times_faster_than_vtk": theirs["median_s"] / mine["median_s"]}
        for window in closers:
            window.close()
    show(figures)
    return figures


def errors(case: Case, scan, device, count: int) -> dict:
    """Return errors against exact pictures of the mesh behind the scan; for other clouds how much of a view it fills.

    Raises
    ------
    WrongAnswer
        Pictures of something else.
    """
    with Renderer(device) as renderer:
        if case.scene in CLOUDS:
            frame = renderer.render(scan, views.views(scan.bounds, 1)[0], case.size, channels=("depth",))
            filled = float(np.isfinite(frame.depth).mean())
            if not 0.02 < filled < 0.95:
                raise WrongAnswer(f"bench scans {case.name}: expected a view of the cloud, got {filled:.0%} of the "
                                  "picture filled")
            return {"filled": filled}
        scene, found = scenes.scene(case.scene), []
        for camera in views.views(scene.box, count):
            exact = truth.cast(scene.scan, camera, case.size, key=scene.key)
            frame = renderer.render(scan, camera, case.size, channels=CHANNELS)
            found.append(quality.measure(exact, frame.depth, frame.normal, scene.diagonal, camera.rotation[2]))
    summary = quality.summary(found)
    if not summary["worst_holes"] < 0.005 * summary["mean_pixels"] or not summary["worst_depth_median"] < 0.05:
        raise WrongAnswer(f"bench scans {case.name}: expected pictures of the scan, got {summary['worst_holes']:.0f} "
                          f"hole pixels and a median depth error of {summary['worst_depth_median']:.3f} % of the "
                          "diagonal in the worst view: mend the renderer before timing it")
    return {"errors": summary}


def _runner(renderer, scan, size):
    def run(camera) -> float:
        start = time.perf_counter()
        renderer.render(scan, camera, size, channels=CHANNELS)
        return time.perf_counter() - start
    return run


def show(figures: dict) -> None:
    """Print the figures."""
    rows = []
    for name, f in figures.items():
        e = f.get("errors")
        vtk = f"{1e3 * f['vtk']['median_s']:.1f} ({f['times_faster_than_vtk']:.1f}x)" if "vtk" in f else "-"
        rows.append((name, f"{f['elements']:,}", f"{1e3 * f['frame']['median_s']:.2f}",
                     f"{1e3 * f['frame']['min_s']:.2f}", f"{f['cores']:.1f}", f"{f['first_s']:.2f}", vtk,
                     f"{e['worst_holes']:.0f}" if e else "-", f"{e['mean_outside']:.1f}" if e else "-",
                     f"{e['mean_depth_median']:.5f}" if e else f"filled {f['filled']:.0%}"))
    print("scans as they are: frames to host arrays of colour, depth and normal; first: with the upload")
    print_table(("case", "faces or points", "ms", "min ms", "cores", "first s", "VTK ms", "hole px", "outside px",
                 "depth median %"), rows)
