"""The command `curvature` as a user meets it."""

import csv

import numpy as np
import pytest
from reference import curved

import clsurf
from clsurf.cli import main
from clsurf.io.images import read_image


@pytest.fixture
def on_device(monkeypatch, device):
    """Commands without --device use the device under test."""
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")


@pytest.fixture
def ball(tmp_path):
    """A sphere of radius 2 on disc, far from the origin."""
    points, normals, _, _ = curved.sphere(2000, 2.0)
    path = tmp_path / "ball.ply"
    clsurf.save(clsurf.PointCloud(points + 1000, normals.astype(np.float32)), path)
    return path


def test_help(capsys):
    assert main(["curvature", "--help"]) == 0
    assert "Usage" in capsys.readouterr().out


def test_ranges_are_printed(ball, on_device, capsys):
    assert main(["curvature", str(ball)]) == 0
    out, err = capsys.readouterr()
    rows = {line.split()[0]: line.split()[1:] for line in out.splitlines()[1:5]}
    assert list(rows) == ["mean", "gaussian", "k1", "k2"]
    np.testing.assert_allclose([float(v) for v in rows["mean"]], 0.5, atol=1e-3)
    assert "2,000 points, 0 of them without" in out and "curvature" in err


def test_numbers_are_written_whole(ball, on_device, tmp_path, capsys):
    assert main(["curvature", str(ball), "-o", str(tmp_path / "c.npz"), "--quiet"]) == 0
    assert main(["curvature", str(ball), "-o", str(tmp_path / "c.csv"), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    found = np.load(tmp_path / "c.npz")
    assert set(found) == set(clsurf.Curvature.__dataclass_fields__) and found["mean"].dtype == np.float64
    with open(tmp_path / "c.csv") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2000
    for name in ("mean", "gaussian", "k1", "k2"):
        np.testing.assert_allclose([float(row[name]) for row in rows], found[name], rtol=1e-7)
    np.testing.assert_allclose([[float(row[a]) for a in "xyz"] for row in rows], found["position"], rtol=1e-13)


def test_a_coloured_scan(ball, on_device, tmp_path):
    assert main(["curvature", str(ball), "-o", str(tmp_path / "c.ply"), "--limit", "0.5", "-q"]) == 0
    cloud = clsurf.load(tmp_path / "c.ply")
    np.testing.assert_allclose(cloud.attributes["mean_curvature"], 0.5, atol=1e-3)
    assert {"gaussian_curvature", "k1", "k2"} <= set(cloud.attributes)
    red, green, blue, alpha = cloud.colors.T.astype(int)
    assert (red > green + 50).all() and (red > blue + 50).all() and (alpha == 255).all()


def test_a_mesh_stays_a_mesh(on_device, tmp_path):
    import trimesh
    shape = trimesh.creation.torus(1.0, 0.4, 48, 32)
    clsurf.save(clsurf.Mesh(shape.vertices, shape.faces), tmp_path / "torus.ply")
    assert main(["curvature", str(tmp_path / "torus.ply"), "-o", str(tmp_path / "c.ply"), "--channel", "k2"]) == 0
    mesh = clsurf.load(tmp_path / "c.ply")
    assert len(mesh.faces) == len(shape.faces) and len(np.unique(mesh.colors, axis=0)) > 20


def test_a_picture_shows_the_values_at_its_pixels(ball, on_device, tmp_path):
    picture = tmp_path / "c.png"
    assert main(["curvature", str(ball), "-o", str(picture), "--size", "120x90", "--limit", "1", "-q"]) == 0
    pixels = read_image(picture)
    assert pixels.shape[:2] == (90, 120)
    middle, corner = pixels[45, 60, :3].astype(int), pixels[0, 0, :3].astype(int)
    assert middle[0] > middle[2] + 50 and (corner == 255).all()


def test_surfaces(ball, on_device, tmp_path, capsys):
    surface = tmp_path / "ball.clsurf"
    assert main(["build", str(ball), str(surface), "-q"]) == 0
    assert main(["curvature", str(surface), "-q"]) == 0
    assert "mean" in capsys.readouterr().out
    assert main(["curvature", str(surface), "-o", str(tmp_path / "c.ply"), "-q"]) == 0
    assert len(clsurf.load(tmp_path / "c.ply").points) == clsurf.load(surface).leaf.sum()
    assert main(["curvature", str(surface), "-o", str(tmp_path / "c.jpg"), "--size", "64x48", "-q"]) == 0


@pytest.mark.parametrize(("arguments", "says"), [
    (["gone.ply"], "gone.ply"), (["a.ply", "-o", "c.gif"], "ends in"), (["a.ply", "--channel", "depth"], "channel"),
    (["a.ply", "--radius", "-1"], "radius"), (["a.ply", "--radius", "wide"], "radius"),
    (["a.ply", "--limit", "-1"], "limit"), (["a.ply", "-o", "no/c.png"], "no does not exist"),
    (["a.ply", "--size", "big"], "WIDTHxHEIGHT")])
def test_a_users_mistake_is_one_line_and_exit_code_2(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["curvature", *arguments]) == 2
    err = capsys.readouterr().err
    assert says in err and err.startswith("clsurf: ") and len(err.splitlines()) == 1
