"""Feature lines against analytic curves, their drawing, their files, odd input."""

import pickle
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from reference.implicit import Quadric, Torus, implicit_channels, surface_channels
from reference.surfaces import fitted, torus_points

import clsurf
from clsurf.analysis.line_chains import chains, relaxed
from clsurf.analysis.lines import KINDS
from clsurf.errors import InputError
from clsurf.render.camera import Camera
from clsurf.render.frame import Frame

ALL = tuple(KINDS)
SIZE = (256, 256)
TORUS_CAMERA = Camera.look_at((0.8, -3.9, 2.8), (0, 0, 0), up=(0, 0, 1), fov=35)
ORTHOGRAPHIC = Camera.orthographic((0.8, -3.9, 2.8), (0, 0, 0), up=(0, 0, 1), height=3.0)


def exact(shape, camera, size=SIZE):
    return Frame(implicit_channels(shape, camera, size), np.zeros(3), camera)


def pixel_distance(shape, camera, size, points, value):
    """Distance (n,) in pixels from points (n, 2) to the zeros of value(channels) on the exact surface, by its slope."""
    p = camera.projection(size)

    def at(xy):
        view = np.stack([(xy[:, 0] - p.cx) / p.fx, (p.cy - xy[:, 1]) / p.fy, -np.ones(len(xy))], axis=1)
        origins = np.broadcast_to(camera.eye, view.shape)
        if not p.perspective:
            origins = camera.eye + (view * [1, 1, 0]) @ camera.rotation
            view = view * [0, 0, 1]
        directions = view @ camera.rotation
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        place = origins + shape.hits(origins, directions)[:, None] * directions
        return value(surface_channels(*shape.derivatives(place), -directions))

    step = 0.25
    slope = [(at(points + d) - at(points - d)) / (2 * step) for d in (np.array([step, 0]), np.array([0, step]))]
    return np.abs(at(points)) / np.hypot(*slope)


@pytest.mark.parametrize("camera", (TORUS_CAMERA, ORTHOGRAPHIC), ids=("perspective", "orthographic"))
def test_lines_of_a_torus_lie_on_the_analytic_curves(device, camera):
    torus = Torus()
    found = clsurf.lines(exact(torus, camera), ("suggestive_contours", "parabolic"), detail=20, device=device)
    for kind, channel in (("suggestive_contours", "radial"), ("parabolic", "gaussian")):
        part = found.of(kind)
        assert part.lengths.sum() > 60
        away = pixel_distance(torus, camera, SIZE, part.points.astype(float), lambda c, name=channel: c[name])
        assert np.mean(away) < 0.07 and np.max(away) < 0.5
    # The circles where K = 0 are those at the top and the bottom of the tube.
    rho = np.hypot(*found.of("parabolic").positions[:, :2].T)
    assert np.abs(rho - 1).max() < 0.01
    assert np.abs(np.abs(found.of("parabolic").positions[:, 2]) - 0.4).max() < 1e-3


def test_suggestive_contours_are_those_that_become_contours(device):
    """The radial curvature grows towards the eye there."""
    torus = Torus()
    found = clsurf.lines(exact(torus, TORUS_CAMERA), detail=1000, device=device)
    directions = found.positions - TORUS_CAMERA.eye
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    channels = surface_channels(*torus.derivatives(found.positions), -directions)
    assert len(found) and (channels["radial_derivative"] > 0).all()


@pytest.mark.parametrize("size", ((200, 150), (400, 300)))
def test_a_sphere_has_a_contour_and_no_other_lines(device, size):
    camera = Camera.orthographic((0, 0, 3), (0.05, 0.03, 0), height=3.0)
    found = clsurf.lines(exact(Quadric((1, 1, 1)), camera, size), ALL, device=device)
    assert len(found) == 1 and found.closed[0] and found.kinds[found.kind[0]] == "contours"
    middle = np.array(size) / 2 - np.array([camera.rotation[0], -camera.rotation[1]]) @ camera.eye * size[1] / 3
    radius = np.hypot(*(found.points - middle).T)
    assert np.abs(radius - size[1] / 3).max() < 0.35 and np.abs(np.mean(radius) - size[1] / 3) < 0.05
    assert (found.strength == 1).all()


