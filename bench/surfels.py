"""The job `surfels`: hierarchies of surfels with normal maps. Maps against float64, builds, normals, frames.

Errors of normals are angles at the pixels that both pictures show, against the same hierarchy's finest level in the
same view; of the interior, at those of them that have no background and no jump in depth of 3 % of the diagonal within
3 pixels in the finest level's picture: silhouettes have a finer threshold. A frame time is `Renderer.render` to host
arrays of colour, depth and normal, the camera orbiting.
"""

import time

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

import clsurf
from clsurf.build.surfels import build_surfels
from clsurf.device import Profile
from clsurf.render.renderer import Renderer
from clsurf.render.surfel_drawing import SurfelDrawing
from clsurf.surface.slim import frame_of_normals
from clsurf.surface.surfel import decoded_normals

from . import record, scenes, views
from .build import WrongAnswer
from .table import print_table

CHANNELS = ("color", "depth", "normal")
SPHERES, QUICK_SPHERES = (500, 2000, 8000, 32_000, 128_000), (500, 2000)
MAP_SIZES, INTERIOR = (1, 2, 4, 8, 16, 32), 16.0
EIGHT_BIT = 0.3  # degrees, RMS
SAMPLES = 60  # maps of each sphere
AROUND, JUMP = 7, 0.03  # of a pixel of the interior: pixels across, and of the diagonal
BLOCK, WARM = 8, 2


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of surfel hierarchies; `device` is an opened one."""
    figures = {"spheres": spheres(device, QUICK_SPHERES if quick else SPHERES)}
    names = ["generated"] if quick else ["meteoroid", *scenes.chosen(("dragon",), quick)]
    size = (256, 256) if quick else (1024, 1024)
    figures["builds"], figures["normals"], figures["frames"] = {}, {}, {}
    for name in names:
        scan = clsurf.models.meteoroid(1) if name == "meteoroid" else scenes.scene(name).scan
        surface, figures["builds"][name] = build(scan, device, 1 if quick else 3)
        figures["normals"][name] = normals(scan, surface, device, size, (4, 16) if quick else MAP_SIZES,
                                           2 if quick else 4)
        figures["frames"][name] = frames(scan, surface, device, size, 8 if quick else 32)
    show(figures, profile)
    return figures


# The answer -----------------------------------------------------------------------------------------------------------


def exact_map(surface, number: int):
    """Return Algorithm 1 in float64 (w * w, 3), NaN where a line misses: every base surfel whose sphere is met."""
    base = surface.base
    p, n, r = (a[base].astype(np.float64) for a in (surface.positions, surface.normals, surface.radii))
    position, normal = surface.positions[number].astype(np.float64), surface.normals[number].astype(np.float64)
    meets = np.linalg.norm(p - position, axis=1) < float(surface.spheres[number]) + r
    meets &= n @ normal > 1e-3
    p, n, r = p[meets], n[meets], r[meets]
    w = int(surface.map_size[number])
    t = ((2 * np.arange(w) + 1) / w - 1) * float(surface.radii[number])
    u, v = frame_of_normals(normal)
    out = np.zeros((w * w, 3))
    for k, place in enumerate(position + t.repeat(w)[:, None] * v + np.tile(t, w)[:, None] * u):
        height = ((p - place) * n).sum(axis=1) / (n @ normal)
        t2 = ((place + height[:, None] * normal - p) ** 2).sum(axis=1) / r**2
        out[k] = (np.where(t2 < 1, np.exp(-4 * t2), 0)[:, None] * n).sum(axis=0)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(length > 0, out / length, np.nan)


def spheres(device, counts) -> dict:
    """Return the error of the maps of unit spheres against `exact_map`, by the number of base surfels.

    Raises
    ------
    WrongAnswer
        More than the code of 8 bits explains.
    """
    found = {}
    for count in counts:
        surface = build_surfels(clsurf.models.sphere(count), device=device)
        inner = np.flatnonzero(surface.level < surface.level.max())
        errors, flips, texels = [], 0, 0
        for number in np.unique(np.concatenate([inner[:9], inner[::max(1, len(inner) // SAMPLES)]])):
            wanted = exact_map(surface, number)
            first = surface.map_offset[number]
            got = surface.normal_atlas[first:first + len(wanted)]
            hit, covered = np.isfinite(wanted[:, 0]), got[:, 3] > 0
            flips, texels = flips + int((hit != covered).sum()), texels + len(got)
            cosine = (decoded_normals(got[hit & covered]) * wanted[hit & covered]).sum(axis=1)
            errors.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        errors = np.concatenate(errors)
        found[str(count)] = {"rms_degrees": float(np.sqrt((errors**2).mean())), "max_degrees": float(errors.max()),
                             "covered_otherwise": flips / texels}
        if not found[str(count)]["rms_degrees"] < EIGHT_BIT or flips > 0.002 * texels:
            raise WrongAnswer(f"bench surfels: maps of a sphere of {count:,} base surfels are "
                              f"{found[str(count)]['rms_degrees']:.3f} degrees off, expected under {EIGHT_BIT}, and "
                              f"{flips} of {texels} texels are covered otherwise")
    return found


def build(scan, device, runs: int):
    """Return the surface, and the time of its build and of its maps."""
    build_surfels(scan, device=device)  # compiles
    seconds, maps = [], []
    for _ in range(runs):
        device.profile = Profile()
        try:
            start = time.perf_counter()
            surface = build_surfels(scan, device=device)
            seconds.append(time.perf_counter() - start)
            maps.append(sum(device.profile.seconds["normal_maps"]))
        finally:
            device.profile = None
    inner = len(surface) - len(surface.base)
    return surface, {"build": record.timing(seconds), "maps": record.timing(maps), "base": len(surface.base),
                     "inner": inner, "levels": int(surface.level.max()), "bytes": surface.nbytes,
                     "mtexels_s": inner * int(surface.map_size[0]) ** 2 / 1e6 / float(np.median(maps))}


def normals(scan, surface, device, size, map_sizes, count: int) -> dict:
    """Return the errors of normals without maps and by the maps' size, means over the views."""
    found, fine, diagonal = {}, [], float(np.linalg.norm(np.ptp(scan.bounds, axis=0)))
    with Renderer(device) as renderer:
        for camera in views.views(scan.bounds, count):
            frame = renderer.render(surface, camera, size, ("normal", "depth"), lod=0.0)
            fine.append((frame.normal, interior(frame.depth, diagonal)))
    for map_size in map_sizes:
        own = surface if map_size == surface.map_size[0] else build_surfels(scan, map_size=map_size, device=device)
        with Renderer(device) as renderer:
            for label, maps in ((f"{map_size}", True), ("none", False)):
                if label in found:
                    continue
                errors = [angle_errors(renderer.render(own, camera, size, ("normal",), surfels=SurfelDrawing(
                    INTERIOR, maps)).normal, *wanted) for camera, wanted in
                    zip(views.views(scan.bounds, count), fine, strict=True)]
                found[label] = {name: float(np.mean([e[name] for e in errors])) for name in errors[0]}
    best = found[str(max(map_sizes))]
    for name in ("mean", "interior_rms"):
        if not best[name] < 0.5 * found["none"][name]:
            raise WrongAnswer(f"bench surfels: normals are {best[name]:.2f} degrees off with maps ({name}), "
                              f"{found['none'][name]:.2f} without: expected at most half")
    return found


