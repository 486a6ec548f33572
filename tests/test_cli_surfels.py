"""The command line builds, describes, draws, traces and reports surfel hierarchies."""

import numpy as np
import pytest
from PIL import Image
from test_build_surfels import uv_sphere

import clsurf
from clsurf.cli import main
from clsurf.cli.recipe import recipe
from clsurf.errors import InputError
from clsurf.models import sphere


@pytest.fixture(autouse=True)
def _on_device(monkeypatch, device):
    """Commands without --device use the device under test."""
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")


def run(*arguments, code=0):
    assert main([str(a) for a in arguments]) == code


@pytest.fixture
def files(tmp_path):
    """A cloud, a mesh, and the hierarchies that the command line makes of them."""
    folder = tmp_path
    clsurf.save(sphere(1500), folder / "cloud.ply")
    clsurf.save(uv_sphere(12, 20), folder / "mesh.ply")
    run("build", folder / "cloud.ply", folder / "pure.clsurf", "--kind", "surfels", "--map-size", "6")
    run("build", folder / "mesh.ply", folder / "hybrid.clsurf", "--hybrid", "--map-size", "4")
    return folder


def test_build_and_info(files, capsys):
    pure, hybrid = (clsurf.load(files / name) for name in ("pure.clsurf", "hybrid.clsurf"))
    assert not pure.hybrid and pure.map_size.max() == 6 and len(pure.base) == 1500
    assert hybrid.hybrid and hybrid.map_size.max() == 4
    run("info", files / "pure.clsurf", "--against", files / "mesh.ply")
    text = capsys.readouterr().out
    assert "1,500 base surfels" in text and "of 6 x 6" in text and "L2 error" in text
    run("info", files / "hybrid.clsurf")
    assert "triangles of" in capsys.readouterr().out


def test_render_trace_report_convert(files):
    run("render", files / "pure.clsurf", files / "a.png", "--size", "60x50", "--interior", "20", "--lod", "10")
    run("render", files / "hybrid.clsurf", files / "b.exr", "--size", "60x50", "--no-maps", "--shadows")
    run("render", files / "mesh.ply", files / "c.png", "--size", "30x30", "--kind", "surfels", "--spacing", "0.2")
    run("trace", files / "pure.clsurf", "--output", files / "hits.npz", "--size", "20x20")
    run("report", files / "pure.clsurf", "--out", files / "r.html", "--size", "60x60", "--interior", "20")
    run("report", files / "mesh.ply", "--out", files / "m.html", "--size", "40x40", "--kind", "scale_map", "--texels",
        "12", "--bits", "16", "--layers", "2", "--stored-normals", "--form", "geosphere", "--faces", "3", "--normals",
        "stored")
    run("convert", files / "pure.clsurf", files / "blended.ply")
    run("convert", files / "pure.clsurf", files / "points.xyz", "--spacing", "0.1")
    run("convert", files / "hybrid.clsurf", files / "faces.ply")
    run("curvature", files / "pure.clsurf", "--output", files / "k.npz")
    assert all((files / name).stat().st_size > 100 for name in ("a.png", "b.exr", "c.png"))
    assert np.isfinite(np.load(files / "hits.npz")["distance"]).any()
    page = (files / "r.html").read_text()
    assert "Inner surfels" in page and "Levels drawn" in page
    page = (files / "m.html").read_text()
    assert "6 x 12 x 12, 2 layers" in page and "24 bits a texel" in page
    assert len(clsurf.load(files / "blended.ply").faces) > 1500
    assert 700 < len(clsurf.load(files / "points.xyz").points) < 900
    assert len(clsurf.load(files / "faces.ply").faces) == len(uv_sphere(12, 20).faces)
    assert abs(np.median(np.load(files / "k.npz")["mean"]) - 1) < 0.05


def test_relief_draws_as_the_option_of_the_same_name(files):
    points = sphere(1500).points
    bumps = 1 + 0.1 * np.sin(14 * points).prod(axis=1, keepdims=True)
    clsurf.save(clsurf.build_surfels(clsurf.PointCloud(points * bumps)), files / "bumpy.clsurf")
    surface, relief = clsurf.load(files / "bumpy.clsurf"), {"0": 0.0, "0.75": 0.75, "inf": np.inf}
    drawn = {}
    for given, value in relief.items():
        run("render", files / "bumpy.clsurf", files / "r.png", "--size", "80x60", "--lod", "12", "--relief", given)
        drawn[given] = np.asarray(Image.open(files / "r.png"))
        clsurf.render(surface, clsurf.Camera.framing(surface, aspect=4 / 3), (80, 60), lod=12,
                      surfels=clsurf.SurfelDrawing(relief=value)).save(files / "same.png")
        np.testing.assert_array_equal(drawn[given], np.asarray(Image.open(files / "same.png")))
    assert (drawn["0"] != drawn["inf"]).any()
    run("report", files / "pure.clsurf", "--out", files / "relief.html", "--size", "40x40", "--relief", "inf")


@pytest.mark.parametrize(("options", "message"), [
    (dict(kind="slim", map_size=8), "--map-size: an option of --kind surfels"),
    (dict(kind="patches", hybrid=True), "--hybrid: an option of --kind surfels"),
    (dict(kind="surfels", degree=2), "--degree: an option of --kind slim"),
    (dict(kind="surfels", error="0.1"), "--error: an option of --kind slim"),
    (dict(kind="surfels", patches=4), "--patches: an option of --kind patches"),
    (dict(map_size=99), "map_size: expected"), (dict(kind="surfels", spacing=-1.0), "spacing: expected"),
    (dict(hybrid=True, spacing=1.0), "spacing: expected without hybrid"), (dict(kind="voxels"), "kind: expected"),
])
def test_options_that_do_not_fit_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        recipe(**options)


def test_mistakes_end_in_one_line(files, capsys):
    for arguments, says in ((("build", files / "cloud.ply", files / "x.clsurf", "--hybrid"), "hybrid: expected a mesh"),
                            (("build", files / "cloud.ply", files / "x.slim2t", "--kind", "surfels"), "a name that"),
                            (("render", files / "pure.clsurf", files / "x.png", "--interior", "-3"), "interior"),
                            (("render", files / "pure.clsurf", files / "x.png", "--relief", "-1"), "relief"),
                            (("report", files / "pure.clsurf", "--relief", "nan"), "relief"),
                            (("report", files / "mesh.ply", "--texels", "9"), "--texels: an option of --kind"),
                            (("report", files / "mesh.ply", "--stored-normals"), "--stored-normals: an option of")):
        capsys.readouterr()
        run(*arguments, code=2)
        assert says in capsys.readouterr().err
    assert not (files / "x.clsurf").exists()
