"""The measures of the job `curvature`, and the job on small tori."""

import numpy as np
import pytest
from reference import curved

import bench
from bench import curvature


def test_the_truth_of_a_torus():
    points, _, mean, _ = curved.torus(500, curvature.MAJOR, curvature.MINOR)
    np.testing.assert_allclose(curvature.mean_of_torus(points), mean, rtol=1e-9)


def test_the_grid_is_a_closed_torus_seen_from_outside():
    vertices, faces = curvature.torus_grid(24, 12)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all() and len(vertices) == 288
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(2 * np.pi**2 * curvature.MAJOR * curvature.MINOR**2, rel=0.1)


def test_noise_is_a_share_of_the_diagonal():
    points = curved.torus(4000)[0]
    moved = curvature.noisy(points, 0.01) - points
    assert moved.std() == pytest.approx(0.01 * np.linalg.norm(np.ptp(points, axis=0)), rel=0.03)
    assert curvature.noisy(points, 0.0) is points


def test_the_job_runs(device, tmp_path, capsys):
    figures = bench.run("curvature", device, tmp_path / "figures.json", quick=True, profile=True)["figures"]
    assert figures["torus"]["0.0"]["rms"] < 0.01 and figures["mesh"]["0.001"]["rms"] < 0.1
    assert figures["torus"]["0.0"]["median_s"] > 0
    out = capsys.readouterr().out
    assert "0.1% noise" in out and "fit_quartics" in out
