"""Meshes of surfaces: on the surface, closed where it is, ending where it ends."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from conftest import scan_path
from test_build_streamed import ground, write_las
from test_build_surfels import uv_sphere

import clsurf
from clsurf.build import sparse_grid, streamed, to_mesh
from clsurf.build.marching import EDGES, marching_cubes, triangle_table
from clsurf.build.sides import turned_over
from clsurf.build.sparse_grid import NearCells, coordinates, keys_of, stepped
from clsurf.errors import Cancelled, InputError
from clsurf.io.stored_leaves import BYTES, only

FAR = np.array([7_691_239.553, 637_291.25, 851.5])
MAJOR, MINOR = 1.0, 0.4


def off_sphere(points):
    return np.linalg.norm(points, axis=1) - 1


def off_torus(points):
    return np.hypot(np.hypot(points[:, 0], points[:, 1]) - MAJOR, points[:, 2]) - MINOR


@pytest.fixture(scope="module")
def shapes(device):
    """Name: surface, distance from the shape, area, Euler characteristic."""
    return {"sphere": (clsurf.build_slim(clsurf.models.sphere(5000), device=device), off_sphere, 4 * np.pi, 2),
            "torus": (clsurf.build_slim(clsurf.models.torus(8000, MAJOR, MINOR), device=device), off_torus,
                      4 * np.pi**2 * MAJOR * MINOR, 0)}


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices.astype(np.float64) + mesh.origin, mesh.faces, process=False)


def border(mesh):
    """Return the world positions (k, 3) of the vertices at open edges; no edge has more than two faces."""
    edges, count = np.unique(np.sort(as_trimesh(mesh).edges, axis=1), axis=0, return_counts=True)
    assert count.max() <= 2
    return mesh.vertices[np.unique(edges[count == 1])].astype(np.float64) + mesh.origin


def rises(mesh):
    """Return the cosines (f,) between the faces' normals and those of their vertices."""
    return np.einsum("ij,ij->i", as_trimesh(mesh).face_normals, mesh.normals[mesh.faces].mean(axis=1))


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_closed_surfaces_become_closed_meshes_of_second_order(name, shapes, device):
    surface, off, area, euler = shapes[name]
    inside, areas = [], []
    for spacing in (0.1, 0.05, 0.025):
        mesh = clsurf.to_mesh(surface, spacing, device=device)
        shape = as_trimesh(mesh)
        assert shape.is_watertight and shape.is_winding_consistent and shape.euler_number == euler
        assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
        assert np.abs(off(shape.vertices)).max() < 5e-4, "vertices are on the surface, which is as near to the shape"
        assert rises(mesh).min() > 0.8 and shape.volume > 0
        assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
        assert np.linalg.norm(shape.vertices[shape.edges_unique[:, 0]] - shape.vertices[shape.edges_unique[:, 1]],
                              axis=1).max() < 2 * spacing
        inside.append(np.sqrt(np.mean(off(shape.triangles_center) ** 2)))
        areas.append(1 - shape.area / area)
    order = np.log2(np.array(inside[:-1]) / inside[1:])
    assert (order > 1.8).all() and (order < 2.2).all(), f"faces come nearer by the square of the spacing, got {order}"
    assert areas[2] < areas[0] / 12 and areas[2] < 3e-4


def test_the_default_spacing_shows_what_the_surface_holds(shapes, device):
    surface, off, _, _ = shapes["torus"]
    shape = as_trimesh(clsurf.to_mesh(surface, device=device))
    edge = np.linalg.norm(np.diff(shape.vertices[shape.edges_unique], axis=1), axis=2)
    assert 0.3 < np.median(edge) / (np.median(surface.radii[surface.leaf]) / 4) < 1.2
    assert np.abs(off(shape.triangles_center)).max() < 0.01 * MINOR


