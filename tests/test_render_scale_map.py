"""Scale maps in the renderer: exact spheres, orders, points on the map itself, both forms, near plane, scenes."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import scan_path
from reference import scale_map as twin
from reference.trace_rays import ray_triangles, unit

import clsurf
from clsurf import Camera, ScaleMapDrawing, Scene
from clsurf.errors import InputError
from clsurf.render.renderer import Renderer
from clsurf.render.scale_map import cells_of, upload_scale_map
from clsurf.surface.cube import border_directions, texel_directions
from clsurf.surface.geosphere import geosphere_directions
from clsurf.surface.scale_map import ScaleMap, encoded_normals
from clsurf.surface.slim import frame_of_normals

SIZE = (96, 72)
ALL = ("color", "depth", "normal", "position", "id", "count", "level", "cost")
CAST, SPHERE = ScaleMapDrawing(), ScaleMapDrawing("geosphere", 5)
OFFSET = (0.3, -0.2, 0.1)


def cameras():
    """A perspective and an orthographic view of the unit sphere."""
    eye = np.array([1.5, 1.0, 3.0])
    return Camera.look_at(eye, (0, 0, 0), (0, 1, 0), fov=40), Camera.orthographic(eye, (0, 0, 0), (0, 1, 0), height=2.6)


def points_of(frame):
    """Which pixels show something, and their world positions."""
    hit = np.isfinite(frame.depth)
    return hit, frame.position[hit].astype(float) + frame.origin


def exact_depth(camera, size, center, radius=1.0):
    """Depth of an analytic sphere, NaN outside it."""
    o, d = camera.rays(size)
    o = o - center
    b = (o * d).sum(1)
    disc = b * b - (o * o).sum(1) + radius**2
    t = np.where(disc > 0, -b - np.sqrt(np.maximum(disc, 0)), np.nan)
    return (t * -(d @ camera.rotation[2])).reshape(size[::-1])


def bumpy(d):
    return 1 + 0.2 * np.sin(3 * d[..., 0] + 1) * np.cos(2 * d[..., 1]) + 0.1 * d[..., 2] ** 3


# Exact surfaces -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", cameras())
def test_a_centred_sphere_is_a_sphere_whatever_the_texels(renderers, camera):
    """Lambda is 1 in every direction, so that even a map of 6 x 8 x 8 is the sphere itself."""
    surface = twin.smooth_map(8, bits=8).moved([[0, -2, 0, 1e6], [2, 0, 0, -1e6], [0, 0, 2, 30], [0, 0, 0, 1]])
    moved = Camera(camera.eye * 2 + (1e6, -1e6, 30), camera.rotation, fov=camera.fov,
                   **({} if camera.height is None else {"height": camera.height * 2}))
    wanted = exact_depth(moved, SIZE, (1e6, -1e6, 30), 2.0)
    for renderer in renderers:
        frame = renderer.render(surface, moved, SIZE, ALL)
        inside = np.isfinite(wanted) & np.isfinite(frame.depth)
        assert np.isfinite(frame.depth).sum() > 0.97 * np.isfinite(wanted).sum()
        assert (np.isfinite(frame.depth) <= np.isfinite(wanted)).mean() > 0.999
        core = inside & (np.nan_to_num(frame.normal[..., 2]) > -2)
        error = np.abs(frame.depth - wanted)[core]
        assert np.quantile(error, 0.97) < 5e-5 and np.quantile(error, 0.995) < 0.02
        assert (frame.count[inside] == 1).all() and (frame.level[inside] == 0).all() and (frame.id[inside] == 0).all()


@pytest.mark.parametrize("camera", cameras())
@pytest.mark.parametrize("kind", ("cast", "geosphere"))
def test_second_order_of_depth_and_normals(renderers, camera, kind):
    """An offset sphere, away from its silhouette: finer maps and geospheres."""
    errors, wanted = [], exact_depth(camera, SIZE, OFFSET)
    for k in (0, 1, 2):
        surface = twin.smooth_map((16, 32, 64)[k] if kind == "cast" else 256, OFFSET)
        frame = renderers[0].render(surface, camera, SIZE, ("depth", "normal", "position"),
                                    scale_map=ScaleMapDrawing(kind, 3 + k, "gradient"))
        hit, points = points_of(frame)
        normal = unit(points - OFFSET)
        away = -unit(points - camera.eye) if camera.height is None else camera.rotation[2]
        core = (normal * away).sum(1) > 0.35
        angle = np.linalg.norm(frame.normal[hit] - normal, axis=1)
        errors.append([np.quantile(e[core], 0.98) for e in (np.abs(frame.depth - wanted)[hit], angle)])
        assert core.sum() > 800 and (np.isfinite(wanted) == hit).mean() > 0.985
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    # Normals of a sphere's triangles are exact but for those of the map, which stays the same.
    assert (rates[:, :1 if kind == "geosphere" else 2] > 1.5).all() and errors[-1][1] < 5e-4, (errors, rates)


@pytest.mark.parametrize("camera", cameras())
def test_tile_cells(renderers, camera):
    """A rough map with holes: drawn points lie on the interpolated map, in the cell that its triangles say is seen.

    A ray that grazes a cell may meet its triangles and not the curved cell: the triangle is drawn.
    """
    rng = np.random.default_rng(5)
    surface = twin.smooth_map(7, f=lambda d: 1 + 0.05 * rng.uniform(-1, 1, d.shape[:3]))
    valid = rng.uniform(size=surface.valid.shape) > 0.1
    surface = ScaleMap(surface.center, surface.radius, surface.scales, valid)
    size, (vertices, faces) = (40, 30), twin.net_mesh(surface)
    origins, directions = camera.rays(size)
    seen = np.array([min([np.inf, *ray_triangles(vertices * surface.radius, faces, o, d)[0]])
                     for o, d in zip(origins, directions, strict=True)]).reshape(size[::-1])
    for renderer in renderers:
        frame = renderer.render(surface, camera, size, ALL)
        hit, points = points_of(frame)
        assert (hit == np.isfinite(seen)).mean() > 0.995
        both = hit & np.isfinite(seen)
        distance = np.linalg.norm(points - surface.center, axis=1)
        there = twin.filtered(surface, points - surface.center) * surface.radius
        gap = np.abs(distance - there)[np.isfinite(there)]
        # Cells with a hole are not drawn, though the map's values reach into half of them.
        assert len(gap) > 0.8 * hit.sum() and np.quantile(gap, 0.8) < 1e-4 and gap.max() < 0.1
        across = (directions @ -camera.rotation[2]).reshape(seen.shape)
        assert np.median(np.abs(frame.depth - seen * across)[both]) < 0.02
        assert np.quantile(np.abs(frame.depth - seen * across)[both], 0.95) < 0.06


def test_walls_along_the_rays_show_the_map_itself(renderers):
    """Where cells stand as steep as a wall, its triangles are seen in other cells than the map: as its own rays do."""
    surface = twin.smooth_map(24, f=lambda d: 0.5 + 0.5 * (d @ (0.7, -0.6, -0.5) > 0.1))
    camera, size = cameras()[0], (160, 120)
    hits = clsurf.trace(surface, *camera.rays(size), device=renderers[0].device)
    depth = (hits.distance * (camera.rays(size)[1] @ -camera.rotation[2])).reshape(size[::-1])
    for renderer in renderers[:2]:
        got = renderer.render(surface, camera, size, "depth").depth
        both, off = np.isfinite(depth) & np.isfinite(got), np.abs(got - depth) > 1e-3
        wall = both & (np.abs(np.linalg.norm(hits.position, axis=-1).reshape(both.shape) - 0.75) < 0.24)
        assert wall.sum() > 1500 and off[wall].mean() < 0.05 and off[both & ~wall].mean() < 0.003


@pytest.mark.parametrize("drawing", (CAST, SPHERE))
def test_forms_tiles_and_lanes_draw_the_same(device, drawing):
    surface, camera = twin.smooth_map(24, f=bumpy), cameras()[0]
    frames = []
    for lanes, tile in ((16, None), (16, 8), (8, None), (4, 64), (1, None)):
        with Renderer(device, lanes=lanes, tile=tile) as renderer:
            frames.append(renderer.render(surface, camera, SIZE, ALL, scale_map=drawing))
    for frame in frames[1:]:
        same = np.isfinite(frame.depth) == np.isfinite(frames[0].depth)
        assert same.mean() > 0.9995
        assert np.nanmax(np.abs(frame.depth - frames[0].depth)) < 1e-4
        assert np.nanquantile(np.abs(frame.normal - frames[0].normal), 0.999) < 1e-3
    again = Renderer(device, lanes=16).render(surface, camera, SIZE, ALL, scale_map=drawing)
    assert all(np.array_equal(again.channels[n], frames[0].channels[n], equal_nan=True) for n in ALL)


def test_no_gaps_along_cube_edges_and_corners(renderers):
    """Looking down on edges, corners and the icosahedron's vertices, at many sizes, every pixel of the ball is hit."""
    surface = twin.smooth_map(9, f=bumpy)
    for direction in ((1, 1, 0), (1, 1, 1), (-1, 1, -1), (0, 0, 1), (0.9, 0, 0.45)):
        camera = Camera.look_at(unit(np.array(direction, float)) * 3, (0, 0, 0), (0.1, 0.9, 0.3), fov=18)
        for drawing in (CAST, ScaleMapDrawing("geosphere", 3)):
            for renderer in renderers[:2]:
                assert np.isfinite(renderer.render(surface, camera, (72, 72), "depth", scale_map=drawing).depth).all()


