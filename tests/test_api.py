"""The face of the package: README's calls as written, the public names, their docstrings and one-line texts."""

import inspect
import pickle
import re
from pathlib import Path

import numpy as np
import pytest

import clsurf
from bench.answer_scenes import torus_mesh

CLASSES = [thing for name in clsurf.__all__ if inspect.isclass(thing := getattr(clsurf, name))]
FUNCTIONS = [thing for name in clsurf.__all__ if inspect.isfunction(thing := getattr(clsurf, name))]
README = Path(__file__).resolve().parents[1] / "README.md"


@pytest.fixture(autouse=True)
def _on_device(monkeypatch, device):
    """Calls without device= use the device under test."""
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")


@pytest.fixture(scope="module")
def ball():
    """2000 points of the unit ball around a survey coordinate, with normals and colours."""
    scan = clsurf.models.sphere(2000)
    colors = np.full((len(scan.points), 4), 255, np.uint8)
    return clsurf.PointCloud(scan.points + np.array([7e5, 7.6e6, 0]), normals=scan.normals, colors=colors)


@pytest.fixture(scope="module")
def slim(ball, device):
    return clsurf.build_slim(ball, device=device)


def test_the_public_names():
    assert sorted(clsurf.__all__) == clsurf.__all__
    assert all(hasattr(clsurf, name) for name in clsurf.__all__)
    assert issubclass(clsurf.errors.InputError, ValueError) and issubclass(clsurf.errors.DeviceError, clsurf.Error)
    assert re.fullmatch(r"\d+\.\d+\.\d+", clsurf.__version__)


def test_readme_runs_as_written(ball, tmp_path, monkeypatch, device):
    """Every line of README's Python, with a generated bunny.ply, 3 views of the 360 and the device under test."""
    monkeypatch.chdir(tmp_path)
    clsurf.save(ball, "bunny.ply")
    code = re.search(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)[1]
    code = code.replace("range(360)", "range(0, 360, 120)").replace('device="intel"', "device=device")
    names = {"device": device, "points": ball.points[:10] + ball.origin}
    exec(code, names)
    frame, near = names["frame"], names["near"]
    assert frame.size == (1024, 768) and Path("bunny.png").stat().st_size > 1000
    assert np.isnan(frame.depth[0, 0]) and np.isfinite(frame.depth[384, 512]) and frame.normal.shape == (768, 1024, 3)
    assert near.position.dtype == np.float64 and np.abs(near.distance).max() < 0.01
    assert len(clsurf.load("bunny.clsurf")) == len(names["slim"])


def test_readmes_patches_run_as_written(slim, tmp_path, monkeypatch, device):
    """README's second block, with a generated bowl in place of bun.conf."""
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[:48, :64]
    depth = (1 + 1e-4 * ((x - 32) ** 2 + (y - 24) ** 2)).astype(np.float32)
    scan = clsurf.load_frames(depth=[depth], intrinsics=np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]))
    code = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)[1]
    assert 'clsurf.load("bun.conf")' in code
    names = {"clsurf": clsurf, "slim": slim, "matrix": np.eye(4), "scan": scan}
    exec(code.replace('clsurf.load("bun.conf")', "scan"), names)
    assert isinstance(names["patches"], clsurf.PatchSurface) and len(names["patches"]) >= 4
    assert Path("scans.png").stat().st_size > 1000 and "<svg" in Path("scans.html").read_text(encoding="utf-8")


def test_readmes_measures_run_as_written(slim, tmp_path, monkeypatch, device):
    """README's third block, with a bumpy sphere as the scan, a noisy one, and its surface."""
    monkeypatch.chdir(tmp_path)
    points = clsurf.models.sphere(4000).points.astype(np.float64)
    scan = clsurf.PointCloud(points * (1 + 0.05 * np.sin(6 * points[:, :1])) + slim.bounds.mean(axis=0))
    noisy = clsurf.PointCloud(points + np.random.default_rng(0).normal(0, 0.005, points.shape))
    code = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)[2]
    names = {"clsurf": clsurf, "slim": slim, "scan": scan, "noisy": noisy, "camera": clsurf.Camera.framing(slim)}
    exec(code, names)
    radius = np.linalg.norm(names["clean"].points + names["clean"].origin, axis=1)
    assert np.abs(radius - 1).mean() < 0.5 * np.abs(np.linalg.norm(noisy.points + noisy.origin, axis=1) - 1).mean()
    assert names["bends"].mean.shape == (4000,) and names["hits"].hit.sum() > 100_000
    assert "<svg" in Path("inked.svg").read_text(encoding="utf-8")
    assert all(Path(name).stat().st_size > 1000 for name in ("mean.png", "inked.png", "inked.svg"))


def test_readmes_scenes_run_as_written(slim, tmp_path, monkeypatch, device):
    """README's fourth block: all kinds, materials and light in one picture."""
    monkeypatch.chdir(tmp_path)
    shown = []
    monkeypatch.setattr(clsurf, "view", shown.append)
    mesh = torus_mesh(40, 20)
    code = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)[3]
    names = {"clsurf": clsurf, "slim": slim, "scan": mesh, "mesh": mesh, "matrix": np.eye(4),
             "cloud": clsurf.models.sphere(2000), "other": clsurf.build_scale_map(mesh, size=32)}
    exec(code, names)
    assert Path("scene.png").stat().st_size > 5_000 and shown == [names["scene"]]


def test_readmes_survey_is_streamed_as_written(tmp_path, monkeypatch, device):
    """README's fifth block, with a generated survey."""
    monkeypatch.chdir(tmp_path)
    clsurf.save(clsurf.models.torus(20_000, 100.0, 40.0), "survey.laz")
    names = {"clsurf": clsurf}
    exec(re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.S)[4], names)
    assert isinstance(names["survey"], clsurf.StoredSurface) and len(names["survey"]) > 100


