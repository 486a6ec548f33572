"""Patches from meshes: resampling against its twins, exactness, what users may ask for, odd meshes."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import scan_path
from reference import patches as twin

import clsurf
from bench.patch_quality import patch_triangles, point_triangle, quality, triangle_distances
from clsurf.build import resample
from clsurf.build.patch_areas import converted
from clsurf.build.patch_error import patch_distances
from clsurf.build.patches import PatchRequest, build_patches
from clsurf.build.resample import FaceLists, Frames, area_lists, resample_faces
from clsurf.errors import Cancelled, InputError
from clsurf.surface.mesh import Mesh


def square_frame(step=0.1, m=17, n=17, origin=(-0.8, -0.8, 0.0)):
    return Frames(np.array([origin]), np.array([[step, 0, 0]]), np.array([[0, step, 0]]), np.array([[m, n]], np.int32))


def whole(mesh):
    count = len(mesh.faces)
    return FaceLists(np.arange(count, dtype=np.int32), np.array([0, count], np.int32), np.array([count], np.int32))


# Resampling ---------------------------------------------------------------------------------------------------------


def test_heights_are_the_same_in_parts(device, monkeypatch):
    """A few rows of nodes a work-item, a few faces a launch."""
    mesh, frames, lists = twin.random_case(1)
    wanted, _, faces = resample_faces(device, mesh, frames, lists)
    monkeypatch.setattr(resample, "_at_once", lambda *_: (3, 7))
    got, _, source = resample_faces(device, mesh, frames, lists)
    assert np.isfinite(wanted).sum() > 100 and np.diff(lists.offset).max() > 14
    np.testing.assert_array_equal(got, wanted)
    np.testing.assert_array_equal(source, faces)


@pytest.mark.parametrize("seed", range(3))
def test_resample_heights(device, seed):
    mesh, frames, lists = twin.random_case(seed)
    heights, colors, source = resample_faces(device, mesh, frames, lists)
    expected, faces = twin.resample_heights(mesh, frames, lists)
    assert colors is None
    # A node exactly at the reach of a face may round either way.
    assert np.count_nonzero(np.isnan(heights) != np.isnan(expected)) <= 3
    both = np.isfinite(heights) & np.isfinite(expected)
    error = np.abs(heights - expected)[both]
    assert both.sum() > 100 and np.count_nonzero(error > 1e-5) <= 2
    assert np.count_nonzero(source != faces) <= 0.05 * len(faces)  # nodes on the edges between faces


def test_resample_heights_on_an_inclined_plane_are_exact(device):
    mesh = twin.sheet(lambda x, y: 0.3 * x - 0.2 * y + 0.1, 9)
    frames = square_frame()
    heights = resample_faces(device, mesh, frames, whole(mesh))[0].reshape(17, 17)
    x, y = np.meshgrid(-0.8 + 0.1 * np.arange(17), -0.8 + 0.1 * np.arange(17))
    np.testing.assert_allclose(heights, 0.3 * x - 0.2 * y + 0.1, atol=1e-6)


def test_cells_over_own_faces_are_opaque(device):
    """The hole rule: every point of an own face is in a cell whose four nodes are opaque."""
    mesh, frames, lists = twin.random_case(7)
    heights, _, _ = resample_faces(device, mesh, frames, lists)
    rng = np.random.default_rng(0)
    offset = frames.node_offset
    for p in range(len(frames)):
        own = lists.faces[lists.offset[p]:lists.offset[p] + lists.own[p]]
        w = rng.dirichlet([1, 1, 1], (len(own), 20))
        points = np.einsum("fsk,fkc->fsc", w, mesh.vertices[mesh.faces[own]].astype(np.float64)).reshape(-1, 3)
        d = points - frames.origins[p]
        i, j = (np.floor(d @ a / (a @ a)).astype(int) for a in (frames.axis_x[p], frames.axis_y[p]))
        m, n = frames.size[p]
        inside = (i >= 0) & (i < m - 1) & (j >= 0) & (j < n - 1)
        opaque = np.isfinite(heights[offset[p]:offset[p + 1]]).reshape(n, m)
        i, j = i[inside], j[inside]
        assert inside.sum() > 300
        assert (opaque[j, i] & opaque[j, i + 1] & opaque[j + 1, i] & opaque[j + 1, i + 1]).all()


def test_faces_that_face_away_give_no_heights(device):
    """A sheet below, upside down, is another side of the surface; a sheet far below is too far."""
    top = twin.sheet(lambda x, y: 0 * x, 5, half=0.3)
    for height, upside_down in ((-0.05, True), (-0.4, False)):
        below = twin.sheet(lambda x, y: 0 * x + height, 9)  # noqa: B023
        mesh = twin.joined(top, replace(below, faces=below.faces[:, ::-1]) if upside_down else below)
        lists = FaceLists(np.arange(len(mesh.faces), dtype=np.int32), np.int32([0, len(mesh.faces)]),
                          np.int32([len(top.faces)]))
        heights = resample_faces(device, mesh, square_frame(), lists)[0]
        assert np.isfinite(heights).sum() > 36
        np.testing.assert_allclose(heights[np.isfinite(heights)], 0, atol=1e-6)


def test_planes_are_not_carried_on_over_a_fall(device):
    """Beyond the own faces a node 0.7 steps away keeps their plane, unless the surface bends down before it."""
    y = [-0.47, 0.47]
    vertices = np.array([[x, b, z] for x, z in ((-0.47, 0), (0.03, 0), (0.07, -0.3)) for b in y], np.float32)
    faces = np.array([[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]], np.int32)
    for count, columns in ((2, 10), (4, 9)):  # the wall is faces 2 and 3
        mesh = Mesh(vertices, faces[:count])
        lists = FaceLists(np.arange(count, dtype=np.int32), np.int32([0, count]), np.int32([2]))
        heights = resample_faces(device, mesh, square_frame(), lists)[0].reshape(17, 17)
        expected, _ = twin.resample_heights(mesh, square_frame(), lists)
        np.testing.assert_array_equal(np.isfinite(heights), np.isfinite(expected).reshape(17, 17))
        assert np.flatnonzero(np.isfinite(heights[8])).max() == columns - 1
        np.testing.assert_allclose(heights[8, 4:columns], 0, atol=1e-6)


def textured(texture, n=9):
    mesh = twin.sheet(lambda x, y: 0.1 * x * y, n)
    return replace(mesh, uv=((mesh.vertices[:, :2] + 1) / 2).astype(np.float32), texture=texture)


@pytest.mark.parametrize("size", [(8, 12), (64, 100)])
def test_resample_colors(device, size):
    texture = np.random.default_rng(1).integers(0, 256, (*size, 4)).astype(np.uint8)
    mesh, frames = textured(texture), square_frame()
    _, colors, source = resample_faces(device, mesh, frames, whole(mesh), precise=True)
    expected = twin.resample_colors(mesh, frames, source)
    visible = expected[:, 3] > 1
    assert np.abs(colors.astype(float) - expected)[visible].max() < 0.52


def test_colors_of_vertices_and_faces(device):
    mesh = twin.sheet(lambda x, y: 0 * x, 5)
    colors = np.full((25, 4), 255, np.uint8)
    colors[:, 0] = 200
    frames = square_frame()
    got = resample_faces(device, replace(mesh, colors=colors), frames, whole(mesh))[1]
    assert got.shape == (289, 3) and (got == [200, 255, 255]).all()
    of_faces = np.zeros((len(mesh.faces), 3), np.uint8)
    of_faces[:, 1] = np.arange(len(mesh.faces)) + 1
    _, got, source = resample_faces(device, replace(mesh, attributes={"face_colors": of_faces}), frames, whole(mesh))
    assert (got == of_faces[source]).all()


def test_transparent_texels_leave_holes(device):
    texture = np.full((2, 2, 4), 255, np.uint8)
    texture[:, 0, 3] = 0
    mesh = textured(texture)
    heights, colors, _ = resample_faces(device, mesh, square_frame(), whole(mesh))
    heights = heights.reshape(17, 17)
    assert np.isnan(heights[:, 5:8]).all() and np.isfinite(heights[:, 9:12]).all()
    heights, colors, _ = resample_faces(device, mesh, square_frame(), whole(mesh), precise=True)
    alpha = colors[:, 3].reshape(17, 17)[8, 4:13]
    assert (np.diff(alpha.astype(int)) >= 0).all() and 0 < alpha[3] < 255  # kept between them


def test_area_lists(device):
    mesh = twin.sheet(lambda x, y: 0 * x, 6)
    owner = (mesh.vertices[mesh.faces].mean(axis=1)[:, 0] > 0).astype(int)
    lists = area_lists(owner, 2, mesh.faces, rings=1)
    for k in range(2):
        faces = lists.faces[lists.offset[k]:lists.offset[k + 1]]
        own = np.flatnonzero(owner == k)
        ring = np.flatnonzero(np.isin(mesh.faces, mesh.faces[own]).any(axis=1) & (owner != k))
        assert (faces[:lists.own[k]] == own).all() and (faces[lists.own[k]:] == ring).all()


# Whole conversions --------------------------------------------------------------------------------------------------


def test_sphere(device):
    """Nodes lie within quantisation and sagitta of the sphere, and every patch faces outward."""
    mesh = twin.ball(4)
    surface = build_patches(mesh, patches=60, device=device)
    assert len(surface) == 60 and surface.equal_sizes and surface.oriented
    inner = 1 - np.linalg.norm(mesh.vertices[mesh.faces].mean(axis=1), axis=1).min()
    nodes = surface.positions()
    apart = np.linalg.norm(nodes[surface.opaque], axis=1) - 1
    assert apart.min() > -1.5 * inner and apart.max() < 1.5 * inner
    centers = np.nanmean(nodes.reshape(60, 289, 3), axis=1)
    assert (np.einsum("ij,ij->i", centers, surface.axis_z) > 0).all()
    assert surface.bound < 2 * inner and surface.diagonal == pytest.approx(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))


def test_bound_holds(device):
    mesh = twin.ball(4)
    surface = build_patches(mesh, patches=40, device=device)
    apart = triangle_distances(mesh.vertices.astype(float) + mesh.origin, patch_triangles(surface))
    assert np.mean(apart <= surface.bound) >= surface.bound_share


def test_a_plane_is_exact(device):
    mesh = twin.sheet(lambda x, y: 0.5 * x + 0.25 * y, 11)
    for wanted in ({"patches": 1}, {"patches": 7}, {"spacing": 0.05}):
        surface = build_patches(mesh, device=device, **wanted)
        nodes = surface.positions()
        nodes = nodes[surface.opaque]
        np.testing.assert_allclose(nodes[:, 2], 0.5 * nodes[:, 0] + 0.25 * nodes[:, 1], atol=2e-6)
        # open borders are met within a cell
        assert np.abs(nodes[:, :2]).max() < 1 + 1.3 * np.linalg.norm(surface.axis_x, axis=1).max()


@pytest.mark.parametrize("count", [13, 50, 333])
def test_a_number_of_patches_is_met(device, count):
    assert len(build_patches(twin.ball(4), patches=count, device=device)) == count


@pytest.mark.parametrize("nodes", [17, (9, 17), 33])
def test_a_spacing_is_met_and_every_area_lies_in_its_patch(device, nodes):
    mesh = twin.ball(4)
    nodes = nodes if isinstance(nodes, tuple) else (nodes, nodes)
    found = converted(mesh, PatchRequest(nodes, spacing=0.05), device, lambda *_: None)
    surface, graph = found.surface, found.graph
    np.testing.assert_allclose(np.linalg.norm(surface.axis_x, axis=1), 0.05, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(surface.axis_y, axis=1), 0.05, rtol=1e-6)
    upper, near = patch_distances(surface, found.owner, graph.middle)
    assert near.max() < 0.004 and (near <= upper).all()
    fewer = converted(mesh, PatchRequest(nodes, spacing=0.08), device, lambda *_: None).surface
    assert len(fewer) < len(surface)


def test_an_error_is_met(device):
    mesh = twin.sheet(lambda x, y: 0.2 * np.sin(3 * x) * np.cos(4 * y), 40)
    coarse = build_patches(mesh, error=1e-3, device=device)
    fine = build_patches(mesh, error=3e-4, device=device)
    assert coarse.node_count < fine.node_count
    for surface, error in ((coarse, 1e-3), (fine, 3e-4)):
        # other points of the faces than the search's: 1 % noise of the samples, 1-2 % between the two measures
        assert quality(surface, mesh, 10_000, parts=1)["rms_mesh"] <= 104 * error


def test_patch_distances(device):
    """Against the exact distance to the patch's own bilinear cells: never less, and near it to first order."""
    mesh = twin.ball(3)
    found = converted(mesh, PatchRequest(patches=20), device, lambda *_: None)
    rng = np.random.default_rng(2)
    faces = rng.integers(0, len(mesh.faces), 300)
    points = found.graph.middle[faces] * rng.uniform(0.995, 1.005, (300, 1))
    upper, near = patch_distances(found.surface, found.owner[faces], points)
    exact = triangle_distances(points, patch_triangles(found.surface, 8))
    assert (upper >= exact - 1e-5).all()
    assert np.median(np.abs(near - exact)) < 1e-4


