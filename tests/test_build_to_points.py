"""Points of surfaces: on them, no two too near, no place without one near by."""

import numpy as np
import pytest
import trimesh
from conftest import scan_path
from scipy.spatial import cKDTree
from test_build_streamed import ground, write_las
from test_build_surfels import uv_sphere

import clsurf
from clsurf.analysis.error import surface_samples
from clsurf.build import sparse_grid, streamed, to_points
from clsurf.build.to_points import spread_out
from clsurf.errors import Cancelled, InputError
from clsurf.io.stored_leaves import BYTES

FAR = np.array([7_691_239.553, 637_291.25, 851.5])


@pytest.fixture(scope="module")
def surfaces(device):
    """One of every kind."""
    ball, mesh = clsurf.models.sphere(5000), uv_sphere(24, 48)
    return {"sphere": clsurf.build_slim(ball, device=device),
            "torus": clsurf.build_slim(clsurf.models.torus(8000), device=device),
            "disc": clsurf.build_slim(clsurf.models.disc(5000), device=device),
            "surfels": clsurf.build_surfels(ball, map_size=4, device=device),
            "hybrid": clsurf.build_surfels(mesh, hybrid=True, map_size=4, device=device),
            "patches": clsurf.models.perfect_sphere(),
            "scale map": clsurf.build_scale_map(mesh, size=16, bits=16, device=device), "mesh": mesh}


KINDS = ["sphere", "torus", "disc", "surfels", "hybrid", "patches", "scale map", "mesh"]


def world(cloud):
    return cloud.points.astype(np.float64) + cloud.origin


def gaps(points):
    """Return the distance (n,) from each point to the next."""
    return cKDTree(points).query(points, k=2)[0][:, 1]


@pytest.mark.parametrize("spacing", [0.1, 0.04])
@pytest.mark.parametrize("name", KINDS)
def test_points_are_spread_evenly_on_the_surface(name, spacing, surfaces, device):
    """`spacing` is over half the width of each."""
    surface = surfaces[name]
    spacing *= np.ptp(surface.bounds, axis=0).max() / 2
    cloud = clsurf.to_points(surface, spacing, device=device)
    points = world(cloud)
    assert gaps(points).min() > spacing * (1 - 1e-5), "no two nearer than the spacing"
    away = cKDTree(points).query(surface_samples(surface, 20_000, device))[0]
    assert away.max() < 2 * spacing and np.percentile(away, 99) < 1.1 * spacing, "no place without a point near by"
    near = clsurf.project(surface, points, device)
    # Onto scale maps to second order, and onto blended discs to a tenth of a tenth, what is on them moves again.
    assert np.abs(near.distance).max() < spacing * {"scale map": 1e-2, "surfels": 5e-2}.get(name, 1e-4)
    assert np.allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    # On edges of triangles a rounding decides which face's normal it is.
    assert np.median(np.einsum("ij,ij->i", near.normal, cloud.normals)) > 0.999


def test_how_many_there_are(surfaces, device):
    """About 0.63 a square of the spacing everywhere: 2.5 times more with a spacing 1.58 times finer."""
    for spacing in (0.1, 0.05):
        count = len(clsurf.to_points(surfaces["sphere"], spacing, device=device).points)
        assert 0.58 < count * spacing**2 / (4 * np.pi) < 0.7


def test_open_surfaces_end_where_they_are_drawn_to_end(surfaces, device):
    points = world(clsurf.to_points(surfaces["disc"], 0.05, device=device))
    down = clsurf.trace(surfaces["disc"], points + np.array([0, 0, 1.0]), (0, 0, -1.0), device=device)
    assert down.hit.mean() > 0.999 and np.abs(points[:, 2]).max() < 1e-6


def test_both_sides_of_a_thin_wall_have_points(device):
    sheet = clsurf.models.disc(4000)
    points = np.concatenate([sheet.points + np.array([0, 0, z]) for z in (0, 0.03)])
    wall = clsurf.build_slim(clsurf.PointCloud(points, np.concatenate([-sheet.normals, sheet.normals])), error=1e-4,
                             device=device)
    cloud = clsurf.to_points(wall, 0.1, device=device)
    up = cloud.normals[:, 2] > 0
    for side in (up, ~up):
        assert side.sum() * 0.1**2 / np.pi > 0.5 and gaps(world(cloud)[side]).min() > 0.1 * (1 - 1e-5)


def test_placed_and_far_ones(surfaces, device):
    plain = clsurf.to_points(surfaces["torus"], 0.1, device=device)
    matrix = np.diag([3.0, 3, 3, 1]) @ trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    matrix[:3, 3] = FAR
    moved = clsurf.to_points(surfaces["torus"].moved(matrix), 0.3, device=device)
    assert np.abs(world(moved) - (world(plain) @ matrix[:3, :3].T + FAR)).max() < 1e-5
    assert np.abs(moved.normals - plain.normals @ matrix[:3, :3].T / 3).max() < 1e-5
    scan = clsurf.models.torus(8000)
    there = clsurf.build_slim(clsurf.PointCloud(scan.points, scan.normals, origin=FAR), device=device)
    cloud = clsurf.to_points(there, 0.1, device=device)
    off = np.hypot(np.hypot(*(world(cloud) - FAR)[:, :2].T) - 1, (world(cloud) - FAR)[:, 2]) - 0.4
    assert np.abs(off).max() < 5e-4 and gaps(world(cloud)).min() > 0.0999


