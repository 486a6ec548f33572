"""Lights of the command line: `clsurf render --light --shadows --occlusion --mirror`."""

import numpy as np
import pytest
from reference.surfaces import sphere

import clsurf
from clsurf.cli import main
from clsurf.io.images import read_channels


@pytest.fixture
def ball(tmp_path, monkeypatch, device):
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")
    monkeypatch.chdir(tmp_path)
    clsurf.save(sphere(300), tmp_path / "ball.clsurf")
    return "ball.clsurf"


def drawn(source, *options):
    """The picture's red (48, 48), linear."""
    assert main(["render", source, "ball.exr", "--size", "48x48", "--channels", "color", "--quiet", *options]) == 0
    return read_channels("ball.exr")["R"]


def test_a_light_from_the_left_lights_the_left(ball):
    red = drawn(ball, "--light=-1,0,0.3", "--shadows")
    assert red[24, 12] > 3 * red[24, 36]


def test_two_lights_of_its_own_occlusion_and_mirror(ball):
    plain, shadows, occlusion, mirror = (drawn(ball, *options)[24, 24] for options in
                                         ([], ["--shadows"], ["--occlusion", "32"], ["--mirror", "1"]))
    assert not np.isclose(plain, shadows)
    assert occlusion == pytest.approx(plain, rel=0.3)  # a sphere hides nothing of itself
    assert mirror == pytest.approx(1, abs=1e-3)  # it mirrors the white background


@pytest.mark.parametrize(("options", "says"), [
    (["--shading", "flat", "--shadows"], "expected phong"), (["--light", "up"], "light"), (["--mirror", "2"], "mirror"),
    (["--occlusion", "-3"], "occlusion")])
def test_mistakes_are_one_line(ball, options, says, capsys):
    assert main(["render", ball, "x.png", *options]) == 2
    said = capsys.readouterr().err.strip()
    assert says in said and "\n" not in said