# Near plane, inside, holes, layers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("drawing", (CAST, SPHERE))
def test_near_plane_opens_the_surface_and_shows_its_inside(renderers, drawing):
    camera = Camera.look_at((0, 0, 3.0), (0, 0, 0), (0, 1, 0), fov=40, near=2.5)
    surface = twin.smooth_map(32)
    for renderer in renderers:
        frame = renderer.render(surface, camera, SIZE, ALL, scale_map=drawing)
        hit, points = points_of(frame)
        middle = frame.depth[36, 48]
        assert middle == pytest.approx(4, abs=0.01) and np.nanmin(frame.depth) >= 2.5 - 1e-5
        assert np.abs(np.linalg.norm(points, axis=1) - 1).max() < 0.01
        facing = (frame.normal[hit] * unit(camera.eye - points)).sum(1)
        assert facing.min() > -1e-3 and frame.normal[36, 48] @ (0, 0, 1) > 0.99


@pytest.mark.parametrize("drawing", (CAST, SPHERE))
@pytest.mark.parametrize("camera", cameras())
def test_clip_planes_cut_the_surface(renderers, drawing, camera):
    """What is left lies on the sphere and on the kept side; where the front is cut away the inside is seen."""
    surface = twin.smooth_map(32)
    ahead = camera.rotation[2]
    for renderer in renderers:
        for plane in ((*ahead, 0.2), (*-ahead, 0.2), (1, 0, 0, -0.1)):
            frame = renderer.render(surface, camera, SIZE, ("depth", "position"), scale_map=drawing, clip=plane)
            hit, points = points_of(frame)
            assert hit.sum() > 300 and (points @ plane[:3] + plane[3]).min() > -1e-3
            assert np.quantile(np.abs(np.linalg.norm(points, axis=1) - 1), 0.99) < 0.01
            whole = np.isfinite(renderer.render(surface, camera, SIZE, "depth", scale_map=drawing).depth)
            assert (hit <= whole).mean() > 0.999
        cut = renderer.render(surface, camera, SIZE, "depth", scale_map=drawing, clip=(*-ahead, 0.2)).depth
        middle = np.linalg.norm(camera.eye)
        assert cut[36, 48] == pytest.approx(middle + 1, abs=0.01)


