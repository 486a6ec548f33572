"""`clsurf render --lines`."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

import clsurf
from clsurf.cli import main
from clsurf.io.images import read_channels, read_image


@pytest.fixture(autouse=True)
def _on_device(monkeypatch, device, tmp_path):
    """Commands without --device use the device under test, in a folder with a scan."""
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")
    monkeypatch.chdir(tmp_path)
    clsurf.save(clsurf.models.torus(8000), "torus.ply")


def render(*arguments):
    return main(["render", *arguments, "--size", "160x120", "--direction", "1,0.3,1", "-q"])


def test_lines_over_a_scan_on_white_and_as_polylines():
    kinds = "contours,suggestive_contours,parabolic"
    assert render("torus.ply", "plain.png") == render("torus.ply", "over.png", "--lines", kinds) == 0
    plain, over = read_image("plain.png").astype(int), read_image("over.png").astype(int)
    changed = np.abs(plain - over)[..., :3].max(axis=-1) > 20
    assert plain.shape == over.shape and 0.01 < changed.mean() < 0.2
    assert (over[changed][:, :3].sum(axis=1) < plain[changed][:, :3].sum(axis=1)).mean() > 0.95
    assert render("torus.ply", "white.exr", "--lines", kinds, "--on-white") == 0
    white = read_channels("white.exr")
    assert (white["R"][white["lines"] == 0] == 1).all() and white["lines"].max() > 0.9
    assert render("torus.ply", "lines.svg", "--lines", kinds) == 0
    assert {g.get("id") for g in ElementTree.parse("lines.svg").getroot()} == set(kinds.split(","))


def test_lines_of_a_surface():
    assert main(["build", "torus.ply", "cubic.clsurf", "--degree", "3", "-q"]) == 0
    assert render("cubic.clsurf", "a.svg", "--lines", "ridges,contours") == 0
    assert len(ElementTree.parse("a.svg").getroot()) == 2


@pytest.mark.parametrize(("arguments", "told"), (
    (("a.png", "--lines", "wrinkles"), "kinds: expected some of contours"),
    (("a.png", "--on-white"), "--on-white: expected --lines too"),
    (("a.svg",), "expected a name that ends in"),
    (("a.pdf", "--lines", "ridges"), "expected a name that ends in")))
def test_refusals_are_one_line(arguments, told, capsys):
    assert render("torus.ply", *arguments) == 2
    error = capsys.readouterr().err
    assert told in error and error.count("\n") == 1


def test_a_quadratic_surface_has_no_ridges(capsys):
    assert main(["build", "torus.ply", "two.clsurf", "-q"]) == 0
    assert render("two.clsurf", "a.png", "--lines", "ridges") == 2
    error = capsys.readouterr().err
    assert "degree 3" in error and error.count("\n") == 1
