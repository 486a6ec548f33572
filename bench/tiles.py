"""The job `tiles`: pictures of SLIM surfaces. Faults against ray casting, time a frame, a stage, a tile; peers.

A frame time is `Renderer.render` to host arrays of colour, depth and normal, the camera orbiting by 1 degree a frame,
nothing view-dependent kept. All cases and peers take turns within one run, in blocks of frames.
"""

import time
from dataclasses import dataclass

import numpy as np

from clsurf.device import Profile
from clsurf.render.renderer import Renderer

from . import peers, quality, record, scenes, truth, views
from .build import WrongAnswer, built
from .table import print_table

CHANNELS = ("color", "depth", "normal")
TILE = 32  # pixels across the squares that the cost of tiles is summed over
BLOCK = 8  # frames of one case before the next one's turn
# Frames before each block that do not count: after another program's turn the first frame took 1.7 times as long (cold
# caches, buffers of another size), the third as long as all that follow.
WARM = 2


@dataclass(frozen=True)
class Case:
    """One thing whose frames are timed."""

    name: str
    scene: str
    degree: int = 2
    size: tuple[int, int] = (1024, 1024)
    lod: float = 4.0  # pixels
    height_px: float | None = None  # of the scan on the picture; None: fills it

    def cameras(self, frames: int):
        """Return the orbit."""
        return views.orbit(scenes.scene(self.scene).box, frames, self.height_px, self.size[1])


CASES = (Case("bunny 500", "bunny", size=(500, 500)), Case("dragon 1024", "dragon"),
         Case("dragon 1024 cubic", "dragon", degree=3), Case("dragon 1024 fast (8 px)", "dragon", lod=8.0),
         Case("dragon 100 px high", "dragon", height_px=100.0))
QUICK_CASES = (Case("generated 500", "generated", size=(500, 500)),
               Case("generated 500 cubic", "generated", degree=3, size=(500, 500)))