@pytest.mark.parametrize("drawing", (CAST, SPHERE))
def test_eye_inside_sees_the_surface_all_around(renderers, drawing):
    """The eye's plane cuts the map: triangles that cross it are drawn where they lie in front."""
    surface = twin.smooth_map(16)
    for near in (0.0, 1e-3):
        camera = Camera.look_at((0.2, 0.1, 0), (1, 0.3, 0.5), (0, 1, 0), fov=150, near=near)
        for renderer in renderers[:2]:
            frame = renderer.render(surface, camera, (48, 36), ALL, scale_map=drawing)
            hit, points = points_of(frame)
            assert hit.all() and np.abs(np.linalg.norm(points, axis=1) - 1).max() < 0.02


def test_holes_are_open(renderers):
    base = twin.smooth_map(32)
    valid = base.valid.copy()
    valid[0, 4] = False  # +Z
    surface = ScaleMap(base.center, base.radius, base.scales, valid)
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), fov=35)
    for drawing in (CAST, SPHERE):
        frame = renderers[0].render(surface, camera, SIZE, scale_map=drawing)
        assert frame.depth[36, 48] == pytest.approx(5, abs=0.01) and np.isfinite(frame.depth[36]).sum() > 50
    empty = ScaleMap(base.center, base.radius, base.scales, np.zeros_like(valid))
    assert not np.isfinite(renderers[0].render(empty, camera, SIZE).depth).any()


