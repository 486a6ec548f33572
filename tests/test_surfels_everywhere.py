"""Surfel hierarchies answer rays, projection, curvature and errors; and the hybrid form is drawn."""

import numpy as np
import pytest
from reference import surfels as twin
from test_build_surfels import two_sheets, uv_sphere

from clsurf import build_surfels, curvature, error, project, trace
from clsurf.build.triangles import nearest_triangles
from clsurf.models import sphere, torus
from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh
from clsurf.surface.surfel import SurfelHierarchy, encoded_normals


@pytest.fixture(scope="module")
def ball(device):
    return build_surfels(sphere(8000), map_size=4, device=device)


@pytest.fixture(scope="module")
def ring(device):
    return build_surfels(torus(2000), map_size=4, device=device)


@pytest.fixture(scope="module")
def hybrid(device):
    return build_surfels(uv_sphere(), map_size=8, hybrid=True, device=device)


@pytest.fixture(params=(16, 4, 1))
def form(request, device, monkeypatch):
    monkeypatch.setattr(device, "lanes", request.param)
    from clsurf.trace import pieces
    pieces._kept.__dict__.clear()  # surfaces on the device know their kernel form
    yield device
    pieces._kept.__dict__.clear()


def random_rays(n, seed=0, reach=3.0):
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(n, 3))
    origins *= reach / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-1, 1, (n, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


# Rays -----------------------------------------------------------------------------------------------------------------


def test_ray_surfels(form, ring):
    origins, directions = random_rays(600)
    wanted, normal, number = twin.ray_surfels(ring, origins, directions)
    hits = trace(ring, origins, directions, device=form)
    assert (np.isfinite(wanted) == hits.hit).mean() > 0.995
    both = np.isfinite(wanted) & hits.hit
    assert both.sum() > 200
    assert (np.abs(hits.distance[both] - wanted[both]) < 1e-4).mean() > 0.99
    assert ((hits.normal * normal)[both].sum(axis=1) > 0.9999).mean() > 0.99
    assert (hits.primitive[both] == number[both]).mean() > 0.99
    near = trace(ring, origins, directions, "any", device=form)
    assert (near.hit == hits.hit).all()


def plates(apart, radius, facing=(-1, 1), aside=0.0):
    """Two base surfels, at zero and `apart` below and `aside` of it; `facing` 1: their fronts are seen from above."""
    one, flat, normals = np.ones(2, np.int32), np.zeros(2, np.float32), np.array([[0, 0, f] for f in facing])
    positions, radii = np.array([[0, 0, 0], [aside, 0, -apart]]), np.full(2, radius)
    atlas = np.pad(encoded_normals(normals), ((0, 0), (0, 1)), constant_values=255)
    return SurfelHierarchy(positions, normals, radii, radii, flat, flat, one, np.zeros(3), np.zeros(0), np.arange(2),
                           one, atlas)


def seen_from_above(surface, x, device):
    """Depth and normal's z seen from (x, 0, 4): perspective, orthographic, and by a ray."""
    eye, at = np.array([x, 0, 4.0]), np.array([x, 0, 0.0])
    for camera in (Camera.look_at(eye, at, (0, 1, 0), 20), Camera.orthographic(eye, at, (0, 1, 0), 1.0)):
        with Renderer(device, lanes=device.lanes) as renderer:
            frame = renderer.render(surface, camera, (9, 9), ("depth", "normal"))
        yield frame.depth[4, 4], frame.normal[4, 4, 2]
    hit = trace(surface, eye, (0, 0, -1), device=device)
    yield (hit.distance, hit.normal[2]) if hit.hit else (np.nan, np.nan)


@pytest.mark.parametrize("radius", (1.0, 0.5))
def test_discs_seen_from_behind_are_set_back(form, radius):
    """By a quarter of their radius, and no more: what faces the eye less far behind them is seen in their place."""
    for part, wanted in ((0.2, 4 + 0.2 * radius), (0.3, 4.0)):
        for depth, z in seen_from_above(plates(part * radius, radius), 0.0, form):
            assert depth == pytest.approx(wanted, abs=1e-5) and z > 0.99


@pytest.mark.parametrize(("x", "facing", "wanted"), [(0.8, (1, -1), 4.0), (0.9, (1, -1), 4.0), (0.9, (1, 1), 5.0),
                                                     (0.9, (-1, -1), 5.0), (0.8, (-1, -1), 4.0)])
def test_no_inside_is_seen_past_the_inner_part_of_a_disc(form, x, facing, wanted):
    """The inner 0.85 of a disc hide all; the rest blends, and hides discs that are seen from behind."""
    discs = plates(1.0, 1.0, facing, 0.5)
    for depth, z in seen_from_above(discs, x, form):
        assert depth == pytest.approx(wanted, abs=1e-5) and z > 0.99
    for query in ("closest", "any"):  # what decides lies past the ray's end
        assert trace(discs, (x, 0, 4), (0, 0, -1), query, far=4.5, device=form).hit == (wanted < 4.5)


def test_a_sheet_drawn_before_does_not_hide_what_a_gap_shows(form):
    """The sheet lies between the disc that covers the gap and the disc seen from behind that the gap would show."""
    gap, sheet = plates(10.0, 1.0, (1, -1), 0.5), plates(0.1, 3.0, (1, 1)).moved(np.diag([1.0, 1, 1, 1]) - [
        [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 5], [0, 0, 0, 0]])
    for first, second in ((sheet, gap), (gap, sheet)):
        for depth, _ in seen_from_above([first, second], 0.9, form):
            assert depth == pytest.approx(4.0, abs=1e-5)
        assert trace([first, second], (0.9, 0, 4), (0, 0, -1), "any", far=4.5, device=form).hit


@pytest.mark.parametrize("query", ("closest", "all"))
def test_a_rays_end_cuts_off_hits_alone(form, ring, query):
    """Wherever rays end, their hits before that are those of endless ones: no disc behind the end shows in a hit."""
    origins, directions = random_rays(200)
    every = trace(ring, origins, directions, query, device=form)
    ray = np.arange(200) if query == "closest" else np.repeat(np.arange(200), np.diff(every.offsets))
    ray, distance = ray[np.isfinite(every.distance)], every.distance[np.isfinite(every.distance)]
    for past in (-0.1, -0.01, -1e-4, 1e-4, 0.01, 0.1):
        far = distance + past  # one ray for each hit
        ended = trace(ring, origins[ray], directions[ray], query, far=far, device=form)
        number = np.arange(len(ray)) if query == "closest" else np.repeat(np.arange(len(ray)), np.diff(ended.offsets))
        of, wanted = np.nonzero((ray[:, None] == ray) & (distance <= far[:, None]))
        assert len(of) > 0 or (past < 0 and query == "closest")
        np.testing.assert_array_equal(number[np.isfinite(ended.distance)], of)
        np.testing.assert_allclose(ended.distance[np.isfinite(ended.distance)], distance[wanted], atol=1e-6)


def test_rays_on_a_sphere(form, ball):
    origins, directions = random_rays(3000)
    b = (origins * directions).sum(axis=1)
    root = b * b - (origins**2).sum(axis=1) + 1
    hits = trace(ball, origins, directions, device=form)
    assert hits.hit[root > 0.02].all() and not hits.hit[root < -0.05].any()
    deep = root > 0.05
    assert np.abs(hits.distance - (-b - np.sqrt(np.maximum(root, 0))))[deep].max() < 0.01
    exact = (hits.position * hits.normal).sum(axis=1) / np.linalg.norm(hits.position, axis=1)
    assert exact[deep].min() > np.cos(np.radians(3))
    every = trace(ball, origins, directions, "all", device=form)
    assert (np.diff(every.offsets)[root > 0.1] == 2).mean() > 0.99
    assert not trace(ball, origins, directions, far=0.5, device=form).hit.any()
    moved = ball.moved(np.array([[0, -2, 0, 7], [2, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1.0]]))
    other = trace(moved, (2 * origins) @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] + (7, 0, 0),
                  directions @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], device=form)
    np.testing.assert_allclose(other.distance[deep], 2 * hits.distance[deep], atol=1e-3)


