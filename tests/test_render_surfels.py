"""Surfel hierarchies in the renderer: against their twins, against analytic surfaces, and against themselves."""

import dataclasses

import numpy as np
import pytest
from reference import surfels as twin
from reference.surfaces import fitted, torus_points

from clsurf import SurfelDrawing, build_surfels
from clsurf.errors import InputError
from clsurf.models import disc, sphere, torus
from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Light, Shading
from clsurf.render.surfels import place_surfels, select_surfels, upload_surfels
from clsurf.render.tiles import Scratch
from clsurf.surface.cloud import PointCloud
from clsurf.surface.surfel import SurfelHierarchy

ALL = ("color", "depth", "normal", "position", "id", "count", "level", "cost")
LANES = (16, 8, 4, 1)


@pytest.fixture(scope="module")
def ball(device):
    return build_surfels(sphere(3000), map_size=8, device=device)


@pytest.fixture(scope="module")
def ring(device):
    return build_surfels(torus(1500), map_size=8, device=device)


def cameras(surface):
    yield Camera.framing(surface, direction=(0.4, 0.5, 1), fov=40)
    yield Camera.orthographic((3, 1, 2), (0, 0, 0), (0, 1, 0), 3.0)
    yield Camera.look_at((1.2, 0.3, 0.4), (0, 0, 0), (0, 1, 0), 70)  # near: some of it lies beside and behind the eye


def angles(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))


# Twins ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lanes", LANES)
def test_select_surfels(lanes, device, ring):
    upload, scratch, states = upload_surfels(device, ring), Scratch(device, lanes), set()
    for camera in cameras(ring):
        for lod, interior in ((4.0, 16.0), (3.0, 40.0), (0.0, 0.0), (30.0, 60.0)):
            size = (90, 70)
            floats = place_surfels(upload, None, camera, size, lod)
            for relief in (0.75, 3.0, np.inf):
                state = select_surfels(device, scratch, upload, device.upload(floats), interior, relief).copy()
                wanted = twin.select_surfels(ring, twin.View(ring, camera, size), lod, interior, relief)
                assert (state != wanted).sum() <= 2  # float32 at a threshold
                states |= set(state.tolist())
    assert states == {0, 1, 2}


@pytest.mark.parametrize("lanes", LANES)
def test_base_surfels_beside_inner_ones_are_found(lanes, device):
    """Children of both kinds, of two roots of which one is a base surfel: all base surfels are drawn at lod 0."""
    n, level, offset = 7, (1, 1, 2, 2, 2, 3, 3), (0, 3, 3, 5, 5, 5, 5, 5)
    up, one = np.tile((0.0, 0, 1), (n, 1)), np.ones(n)
    surface = SurfelHierarchy(np.arange(3 * n).reshape(n, 3) / 99, up, one, 3 * one, 0 * one, 0 * one, level, offset,
                              (2, 3, 4, 5, 6), np.arange(n), one, np.tile((128, 128, 255, 255), (n, 1)))
    camera, upload = Camera.look_at((0, 0, 9), (0, 0, 0)), upload_surfels(device, surface)
    view = device.upload(place_surfels(upload, None, camera, (9, 9), 0.0))
    state = select_surfels(device, Scratch(device, lanes), upload, view, 0.0, 0.75)
    wanted = twin.select_surfels(surface, twin.View(surface, camera, (9, 9)), 0.0, 0.0)
    assert state.tolist() == wanted.tolist() == [1, 2, 1, 2, 2, 2, 2]


@pytest.mark.parametrize("lanes", LANES)
def test_plain_cosines(lanes, device, ring, monkeypatch):
    """Of sound maps, of sizes that lanes do not divide, and of maps with a texel that is not covered or turned away."""
    monkeypatch.setattr(device, "lanes", lanes)
    odd = build_surfels(sphere(400), map_size=5, device=device)
    for surface in (ring, odd):
        inner = np.flatnonzero(surface.map_size > 1)
        atlas = surface.normal_atlas.copy()
        for k, texel in enumerate(np.random.default_rng(0).integers(0, surface.map_size[0] ** 2, 9)):
            at = surface.map_offset[inner[-1 - k]] + texel  # of the corners, none matters
            atlas[at] = (*atlas[at, :3], 0) if k % 2 else (*(255 - atlas[at, :3]), 255)
        surface = dataclasses.replace(surface, normal_atlas=atlas)
        got = device.download(upload_surfels(device, surface).surfels)[inner, 11]
        wanted = np.array([twin.plain_cosine(surface, s) for s in inner])
        np.testing.assert_allclose(got, wanted, atol=2e-4)
        assert 4 < (got == 2).sum() < len(got) - 20


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("maps", (True, False))
def test_tile_surfels(number, maps, device, ring, renderers):
    camera, size = list(cameras(ring))[number], (44, 35)
    for lod, interior in ((5.0, 20.0), (0.0, 16.0)):
        view = twin.View(ring, camera, size)
        state = twin.select_surfels(ring, view, lod, interior if lod else 0.0)
        depth, normal, count, nearest = twin.tile_surfels(ring, view, np.flatnonzero(state == 2), maps)
        for renderer in renderers:
            frame = renderer.render(ring, camera, size, ALL, lod=lod, surfels=SurfelDrawing(interior, maps))
            hit, got = np.isfinite(depth), np.isfinite(frame.depth.ravel())
            assert (hit != got).mean() < 0.004
            both = hit & got
            close = np.abs(frame.depth.ravel() - depth)[both] < 1e-3
            assert close.mean() > 0.99
            turned = angles(frame.normal.reshape(-1, 3)[both], normal[both])
            assert (turned < 0.2).mean() > 0.985
            assert (frame.count.ravel() == count)[both].mean() > 0.985
            assert (frame.level.ravel()[both] == ring.level[nearest[both]]).mean() > 0.99