def test_layers_are_drawn_and_named(renderers):
    base = twin.smooth_map(16)
    scales = np.concatenate([base.scales, base.scales * np.float32(0.5)])
    valid = np.ones(scales.shape, bool)
    valid[0, :, :, :8] = False
    surface = ScaleMap(base.center, base.radius, scales, valid)
    camera = cameras()[0]
    for drawing in (CAST, SPHERE):
        frame = renderers[0].render(surface, camera, SIZE, ALL, scale_map=drawing)
        hit, points = points_of(frame)
        distance = np.linalg.norm(points, axis=1)
        assert set(np.unique(frame.level[hit])) == {0, 1}
        assert np.abs(distance - np.where(frame.level[hit] == 0, 1, 0.5)).max() < 0.01


# Normals and options --------------------------------------------------------------------------------------------------


def test_scale_normals(device):
    """Four neighbours against the twin; the gradient against the exact normals of a smooth shape, on edges too."""
    from clsurf.render.scale_map import scale_normals
    exact = []
    for size in (16, 32, 64):
        surface = twin.smooth_map(size, OFFSET)
        upload = upload_scale_map(device, surface)
        near = scale_normals(device, upload, 0, ScaleMapDrawing(normals="neighbours"))[..., :3]
        assert np.abs(near - twin.scale_normals(surface)).max() < 2e-4 * size / 16
        got = scale_normals(device, upload, 0, ScaleMapDrawing(normals="gradient"))[..., :3]
        wanted = unit(surface.positions()[0] - OFFSET)
        off, rough = (np.linalg.norm(n - wanted, axis=-1) for n in (got, near))
        exact.append((off[:, 1:-1, 1:-1].max(), off.max()))
        assert np.median(off) < 0.7 * np.median(rough)
    assert (np.log2(np.divide(exact[:-1], exact[1:])) > 1.9).all(), exact


@pytest.mark.parametrize("lanes", (16, 1))
def test_scale_normals_follow_quadratics_exactly(device, monkeypatch, lanes):
    """Of rho = 1 + g.(x, y) + a quadratic form about a texel, the fit finds g whatever the form: mixed term, edges,
    corners and holes among the texels around it."""
    from clsurf.render.scale_map import scale_normals
    monkeypatch.setattr(device, "lanes", lanes)
    surface, size = twin.smooth_map(6), 6
    upload, around = upload_scale_map(device, surface), border_directions(size)
    gx, gy, off = 0.3, -0.2, {}
    for form, terms in {"square": (1.5, 0, -2.0), "mixed": (0, 2.5, 0), "all": (-1.0, 2.0, 1.5)}.items():
        for face, row, column in ((0, 2, 3), (3, 0, 2), (4, 3, 5), (2, 0, 0), (5, 5, 0)):
            d = texel_directions(size)[face, row, column]
            u, v = frame_of_normals(d)
            along = around @ d
            x, y = around @ u / along, around @ v / along
            rho = 1 + gx * x + gy * y + terms[0] * x * x + terms[1] * x * y + terms[2] * y * y
            rho = np.where((along > 0.5) & (rho > 0), rho, -1)
            hole = (face, row, column + 1)
            wanted = unit(d - gx * u - gy * v)
            for holes in (False, True):
                rho[hole] = -1 if holes else rho[hole]
                own = replace(upload, rho=np.ascontiguousarray(rho[None], np.float32))
                got = scale_normals(device, own, 0, ScaleMapDrawing(normals="gradient"))[face, row, column, :3]
                off[form, face, row, column, holes] = np.linalg.norm(got - wanted)
    assert max(off.values()) < 1e-4, off


