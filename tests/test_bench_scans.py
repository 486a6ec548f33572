"""The benchmark of scans drawn as they are: it checks its answer and gives its figures."""

import json

from bench import run


def test_scans_quick(device, tmp_path, capsys):
    result = run("scans", device, tmp_path / "scans.json", quick=True)
    assert json.loads((tmp_path / "scans.json").read_text())["job"] == "scans"
    mesh, points = result["figures"]["generated mesh 256"], result["figures"]["generated points 256"]
    assert mesh["errors"]["worst_holes"] == 0 and mesh["errors"]["mean_depth_median"] < 1e-4
    assert points["errors"]["worst_holes"] == 0 and points["errors"]["mean_depth_median"] < 0.02
    assert mesh["frame"]["median_s"] > 0 and "scans as they are" in capsys.readouterr().out
