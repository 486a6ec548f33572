"""SLIM surfaces as a whole: exactness, orders of approximation, coverage, hierarchy, repeatability, bad input."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsurf.build.point_tree import build_point_tree
from clsurf.build.project import project
from clsurf.build.radius import Noise
from clsurf.build.slim import Points, assemble, build_levels, build_slim, face_normals
from clsurf.errors import Cancelled, InputError
from clsurf.io import load
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh
from clsurf.surface.slim import SlimSurface
from tests.conftest import scan_path
from tests.reference import build as twin
from tests.reference.scans import cloud_of, ellipsoid, torus


def silent(stage, done):
    pass


def fixed_radius_surface(points, normals, degree, spacings, device):
    """Leaves whose radius is `spacings` mean point spacings (an area per point of spacing^2)."""
    points, normals = points.astype(np.float32), normals.astype(np.float32)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    tree = build_point_tree(points, normals, np.zeros(3, np.float32), 1 / diagonal, device)
    near = cKDTree(points).query(points[::97], 13)[0][:, 12]
    radius = spacings * float(np.median(near)) / np.sqrt(12.5 / np.pi)
    levels = build_levels(tree, degree, 1e-9, Noise(0.0, 0.01), silent, fixed_radius=radius / diagonal)
    return assemble(levels, Points(points, normals, None, None), tree, degree, 0.01, diagonal, np.zeros(3))


GRAPHS = {1: lambda x, y: 0.2 * x - 0.3 * y + 0.1, 2: lambda x, y: 0.5 * x * x - 0.3 * x * y + 0.2 * y * y + 0.1 * x,
          3: lambda x, y: 0.5 * (x**3 - 3 * x * y * y)}  # plane, paraboloid, monkey saddle


@pytest.mark.parametrize("degree", (1, 2, 3))
def test_reproduces_its_polynomials(device, degree):
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 4000))
    points = np.stack([x, y, GRAPHS[degree](x, y)], axis=1)
    normals = np.tile([0.0, 0, 1], (len(x), 1))  # a polynomial over a tilted plane is none any more
    surface = build_slim(PointCloud(points, normals=normals), degree=degree, device=device)
    assert surface.fit_error.max() < 8e-7 * surface.diagonal
    near = project(surface, points, device=device)
    assert np.abs(near.distance).max() < 8e-7 * surface.diagonal
    assert len(surface) < 1000


@pytest.mark.parametrize("degree", (1, 2, 3))
@pytest.mark.parametrize("shape", (torus, ellipsoid))
def test_orders_of_approximation(device, shape, degree):
    counts = {1: (2000, 8000, 32000), 2: (2000, 8000, 32000), 3: (1500, 6000, 24000)}[degree]
    position, normal = [], []
    for count in counts:
        points, normals = shape(count)
        surface = fixed_radius_surface(points, normals, degree, {1: 3.0, 2: 4.0, 3: 5.0}[degree], device)
        exact, exact_normal = shape(3000, seed=1)
        near = project(surface, exact, device=device)
        position.append(np.sqrt((near.distance**2).mean()))
        normal.append(np.sqrt((((near.normal - exact_normal) ** 2).sum(axis=1)).mean()))
    order = lambda error: np.log2(error[0] / error[-1]) / (len(counts) - 1)  # noqa: E731  (the spacing halves)
    assert order(position) > degree + 1 - 0.25, position
    assert order(normal) > degree - 0.25, normal


def overlap_of(surface, points):
    """o(p) over the leaves, float64."""
    leaves = np.flatnonzero(surface.leaf)
    reach = twin.ALPHA * surface.radii[leaves].astype(float)
    centers = surface.centers[leaves].astype(float)
    lists = cKDTree(points).query_ball_point(centers, reach)
    leaf = np.repeat(np.arange(len(leaves)), [len(found) for found in lists])
    point = np.concatenate([np.asarray(found, int) for found in lists])
    d2 = ((points[point] - centers[leaf]) ** 2).sum(axis=1)
    return np.bincount(point, twin.weight(d2, reach[leaf]), minlength=len(points))


def check_hierarchy(surface):
    """Levels ascend, every surfel is reachable, children are of the next level with centres in their parent's ball."""
    assert (np.diff(surface.level) >= 0).all()
    counts = np.diff(surface.child_offset)
    assert (counts[surface.leaf] == 0).all() and (counts[~surface.leaf] > 0).all()
    parent = np.repeat(np.arange(len(surface)), counts)
    child = surface.children
    assert (surface.level[child] == surface.level[parent] + 1).all()
    distance = np.linalg.norm(surface.centers[child].astype(float) - surface.centers[parent], axis=1)
    assert (distance <= surface.radii[parent] + 3e-7 * surface.diagonal).all()
    assert (surface.level[surface.roots] == 1).all()


