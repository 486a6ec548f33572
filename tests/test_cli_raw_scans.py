"""`clsurf render --as scan`: meshes and clouds as they are."""

import numpy as np
import pytest

import clsurf
from clsurf.cli import main
from clsurf.io.images import read_image


@pytest.fixture
def folder(tmp_path, monkeypatch, device):
    """The current folder, with a cloud and a mesh in it."""
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")
    monkeypatch.chdir(tmp_path)
    cloud = clsurf.models.sphere(3000)
    clsurf.save(clsurf.PointCloud(cloud.points, attributes={"height": cloud.points[:, 1]}), "cloud.ply")
    clsurf.save(clsurf.Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), [[0, 1, 2]]), "mesh.ply")
    return tmp_path


def test_draws_scans_as_they_are(folder, capsys):
    assert main(["render", "mesh.ply", "m.png", "--as", "scan", "--size", "60x60", "--direction", "0,0,1"]) == 0
    told = capsys.readouterr().err
    assert "build" not in told and "Mesh(" in told
    shown = np.asarray(read_image("m.png"))[..., 0] < 250
    assert 0.3 < shown.mean() < 0.6  # half of its square
    assert main(["render", "cloud.ply", "c.png", "--as", "scan", "--size", "60x60", "--point-size", "1px"]) == 0
    assert main(["render", "cloud.ply", "d.png", "--as", "scan", "--size", "60x60", "--no-eye-dome"]) == 0
    thin, whole = (np.asarray(read_image(name))[..., 0] < 250 for name in ("c.png", "d.png"))
    assert whole.sum() > thin.sum()


@pytest.mark.parametrize(("options", "word"), (
    (["--as", "mesh"], "as"), (["--as", "scan", "--lines", "contours"], "lines"),
    (["--as", "scan", "--channel", "mean"], "channel"), (["--as", "scan", "--kind", "slim"], "kind"),
    (["--as", "scan", "--point-size", "big"], "point-size"), (["--as", "scan", "--point-size", "-3px"], "size"),
    (["--as", "scan", "--attribute", "weight"], "attribute")))
def test_bad_options_are_told_in_one_line(folder, options, word, capsys):
    assert main(["render", "cloud.ply", "x.png", "--size", "40x40", "--quiet", *options]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1 and told[0].startswith("clsurf: ") and word in told[0]