def test_rays_agree_with_the_picture(device, ball):
    camera, size = Camera.look_at((0.4, 0.5, 3), (0, 0, 0), (0, 1, 0), 40), (60, 50)
    with Renderer(device) as renderer:
        frame = renderer.render(ball, camera, size, ("position", "normal"), lod=0.0)
    hits = trace(ball, *camera.rays(size), device=device)
    drawn = np.isfinite(frame.position[..., 0])
    assert (drawn == hits.hit.reshape(drawn.shape)).mean() > 0.995
    both = drawn & hits.hit.reshape(drawn.shape)
    position, normal = (a.reshape(*both.shape, 3)[both] for a in (hits.position, hits.normal))
    assert np.quantile(np.linalg.norm(frame.position[both] - position, axis=1), 0.99) < 2e-3
    assert np.quantile((frame.normal[both] * normal).sum(axis=1), 0.01) > np.cos(np.radians(1))


def test_rays_of_the_hybrid_form_hit_its_mesh(device, hybrid):
    origins, directions = random_rays(500)
    hits, wanted = (trace(thing, origins, directions, device=device) for thing in (hybrid, uv_sphere()))
    np.testing.assert_allclose(hits.distance, wanted.distance, atol=1e-6)


# Projection, curvature, error -----------------------------------------------------------------------------------------


