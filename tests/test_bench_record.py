"""Records of figures and their comparison; the jobs themselves on the generated scan."""

import json
import math

import numpy as np
import pytest

import bench
from bench import build, compare, record
from clsurf.errors import FileFormatError, InputError


def result(**figures) -> dict:
    return {"job": "build", "figures": figures,
            "record": {"commit": "a", "device": "d", "platform": "p", "driver": "1", "cpu": "c", "date": "today"}}


def test_timing_is_robust_to_one_slow_run():
    found = record.timing([1.0, 1.1, 1.2, 9.0, 1.1])
    assert found["median_s"] == 1.1 and found["min_s"] == 1.0 and found["runs"] == 5 and found["spread"] < 0.1


def test_json_returns_what_was_written(tmp_path):
    path = tmp_path / "new" / "figures.json"
    record.write(path, result(count=np.int32(3), rms=np.float32(0.5), list=np.arange(2)))
    assert record.read(path)["figures"] == {"count": 3, "rms": 0.5, "list": [0, 1]}
    assert [p.name for p in path.parent.iterdir()] == ["figures.json"]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "figures.json"
    record.write(path, result(count=1))
    with pytest.raises(TypeError):
        record.write(path, result(count=object()))
    assert record.read(path)["figures"] == {"count": 1}
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("text", ["", "{", "[]", json.dumps({"format": "other"})])
def test_foreign_files_are_refused(tmp_path, text):
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(FileFormatError, match="bench figures"):
        record.read(path)


def test_compare_marks_what_is_beyond_the_noise():
    quiet, noisy = {"spread": 0.01, "runs": 5}, {"spread": 0.2, "runs": 5}
    before = result(fast={"median_s": 1.0, **quiet}, wild={"median_s": 1.0, **noisy}, holes=0,
                    times_faster_than_open3d=3.0, same=0, only=1)
    after = result(fast={"median_s": 0.8, **quiet}, wild={"median_s": 1.3, **noisy}, holes=4,
                   times_faster_than_open3d=2.0, same=0)
    rows = {row["name"]: row for row in compare.compared(before, after)}
    assert set(rows) == {"fast.median_s", "wild.median_s", "holes", "times_faster_than_open3d", "same"}
    assert rows["fast.median_s"]["verdict"] == "better" and rows["fast.median_s"]["ratio"] == pytest.approx(0.8)
    assert rows["wild.median_s"]["verdict"] == "" and rows["wild.median_s"]["noise"] == pytest.approx(0.4)
    assert rows["holes"]["verdict"] == "worse" and math.isnan(rows["holes"]["ratio"])
    assert rows["times_faster_than_open3d"]["verdict"] == "worse"
    assert rows["same"]["verdict"] == "" and rows["same"]["ratio"] == 1


def test_compare_files_prints_where_the_figures_come_from(tmp_path, capsys):
    for name, value in (("a", 1.0), ("b", 2.0)):
        record.write(tmp_path / name, result(rms=value))
    assert len(bench.compare_files(tmp_path / "a", tmp_path / "b")) == 1
    printed = capsys.readouterr().out
    assert "2.000" in printed and "worse" in printed and "1 figures compared, 1 beyond the noise" in printed


def test_an_unknown_job_is_named():
    with pytest.raises(InputError, match="tiles"):
        bench.run("frames")


def test_overlap_equals_brute_force():
    rng = np.random.default_rng(3)
    points = rng.random((300, 3))

    class Surface:
        centers, radii = rng.random((40, 3)).astype(np.float32), (0.2 + 0.2 * rng.random(40)).astype(np.float32)
        leaf, origin = rng.random(40) > 0.3, np.array([0.1, 0.0, -0.2])

    reach = Surface.radii[Surface.leaf].astype(np.float64) * 2 / 3
    t = np.linalg.norm(points[:, None] - Surface.origin - Surface.centers[Surface.leaf], axis=2) / reach
    wanted = (np.maximum(1 - t * t, 0) ** 3).sum(axis=1)
    np.testing.assert_allclose(build.overlap(Surface, points), wanted, atol=1e-12)


def test_sharp_edges_of_a_box():
    import trimesh

    from clsurf.surface.mesh import Mesh
    box = trimesh.creation.box()
    edges = build.sharp_edges(Mesh(box.vertices, box.faces))
    assert len(edges) == 12 and np.allclose(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1), 1)
    away = build.distance_to_segments(np.array([[0.5, 0.5, 0.0], [0.5, 0.0, 0.0]]), edges)
    assert np.allclose(away, [0.0, 0.5])


@pytest.mark.parametrize("job", ["build", "tiles", "normals"])
def test_quick_jobs_check_and_measure(job, device, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = bench.run(job, device=device, json_path=tmp_path / "figures.json", quick=True, profile=True)
    again = record.read(tmp_path / "figures.json")
    assert again["job"] == job and again["record"]["device"] == device.name and again["record"]["commit"]
    assert found["figures"].keys() == again["figures"].keys()
    if job == "tiles":
        assert found["figures"]["pictures"]["generated"]["worst_holes"] == 0
        assert found["figures"]["frames"]["generated 500"]["frame"]["median_s"] > 0
        assert "tile_slim" in found["figures"]["frames"]["generated 500"]["stages"]
    elif job == "normals":
        assert found["figures"]["generated"]["wrong"] == 0
    else:
        generated = found["figures"]["generated"]
        assert generated["rms_percent"] < 0.1 and generated["build"]["median_s"] > 0
    assert "kernel or stage" in capsys.readouterr().out


def test_report_shows_what_was_measured_and_dashes_elsewhere():
    from bench import report
    made = {"device": "D", "platform": "P", "driver": "1", "cpu": "C", "commit": "abc", "date": "today"}
    figures = {"build": {"bunny": {"build": {"median_s": 0.1234}}}}
    text = report.markdown({"pocl": figures, "intel": {}}, {"pocl": made})
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) == 2 + len(report.ROWS) and all(line.count("|") == 6 for line in lines)
    assert "| bunny build, T 0.01 | 0.15 s | 0.06 s | 0.123 s | - |" in lines and "commit abc" in text
