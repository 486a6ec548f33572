"""Morphing: concentric spheres, closed forms, sizes, centres, holes, normals, several models, the command."""

import numpy as np
import pytest
from reference import scale_map as twin
from reference.trace_rays import unit

import clsurf
from clsurf import Mesh
from clsurf.build.morph import morph_frames
from clsurf.cli import main
from clsurf.errors import InputError
from clsurf.surface.cube import texel_directions
from clsurf.surface.scale_map import ScaleMap, encoded_normals


def ball(radius, size=16, bits=8, center=(0, 0, 0), normals=False, sphere=None):
    """A map of a sphere about its own centre, relative to a larger sphere where one is named."""
    sphere = radius if sphere is None else sphere
    f = lambda d: np.full(d.shape[:3], radius / sphere)  # noqa: E731
    own = twin.smooth_map(size, f=f, bits=32)
    scales = clsurf.surface.scale_map.encoded(np.full(own.scales.shape, radius / sphere), bits)
    return ScaleMap(center, sphere, scales, own.valid,
                    encoded_normals(texel_directions(size)) if normals else None)


@pytest.mark.parametrize("t", (0, 0.25, 0.5, 0.9, 1))
def test_concentric_spheres(device, t):
    """The mean radius within half a code, of different radii, sizes and bits."""
    a, b = ball(1.0, sphere=1.5), ball(3.0, size=24, bits=16)
    between = clsurf.morph(a, b, t, device=device)
    wanted = (1 - t) * 1.0 + t * 3.0
    code = between.radius / (255 if between.bits == 8 else 65535)
    got = between.lambdas[0] * between.radius
    # A's own code is off by up to half of it, and the sphere's radius is the blend of both.
    assert np.abs(got - wanted).max() <= 0.5 * code + (1 - t) * 0.5 * 1.5 / 255 + 1e-6
    assert between.valid.all() and between.size == 24 and between.radius == pytest.approx((1 - t) * 1.5 + t * 3)
    same = clsurf.morph(ball(1.0, sphere=2.0), ball(1.5, sphere=2.0), t, device=device)
    assert np.abs((same.lambdas[0] * same.radius).mean() - (1 + 0.5 * t)) <= 0.5 * 2 / 255 + 0.5 * 2 / 255


def test_ends_are_the_models_themselves(device):
    rng = np.random.default_rng(0)
    a, b = (twin.smooth_map(9, f=lambda d: 1 + 0.2 * rng.uniform(-1, 1, d.shape[:3]), bits=8) for _ in range(2))
    assert np.array_equal(clsurf.morph(a, b, 0).scales, a.scales)
    assert np.array_equal(clsurf.morph(a, b, 1).scales, b.scales)


def test_distances_and_centres_blend_linearly(device):
    """Against the closed form at every texel, three models of different sizes, centres and radii."""
    shapes = [(16, (0, 0, 0), (0.2, 0.1, 0)), (32, (5, 1, 0), (0, 0.3, 0)), (24, (-1, 0, 9), (0, 0, -0.25))]
    weights = np.array([1.0, 2, 1])
    models = []
    for size, center, inner in shapes:
        own = twin.smooth_map(size, inner)
        models.append(ScaleMap(center, own.radius, own.scales, own.valid))
    between = clsurf.morph(list(zip(models, weights, strict=True)), device=device)
    d = texel_directions(32)
    wanted = sum(w * twin.sphere_distance(d, inner) for w, (_, _, inner) in zip(weights / 4, shapes, strict=True))
    assert between.size == 32 and between.bits == 32
    assert np.abs(between.lambdas[0] * between.radius - wanted).max() < 2e-3  # of the resampling from 16
    assert np.allclose(between.center, (weights / 4) @ [center for _, center, _ in shapes])


def test_normals_are_those_of_the_blended_shape(device):
    """Offset spheres whose blend is no sphere: stored normals against the gradient of the blended distances."""
    maps = []
    for inner in ((0.3, 0, 0.1), (-0.1, 0.3, 0)):
        own = twin.smooth_map(48, inner)
        normals = encoded_normals(unit(own.positions()[0] - inner))
        maps.append(ScaleMap((0, 0, 0), own.radius, own.scales, own.valid, normals))
    between = clsurf.morph(*maps, 0.4, device=device)
    exact = twin.scale_normals(between)
    angle = np.degrees(np.arccos(np.clip((between.unit_normals()[0] * exact).sum(-1), -1, 1)))
    assert angle.max() < 1.5 and clsurf.morph(maps[0], ball(1), 0.5, device=device).normals is None


def test_holes_go_with_the_weight_and_leave_no_step(device):
    a, b = ball(1.0, 16, 32), ball(2.0, 16, 32)
    valid = a.valid.copy()
    valid[0, 2, 3:9, 3:9] = False
    a = ScaleMap(a.center, a.radius, np.where(valid, a.scales, 0), valid)
    for t, holes in ((0, True), (0.4, True), (0.5, False), (0.6, False), (1, False)):
        between = clsurf.morph(a, b, t, device=device)
        assert (between.hole_share > 0) == holes
        assert np.allclose(between.lambdas[0][between.valid[0]] * between.radius, 1 + t, atol=1e-6)
    nothing = ScaleMap(a.center, 1.0, a.scales, np.zeros_like(valid))
    assert clsurf.morph(nothing, b, 0.2, device=device).hole_share == 1


