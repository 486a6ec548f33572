"""Anti-aliasing by coverage: pixels with an edge are those of 4 x 4 samples, all others those of one."""

import numpy as np
import pytest
from reference import light as twin
from reference.patch_scenes import globe
from reference.surfaces import sphere
from test_render_supersampling import half_plane

import clsurf
from clsurf.errors import InputError
from clsurf.render import renderer
from clsurf.render.camera import Camera
from clsurf.render.coverage import FACTOR, edge_layout, mark_edges
from clsurf.render.light import Light
from clsurf.render.material import Material
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Shading
from clsurf.render.tiles import BIN, Grid, Layout, Scratch, view_floats

SIZE = (61, 45)
CAMERA = Camera.look_at((0.3, 0.8, 3.6), (0, 0, 0), fov=40)
ORTHOGRAPHIC = Camera.orthographic((1, 2, 3), (0, 0, 0), height=3)


def scene():
    """A sphere, one that cuts it, and a flat rim behind."""
    shift = np.eye(4)
    shift[:3, 3] = 0.9, 0.3, 0.2
    return [sphere(400), sphere(300).moved(0.5 * np.eye(4) + np.diag([0, 0, 0, 0.5])).moved(shift)]


def edges_of(frame, camera):
    normal = frame.normal.astype(float) @ camera.rotation.T
    return twin.mark_edges(view_floats(camera, frame.size), frame.depth.astype(float), normal, frame.id)


@pytest.mark.parametrize("camera", (CAMERA, ORTHOGRAPHIC))
@pytest.mark.parametrize("lanes", (16, 1))
def test_edges_have_the_mean_of_their_samples(device, lanes, camera):
    """Every pixel is, exactly, that of the supersampled picture or that of the plain one, as the twin's edges say."""
    surfaces, shading = scene(), Shading()
    with Renderer(device, lanes=lanes) as r:
        plain = r.render(surfaces, camera, SIZE, ("color", "depth", "normal", "id"), shading, lod=0)
        fine = r.render(surfaces, camera, SIZE, ("color",), shading, lod=0, antialias="supersample")
        got = r.render(surfaces, camera, SIZE, ("color", "depth", "id"), shading, lod=0, antialias="coverage")
    edges = edges_of(plain, camera)
    assert 150 < edges.sum() < 0.6 * edges.size
    doubtful = np.zeros_like(edges)  # where rounding decides whether a step of depth is one
    differs = np.abs(got.color - np.where(edges[..., None], fine.color, plain.color)).max(axis=2) > 2e-4
    doubtful |= differs
    assert doubtful.sum() <= 2
    assert np.array_equal(got.depth, plain.depth, equal_nan=True) and np.array_equal(got.id, plain.id)
    assert list(got.channels) == ["color", "depth", "id"]


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("camera", (CAMERA, ORTHOGRAPHIC))
def test_mark_edges(device, lanes, camera):
    with Renderer(device, lanes=lanes) as r:
        plain = r.render(scene(), camera, SIZE, ("color", "depth", "normal", "id"), lod=0)
    arrays = {name: device.upload(plain.channels[name]) for name in ("depth", "normal", "id")}
    grid = Grid(SIZE, 4, Layout(), None, None)
    edges, large = mark_edges(device, Scratch(device, lanes), grid, device.upload(view_floats(camera, SIZE)), arrays,
                              edge_layout(Layout(), 1))
    got, wanted = device.download(edges).astype(bool), edges_of(plain, camera)
    assert (got != wanted).sum() <= 2
    bins = device.download(large.touched).reshape(large.bins_y, large.bins_x)
    side = BIN // FACTOR
    padded = np.zeros((side * large.bins_y, side * large.bins_x), bool)
    padded[:SIZE[1], :SIZE[0]] = got
    assert np.array_equal(bins == -1, padded.reshape(large.bins_y, side, large.bins_x, side).any(axis=(1, 3)))
    assert set(np.unique(bins)) == {-1, -2} and large.size == (4 * SIZE[0], 4 * SIZE[1])


