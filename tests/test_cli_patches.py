"""The command line on spatial patches, and the options of the camera."""

import re

import numpy as np
import pytest
from test_report import bumps, flat

import clsurf
from clsurf.cli import main
from clsurf.cli.cameras import checked_view
from clsurf.cli.recipe import recipe
from clsurf.io.images import read_image
from clsurf.surface.patch_mesh import patch_mesh


@pytest.fixture(autouse=True)
def _on_device(monkeypatch, device):
    """Commands without --device use the device under test."""
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with a cloud, a mesh and patches in it."""
    monkeypatch.chdir(tmp_path)
    scan = clsurf.models.sphere(3000)
    clsurf.save(scan, "cloud.ply")
    clsurf.save(bumps(), "bumps.clsurf")
    i, j = np.meshgrid(np.arange(24), np.arange(24))
    vertices = np.stack([i.ravel(), j.ravel(), np.sin(i.ravel() / 6)], axis=1) * 0.1
    first = (j[:-1, :-1] * 24 + i[:-1, :-1]).ravel()
    faces = np.concatenate([np.stack([first, first + 1, first + 25], 1), np.stack([first, first + 25, first + 24], 1)])
    clsurf.save(clsurf.Mesh(vertices, faces), "mesh.ply")
    return tmp_path


@pytest.mark.parametrize("scan", ["cloud.ply", "mesh.ply"])
def test_build_info_render_report_convert(scan, folder, capsys):
    assert main(["build", scan, "p.clsurf", "--patches", "40", "--nodes", "9"]) == 0
    told = capsys.readouterr().err
    assert "PatchSurface(" in told and "surface: " in told
    built = clsurf.load("p.clsurf")
    assert isinstance(built, clsurf.PatchSurface) and (built.size == 9).all()
    assert main(["info", "p.clsurf"]) == 0
    told = capsys.readouterr().out
    for word in (f"{len(built):,} of 9 x 9", f"{int(built.opaque.sum()):,} opaque", "8-bit", "spacing", "bound"):
        assert word in told, word
    assert main(["render", "p.clsurf", "p.png", "--size", "90x70"]) == 0
    assert len(np.unique(np.asarray(read_image("p.png"))[..., 0])) > 10
    assert main(["report", "p.clsurf", "-o", "p.html", "--size", "80x60"]) == 0
    assert "Interpolated nodes" in (folder / "p.html").read_text()
    assert main(["convert", "p.clsurf", "p.ply", "-q"]) == 0
    assert len(clsurf.load("p.ply").faces) > 100


def test_precise(folder, capsys):
    assert main(["build", "mesh.ply", "p.clsurf", "--spacing", "0.1", "--precise", "--nodes", "9x7", "-q"]) == 0
    built = clsurf.load("p.clsurf")
    assert built.displacements.dtype == np.int32 and (built.size == [9, 7]).all()
    assert main(["info", "p.clsurf"]) == 0 and "32-bit" in capsys.readouterr().out


def test_a_scan_is_built_first(folder, capsys):
    assert main(["render", "mesh.ply", "p.png", "--size", "60x50", "--kind", "patches"]) == 0
    assert "PatchSurface(" in capsys.readouterr().err
    assert main(["report", "cloud.ply", "--size", "60x50", "--device", "pocl"]) == 0
    told = capsys.readouterr().err
    assert "SlimSurface(" in told and "report.html" in told and (folder / "report.html").exists()


def test_drawing_options_reach_the_renderer(folder, capsys):
    """Pictures differ where they should: triangles, trilinear nodes, cells that fade out, supersampling."""
    picture = lambda *more: (main(["render", "bumps.clsurf", "p.png", "--size", "60x50", "--fov", "120", "-q", *more]),  # noqa: E731
                             np.asarray(read_image("p.png")).astype(int))
    code, plain = picture()
    for more in (["--cells", "bilinear"], ["--nodes", "homogeneous"], ["--nodes", "trilinear"], ["--alpha"],
                 ["--supersampling", "2"], ["--cells", "triangles"]):
        code_more, other = picture(*more)
        assert code == code_more == 0 and other.shape == plain.shape
        changed = (np.abs(other - plain) > 2).any(axis=2).mean()
        assert changed < 0.02 if "homogeneous" in more else changed > 0, more  # exact but for the last bits


@pytest.mark.parametrize(("arguments", "says"), [
    (["build", "cloud.ply", "x.clsurf", "--patches", "0"], "patches: expected a positive"),
    (["build", "cloud.ply", "x.clsurf", "--spacing", "-1"], "spacing"),
    (["build", "cloud.ply", "x.clsurf", "--spacing", "nan"], "spacing"),
    (["build", "cloud.ply", "x.clsurf", "--patches", "9", "--spacing", "1"], "only one of"),
    (["build", "cloud.ply", "x.clsurf", "--patches", "9", "--error", "0.1"], "only one of"),
    (["build", "cloud.ply", "x.clsurf", "--patches", "9", "--error", "auto"], "between 0 and 1"),
    (["build", "cloud.ply", "x.clsurf", "--patches", "9", "--degree", "2"], "--degree: an option of --kind slim"),
    (["build", "cloud.ply", "x.clsurf", "--kind", "slim", "--precise"], "--precise: an option of --kind patches"),
    (["build", "cloud.ply", "x.clsurf", "--kind", "voxels"], "slim, patches, surfels or scale_map"),
    (["build", "cloud.ply", "x.clsurf", "--nodes", "1"], "from 2 to 256"),
    (["build", "cloud.ply", "x.clsurf", "--nodes", "17x"], "17x9"),
    (["build", "cloud.ply", "x.clsurf", "--nodes", "many"], "17x9"),
    (["build", "cloud.ply", "x.clsurf", "--method", "magic"], "areas, global_views"),
    (["build", "cloud.ply", "x.clsurf", "--method", "areas"], "areas"),
    (["build", "cloud.ply", "x.clsurf", "--patches", "nine"], "--patches"),
    (["build", "cloud.ply", "x.slim2t", "--patches", "9"], ".clsurf"),
    (["build", "bumps.clsurf", "x.clsurf"], "expected a scan"),
    (["convert", "bumps.clsurf", "x.slim2t"], "PatchSurface cannot be written"),
    (["render", "bumps.clsurf", "x.png", "--cells", "hexagons"], "hexagons"),
    (["render", "bumps.clsurf", "x.png", "--nodes", "17"], "exact, trilinear"),
    (["render", "bumps.clsurf", "x.png", "--supersampling", "9"], "supersampling"),
    (["render", "bumps.clsurf", "x.png", "--eye", "1,2"], "eye"),
    (["render", "bumps.clsurf", "x.png", "--eye", "1,2,inf"], "eye"),
    (["render", "bumps.clsurf", "x.png", "--eye", "1,2,3", "--direction", "0,0,1"], "got both"),
    (["render", "bumps.clsurf", "x.png", "--eye", "1,2,3", "--target", "1,2,3"], "apart"),
    (["render", "bumps.clsurf", "x.png", "--ortho", "1", "--fov", "30"], "got both"),
    (["render", "bumps.clsurf", "x.png", "--ortho", "-1"], "positive height"),
    (["report", "bumps.clsurf", "-o", "x.pdf"], ".html"), (["report", "gone.clsurf", "-o", "x.html"], "gone.clsurf"),
    (["report", "bumps.clsurf", "-o", "no/x.html"], "no does not exist"),
    (["report", "bumps.clsurf", "-o", "x.html", "--size", "0x0"], "WIDTHxHEIGHT"),
])
def test_a_users_mistake_is_one_line_and_exit_code_2(arguments, says, folder, capsys):
    assert main(arguments) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert said[-1].startswith("clsurf: ") and says in said[-1] and "Traceback" not in "".join(said)
    assert sorted(p.name for p in folder.iterdir()) == ["bumps.clsurf", "cloud.ply", "mesh.ply"]


def test_cameras():
    """The options' cameras are those of the API."""
    surface, size = flat(3), (200, 100)
    middle = surface.bounds.mean(axis=0)
    view = lambda direction="", up="0,1,0", fov=None, eye="", target="", ortho=None: \
        checked_view(direction, up, fov, eye, target, ortho).camera(surface, size)  # noqa: E731
    same = lambda a, b: np.allclose(a.eye, b.eye) and np.allclose(a.rotation, b.rotation) and a.fov == b.fov \
        and a.height == b.height  # noqa: E731
    framed = clsurf.Camera.framing(surface, aspect=2.0)
    assert same(view(), framed)
    assert same(view("0,0,1", "1,0,0", 60.0), clsurf.Camera.framing(surface, (0, 0, 1), 60, (1, 0, 0), 2.0))
    assert same(view(eye="1,2,3"), clsurf.Camera.look_at((1, 2, 3), middle))
    assert same(view(eye="0,0,0", target="0,0,-1", fov=30.0), clsurf.Camera.look_at((0, 0, 0), (0, 0, -1), fov=30))
    assert same(view(eye="1,2,3", ortho=4.0), clsurf.Camera.orthographic((1, 2, 3), middle, height=4))
    above = view("0,0,1", ortho=4.0)
    assert above.height == 4 and np.allclose(above.rotation, np.eye(3)) and np.allclose(above.eye[:2], middle[:2])
    aside = view(target="5,5,0")
    assert np.allclose(aside.rotation, framed.rotation)
    assert np.allclose(aside.projection(size).cx, 100) and np.allclose(np.cross(aside.eye - [5, 5, 0],
                                                                                aside.rotation[2]), 0, atol=1e-9)


