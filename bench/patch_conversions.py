"""Conversions to spatial patches that the job `patches` measures: meshes, clouds, range images, a depth frame's way."""

import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_fill_holes, distance_transform_edt
from scipy.spatial import cKDTree

from clsurf.build.patches import build_patches
from clsurf.io import load
from clsurf.render.renderer import Renderer
from clsurf.surface.cloud import PointCloud

from . import record, scenes, truth, views
from .patch_coverage import coverage, point_spacing
from .patch_quality import quality
from .table import print_table

MESHES = {"bunny": {"patches": 1526}, "fandisk": {}}  # the paper's number
HEAD = 837  # patches, the paper's
SAMPLES = 20_000  # of a mesh and of its patches that distances are measured from
SCANS = {"bunny scans": "range_scans/bunny/bun.conf", "happy scans": "range_scans/happy/happyStandRight.conf",
         "lion": "coloured/lion_takanawa.copc.laz"}
PICTURE = (500, 500)
SILHOUETTES = (1500, 1500)


def measure(device) -> tuple[dict, dict]:
    """Return the figures of every conversion whose data is here, and surfaces for further measures, by name."""
    figures, surfaces = {}, {}
    for name, options in MESHES.items():
        if scenes.available(name):
            figures[name], surfaces[name] = mesh_figures(scenes.scene(name), device, options)
    head = scenes.data_folder() / "maxplanck" / "maxplanck.ply"
    if head.exists():
        mesh = load(head)
        cloud = PointCloud(mesh.vertices, origin=mesh.origin)
        figures["head"], surfaces["head"] = cloud_figures(cloud, device, patches=HEAD)
    for name, path in SCANS.items():
        if (scenes.data_folder() / path).exists():
            figures[name], _ = cloud_figures(load(scenes.data_folder() / path), device)
    frames = scenes.data_folder() / "rgbd"
    if frames.exists():
        figures["depth frame"] = {"first_frame": first_frame(frames, device)}
    missing = [name for name in (*MESHES, "head", *SCANS, "depth frame") if name not in figures]
    if missing:
        print(f"scans missing: {', '.join(missing)} (CLSURF_DATA names their folder)")
    return figures, surfaces


def mesh_figures(scene, device, options) -> tuple[dict, object]:
    """Return time, distances in % of the diagonal and holes of the conversion of a mesh, and its patches."""
    seconds = []
    for _ in range(4):
        start = time.perf_counter()
        surface = build_patches(scene.scan, device=device, **options)
        seconds.append(time.perf_counter() - start)
    found = {"build": record.timing(seconds[1:]), "patches": len(surface), "nodes": surface.node_count}
    found |= {key: value for key, value in quality(surface, scene.scan, SAMPLES).items()
              if key in ("rms", "rms_surface", "rms_mesh", "max_vertices", "max_surface")}
    return found | {"holes": holes(surface, scene, device), "overhang": overhang(surface, scene, device)}, surface


def holes(surface, scene, device) -> int:
    """Return the pixels of four 500x500 views that drawn ones enclose although the mesh is seen there."""
    total = 0
    with Renderer(device) as renderer:
        for camera in views.views(scene.box)[::2]:
            drawn = np.isfinite(renderer.render(surface, camera, PICTURE, channels=("depth",)).depth)
            exact = truth.cast(scene.scan, camera, PICTURE, key=scene.key)
            total += int((binary_fill_holes(drawn) & ~drawn & exact.hit).sum())
    return total


