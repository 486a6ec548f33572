"""The job `surfels` and its pictures run on small models, and the job refuses wrong answers."""

import numpy as np
import pytest

import bench
from bench import scenes, surfel_pictures, surfels
from bench.build import WrongAnswer


@pytest.fixture
def small(monkeypatch):
    model = scenes.Scene("generated", scenes.wavy_torus(120, 45))
    monkeypatch.setattr(scenes, "scene", lambda name: model)
    monkeypatch.setattr(surfels, "QUICK_SPHERES", (500,))


def test_the_job_runs(device, small, tmp_path, capsys):
    found = bench.run("surfels", device, tmp_path / "figures.json", quick=True, profile=True)["figures"]
    assert found["spheres"]["500"]["rms_degrees"] < 0.3
    errors = found["normals"]["generated"]
    assert errors["16"]["mean"] < errors["4"]["mean"] < errors["none"]["mean"]
    assert found["frames"]["generated"]["maps"]["median_s"] > 0 and found["builds"]["generated"]["mtexels_s"] > 0
    assert "tile_surfels" in capsys.readouterr().out


def test_wrong_maps_are_refused(device, small, monkeypatch):
    exact = surfels.exact_map
    turn = np.array([[1, 0.02, 0], [-0.02, 1, 0], [0, 0, 1]])
    monkeypatch.setattr(surfels, "exact_map", lambda *a: exact(*a) @ turn)
    with pytest.raises(WrongAnswer, match="degrees off"):
        surfels.spheres(device, (500,))


def test_pictures_are_drawn(device, monkeypatch):
    monkeypatch.setattr(surfel_pictures, "MAP_SIZES", (1, 8))
    monkeypatch.setattr(scenes, "available", lambda name: False)
    monkeypatch.setattr(scenes, "data_folder", lambda: __import__("pathlib").Path("nowhere"))
    pictures = surfel_pictures.Pictures(device, (80, 80), 5000)
    for figure in surfel_pictures.FIGURES:
        for frame in getattr(pictures, figure)().values():
            assert (frame.color[..., :3] < 0.9).any()