def test_recipes(device):
    assert recipe().slim == {"degree": 2, "error": None} and recipe().kind == ""
    assert recipe(error="auto").slim["error"] == "auto"
    made = recipe("patches", error="0.001", nodes="9x5", views=3)
    assert made.patches == {"nodes": (9, 5), "views": 3, "error": 0.001} and made.kind == "patches"
    assert recipe(patches=4).kind == "patches"
    assert recipe().kind_for(clsurf.models.sphere(100)) == "slim"


def test_patches_as_a_mesh():
    """Every opaque cell is two triangles that face the way axis_z points; transparent nodes are gone."""
    surface = flat(2, (5, 4), 0.5, np.where(np.arange(20) == 7, np.nan, 1.0))
    mesh = patch_mesh(surface)
    assert len(mesh.vertices) == 2 * 19 and len(mesh.faces) == 2 * 2 * 8 and mesh.colors is None
    points = mesh.vertices[mesh.faces] + mesh.origin
    normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    assert np.allclose(normals, [0, 0, 0.25]) and np.allclose(points[..., 2], 1)
    colored = clsurf.PatchSurface([[0, 0, 0]], [[1, 0, 0]], [[0, 1, 0]], [1], (2, 2), np.zeros(4, np.int8),
                                  color=(9, 8, 7))
    assert (patch_mesh(colored).colors == [9, 8, 7, 255]).all()
    none = clsurf.PatchSurface(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), (17, 17),
                               np.zeros(0, np.int8))
    assert len(patch_mesh(none).vertices) == 0


def test_help_names_every_option_of_patches(capsys):
    assert main(["build", "--help"]) == 0
    told = capsys.readouterr().out
    assert set(re.findall(r"--(\w+)", told)) >= {"kind", "patches", "spacing", "nodes", "error", "method", "views",
                                                 "precise", "degree", "device", "quiet"}