# Faults are counted for these; (scene, degree, lod in pixels).
PICTURES = (("bunny", 2, 4.0), ("dragon", 2, 4.0), ("bunny", 3, 4.0), ("dragon", 3, 4.0), ("dragon", 2, 8.0))
QUICK_PICTURES = (("generated", 2, 4.0),)


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of rendering; `device` is an opened one."""
    names = scenes.chosen(("bunny", "dragon"), quick)
    cases = QUICK_CASES if names == ["generated"] else [case for case in CASES if case.scene in names]
    pictures = QUICK_PICTURES if names == ["generated"] else [p for p in PICTURES if p[0] in names]
    wanted = dict.fromkeys([(c.scene, c.degree) for c in cases] + [p[:2] for p in pictures])
    surfaces = {key: built(scenes.scene(key[0]), key[1], device) for key in wanted}
    figures = {"pictures": {}, "frames": {}}
    for name, degree, lod in pictures:
        size = (256, 256) if quick else (1024, 1024)
        label = f"{name}{' cubic' if degree == 3 else ''}{'' if lod == 4 else f' {lod:g} px'}"
        figures["pictures"][label] = faults(scenes.scene(name), surfaces[name, degree], device, size, lod,
                                            2 if quick else 8)
    figures["frames"] = frames(cases, surfaces, device, 8 if quick else 32, with_peers=not quick)
    for case in cases:
        figures["frames"][case.name] |= costs(case, surfaces[case.scene, case.degree], device)
    show(figures, profile)
    return figures


# The answer ----------------------------------------------------------------------------------------------------------


def faults(scene, surface, device, size=(1024, 1024), lod: float = 4.0, count: int = 8) -> dict:
    """Return the figures of `quality.measure` over the views: worst, mean, and each view's.

    Raises
    ------
    WrongAnswer
        Pictures of something else than the scene.
    """
    per_view = []
    with Renderer(device) as renderer:
        for camera in views.views(scene.box, count):
            exact = truth.cast(scene.scan, camera, size, key=scene.key)
            frame = renderer.render(surface, camera, size, channels=CHANNELS, lod=lod)
            per_view.append(quality.measure(exact, frame.depth, frame.normal, scene.diagonal, camera.rotation[2]))
    found = quality.summary(per_view)
    if not found["worst_holes"] < 0.02 * found["mean_pixels"] or not found["worst_depth_median"] < 0.1:
        raise WrongAnswer(f"bench tiles {scene.name}: expected pictures of the scan, got {found['worst_holes']:.0f} "
                          f"hole pixels and a median depth error of {found['worst_depth_median']:.3f} % of the "
                          "diagonal in the worst view: mend the renderer before timing it")
    return found | {"views": {str(i): figures for i, figures in enumerate(per_view)}}


# Times ---------------------------------------------------------------------------------------------------------------


def frames(cases, surfaces, device, count: int, with_peers: bool = True) -> dict:
    """Return the frame times of every case, then, in turns with peers on the same cameras, how much faster they are.

    ``frame`` is measured before any peer is loaded: their idle threads cost a bunny's frame of 2.2 ms another 1.4 ms.
    ``frame_beside_peers`` is what the ratios are made of. ``cores`` is processor time over wall time: on a busy
    machine Intel's runtime was seen to draw whole runs with one of two cores, at half the speed; such a run is to be
    repeated.
    """
    orbits = {case.name: case.cameras(count + WARM) for case in cases}
    runners = {case.name: _clsurf_runner(case, surfaces[case.scene, case.degree], device) for case in cases}
    seconds, cores = in_turns(runners, orbits, count)
    found = {name: {"frame": record.timing(seconds[name]), "cores": cores[name]} for name in runners}
    if not with_peers:
        return found
    plain = [case for case in cases if case.degree == 2 and case.lod == 4.0]
    runners, closers = {case.name: runners[case.name] for case in plain}, []
    casters = {name: peers.embree(scenes.scene(name).scan) for name in dict.fromkeys(c.scene for c in plain)}
    for case in plain:
        if casters[case.scene] is not None:
            runners[case.name, "open3d"] = _peer_runner(casters[case.scene], case.size)
        window = peers.vtk_window(scenes.scene(case.scene).scan, case.size) if case.height_px is None else None
        if window is not None:
            runners[case.name, "vtk"] = _peer_runner(window, case.size)
            closers.append(window)
    seconds, _ = in_turns(runners, orbits, count)
    for window in closers:
        window.close()
    for case in plain:
        mine = found[case.name]
        mine["frame_beside_peers"] = record.timing(seconds[case.name])
        for peer in ("open3d", "vtk"):
            if (case.name, peer) in seconds:
                mine[peer] = record.timing(seconds[case.name, peer])
                mine[f"times_faster_than_{peer}"] = mine[peer]["median_s"] / mine["frame_beside_peers"]["median_s"]
    return found


def in_turns(runners, orbits, count: int) -> tuple[dict, dict]:
    """Return the seconds of `count` runs of each runner, taken in blocks by turns, and the cores that it kept busy.

    A key of `runners` is a case's name, or that and a peer's.
    """
    seconds, cores = {key: [] for key in runners}, {key: [] for key in runners}
    cameras = {key: orbits[key if isinstance(key, str) else key[0]] for key in runners}
    for key, run in runners.items():  # programs, buffers and caches are made before the clock starts
        for camera in cameras[key][:3]:
            run(camera)
    for start in range(0, count, BLOCK):
        for key, run in runners.items():
            cpu, wall = time.process_time(), time.perf_counter()
            seconds[key] += [run(camera) for camera in cameras[key][start:start + WARM + BLOCK]][WARM:]
            cores[key].append((time.process_time() - cpu) / (time.perf_counter() - wall))
    return seconds, {key: float(np.median(share)) for key, share in cores.items()}


def _clsurf_runner(case, surface, device):
    renderer = Renderer(device)

    def run(camera) -> float:
        start = time.perf_counter()
        renderer.render(surface, camera, case.size, channels=CHANNELS, lod=case.lod)
        return time.perf_counter() - start

    return run


def _peer_runner(peer, size):
    return lambda camera: peer.seconds(camera, size)


def costs(case, surface, device) -> dict:
    """Return what a frame is made of: the time of each launch, and how the work is spread over tiles of 32x32 pixels.

    Timed launches wait for each other, so that their sum exceeds a frame's time.
    """
    with Renderer(device) as renderer:
        camera = case.cameras(1)[0]
        cost = renderer.render(surface, camera, case.size, channels=("cost",), lod=case.lod).cost
        device.profile = Profile()
        try:
            for camera in case.cameras(7):
                renderer.render(surface, camera, case.size, channels=CHANNELS, lod=case.lod)
            rows = device.profile.rows()
        finally:
            device.profile = None
    cost = np.nan_to_num(np.maximum(cost, 0).astype(np.float64))
    height, width = (n - n % TILE for n in cost.shape)
    tiles = cost[:height, :width].reshape(height // TILE, TILE, width // TILE, TILE).sum(axis=(1, 3)).ravel()
    busy = tiles[tiles > 0]
    stages = {label: {"calls": calls // 7, "min_ms": low, "median_ms": median, "share": share}
              for label, calls, low, median, share in rows}
    tile_ms = sum(s["median_ms"] for label, s in stages.items() if label.startswith("tile"))
    return {"stages": stages, "tiles": {
        "busy": len(busy), "of": len(tiles), "evaluations": float(busy.sum()),
        "median_evaluations": float(np.median(busy)) if len(busy) else 0.0,
        "largest_evaluations": float(busy.max()) if len(busy) else 0.0,
        "ms_per_busy_tile": tile_ms / max(len(busy), 1),
        "ns_per_evaluation": 1e6 * tile_ms / max(float(busy.sum()), 1.0)}}


# Printing ------------------------------------------------------------------------------------------------------------


def show(figures: dict, profile: bool) -> None:
    """Print the figures."""
    print("faults against ray casting (pixels a view: worst / mean), errors of the mean view")
    pairs = ("holes", "outside", "missing", "fragments", "depth_outliers", "depth_outliers_inner")
    print_table(("scene", *(name.replace("depth_outliers", "outliers") for name in pairs), "depth median %", "RMS %",
                 "distance %", "normal deg", "facet deg"),
                [(label, *(f"{f[f'worst_{name}']:.0f} / {f[f'mean_{name}']:.1f}" for name in pairs),
                  f"{f['mean_depth_median']:.4f}", f"{f['mean_depth_rms']:.4f}", f"{f['mean_distance_median']:.4f}",
                  f"{f['mean_normal_median']:.2f}", f"{f['mean_normal_facet_median']:.2f}")
                 for label, f in figures["pictures"].items()])
    rows = []
    for name, f in figures["frames"].items():
        t, tiles = f["frame"], f["tiles"]
        others = [f"{1e3 * f[p]['median_s']:.1f} ({f[f'times_faster_than_{p}']:.1f}x)" if p in f else "-"
                  for p in ("open3d", "vtk")]
        rows.append((name, f"{1e3 * t['median_s']:.2f}", f"{1e3 * t['min_s']:.2f}", f"{f['cores']:.1f}", *others,
                     f"{tiles['busy']} of {tiles['of']}", f"{1e3 * tiles['ms_per_busy_tile']:.1f}",
                     f"{tiles['largest_evaluations'] / max(tiles['median_evaluations'], 1):.1f}",
                     f"{tiles['ns_per_evaluation']:.3f}"))
    print("frames to host arrays of colour, depth and normal")
    print_table(("case", "ms", "min ms", "cores", "Open3D rays ms", "VTK ms", f"tiles of {TILE} px", "us a tile",
                 "largest/median", "ns an evaluation"), rows)
    if profile:
        for name, f in figures["frames"].items():
            print(f"\nstages of a frame of {name} (each launch waits for the one before)")
            print_table(("kernel or stage", "calls", "min ms", "median ms", "share"),
                        [(label, s["calls"], f"{s['min_ms']:.3f}", f"{s['median_ms']:.3f}", f"{s['share']:.1%}")
                         for label, s in f["stages"].items()])