def test_ridges_of_an_ellipsoid_lie_on_its_symmetry_planes(device):
    axes = np.array([1, 0.6, 0.4])
    camera = Camera.look_at((3.0, 1.1, 1.6), (0, 0, 0), up=(0, 0, 1), fov=40)
    frame = exact(Quadric(axes), camera)
    found = clsurf.lines(frame, ("ridges", "crest"), detail=3, device=device)
    for kind in found.kinds:
        part = found.of(kind)
        assert part.lengths.sum() > 60
        assert np.abs(part.positions / axes).min(axis=1).max() < 0.01
    # The strongest: through the end of the longest axis, across the shortest (k1 = a / c^2 there).
    strong = found.of("ridges").positions[found.of("ridges").strength > 0.9 * found.of("ridges").strength.max()]
    assert np.abs(strong[:, 2]).max() < 0.01 and strong[:, 0].max() > 0.99
    assert len(clsurf.lines(frame, "valleys", detail=100, device=device)) == 0


def test_lines_do_not_depend_on_the_kernels_form(device, monkeypatch):
    frame = exact(Torus(), TORUS_CAMERA)
    one = clsurf.lines(frame, ALL, detail=5, device=device)
    monkeypatch.setattr(device, "lanes", 1)
    other = clsurf.lines(frame, ALL, detail=5, device=device)
    assert len(one) == len(other) > 3 and np.abs(one.points - other.points).max() < 1e-2
    assert np.abs(one.draw().lines - other.draw().lines).max() < 0.02


def test_lines_do_not_depend_on_resolution(device):
    """The same curves at twice the size, at twice the pixels."""
    torus = Torus()
    small, large = (clsurf.lines(exact(torus, TORUS_CAMERA, (n, n)), ("contours", "suggestive_contours", "parabolic"),
                                 detail=20, device=device) for n in (256, 512))
    for kind in small.kinds:
        a, b = small.of(kind), large.of(kind)
        assert abs(2 * a.lengths.sum() - b.lengths.sum()) < 0.1 * b.lengths.sum()
        if kind != "contours":  # whose positions end half a pixel from the surface's end
            far = np.linalg.norm(a.positions[:, None] - b.positions[None], axis=-1).min(axis=1)
            assert np.median(far) < 0.004 and far.max() < 0.05


def test_lines_do_not_depend_on_units_or_place(device):
    torus, scale, shift = Torus(), 1000.0, np.array([5e6, -2e6, 100.0])
    channels = implicit_channels(torus, TORUS_CAMERA, SIZE)
    power = {"depth": 1, "mean": -1, "k1": -1, "k2": -1, "gaussian": -2, "radial": -1, "radial_derivative": -2,
             "derivative1": -2, "derivative2": -2}
    moved = {name: value * np.float32(scale**power.get(name, 0)) for name, value in channels.items()}
    far = Camera.look_at(TORUS_CAMERA.eye * scale + shift, shift, up=(0, 0, 1), fov=35)
    one = clsurf.lines(Frame(channels, camera=TORUS_CAMERA), ALL, detail=5, device=device)
    other = clsurf.lines(Frame(moved, camera=far), ALL, detail=5, device=device)
    assert len(one) == len(other) > 3
    assert np.abs(one.points - other.points).max() < 1e-2
    assert np.abs((other.positions - shift) / scale - one.positions).max() < 1e-4
    assert other.unit == pytest.approx(one.unit / scale, rel=1e-5)
    same = clsurf.lines(Frame(channels, camera=TORUS_CAMERA), ALL, detail=5, unit=one.unit, device=device)
    fewer = clsurf.lines(Frame(channels, camera=TORUS_CAMERA), ALL, detail=5, unit=10 * one.unit, device=device)
    assert np.array_equal(same.points, one.points) and len(fewer) < len(one)


def test_lines_of_a_rendered_surface(device):
    """From points to lines: cubic surfels, their channels, K = 0 and kappa_r = 0 where they belong."""
    torus = Torus()
    surface = fitted(*torus_points(30000), spacing=0.09, degree=3)
    frame = clsurf.render(surface, TORUS_CAMERA, SIZE, ("color", *clsurf.line_channels(ALL)), device=device)
    found = clsurf.lines(frame, ("contours", "suggestive_contours", "parabolic"), detail=5, device=device)
    for kind, channel in (("suggestive_contours", "radial"), ("parabolic", "gaussian")):
        part = found.of(kind)
        away = pixel_distance(torus, TORUS_CAMERA, SIZE, part.points.astype(float), lambda c, name=channel: c[name])
        assert part.lengths.sum() > 60 and np.nanmean(away) < 0.3
    assert found.of("contours").lengths.sum() > 500
    for options in ({"tile": 64}, {"lanes": 1}):
        with clsurf.Renderer(device, **options) as renderer:
            other = renderer.render(surface, TORUS_CAMERA, SIZE, clsurf.line_channels(ALL))
        again = clsurf.lines(other, ("contours", "suggestive_contours", "parabolic"), detail=5, device=device)
        assert len(again) == len(found) and abs(again.lengths - found.lengths).max() < 1
        assert np.median(np.linalg.norm(again.points - found.points, axis=1)) < 1e-3
    drawn = found.draw(frame)
    assert drawn.color.shape == (256, 256, 4) and np.array_equal(drawn.depth, frame.depth, equal_nan=True)
    assert (drawn.color[drawn.lines == 0] == frame.color[drawn.lines == 0]).all() and 0 < drawn.lines.max() <= 1


