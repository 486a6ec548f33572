"""The job `smooth`: error and time of `clsurf.smooth` on noisy meshes whose true shape is known, beside Taubin's.

Error is measured twice: root mean square distance of the smoothed vertices from the true mesh's surface (a vertex that
slid within the surface has none) and from their own true places; mean angle of the vertex normals, and of the faces'.
The floors and aims are of surface distance and vertex normals.
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

import clsurf
from clsurf.device import Profile
from clsurf.surface.mesh import Mesh

from . import scenes
from .build import WrongAnswer
from .peers import open3d
from .table import print_table, profile_rows
from .truth import vertex_normals

PAIRS = {"julius": "Julius0.2", "nicolo": "Nicolo0.2", "bunny 0.2": "Bunny0.2", "fandisk 0.3": "Fandisk0.3"}
# Root mean square % of the diagonal, mean degrees: floor, aim.
GOALS = {"bunny + 0.2 %": ((0.063, 5.2), (0.055, 4.5)), "julius": ((0.039, 4.2), (0.036, 3.8)),
         "nicolo": ((0.058, 4.2), (0.055, 4.0)), "bunny 0.2": ((0.047, 3.6), (0.044, 3.4)),
         "fandisk 0.3": ((0.115, 3.4), (0.105, 3.0))}
SECONDS = (0.3, 0.15)  # of the bunny on PoCL: floor, aim
NOISE = 0.002  # of the diagonal, in each coordinate: the noise put on the bunny
NEAR = 16  # triangles with the nearest centroids that a distance to the surface looks at
TAUBIN = (0.5, -0.53)
TAUBIN_STEPS = (10, 20, 40, 80)  # the peers' number of steps is chosen by the truth


@dataclass(frozen=True, eq=False)
class Pair:
    """A noisy mesh and its true vertices (v, 3) float64, relative to the mesh's origin."""

    noisy: Mesh
    exact: NDArray


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of smoothing; `device` is an opened one.

    Returns
    -------
    dict
        Per scene: vertices, noisy and smooth errors (`errors`), per method, seconds (median of five after a first run),
        and the peers'.
    """
    figures = {}
    for name, pair in pairs(quick):
        figures[name] = _scene(name, pair, device, quick)
    show(figures)
    if profile and figures:
        device.profile = Profile()
        try:
            clsurf.smooth(pairs(quick)[0][1].noisy, device=device)
            print(f"\nstages of smoothing {next(iter(figures))} (each launch waits for the one before)")
            print_table(("kernel or stage", "calls", "min ms", "median ms", "share"), profile_rows(device.profile))
        finally:
            device.profile = None
    return figures


def pairs(quick: bool) -> list[tuple[str, Pair]]:
    """Return (name, pair) of every scene that can be loaded; a generated sphere in any case."""
    points = _sphere()
    found = [] if not quick else [("generated", _noisy(Mesh(points, ConvexHull(points).simplices)))]
    if quick or not scenes.available("bunny"):
        return found or [("generated", _noisy(Mesh(points, ConvexHull(points).simplices)))]
    found.append(("bunny + 0.2 %", _noisy(scenes.scene("bunny").scan)))
    for name, folder in PAIRS.items():
        place = scenes.data_folder() / "denoise" / folder
        if not (place / "Noisy.obj").exists():
            print(f"scans missing: denoise/{folder} (CLSURF_DATA names their folder)")
            continue
        noisy, exact = clsurf.load(place / "Noisy.obj"), clsurf.load(place / "Original.obj")
        found.append((name, Pair(noisy, exact.vertices + (exact.origin - noisy.origin))))
    return found


def _sphere(count: int = 4000) -> NDArray:
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def _noisy(mesh: Mesh) -> Pair:
    exact = mesh.vertices.astype(np.float64)
    diagonal = np.linalg.norm(np.diff(mesh.bounds, axis=0))
    noise = np.random.default_rng(1).normal(size=exact.shape) * NOISE * diagonal
    return Pair(Mesh((exact + noise).astype(np.float32), mesh.faces, origin=mesh.origin), exact)


def _scene(name: str, pair: Pair, device, quick: bool) -> dict:
    result = {"vertices": len(pair.exact), "noisy": errors(pair, pair.noisy.vertices)}
    for method in ("normals", "projection", "quadrics"):
        clean = clsurf.smooth(pair.noisy, method=method, device=device)
        if not ((clean.faces == pair.noisy.faces).all() and np.isfinite(clean.vertices).all()):
            raise WrongAnswer(f"bench smooth {name}: expected the same faces and finite vertices ({method})")
        result[method] = errors(pair, clean.vertices)
    if not result["normals"]["surface"] < 0.7 * result["noisy"]["surface"]:
        raise WrongAnswer(f"bench smooth {name}: expected less than 0.7 of the noise left, got "
                          f"{result['normals']['surface']:.4f} % of {result['noisy']['surface']:.4f} %")
    seconds = []
    for _ in range(2 if quick else 5):
        start = time.perf_counter()
        clsurf.smooth(pair.noisy, device=device)
        seconds.append(time.perf_counter() - start)
    result["seconds"], result["min_s"] = float(np.median(seconds)), min(seconds)
    if name in GOALS:
        result["floor"], result["aim"] = GOALS[name]
    result["peers"] = {label: _best(pair, run) for label, run in taubin().items()} if not quick else {}
    return result


def errors(pair: Pair, vertices: NDArray) -> dict:
    """Return the errors of `vertices` (v, 3): % of the true box's diagonal, degrees, and folded faces.

    surface, vertex: root mean square distance to the true surface, to the true places. vertex_normal, face_normal: mean
    angles. folded: faces turned by more than a right angle.
    """
    exact, faces = pair.exact, pair.noisy.faces
    diagonal = np.linalg.norm(np.ptp(exact, axis=0))
    rms = lambda d2: float(100 * np.sqrt(np.mean(d2)) / diagonal)  # noqa: E731
    angle = lambda a, b: np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))  # noqa: E731
    turned = angle(face_normals(exact, faces), face_normals(vertices, faces))
    normals = angle(vertex_normals(exact, faces), vertex_normals(vertices, faces))
    return {"surface": rms(squared_distance(np.asarray(vertices, np.float64), exact, faces)),
            "vertex": rms(((vertices - exact) ** 2).sum(axis=1)), "vertex_normal": float(normals.mean()),
            "face_normal": float(turned.mean()), "folded": int((turned > 90).sum())}


def face_normals(vertices: NDArray, faces: NDArray) -> NDArray:
    """Return unit normals (f, 3) float64; 0 for faces without area."""
    v = np.asarray(vertices, np.float64)[faces]
    cross = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)


def squared_distance(points: NDArray, vertices: NDArray, faces: NDArray) -> NDArray:
    """Return squared distances (n,) of points to the nearest of the NEAR triangles with the nearest centroids."""
    corners = vertices[faces]
    near = cKDTree(corners.mean(axis=1)).query(points, k=min(NEAR, len(faces)))[1].reshape(len(points), -1)
    best = np.full(len(points), np.inf)
    for column in near.T:
        best = np.minimum(best, ((nearest_on_triangles(points, *corners[column].transpose(1, 0, 2)) - points) ** 2)
                          .sum(axis=1))
    return best


def nearest_on_triangles(p: NDArray, a: NDArray, b: NDArray, c: NDArray) -> NDArray:
    """Return the nearest points (n, 3) of triangles: inside their planes where that is within, else on an edge."""
    def on_edge(start, end):
        along = end - start
        t = ((p - start) * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-300)
        return start + np.clip(t, 0, 1)[:, None] * along
    normal = np.cross(b - a, c - a)
    area2 = np.maximum((normal * normal).sum(axis=1), 1e-300)
    foot = p - (((p - a) * normal).sum(axis=1) / area2)[:, None] * normal
    inside = np.ones(len(p), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(end - start, foot - start) * normal).sum(axis=1) >= 0
    options = np.stack([on_edge(a, b), on_edge(b, c), on_edge(c, a)])
    nearest = ((options - p) ** 2).sum(axis=2).argmin(axis=0)
    return np.where(inside[:, None], foot, options[nearest, np.arange(len(p))])


# Peers ----------------------------------------------------------------------------------------------------------------


def taubin() -> dict:
    """Return Taubin's smoothing by the programs that are installed: name to a function of (mesh, steps) to vertices."""
    found = {"trimesh": _trimesh}
    if open3d() is not None:
        found["Open3D"] = _open3d
    try:
        import pymeshlab  # noqa: F401
    except (ImportError, OSError):
        return found
    return found | {"MeshLab": _meshlab}