def test_scaling_by_two_scales_everything(device):
    mesh = twin.ball(3)
    one = build_patches(mesh, patches=30, device=device)
    two = build_patches(replace(mesh, vertices=2 * mesh.vertices), patches=30, device=device)
    for name in ("origins", "axis_x", "axis_y", "axis_z_length"):
        np.testing.assert_allclose(getattr(two, name), 2 * getattr(one, name), rtol=1e-6, atol=1e-6)
    assert (two.displacements == one.displacements).all()


def test_conversions_repeat(device):
    mesh = twin.ball(3)
    one, two = (build_patches(mesh, patches=30, device=device) for _ in range(2))
    assert all((getattr(one, n) == getattr(two, n)).all() for n in ("origins", "axis_x", "displacements"))


def test_a_survey_far_from_zero(device):
    mesh = twin.ball(3)
    place = np.array([7_691_239.553, 1e6, 100])
    far = Mesh(mesh.vertices.astype(np.float64) + place, mesh.faces)
    surface = build_patches(far, patches=30, device=device)
    assert np.abs(np.nanmean(surface.positions(), axis=0) - place).max() < 0.1
    assert surface.bound < 0.02


def test_several_parts_and_their_least_number(device):
    mesh = twin.joined(twin.ball(2), twin.ball(2, 0.5, (3, 0, 0)), twin.ball(1, 0.2, (0, 3, 0)))
    surface = build_patches(mesh, patches=30, device=device)
    assert len(surface) == 30
    points = surface.positions()[surface.opaque]
    assert (points[:, 0] > 2).any() and (points[:, 1] > 2).any()
    with pytest.raises(InputError, match="patches: expected from 3 "):
        build_patches(mesh, patches=2, device=device)


