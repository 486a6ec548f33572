"""The measures of the job `smooth`: errors put in by hand are found; the job runs on a generated sphere."""

import numpy as np
import pytest

import bench
from bench import smooth
from clsurf.surface.mesh import Mesh


def test_nearest_on_triangles():
    a, b, c = (np.array([v]) for v in ((0.0, 0, 0), (2.0, 0, 0), (0.0, 2, 0)))
    for point, wanted in (((0.5, 0.5, 3), (0.5, 0.5, 0)), ((-1, -1, 1), (0, 0, 0)), ((1, -2, 0), (1, 0, 0)),
                          ((2, 2, 1), (1, 1, 0)), ((5, -1, 0), (2, 0, 0)), ((-1, 1, 0), (0, 1, 0))):
        assert np.allclose(smooth.nearest_on_triangles(np.array([point], float), a, b, c), [wanted])


def test_errors():
    grid = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0), indexing="ij"), axis=-1).reshape(-1, 2)
    exact = np.column_stack([grid, np.zeros(36)])
    i = np.arange(36).reshape(6, 6)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    mesh = Mesh(exact.astype(np.float32), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    pair, diagonal = smooth.Pair(mesh, exact), np.hypot(5, 5)
    lifted = smooth.errors(pair, exact + np.array([0, 0, 0.1]))
    assert lifted["surface"] == pytest.approx(10 / diagonal) and lifted["vertex"] == pytest.approx(10 / diagonal)
    assert lifted["vertex_normal"] == lifted["face_normal"] == lifted["folded"] == 0
    slid = exact + np.where(np.isin(np.arange(36), (14, 15, 20, 21))[:, None], (0.2, 0.1, 0), 0)
    slid = smooth.errors(pair, slid)
    assert slid["surface"] < 1e-9 and slid["vertex"] > 0.5
    tilted = smooth.errors(pair, exact @ np.array([[1, 0, 0], [0, np.cos(0.1), np.sin(0.1)], [0, 0, 1]]))
    assert tilted["vertex_normal"] == pytest.approx(np.degrees(0.1)) == tilted["face_normal"]
    assert smooth.errors(pair, exact * (1, -1, 1))["folded"] == 50


def test_job(device, capsys):
    figures = bench.run("smooth", device, quick=True)["figures"]["generated"]
    assert figures["noisy"]["surface"] > 2 * figures["normals"]["surface"] and figures["seconds"] > 0
    assert "generated" in capsys.readouterr().out
