"""The job `trace`: rays a second, by packets of a picture (primary, shadows, ambient occlusion) and one by one.

Packets are timed as launches; single rays as `clsurf.trace` from host arrays of float64 to host arrays of float64, and
beside it the share of the kernel itself: "single" are lines from around the model to random vertices, "bounced" rays
leave the pixels of a picture in random directions. A shadow or occlusion ray is one that has to be traced: from a pixel
that shows the surface and faces the lamp. Embree is Open3D's, on the mesh that the surface was made from, float32 both
ways.
"""

import time

import numpy as np

import clsurf
from clsurf.device import Profile
from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Light, Shading
from clsurf.render.slim import place_slim, upload_slim
from clsurf.render.tiles import Layout
from clsurf.trace.packets import packet_lanes, trace_pixels
from clsurf.trace.pieces import traced

from . import peers, record, scenes
from .build import WrongAnswer, built
from .table import print_table, profile_rows

SIZE, FRAME = (1024, 1024), (1000, 1000)
DIRECTIONS = 64  # of ambient occlusion
SINGLE = 1 << 19  # rays one by one
# (floor, aim) in Mrays/s, or ms of the frame; single rays: PoCL, Intel's runtime.
GOALS = {("bunny", "primary"): (50, 80), ("dragon", "primary"): (35, 60), ("dragon", "shadows"): (30, 45),
         ("dragon", "occlusion"): (60, 100), ("dragon", "frame"): (60, 30)}
SINGLE_GOALS = {False: (6.5, 10), True: (8.5, 14)}


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of tracing; `device` is an opened one."""
    names = scenes.chosen(("bunny", "dragon"), quick)
    size, frame, count = ((128, 128), (96, 96), 1 << 14) if quick else (SIZE, FRAME, SINGLE)
    figures = {}
    for name in names:
        scene = scenes.scene(name)
        surface = built(scene, 2, device)
        runs = 2 if quick else 7
        found = {"primary": primary(name, surface, device, size, runs)}
        found |= secondary(scene, surface, device, size, frame, runs)
        found["single"] = single(scene, surface, device, count, runs, with_peer=not quick)
        found["bounced"] = bounced(scene, surface, device, size, runs, with_peer=not quick)
        for what, values in found.items():
            values["goals"] = SINGLE_GOALS["Intel" in device.platform_name] \
                if name == "dragon" and what in ("single", "bounced") else GOALS.get((name, what))
        figures[name] = found
    show(figures)
    if profile:
        origins, directions, _ = arbitrary_rays(scenes.scene(names[-1]), count)
        device.profile = Profile()
        try:
            clsurf.trace(surface, origins, directions, device=device)
            print(f"\nstages of single rays, {names[-1]} (each launch waits for the one before)")
            print_table(("kernel", "calls", "min ms", "median ms", "share"), profile_rows(device.profile))
        finally:
            device.profile = None
    return figures


def arbitrary_rays(scene, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origins around the model, unit directions to random vertices of it, and those vertices, (count, 3)."""
    rng = np.random.default_rng(0)
    out = rng.normal(size=(count, 3))
    out *= rng.uniform(0.6, 1.5, (count, 1)) * scene.diagonal / np.linalg.norm(out, axis=1, keepdims=True)
    origins = scene.box.mean(axis=0) + out
    targets = scene.scan.vertices[rng.integers(0, len(scene.scan.vertices), count)] + scene.scan.origin
    directions = targets - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True), targets


def timed(runs: int, work) -> list[float]:
    """Return the seconds of `runs` calls of `work`, after one that does not count."""
    work()
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return seconds


# Packets -------------------------------------------------------------------------------------------------------------