def test_long_faces_are_cut(device):
    """A cube of 12 faces takes any number of patches, and keeps its shape and colours."""
    cube = replace(twin.cube(), colors=np.tile(np.uint8([10, 200, 30, 255]), (8, 1)))
    surface = build_patches(cube, patches=96, device=device)
    assert len(surface) == 96 and (surface.colors[surface.opaque] == [10, 200, 30]).all()
    corners = patch_triangles(surface)
    assert triangle_distances(cube.vertices.astype(float), corners).max() < 0.1


def odd_meshes():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1.0]], np.float32)
    yield "one face", Mesh(square, [[0, 1, 2]])
    yield "an edge of three faces", Mesh(square, [[0, 1, 2], [0, 2, 3], [0, 2, 4]])
    yield "the same face twice", Mesh(square, [[0, 1, 2], [0, 1, 2], [2, 1, 0]])
    yield "faces without area", Mesh(square, [[0, 1, 2], [0, 0, 1], [0, 2, 2], [1, 1, 1]])
    yield "a needle", Mesh(np.float32([[0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0]]), [[0, 1, 2]])
    yield "a line", Mesh(np.float32([[0, 0, 0], [1, 0, 0], [0.5, 0, 0]]), [[0, 1, 2]])
    bad = square.copy()
    bad[4] = np.nan
    yield "a vertex that is not finite", Mesh(bad, [[0, 1, 2], [0, 2, 3], [0, 2, 4]])
    yield "tiny", Mesh(square * np.float32(1e-12), [[0, 1, 2], [0, 2, 3]])
    yield "huge", Mesh(square * np.float32(1e12), [[0, 1, 2], [0, 2, 3]])
    yield "opposite orientations", Mesh(square, [[0, 1, 2], [0, 3, 2]])


