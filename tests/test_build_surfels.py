"""Surfel hierarchies: their trees, radii and normal maps."""

import dataclasses
import pickle

import numpy as np
import pytest
from reference import surfels as twin
from reference.surfaces import sphere_points
from scipy.spatial import cKDTree

from clsurf import build_surfels, load, save
from clsurf.build import surfel_maps, surfel_points, surfel_tree
from clsurf.build.neighbours import nearest
from clsurf.errors import Cancelled, DeviceMemoryError, InputError
from clsurf.models import sphere, torus
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh
from clsurf.surface.surfel import decoded_normals, encoded_normals

EIGHT_BIT = 0.3  # degrees, RMS


@pytest.fixture(params=(16, 4, 1))
def form(request, device, monkeypatch):
    """The device in each kernel form."""
    monkeypatch.setattr(device, "lanes", request.param)
    return device


def uv_sphere(rows=24, columns=48, radius=1.0, center=(0, 0, 0)):
    """A closed triangulated sphere with exact normals."""
    theta, phi = np.pi * np.arange(1, rows) / rows, 2 * np.pi * np.arange(columns) / columns
    t, f = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    n = np.concatenate([np.stack([np.sin(t) * np.cos(f), np.sin(t) * np.sin(f), np.cos(t)], axis=1),
                        [[0, 0, 1], [0, 0, -1]]])
    top, bottom = (rows - 1) * columns, (rows - 1) * columns + 1
    i, j = (a.ravel() for a in np.meshgrid(np.arange(rows - 2), np.arange(columns), indexing="ij"))
    a, b = i * columns + j, i * columns + (j + 1) % columns
    j = np.arange(columns)
    last = (rows - 2) * columns
    faces = np.concatenate([np.stack([a, a + columns, b + columns], axis=1), np.stack([a, b + columns, b], axis=1),
                            np.stack([np.full(columns, top), j, (j + 1) % columns], axis=1),
                            np.stack([np.full(columns, bottom), last + (j + 1) % columns, last + j], axis=1)])
    return Mesh(radius * n + np.asarray(center), faces, n.astype(np.float32))