def primary(name: str, surface, device, size, runs: int) -> dict:
    """Return the figures of a picture's own rays, with blending.

    Raises
    ------
    WrongAnswer
        Depth that is not that of the tile renderer.
    """
    camera, layout = Camera.framing(surface, aspect=size[0] / size[1]), Layout()
    bins = -(-size[0] // 8), -(-size[1] // 8)
    touched = device.empty((bins[0] * bins[1],), np.int32)
    planes = device.empty((bins[0] * bins[1], layout.constants["FIELDS"], 64), np.float32)
    view = device.upload(place_slim(upload_slim(device, surface), None, camera, size, 0.0)[0])
    packets = traced(device, surface).packets

    def run():
        device.fill(touched, -1)
        trace_pixels(device, packet_lanes(device.lanes), packets, view, layout.constants, 0, None, *bins, touched,
                     planes)
        device.finish()

    seconds = timed(runs, run)
    depth = np.where((device.download(touched) >= 0)[:, None], device.download(planes)[:, 0], np.inf)
    depth = depth.reshape(bins[1], bins[0], 8, 8).transpose(0, 2, 1, 3).reshape(8 * bins[1], 8 * bins[0])
    with Renderer(device) as renderer:
        drawn = renderer.render(surface, camera, size, ("depth",), lod=0).depth
    wrong = 1 - np.isclose(depth[:size[1], :size[0]], np.where(np.isfinite(drawn), drawn, np.inf), rtol=1e-4).mean()
    if not wrong < 1e-3:
        raise WrongAnswer(f"bench trace {name}: expected the tile renderer's depth, got another at {wrong:.2%} of the "
                          "pixels: mend the packets before timing them")
    rays = size[0] * size[1]
    return {"time": record.timing(seconds), "rays": rays, "mrays_s": rays / np.median(seconds) / 1e6,
            "pixels_that_differ": wrong}


def secondary(scene, surface, device, size, frame_size, runs: int) -> dict:
    """Return the figures of hard shadows, of ambient occlusion, and of a shaded picture with two lights' shadows."""
    sun = np.array([0.6, 0.7, 0.4])
    lit = Scene([surface], [Light("directional", tuple(sun))])
    camera = Camera.framing(surface, aspect=size[0] / size[1])
    out = {}
    with Renderer(device) as renderer:
        plain = renderer.render(lit, camera, size, ("depth", "normal", "color"), lod=0)
        hit = np.isfinite(plain.depth)
        facing = int((plain.normal[hit] @ sun > 0).sum())
        shaded = [("shadows", Shading(shadows=True), facing),
                  ("occlusion", Shading(occlusion=DIRECTIONS, ambient=0.8), int(hit.sum()) * DIRECTIONS)]
        for what, shading, rays in shaded:
            picture = renderer.render(lit, camera, size, ("color",), shading, lod=0)
            darker = (picture.color[..., :3].sum(axis=2) < plain.color[..., :3].sum(axis=2) - 1e-3)[hit].mean() \
                if what == "shadows" else 0.5
            if not 0.001 < darker < 0.95:
                raise WrongAnswer(f"bench trace {scene.name}: expected shadows in part of the picture, got them at "
                                  f"{darker:.1%} of its pixels")
            renderer.profile = Profile()
            for _ in range(runs):
                renderer.render(lit, camera, size, ("color",), shading, lod=0)
            launches = np.array(renderer.profile.seconds["trace_lights"])
            renderer.profile = None
            seconds = launches.reshape(runs, -1).sum(axis=1)
            out[what] = {"time": record.timing(seconds), "rays": rays, "mrays_s": rays / np.median(seconds) / 1e6}
        two = Scene([surface], [Light("directional", tuple(sun)), Light("directional", (-0.5, 0.6, 0.6))])
        seconds = timed(runs, lambda: renderer.render(two, camera, frame_size, ("color",), Shading(shadows=True)))
        out["frame"] = {"time": record.timing(seconds), "ms": 1e3 * float(np.median(seconds))}
    return out


# One by one ----------------------------------------------------------------------------------------------------------


def single(scene, surface, device, count: int, runs: int, with_peer: bool) -> dict:
    """Return the figures of arbitrary rays: closest, any, all; the same on the mesh, and Embree's.

    Raises
    ------
    WrongAnswer
        Hits far from the scan, or meshes hit elsewhere than by Embree.
    """
    origins, directions, targets = arbitrary_rays(scene, count)
    hits = clsurf.trace(surface, origins, directions, device=device)
    on_mesh = clsurf.trace(scene.scan, origins, directions, device=device)
    both = hits.hit & on_mesh.hit
    apart = np.abs(hits.distance[both] - on_mesh.distance[both]) / scene.diagonal
    # Vertices of the outline, as the ray sees it, are grazed.
    behind = (on_mesh.distance > np.linalg.norm(targets - origins, axis=1) + 1e-4 * scene.diagonal).mean()
    if not (hits.hit.mean() > 0.97 and np.median(apart) < 1e-3 and behind < 0.05 and on_mesh.hit.mean() > 0.95):
        raise WrongAnswer(f"bench trace {scene.name}: expected hits where the scan is, got {hits.hit.mean():.2%} hits, "
                          f"{np.median(apart):.2%} of the diagonal off the mesh, and {behind:.2%} behind their target")
    runners = {"closest": lambda: clsurf.trace(surface, origins, directions, device=device),
               "any": lambda: clsurf.trace(surface, origins, directions, "any", device=device),
               "mesh": lambda: clsurf.trace(scene.scan, origins, directions, device=device)}
    embree = peers.embree(scene.scan) if with_peer else None
    if embree is not None:
        rays = embree.module.core.Tensor(np.concatenate([origins - embree.origin, directions], 1).astype(np.float32))
        theirs = embree.scene.cast_rays(rays)["t_hit"].numpy()
        if not np.isclose(theirs, on_mesh.distance, rtol=1e-3).mean() > 0.98:
            raise WrongAnswer(f"bench trace {scene.name}: expected Embree's hits of the mesh")
        runners["embree"] = lambda: embree.scene.cast_rays(rays)
    seconds = {name: [] for name in runners}
    for _ in range(runs):
        for name, run in runners.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    out = {"rays": count, "hits": float(hits.hit.mean()), "off_mesh": float(np.median(apart))}
    for name, values in seconds.items():
        out[name] = {"time": record.timing(values), "mrays_s": count / np.median(values) / 1e6}
    kernel = kernel_seconds(device, runners["closest"], runs)
    out["kernel"] = {"mrays_s": count / kernel["ray_slim"] / 1e6}
    out["conversion_share"] = 1 - kernel["ray_slim"] / np.median(seconds["closest"])
    out["mrays_s"] = out["closest"]["mrays_s"]
    return out


def bounced(scene, surface, device, size, runs: int, with_peer: bool) -> dict:
    """Return the figures of rays that leave the surface seen, one a pixel in the picture's order; and Embree's.

    Raises
    ------
    WrongAnswer
        Other rays hit the surface than hit the mesh.
    """
    origins, directions = bounced_rays(surface, device, size)
    hit = clsurf.trace(surface, origins, directions, device=device).hit
    differ = (hit != clsurf.trace(scene.scan, origins, directions, device=device).hit).mean()
    if not differ < 0.1:  # bunny 0.5 %, dragon 0.3 %, a coarse torus 7 %
        raise WrongAnswer(f"bench trace {scene.name}: expected bounced rays to hit the surface where they hit the "
                          f"mesh, got {differ:.1%} that do not")
    runners = {"closest": lambda: clsurf.trace(surface, origins, directions, device=device)}
    embree = peers.embree(scene.scan) if with_peer else None
    if embree is not None:
        rays = embree.module.core.Tensor(np.concatenate([origins - embree.origin, directions], 1).astype(np.float32))
        runners["embree"] = lambda: embree.scene.cast_rays(rays)
    seconds = {name: [] for name in runners}
    for _ in range(runs):
        for name, run in runners.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    out = {name: {"time": record.timing(values), "mrays_s": len(origins) / np.median(values) / 1e6}
           for name, values in seconds.items()}
    return {"rays": len(origins), "hits": float(hit.mean()), "differ": float(differ),
            "mrays_s": out["closest"]["mrays_s"]} | out


def bounced_rays(surface, device, size) -> tuple[np.ndarray, np.ndarray]:
    """Return origins a little off the surface that a picture shows, out of the scan's noise, and unit directions."""
    camera = Camera.framing(surface, aspect=size[0] / size[1])
    seen = clsurf.trace(surface, *camera.rays(size), device=device)
    normal = seen.normal[seen.hit]
    out = np.random.default_rng(0).normal(size=normal.shape)
    out *= (np.sign((out * normal).sum(axis=1)) / np.linalg.norm(out, axis=1))[:, None]
    return seen.position[seen.hit] + max(1e-3 * surface.diagonal, 2 * surface.bound) * normal, out


def kernel_seconds(device, work, runs: int) -> dict[str, float]:
    """Return the median seconds that each kernel takes in one call of `work`."""
    found = []
    for _ in range(runs):
        kept, device.profile = device.profile, Profile()
        try:
            work()
            found.append({label: sum(values) for label, values in device.profile.seconds.items()})
        finally:
            device.profile = kept
    return {label: float(np.median([one[label] for one in found])) for label in found[0]}


def show(figures) -> None:
    """Print the figures beside their floors and aims."""
    rows = []
    for name, found in figures.items():
        for what, values in found.items():
            goals = values["goals"] or ("-", "-")
            figure = f"{values['ms']:.1f} ms" if what == "frame" else f"{values['mrays_s']:.1f} Mrays/s"
            rows.append((f"{name}, {what}", figure, goals[0], goals[1]))
            if what == "bounced" and "embree" in values:
                rows.append((f"{name}, bounced, embree", f"{values['embree']['mrays_s']:.1f} Mrays/s", "-", "-"))
            if what == "single":
                rows += [(f"{name}, single, {label}", f"{values[label]['mrays_s']:.1f} Mrays/s", "-", "-")
                         for label in ("kernel", "any", "mesh", "embree") if label in values]
                rows.append((f"{name}, single, share of conversion", f"{values['conversion_share']:.0%}", "-", "-"))
    print_table(("rays", "here", "floor", "aim"), rows)
