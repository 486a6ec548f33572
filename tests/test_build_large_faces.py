"""Middles of large faces: which faces, what the middles carry, and a mesh whose hole was closed by large faces."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion
from test_render_triangles import globe

from clsurf.analysis.error import error, surface_samples
from clsurf.build.large_faces import coarse_edges, large_faces, longest2, with_edges, with_middles
from clsurf.build.slim import build_slim, face_normals
from clsurf.render.camera import Camera
from clsurf.render.renderer import render
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh


def test_longest_edges():
    rng = np.random.default_rng(0)
    points, faces = rng.normal(size=(50, 3)).astype(np.float32), rng.integers(0, 50, (200, 3))
    corners = points[faces]
    expected = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    np.testing.assert_allclose(np.sqrt(longest2(points, faces)), expected, rtol=1e-6)


def test_faces_of_one_size_are_not_large():
    points = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 0], [np.nan, 0, 0]])
    even = np.array([[0, 1, 2], [0, 2, 3]])
    assert len(large_faces(points, even)) == 0 and len(large_faces(points, even[:0])) == 0
    found = large_faces(points, np.concatenate([even, even, [[2, 4, 3], [0, 1, 5]]]))
    assert found.tolist() == [[2, 4, 3]]


def test_middles_carry_normal_colour_and_least_weight():
    points = np.float32([[0, 0, 0], [3, 0, 0], [0, 3, 0]])
    down = np.float32([[0, 0, -1], [0, 0.6, -0.8], [0, 0, -1]])
    colors = np.uint8([[0, 0, 0, 255], [100, 0, 0, 255], [101, 0, 3, 255]])
    position, normals, colors, weights = with_middles(points, down, colors, np.float32([2, 0.5, 1]),
                                                      np.array([[0, 1, 2]]))
    assert position[3].tolist() == [1, 1, 0] and normals[3].tolist() == [0, 0, -1]
    assert colors[3].tolist() == [67, 0, 1, 255] and weights[3] == 0.5
    assert with_middles(points, None, None, None, np.array([[0, 1, 2]]))[1:] == (None, None, None)


def sparse_disc(count=60):
    """A bent sheet of count^2 vertices, of which those in a disc were lost and faces put in their place."""
    from scipy.spatial import Delaunay
    x, y = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count))
    flat = np.stack([x.ravel(), y.ravel()], axis=1)
    apart = np.hypot(*flat.T)
    ring = np.linspace(0, 2 * np.pi, 7)[:-1]
    flat = np.concatenate([flat[apart > 0.3], 0.15 * np.stack([np.cos(ring), np.sin(ring)], axis=1)])
    place = np.concatenate([flat, 0.3 * (flat**2).sum(axis=1)[:, None]], axis=1)
    return Mesh(place, Delaunay(flat).simplices)


def test_leaves_cover_large_faces(device):
    mesh = sparse_disc()
    with_faces = build_slim(mesh, error=0.003, device=device)
    assert len(large_faces(mesh.vertices, mesh.faces)) > 5
    radius = np.hypot(*(with_faces.centers[with_faces.leaf] + with_faces.origin)[:, :2].T)
    own = np.hypot(*(mesh.vertices + mesh.origin)[:, :2].T)
    in_disc = radius < 0.28
    assert in_disc.sum() > 0 and not np.isclose(radius[in_disc, None], own[None], atol=1e-6).any(axis=1).all()
    samples = surface_samples(mesh, 4000, device)
    cloud = PointCloud(mesh.points, normals=face_normals(mesh.points, mesh.faces), origin=mesh.origin)
    assert error(with_faces, samples, device=device).max < 0.5 * error(build_slim(cloud, error=0.003, device=device),
                                                                      samples, device=device).max


def test_clouds_are_as_before(device):
    mesh = sparse_disc(30)
    cloud = PointCloud(mesh.vertices, normals=np.tile(np.float32([0, 0, 1]), (len(mesh.vertices), 1)))
    surface = build_slim(cloud, device=device)
    assert np.isin(surface.centers, mesh.vertices).all()


def test_weight_of_a_mesh_with_large_faces(device):
    mesh = sparse_disc()
    weight = np.ones(len(mesh.vertices))
    weight[:5] = 0
    surface = build_slim(mesh, weight=weight, device=device)
    assert surface.leaf.any() and np.isfinite(surface.bound)
    assert surface.bound == pytest.approx(build_slim(mesh, device=device).bound, rel=1)


def test_edges_of_meshes_that_are_coarse_for_their_curvature():
    ball, fine = globe(6, 12), globe(40, 80)
    edges = coarse_edges(ball.vertices, ball.vertices, ball.faces)  # 30 degrees from one to the next
    assert len(edges) == len({tuple(sorted(e)) for f in ball.faces.tolist() for e in ((f[0], f[1]), (f[1], f[2]),
                                                                                    (f[2], f[0]))})
    assert not len(coarse_edges(fine.vertices, fine.vertices, fine.faces))
    assert not len(coarse_edges(ball.vertices, ball.vertices, ball.faces[:0]))
    colors = np.tile(np.uint8([[10, 20, 31, 255]]), (len(ball.vertices), 1))
    weights = np.linspace(1, 2, len(ball.vertices), dtype=np.float32)
    position, normals, colors, weights = with_edges(ball.vertices, 3 * ball.vertices, colors, weights, edges)
    n = len(ball.vertices)
    middle = ball.vertices[edges].mean(axis=1)
    np.testing.assert_allclose(position[n:], middle, atol=1e-6)
    far = np.linalg.norm(middle, axis=1) > 0.1
    np.testing.assert_allclose(normals[n:][far], middle[far] / np.linalg.norm(middle[far], axis=1, keepdims=True),
                               atol=1e-5)
    assert (colors[n:] == (10, 20, 31, 255)).all() and (weights[n:] == weights[edges].min(axis=1)).all()
    assert with_edges(ball.vertices, None, None, None, edges[:0])[1:] == (None, None, None)


def test_both_sides_of_a_coarse_thin_rim_are_kept(device):
    # A plate of 0.12 whose rim is round: a ball of 14 of its vertices holds both sides.
    mesh = globe(16, 48)
    thin = Mesh(mesh.vertices * np.float32([1, 1, 0.06]), mesh.faces)
    surface = build_slim(thin, device=device)
    camera = Camera.look_at((0.5, 3, 0.4), (0, 0, 0), fov=45)
    wanted, got = (render(thing, camera, (160, 120), ("depth",), lod=0, device=device).depth
                   for thing in (thin, surface))
    assert (np.isfinite(got) & ~binary_dilation(np.isfinite(wanted), iterations=2)).sum() < 20
    assert (~np.isfinite(got) & binary_erosion(np.isfinite(wanted), iterations=2)).sum() == 0