def overhang(surface, scene, device) -> float:
    """Return how far patches reach beyond the mesh's silhouette in eight views, in node spacings there.

    The larger spacing of the patch at the place. Measured in pixels of a 1500x1500 picture, of which one is taken as
    the pixels' own rounding.
    """
    position, patch = surface.positions(), surface.node_patches()[0]
    shows = np.isfinite(position[:, 0])
    widest = np.maximum(np.linalg.norm(surface.axis_x, axis=1), np.linalg.norm(surface.axis_y, axis=1))
    tree, spacing = cKDTree(position[shows]), widest[patch[shows]]
    worst = 0.0
    with Renderer(device) as renderer:
        for camera in views.views(scene.box):
            frame = renderer.render(surface, camera, SILHOUETTES, channels=("depth", "position"))
            exact = truth.cast(scene.scan, camera, SILHOUETTES, key=scene.key)
            beyond = np.where(np.isfinite(frame.depth), distance_transform_edt(~exact.hit) - 1, 0)
            rows = np.nonzero(beyond > 0)
            _, near = tree.query(frame.position[rows].astype(np.float64) + frame.origin)
            pixels = spacing[near] * camera.projection(SILHOUETTES).fx / frame.depth[rows]
            worst = max(worst, float((beyond[rows] / pixels).max(initial=0)))
    return worst


def cloud_figures(scan, device, **options) -> tuple[dict, object]:
    """Return time and coverage of the conversion of points or range images, and its patches."""
    start = time.perf_counter()
    surface = build_patches(scan, device=device, **options)
    seconds = time.perf_counter() - start
    cloud, spacing = (scan, None) if isinstance(scan, PointCloud) else (scan.to_points(), image_spacing(scan))
    found = coverage(surface, cloud.points.astype(np.float64) + cloud.origin, spacing)
    return {"build": record.timing([seconds]), "patches": len(surface), "nodes": surface.node_count,
            "points": len(cloud.points), "points_covered": found.points_covered,
            "nodes_supported": found.nodes_supported,
            "node_spacings": found.node_spacing / found.point_spacing}, surface


def image_spacing(scan) -> float:
    """Return the median over range images of the point spacing in each: where images overlap, points lie closer."""
    points = (image.sensor_points().reshape(-1, 3).astype(np.float64) for image in scan.images)
    return float(np.median([point_spacing(p[np.isfinite(p).all(axis=1)]) for p in points]))


def first_frame(folder, device) -> dict:
    """Return the time from the files of one depth and colour frame to its shaded picture, kernels built before."""
    seconds = []
    with tempfile.TemporaryDirectory() as one:
        for name in ("color", "depth"):  # the first frame by itself
            (Path(one) / name).mkdir()
            shutil.copy(sorted((folder / name).iterdir())[0], Path(one) / name)
        for path in (*folder.glob("*.json"), *folder.glob("trajectory.log")):
            shutil.copy(path, one)
        for _ in range(4):
            start = time.perf_counter()
            with Renderer(device) as renderer:
                renderer.render(build_patches(load(one), device=device), size=(640, 480))
            seconds.append(time.perf_counter() - start)
    return record.timing(seconds[1:])


def show(figures: dict) -> None:
    """Print the figures."""
    print("\nconversions: distances in % of the diagonal; hole pixels in four 500x500 views")
    print_table(("scan", "s", "patches", "nodes", "RMS", "max of vertices", "holes", "overhang, nodes"),
                [(name, f"{f['build']['median_s']:.2f}", f"{f['patches']:,}", f"{f['nodes']:,}", f"{f['rms']:.4f}",
                  f"{f['max_vertices']:.4f}", f["holes"], f"{f['overhang']:.2f}")
                 for name, f in figures.items() if "rms" in f])
    print("\nconversions of points: points within two node spacings of a patch, opaque nodes within two point spacings "
          "of a point")
    print_table(("scan", "points", "s", "patches", "node over point spacing", "points", "nodes"),
                [(name, f"{f['points']:,}", f"{f['build']['median_s']:.2f}", f"{f['patches']:,}",
                  f"{f['node_spacings']:.2f}", f"{f['points_covered']:.3%}", f"{f['nodes_supported']:.3%}")
                 for name, f in figures.items() if "points_covered" in f])
    if "depth frame" in figures:
        print(f"\n640x480 depth and colour frame, files to shaded picture: "
              f"{figures['depth frame']['first_frame']['median_s']:.3f} s")
