"""The job `channels`: what channels of curvature cost on a frame, and how true they are on a torus.

The answer is checked first: curvature at the pixels of a torus by surfels of less and less error, against its formula,
for both sides of the paper's equation 8. Then frames of colour, depth and normal alone and with channels of curvature
take turns on the same orbit of 1 degree a frame.
"""

import time

import numpy as np

from clsurf import models
from clsurf.build.slim import build_slim
from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer
from clsurf.render.slim_drawing import SlimDrawing

from . import record, scenes
from .build import WrongAnswer, built
from .table import print_table
from .tiles import BLOCK, CHANNELS, WARM, Case, in_turns

FLOOR, AIM = 1.40, 1.20  # a frame with mean and gaussian over one without
MAJOR, MINOR = 1.0, 0.4
ERRORS = (0.01, 0.003, 0.001)  # of the torus's surfaces, T_MDL
SECOND = ("mean", "gaussian", "k1", "k2", "direction1", "direction2", "radial")
THIRD = ("derivative1", "derivative2", "radial_derivative")
SETS = {"plain": (), "mean, gaussian": ("mean", "gaussian"), "lines": ("radial", "radial_derivative"),
        "k1, k2": ("k1", "k2"), "all of order 2": SECOND, "all": (*SECOND, *THIRD)}
CASES = (Case("bunny 500", "bunny", size=(500, 500)), Case("dragon 1024", "dragon"),
         Case("bunny 500 cubic", "bunny", degree=3, size=(500, 500)), Case("dragon 1024 cubic", "dragon", degree=3))
QUICK_CASES = (Case("generated 500", "generated", size=(500, 500)),
               Case("generated 500 cubic", "generated", degree=3, size=(500, 500)))


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of channels of curvature; `device` is an opened one."""
    errors, count = (ERRORS[1:2], 20_000) if quick else (ERRORS, 100_000)
    figures = {"torus": torus(device, errors, count, (128, 128) if quick else (512, 512))}
    names = scenes.chosen(("bunny", "dragon"), quick)
    cases = QUICK_CASES if names == ["generated"] else [case for case in CASES if case.scene in names]
    figures["frames"] = frames(cases, device, BLOCK if quick else 3 * BLOCK)
    show(figures)
    return figures


# The answer ----------------------------------------------------------------------------------------------------------


def torus(device, errors, count: int, size) -> list[dict]:
    """Return relative RMS errors of mean and Gaussian curvature at the pixels of a torus of `count` points.

    Raises
    ------
    WrongAnswer
        Curvature of something else.
    """
    cloud, out = models.torus(count, MAJOR, MINOR), []
    camera = Camera.look_at((0.6, -2.4, 3.2), (0, 0, 0), up=(0, 0, 1))
    with Renderer(device) as renderer:
        for degree in (2, 3):
            for error in errors:
                surface = build_slim(cloud, degree=degree, error=error, device=device)
                row = {"degree": degree, "error": error, "leaves": int(surface.leaf.sum()),
                       "radius": float(np.median(surface.radii[surface.leaf]))}
                for kind in ("separate", "function"):
                    frame = renderer.render(surface, camera, size, ("position", "mean", "gaussian"), lod=0,
                                            slim=SlimDrawing(kind))
                    row |= {f"{kind}_{name}": value for name, value in torus_errors(frame).items()}
                out.append(row)
    worst = max(row["separate_mean"] for row in out)
    if not worst < 0.2:
        raise WrongAnswer(f"bench channels torus: expected its mean curvature at the pixels, got a relative RMS error "
                          f"of {worst:.3f}: mend the channels before timing them")
    return out


def torus_errors(frame) -> dict:
    """Return the relative RMS errors of a frame's mean and Gaussian curvature of the torus."""
    hit = np.isfinite(frame.mean)
    place = (frame.position[hit] + frame.origin).astype(np.float64)
    ring = np.hypot(place[:, 0], place[:, 1])
    # On the torus nearest to the place; the tube's curvature, and that of the ring.
    cosine = (ring - MAJOR) / np.hypot(ring - MAJOR, place[:, 2])
    k1, k2 = 1 / MINOR, cosine / (MAJOR + MINOR * cosine)
    wanted = {"mean": (k1 + k2) / 2, "gaussian": k1 * k2}
    return {name: float(np.sqrt(np.mean((frame.channels[name][hit] - value) ** 2) / np.mean(value**2)))
            for name, value in wanted.items()}