@pytest.mark.parametrize("degree", (1, 2, 3))
def test_covers_every_point(device, degree):
    scan = cloud_of(torus, 20000)
    surface = build_slim(scan, degree=degree, device=device)
    assert overlap_of(surface, scan.points.astype(float)).min() >= 0.1
    check_hierarchy(surface)
    assert np.abs(np.linalg.norm(surface.normals, axis=1) - 1).max() < 1e-6
    assert np.isfinite(surface.coefficients).all() and (surface.radii > 0).all()


def test_covers_two_sheets(device):
    top, normal = torus(8000)
    points, normals = np.concatenate([top, top - 0.15 * normal]), np.concatenate([normal, -normal])
    surface = build_slim(PointCloud(points, normals=normals), device=device)
    near = project(surface, points, device=device)
    assert np.sqrt((near.distance**2).mean()) < 1e-3
    assert (np.einsum("ij,ij->i", near.normal, normals) > 0.5).mean() > 0.98


def test_thin_and_sparse(device):
    """Two sheets of opposite normals, closer than a few point spacings: neither pulls the other's leaves."""
    top, normal = torus(1500)
    points, normals = np.concatenate([top, top - 0.06 * normal]), np.concatenate([normal, -normal])
    surface = build_slim(PointCloud(points, normals=normals), device=device)
    away = np.abs(np.hypot(np.hypot(*surface.centers[:, :2].T + surface.origin[:2, None]) - 1,
                           surface.centers[:, 2] + surface.origin[2]) - 0.4)
    assert ((away < 1e-5) | (np.abs(away - 0.06) < 1e-5)).all()
    near = project(surface, points, device=device)
    assert np.sqrt((near.distance**2).mean()) < 5e-3
    assert (np.einsum("ij,ij->i", near.normal, normals) > 0.7).mean() > 0.97


def test_same_input_same_bytes(device):
    scan = cloud_of(torus, 8000)
    first, second = (build_slim(scan, degree=3, device=device) for _ in range(2))
    for name in ("centers", "radii", "normals", "coefficients", "level", "leaf", "child_offset", "children",
                 "fit_error", "footprint"):
        a, b = getattr(first, name), getattr(second, name)
        assert (a is None and b is None) or a.tobytes() == b.tobytes(), name
    assert first.bound == second.bound


@pytest.mark.parametrize("scale", (1000.0, 1e-6, 1024.0))
def test_scaled_input_same_tree(device, scale):
    points, normals = ellipsoid(10000)
    plain = build_slim(PointCloud(points, normals=normals), device=device)
    scaled = build_slim(PointCloud(points * scale, normals=normals), device=device)
    if scale == 1024:
        assert len(plain) == len(scaled) and (plain.children == scaled.children).all()
        np.testing.assert_allclose(scaled.centers, plain.centers * np.float32(scale), rtol=1e-5)
    assert len(scaled) == pytest.approx(len(plain), rel=0.01)
    assert scaled.leaf.sum() == pytest.approx(plain.leaf.sum(), rel=0.01)
    assert scaled.bound == pytest.approx(plain.bound * scale, rel=0.05)


def test_order_of_points_does_not_matter(device):
    points, normals = ellipsoid(10000)
    order = np.random.default_rng(0).permutation(len(points))
    plain = build_slim(PointCloud(points, normals=normals), device=device)
    shuffled = build_slim(PointCloud(points[order], normals=normals[order]), device=device)
    assert plain.coefficients.tobytes() == shuffled.coefficients.tobytes()


def test_bound_holds(device):
    scan = cloud_of(torus, 20000)
    surface = build_slim(scan, error=0.03, device=device)
    distance = np.abs(project(surface, scan.points.astype(float) + scan.origin, device=device).distance)
    assert surface.bound_share == 0.999
    assert (distance <= surface.bound * 1.001).mean() >= surface.bound_share - 1e-4
    assert surface.bound < 0.01 * surface.diagonal


def test_smaller_error_finer_surface(device):
    scan = cloud_of(torus, 20000)
    sizes = [int(build_slim(scan, error=error, device=device).leaf.sum()) for error in (0.1, 0.03, 0.01)]
    assert sizes[0] < sizes[1] < sizes[2]