def test_the_same_points_each_time_and_even_across_chunks(surfaces, device, monkeypatch):
    one, again = (clsurf.to_points(surfaces["torus"], 0.1, device=device) for _ in range(2))
    assert np.array_equal(one.points, again.points) and np.array_equal(one.normals, again.normals)
    monkeypatch.setattr(sparse_grid, "CHUNK", 2000)
    monkeypatch.setattr(to_points, "CHUNK", 2000)
    points = world(clsurf.to_points(surfaces["torus"], 0.1, device=device))
    assert gaps(points).min() > 0.1 * (1 - 1e-5)
    assert cKDTree(points).query(surface_samples(surfaces["torus"], 20_000, device))[0].max() < 0.2


def test_colors_are_those_of_the_place(device):
    scan = clsurf.models.sphere(5000)
    colors = np.full((5000, 4), 255, np.uint8)
    colors[:, :3] = np.where(scan.points[:, :1] > 0, (200, 40, 10), (10, 60, 220))
    mesh = uv_sphere(24, 48)
    painted = np.full((len(mesh.vertices), 4), 255, np.uint8)
    painted[:, :3] = np.where(mesh.vertices[:, :1] > 0, (200, 40, 10), (10, 60, 220))
    for surface in (clsurf.build_slim(clsurf.PointCloud(scan.points, scan.normals, colors), error=0.001, device=device),
                    clsurf.Mesh(mesh.vertices, mesh.faces, colors=painted)):
        cloud = clsurf.to_points(surface, 0.1, device=device)
        side = world(cloud)[:, 0]
        clear = np.abs(side) > 0.3
        assert np.abs(cloud.colors[clear, :3] - np.where(side[clear, None] > 0, (200, 40, 10),
                                                         (10, 60, 220))).max() <= 3


def test_surfaces_in_their_store(device, tmp_path, monkeypatch):
    write_las(tmp_path / "hills.las", *ground(20_000))
    monkeypatch.setattr(streamed, "sizes_of", lambda limit: streamed.Sizes(10_000, 4_000, 3_000))
    place = clsurf.build_slim(tmp_path / "hills.las", error=0.003, out=tmp_path / "a.clsurf", device=device).place
    stored = clsurf.open_surface(place, budget=BYTES * len(clsurf.open_surface(place)) * 6 // 10)
    one, other = (clsurf.to_points(surface, 2.0, device=device) for surface in (stored, stored.load()))
    assert len(one.points) == pytest.approx(len(other.points), rel=0.02) and one.colors is not None
    assert gaps(world(one)).min() > 1.99
    assert np.abs(clsurf.project(stored, world(one), device).distance).max() < 0.01


@pytest.mark.parametrize("sided", [False, True])
def test_spread_out(sided):
    rng = np.random.default_rng(3)
    places = rng.uniform(size=(5000, 3)) * (1, 1, 0.02)
    sides = np.where(rng.uniform(size=(5000, 1)) < 0.5, 1.0, -1.0) * (0, 0, 1.0 if sided else 0.0)
    taken = np.array([[0.5, 0.5, 0.0], [0.52, 0.5, 0.0]])
    chosen = spread_out(places, sides, 0.05, taken, np.tile((0, 0, 1.0 if sided else 0.0), (2, 1)))
    assert len(np.unique(chosen)) == len(chosen) > 200
    for side in ((1, -1) if sided else (0,)):
        mine = chosen[sides[chosen, 2] == side]
        before = taken if side >= 0 else taken[:0]
        assert gaps(places[mine]).min() >= 0.05
        tree = cKDTree(np.concatenate([places[mine], before]))
        assert len(before) == 0 or cKDTree(before).query(places[mine])[0].min() >= 0.05
        assert tree.query(places[sides[:, 2] == side])[0].max() < 0.05, "no more can be added"
    assert len(spread_out(places[:0], sides[:0], 0.05, taken, np.zeros((2, 3)))) == 0


@pytest.mark.parametrize(("make", "says"), [
    (lambda s: clsurf.to_points(s, 0), "spacing: expected a length"), (lambda s: clsurf.to_points(s, "x"), "spacing"),
    (lambda s: clsurf.to_points(s, 1e-6), "spacing: expected at least"),
    (lambda s: clsurf.to_points(clsurf.models.sphere(10)), "build_slim"),
    (lambda s: clsurf.to_points(None), "expected a SlimSurface"),
    (lambda s: clsurf.to_points(clsurf.Mesh(np.zeros((3, 3), np.float32))), "face")])
def test_what_has_no_points_is_said_in_one_line(make, says, surfaces):
    with pytest.raises(InputError, match=says) as caught:
        make(surfaces["sphere"])
    assert "\n" not in str(caught.value)


def test_progress_and_its_end(surfaces, device):
    seen = []
    clsurf.to_points(surfaces["sphere"], 0.1, lambda *step: seen.append(step), device)
    assert {stage for stage, _ in seen} == {"cells near the surface", "points"} and seen[-1] == ("points", 1.0)
    with pytest.raises(Cancelled):
        clsurf.to_points(surfaces["sphere"], 0.1, lambda *_: False, device)


def test_an_unoriented_surface(device):
    """Another program's file: its normals have no side, all points keep apart."""
    surface = clsurf.load(scan_path("slim/pai.slim2t"))
    assert not surface.oriented
    points = world(clsurf.to_points(surface, 0.2, device=device))
    assert gaps(points).min() > 0.2 * (1 - 1e-5)
    mesh = clsurf.to_mesh(surface, 0.1, device=device)
    assert np.percentile(np.abs(clsurf.project(surface, mesh.vertices + mesh.origin, device).distance), 99) < 0.01
    area = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).area
    assert area / (len(points) * 0.2**2) == pytest.approx(1 / 0.63, rel=0.15), "all of it is there"
