"""The job `lines`: feature lines against the torus's analytic curves, and frames with lines over them.

A line's distance from its curve is |f| / |grad f| in pixels, f the curvature whose zeros the curve is, on the exact
torus along the pixel's ray. A frame is the picture, the lines in it and the strokes over it, to host arrays; the camera
orbits by 1 degree a frame.
"""

import time

import numpy as np

from clsurf import models
from clsurf.analysis.lines import line_channels, lines
from clsurf.build.slim import build_slim
from clsurf.device import Profile
from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer

from . import record, scenes, views
from .build import WrongAnswer
from .table import print_table

FLOORS = {"suggestive_contours": (0.3, 0.15), "parabolic": (0.4, 0.2)}  # pixels: floor, aim
FRAME_FLOOR, FRAME_AIM = 4.0, 15.0  # frames a second
KINDS = ("contours", "suggestive_contours", "ridges")
TORUS_POINTS, TORUS_ERRORS = 51200, (0.003, 0.002, 0.001)
TORUS_DIRECTIONS = ((1.0, 0.2, 0.7), (0.3, -1.0, 0.55))  # from the torus, about the z axis, to the eye
MAJOR, MINOR = 1.0, 0.4
FRAME_ERROR = 0.02  # of the surface that lines are found on: coarse ones give the cleaner lines
WARM = 3


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of feature lines; `device` is an opened one."""
    size = (256, 256) if quick else (1024, 1024)
    figures = {"torus": torus(device, size, 20000 if quick else TORUS_POINTS)}
    name = scenes.chosen(("dragon",), quick)[0]
    figures["frames"] = {"scene": name, **frames(scenes.scene(name), device, size, 4 if quick else 24)}
    show(figures, profile)
    return figures


# The answer ----------------------------------------------------------------------------------------------------------


def torus(device, size, count: int) -> dict:
    """Return the distances of the lines of a torus of `count` points from its analytic curves in pixels, by the error
    of the surface and the kind of line, over two views.

    Raises
    ------
    WrongAnswer
        No lines, or lines somewhere else.
    """
    scan, out = models.torus(count), {}
    for error in TORUS_ERRORS:
        surface, pictures = build_slim(scan, degree=3, error=error, device=device), []
        with Renderer(device) as renderer:
            for direction in TORUS_DIRECTIONS:
                camera = Camera.framing(surface, direction, fov=35, up=(0, 0, 1))
                pictures.append(renderer.render(surface, camera, size, line_channels(tuple(FLOORS))))
        out[str(error)] = {kind: torus_lines(pictures, kind, device) for kind in FLOORS}
    return out


def torus_lines(pictures, kind: str, device) -> dict:
    """Return the distances of the lines of `kind` in frames of the torus; raises WrongAnswer."""
    away = []
    for frame in pictures:
        found = lines(frame, kind, detail=4, device=device)
        away.append(torus_distances(found.points.astype(np.float64), frame.camera, frame.size, 2, kind))
    away = np.concatenate(away)
    if len(away) < pictures[0].size[0] / 8 or not np.median(away) < 2:
        raise WrongAnswer(f"bench lines torus: expected {kind} on the analytic curve, got {len(away)} vertices at "
                          f"a median distance of {np.median(away) if len(away) else np.nan:.2f} pixels")
    return {"mean_px": float(np.mean(away)), "median_px": float(np.median(away)),
            "p95_px": float(np.quantile(away, 0.95)), "vertices": len(away)}


def torus_distances(points, camera, size, axis: int, kind: str):
    """Return the distances (n,) in pixels of points (n, 2) from the curve of `kind` on the exact torus about `axis`."""
    step = 0.25
    value = torus_curvature(points, camera, size, axis, kind)
    slope = [(torus_curvature(points + d, camera, size, axis, kind)
              - torus_curvature(points - d, camera, size, axis, kind)) / (2 * step)
             for d in (np.array([step, 0]), np.array([0, step]))]
    away = np.abs(value) / np.hypot(*slope)
    return away[np.isfinite(away)]


def torus_curvature(points, camera, size, axis: int, kind: str):
    """Return the radial curvature ("suggestive_contours") or cos v, which the Gaussian curvature's sign is that of."""
    p = camera.projection(size)
    view = np.stack([(points[:, 0] - p.cx) / p.fx, (p.cy - points[:, 1]) / p.fy, -np.ones(len(points))], axis=1)
    ray = view @ camera.rotation
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    place = camera.eye + max(np.linalg.norm(camera.eye) - 1.01 * (MAJOR + MINOR), 0) * ray
    flat = np.ones(3)
    flat[axis] = 0
    for _ in range(200):  # sphere tracing: the distance to the torus is known exactly
        rho = np.linalg.norm(place * flat, axis=1)
        distance = np.hypot(rho - MAJOR, place[:, axis]) - MINOR
        place = place + distance[:, None] * ray
    rho = np.linalg.norm(place * flat, axis=1)
    cosine = (rho - MAJOR) / MINOR
    if kind == "parabolic":
        return np.where(np.abs(distance) < 1e-6, cosine, np.nan)
    normal = (place * flat / rho[:, None] * (rho - MAJOR)[:, None] + place * (1 - flat)) / MINOR
    around = np.cross(np.eye(3)[axis], place / rho[:, None])
    across = np.cross(normal, around)
    a, b = (ray * across).sum(axis=1), (ray * around).sum(axis=1)
    radial = (a * a / MINOR + b * b * cosine / rho) / (a * a + b * b)
    return np.where(np.abs(distance) < 1e-6, radial, np.nan)