def test_a_finer_silhouette_gives_the_contours_and_hides_lines(device):
    big, small = (exact(Torus(1.0, r), TORUS_CAMERA) for r in (0.4, 0.3))
    kinds = ("contours", "parabolic")
    found = clsurf.lines(big, kinds, silhouette=small, device=device)
    own = clsurf.lines(small, "contours", device=device)
    assert np.array_equal(found.of("contours").points, own.points)
    alone = clsurf.lines(big, "contours", silhouette=small, device=device)
    assert np.array_equal(alone.points, own.points)
    x, y = found.of("parabolic").points.astype(int).T
    assert np.isfinite(small.depth[y, x]).all()
    assert found.of("parabolic").lengths.sum() < clsurf.lines(big, "parabolic", device=device).lengths.sum() + 1


def test_empty_frames(device):
    for size in ((64, 40), (1, 1), (3, 200)):
        frame = clsurf.render([], TORUS_CAMERA, size, ("color", "depth", "normal"), device=device)
        empty = np.full(size[::-1], np.nan, np.float32)
        more = {name: np.stack([empty] * 3, axis=-1) if "direction" in name else empty
                for name in clsurf.line_channels(ALL) if name not in frame.channels}
        found = clsurf.lines(Frame(frame.channels | more, camera=TORUS_CAMERA), ALL, device=device)
        assert len(found) == len(found.polylines) == 0 and found.lengths.shape == (0,)
        assert (found.draw().color == 1).all() and found.draw(frame).lines.max() == 0
        assert ElementTree.fromstring(found.svg()).tag.endswith("svg")


def test_lines_are_plain_data(device):
    """Read-only arrays; a copy drawn in another process is the same."""
    found = clsurf.lines(exact(Torus(), TORUS_CAMERA, (96, 80)), ("contours", "parabolic"), device=device)
    assert "contours" in repr(found) and not found.points.flags.writeable
    again = pickle.loads(pickle.dumps(found))
    assert again.device is None and np.array_equal(again.points, found.points) and again.kinds == found.kinds
    assert sum(len(found.of(kind)) for kind in found.kinds) == len(found) == len(found.polylines)
    with pytest.raises(ValueError, match="points: expected"):
        replace(found, points=found.points[:-1])


def test_contours_of_other_surfaces(device):
    """They need depth and normal only: spatial patches have them too."""
    frame = clsurf.render(clsurf.models.perfect_sphere(), size=(200, 150), channels=("depth", "normal"), device=device)
    found = clsurf.lines(frame, "contours", device=device)
    assert found.closed.tolist() == [True] and abs(found.lengths[0] / (np.pi * np.ptp(found.points[:, 0])) - 1) < 0.01


def test_channels_with_values_that_are_not_finite(device):
    """Such as the radial curvature where the eye looks along the normal."""
    channels = implicit_channels(Torus(), TORUS_CAMERA, SIZE)
    plain = clsurf.lines(Frame(channels, camera=TORUS_CAMERA), "suggestive_contours", detail=20, device=device)
    spoilt = {name: value.copy() for name, value in channels.items()}
    facing = np.abs(np.nan_to_num(spoilt["radial"])) > 2.4
    spoilt["radial"][facing], spoilt["radial_derivative"][facing] = np.nan, np.inf
    found = clsurf.lines(Frame(spoilt, camera=TORUS_CAMERA), "suggestive_contours", detail=20, device=device)
    assert facing.sum() > 500 and len(found) == len(plain) and np.abs(found.points - plain.points).max() < 0.1