def test_automatic_error_follows_spacing(device):
    errors = [build_slim(cloud_of(torus, count), error="auto", device=device).error for count in (5000, 20000)]
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)


def test_world_far_from_zero(device):
    points, normals = torus(5000)
    far = np.array([7_691_239.553, -4e6, 1e9])
    surface = build_slim(PointCloud(points + far, normals=normals), device=device)
    near = project(surface, points + far, device=device)
    assert np.sqrt((near.distance**2).mean()) < 1e-3
    np.testing.assert_allclose(near.position - far, points, atol=0.01)


def test_moved_surface_projects(device):
    points, normals = torus(5000)
    surface = build_slim(PointCloud(points, normals=normals), device=device)
    c, s = np.cos(0.3), np.sin(0.3)
    matrix = np.array([[2 * c, -2 * s, 0, 5], [2 * s, 2 * c, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]])
    queries = points[::50] + 0.02 * normals[::50]
    here = project(surface, queries, device=device)
    there = project(surface.moved(matrix), queries @ matrix[:3, :3].T + matrix[:3, 3], device=device)
    np.testing.assert_allclose(there.position, here.position @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-4)
    np.testing.assert_allclose(there.distance, 2 * here.distance, atol=1e-5)
    np.testing.assert_allclose(there.normal, here.normal @ matrix[:3, :3].T / 2, atol=1e-4)


def test_projects_far_points(device):
    surface = build_slim(cloud_of(ellipsoid, 8000), device=device)
    near = project(surface, [[0, 0, 50.0], [30.0, 0, 0], [0, -1e4, 0]], device=device)
    np.testing.assert_allclose(near.position, [[0, 0, 0.8], [1, 0, 0], [0, -0.7, 0]], atol=0.06)
    np.testing.assert_allclose(near.distance, [49.2, 29, 1e4 - 0.7], rtol=1e-3)
    mixed = project(surface, np.concatenate([np.full((7, 3), 4e6), [[0, 0, 0.9]]]), device=device)  # one packet
    np.testing.assert_allclose(mixed.distance[:7], 4e6 * np.sqrt(3), rtol=1e-5)
    assert np.isfinite(mixed.position).all()
    assert project(surface, np.zeros((0, 3)), device=device).position.shape == (0, 3)


def test_strays_do_not_bridge(device):
    points, normals = ellipsoid(8000)
    strays = np.array([[1.3, 0, 0], [0, 1.1, 0], [0, 1.1, 0.01], [0, 1.11, 0], [-1.4, 0.2, 0.1], [-1.5, 0.1, 0]])
    scan = PointCloud(np.concatenate([points, strays]), normals=np.concatenate([normals, np.tile([0.0, 0, 1], (6, 1))]))
    surface = build_slim(scan, device=device)
    outside = np.linalg.norm((surface.centers + surface.origin) / (1, 0.7, 0.8), axis=1) > 1.2
    assert outside[surface.leaf].any()
    assert surface.radii[surface.leaf & outside].max() < 0.2  # the gap is 0.3 to 0.5
    near = project(surface, points, device=device)
    assert np.abs(near.distance).max() < 0.01


@pytest.mark.parametrize("bad", ([[0, 0]], [[np.nan, 0, 0]], [1.0, 2, 3]))
def test_project_refuses(device, bad):
    surface = build_slim(cloud_of(ellipsoid, 500), device=device)
    with pytest.raises(InputError, match="points: expected"):
        project(surface, bad, device=device)


def test_mesh_without_normals(device):
    x, y = np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40), indexing="ij")
    index = np.arange(1600).reshape(40, 40)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    vertices = np.concatenate([np.stack([x.ravel(), y.ravel(), 0.1 * x.ravel() ** 2], axis=1), [[0.5, 0.5, 3]]])
    surface = build_slim(Mesh(vertices, faces), device=device)  # the last vertex is of no face: no normal
    assert (surface.normals[:, 2] > 0.9).all() and surface.bounds[1, 2] < 0.5


def test_cloud_without_normals(device):
    points, normals = ellipsoid(4000)
    surface = build_slim(PointCloud(points), device=device)
    near = project(surface, points, device=device)
    assert np.sqrt((near.distance**2).mean()) < 2e-3
    assert abs(np.sign(np.einsum("ij,ij->i", near.normal, normals)).sum()) > 0.98 * len(points)