# Times ---------------------------------------------------------------------------------------------------------------


def frames(cases, device, count: int) -> dict:
    """Return the time of a frame of every case by channels, and over that of the plain frame."""
    runners, orbits, found = {}, {}, {}
    renderer = Renderer(device)
    for case in cases:
        surface = built(scenes.scene(case.scene), case.degree, device)
        orbits[case.name] = case.cameras(count + WARM)
        for label, names in SETS.items():
            if case.degree == 3 or not set(names) & set(THIRD):
                runners[case.name, label] = _runner(renderer, surface, case, (*CHANNELS, *names))
        _check(renderer, surface, case, orbits[case.name][0])
    seconds, _ = in_turns(runners, orbits, count)
    renderer.close()
    for (name, label), times in seconds.items():
        mine = found.setdefault(name, {})
        mine[label] = record.timing(times)
        mine[label]["times_plain"] = mine[label]["median_s"] / mine["plain"]["median_s"]
    return found


def _check(renderer, surface, case, camera) -> None:
    """Raise WrongAnswer unless channels of curvature leave the depth as it is and have values where there is one."""
    plain = renderer.render(surface, camera, case.size, CHANNELS)
    more = renderer.render(surface, camera, case.size, (*CHANNELS, "mean", "gaussian"))
    same = np.mean(np.isclose(plain.depth, more.depth, rtol=1e-5, equal_nan=True))
    seen = np.isfinite(more.depth)
    if same < 0.9999 or not np.isfinite(more.mean[seen]).all() or np.isfinite(more.mean[~seen]).any():
        raise WrongAnswer(f"bench channels {case.name}: expected the same picture with curvature where it shows "
                          f"something, got {same:.4%} of its pixels: mend the channels before timing them")


def _runner(renderer, surface, case, channels):
    def run(camera) -> float:
        start = time.perf_counter()
        renderer.render(surface, camera, case.size, channels=channels)
        return time.perf_counter() - start

    return run


# Printing ------------------------------------------------------------------------------------------------------------


def show(figures: dict) -> None:
    """Print the figures."""
    print("torus: relative RMS error at the pixels, blended derivatives / derivatives of the blended function")
    rows, before = [], None
    for row in figures["torus"]:
        order = "-"
        if before and before["degree"] == row["degree"]:
            smaller = np.log(before["radius"] / row["radius"])
            order = f"{np.log(before['separate_mean'] / row['separate_mean']) / smaller:.1f}"
        rows.append((f"degree {row['degree']}, T {row['error']:g}", row["leaves"], f"{row['radius']:.3f}",
                     f"{row['separate_mean']:.5f} / {row['function_mean']:.5f}",
                     f"{row['separate_gaussian']:.5f} / {row['function_gaussian']:.5f}", order))
        before = row
    print_table(("surface", "leaves", "radius", "mean", "gaussian", "order of mean"), rows)
    labels = list(SETS)
    print("frames to host arrays of colour, depth, normal and these; ms (times the plain one; mean and gaussian: floor "
          f"{FLOOR:.2f}, aim {AIM:.2f})")
    print_table(("case", *labels),
                [(name, *(f"{1e3 * f[s]['median_s']:.2f} ({f[s]['times_plain']:.2f}x)" if s in f else "-"
                          for s in labels)) for name, f in figures["frames"].items()])