def test_svg_holds_the_polylines(device, tmp_path):
    found = clsurf.lines(exact(Torus(), TORUS_CAMERA), ("contours", "parabolic"), device=device)
    found.save(tmp_path / "x.svg", colors={"parabolic": (1, 0, 0)})
    root = ElementTree.parse(tmp_path / "x.svg").getroot()
    assert root.get("viewBox") == "0 0 256 256"
    groups = {g.get("id"): g for g in root}
    assert set(groups) == {"contours", "parabolic"} and groups["parabolic"].get("stroke") == "rgb(255,0,0)"
    drawn = [np.array([[float(v) for v in p.split(",")] for p in line.get("points").split()])
             for g in root for line in g]
    assert len(drawn) == len(found)
    for got, wanted in zip(drawn, found.polylines, strict=True):
        assert np.abs(got - wanted).max() < 0.006
    for ending in ("png", "jpg", "exr"):
        found.save(tmp_path / f"x.{ending}")
        assert (tmp_path / f"x.{ending}").stat().st_size > 0


def test_strokes_are_as_wide_and_dark_as_asked(device):
    frame = exact(Quadric((1, 1, 1)), Camera.orthographic((0, 0, 3), (0, 0, 0), height=3.0))
    found = clsurf.lines(frame, "contours", device=device)
    for width in (0.5, 1.0, 3.0):
        ink = found.draw(width=width, ink=0.5).lines
        assert abs(ink.sum() / (0.5 * width * found.lengths.sum()) - 1) < 0.05
    assert abs(found.draw((512, 512), width=2).lines.sum() / (2 * 2 * found.lengths.sum()) - 1) < 0.05
    red = found.draw(width=3, colors=(1, 0, 0), background=(0, 0, 1)).color
    assert tuple(red[128, 128]) == (0, 0, 1, 1) and red[..., 0].max() == pytest.approx(1, abs=1e-5)


def test_chains_are_walked_in_order():
    """A path given in a mess, a closed line, and what is too short or too weak."""
    rng = np.random.default_rng(0)
    angle = np.arange(20) * 2 * np.pi / 20
    ring = np.stack([30 + 5 * np.cos(angle), 30 + 5 * np.sin(angle)], axis=1)
    path = np.stack([np.arange(12.0), np.zeros(12)], axis=1)
    weak, short = path + np.array([0, 5]), path[:3] + np.array([0, 9])
    points = np.concatenate([path, ring, weak, short])
    strength = np.concatenate([np.full(12, 0.5), np.full(20, 3.0), np.full(12, 0.9), np.full(3, 2.0)])
    strength[4] = 2
    pairs = np.concatenate([np.arange(11)[:, None] + [0, 1], 12 + (np.arange(20)[:, None] + [0, 1]) % 20,
                            32 + np.arange(11)[:, None] + [0, 1], 44 + np.arange(2)[:, None] + [0, 1]])
    shuffle = rng.permutation(len(points))
    place = np.argsort(shuffle)
    pairs = place[pairs][rng.permutation(len(pairs))]
    pairs = np.where(rng.random(len(pairs))[:, None] < 0.5, pairs, pairs[:, ::-1])
    both = np.stack([*points.T, np.ones(len(points)), strength], axis=1).astype(np.float32)[shuffle]
    found = chains(both, pairs, peak=1.0, length=5)
    assert sorted(np.diff(found.offset)) == [12, 20] and sorted(found.closed) == [False, True]
    for i in range(2):
        line = found.points[found.offset[i]:found.offset[i + 1], :2]
        step = np.linalg.norm(np.diff(line, axis=0), axis=1)
        assert np.allclose(step, 1 if len(line) == 12 else 10 * np.sin(np.pi / 20), atol=1e-5)
    assert chains(both, pairs, peak=1.0, length=5, ring=20).closed.tolist() == [False]
    smooth = relaxed(found, 3)
    assert np.abs(smooth - found.points)[:, :2].max() < 0.5
    straight = smooth[found.offset[np.argmin(found.closed)]:][:12] if not found.closed[0] else smooth[20:32]
    assert np.abs(straight[:, 1]).max() < 1e-6


@pytest.mark.parametrize("kinds", ("lines", (), ("ridges", "creases"), 3, None, [["ridges"]]))
def test_unknown_kinds(device, kinds):
    with pytest.raises(InputError, match="kinds: expected some of contours"):
        clsurf.lines(exact(Torus(), TORUS_CAMERA, (16, 16)), kinds, device=device)


