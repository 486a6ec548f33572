"""The benchmark of first steps: it checks its answers and gives its figures."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bench import first, run, scenes
from bench.build import WrongAnswer
from clsurf.build.to_mesh import to_mesh
from clsurf.build.to_points import to_points


def test_first_quick(device, tmp_path, capsys):
    result = run("first", device, tmp_path / "first.json", quick=True)
    assert json.loads((tmp_path / "first.json").read_text())["job"] == "first"
    found = result["figures"]["generated"]
    assert found["mesh"]["open_edges"] == 0 and found["points"]["most_spacings"] < 2
    assert all(found[what]["time"]["min_s"] > 0 for what in found) and result["figures"]["import"]["runs"] == 3
    assert "first steps" in capsys.readouterr().out


def test_a_wrong_mesh_and_wrong_points_are_told(device):
    scene = scenes.scene("generated")
    surface = first.built(scene, 2, device)
    mesh = to_mesh(surface, spacing=0.1, device=device)
    with pytest.raises(WrongAnswer, match="mend to_mesh"):
        first.answer(scene, surface, replace(mesh, vertices=mesh.vertices + np.float32(0.05)), device)
    with pytest.raises(WrongAnswer, match="mend to_mesh"):
        first.answer(scene, surface, replace(mesh, faces=np.tile(mesh.faces, (2, 1))), device)
    points = to_points(surface, device=device)
    twice = replace(points, points=np.tile(points.points, (2, 1)), normals=np.tile(points.normals, (2, 1)))
    few = replace(points, points=points.points[:1000], normals=points.normals[:1000])
    for wrong in (twice, few):
        with pytest.raises(WrongAnswer, match="mend to_points"):
            first.spread(surface, wrong, device)