def two_sheets(n=40, gap=0.02):
    """Both sides of a thin plate: a grid of points with normals up, and one below it with normals down."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n)))
    above = np.stack([x, y, np.full(n * n, gap / 2)], axis=1)
    up = np.tile([0.0, 0, 1], (n * n, 1))
    return PointCloud(np.concatenate([above, above * (1, 1, -1)]), np.concatenate([up, -up]).astype(np.float32),
                      origin=np.zeros(3))


def parents(surface):
    """The parent of every surfel, -1 for the root."""
    out = np.full(len(surface), -1)
    out[surface.children] = np.repeat(np.arange(len(surface)), np.diff(surface.child_offset))
    return out


# The tree -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scan", [sphere(3000), torus(5000), two_sheets(), sphere(17), sphere(1), uv_sphere()],
                         ids=("sphere", "torus", "sheets", "few", "one", "mesh"))
def test_every_point_lies_below_the_root_once_and_in_all_spheres_and_discs_above(scan, device):
    s = build_surfels(scan, map_size=2, device=device)
    parent, base = parents(s), s.base
    assert (parent < 0).sum() == 1 and parent[0] == -1
    assert len(base) >= len(scan.points) and s.level[base].min() == s.level.max()
    p, n = s.positions.astype(np.float64), s.normals.astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-6)
    child = np.flatnonzero(parent >= 0)
    above = parent[child]
    apart = np.linalg.norm(p[child] - p[above], axis=1)
    assert (apart + s.spheres[child] <= s.spheres[above] * (1 + 1e-5)).all()
    at = base.copy()
    while True:
        at = parent[at]
        if (at < 0).all():
            break
        use = at >= 0
        d = p[base[use]] - p[at[use]]
        height = (d * n[at[use]]).sum(axis=1)
        flat = np.sqrt(np.maximum((d**2).sum(axis=1) - height**2, 0))
        tolerance = 1e-5 * np.ptp(p, axis=0).max() + 1e-6
        assert (flat + s.radii[base[use]] <= s.radii[at[use]] + tolerance).all()
        assert (np.abs(height) <= s.heights[at[use]] + tolerance).all()
        at = np.where(at < 0, 0, at) if use.all() else at


def test_the_tree_is_shallow_and_the_same_for_every_order_of_the_points(device):
    points, normals = torus(4000).points, torus(4000).normals
    order = np.random.default_rng(0).permutation(len(points))
    a = build_surfels(PointCloud(points, normals), map_size=4, device=device)
    b = build_surfels(PointCloud(points[order], normals[order]), map_size=4, device=device)
    assert len(a) == len(b) and a.level.max() <= 6
    assert len(a) - len(a.base) < len(a.base) / 6
    np.testing.assert_allclose(np.sort(a.positions, axis=0), np.sort(b.positions, axis=0), atol=1e-6)
    assert (build_surfels(PointCloud(points, normals), map_size=4, device=device).normal_atlas == a.normal_atlas).all()


def test_points_in_one_place_and_strays_are_clustered(device):
    points = np.concatenate([np.zeros((50, 3)), 10.0 ** np.arange(-6, 7)[:, None] * np.ones((1, 3))])
    cloud = PointCloud(points.astype(np.float32), np.tile([0, 0, 1], (len(points), 1)).astype(np.float32))
    s = build_surfels(cloud, map_size=1, device=device)
    assert len(s.base) == len(points) and (parents(s) < 0).sum() == 1


def test_both_sides_of_a_plate_are_apart_below_the_top(device):
    scan = two_sheets()
    tree = surfel_tree.cluster(scan.points, scan.normals, lambda done: None)
    for level in (2, 3):
        for c in np.flatnonzero(tree.level == level):
            sides = scan.normals[tree.order[tree.start[c]:tree.start[c] + tree.count[c]], 2]
            assert (sides == sides[0]).all()


# Base surfels ---------------------------------------------------------------------------------------------------------


def test_surfel_radii(device):
    points, normals = torus(500).points, torus(500).normals
    indices, _ = nearest(points, surfel_points.NEIGHBOURS, device=device)
    radii, spacings = surfel_points.surfel_radii(points, normals, device)
    wanted, wide = twin.surfel_radii(points.astype(np.float64), normals.astype(np.float64), indices, 1.5)
    np.testing.assert_allclose(radii, np.minimum(wanted, 2.5 * np.median(wanted[indices[:, 1:]], axis=1)), rtol=1e-4)
    np.testing.assert_allclose(spacings, wide, rtol=1e-4)


def test_strays_have_no_large_discs(device):
    stray = np.array([[9.0, 0, 0], [9.1, 0, 0], [0, -7, 0]], np.float32)
    points = np.concatenate([sphere(1000).points, stray])
    normals = np.concatenate([sphere(1000).normals, np.tile([1.0, 0, 0], (3, 1))]).astype(np.float32)
    radii, _ = surfel_points.surfel_radii(points, normals, device)
    assert radii[-3:].max() < 0.5 and radii[:-3].max() < 0.3 and np.median(radii) > 0.1


@pytest.mark.parametrize("spread", (0.0, 0.35))
def test_the_seen_part_of_discs_leaves_no_hole(spread, device):
    rng = np.random.default_rng(1)
    n = 50
    x, y = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n)))
    points = np.stack([x, y, 0 * x], axis=1) + rng.uniform(-spread, spread, (n * n, 3)) * (1, 1, 0)
    normals = np.tile([0, 0, 1], (n * n, 1)).astype(np.float32)
    radii, _ = surfel_points.surfel_radii(points.astype(np.float32), normals, device)
    q = rng.uniform(3, n - 4, (20000, 2))
    distance, near = cKDTree(points[:, :2]).query(q, 6)
    assert (distance < twin.CORE * radii[near]).any(axis=1).all()
    assert np.median(radii) < 1.3  # and they are not needlessly large


@pytest.mark.parametrize("lines", (False, True))
def test_scattered_points_and_scan_lines_leave_no_hole(lines, device):
    rng = np.random.default_rng(1)
    points = np.zeros((40_000, 3), np.float32)
    points[:, :2] = rng.uniform(0, 200, (40_000, 2))
    if lines:
        points[:, 1] = np.repeat(np.arange(0, 200, 2.0), 400) + rng.normal(0, 0.05, 40_000)
    radii, spacings = surfel_points.surfel_radii(points, np.tile(np.float32([0, 0, 1]), (40_000, 1)), device)
    q = rng.uniform(8, 192, (200_000, 2))
    distance, near = cKDTree(points[:, :2]).query(q, 30)
    assert (distance < twin.CORE * radii[near]).any(axis=1).all()
    assert (radii**2).mean() < 2.6 * (spacings**2).mean()


def test_large_faces_are_sampled_and_spacing_thins(device):
    box = Mesh(np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0.0]]), [[0, 1, 2], [0, 2, 3]])
    s = build_surfels(box, spacing=0.1, map_size=1, device=device)
    assert 1000 < len(s.base) < 4000 and 0.05 < s.spacing < 0.15
    np.testing.assert_allclose(s.normals[s.base], np.tile([0, 0, 1], (len(s.base), 1)), atol=1e-6)
    fine = build_surfels(sphere(20000), map_size=1, device=device)
    coarse = build_surfels(sphere(20000), spacing=0.1, map_size=1, device=device)
    assert len(coarse.base) < 3500 < len(fine.base)
    assert 0 < fine.bound < coarse.bound / 4 < 0.1**2 / 4 and coarse.bound_share == 0.999


def test_survey_coordinates_colours_and_strange_points(device):
    scan = sphere(2000)
    far = np.array([7691239.553, 532101.127, 12.0])
    points = np.concatenate([scan.points + far, [[np.nan, 0, 0]]])
    normals = np.concatenate([scan.normals, [[0, 0, 1]]]).astype(np.float32)
    colors = np.tile(np.array([200, 40, 10, 255], np.uint8), (len(points), 1))
    s = build_surfels(PointCloud(points, normals, colors), map_size=4, device=device)
    assert len(s.base) == 2000
    np.testing.assert_allclose(s.positions[s.base].mean(axis=0) + s.origin, far, atol=1e-2)
    assert (np.abs(s.colors.astype(int) - colors[0]) <= 1).all()
    covered = s.normal_atlas[:, 3] > 0
    assert (np.abs(s.color_atlas[covered].astype(int) - colors[0]) <= 1).all()


# Maps -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", (500, 4000, 128_000))
def test_normal_maps(n, device):
    """Against Algorithm 1 in float64: what is left is the code of 8 bits, and the surfels' rims."""
    s = build_surfels(sphere(n), device=device)
    inner = np.flatnonzero((s.level < s.level.max()) & (s.level >= s.level.max() - 3))
    chosen = np.random.default_rng(0).choice(inner, 6)
    errors, flips, texels = [], 0, 0
    for i in chosen:
        wanted = twin.normal_map(s, i)
        got = s.normal_atlas[s.map_offset[i]:s.map_offset[i] + s.map_size[i]**2]
        hit = np.isfinite(wanted[:, 0])
        flips += (hit != (got[:, 3] > 0)).sum()
        texels += len(got)
        both = hit & (got[:, 3] > 0)
        errors.append(twin.angles(got[both], wanted[both]))
    errors = np.concatenate(errors)
    assert np.sqrt((errors**2).mean()) < EIGHT_BIT
    assert np.quantile(errors, 0.99) < 0.5 and flips <= 0.002 * texels