@pytest.mark.parametrize("lanes", (16, 1))
def test_displace_nodes(device, monkeypatch, lanes):
    """Nodes of a geosphere lie on the map, holes are no nodes, and normals are the texels' own in between."""
    monkeypatch.setattr(device, "lanes", lanes)
    base = twin.smooth_map(12, f=bumpy)
    valid = np.random.default_rng(0).uniform(size=base.valid.shape) > 0.05
    surface = ScaleMap(base.center, base.radius, base.scales, valid)
    cells = cells_of(device, upload_scale_map(device, surface), ScaleMapDrawing("geosphere", 3))
    directions = geosphere_directions(8).reshape(-1, 3)
    got = device.download(cells.positions)[:, :len(directions)].T
    wanted = twin.displace_nodes(surface, directions)
    assert (np.isnan(got) == np.isnan(wanted)).mean() > 0.999
    assert np.nanmax(np.abs(got - wanted)) < 1e-5
    nodes = device.download(cells.nodes)
    exact = np.linalg.norm(nodes[:, :3], axis=1)
    assert np.abs(exact - 1).max() < 1e-5 and (nodes[:, :3] * directions).sum(axis=1).min() > 0.3


def test_project_cells(device):
    """Where a block may touch the picture holds every pixel that its cells are drawn at, in both forms."""
    from clsurf.render.scale_map import place_scale_map, project_cells
    from clsurf.render.tiles import Scratch
    surface, size = twin.smooth_map(10, f=bumpy), (64, 48)
    upload = upload_scale_map(device, surface)
    cells = cells_of(device, upload, CAST)
    found = []
    for lanes in (16, 8, 1):
        for camera in cameras():
            view, cull = place_scale_map(upload, None, camera, size, (1, 1, 1))
            scratch = Scratch(device, lanes)
            _, touch = project_cells(device, scratch, cells, device.upload(view), cull)
            full, keys = device.download(touch.full).astype(int), device.download(touch.keys)
            points = device.download(cells.positions)[:, :6 * cells.side**2].T.reshape(6, cells.side, cells.side, 3)
            seen = (points * surface.radius - camera.eye) @ camera.rotation.T
            p = camera.projection(size)
            x = (p.fx * seen[..., 0] / (-seen[..., 2] if p.perspective else 1) + p.cx).reshape(-1)
            shown = full[:, 0] <= full[:, 2]
            assert cull and 0.3 < shown.mean() < 0.8
            assert 4 * full[shown, 0].min() <= max(x.min() - 0.5, 0) + 4
            assert 4 * full[shown, 2].max() + 4 >= min(x.max() - 0.5, size[0])
            near = np.where(keys[shown] & 0x80000000, keys[shown] ^ np.uint32(0x80000000), ~keys[shown])
            assert near.view(np.float32).min() == pytest.approx(-seen[..., 2].max(), abs=0.02)
            found.append((full[shown], shown))
    for k in (0, 1):
        for other in found[k + 2::2]:
            assert np.array_equal(found[k][1], other[1]) and np.abs(found[k][0] - other[0]).max() <= 1