@pytest.mark.parametrize("lanes", (16, 8, 1))
def test_what_an_edge_is(device, lanes):
    """A fold is one from 35 degrees on; a step of depth from one and a half pixels on, unless a plane goes on there."""
    size, camera = (21, 9), Camera.orthographic((0, 0, 5), (0, 0, 0), height=9)  # a pixel is a unit wide
    grid, view = Grid(size, 4, Layout(), None, None), device.upload(view_floats(camera, size))

    def columns(depth, normal, number=None):
        arrays = {"depth": depth, "normal": normal} | ({} if number is None else {"id": number})
        arrays = {name: device.upload(np.tile(a, (9, *a.ndim * (1,)))) for name, a in arrays.items()}
        edges, _ = mark_edges(device, Scratch(device, lanes), grid, view, arrays, edge_layout(Layout(), 1))
        edges = device.download(edges)
        assert (edges == edges[0]).all()
        return np.flatnonzero(edges[0]).tolist()

    def facing(degrees):
        a = np.radians(degrees) * np.ones(21)
        return np.stack([np.sin(a), np.zeros(21), np.cos(a)], axis=1).astype(np.float32)

    flat, right = np.full(21, 5, np.float32), np.arange(21) >= 8
    assert columns(flat, facing(0)) == []
    for degrees, wanted in ((30, []), (40, [7, 8])):
        assert columns(flat, np.where(right[:, None], facing(degrees), facing(0))) == wanted
    for step, wanted in ((1.4, []), (1.7, [7, 8]), (-1.7, [7, 8]), (np.nan, [7, 8])):
        assert columns(np.where(right, flat + np.float32(step), flat), facing(0)) == wanted
    slope = (5 + 3 * np.arange(21)).astype(np.float32)
    tilt = -np.degrees(np.arctan(3))
    assert columns(slope, facing(-tilt)) == [] and len(columns(slope, facing(tilt))) == 21
    assert columns(flat, facing(0), right.astype(np.int32)) == [7, 8]


@pytest.mark.parametrize("angle", (3, 17, 40, 73))
def test_edge_of_a_half_plane(device, angle):
    """What a straight edge covers of its pixels, to what 16 samples can tell: none of its pixels is forgotten."""
    camera = Camera.orthographic((0, 0, 5), (0.01, 0.02, 0), height=0.5)
    y, x = np.mgrid[:64, :64] + 0.5
    right, up = (x - 32) * 0.5 / 64 + 0.01, (32 - y) * 0.5 / 64 + 0.02
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    fine = np.linspace(-0.5, 0.5, 41)[:-1] + 0.0125
    signed = (right * c + up * s) * 64 / 0.5
    wanted = (signed[..., None, None] + fine[:, None] * c + fine[None] * s > 0).mean(axis=(-2, -1))
    with Renderer(device) as r:
        white = Shading(look="flat", color=(1, 1, 1))
        got, plain, fine = (r.render(half_plane(angle), camera, (64, 64), ("color",), white, background="transparent",
                                     antialias=a).color[..., 3] for a in ("coverage", "none", "supersample"))
    assert np.array_equal(got, fine) and np.abs(got - wanted).max() < 0.25
    error = [np.sqrt(np.mean((a - wanted) ** 2)) for a in (got, plain)]
    assert error[0] < 0.35 * error[1]


@pytest.mark.parametrize("lanes", (16, 1))
def test_patches(device, lanes):
    """Patches are drawn at once where nothing else is; their edges come from the tiles that hold one."""
    surface = globe()
    with Renderer(device, lanes=lanes) as r:
        plain, got, fine = (r.render(surface, CAMERA, SIZE, ("color",), antialias=a)
                            for a in ("none", "coverage", "supersample"))
    changed = np.abs(got.color - plain.color).max(axis=2) > 0
    assert 60 < changed.sum() < 0.35 * changed.size
    assert np.abs(got.color - fine.color)[changed].max() < 2e-3
    outline = np.abs(fine.color - plain.color).max(axis=2) > 0.1
    assert (changed | ~outline).all()


def test_materials_shadows_and_skies_at_edges(device):
    """What the stage that lights planes does it does for edges too."""
    lights = [Light("image", picture=np.linspace(0, 1, 32 * 64 * 3).reshape(32, 64, 3).astype(np.float32)),
              Light("directional", (1, 1, 1), intensity=0.5)]
    made = Scene(scene(), lights, [Material("physical", roughness=0.6), Material("matcap")])
    shading = Shading(shadows=True)
    with Renderer(device) as r:
        frames = [r.render(made, CAMERA, SIZE, ("color", "depth", "normal", "id"), shading, lod=0, background="sky",
                           antialias=a) for a in ("none", "coverage", "supersample")]
    edges = edges_of(frames[0], CAMERA)
    error = np.abs(frames[1].color - frames[2].color).max(axis=2)
    assert np.median(error[edges]) < 1e-4 and np.quantile(error[edges], 0.95) < 0.02
    assert np.quantile(np.abs(frames[0].color - frames[2].color).max(axis=2)[edges], 0.8) > 0.02