# Analytic surfaces ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lod", (0.0, 4.0))
def test_a_sphere_is_drawn_where_it_is(lod, device, ball, renderers):
    camera = Camera.look_at((0.5, 0.7, 4), (0, 0, 0), (0, 1, 0), 35)
    size = (200, 160)
    _, directions = camera.rays(size)
    eye, d = camera.eye, directions.reshape(-1, 3)
    b, c = d @ eye, eye @ eye - 1
    disc_ = b * b - c
    with np.errstate(invalid="ignore"):
        t = -b - np.sqrt(disc_)
    exact = (eye + t[:, None] * d).reshape(size[1], size[0], 3)
    inside = (disc_ > 0).reshape(size[1], size[0])
    deep = (disc_ > 0.06).reshape(size[1], size[0])  # over a pixel inside
    far = (disc_ < -0.15).reshape(size[1], size[0])
    for renderer in renderers:
        frame = renderer.render(ball, camera, size, ("depth", "normal", "position"), lod=lod)
        hit = np.isfinite(frame.depth)
        assert hit[deep].all() and not hit[far].any()
        both = hit & inside & deep
        assert np.linalg.norm((frame.position - exact)[both], axis=1).max() < 0.03
        turned = angles(frame.normal[both], exact[both])
        assert turned.mean() < 1.2 and np.quantile(turned, 0.99) < 4.5
        assert ((frame.normal * directions.reshape(frame.normal.shape)).sum(axis=2)[hit] < 1e-3).all()


@pytest.mark.parametrize("lod", (0.0, 4.0, 30.0))
def test_inside_of_a_sphere_has_no_hole(lod, ball, renderers):
    for eye in ((0, 0, 0), (0.3, 0.8, 0.4), (0.1, 0.2, 0.9)):
        camera = Camera.look_at(eye, (-1, 0.2, 0.3), (0, 1, 0), 90)
        for renderer in renderers:
            frame = renderer.render(ball, camera, (96, 80), ("depth", "normal", "position"), lod=lod)
            assert np.isfinite(frame.depth).all()
            p = frame.position / np.linalg.norm(frame.position, axis=2, keepdims=True)
            assert np.median(angles(-frame.normal, p)) < 3


def test_maps_halve_the_error_of_normals(device):
    rough = torus(60_000)
    a = 0.04 * np.sin(25 * rough.points).sum(axis=1)
    surface = build_surfels(PointCloud(rough.points + a[:, None] * rough.normals), device=device)
    camera = Camera.framing(surface.bounds, direction=(0.2, 0.3, 1), fov=35, margin=1.6)
    with Renderer(device) as renderer:
        fine = renderer.render(surface, camera, (300, 300), ("normal",), lod=0.0).normal
        errors = []
        for maps in (True, False):
            frame = renderer.render(surface, camera, (300, 300), ("normal", "level"), surfels=SurfelDrawing(16.0, maps))
            turned = angles(frame.normal, fine)
            errors.append(turned[np.isfinite(turned)].mean())
            assert (frame.level[frame.level > 0] < surface.level.max()).mean() > 0.8
    assert errors[0] < 0.5 * errors[1]


# Invariance -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", range(3))
def test_forms_and_tile_sizes_agree(number, device, ring):
    camera, frames = list(cameras(ring))[number], []
    for lanes, tile in ((16, None), (16, 8), (16, 64), (8, None), (4, None), (1, None)):
        with Renderer(device, lanes=lanes, tile=tile) as renderer:
            frames.append(renderer.render(ring, camera, (90, 70), ALL))
    for frame in frames[1:]:
        one, exact = frames[0], frame is frames[1] or frame is frames[2]
        for name in ALL[:-1]:
            a, b = getattr(one, name), getattr(frame, name)
            same = (a == b) | (a != a) & (b != b) if exact else np.isclose(a, b, atol=2e-3, equal_nan=True)
            assert same.mean() > (1 - 1e-9 if exact else 0.998), name


