"""Scale maps through the common interfaces: as a mesh, nearest points, curvature, error."""

import numpy as np
import pytest
from reference import scale_map as twin
from reference.trace_rays import unit
from trimesh.triangles import closest_point

import clsurf
from clsurf.build.triangles import nearest_triangles
from clsurf.errors import InputError
from clsurf.surface.scale_map import ScaleMap
from clsurf.surface.scale_mesh import scale_mesh


@pytest.mark.parametrize("size", (1, 2, 5))
def test_the_net_is_a_closed_mesh(size):
    """Euler's number 2, every edge in two faces in opposite directions, all facing outward."""
    mesh = scale_mesh(twin.smooth_map(size))
    assert len(mesh.vertices) == 6 * size**2
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert len(mesh.vertices) - len(edges) // 2 + len(mesh.faces) == 2
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)
    assert (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1).min() > 0


def test_holes_and_layers_of_the_mesh():
    base = twin.smooth_map(6)
    scales = np.concatenate([base.scales, base.scales * np.float32(0.5)])
    valid = np.ones(scales.shape, bool)
    valid[0, 2, 3, 3] = False
    mesh = scale_mesh(ScaleMap((9, 9, 9), base.radius, scales, valid))
    whole = len(scale_mesh(base).faces)
    assert len(mesh.vertices) == 2 * 216 - 1 and len(mesh.faces) == 2 * whole - 6
    assert np.allclose(mesh.origin, 9)
    assert np.allclose(np.unique(np.linalg.norm(mesh.vertices, axis=1).round(4)), (0.5, 1))


def test_nearest_triangles(device):
    """Which triangle and how far, against every triangle."""
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(300, 3, 3)) + 3
    points = 2 * rng.normal(size=(400, 3)) + 3
    distance, face = nearest_triangles(corners.reshape(-1, 3), np.arange(900).reshape(-1, 3), points, device)
    every = np.stack([np.linalg.norm(closest_point(np.broadcast_to(t, (400, 3, 3)), points) - points, axis=1)
                      for t in corners])
    assert np.abs(distance - every.min(axis=0)).max() < 1e-5
    assert np.abs(every[face, np.arange(400)] - every.min(axis=0)).max() < 1e-5


def test_project(device):
    """An offset sphere: position, normal and signed distance, of second order; placed too."""
    rng = np.random.default_rng(1)
    center = np.array([0.3, -0.2, 0.1])
    points = unit(rng.normal(size=(500, 3))) * rng.uniform(0.6, 1.6, (500, 1)) + center
    exact = np.linalg.norm(points - center, axis=1) - 1
    errors = []
    for size in (16, 32):
        near = clsurf.project(twin.smooth_map(size, center), points, device=device)
        assert np.allclose(np.abs(near.distance), np.linalg.norm(near.position - points, axis=1))
        normal = unit(near.position - center)
        errors.append((np.abs(near.distance - exact).max(), np.linalg.norm(near.normal - normal, axis=1).max()))
    assert errors[1][0] < 0.35 * errors[0][0] and errors[1][0] < 1e-3 and errors[1][1] < 0.02
    turn = np.array([[0, -2, 0, 1e5], [2, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1.0]])
    there = points @ turn[:3, :3].T + turn[:3, 3]
    moved = clsurf.project(twin.smooth_map(32, center).moved(turn), there, device=device)
    assert np.allclose(moved.distance, 2 * near.distance, atol=1e-6)
    with pytest.raises(InputError):
        clsurf.project(ScaleMap((0, 0, 0), 1, np.zeros((1, 6, 2, 2), np.uint8), np.zeros((1, 6, 2, 2), bool)), points,
                       device=device)


def test_curvature_and_error(device):
    """A sphere of radius 2 has curvature 1/2 at every texel; the error of a map of a mesh is small."""
    surface = ScaleMap((1e4, 0, 0), 2.0, np.full((1, 6, 24, 24), 255, np.uint8), np.ones((1, 6, 24, 24), bool))
    found = clsurf.curvature(surface, device=device)
    assert len(found) == 6 * 24**2 and np.nanmax(np.abs(found.mean - 0.5)) < 1e-3
    mesh = scale_mesh(surface)
    assert clsurf.error(surface, mesh, device=device).max < 1e-5
    twice = mesh.vertices * 2.0 + 2 * mesh.origin
    assert clsurf.error(surface.moved(np.diag([2.0, 2, 2, 1])), twice, device=device).max < 1e-3