def test_meshes_and_placed_maps(device):
    v, f = twin.icosphere(3)
    mesh = Mesh(v, f)
    larger = ball(1).moved([[3, 0, 0, 1], [0, 3, 0, 0], [0, 0, 3, 0], [0, 0, 0, 1]])
    between = clsurf.morph(mesh, larger, 0.5, device=device)
    assert between.size == 128 and between.radius == pytest.approx(2, rel=1e-3)
    assert np.allclose(between.center, (0.5, 0, 0), atol=1e-6)
    shapes = list(morph_frames(ball(1), ball(2), 5, ease=True, device=device))
    radii = [s.radius for s in shapes]
    assert len(shapes) == 5 and np.allclose(radii, [1, 1.15625, 1.5, 1.84375, 2])


@pytest.mark.parametrize("wrong", (
    (ball(1), ball(2)), (ball(1), ball(2), 1.5), (ball(1), ball(2), "half"), ([],), ([(ball(1), -1)],),
    ([(ball(1), 0)],), ([ball(1), ball(2)],), (ball(1),),
    (ball(1).moved([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), ball(1), 0.5)))
def test_bad_requests(device, wrong):
    with pytest.raises(InputError, match="expected"):
        clsurf.morph(*wrong, device=device)


def test_the_commands(device, tmp_path, capsys, monkeypatch):
    """build, info, render, convert, report and morph on scale maps, from file to file."""
    monkeypatch.setenv("CLSURF_DEVICE", device.name)
    v, f = twin.icosphere(3)
    for name, axes in (("a", (1, 1, 1)), ("b", (1, 0.7, 0.6))):
        clsurf.save(Mesh(v * axes, f), tmp_path / f"{name}.ply")
    at = lambda name: str(tmp_path / name)  # noqa: E731
    assert main(["build", at("a.ply"), at("a.clsurf"), "--kind", "scale_map", "--size", "12", "--bits", "16",
                 "--layers", "2", "--normals", "--hit", "innermost", "--center", "0,0.1,0", "-q"]) == 0
    surface = clsurf.load(tmp_path / "a.clsurf")
    assert (surface.size, surface.bits, surface.layers, surface.hit) == (12, 16, 2, "innermost")
    assert np.allclose(surface.center, (0, 0.1, 0)) and surface.normals is not None
    assert main(["info", at("a.clsurf")]) == 0
    assert "12 x 12, 16 bits, layers 2, innermost hits, normals yes" in capsys.readouterr().out
    assert main(["render", at("a.clsurf"), at("a.png"), "--size", "60x50", "--form", "geosphere", "--faces", "3",
                 "--normals", "stored", "-q"]) == 0
    assert main(["convert", at("a.clsurf"), at("c.ply"), "-q"]) == 0
    assert len(clsurf.load(tmp_path / "c.ply").faces) > 1000
    assert main(["report", at("a.clsurf"), "--out", at("a.html"), "--size", "60x50", "-q"]) == 0
    assert "Rays with several hits" in (tmp_path / "a.html").read_text()
    assert main(["morph", at("a.ply"), at("b.ply"), at("m.gif"), "--frames", "3", "--back", "--size", "40x30",
                 "--texels", "8", "-q"]) == 0
    assert (tmp_path / "m.gif").stat().st_size > 500
    assert main(["morph", at("a.ply"), at("a.clsurf"), at("frames"), "--frames", "2", "--fit", "--size", "40x30",
                 "--texels", "8", "-q"]) == 0
    assert len(list((tmp_path / "frames").iterdir())) == 2
    assert main(["morph", at("a.ply"), at("b.ply"), at("m.clsurf"), "--t", "0.5", "--texels", "8", "-q"]) == 0
    assert clsurf.load(tmp_path / "m.clsurf").size == 8


@pytest.mark.parametrize("wrong", (
    ["build", "a.ply", "a.clsurf", "--kind", "scale_map", "--bits", "9"],
    ["build", "a.ply", "a.slim2t", "--kind", "scale_map"],
    ["build", "a.ply", "a.clsurf", "--layers", "2"],
    ["build", "a.ply", "a.clsurf", "--kind", "scale_map", "--error", "0.1"],
    ["build", "a.ply", "a.clsurf", "--kind", "scale_map", "--center", "middle"],
    ["render", "a.clsurf", "a.png", "--form", "mesh"], ["morph", "a.ply", "b.ply", "m.avi"],
    ["morph", "a.ply", "b.ply", "m.gif", "--frames", "1"], ["morph", "a.ply", "b.ply", "m.clsurf", "--t", "2"]))
def test_bad_commands_end_with_a_line(tmp_path, monkeypatch, capsys, wrong):
    monkeypatch.chdir(tmp_path)
    assert main(wrong) == 2
    said = capsys.readouterr().err
    assert "expected" in said or "option" in said
    assert "Traceback" not in said