def test_stored_normals_and_their_absence(renderers):
    d = texel_directions(32)
    plain = twin.smooth_map(32)
    turned = twin.smooth_map(32, normals=encoded_normals(unit(d + np.array([0.4, 0, 0]))))
    camera = Camera.look_at((0, 0, 3.0), (0, 0, 0), (0, 1, 0), fov=40)
    middle = lambda s, **o: renderers[0].render(s, camera, SIZE, scale_map=ScaleMapDrawing(**o)).normal[36, 48]  # noqa: E731
    assert middle(turned) @ unit(np.array([0.4, 0, 1])) > 0.999 > 0.99 > middle(turned) @ (0, 0, 1)
    assert middle(turned, normals="gradient") @ (0, 0, 1) > 0.999
    assert middle(turned, form="geosphere", normals="stored") @ unit(np.array([0.4, 0, 1])) > 0.995
    with pytest.raises(InputError, match="normals"):
        middle(plain, normals="stored")


@pytest.mark.parametrize("wrong", (dict(form="mesh"), dict(normals="smooth"), dict(level=-1), dict(level=10),
                                   dict(level=2.5), dict(epsilon=0), dict(epsilon="far")))
def test_bad_drawing(wrong):
    with pytest.raises(InputError, match="expected"):
        ScaleMapDrawing(**wrong)


def test_bad_scale_map_option(renderers):
    with pytest.raises(InputError, match="ScaleMapDrawing"):
        renderers[0].render(twin.smooth_map(4), None, SIZE, scale_map="cast")


# Scenes ---------------------------------------------------------------------------------------------------------------


def test_meets_other_surfaces_in_one_z_buffer(renderers):
    """A map and a SLIM sphere through each other: the nearer one at every pixel, whatever their order."""
    slim = clsurf.build_slim(clsurf.models.sphere(3000), error=0.005, device=renderers[0].device)
    move = lambda x: [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]  # noqa: E731
    camera = Camera.look_at((0, 0, 5.0), (0, 0, 0), (0, 1, 0), fov=40)
    map_, other = twin.smooth_map(32).moved(move(-0.4)), slim.moved(move(0.4))
    for renderer in renderers[:2]:
        one = renderer.render(Scene([map_, other]), camera, SIZE, ALL)
        two = renderer.render(Scene([other, map_]), camera, SIZE, ALL)
        hit = np.isfinite(one.depth)
        assert np.nanmax(np.abs(one.depth - two.depth)) < 1e-4
        assert ((one.id == 0) == (two.id == 1))[hit].mean() > 0.995
        x = np.broadcast_to(np.arange(SIZE[0]), hit.shape)
        assert (one.id[hit & (x < 44)] == 0).all() and (one.id[hit & (x > 52)] == 1).all()


def test_colours_supersampling_and_shading(renderers):
    camera, surface = cameras()[0], twin.smooth_map(16)
    red = clsurf.Shading(look="flat", color=(1, 0, 0))
    frame = renderers[0].render(surface, camera, SIZE, shading=red, supersampling=2)
    hit = np.isfinite(frame.depth)
    assert np.allclose(frame.color[36, 48], (1, 0, 0, 1), atol=1e-5) and hit.sum() > 1000
    other = twin.smooth_map(8).moved(np.diag([0.3, 0.3, 0.3, 1]))
    lit = renderers[0].render([surface, other], camera, SIZE, shading=clsurf.Shading(shadows=True))
    assert np.isfinite(lit.color).all()


def test_bunny_against_its_mesh(device):
    """The share of rays that meet the bunny once see the mesh itself, within the texels' size."""
    mesh = clsurf.load(scan_path("bunny/bunny.obj"))
    surface = clsurf.build_scale_map(mesh, bits=16, normals=True, device=device)
    camera = Camera.framing(surface, direction=(0.2, 0.4, 2))
    frame = clsurf.render(surface, camera, (120, 90), device=device)
    hits = clsurf.trace(mesh, *camera.rays((120, 90)), device=device)
    depth = (hits.distance * (camera.rays((120, 90))[1] @ -camera.rotation[2])).reshape(90, 120)
    both = np.isfinite(depth) & np.isfinite(frame.depth)
    assert both.sum() > 2500 and np.median(np.abs(frame.depth - depth)[both]) < 2e-3 * surface.radius