def test_frames_are_the_same_each_time_and_for_a_placed_surface(device, ring):
    camera, size = next(cameras(ring)), (90, 70)
    turn = np.array([[0, -2, 0, 5], [2, 0, 0, -3], [0, 0, 2, 1e5], [0, 0, 0, 1.0]])
    moved = Camera.look_at(*((turn @ [*p, w])[:3] for p, w in ((camera.eye, 1), (camera.eye - camera.rotation[2], 1))),
                           (turn @ [*camera.rotation[1], 0])[:3], 40)
    with Renderer(device) as renderer:
        a, b = (renderer.render(ring, camera, size, ALL) for _ in range(2))
        c = renderer.render(ring.moved(turn), moved, size, ALL)
    for name in ALL:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    both = np.isfinite(a.depth) & np.isfinite(c.depth)
    assert both.sum() > 0.99 * np.isfinite(a.depth).sum()
    np.testing.assert_allclose(np.median(c.depth[both] / a.depth[both]), 2, rtol=1e-5)
    assert (angles(a.normal @ turn[:3, :3].T / 2, c.normal)[both] < 0.5).mean() > 0.99


def test_surfaces_of_all_kinds_meet_in_one_z_buffer(device, renderers):
    slim = fitted(*torus_points(3000), 0.2, 2)
    flat = build_surfels(disc(4000, 2.0), device=device)
    camera = Camera.look_at((0, 3, 4), (0, 0, 0), (0, 1, 0), 40)
    for renderer in renderers:
        for scene in ([slim, flat], [flat, slim]):
            number = scene.index(flat)
            frame = renderer.render(scene, camera, (100, 80), ("id", "depth", "position", "mean", "count"))
            both = frame.id >= 0
            assert set(np.unique(frame.id[both])) == {0, 1}
            inside = np.isfinite(frame.depth) & (frame.id != number)
            assert (frame.position[inside][:, 2] > -0.02).all()  # the plate hides what lies below it
            assert np.isnan(frame.mean[frame.id == number]).all() and np.isfinite(frame.mean[frame.id != number]).any()
        assert renderer.render(Scene([]), camera, (9, 9), ("depth",)).depth.shape == (9, 9)


def test_supersampling_averages_the_finer_picture(ball, renderers):
    """Twice as many samples are the picture of twice the size, level of detail and all, in light: edges apart."""
    camera = Camera.look_at((0.5, 0.7, 4), (0, 0, 0), (0, 1, 0), 35)
    for renderer in renderers:
        fine = renderer.render(ball, camera, (80, 72), ("color", "depth", "normal"), Shading("normal"), lod=0.0)
        both = renderer.render(ball, camera, (40, 36), ("color", "depth", "normal"), Shading("normal"), lod=0.0,
                               supersampling=2)
        plain = renderer.render(ball, camera, (40, 36), ("color",), Shading("normal"), lod=0.0)
        blocks = fine.color.reshape(36, 2, 40, 2, 4)
        mean = blocks.mean(axis=(1, 3))
        np.testing.assert_allclose(both.color, mean, atol=2e-3)
        seen = np.isfinite(fine.depth).reshape(36, 2, 40, 2)
        edge = seen.any(axis=(1, 3)) & ~seen.all(axis=(1, 3))
        assert edge.sum() > 20 and np.abs(plain.color - mean)[edge].max() > 0.1
        assert (np.isfinite(both.depth) == seen.any(axis=(1, 3))).mean() > 0.97


def test_a_closed_surface_keeps_its_outline_at_every_level(device):
    """Discs that stand beside what lies below them are trimmed: coarse levels draw what the finest draws."""
    surface = build_surfels(sphere(40_000), device=device)
    camera = Camera.look_at((0.5, 0.7, 4), (0, 0, 0), (0, 1, 0), 35)
    with Renderer(device) as renderer:
        fine, coarse = (np.isfinite(renderer.render(surface, camera, (300, 300), ("depth",), lod=lod,
                                                    surfels=SurfelDrawing(24.0)).depth) for lod in (0.0, 6.0))
    outline = np.count_nonzero(fine[1:] != fine[:-1]) + np.count_nonzero(fine[:, 1:] != fine[:, :-1])
    assert np.count_nonzero(coarse != fine) < 0.05 * outline


# Options and input ----------------------------------------------------------------------------------------------------