def test_projection_onto_a_sphere_is_of_second_order(device):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(4000, 3))
    x *= rng.uniform(0.9, 1.15, (4000, 1)) / np.linalg.norm(x, axis=1, keepdims=True)
    wanted, errors = np.linalg.norm(x, axis=1) - 1, []
    for n in (2000, 8000, 32000):
        near = project(build_surfels(sphere(n), map_size=1, device=device), x, device=device)
        errors.append(np.sqrt(np.mean((near.distance - wanted) ** 2)))
        cosine = (near.normal * x).sum(axis=1) / np.linalg.norm(x, axis=1)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 120 / np.sqrt(n)
        np.testing.assert_allclose(np.linalg.norm(x - near.position, axis=1), np.abs(near.distance), atol=1e-9)
    assert errors[0] < 2e-3 and errors[0] / errors[1] > 2.8 and errors[1] / errors[2] > 2.8  # h^2: 4


def test_projection_keeps_to_its_side_and_stops_at_rims(device):
    sheets = build_surfels(two_sheets(), map_size=1, device=device)
    near = project(sheets, [[0.1, 0.2, 0.5], [0.1, 0.2, -0.5], [0.3, 0.1, 0.012], [5.0, 0, 0.01]], device=device)
    np.testing.assert_allclose(near.position[:3, 2], [0.01, -0.01, 0.01], atol=1e-6)
    np.testing.assert_allclose(near.distance[:3], [0.49, 0.49, 0.002], atol=1e-6)
    np.testing.assert_allclose(near.normal[:, 2], [1, -1, 1, 1], atol=1e-6)
    assert 1 <= near.position[3, 0] < 1.06


def test_projection_onto_the_hybrid_form(device, hybrid):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(300, 3))
    corners = hybrid.vertices[hybrid.triangles].astype(np.float64)
    near = project(hybrid, x, device=device)
    from clsurf.build.triangles import barycentric_foot
    for i in range(0, 300, 10):
        foot, _ = barycentric_foot(np.tile(x[i], (len(corners), 1)), corners)
        apart = np.linalg.norm(foot - x[i], axis=1).min()
        np.testing.assert_allclose(abs(near.distance[i]), apart, atol=1e-6)
    assert (np.sign(near.distance) == np.sign(np.linalg.norm(x, axis=1) - 0.995)).mean() > 0.97
    # The foot is the nearest place of a triangle: no place of a fine raster is nearer.
    i, j = (t.ravel() for t in np.meshgrid(np.arange(21), np.arange(21), indexing="ij"))
    raster = np.stack([i, j, 20 - i - j], axis=1)[i + j <= 20] / 20
    for q in x[:20]:
        foot, _ = barycentric_foot(q[None], corners[:1])
        best = np.linalg.norm(raster @ corners[0] - q, axis=1).min()
        assert np.linalg.norm(foot - q) <= best + 1e-12