@pytest.mark.parametrize("name, mesh", list(odd_meshes()))
def test_odd_meshes(device, name, mesh):
    surface = build_patches(mesh, method="areas", device=device)
    points = surface.positions()[surface.opaque]
    size = np.nanmax(np.abs(mesh.vertices))
    assert len(points) and np.isfinite(points).all() and np.abs(points).max() < 1.5 * size


def test_meshes_that_cannot_be_converted(device):
    v = np.zeros((3, 3), np.float32)
    for mesh, match in ((Mesh(v, np.zeros((0, 3))), "faces"), (Mesh(v, [[0, 1, 2]]), "extent"),
                        (Mesh(v + np.nan, [[0, 1, 2]]), "finite")):
        with pytest.raises(InputError, match=match):
            build_patches(mesh, method="areas", device=device)


def test_progress_and_cancel(device):
    seen = []
    build_patches(twin.ball(3), device=device, progress=lambda what, done: seen.append((what, done)))
    assert seen and all(0 <= done <= 1 for _, done in seen) and {"areas", "nodes"} <= {what for what, _ in seen}
    with pytest.raises(Cancelled):
        build_patches(twin.ball(3), device=device, progress=lambda what, done: False)


def test_precise_nodes_are_finer(device):
    mesh = twin.ball(4)
    plain = converted(mesh, PatchRequest(patches=30), device, lambda *_: None)
    precise = converted(mesh, PatchRequest(patches=30, precise=True), device, lambda *_: None)
    assert precise.surface.displacements.dtype == np.int32
    step = plain.surface.axis_z_length.max()
    assert np.nanmax(np.abs(precise.surface.positions() - plain.surface.positions())) < step