def test_placed_and_far_ones_are_the_same(shapes, device):
    surface = shapes["torus"][0]
    plain = clsurf.to_mesh(surface, 0.1, device=device)
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    matrix = np.diag([3.0, 3, 3, 1]) @ turn
    matrix[:3, 3] = FAR
    moved = clsurf.to_mesh(surface.moved(matrix), 0.3, device=device)
    assert np.array_equal(plain.faces, moved.faces)
    world = (plain.vertices + plain.origin) @ matrix[:3, :3].T + FAR
    assert np.abs(moved.vertices + moved.origin - world).max() < 1e-5
    assert np.abs(moved.normals - plain.normals @ turn[:3, :3].T).max() < 1e-5
    # A scan that lies far away itself.
    scan = clsurf.models.torus(8000, MAJOR, MINOR)
    there = clsurf.build_slim(clsurf.PointCloud(scan.points, scan.normals, origin=FAR), device=device)
    mesh = clsurf.to_mesh(there, 0.1, device=device)
    assert as_trimesh(mesh).is_watertight and np.abs(off_torus(mesh.vertices + (mesh.origin - FAR))).max() < 5e-4


@pytest.mark.parametrize("spacing", [0.1, 0.03])
def test_open_surfaces_end_where_they_are_drawn_to_end(spacing, device):
    """Of half a sphere: the border lies on the last of the surface that rays meet, to a tenth of the spacing."""
    ball = clsurf.models.sphere(10_000)
    upper = ball.points[:, 2] > 0
    half = clsurf.build_slim(clsurf.PointCloud(ball.points[upper], ball.normals[upper]), device=device)
    mesh = clsurf.to_mesh(half, spacing, device=device)
    shape = as_trimesh(mesh)
    rim = border(mesh)
    assert shape.euler_number == 1 and len(rim) > 4 / spacing and rises(mesh).min() > 0.5
    assert np.abs(off_sphere(shape.vertices)).max() < 1e-3
    reach = 2 / 3 * np.median(half.radii)  # what a ball may show beyond its points
    assert -reach < rim[:, 2].min() and rim[:, 2].max() < 0.1 * spacing + 0.02

    def drawn(points):  # where rays from the middle meet the surface
        return clsurf.trace(half, np.zeros(3), points, device=device).hit

    level = rim * (1, 1, 0) / np.linalg.norm(rim[:, :2], axis=1, keepdims=True)
    turn = np.arctan2(rim[:, 2], np.linalg.norm(rim[:, :2], axis=1))
    at = lambda angle: np.cos(angle)[:, None] * level + np.sin(angle)[:, None] * (0, 0, 1)  # noqa: E731
    # Where the outlines of two balls meet there are notches.
    assert drawn(at(turn + 0.2 * spacing)).mean() > 0.8, "the surface goes on up to the border"
    assert drawn(at(turn - 0.2 * spacing)).mean() < 0.1, "and not far beyond it"


def test_holes_stay_open(device):
    """A plate with a round hole: two borders, no curtain, and no more area with a coarse grid than with a fine one."""
    x, y = (np.mgrid[-60:61, -60:61] / 60.0).reshape(2, -1)
    points = np.stack([x, y, 0 * x], axis=1)[np.hypot(x, y) > 0.4]
    plate = clsurf.build_slim(clsurf.PointCloud(points, np.tile((0, 0, 1.0), (len(points), 1))), device=device)
    area = []
    for spacing in (0.1, 0.05):
        mesh = clsurf.to_mesh(plate, spacing, device=device)
        shape = as_trimesh(mesh)
        assert shape.euler_number == 0 and np.abs(shape.vertices[:, 2]).max() < 1e-6
        # The balls beside the hole are as large as it: what they show reaches into it, so far and no further.
        assert np.linalg.norm(shape.vertices[:, :2], axis=1).min() > 0.2
        area.append(shape.area)
    assert area[0] == pytest.approx(area[1], rel=0.01)


