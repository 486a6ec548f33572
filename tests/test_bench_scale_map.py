"""The job `scale_map`: a quick run checks its answers and writes them."""

import json

import numpy as np

import bench
from bench import scale_map


def test_geospheres_are_closed_and_face_outward():
    mesh = scale_map.geosphere_mesh(8)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)
    assert len(mesh.faces) == 20 * 64 and (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1).min() > 0
    # As much as a sphere of chords holds; every edge is met by two triangles.
    assert abs((np.cross(b, c) * a).sum() / 6 / (4 * np.pi / 3) - 1) < 0.02
    points = np.unique(mesh.vertices.round(5), axis=0)
    assert len(points) == 10 * 64 + 2


def test_quick_job_checks_and_measures(device, tmp_path, capsys):
    found = bench.run("scale_map", device=device, json_path=tmp_path / "figures.json", quick=True)["figures"]
    assert found["order"]["ellipsoid"]["orders"][-1] > 1.9 and found["exact"]["offset sphere"] < 1e-3
    assert found["morph"]["spheres_codes"] <= 0.501 and len(found["geosphere"]) == 3
    assert json.loads((tmp_path / "figures.json").read_text())["job"] == "scale_map"
    assert "aim" in capsys.readouterr().out