def test_bunny(device):
    """The paper's numbers of patches, nodes and bytes, and the distances asked for, in % of the diagonal."""
    mesh = clsurf.load(scan_path("bunny/bunny.obj"))
    surface = build_patches(mesh, patches=1526, device=device)
    figures = quality(surface, mesh, 4_000, parts=1)
    assert figures["patches"] == 1526 and figures["nodes"] == 441_014 and figures["megabytes"] <= 1.83
    assert figures["rms"] <= 0.010 and figures["max_vertices"] <= 0.12


# The measurement ----------------------------------------------------------------------------------------------------


def test_triangle_distances():
    rng = np.random.default_rng(3)
    triangles = rng.normal(size=(60, 3, 3)) * rng.choice([0.01, 1], (60, 1, 1))
    triangles[0, 2] = triangles[0, 1]  # a line
    points = rng.normal(size=(50, 3))
    exact = np.min([point_triangle(points, np.broadcast_to(t, (50, 3, 3))) for t in triangles], axis=0)
    np.testing.assert_allclose(triangle_distances(points, triangles), exact, atol=1e-12)
    w = rng.dirichlet([1, 1, 1], 60)
    inside = (w[:, :, None] * triangles).sum(axis=1)
    assert triangle_distances(inside, triangles).max() < 1e-12
    normal = np.cross(triangles[1, 1] - triangles[1, 0], triangles[1, 2] - triangles[1, 0])
    normal /= np.linalg.norm(normal)
    assert point_triangle(inside[1:2] + 0.3 * normal, triangles[1:2])[0] == pytest.approx(0.3)
