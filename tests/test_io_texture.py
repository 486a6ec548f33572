"""Pictures given for meshes whose files name none."""

import numpy as np
import pytest

import clsurf
from clsurf.cli import main
from clsurf.errors import FileFormatError, InputError
from clsurf.io.images import read_image, write_image

QUARTERS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)  # row 0 on top


@pytest.fixture
def square(tmp_path):
    """A unit square that faces +z, with texture coordinates and no material."""
    path = tmp_path / "square.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
                    "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    return path


@pytest.fixture
def picture(tmp_path):
    path = tmp_path / "quarters.png"
    write_image(path, np.repeat(np.repeat(QUARTERS, 8, 0), 8, 1))
    return path


def test_a_texture_is_put_on_the_right_way_up(device, square, picture):
    assert clsurf.load(square).texture is None
    mesh = clsurf.load(square, texture=picture)
    assert mesh.texture.shape == (16, 16, 4) and (mesh.texture[..., 3] == 255).all()
    camera = clsurf.Camera.orthographic((0.5, 0.5, 2), (0.5, 0.5, 0), height=1)
    frame = clsurf.render(mesh, camera, (32, 32), device=device)
    assert np.array_equal(frame.color[8::16, 8::16, :3] > 0.25, QUARTERS > 0)


@pytest.mark.parametrize("given", [QUARTERS, QUARTERS.astype(np.uint16) * 257, QUARTERS.astype(np.float32) / 255,
                                   np.dstack([QUARTERS, np.full((2, 2), 255, np.uint8)])])
def test_pictures_of_all_types_give_the_same_texture(square, given):
    mesh = clsurf.load(square, texture=given)
    assert np.array_equal(mesh.texture[..., :3], QUARTERS) and (mesh.texture[..., 3] == 255).all()


def test_grey_pictures(square):
    mesh = clsurf.load(square, texture=np.array([[[10], [200]]], np.uint8))
    assert mesh.texture[0].tolist() == [[10, 10, 10, 255], [200, 200, 200, 255]]


def test_the_command_turns_pictures_that_are_upside_down(square, picture, tmp_path, monkeypatch, device):
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")
    found = []
    for name in (str(picture), f"{picture}:flip"):
        out = tmp_path / f"out{len(found)}.png"
        assert main(["render", str(square), str(out), "--as", "scan", "--texture", name, "--direction", "0,0,1",
                     "--size", "64x64", "--quiet"]) == 0
        found.append(read_image(out)[..., :3])
    assert not np.array_equal(*found)
    middle = slice(24, 40)
    rows = [image[middle, middle].reshape(16, 16, 3)[[2, 13]][:, [2, 13]] > 100 for image in found]
    assert np.array_equal(rows[0], QUARTERS > 0) and np.array_equal(rows[1], QUARTERS[::-1] > 0)


def test_mistakes_are_told(square, picture, tmp_path):
    plain = tmp_path / "plain.ply"
    clsurf.save(clsurf.Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)), plain)
    with pytest.raises(InputError, match="texture coordinates"):
        clsurf.load(plain, texture=picture)
    with pytest.raises(InputError, match="no such file"):
        clsurf.load(square, texture=tmp_path / "none.png")
    with pytest.raises(FileFormatError):
        clsurf.load(square, texture=square)
    with pytest.raises(InputError, match="1 to 4"):
        clsurf.load(square, texture=np.zeros((4, 4)))