def test_normal_maps_of_a_sphere_are_its_normals(device):
    s = build_surfels(sphere(128_000), device=device)
    i = np.flatnonzero(s.level == 3)
    for k in i[:20]:
        n = s.normals[k].astype(np.float64)
        places = twin.texel_places(s, k)
        got = s.normal_atlas[s.map_offset[k]:s.map_offset[k] + 256]
        flat = places - (places @ n)[:, None] * n
        inside = (got[:, 3] > 0) & ((flat**2).sum(axis=1) < 0.8)
        high = np.sqrt(1 - (flat**2).sum(axis=1, where=inside[:, None], initial=0))
        exact = flat + high[:, None] * n
        # The points stand 0.6 degrees apart.
        assert np.sqrt((twin.angles(got[inside], exact[inside]) ** 2).mean()) < 0.6


def test_kernel_forms_give_the_same_maps(form, device):
    made = build_surfels(torus(800), map_size=5, device=form)
    assert made.map_size.max() == 5
    errors, inner = [], np.flatnonzero(made.map_size > 1)
    for i in inner[:12]:
        wanted = twin.normal_map(made, i)
        got = made.normal_atlas[made.map_offset[i]:made.map_offset[i] + 25]
        both = np.isfinite(wanted[:, 0]) & (got[:, 3] > 0)
        assert (np.isfinite(wanted[:, 0]) != (got[:, 3] > 0)).sum() <= 1
        errors.append(twin.angles(got[both], wanted[both]))
    assert np.sqrt((np.concatenate(errors)**2).mean()) < EIGHT_BIT