def _trimesh(mesh: Mesh, steps: int) -> NDArray:
    import trimesh
    other = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    trimesh.smoothing.filter_taubin(other, lamb=TAUBIN[0], nu=-TAUBIN[1], iterations=2 * steps)
    return np.asarray(other.vertices)


def _open3d(mesh: Mesh, steps: int) -> NDArray:
    module = open3d()
    vector = module.utility
    other = module.geometry.TriangleMesh(vector.Vector3dVector(np.array(mesh.vertices, np.float64)),
                                         vector.Vector3iVector(np.array(mesh.faces)))
    return np.asarray(other.filter_smooth_taubin(steps, *TAUBIN).vertices)


def _meshlab(mesh: Mesh, steps: int) -> NDArray:
    import pymeshlab
    other = pymeshlab.MeshSet()
    other.add_mesh(pymeshlab.Mesh(np.array(mesh.vertices, np.float64), np.array(mesh.faces)))
    other.apply_coord_taubin_smoothing(lambda_=TAUBIN[0], mu=TAUBIN[1], stepsmoothnum=steps)
    return other.current_mesh().vertex_matrix()


def _best(pair: Pair, run) -> dict:
    """Return the errors and seconds of the number of steps with the least distance from the true surface."""
    found = []
    for steps in TAUBIN_STEPS:
        start = time.perf_counter()
        vertices = run(pair.noisy, steps)
        seconds = time.perf_counter() - start
        found.append(errors(pair, vertices) | {"steps": steps, "seconds": seconds})
    return min(found, key=lambda f: f["surface"])