def test_readmes_commands_exist(capsys):
    """Every `clsurf ...` line of README's second shell block names a command and options that its help knows."""
    from clsurf.cli import main
    block = README.read_text(encoding="utf-8").partition("or from the shell")[2].split("```")[1]
    lines = re.findall(r"^clsurf (\w+)(.*?)(?:#.*)?$", block, re.M)
    assert len(lines) >= 6
    for command, rest in lines:
        assert main([command, "--help"]) == 0
        told = capsys.readouterr().out
        assert all(option in told for option in re.findall(r"--\w+", rest)), command


def test_a_scene_of_placed_surfaces(slim):
    """Two surfaces in one z-buffer: `id` tells them apart, `position` + `origin` is a survey coordinate."""
    matrix = np.eye(4)
    matrix[0, 3] = 3.0
    scene = clsurf.Scene([slim, slim.moved(matrix)])
    frame = clsurf.render(scene, clsurf.Camera.framing(scene, direction=(0, 0, 1), aspect=2.0), size=(160, 80),
                          channels=("color", "id", "position", "depth"))
    assert set(np.unique(frame.id)) == {-1, 0, 1} and frame.id[40, 45] == 0 and frame.id[40, 115] == 1
    center = slim.bounds.mean(axis=0) + np.where(frame.id[..., None] == 1, 3.0, 0.0) * np.array([1, 0, 0])
    hit = frame.id >= 0
    radius = np.linalg.norm(frame.position.astype(float) + frame.origin - center, axis=-1)[hit]
    assert np.abs(radius - 1).max() < 0.02


def test_a_frame_shows_itself_and_tells_its_channels(slim):
    frame = clsurf.render(slim, size=(40, 30), channels=("color",))
    assert frame._repr_png_().startswith(b"\x89PNG") and np.asarray(frame).shape == (30, 40, 4)
    with pytest.raises(AttributeError, match="channels="):
        _ = frame.depth
    assert clsurf.render(slim, size=(1, 1)).size == (1, 1)


def test_a_closed_renderer_says_so(slim, device):
    with clsurf.Renderer(device=device) as renderer:
        renderer.render(slim, size=(8, 8))
    renderer.close()
    with pytest.raises(clsurf.errors.DeviceError, match="closed"):
        renderer.render(slim, size=(8, 8))


def test_data_pickles(ball, slim):
    for thing in (ball, slim, clsurf.models.torus(500), clsurf.render(slim, size=(8, 8)), clsurf.Camera.framing(slim)):
        again = pickle.loads(pickle.dumps(thing))
        assert type(again) is type(thing) and repr(again) == repr(thing)


def test_an_empty_scene_is_all_background():
    frame = clsurf.render(clsurf.Scene([]), size=(20, 10), channels=("color", "depth", "id"))
    assert (frame.color == 1).all() and np.isnan(frame.depth).all() and (frame.id == -1).all()


def test_one_line_texts(ball, slim, device):
    camera = clsurf.Camera.framing(slim)
    mesh = clsurf.Mesh(np.eye(3, dtype=np.float32), [[0, 1, 2]])
    things = [ball, mesh, slim, slim.moved(np.eye(4)), camera, device, clsurf.Shading(), clsurf.Profile(),
              clsurf.render(slim, camera, size=(8, 8))]
    for thing in things:
        text = repr(thing)
        assert "\n" not in text and "array(" not in text and len(text) < 260, text


@pytest.mark.parametrize("thing", CLASSES + FUNCTIONS, ids=lambda thing: thing.__name__)
def test_docstrings(thing):
    """A sentence everywhere; Parameters name every argument of a function; what returns says Returns."""
    text = inspect.getdoc(thing) or ""
    assert text.split("\n")[0].endswith((".", ":")), "one sentence first"
    for name, member in vars(thing).items() if inspect.isclass(thing) else ():
        if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, property | classmethod)):
            assert inspect.getdoc(getattr(thing, name)), f"{thing.__name__}.{name}"
    if inspect.isfunction(thing) and "`Renderer.render`" not in text:
        assert "Parameters\n---" in text and "Raises\n---" in text
        described = text.split("Parameters\n---")[1]
        for name in inspect.signature(thing).parameters:
            assert re.search(rf"\b{name}\b.* : ", described), name
        if inspect.signature(thing).return_annotation not in (None, "None"):
            assert "Returns\n---" in text or text.startswith("Return")


@pytest.mark.parametrize("call", [
    lambda: clsurf.project(clsurf.models.sphere(10), "x"),
    lambda: clsurf.project(clsurf.models.sphere(10), [[0, 0, 0]]),
    lambda: clsurf.estimate_normals(3), lambda: clsurf.estimate_normals(clsurf.models.sphere(10), k="x"),
    lambda: clsurf.estimate_normals(clsurf.models.sphere(10), orient={1}), lambda: clsurf.Shading(color="red"),
    lambda: clsurf.Shading(ambient="x"), lambda: clsurf.Shading(shininess=None)])
def test_wrong_arguments_are_named_in_one_line(call):
    with pytest.raises(clsurf.errors.InputError, match=r"expected .*, got") as caught:
        call()
    assert "\n" not in str(caught.value)


def test_texts_are_short(device):
    surface = clsurf.build_slim(clsurf.models.sphere(500), device=device)
    for thing in (clsurf.Scene([surface]), clsurf.Renderer(device), clsurf.project(surface, np.zeros((3, 3)), device)):
        assert "\n" not in repr(thing) and len(repr(thing)) < 120