def interior(depth, diagonal: float):
    """Return the pixels (h, w) bool around which a surface goes on in the picture."""
    known = np.where(np.isfinite(depth), depth, np.inf)
    with np.errstate(invalid="ignore"):
        jump = maximum_filter(known, AROUND) - minimum_filter(known, AROUND)
    return np.isfinite(depth) & (jump < JUMP * diagonal)


def angle_errors(got, wanted, inside) -> dict:
    """Return mean, median and root mean square angle in degrees where both are seen, and of the pixels `inside`."""
    both = np.isfinite(got[..., 0]) & np.isfinite(wanted[..., 0])
    angle = np.degrees(np.arccos(np.clip((got[both] * wanted[both]).sum(axis=-1), -1, 1)))
    within = angle[inside[both]]
    return {"mean": angle.mean(), "median": np.median(angle), "rms": np.sqrt((angle**2).mean()),
            "interior_mean": within.mean(), "interior_rms": np.sqrt((within**2).mean()),
            "shown_otherwise": float((np.isfinite(got[..., 0]) != np.isfinite(wanted[..., 0])).sum())}


# Times ----------------------------------------------------------------------------------------------------------------


def frames(scan, surface, device, size, count: int) -> dict:
    """Return frame times in turns: with maps, without, the finest level, and a SLIM surface of T_MDL 0.01 beside."""
    slim = clsurf.build_slim(scan, device=device)
    cases = {"maps": (surface, {"surfels": SurfelDrawing(INTERIOR)}),
             "no maps": (surface, {"surfels": SurfelDrawing(INTERIOR, False)}),
             "finest": (surface, {"lod": 0.0}), "slim": (slim, {})}
    cameras, seconds = views.orbit(scan.bounds, count), {name: [] for name in cases}
    with Renderer(device) as renderer:
        for start in range(0, count, BLOCK):
            for name, (thing, options) in cases.items():
                block = cameras[start:start + BLOCK]
                for i, camera in enumerate([*block[:WARM], *block]):
                    begin = time.perf_counter()
                    renderer.render(thing, camera, size, CHANNELS, **options)
                    if i >= WARM:
                        seconds[name].append(time.perf_counter() - begin)
        renderer.profile = Profile()
        for camera in cameras[:BLOCK]:
            renderer.render(surface, camera, size, CHANNELS)
        stages = {label: {"calls": calls / BLOCK, "median_ms": median, "share": share}
                  for label, calls, _, median, share in renderer.profile.rows()}
    return {name: record.timing(times) for name, times in seconds.items()} | {"stages": stages}