# Printing -------------------------------------------------------------------------------------------------------------


def show(figures: dict) -> None:
    """Print the figures."""
    rows = []
    for name, found in figures.items():
        goals = [f"{found[g][0]:.3f} / {found[g][1]:.1f}" if g in found else "-" for g in ("floor", "aim")]
        for label in ("noisy", "normals", "projection", "quadrics"):
            rows.append((name if label == "noisy" else f"  {label}", *_cells(found[label]),
                         f"{found['seconds']:.3f}" if label == "normals" else "-",
                         *(goals if label == "normals" else ("-", "-"))))
        rows += [(f"  Taubin, {peer}, {f['steps']} steps (best)", *_cells(f), f"{f['seconds']:.3f}", "-", "-")
                 for peer, f in found["peers"].items()]
    print("smoothing: root mean square distance, % of the diagonal, from the true surface and place; mean angles of "
          "vertex and face normals")
    print_table(("scene", "surface %", "place %", "vertex deg", "face deg", "folded", "s", "floor", "aim"), rows)
    print(f"the bunny's time on PoCL: floor {SECONDS[0]} s, aim {SECONDS[1]} s")


def _cells(f: dict) -> tuple:
    return (f"{f['surface']:.4f}", f"{f['vertex']:.4f}", f"{f['vertex_normal']:.2f}", f"{f['face_normal']:.2f}",
            f"{f['folded']}")
