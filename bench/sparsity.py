"""The job `sparsity`: surfels and floats needed by degree for one L2 error, and linear splats beside quadratic surfels.

Source: paper 003, section 4, "Sparsity analysis", figures 21 and 22: 5.4K linear, 1.9K quadratic or 1.3K cubic surfels
for 0.01 % of the diagonal on a hand; a quadratic picture beside one of linear primitives.
"""

import time

import numpy as np
from scipy.spatial import cKDTree

from clsurf.analysis.sparsity import CURVE, sparsity
from clsurf.build.slim import build_slim
from clsurf.render.renderer import Renderer
from clsurf.surface.slim import FLOATS, frame_of_normals

from . import quality, scenes, truth, views
from .build import WrongAnswer, overlap, world_points
from .table import print_table

TARGET = 1e-4  # L2 error over the diagonal
T_MDL = 0.01  # of the pictures
# (degree, to degree): floor, aim (the paper's).
RATIOS = {(2, 1): (0.45, 0.35), (3, 2): (0.75, 0.68)}
SIZE = (1024, 1024)
FRAMES = 5


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures; `device` is an opened one."""
    figures = {}
    for name in scenes.chosen(("bunny",), quick):
        scene = scenes.Scene(name, scenes.wavy_torus(200, 80)) if quick else scenes.scene(name)
        study = sparsity(scene.scan, TARGET, curve=(0.01, 0.04) if quick else CURVE, device=device)
        figures[name] = {"study": studied(scene, study, device), "beside": beside(scene, device, quick)}
        print(f"{name}: {len(scene.scan.points):,} points")
        print(study.table())
    show(figures)
    return figures


def studied(scene, study, device) -> dict:
    """Return the study as plain figures.

    Raises
    ------
    WrongAnswer
        An error above the target, points without a leaf, or an error that the paper's own measure does not confirm.
    """
    found = {"target": study.target, "needed": {}, "curves": {}}
    for degree, one in study.needed.items():
        if one is None:
            raise WrongAnswer(f"bench sparsity {scene.name}: no surface of degree {degree} within {study.target:g}")
        surface = build_slim(scene.scan, degree=degree, error=one.t_mdl, device=device)
        points = world_points(scene.scan)
        covered = float(overlap(surface, points).min())
        paper = along_normals(surface, points, scene.scan.normals) / surface.diagonal
        if one.rms > study.target or covered <= 0 or not 0.9 < paper / one.rms < 1.15:
            raise WrongAnswer(f"bench sparsity {scene.name}, degree {degree}: expected every point covered and an L2 "
                              f"error of at most {study.target:g}, along normals too, got overlap {covered:.3f}, "
                              f"{one.rms:.3g} and {paper:.3g}: mend the builder or the projection first")
        found["needed"][str(degree)] = vars(one) | {"rms_along_normals": paper}
        found["curves"][str(degree)] = [vars(s) for s in study.curves[degree]]
    found["ratios"] = {f"{degree}/{to}": study.ratio(degree, to) for degree, to in RATIOS}
    return found


def along_normals(surface, points, normals) -> float:
    """Return the L2 error as the paper measures it: every point moved along its normal by equation 6, on the host.

    q is the mean, weighted by G, of where the line through the point along its normal meets the leaves whose balls
    hold the point; leaves that face away are left out, as those of the far side of a thin sheet.
    """
    c, r, n = (np.asarray(a[surface.leaf], np.float64) for a in (surface.centers, surface.radii, surface.normals))
    k = np.zeros((len(c), 10))
    k[:, :surface.coefficients.shape[1]] = surface.coefficients[surface.leaf]
    axes = (*frame_of_normals(n), n)
    local = points - surface.origin
    inside = cKDTree(local).query_ball_point(c, r, return_sorted=False)
    count = np.array([len(found) for found in inside])
    point, leaf = np.concatenate([np.asarray(found, np.int64) for found in inside]), np.repeat(np.arange(len(c)), count)
    start = np.stack([((local[point] - c[leaf]) * a[leaf]).sum(axis=1) for a in axes])
    along = np.stack([(normals[point] * a[leaf]).sum(axis=1) for a in axes])
    k, radius, t = k[leaf].T, r[leaf], np.zeros(len(point))
    for _ in range(6):  # Newton from the point itself
        u, v, w = start + t * along
        f = w - (k[0] + k[1] * u + k[2] * v + k[3] * u * u + k[4] * u * v + k[5] * v * v + k[6] * u**3
                 + k[7] * u * u * v + k[8] * u * v * v + k[9] * v**3)
        fu = k[1] + 2 * k[3] * u + k[4] * v + 3 * k[6] * u * u + 2 * k[7] * u * v + k[8] * v * v
        fv = k[2] + k[4] * u + 2 * k[5] * v + k[7] * u * u + 2 * k[8] * u * v + 3 * k[9] * v * v
        slope = along[2] - fu * along[0] - fv * along[1]
        t = np.clip(t - f / np.where(np.abs(slope) < 0.05, 0.05, slope), -radius, radius)
    g = np.maximum(1 - ((start + t * along) ** 2).sum(axis=0) / radius**2, 0) ** 3
    g *= (along[2] > 0) & (np.abs(f) < 1e-3 * radius)
    total = np.bincount(point, g, len(points))
    reached = total > 0
    mean = np.bincount(point, g * t, len(points))[reached] / total[reached]
    return float(np.sqrt(np.mean(mean**2)))


# Linear splats beside quadratic surfels -------------------------------------------------------------------------------


def beside(scene, device, quick: bool) -> dict:
    """Return size, error, normals and frame time of a quadratic surface and of linear ones at its cost.

    At equal floats, and at equal frame time: the finest linear surface that is drawn no slower.
    """
    quadratic = build_slim(scene.scan, degree=2, error=T_MDL, device=device)
    floats = FLOATS[2] * int(quadratic.leaf.sum())
    equal = linear_of_floats(scene.scan, floats, device)
    finer = [build_slim(scene.scan, degree=1, error=t, device=device) for t in ((0.005,) if quick else (0.001, 0.003))]
    surfaces = {"quadratic": quadratic, "linear, equal floats": equal}
    surfaces |= {f"linear, T {s.error:g}": s for s in finer}
    size = (256, 256) if quick else SIZE
    camera = views.views(scene.box, 8)[0]
    exact = truth.cast(scene.scan, camera, size, key=scene.key)
    figures, seconds = {}, {name: [] for name in surfaces}
    renderers = {name: Renderer(device) for name in surfaces}
    frames = {name: renderers[name].render(s, camera, size, channels=("color", "depth", "normal"))
              for name, s in surfaces.items()}
    for _ in range(FRAMES):
        for name, surface in surfaces.items():
            start = time.perf_counter()
            renderers[name].render(surface, camera, size, channels=("color", "depth", "normal"))
            seconds[name].append(time.perf_counter() - start)
    for name, surface in surfaces.items():
        renderers[name].close()
        found = quality.measure(exact, frames[name].depth, frames[name].normal, scene.diagonal, camera.rotation[2])
        leaves = int(surface.leaf.sum())
        figures[name] = {"leaves": leaves, "floats": FLOATS[surface.degree] * leaves,
                         "frame_s": float(np.median(seconds[name])), "depth_rms_percent": found["depth_rms"],
                         "distance_percent": found["distance_median"], "normal_degrees": found["normal_median"],
                         "normal_rough_degrees": roughness(frames[name].normal, exact.normal)}
    return figures


def linear_of_floats(scan, floats: int, device):
    """Return the surface of linear surfels whose leaves take about `floats` numbers."""
    low, high, best = 1e-3, 0.2, None
    for _ in range(9):
        t_mdl = (low * high) ** 0.5
        surface = build_slim(scan, degree=1, error=t_mdl, device=device)
        got = FLOATS[1] * int(surface.leaf.sum())
        if best is None or abs(got - floats) < abs(FLOATS[1] * int(best.leaf.sum()) - floats):
            best = surface
        if abs(got - floats) < 0.01 * floats:
            break
        low, high = (t_mdl, high) if got > floats else (low, t_mdl)
    return best


def roughness(normal, exact) -> float:
    """Return the median angle, degrees, by which steps of the normal between pixels differ from the exact steps.

    Facets of planes show in steps: blended planes turn in jerks what turns evenly on the surface.
    """
    steps = []
    for axis in (0, 1):
        jerk = np.linalg.norm(np.diff(normal, axis=axis) - np.diff(exact, axis=axis), axis=2)
        steps.append(jerk[np.isfinite(jerk)])
    return float(np.degrees(np.median(np.concatenate(steps))))


def show(figures: dict) -> None:
    """Print the ratios beside floors and aims, and the linear surfaces beside the quadratic one."""
    rows = []
    for name, f in figures.items():
        for (degree, to), (floor, aim) in RATIOS.items():
            needed = f["study"]["needed"]
            rows.append((f"{name}: leaves of degree {degree} / {to}", f"{f['study']['ratios'][f'{degree}/{to}']:.3f}",
                         floor, aim, f"{needed[str(degree)]['leaves']:,} / {needed[str(to)]['leaves']:,}",
                         f"{needed[str(degree)]['floats'] / needed[str(to)]['floats']:.2f}"))
    print(f"for an L2 error of {100 * TARGET:g} % of the diagonal")
    print_table(("surfels", "ratio", "floor", "aim (paper)", "leaves", "floats ratio"), rows)
    print("linear splats beside quadratic surfels")
    print_table(("scene and surface", "leaves", "floats", "frame ms", "depth RMS %", "distance %", "normal deg",
                 "roughness deg"),
                [(f"{name}: {what}", f"{one['leaves']:,}", f"{one['floats']:,}", f"{1e3 * one['frame_s']:.2f}",
                  f"{one['depth_rms_percent']:.4f}", f"{one['distance_percent']:.4f}", f"{one['normal_degrees']:.2f}",
                  f"{one['normal_rough_degrees']:.3f}")
                 for name, f in figures.items() for what, one in f["beside"].items()])
