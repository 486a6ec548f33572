"""The job `scale_map`: exactness and order of scale maps, builds, frames, the error of geospheres, morphs.

Source: Reiter, "Spherical Scale Mapping", 2005, sections 4 and 5: 2500 triangles and an 8-bit cube map of 128 texels at
320x240, 14 frames a second; steep slopes that a geosphere cannot follow.
"""

import itertools
import statistics
import time

import numpy as np

from clsurf.build.morph import blend, prepared
from clsurf.build.scale_map import build_scale_map
from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer
from clsurf.render.scale_map import cells_of, upload_scale_map
from clsurf.render.scale_map_drawing import ScaleMapDrawing
from clsurf.surface.cube import interpolated, texel_directions
from clsurf.surface.geosphere import geosphere_directions
from clsurf.surface.mesh import Mesh
from clsurf.surface.scale_map import ScaleMap, encoded
from clsurf.trace.hits import trace

from . import record, scenes
from .build import WrongAnswer
from .table import print_table

SIZES = (32, 64, 128, 256)
OFFSET, AXES = np.array([0.3, -0.2, 0.1]), np.array([1.0, 0.75, 0.5])
PICTURE = (640, 480)
BUILD_FLOOR, BUILD_AIM = 0.2, 0.05  # s, 128 texels of the bunny on PoCL
FRAMES_FLOOR, FRAMES_AIM = 80, 250  # a second on PoCL
FRAMES = 40
LEVELS = (2, 3, 4, 5, 6, 7)


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures; `device` is an opened one."""
    figures = {"exact": exact(device, quick), "order": order(quick)}
    if quick:
        scene = scenes.Scene("generated", scenes.wavy_torus(120, 60))
    else:
        scene = scenes.scene(scenes.chosen(("bunny",), quick)[0])
    size = 32 if quick else 128
    figures["scene"] = scene.name
    figures["build"] = builds(scene.scan, size, device, quick)
    surface = build_scale_map(scene.scan, size=size, bits=16, normals=True, device=device)
    figures["rays"] = {"several_hits": surface.multiple_share, "without_hit": surface.hole_share}
    figures["frames"] = frames(surface, device, quick)
    figures["geosphere"] = geosphere_errors(surface, device, LEVELS[:3] if quick else LEVELS)
    figures["morph"] = morphs(surface, device)
    show(figures)
    return figures


def exact(device, quick: bool) -> dict:
    """Return how far built maps are from closed forms, in units of lambda.

    Raises
    ------
    WrongAnswer
        A centred sphere that is not 1 everywhere, or a 16-bit error above 1e-4.
    """
    steps = 64 if quick else 256
    sphere = geosphere_mesh(steps)
    centred = build_scale_map(sphere, size=64, device=device)
    if not ((centred.scales == 255).all() and centred.valid.all()):
        raise WrongAnswer("bench scale_map: expected 1 everywhere of a centred sphere: mend build_scale_map first")
    d, found = texel_directions(64), {}
    for name, mesh, distance in (
            ("offset sphere", Mesh(sphere.vertices + OFFSET, sphere.faces), offset_sphere(d)),
            ("ellipsoid", Mesh(sphere.vertices * AXES, sphere.faces), 1 / np.linalg.norm(d / AXES, axis=-1))):
        built = build_scale_map(mesh, size=64, center=(0, 0, 0), bits=16, device=device)
        found[name] = float(np.abs(built.lambdas[0] - distance / built.radius).max())
        if found[name] > (1e-3 if quick else 1e-4):
            raise WrongAnswer(f"bench scale_map, {name}: expected lambda within 1e-4, got {found[name]:.3g}: mend "
                              "build_scale_map first")
    return found


def order(quick: bool) -> dict:
    """Return the largest error of lambda between texels by size, of exact texels, and the orders."""
    d = np.random.default_rng(0).normal(size=(20_000 if quick else 200_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    found = {}
    for name, distance in (("offset sphere", offset_sphere),
                           ("ellipsoid", lambda d: 1 / np.linalg.norm(d / AXES, axis=-1))):
        errors = []
        for size in SIZES:
            texels = distance(texel_directions(size))
            got, _ = interpolated(texels, np.ones(texels.shape, bool), d)
            errors.append(float(np.abs(got - distance(d)).max() / texels.max()))
        orders = np.log2(np.divide(errors[:-1], errors[1:])).tolist()
        if min(orders) < 1.7:
            raise WrongAnswer(f"bench scale_map, {name}: expected order 2 between texels, got {orders}")
        found[name] = {"errors": dict(zip(map(str, SIZES), errors, strict=True)), "orders": orders}
    return found


def offset_sphere(d):
    """Distance from zero to the unit sphere about OFFSET in unit directions (..., 3)."""
    b = d @ OFFSET
    return b + np.sqrt(b * b - OFFSET @ OFFSET + 1)


def geosphere_mesh(steps: int) -> Mesh:
    """Return the unit geosphere of 20 steps^2 triangles."""
    d = geosphere_directions(steps)
    return Mesh(d.reshape(-1, 3).astype(np.float32), grid_faces(10, steps + 1))


def grid_faces(grids: int, side: int):
    """Return the triangles (n, 3) of square grids of nodes, counter-clockwise from outside on geospheres."""
    at = np.arange(grids * side * side).reshape(grids, side, side)
    a, b, c, d = at[:, :-1, :-1], at[:, :-1, 1:], at[:, 1:, :-1], at[:, 1:, 1:]
    return np.concatenate([np.stack(x, axis=-1).reshape(-1, 3) for x in ((a, c, b), (d, b, c))])


def builds(scan, size, device, quick) -> dict:
    """Return the times of maps of a scan."""
    found = {}
    for name, options in (("8 bits", {}), ("16 bits, normals, 3 layers", {"bits": 16, "normals": True, "layers": 3})):
        seconds = []
        for _ in range(4 if quick else 10):
            start = time.perf_counter()
            build_scale_map(scan, size=size, device=device, **options)
            seconds.append(time.perf_counter() - start)
        found[name] = record.timing(seconds[2:])
    return found


def frames(surface, device, quick) -> dict:
    """Return the times of frames with colour, depth and normal, the camera moving."""
    size = (160, 120) if quick else PICTURE
    camera = Camera.framing(surface, direction=(1, 0.5, 2), aspect=size[0] / size[1])
    middle, found = surface.bounds.mean(axis=0), {}
    ways = {"rays of pixels": ScaleMapDrawing(), "geosphere of 81,920": ScaleMapDrawing("geosphere", 6),
            "geosphere of 20,480": ScaleMapDrawing("geosphere", 5)}
    for name, drawing in ways.items():
        with Renderer(device) as renderer:
            seconds = []
            for k in range(8 if quick else FRAMES):
                turned = camera.orbited(middle, 9 * k)
                start = time.perf_counter()
                frame = renderer.render(surface, turned, size, scale_map=drawing)
                seconds.append(time.perf_counter() - start)
            if not np.isfinite(frame.depth).mean() > 0.02:
                raise WrongAnswer(f"bench scale_map, {name}: expected a picture of the surface, got nothing")
            found[name] = record.timing(seconds[4:])
    return found


def geosphere_errors(surface, device, levels) -> dict:
    """Return how far displaced geospheres are from the map itself along rays from the centre, radii, by level."""
    d = np.random.default_rng(0).normal(size=(50_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    value, known = interpolated(np.nan_to_num(surface.lambdas[0].astype(np.float64)), surface.valid[0], d)
    upload, found = upload_scale_map(device, surface), {}
    for level in levels:
        cells = cells_of(device, upload, ScaleMapDrawing("geosphere", level))
        points = device.download(cells.positions)[:, :cells.grids * cells.side**2].T
        mesh = Mesh(np.ascontiguousarray(points), grid_faces(cells.grids, cells.side))
        hits = trace(mesh, np.zeros(3), d, device=device)
        use = known & hits.hit
        gap = np.abs(hits.distance[use] - value[use])
        found[str(level)] = {"triangles": 20 * 4**level, "rms": float(np.sqrt(np.mean(gap**2))),
                             "median": float(np.median(gap)), "p99": float(np.quantile(gap, 0.99)),
                             "max": float(gap.max())}
    rms = [one["rms"] for one in found.values()]
    if not all(finer < coarser for coarser, finer in itertools.pairwise(rms)):
        raise WrongAnswer(f"bench scale_map: expected finer geospheres to be nearer, got RMS {rms}")
    return found


def morphs(surface, device) -> dict:
    """Return the error of concentric spheres, in codes, and the time of a blend.

    Raises
    ------
    WrongAnswer
        A mean radius that is more than half a code off.
    """
    size = surface.size
    ball = lambda r: ScaleMap((0, 0, 0), 2.0, encoded(np.full((1, 6, size, size), r / 2), 8),  # noqa: E731
                              np.ones((1, 6, size, size), bool))
    a, b, worst = ball(1.0), ball(2.0), 0.0
    parts = prepared([a, b], device)
    ends = [float(p["distance"].mean()) for p in parts]
    for t in np.linspace(0, 1, 9):
        got = blend(parts, [1 - t, t])
        mean = float((got.lambdas[0] * got.radius).mean())
        worst = max(worst, abs(mean - ((1 - t) * ends[0] + t * ends[1])) / (2 / 255))
    if worst > 0.5 + 1e-3:
        raise WrongAnswer(f"bench scale_map: expected spheres between within half a code, got {worst:.3f} codes")
    parts, seconds = prepared([surface, ball(1.0)], device), []
    for t in np.linspace(0.1, 0.9, 9):
        start = time.perf_counter()
        blend(parts, [1 - t, t])
        seconds.append(time.perf_counter() - start)
    return {"spheres_codes": worst, "blend_s": statistics.median(seconds)}


def show(figures: dict) -> None:
    """Print the figures beside floors and aims."""
    print_table(("closed forms", "largest error, 16 bits", *(f"between texels, {s}" for s in SIZES), "orders"),
                [(name, f"{error:.2e}", *(f"{figures['order'][name]['errors'][str(s)]:.2e}" for s in SIZES),
                  ", ".join(f"{o:.2f}" for o in figures["order"][name]["orders"]))
                 for name, error in figures["exact"].items()])
    rays = figures["rays"]
    print(f"{figures['scene']}: {rays['several_hits']:.2%} of the rays with several hits, {rays['without_hit']:.2%} of "
          "the texels without one")
    limits = f"{1e3 * BUILD_FLOOR:g} ms", f"{1e3 * BUILD_AIM:g} ms"
    rows = [(f"build, {name}", f"{1e3 * one['median_s']:.1f} ms", *limits)
            for name, one in figures["build"].items()]
    rows += [(f"frames, {name}", f"{1 / one['median_s']:.0f} a second", f"{FRAMES_FLOOR}", f"{FRAMES_AIM}")
             for name, one in figures["frames"].items()]
    rows += [("concentric spheres, morphed", f"{figures['morph']['spheres_codes']:.3f} codes", "0.5", ""),
             ("a morph", f"{1e3 * figures['morph']['blend_s']:.1f} ms", "", "")]
    print_table(("figure", "", "floor (PoCL)", "aim"), rows)
    print("geospheres against the map itself, along rays from the centre, % of the radius")
    print_table(("level", "triangles", "RMS", "median", "99 %", "max"),
                [(level, f"{one['triangles']:,}", *(f"{100 * one[k]:.4f}" for k in ("rms", "median", "p99", "max")))
                 for level, one in figures["geosphere"].items()])