def test_nearest_triangles_are_named(device):
    mesh = uv_sphere(8, 10)
    middles = mesh.vertices[mesh.faces].astype(np.float64).mean(axis=1)
    distance, face = nearest_triangles(mesh.vertices, mesh.faces, 1.01 * middles, device)
    assert (face == np.arange(len(mesh.faces))).all() and distance.max() < 0.02


def test_curvature_and_error(device, ball, hybrid):
    assert abs(np.median(curvature(ball, device=device).mean) - 1) < 0.01
    assert abs(np.median(curvature(hybrid, device=device).mean) - 1) < 0.05
    found = error(ball, sphere(500), device=device)
    assert found.rms < 2e-3 and abs(found.mean) < 1e-3
    other = error(ball, uv_sphere(), both=True, samples=2000, device=device)
    assert other.backward.max < 0.02


# The hybrid form in pictures ------------------------------------------------------------------------------------------


def test_the_finest_level_of_the_hybrid_form_is_its_mesh(device, renderers, hybrid):
    mesh = Mesh(hybrid.vertices, hybrid.triangles, hybrid.vertex_normals)
    camera = Camera.look_at((0.4, 0.5, 3), (0, 0, 0), (0, 1, 0), 40)
    for renderer in renderers:
        one, other = (renderer.render(thing, camera, (120, 90), ("depth", "normal", "id"), lod=0.0)
                      for thing in (hybrid, mesh))
        np.testing.assert_allclose(one.depth, other.depth, atol=1e-5)
        np.testing.assert_allclose(one.normal, other.normal, atol=1e-4)


def test_triangles_and_surfels_meet_without_holes(device, renderers, hybrid):
    camera = Camera.look_at((0.2, 0.3, 2.0), (0, 0, 0), (0, 1, 0), 60)
    size = (100, 100)
    for renderer in renderers:
        fine = renderer.render(hybrid, camera, size, ("depth", "normal"), lod=0.0)
        for lod in (6.0, 16.0, 40.0):
            frame = renderer.render(hybrid, camera, size, ("depth", "normal", "level"), lod=lod)
            hit, wanted = np.isfinite(frame.depth), np.isfinite(fine.depth)
            assert hit[wanted].all()
            both = hit & wanted
            turned = np.degrees(np.arccos(np.clip((frame.normal * fine.normal)[both].sum(axis=-1), -1, 1)))
            assert turned.mean() < 2.5


def test_colours_of_the_hybrid_form(device, renderers):
    mesh = uv_sphere()
    colors = np.tile(np.array([10, 200, 30, 255], np.uint8), (len(mesh.vertices), 1))
    s = build_surfels(Mesh(mesh.vertices, mesh.faces, mesh.normals, colors), map_size=8, hybrid=True, device=device)
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 50)
    from clsurf.render.shade import Shading
    for renderer in renderers:
        for lod in (0.0, 16.0):
            frame = renderer.render(s, camera, (50, 50), ("color", "depth"), Shading("flat"), lod=lod)
            seen = frame.color[np.isfinite(frame.depth)][:, :3]
            assert np.abs(seen - seen[0]).max() < 0.01 and seen[0, 1] > 10 * seen[0, 0]


def test_points_with_texture_free_normals_are_estimated(device):
    s = build_surfels(PointCloud(sphere(2000).points), map_size=2, device=device)
    assert ((s.normals[s.base] * s.positions[s.base]).sum(axis=1) > 0.9).mean() > 0.99