def test_near_sheets_are_kept_apart(device):
    """Three planes 1.5 spacings from each other, one turned over: three sheets and nothing between them."""
    sheet = clsurf.models.disc(4000)
    points = np.concatenate([sheet.points + np.array([0, 0, z]) for z in (0, 0.075, 0.15)])
    normals = np.concatenate([sheet.normals * sign for sign in (1, 1, -1)])
    stack = clsurf.build_slim(clsurf.PointCloud(points, normals), error=1e-4, device=device)
    mesh = clsurf.to_mesh(stack, 0.05, device=device)
    z = mesh.vertices[:, 2] + mesh.origin[2]
    assert np.abs(z[:, None] - [0, 0.075, 0.15]).min(axis=1).max() < 2e-3
    assert np.ptp(z[mesh.faces], axis=1).max() < 4e-3, "no face joins two sheets"
    assert as_trimesh(mesh).area == pytest.approx(3 * np.pi, rel=0.15)


def test_the_same_mesh_each_time_and_in_any_chunks(shapes, device, monkeypatch):
    surface = shapes["torus"][0]
    first, again = (clsurf.to_mesh(surface, 0.1, device=device) for _ in range(2))
    monkeypatch.setattr(sparse_grid, "CHUNK", 1000)
    monkeypatch.setattr("clsurf.build.marching.CHUNK", 777)
    for other in (again, clsurf.to_mesh(surface, 0.1, device=device)):
        assert np.array_equal(first.faces, other.faces) and np.array_equal(first.vertices, other.vertices)
        assert np.array_equal(first.normals, other.normals)


def test_colors_are_those_of_the_place(device):
    scan = clsurf.models.sphere(5000)
    colors = np.full((5000, 4), 255, np.uint8)
    colors[:, :3] = np.where(scan.points[:, :1] > 0, (200, 40, 10), (10, 60, 220))
    surface = clsurf.build_slim(clsurf.PointCloud(scan.points, scan.normals, colors), error=0.001, device=device)
    mesh = clsurf.to_mesh(surface, 0.1, device=device)
    side = mesh.vertices[:, 0] + mesh.origin[0]
    clear = np.abs(side) > 0.3
    expected = np.where(side[clear, None] > 0, (200, 40, 10), (10, 60, 220))
    assert np.abs(mesh.colors[clear, :3] - expected).max() <= 3 and (mesh.colors[:, 3] == 255).all()
    assert clsurf.to_mesh(clsurf.build_slim(scan, device=device), 0.2, device=device).colors is None