def test_triangle_maps(form):
    mesh = uv_sphere(12, 16)
    s = build_surfels(mesh, map_size=6, hybrid=True, device=form)
    assert s.hybrid and len(s.triangles) == len(mesh.faces) and not len(s.base)
    assert sorted(map(tuple, np.sort(s.triangles, axis=1))) == sorted(map(tuple, np.sort(mesh.faces, axis=1)))
    errors, flips = [], 0
    for i in range(0, len(s), 5):
        wanted = twin.triangle_map(s, i)
        got = s.normal_atlas[s.map_offset[i]:s.map_offset[i] + 36]
        both = np.isfinite(wanted[:, 0]) & (got[:, 3] > 0)
        flips += (np.isfinite(wanted[:, 0]) != (got[:, 3] > 0)).sum()
        errors.append(twin.angles(got[both], wanted[both]))
    assert np.sqrt((np.concatenate(errors)**2).mean()) < EIGHT_BIT and flips <= 0.002 * 36 * len(s) / 5


def test_of_sheets_above_each_other_the_nearest_to_the_plane_counts(form):
    """Three squares that face the same way, the outer ones with other normals: the surfel lies in the middle one."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    vertices = np.concatenate([square + np.array([0, 0, h]) for h in (0.0, 0.1, 0.2)])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(3)])
    normals = np.repeat([[0.6, 0, 0.8], [0, 0, 1], [0, 0.6, 0.8]], 4, axis=0)
    s = build_surfels(Mesh(vertices, faces, normals.astype(np.float32)), map_size=6, hybrid=True, device=form)
    assert len(s) == 1 and abs(s.positions[0, 2] + s.origin[2] - 0.1) < 0.01
    covered = s.normal_atlas[:, 3] > 0
    assert covered.sum() > 9 and (twin.angles(s.normal_atlas[covered], np.array([0, 0, 1.0])) < 0.5).all()


@pytest.mark.parametrize("hybrid", (False, True))
def test_maps_keep_their_side_of_a_thin_sheet(hybrid, device):
    if hybrid:
        outer, inner = uv_sphere(), uv_sphere(radius=0.98)
        scan = Mesh(np.concatenate([outer.vertices, inner.vertices]),
                    np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)]),
                    np.concatenate([outer.normals, -inner.normals]))
    else:
        scan = two_sheets()
    s = build_surfels(scan, map_size=8, hybrid=hybrid, device=device)
    for i in np.flatnonzero((s.map_size > 1) & (s.level > 2)):
        texels = s.normal_atlas[s.map_offset[i]:s.map_offset[i] + 64]
        assert (decoded_normals(texels[texels[:, 3] > 0]) @ s.normals[i] > 0).all()


def test_lines_past_the_rim_of_an_open_surface_are_not_covered(device):
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 41)))
    s = build_surfels(PointCloud(np.stack([x, y, 0 * x], axis=1), np.tile([0, 0, 1], (len(x), 1)).astype(np.float32),
                                 origin=np.zeros(3)), device=device)
    places, got = twin.texel_places(s, 0), s.normal_atlas[:256, 3] > 0
    reach = np.abs(places[:, :2]).max(axis=1)
    assert got[reach < 1].all() and not got[reach > 1 + 0.05 * 1.5].any()


def test_codes_of_normals_round_trip():
    normals = sphere_points(5000)[1]
    errors = np.degrees(np.arccos(np.clip((decoded_normals(encoded_normals(normals)) * normals).sum(axis=1), -1, 1)))
    assert np.sqrt((errors**2).mean()) < 0.2 and errors.max() < 0.45


# Input and output -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hybrid", (False, True))
def test_stored_and_pickled_surfaces_are_the_same(hybrid, device, tmp_path):
    mesh = uv_sphere(8, 12)
    colors = np.random.default_rng(0).integers(0, 256, (len(mesh.vertices), 4)).astype(np.uint8)
    s = build_surfels(Mesh(mesh.vertices, mesh.faces, mesh.normals, colors), map_size=3, hybrid=hybrid, device=device)
    save(s, tmp_path / "a.clsurf")
    for other in (load(tmp_path / "a.clsurf"), pickle.loads(pickle.dumps(s))):
        for name, value in vars(s).items():
            np.testing.assert_array_equal(getattr(other, name), value)
            assert value is None or getattr(other, name) is not None
    assert "inner surfels" in repr(s) and s.nbytes > 0
    np.testing.assert_allclose(s.moved(2 * np.eye(4) + np.diag([0, 0, 0, -1])).bounds, 2 * s.bounds)


@pytest.mark.parametrize(("options", "message"), [
    (dict(map_size=0), "map_size: expected"), (dict(map_size=65), "map_size: expected"),
    (dict(map_size=1.5), "map_size: expected"), (dict(spacing=-1), "spacing: expected"),
    (dict(spacing="a"), "spacing: expected"), (dict(hybrid=True), "hybrid: expected a mesh"),
    (dict(spacing=1e-9), "spacing: expected"),
])
def test_wrong_options_are_refused(options, message, device):
    with pytest.raises(InputError, match=message):
        build_surfels(sphere(100), device=device, **options)


def test_what_cannot_be_built_is_refused(device):
    with pytest.raises(InputError, match="at least one point"):
        build_surfels(PointCloud(np.zeros((0, 3), np.float32)), device=device)
    with pytest.raises(InputError, match="expected a Mesh"):
        build_surfels([1], device=device)
    with pytest.raises(DeviceMemoryError, match="memory_limit"):
        build_surfels(sphere(1000), memory_limit="100kB", device=device)
    with pytest.raises(InputError, match="spacing: expected without hybrid"):
        build_surfels(uv_sphere(6, 6), hybrid=True, spacing=1.0, device=device)
    flat = Mesh(np.zeros((3, 3), np.float32), [[0, 1, 2]])
    with pytest.raises(InputError, match="face with an area"):
        build_surfels(flat, hybrid=True, device=device)


def test_progress_is_told_and_may_stop(device):
    told = []
    build_surfels(sphere(2000), map_size=2, progress=lambda stage, done: told.append((stage, done)), device=device)
    assert [stage for stage, _ in told] == sorted((stage for stage, _ in told), key=["points", "clusters",
                                                                                     "maps"].index)
    assert told[-1] == ("maps", 1.0)
    with pytest.raises(Cancelled):
        build_surfels(sphere(2000), progress=lambda stage, done: stage != "maps", device=device)


@pytest.mark.parametrize("hybrid", [False, True])
def test_lists_and_maps_larger_than_a_buffer(device, largest_buffer, monkeypatch, hybrid):
    """Neighbours and normal maps are made in parts, to the same bytes."""
    scan = uv_sphere() if hybrid else torus(20_000)
    wanted = build_surfels(scan, map_size=8, hybrid=hybrid, device=device)
    largest_buffer(37 * len(wanted.triangles if hybrid else scan.points))
    assert wanted.normal_atlas.nbytes > device.largest_buffer_bytes
    monkeypatch.setattr(surfel_maps, "LAUNCHES", 1)  # where the buffer does not ask for more
    got = build_surfels(scan, map_size=8, hybrid=hybrid, device=device)
    for name in ("positions", "radii", "normals", "normal_atlas", "children"):
        np.testing.assert_array_equal(getattr(got, name), getattr(wanted, name))


@pytest.mark.parametrize("hybrid", [False, True])
@pytest.mark.parametrize("colored", [False, True])
def test_maps_walked_in_parts(device, monkeypatch, hybrid, colored):
    """A driver that ends long loops walks below one surfel after the other: the sums differ by rounding."""
    scan = uv_sphere() if hybrid else torus(3000)
    if hybrid:  # two layers, the second one turned a little: of their triangles the nearest counts
        bumps = 1 + 0.1 * np.sin(7 * scan.vertices).sum(axis=1, keepdims=True)
        scan = Mesh(np.concatenate([0.9 * scan.vertices * bumps, scan.vertices]).astype(np.float32),
                    np.concatenate([scan.faces, scan.faces + len(scan.vertices)]))
    if colored:
        colors = np.random.default_rng(2).integers(0, 256, (len(scan.vertices if hybrid else scan.points), 4), np.uint8)
        scan = dataclasses.replace(scan, colors=colors)
    monkeypatch.setattr(device, "lanes", 1)
    wanted = build_surfels(scan, map_size=6, hybrid=hybrid, device=device)
    walked, roots_of = [], surfel_maps.roots_of
    monkeypatch.setattr(surfel_maps, "roots_of", lambda *a: walked.append(roots_of(*a)) or walked[-1])
    if device.loop_turns is None:
        monkeypatch.setattr(device, "loop_turns", 65535)
    monkeypatch.setattr(surfel_maps, "NODE_TURNS", device.loop_turns // 400)
    got = build_surfels(scan, map_size=6, hybrid=hybrid, device=device)
    heavy, roots = walked[0]
    assert 4 < len(roots) < 100 and 4 < heavy < (wanted.map_size > 1).sum()
    for name in ("normal_atlas", "color_atlas") if colored else ("normal_atlas",):
        apart = np.abs(getattr(got, name).astype(int) - getattr(wanted, name))
        assert apart.max() <= 1 and (apart > 0).mean() < 0.01
