"""The measures of the job `patches`: faults painted by hand are counted; the job runs on a small model."""

import numpy as np
import pytest

import bench
from bench import patch_pictures, patch_tables, patches, scenes
from clsurf import models
from clsurf.render.camera import Camera
from clsurf.render.frame import Frame

SIZE = (200, 160)
CAMERA = Camera.look_at((30.0, 40.0, 500.0), (0.0, 0.0, 0.0), fov=40.0)


def exact_frame(radius=128.0):
    """Return the picture of a sphere by its formula, with normals."""
    depth, _ = patch_pictures.sphere_depth(CAMERA, SIZE, radius)
    origins, directions = CAMERA.rays(SIZE)
    place = origins + directions * (depth.ravel() / -(directions @ CAMERA.rotation[2]))[:, None]
    gray = np.full((*depth.shape, 4), 0.5, np.float32)
    gray[..., 3] = 1
    return Frame({"color": gray, "depth": depth, "normal": (place / radius).reshape(*depth.shape, 3)}, np.zeros(3),
                 CAMERA)


def painted(frame, **arrays):
    return Frame({name: getattr(frame, name) for name in ("color", "depth", "normal")} | arrays, np.zeros(3), CAMERA)


def test_sphere_depth_is_that_of_points_of_the_sphere():
    frame = exact_frame()
    assert np.isfinite(frame.depth).mean() > 0.2
    found = patch_pictures.sphere_faults(frame, CAMERA, SIZE, 128.0)
    assert found["radial"] < 1e-9 and found["depth_facing"] == 0
    assert found["pinholes"] == found["outside"] == found["off"] == 0


def test_sphere_faults_count_what_is_painted():
    frame = exact_frame()
    depth = frame.depth.copy()
    middle = tuple(np.argwhere(np.isfinite(depth)).mean(axis=0).astype(int))
    depth[middle] += 0.05
    depth[middle[0] + 5, middle[1]] = np.nan
    depth[0, :3] = 400.0
    found = patch_pictures.sphere_faults(painted(frame, depth=depth), CAMERA, SIZE, 128.0)
    assert found["off"] == found["off_facing"] == 1 and found["pinholes"] == 1 and found["outside"] == 3
    assert found["depth_facing"] == pytest.approx(0.05, abs=1e-6)
    larger = patch_pictures.sphere_faults(exact_frame(128.3), CAMERA, SIZE, 128.0)
    assert larger["radial"] == pytest.approx(0.3, abs=1e-6) and larger["off"] > 1000


def test_speckle_is_counted_and_edges_are_not():
    frame = exact_frame()
    clean = patch_pictures.faults(frame, 1.0)
    assert clean["pinholes"] == clean["depth_speckle"] == clean["normal_speckle"] == clean["color_speckle"] == 0
    assert clean["pixels"] == np.isfinite(frame.depth).sum()
    depth, normal = frame.depth.copy(), frame.normal.copy()
    y, x = np.argwhere(np.isfinite(depth)).mean(axis=0).astype(int)
    depth[y, x] -= 3.0  # in front of a neighbourhood that changes by less
    normal[y + 9, x] = np.roll(normal[y + 9, x], 1)
    depth[y - 20, x] = np.nan
    depth[y + 12:, :] -= 40.0  # an occluding contour
    color = frame.color.copy()
    color[:, x - 10:, :3] = 0.4  # an edge
    color[y - 9, x + 5, 1] = 0.5
    color[y - 9, x - 30, :3] = 0.505  # too little to see
    found = patch_pictures.faults(painted(frame, color=color, depth=depth, normal=normal), 1.0)
    assert (found["depth_speckle"], found["normal_speckle"], found["color_speckle"], found["pinholes"]) == (1,) * 4


def test_tables_hold_the_papers_arithmetic(capsys):
    earth = models.earth(383, color=np.full((8, 16, 3), (20, 40, 120), np.uint8))
    tables = patch_tables.measure({"earth 383": earth, "sphere": models.perfect_sphere()}, patches.PAPER,
                                  patches.SMALL)
    for name in tables:
        count, nodes, megabytes = patch_tables.PAPER_MODELS[name]
        assert tables[name]["patches"] == count and nodes in (None, tables[name]["nodes"])
        assert tables[name]["nbytes"] / 1e6 == pytest.approx(megabytes, abs=0.01)
    assert tables["sphere"]["normals"]["groups"] == 1 and tables["sphere"]["small_plain_share"] == 1
    patch_tables.show(tables)
    assert "110,687 | 110,687" in capsys.readouterr().out


def test_every_mode_is_a_way_to_draw():
    from clsurf.render.patch_drawing import PatchDrawing
    for options in (*patches.MODES.values(), *patches.SMALL_MODES.values()):
        PatchDrawing(**options)


def test_the_job_runs(device, monkeypatch, tmp_path):
    monkeypatch.setattr(patches, "vtk_window", lambda surface, size: None)
    monkeypatch.setattr(patches, "MODES", {"quads": {}, "triangles": {"cells": "triangles"}})
    monkeypatch.setattr(patches, "PAPER", (64, 64))
    monkeypatch.setattr(scenes, "data_folder", lambda: tmp_path)
    result = bench.run("patches", device, tmp_path / "figures.json", quick=True, profile=True)["figures"]
    assert set(result["models"]) == {"sphere", "earth 383"} and result["models"]["sphere"]["nbytes"] == 448_098
    found = result["pictures"]
    assert found["sphere"]["radial"] < 0.01 and found["sphere"]["off_facing"] == found["sphere"]["outside"] == 0
    assert found["sphere"]["pinholes"] == found["earth 383"]["pinholes"] == found["earth 383"]["depth_speckle"] == 0
    assert all(figures["frame"]["median_s"] > 0 for figures in result["frames"].values())
    assert result["modes"]["quads"]["ratio"] == 1
    assert result["stages"]