def test_surfaces_in_their_store_become_the_same_mesh(device, tmp_path, monkeypatch):
    write_las(tmp_path / "hills.las", *ground(20_000))
    monkeypatch.setattr(streamed, "sizes_of", lambda limit: streamed.Sizes(10_000, 4_000, 3_000))
    place = clsurf.build_slim(tmp_path / "hills.las", error=0.003, out=tmp_path / "a.clsurf", device=device).place
    stored = clsurf.open_surface(place, budget=BYTES * len(clsurf.open_surface(place)) * 6 // 10)
    assert len(stored.surfels) > 2
    one, other = clsurf.to_mesh(stored, 1.5, device=device), clsurf.to_mesh(stored.load(), 1.5, device=device)
    assert len(one.faces) == pytest.approx(len(other.faces), rel=0.01)
    assert np.abs(clsurf.project(stored.load(), one.vertices + one.origin, device).distance).max() < 0.05
    assert as_trimesh(one).area == pytest.approx(as_trimesh(other).area, rel=0.01)
    assert len(clsurf.to_mesh(stored, device=device).faces) > 1000
    at_once = clsurf.to_mesh(clsurf.open_surface(place), 1.5, device=device)  # its budget holds all of it
    assert np.array_equal(at_once.faces, other.faces)


def test_other_surfaces_give_the_triangles_that_they_have(device):
    mesh = uv_sphere(12, 20)
    assert clsurf.to_mesh(mesh) is mesh
    hybrid = clsurf.build_surfels(mesh, hybrid=True, map_size=4, device=device)
    assert np.array_equal(clsurf.to_mesh(hybrid).faces, hybrid.triangles)
    patches = clsurf.models.perfect_sphere()
    assert len(clsurf.to_mesh(patches).vertices) == patches.opaque.sum()
    scales = clsurf.build_scale_map(mesh, size=8, device=device)
    assert as_trimesh(clsurf.to_mesh(scales)).is_watertight
    matrix = np.diag([2.0, 2, 2, 1])
    assert np.allclose(clsurf.to_mesh(mesh.moved(matrix)).vertices, 2 * mesh.vertices)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_an_unoriented_surface_gets_its_sides_first(degree, device):
    surface = clsurf.build_slim(clsurf.models.torus(8000), degree=degree, device=device)
    some = np.flatnonzero(np.random.default_rng(0).uniform(size=len(surface)) < 0.4)
    mixed = replace(turned_over(surface, some), oriented=False)
    # What is turned over is where it was, and back again what it was.
    back = turned_over(mixed, some)
    assert np.allclose(back.coefficients, surface.coefficients, atol=1e-4 * np.abs(surface.coefficients).max())
    leaf = some[surface.leaf[some]]
    for k in leaf[:20]:
        alone = [only(one, np.array([k])) for one in (surface, mixed)]
        places = alone[0].centers + 0.3 * alone[0].radii[0] * np.random.default_rng(k).normal(size=(50, 3))
        near = [clsurf.project(one, places + surface.origin, device) for one in alone]
        assert np.abs(near[0].position - near[1].position).max() < 1e-4
        assert np.allclose(near[0].distance, -near[1].distance, atol=1e-4)
    mesh = clsurf.to_mesh(mixed, 0.08, device=device)
    shape = as_trimesh(mesh)
    assert shape.is_watertight and shape.euler_number == 0 and shape.volume > 0 and rises(mesh).min() > 0.7


def test_surfels_without_triangles_are_meshed(device):
    surfels = clsurf.build_surfels(clsurf.models.sphere(3000), map_size=4, device=device)
    mesh = clsurf.to_mesh(surfels, 0.1, device=device)
    shape = as_trimesh(mesh)
    assert shape.is_watertight and shape.euler_number == 2 and rises(mesh).min() > 0.8
    assert np.abs(off_sphere(shape.vertices)).max() < 0.01
    assert len(clsurf.to_mesh(surfels, device=device).faces) > 1000


@pytest.mark.parametrize(("make", "says"), [
    (lambda s: clsurf.to_mesh(s, 0), "spacing: expected a length"), (lambda s: clsurf.to_mesh(s, -1), "spacing"),
    (lambda s: clsurf.to_mesh(s, float("nan")), "spacing"), (lambda s: clsurf.to_mesh(s, "fine"), "spacing"),
    (lambda s: clsurf.to_mesh(s, True), "spacing"), (lambda s: clsurf.to_mesh(s, 1e-12), "spacing: expected at least"),
    (lambda s: clsurf.to_mesh(s, 1e-4), "spacing: expected at least"),
    (lambda s: clsurf.to_mesh(s, 50.0), "spacing: expected a smaller one"),
    (lambda s: clsurf.to_mesh(clsurf.models.sphere(10)), "build_slim"),
    (lambda s: clsurf.to_mesh(3), "expected a SlimSurface"),
    (lambda s: clsurf.to_mesh(clsurf.models.sphere(10).moved(np.eye(4))), "build_slim")])
def test_what_cannot_be_meshed_is_said_in_one_line(make, says, shapes):
    with pytest.raises(InputError, match=says) as caught:
        make(shapes["sphere"][0])
    assert "\n" not in str(caught.value)


def test_a_spacing_that_is_named_is_taken(shapes, device, monkeypatch):
    """Too fine a spacing is refused with one that does; by default a coarser one is taken at once."""
    monkeypatch.setattr(to_mesh, "MOST_CELLS", 20_000)
    with pytest.raises(InputError, match="at least") as caught:
        clsurf.to_mesh(shapes["sphere"][0], 0.01, device=device)
    named = float(str(caught.value).split("at least ")[1].split()[0])
    assert as_trimesh(clsurf.to_mesh(shapes["sphere"][0], 1.2 * named, device=device)).is_watertight
    monkeypatch.setattr(to_mesh, "DEFAULT_CELLS", 2_000)
    coarse = clsurf.to_mesh(shapes["sphere"][0], device=device)
    assert as_trimesh(coarse).is_watertight and 100 < len(coarse.vertices) < 2_000


def test_progress_and_its_end(shapes, device):
    seen = []
    clsurf.to_mesh(shapes["sphere"][0], 0.1, lambda *step: seen.append(step), device)
    assert {stage for stage, _ in seen} == {"cells near the surface", "distances", "triangles", "vertices"}
    assert all(0 <= done <= 1 for _, done in seen) and seen[-1][1] == 1.0
    with pytest.raises(Cancelled):
        clsurf.to_mesh(shapes["sphere"][0], 0.1, lambda *_: False, device)


def test_keys():
    places = np.random.default_rng(0).integers(0, 1 << 20, (1000, 3))
    keys = keys_of(places)
    assert np.array_equal(coordinates(keys), places)
    for axis in range(3):
        assert np.array_equal(coordinates(stepped(keys, axis)), places + np.eye(3, dtype=int)[axis])


def test_marching_cubes_of_any_values_are_closed():
    """All patterns of inside corners, the ambiguous ones too, side by side."""
    count = 20
    parents = np.sort(keys_of(np.stack(np.meshgrid(*[np.arange(count // 2)] * 3), axis=-1).reshape(-1, 3)))
    grid = NearCells(np.zeros(3), 1.0, parents).grid()
    places = coordinates(grid.nodes)
    assert len(grid.nodes) == (count + 1) ** 3 and len(grid.cells) == count**3
    values = np.random.default_rng(0).normal(size=len(places))
    values[((places == 0) | (places == count)).any(axis=1)] = 1
    faces = marching_cubes(grid, values)
    edges, faces = np.unique(faces, return_inverse=True)
    at = places[edges // 3] + 0.5 * np.eye(3)[edges % 3]
    shape = trimesh.Trimesh(at, faces.reshape(-1, 3), process=False)
    assert shape.is_watertight and shape.is_winding_consistent and shape.volume > 0


def test_the_table_is_whole():
    table = triangle_table()
    for case in range(256):
        crossed = {k for k, (low, axis) in enumerate(EDGES) if (case >> low & 1) != (case >> (low | 1 << axis) & 1)}
        assert set(table[case][table[case] >= 0].tolist()) == crossed


def test_the_bunny(device):
    """A real scan, open at its base: as near to the points as its surface, in one piece, with the scan's five holes."""
    scan = clsurf.load(scan_path("bunny/bunny.obj"))
    surface = clsurf.build_slim(scan, device=device)
    mesh = clsurf.to_mesh(surface, device=device)
    shape = as_trimesh(mesh)
    assert shape.euler_number == 2 - 5 and shape.body_count == 1 and len(border(mesh)) < 600
    found = clsurf.error(mesh, scan, both=True, device=device)
    assert found.rms < 1.3 * clsurf.error(surface, scan, device=device).rms
    assert found.backward.percentile(99) < 0.001 * found.diagonal
    assert np.sort(rises(mesh))[10] > 0.5


def test_sharp_edges_close(device):
    """Fandisk: balls beside an edge end at it, and not every place between them is drawn."""
    scan = clsurf.load(scan_path("denoise/Fandisk0.3/Original.obj"))
    mesh = clsurf.to_mesh(clsurf.build_slim(scan, device=device), device=device)
    shape = as_trimesh(mesh)
    assert shape.is_watertight and shape.euler_number == 2 and shape.body_count == 1
    assert clsurf.error(mesh, scan, device=device).relative.rms < 5e-4