def test_frames_that_cannot_be_used(device):
    frame = exact(Torus(), TORUS_CAMERA, (16, 16))
    less = Frame({"depth": frame.depth, "normal": frame.normal}, camera=TORUS_CAMERA)
    with pytest.raises(InputError, match=r"none of the name derivative1, k1, direction1, mean.*line_channels"):
        clsurf.lines(less, "ridges", device=device)
    with pytest.raises(InputError, match=r"frame: expected a clsurf.Frame with its camera"):
        clsurf.lines(Frame(frame.channels), "ridges", device=device)
    with pytest.raises(InputError, match="silhouette: expected the frame's size"):
        clsurf.lines(frame, "ridges", silhouette=exact(Torus(), TORUS_CAMERA, (17, 16)), device=device)
    for option in ({"smoothing": 3}, {"smoothing": float("nan")}, {"detail": 0}, {"length": -1}, {"length": "x"},
                   {"gap": -1}, {"unit": 0}, {"unit": float("inf")}):
        with pytest.raises(InputError, match=f"{next(iter(option))}: expected a number from"):
            clsurf.lines(frame, "ridges", device=device, **option)
    found = clsurf.lines(frame, "contours", device=device)
    for option in ({"width": -1}, {"ink": 2}, {"width": (1, 2, 3)}, {"colors": (1, 2, 3)}, {"colors": "red"},
                   {"colors": {"contours": None}}):
        with pytest.raises(InputError, match=f"{next(iter(option))}: expected"):
            found.draw(**option)
    with pytest.raises(InputError, match="channel color"):
        found.draw(less)
    with pytest.raises(InputError, match="unknown format"):
        found.save("x.pdf")


def path(points, depth=1.0, strength=1.0):
    """Points (n, 4) and the pairs that join them in a row."""
    n = len(points)
    return np.stack([*np.asarray(points, float).T, np.full(n, depth), np.full(n, strength)], axis=1), \
        np.arange(n - 1)[:, None] + [0, 1]


def test_gaps_between_ends_that_point_at_each_other_are_closed():
    x = np.arange(10.0)
    straight = np.stack([x, 0 * x], axis=1)
    for shift, depth, count in (((13, 0.5), 1.0, 1), ((19, 0), 1.0, 2), ((13, 6), 1.0, 2), ((13, 0), 1.5, 2)):
        (a, p), (b, q) = path(straight), path(straight + shift, depth)
        found = chains(np.concatenate([a, b]), np.concatenate([p, q + 10]), 0, 1, gap=6, steepest=0.1)
        assert len(found.closed) == count and len(found.points) == 20
    ring = 10 * np.stack([np.cos(np.linspace(0, 6, 60)), np.sin(np.linspace(0, 6, 60))], axis=1)
    found = chains(*path(ring)[:1], path(ring)[1], 0, 1, gap=6)
    assert found.closed.tolist() == [True]


def test_a_closed_gap_makes_short_pieces_long_enough():
    x = np.arange(6.0)
    pieces = [path(np.stack([x + 8 * i, 0 * x], axis=1)) for i in range(4)]
    points = np.concatenate([p for p, _ in pieces])
    pairs = np.concatenate([q + 6 * i for i, (_, q) in enumerate(pieces)])
    assert len(chains(points, pairs, 0, 20).closed) == 0
    assert np.diff(chains(points, pairs, 0, 20, gap=4).offset).tolist() == [24]


@pytest.mark.parametrize("noise", (0.0, 0.001, 0.003))
def test_noise_makes_no_lines(device, noise):
    """The surface that lines are found on is coarser the noisier the scan; noise is over the diagonal."""
    rng = np.random.default_rng(2)
    scan = clsurf.models.sphere(12000)
    points = scan.points + rng.normal(0, noise * np.linalg.norm(np.ptp(scan.bounds, axis=0)), scan.points.shape)
    surface = clsurf.line_surface(clsurf.PointCloud(points.astype(np.float32)), device=device)
    assert surface.degree == 3 and surface.error == pytest.approx(0.03 + 10 * max(noise - 0.0003, 0), abs=0.004)
    frame = clsurf.render(surface, size=(300, 300), channels=clsurf.line_channels(ALL), device=device)
    found = clsurf.lines(frame, ALL, device=device)
    assert found.of("contours").lengths.max() > 500 and found.lengths.sum() < 1.03 * found.lengths.max()


def test_line_surface_refuses_in_one_line(device):
    for wrong in (3, clsurf.models.perfect_sphere(), clsurf.PointCloud(np.ones((50, 3)))):
        with pytest.raises(InputError, match="scan: expected"):
            clsurf.line_surface(wrong, device=device)