def test_colors_are_averaged_in_linear_light(device):
    points, normals = ellipsoid(8000)
    colors = np.zeros((len(points), 4), np.uint8)
    colors[:, 0] = np.where(points[:, 0] > 0, 255, 0)
    colors[:, 1], colors[:, 3] = np.where(np.arange(len(points)) % 2, 255, 0), 255
    surface = build_slim(PointCloud(points, normals=normals, colors=colors), device=device)
    away = np.abs(surface.centers[:, 0] + surface.origin[0]) > surface.radii
    right = surface.centers[away, 0] + surface.origin[0] > 0
    assert (surface.colors[away, 0] == np.where(right, 255, 0)).all()
    assert abs(np.median(surface.colors[:, 1].astype(int)) - 188) < 12  # half the light is sRGB 188
    assert (surface.colors[:, 3] == 255).all()


def test_texture_gives_colors(device):
    points, normals = ellipsoid(3000)
    texture = np.zeros((2, 2, 4), np.uint8)
    texture[..., 3], texture[0, :, 2] = 255, 255  # the top row is blue
    uv = np.stack([np.full(len(points), 0.5), np.where(points[:, 2] > 0, 0.75, 0.25)], axis=1)
    surface = build_slim(Mesh(points, normals=normals, uv=uv, texture=texture), device=device)
    away = np.abs(surface.centers[:, 2] + surface.origin[2]) > surface.radii
    up = surface.centers[away, 2] + surface.origin[2] > 0
    assert (surface.colors[away, 2] == np.where(up, 255, 0)).all()


def test_weights(device):
    points, normals = ellipsoid(6000)
    scan = PointCloud(points, normals=normals)
    plain = build_slim(scan, device=device)
    even = build_slim(scan, weight=np.full(len(points), 2.0), device=device)
    np.testing.assert_allclose(even.coefficients, plain.coefficients, atol=2e-3)
    lifted = points * np.where(np.arange(len(points)) % 2, 1.05, 1.0)[:, None]
    trusted = build_slim(PointCloud(lifted, normals=normals), weight=(np.arange(len(points)) % 2 == 0), device=device)
    assert np.sqrt((project(trusted, points[::2], device=device).distance ** 2).mean()) < 2e-3
    leaning = build_slim(PointCloud(lifted, normals=normals), error=0.1, device=device,
                         weight=np.where(np.arange(len(points)) % 2, 0.01, 1.0))
    assert np.median(np.abs(project(leaning, points[::2], device=device).distance)) < 0.005
    with pytest.raises(InputError, match="weight: expected 6000 numbers"):
        build_slim(scan, weight=[1.0, 2.0], device=device)


def test_seams_have_whole_normals():
    """A cube whose faces share no vertices: normals at its corners are those of the closed cube."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    split = np.arange(24).reshape(6, 4)
    points = np.concatenate([corners[quads].reshape(-1, 3), [[0, 0, 0]]]).astype(np.float32)
    normals = face_normals(points, np.concatenate([split[:, :3], split[:, [0, 2, 3]]]))
    for corner in corners:
        here = (points[:24] == corner).all(axis=1)
        assert (normals[:24][here] == normals[:24][here][0]).all()
        assert (np.sign(normals[:24][here][0]) == np.sign(corner - 0.5)).all()
    assert (normals[24] == 0).all()  # of no face


def test_progress_rises_and_cancels(device):
    scan, seen = cloud_of(torus, 5000), []
    build_slim(scan, device=device, progress=lambda *step: seen.append(step))
    assert [stage for stage, done in seen if done == 1] == ["points", "levels", "bound"]
    for stage in {stage for stage, _ in seen}:
        done = [d for s, d in seen if s == stage]
        assert done == sorted(done) and 0 <= done[0] and done[-1] == 1
    for stop_at in range(len(seen)):
        steps = iter(range(len(seen)))
        with pytest.raises(Cancelled):
            build_slim(scan, device=device, progress=lambda *_, s=stop_at, n=steps: next(n) < s)

    def fail(stage, done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_slim(scan, device=device, progress=fail)


def test_bunny(device):
    scan = load(scan_path("bunny/bunny.obj"))
    surface = build_slim(scan, device=device)
    assert 5500 < surface.leaf.sum() < 7000
    assert isinstance(surface, SlimSurface)
    assert overlap_of(surface, scan.points.astype(float)).min() >= 0.1
    check_hierarchy(surface)
    distance = project(surface, scan.points.astype(float) + scan.origin, device=device).distance
    assert np.sqrt((distance**2).mean()) < 1.4e-4 * surface.diagonal
    cubic = build_slim(scan, degree=3, device=device)
    assert 0.6 < cubic.leaf.sum() / surface.leaf.sum() < 0.8
