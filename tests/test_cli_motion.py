"""Moving pictures and cameras of files on the command line: `clsurf render --turntable --path --camera`."""

import os

import numpy as np
import pytest
from PIL import Image
from reference.surfaces import sphere

import clsurf
from clsurf.cli import main
from clsurf.io.images import read_image
from clsurf.surface.srgb import to_linear


@pytest.fixture
def ball(tmp_path, monkeypatch, device):
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")
    monkeypatch.chdir(tmp_path)
    clsurf.save(sphere(300), tmp_path / "ball.clsurf")
    cameras = [clsurf.Camera.look_at((x, 0, 5), (0, 0, 0)) for x in (-3, 0, 3)]
    matrix = np.array([[60.0, 0, 20], [0, 60, 15], [0, 0, 1]])
    clsurf.save_cameras(clsurf.CameraPath(cameras), tmp_path / "path.json")
    pose = np.diag([1, -1, -1, 1.0])
    pose[:3, 3] = 0, 0, 5
    left = pose.copy()
    left[0, 3] = 1
    clsurf.save_cameras({"front": clsurf.Camera.from_intrinsics(matrix, pose, (40, 30)),
                         "side": clsurf.Camera.from_intrinsics(matrix, left, (40, 30))}, tmp_path / "k.json")
    return "ball.clsurf"


def middle(picture):
    """Mean column of what is not white."""
    return np.nonzero((picture[..., :3] < 250).any(axis=2))[1].mean() + 0.5


def frames_of(path):
    with Image.open(path) as file:
        for i in range(file.n_frames):
            file.seek(i)
            yield np.asarray(file.convert("RGB"))


@pytest.mark.parametrize("options", [["--turntable", "3"], ["--turntable", "3", "--eye", "0,0,4"],
                                     ["--path", "path.json", "--frames", "3"],
                                     ["--turntable", "3", "--channel", "mean"],
                                     ["--turntable", "3", "--lines", "contours"]])
def test_a_moving_picture(ball, options, capsys):
    assert main(["render", ball, "out.webp", "--size", "48x32", "--fps", "10", *options]) == 0
    assert "3 frames, 0.3 s" in capsys.readouterr().err
    frames = list(frames_of("out.webp"))
    assert len(frames) == 3 and frames[0].shape == (32, 48, 3)
    assert all(20 < middle(frame) < 28 for frame in frames) if "path.json" not in options else \
        abs(middle(frames[1]) - 24) < 1


def test_a_moving_picture_is_exposed(ball):
    """A stop less is half the light: sRGB 0.5 of linear 0.21."""
    assert main(["render", ball, "full", "--size", "24x16", "--turntable", "2", "--quiet"]) == 0
    assert main(["render", ball, "half", "--size", "24x16", "--turntable", "2", "--exposure", "-1", "--quiet"]) == 0
    full, half = (to_linear(read_image(f"{name}/00001.png")[..., :3].astype(float) / 255) for name in ("full", "half"))
    at = full[8, 12]
    assert (at > 0.2).all() and half[8, 12] == pytest.approx(at / 2, abs=0.01)
    assert main(["render", ball, "sixteen", "--size", "24x16", "--turntable", "2", "--bits", "16", "--quiet"]) == 2


def test_a_path_has_a_second_from_key_to_key(ball):
    assert main(["render", ball, "out", "--size", "8x8", "--path", "path.json", "--quiet"]) == 0
    assert len(os.listdir("out")) == 61


def test_a_camera_of_a_file(ball):
    """Its own size is the picture's, and a camera a unit to the right sees the ball 60 / 5 pixels further left."""
    for name, options in (("a.png", "k.json"), ("b.png", "k.json:side")):
        assert main(["render", ball, name, "--camera", options, "--quiet"]) == 0
    front, side = read_image("a.png"), read_image("b.png")
    assert front.shape[:2] == (30, 40) and middle(front) == pytest.approx(20, abs=0.3)
    assert middle(front) - middle(side) > 8


@pytest.mark.parametrize(("out", "options", "says"), [
    ("a.png", ["--turntable", "3"], "video format .png"), ("a.mp4", [], "a.mp4"),
    ("a.gif", ["--turntable", "0"], "turntable"), ("a.gif", ["--turntable", "3", "--path", "path.json"], "one of"),
    ("a.gif", ["--frames", "3"], "--path"), ("a.gif", ["--path", "path.json", "--eye", "1,2,3"], "got both"),
    ("a.gif", ["--path", "none.json"], "none.json: no such file"),
    ("a.png", ["--camera", "k.json:back"], "front, side"),
    ("a.gif", ["--turntable", "3", "--fps", "0"], "fps"), ("a.gif", ["--turntable", "3", "--fps", "99"], "fps")])
def test_mistakes_are_one_line(ball, out, options, says, capsys):
    assert main(["render", ball, out, *options]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert says in said and not os.path.exists(out)
