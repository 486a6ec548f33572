"""The job `light`: what materials, skies, shadows and anti-aliasing cost on a frame, and how true they are.

The answer is checked first: a white sphere in white light from all sides, and the edges of a picture drawn with
coverage against the same with 4 x 4 samples everywhere. Then frames take turns on the same orbit of 1 degree a frame.
"""

import time

import numpy as np

from clsurf import models
from clsurf.build.slim import build_slim
from clsurf.render.camera import Camera
from clsurf.render.light import Light
from clsurf.render.material import Material
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Shading

from . import record, scenes
from .build import WrongAnswer, built
from .table import print_table
from .tiles import BLOCK, WARM, Case, in_turns

CASES = (Case("bunny 500", "bunny", size=(500, 500)), Case("dragon 1024", "dragon"))
QUICK_CASES = (Case("generated 500", "generated", size=(500, 500)),)
LAMP, SKY = Light("directional", (1.0, 2.0, 1.0)), Light("image", picture="studio")
# What is drawn: lights, material, and options of `render`.
LOOKS = {
    "plain": ((Light(),), None, {}),
    "matcap": ((Light(),), Material("matcap"), {}),
    "physical, 1 lamp": ((LAMP,), Material("physical"), {}),
    "phong, sky": ((SKY,), None, {}),
    "physical, sky": ((SKY,), Material("physical"), {}),
    "physical, sky, 32 directions": ((SKY,), Material("physical"), {"shading": Shading(occlusion=32)}),
    "coverage": ((Light(),), None, {"antialias": "coverage"}),
    "supersampling 2": ((Light(),), None, {"supersampling": 2}),
    "supersampling 4": ((Light(),), None, {"supersampling": 4}),
}


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of light; `device` is an opened one."""
    names = scenes.chosen(("bunny", "dragon"), quick)
    cases = QUICK_CASES if names == ["generated"] else [case for case in CASES if case.scene in names]
    figures = {"furnace": furnace(device), "edges": {}, "frames": {}}
    surfaces = {case.name: built(scenes.scene(case.scene), case.degree, device) for case in cases}
    for case in cases:
        figures["edges"][case.name] = edges(device, surfaces[case.name], case.cameras(1)[0], case.size)
    figures["frames"] = frames(cases, surfaces, device, BLOCK if quick else 2 * BLOCK)
    show(figures)
    return figures


# The answer ----------------------------------------------------------------------------------------------------------


def furnace(device) -> dict:
    """Return the largest deviation from white of white spheres in white light, by roughness.

    Raises
    ------
    WrongAnswer
        Light is lost or made.
    """
    ball = build_slim(models.ellipsoid(3000), degree=2, error=0.01, device=device)
    light, camera = Light("image", picture=np.ones((32, 64, 3), np.float32)), Camera.framing(ball)
    out = {}
    with Renderer(device) as renderer:
        for roughness in (0.0, 0.5, 1.0):
            for metallic in (0.0, 1.0):
                material = Material("physical", (1.0, 1.0, 1.0), metallic=metallic, roughness=roughness)
                frame = renderer.render(Scene([ball], [light], material), camera, (128, 128))
                hit = np.isfinite(frame.depth)
                out[f"roughness {roughness:g}, metallic {metallic:g}"] = float(
                    np.abs(frame.color[..., :3][hit] - 1).max())
    if not max(out.values()) < 1e-3:
        raise WrongAnswer(f"bench light: expected white spheres in white light, got {max(out.values()):.4f} off: mend "
                          "the materials before timing them")
    return out


def edges(device, surface, camera, size) -> dict:
    """Return the RMS differences, over pixels that 4 x 4 samples change, of frames without and with coverage.

    Raises
    ------
    WrongAnswer
        Coverage is not what more samples give.
    """
    with Renderer(device) as renderer:
        plain, coverage, fine = (renderer.render(surface, camera, size, ("color",), lod=0.0, antialias=kind).color
                                 for kind in ("none", "coverage", "supersample"))
    changed = np.abs(plain - fine).max(axis=2) > 0.02
    found = {"edge_pixels": int(changed.sum())} | {
        name: float(np.sqrt(np.mean((color - fine)[changed] ** 2))) for name, color in (("plain_rms", plain),
                                                                                       ("coverage_rms", coverage))}
    if not found["coverage_rms"] < 0.25 * found["plain_rms"]:
        raise WrongAnswer(f"bench light: expected edges as 4 x 4 samples draw them, got {found}: mend the coverage "
                          "before timing it")
    return found


# Times ---------------------------------------------------------------------------------------------------------------


def frames(cases, surfaces, device, count: int) -> dict:
    """Return the time of a frame of every case by looks, and over that of the plain frame."""
    renderer, orbits, runners, found = Renderer(device), {}, {}, {}
    for case in cases:
        orbits[case.name] = case.cameras(count + WARM)
        for label, (lights, material, options) in LOOKS.items():
            scene = Scene([surfaces[case.name]], lights, material)
            runners[case.name, label] = _runner(renderer, scene, case.size, options)
    seconds, _ = in_turns(runners, orbits, count)
    renderer.close()
    for (name, label), times in seconds.items():
        mine = found.setdefault(name, {})
        mine[label] = record.timing(times)
        mine[label]["times_plain"] = mine[label]["median_s"] / mine["plain"]["median_s"]
    return found


def _runner(renderer, scene, size, options):
    def run(camera) -> float:
        start = time.perf_counter()
        renderer.render(scene, camera, size, ("color", "depth", "normal"), **options)
        return time.perf_counter() - start

    return run


# Printing ------------------------------------------------------------------------------------------------------------


def show(figures: dict) -> None:
    """Print the figures."""
    print("white spheres in white light: largest deviation from white")
    print_table(("material", "off"), [(name, f"{off:.6f}") for name, off in figures["furnace"].items()])
    print("pixels that 4 x 4 samples change: RMS difference from them")
    print_table(("case", "pixels", "one sample", "coverage"),
                [(name, f["edge_pixels"], f"{f['plain_rms']:.4f}", f"{f['coverage_rms']:.4f}")
                 for name, f in figures["edges"].items()])
    print("frames to host arrays of colour, depth and normal; ms (times the plain one)")
    print_table(("look", *figures["frames"]),
                [(label, *(f"{1e3 * f[label]['median_s']:.2f} ({f[label]['times_plain']:.2f}x)"
                           for f in figures["frames"].values())) for label in LOOKS])