# Times ---------------------------------------------------------------------------------------------------------------


def frames(scene, device, size, count: int) -> dict:
    """Return the times of whole frames, of their parts, and of every kernel."""
    surface = build_slim(scene.scan, degree=3, error=FRAME_ERROR, device=device)
    channels = ("color", *line_channels(KINDS))
    parts = {"whole": [], "render": [], "lines": [], "strokes": []}
    with Renderer(device) as renderer:
        def run(camera):
            start = time.perf_counter()
            frame = renderer.render(surface, camera, size, channels)
            rendered = time.perf_counter()
            found = lines(frame, KINDS, device=device)
            traced = time.perf_counter()
            drawn = found.draw(frame)
            end = time.perf_counter()
            return (end - start, rendered - start, traced - rendered, end - traced), found, drawn

        orbit = views.orbit(scene.box, count + WARM)
        for i, camera in enumerate(orbit):
            seconds, found, drawn = run(camera)
            if i >= WARM:
                for name, value in zip(parts, seconds, strict=True):
                    parts[name].append(value)
        if not (len(found) and drawn.lines.max() > 0.5 and np.isfinite(drawn.color).all()):
            raise WrongAnswer(f"bench lines {scene.name}: expected lines in the picture, got {found}")
        device.profile = Profile()
        try:
            for camera in orbit[:5]:
                run(camera)
            rows = device.profile.rows()
        finally:
            device.profile = None
    return {"line_count": len(found), "vertices": len(found.points),
            "frames_per_second": 1 / float(np.median(parts["whole"])),
            **{name: record.timing(seconds) for name, seconds in parts.items()},
            "stages": {label: {"calls": calls, "min_ms": low, "median_ms": median, "share": share}
                       for label, calls, low, median, share in rows}}


# Printing ------------------------------------------------------------------------------------------------------------


def show(figures: dict, profile: bool) -> None:
    """Print the figures beside their floors and aims."""
    print("torus: distance of lines from the analytic curve, pixels")
    print_table(("kind", "error", "mean", "median", "95 %", "vertices", "floor", "aim"),
                [(kind, error, f"{f['mean_px']:.3f}", f"{f['median_px']:.3f}", f"{f['p95_px']:.3f}", f["vertices"],
                  *FLOORS[kind]) for error, kinds in figures["torus"].items() for kind, f in kinds.items()])
    f = figures["frames"]
    print(f"frames of {f['scene']} with {', '.join(KINDS)} over the picture: {f['line_count']} lines, {f['vertices']} "
          f"vertices; {f['frames_per_second']:.1f} a second (floor {FRAME_FLOOR:g}, aim {FRAME_AIM:g})")
    print_table(("part", "ms", "min ms"), [(name, f"{1e3 * f[name]['median_s']:.1f}", f"{1e3 * f[name]['min_s']:.1f}")
                                           for name in ("whole", "render", "lines", "strokes")])
    if profile:
        print("\nstages (each launch waits for the one before)")
        print_table(("kernel", "calls", "min ms", "median ms", "share"),
                    [(label, s["calls"], f"{s['min_ms']:.3f}", f"{s['median_ms']:.3f}", f"{s['share']:.1%}")
                     for label, s in f["stages"].items()])