def test_colours_come_from_points_and_colour_maps(device, renderers):
    scan = sphere(6000)
    colors = np.full((6000, 4), 255, np.uint8)
    colors[:, :3] = np.where(scan.points[:, :1] > 0, (255, 0, 0), (0, 0, 255))
    surface = build_surfels(PointCloud(scan.points, scan.normals, colors), device=device)
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 35)
    for renderer in renderers:
        for lod in (0.0, 20.0):
            frame = renderer.render(surface, camera, (120, 120), ("color", "position", "level"), Shading("flat"), lod,
                                    surfels=SurfelDrawing(20.0))
            assert ((frame.level < surface.level.max()).mean() > 0.8) == (lod > 0)
            side = frame.position[..., 0]
            assert (np.abs(frame.color[side > 0.05][:, :3] - (1, 0, 0)).max(axis=1) < 0.01).mean() > 0.98
            assert (np.abs(frame.color[side < -0.05][:, :3] - (0, 0, 1)).max(axis=1) < 0.01).mean() > 0.98
        plain = renderer.render(surface, camera, (60, 60), ("color",),
                                Shading("flat", color=(0, 1, 0), model_colors=False)).color
        assert set(map(tuple, plain.reshape(-1, 4).round(3))) == {(1, 1, 1, 1), (0, 1, 0, 1)}
        for look in ("ball_size", "ball_level"):
            assert len(np.unique(renderer.render(surface, camera, (60, 60), ("color",), look, lod=10.0).color)) > 3


def test_what_lies_outside_the_picture_is_not_drawn_and_changes_nothing(device, ring):
    with Renderer(device) as renderer:
        whole = renderer.render(ring, Camera.orthographic((0, 0, 5), (0, 0, 0), (0, 1, 0), 3.2), (128, 128), ALL[:3])
        near = Camera.orthographic((0.8, 0.4, 5), (0.8, 0.4, 0), (0, 1, 0), 0.8)
        part = renderer.render(ring, near, (32, 32), ALL[:3])
        away = renderer.render(ring, Camera.look_at((0, 0, 5), (0, 0, 9), (0, 1, 0), 40), (32, 32), ALL)
    x, y = int(64 + 0.8 / 3.2 * 128) - 16, int(64 - 0.4 / 3.2 * 128) - 16
    same = np.isclose(whole.depth[y:y + 32, x:x + 32], part.depth, atol=1e-5, equal_nan=True)
    assert same.mean() > 0.99
    assert not np.isfinite(away.depth).any() and (away.id == -1).all()


def test_strange_surfels_and_empty_hierarchies(device, ring):
    radii, positions = ring.radii.copy(), ring.positions.copy()
    radii[5], positions[7] = np.nan, np.inf
    broken = dataclasses.replace(ring, radii=radii, positions=positions)
    empty = build_surfels(sphere(1), device=device)
    camera = next(cameras(ring))
    with Renderer(device) as renderer:
        frame = renderer.render(broken, camera, (60, 60), ALL)
        assert np.isfinite(frame.depth).sum() > 500 and np.isfinite(frame.color).all()
        assert np.isfinite(renderer.render(empty, None, (20, 20), ("depth",)).depth).any()


def test_shadows_fall_on_and_from_surfels(device, renderers):
    flat = build_surfels(disc(6000, 2.0), device=device)
    small = build_surfels(sphere(3000), map_size=8, device=device)
    placed = small.moved(np.array([[0.4, 0, 0, 0], [0, 0.4, 0, 0], [0, 0, 0.4, 1.0], [0, 0, 0, 1]]))
    scene = Scene([flat, placed], [Light("directional", (0, 0, 1))])
    camera = Camera.look_at((0, -4, 3), (0, 0, 0), (0, 1, 0), 45)
    for renderer in renderers[:2]:
        lit, dark = (renderer.render(scene, camera, (120, 100), ("color", "id", "position"),
                                     Shading(shadows=shadows, specular=0)) for shadows in (False, True))
        on, reach = lit.id == 0, np.linalg.norm(lit.position[..., :2], axis=2)
        with np.errstate(invalid="ignore"):
            inner, outer = on & (reach < 0.35), on & (reach > 0.48)
        assert inner.sum() > 50
        assert (dark.color[inner][:, 0] < 0.3 * lit.color[inner][:, 0]).mean() > 0.98
        assert (np.abs(dark.color - lit.color)[outer].max(axis=1) < 1e-3).mean() > 0.98


@pytest.mark.parametrize("options", [dict(interior=-1), dict(interior=np.nan), dict(interior="a"), dict(maps=1),
                                     dict(relief=-1), dict(relief=np.nan), dict(relief="a")])
def test_wrong_options_are_refused(options):
    with pytest.raises(InputError, match="surfels"):
        SurfelDrawing(**options)


def test_something_else_is_refused(device, ring):
    with Renderer(device) as renderer, pytest.raises(InputError, match="SurfelDrawing"):
        renderer.render(ring, surfels=3)
