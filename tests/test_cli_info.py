"""`clsurf info`: what it says of surfaces, their error against a scan, and the study of a scan."""

import re

import pytest

import clsurf
from bench.scenes import wavy_torus
from clsurf.analysis.error import error
from clsurf.cli import main


@pytest.fixture(scope="module")
def files(tmp_path_factory, device):
    """A mesh, the same as a cloud, and a surface of it, on disk."""
    folder = tmp_path_factory.mktemp("info")
    mesh = wavy_torus(120, 50)
    surface = clsurf.build_slim(mesh, degree=2, error=0.02, device=device)
    clsurf.save(mesh, folder / "mesh.ply")
    clsurf.save(clsurf.PointCloud(mesh.points, normals=mesh.normals, origin=mesh.origin), folder / "cloud.ply")
    clsurf.save(surface, folder / "surface.clsurf")
    return folder


@pytest.fixture(autouse=True)
def on_device(monkeypatch, device):
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")


def lines(capsys):
    return {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}


def test_info_tells_error_counts_and_floats(files, capsys, device):
    assert main(["info", str(files / "surface.clsurf"), "--against", str(files / "mesh.ply")]) == 0
    said = lines(capsys)
    surface, mesh = clsurf.load(files / "surface.clsurf"), clsurf.load(files / "mesh.ply")
    leaves = int(surface.leaf.sum())
    assert f"{leaves:,} leaves" in said["surfels"] and f"{12 * leaves:,} in the leaves" in said["floats"]
    assert "of degree 2" in said["floats"] and "T_MDL 0.02" in said["error"]
    found = error(surface, mesh, both=True, device=device)
    for name, one in (("against", found), ("back", found.backward)):
        assert float(re.search(r"L2 error (\S+) ", said[name])[1]) == pytest.approx(one.rms, rel=2e-3)
        assert float(re.search(r"\((\S+)% of", said[name])[1]) == pytest.approx(100 * one.relative.rms, abs=6e-5)


def test_info_against_points_measures_one_way(files, capsys):
    assert main(["info", str(files / "mesh.ply"), "--against", str(files / "cloud.ply")]) == 0
    said = lines(capsys)
    assert "(0.0000% of the diagonal)" in said["against"] and "back" not in said


def test_info_study(files, capsys):
    assert main(["info", str(files / "cloud.ply"), "--study", "0.003"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert sum(line.endswith("*") for line in said) == 3 and said[-1].endswith("0.3 % of the diagonal")


@pytest.mark.parametrize(("arguments", "says"), [
    (["surface.clsurf", "--study", "0.001"], "expected a scan to study"), (["cloud.ply", "--study", "2"], "target"),
    (["cloud.ply", "--against", "mesh.ply"], "surface or a mesh"),
    (["surface.clsurf", "--against", "no.ply"], "no.ply"),
    (["surface.clsurf", "--against", "surface.clsurf"], "got a surface")])
def test_info_refuses(files, arguments, says, capsys):
    name, option, value = arguments
    value = str(files / value) if value.endswith(("ply", "clsurf")) else value
    assert main(["info", str(files / name), option, value]) == 2
    assert says in capsys.readouterr().err.splitlines()[-1]