# Printing -------------------------------------------------------------------------------------------------------------


def show(figures: dict, profile: bool) -> None:
    """Print the figures."""
    print("normal maps of unit spheres against Algorithm 1 in float64")
    print_table(("base surfels", "RMS deg", "max deg", "covered otherwise"),
                [(f"{int(n):,}", f"{f['rms_degrees']:.3f}", f"{f['max_degrees']:.2f}", f"{f['covered_otherwise']:.4%}")
                 for n, f in figures["spheres"].items()])
    print("builds with maps of 16 x 16")
    print_table(("scan", "base", "inner", "build s", "of it maps s", "Mtexels/s", "MB"),
                [(name, f"{f['base']:,}", f"{f['inner']:,}", f"{f['build']['median_s']:.2f}",
                  f"{f['maps']['median_s']:.3f}", f"{f['mtexels_s']:.1f}", f"{f['bytes'] / 1e6:.1f}")
                 for name, f in figures["builds"].items()])
    print(f"normals at {INTERIOR:g} px against the finest level, degrees")
    of_none = lambda f, e, name: f"{e[name] / f['none'][name]:.3f}"  # noqa: E731
    print_table(("scan", "map", "mean", "of none", "median", "RMS", "of none", "interior mean", "of none",
                 "interior RMS", "of none", "px shown otherwise"),
                [(name, label, f"{e['mean']:.3f}", of_none(f, e, "mean"), f"{e['median']:.3f}", f"{e['rms']:.2f}",
                  of_none(f, e, "rms"), f"{e['interior_mean']:.3f}", of_none(f, e, "interior_mean"),
                  f"{e['interior_rms']:.2f}", of_none(f, e, "interior_rms"), f"{e['shown_otherwise']:.0f}")
                 for name, f in figures["normals"].items() for label, e in sorted(
                     f.items(), key=lambda item: 0 if item[0] == "none" else int(item[0]))])
    print("frames to host arrays of colour, depth and normal, ms")
    print_table(("scan", "maps", "no maps", "finest", "SLIM 0.01"),
                [(name, *(f"{1e3 * f[label]['median_s']:.2f}" for label in ("maps", "no maps", "finest", "slim")))
                 for name, f in figures["frames"].items()])
    if profile:
        for name, f in figures["frames"].items():
            print(f"\nstages of a frame of {name} (each launch waits for the one before)")
            print_table(("kernel", "calls", "median ms", "share"),
                        [(label, f"{s['calls']:g}", f"{s['median_ms']:.3f}", f"{s['share']:.1%}")
                         for label, s in f["stages"].items()])
