"""The command `trace` as a user meets it."""

import numpy as np
import pytest

import clsurf
from clsurf.cli import main


@pytest.fixture
def cube(tmp_path, monkeypatch, device):
    """A mesh of a cube from 0 to 1 on disk; commands without --device use the device under test."""
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float32)
    quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    path = tmp_path / "cube.ply"
    clsurf.save(clsurf.Mesh(corners, [[a, b, c] for q in quads for a, b, c in (q[:3], (q[0], q[2], q[3]))]), path)
    return path


RAYS = np.array([[0.3, 0.4, 3, 0, 0, -2], [0.3, 0.4, 3, 0, 0, 1], [-1, 0.2, 0.6, 1, 0, 0.0]])


@pytest.mark.parametrize("name", ["rays.npy", "rays.csv", "rays.txt"])
def test_rays_of_a_file(cube, tmp_path, name, capsys):
    rays, out = tmp_path / name, tmp_path / "hits.npz"
    if name.endswith("npy"):
        np.save(rays, RAYS)
    else:
        np.savetxt(rays, RAYS, delimiter="," if name.endswith("csv") else " ",
                   header="x,y,z,dx,dy,dz" if name.endswith("csv") else "", comments="")
    assert main(["trace", str(cube), str(rays), "--output", str(out)]) == 0
    hits = np.load(out)
    np.testing.assert_allclose(hits["distance"], [2, np.inf, 1], rtol=1e-6)
    np.testing.assert_allclose(hits["position"][[0, 2]], [[0.3, 0.4, 1], [0, 0.2, 0.6]], atol=1e-6)
    assert hits["surface"].tolist() == [0, -1, 0] and "2 of 3 rays hit" in capsys.readouterr().err
    table = tmp_path / "all.csv"
    assert main(["trace", str(cube), str(rays), "-o", str(table), "--query", "all", "-q"]) == 0
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    assert rows[:, 0].tolist() == [0, 0, 2, 2]
    np.testing.assert_allclose(rows[:, 1], [2, 3, 1, 2], rtol=1e-6)
    assert table.read_text().startswith("ray,distance,x,y,z,nx,ny,nz,primitive\n0,")


def test_picture_of_depth(cube, tmp_path):
    """The camera's rays: depth and normals in .exr, grey in .png; of the surface where one is asked for."""
    picture = tmp_path / "depth.exr"
    view = ["--eye", "0.5,0.5,4", "--target", "0.5,0.5,0", "--size", "40x30", "-q"]
    assert main(["trace", str(cube), "--output", str(picture), *view]) == 0
    from clsurf.io.images import read_channels
    channels = read_channels(picture)
    depth = next(np.squeeze(array) for name, array in channels.items() if name.lower().startswith(("depth", "z")))
    assert depth.shape == (30, 40) and abs(depth[15, 20] - 3) < 1e-5 and np.isnan(depth[0, 0])
    assert main(["trace", str(cube), "-o", str(tmp_path / "depth.png"), *view]) == 0
    assert main(["trace", str(cube), "-o", str(tmp_path / "slim.npz"), "--kind", "slim", *view]) == 0
    assert np.load(tmp_path / "slim.npz")["distance"].shape == (1200,)


@pytest.mark.parametrize(("arguments", "says"), [
    (["gone.ply"], "gone.ply"), (["CUBE", "gone.npy"], "gone.npy: no such file"),
    (["CUBE", "-o", "x.jpg"], "ends in .npz"), (["CUBE", "BAD"], "rows of six numbers"),
    (["CUBE", "GOOD", "-o", "x.png"], "ends in .npz"), (["CUBE", "--query", "some"], "closest, any, all"),
    (["CUBE", "-o", "x.exr", "--query", "all"], "closest or any"), (["CUBE", "--size", "big"], "WIDTHxHEIGHT")])
def test_a_users_mistake_is_one_line_and_exit_code_2(cube, tmp_path, monkeypatch, capsys, arguments, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.csv").write_text("1 2 3\n4 5 6\n")
    np.save(tmp_path / "good.npy", RAYS)
    names = {"CUBE": str(cube), "BAD": "bad.csv", "GOOD": "good.npy"}
    assert main(["trace", *(names.get(word, word) for word in arguments)]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("clsurf:")]
    assert len(said) == 1 and says in said[0]
    assert not list(tmp_path.glob("hits*"))