def test_nothing_to_see(device):
    with Renderer(device) as r:
        for things in ([], [sphere(20)]):
            away = Camera.look_at((0, 0, 5), (0, 0, 9))
            frame = r.render(things, away, (9, 7), ("color",), antialias="coverage", background=(0.5, 0.5, 0.5))
            assert np.ptp(frame.color[..., 0]) == 0
        depth = r.render(sphere(20), None, (9, 7), ("depth",), antialias="coverage")
        assert list(depth.channels) == ["depth"]


@pytest.mark.parametrize("wrong", [{"antialias": "fxaa"}, {"antialias": "coverage", "supersampling": 2},
                                   {"antialias": 4}])
def test_wrong_options_say_what_is_expected(device, wrong):
    with Renderer(device) as r, pytest.raises(InputError, match="antialias"):
        r.render(sphere(20), None, (8, 8), **wrong)


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("kind", ("slim", "mesh", "cloud", "patches", "scale map", "surfels"))
def test_no_stage_draws_bins_without_edges(device, lanes, kind, monkeypatch):
    """The large picture's bins that are not wanted stay as they were marked, in every kind's tile stage."""
    mesh, marked = ball_mesh(), []
    surface = {"slim": lambda: sphere(300), "mesh": lambda: mesh, "cloud": lambda: clsurf.models.basic.sphere(3000),
               "patches": lambda: clsurf.models.perfect_sphere(radius=1.0),
               "scale map": lambda: clsurf.build_scale_map(mesh, size=16, device=device),
               "surfels": lambda: clsurf.build_surfels(mesh, device=device)}[kind]()

    def watched(device, layout, *more, of=renderer.mark_edges):
        edges, large = of(device, layout, *more)
        marked.append((large, device.download(large.touched)))
        return edges, large
    monkeypatch.setattr(renderer, "mark_edges", watched)
    with Renderer(device, lanes=lanes) as r:
        r.render(Scene([surface]), CAMERA, SIZE, ("color",), antialias="coverage")
        (large, before), = marked
        after = device.download(large.touched)
    assert (before == -2).any() and (before == -1).any()
    assert (after[before == -2] == -2).all() and (after[before == -1] >= 0).sum() > 10


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("kind", ("mesh", "scale map", "surfels"))
def test_every_representation(device, lanes, kind):
    """The same promise for what has tiles of its own: edges as with 4 x 4 samples, the rest untouched."""
    mesh = ball_mesh()
    surface = {"mesh": lambda: mesh, "scale map": lambda: clsurf.build_scale_map(mesh, size=16, device=device),
               "surfels": lambda: clsurf.build_surfels(mesh, device=device)}[kind]()
    with Renderer(device, lanes=lanes) as r:
        plain, got, fine = (r.render(Scene([surface], [Light()], Material("flat", (0.2, 0.4, 0.6))), CAMERA, SIZE,
                                     ("color", "depth", "normal", "id"), lod=0, antialias=a)
                            for a in ("none", "coverage", "supersample"))
    edges = edges_of(plain, CAMERA)
    assert 60 < edges.sum() < 0.6 * edges.size
    assert (np.abs(got.color - np.where(edges[..., None], fine.color, plain.color)).max(axis=2) > 1e-5).sum() <= 2


def ball_mesh():
    """A sphere of triangles."""
    n = 24
    down, around = np.pi * np.arange(n + 1) / n, 2 * np.pi * np.arange(2 * n) / (2 * n)
    points = np.stack([np.outer(np.sin(down), np.cos(around)), np.outer(np.sin(down), np.sin(around)),
                       np.outer(np.cos(down), np.ones(2 * n))], axis=-1).reshape(-1, 3)
    i, j = (a.ravel() for a in np.mgrid[:n, :2 * n])
    a, b = i * 2 * n + j, i * 2 * n + (j + 1) % (2 * n)
    faces = np.concatenate([np.stack([a, a + 2 * n, b], axis=1), np.stack([b, a + 2 * n, b + 2 * n], axis=1)])
    return clsurf.Mesh(points, faces[(faces[:, 0] >= 2 * n) | (faces[:, 1] >= 2 * n)])
