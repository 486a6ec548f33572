"""The job `sparsity`: its own measure of error against a closed form, and a quick run."""

import numpy as np
import pytest

import bench
from bench import sparsity
from tests.reference import surfaces


@pytest.mark.parametrize("away", (0.02, -0.03))
def test_along_normals_is_the_offset_of_a_sphere(away):
    points, normals = surfaces.sphere_points(800, 1 + away)
    assert sparsity.along_normals(surfaces.sphere(400), points, normals) == pytest.approx(abs(away), abs=1e-3)


def test_roughness_is_zero_on_the_exact_picture_and_sees_facets():
    x = np.linspace(-0.5, 0.5, 60)
    normal = np.stack(np.broadcast_arrays(x[None], x[:, None], 0), axis=2)
    normal[..., 2] = np.sqrt(1 - (normal**2).sum(axis=2))
    assert sparsity.roughness(normal, normal) == 0
    facets = normal[::6, ::6].repeat(6, axis=0).repeat(6, axis=1)
    assert sparsity.roughness(facets, normal) > 0.5


def test_quick_job_checks_and_measures(device, tmp_path, capsys):
    found = bench.run("sparsity", device=device, json_path=tmp_path / "figures.json", quick=True)["figures"]
    figures = found["generated"]
    needed = figures["study"]["needed"]
    assert needed["3"]["leaves"] < needed["2"]["leaves"] < needed["1"]["leaves"]
    assert figures["study"]["ratios"]["2/1"] < 0.45 and figures["study"]["ratios"]["3/2"] < 0.75
    quadratic, linear = figures["beside"]["quadratic"], figures["beside"]["linear, equal floats"]
    assert linear["floats"] == pytest.approx(quadratic["floats"], rel=0.1)
    for name in ("normal_degrees", "normal_rough_degrees", "depth_rms_percent"):
        assert quadratic[name] < linear[name]
    assert "aim (paper)" in capsys.readouterr().out
