"""Light, materials and output of the command line: `clsurf render --light --sky --material --tone` and others."""

import numpy as np
import pytest
from reference.surfaces import sphere

import clsurf
from clsurf.cli import main
from clsurf.io.images import read_channels, read_image, write_image
from clsurf.surface.srgb import to_linear


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


def test_skies_and_materials(ball):
    """The sun of the built-in sky is up and to the left; turned by half a circle it is behind; gold is yellow."""
    sky, turned = (drawn(ball, "--sky", name, "--direction", "0,0,1") for name in ("sky", "sky,180"))
    assert sky[16, 16] > 1.3 * sky[34, 34] and sky[16, 16] > turned[16, 16]
    write_image("lamp.exr", np.full((8, 16, 3), 0.25, np.float32))
    furnace = drawn(ball, "--sky", "lamp.exr", "--material", "metal", "--background", "sky")
    assert np.allclose(furnace[0, 0], 0.25) and 0.1 < furnace[24, 24] < 0.2
    drawn(ball, "--material", "gold", "--sky", "studio")
    parts = read_channels("ball.exr")
    assert parts["R"][24, 24] > 1.2 * parts["B"][24, 24]
    clay = drawn(ball, "--material", "clay")
    assert clay[16, 16] > clay[34, 34]


def test_backgrounds(ball):
    for text, top, bottom in (("0.5,0.5,0.5", 0.5, 0.5), ("#336699", 0.2, 0.2), ("0,0,0:1,1,1", 1 / 96, 95 / 96)):
        red = drawn(ball, "--background", text)
        assert red[0, 0] == pytest.approx(to_linear(top), abs=1e-4)
        assert red[47, 47] == pytest.approx(to_linear(bottom), abs=1e-4)
    drawn(ball, "--background", "transparent", "--antialias", "coverage")
    alpha = read_channels("ball.exr")["A"]
    assert alpha[0, 0] == 0 and alpha[24, 24] == 1 and ((alpha > 0) & (alpha < 1)).sum() > 40


def test_tone_exposure_and_bits(ball):
    def png(*options):
        assert main(["render", ball, "ball.png", "--size", "48x48", "--quiet", *options]) == 0
        return read_image("ball.png")
    plain, deep, bright = png(), png("--bits", "16"), png("--exposure", "1", "--tone", "agx")
    assert deep.dtype == np.uint16 and np.abs(deep / 257 - plain).max() < 0.51
    assert np.abs(bright[24, 24].astype(int) - plain[24, 24]).max() > 5


@pytest.mark.parametrize(("options", "says"), [
    (["--shading", "flat", "--shadows"], "expected phong"), (["--light", "up"], "light"), (["--mirror", "2"], "mirror"),
    (["--occlusion", "-3"], "occlusion"), (["--sky", "moon"], "--sky"), (["--material", "wood"], "--material"),
    (["--material", "jade", "--mirror", "0.5"], "--mirror"),
    (["--material", "gold", "--shading", "flat"], "--material"),
    (["--background", "grey"], "background"), (["--background", "sky"], "--sky"), (["--tone", "film"], "tone"),
    (["--bits", "10"], "bits"), (["--exposure", "nan"], "exposure"), (["--antialias", "4"], "antialias"),
    (["--antialias", "coverage", "--supersampling", "2"], "antialias"),
    (["--tone", "aces", "--lines", "ridges"], "--lines"),
    (["--background", "1,1,1", "--channel", "mean"], "--channel")])
def test_mistakes_are_one_line(ball, options, says, capsys):
    assert main(["render", ball, "x.png", *options]) == 2
    said = capsys.readouterr().err.strip()
    assert says in said and "\n" not in said
