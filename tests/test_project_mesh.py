"""Nearest points of meshes and patches, and on which side of them a point lies."""

import numpy as np
import pytest
import trimesh
from reference.ray_scenes import torus_mesh
from reference.small_device import small

import clsurf
from clsurf.build.triangles import barycentric_foot
from clsurf.errors import InputError
from clsurf.models import perfect_sphere
from clsurf.surface.mesh import Mesh


def mesh_of(shape, origin=None):
    return Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32), origin=origin)


def queries(count=4000, size=2.0, seed=0):
    return np.random.default_rng(seed).uniform(-size, size, (count, 3))


@pytest.mark.parametrize("shift", [0.0, 1e6])
def test_signed_distance_of_a_box(device, shift):
    """Most of the feet are on edges and corners, where the nearest face alone can tell the wrong side."""
    half = np.array([0.5, 0.75, 1.0])
    points = queries()
    found = clsurf.project(mesh_of(trimesh.creation.box(2 * half), [shift] * 3), points + shift, device)
    q = np.abs(points) - half
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
    assert (exact < 0).sum() > 100 and ((q > 0).sum(axis=1) > 1).sum() > 1000
    assert np.abs(found.distance - exact).max() < 1e-6
    outside = exact > 0
    nearest = np.sign(points) * np.minimum(np.abs(points), half)
    # Of two triangles as near in float32 either is taken: the foot is off by the root of that.
    assert np.abs(found.position - shift - nearest)[outside].max() < 2e-4
    # From outside, the pseudonormal of the foot and the way to the point include less than a right angle.
    toward = points - nearest
    assert ((found.normal * toward).sum(axis=1)[outside] > 0).all()
    assert np.allclose(np.linalg.norm(found.normal, axis=1), 1)


def test_the_side_at_sharp_corners(device):
    """A spike of four slim faces: their normals differ by almost half a turn at the tip."""
    tip = Mesh(np.array([[0, 0, 1], [0.1, 0, 0], [-0.05, 0.08, 0], [-0.05, -0.08, 0]], np.float32),
               np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], np.int32))
    around = np.random.default_rng(1).normal(size=(2000, 3))
    around = [0, 0, 1] + 0.3 * around / np.linalg.norm(around, axis=1, keepdims=True)
    around = around[around[:, 2] > 1.1]
    found = clsurf.project(tip, around, device)
    assert (found.distance > 0).all() and np.allclose(found.position, [0, 0, 1], atol=1e-6)


def test_seams_of_textures_are_no_rims(device):
    """With every face's corners its own, as OBJ files with textures have them, the sides stay the same."""
    box = mesh_of(trimesh.creation.box((1, 1, 1)))
    apart = Mesh(box.vertices[box.faces].reshape(-1, 3), np.arange(box.faces.size, dtype=np.int32).reshape(-1, 3))
    points = queries(seed=2)
    one, other = (clsurf.project(mesh, points, device) for mesh in (box, apart))
    assert np.array_equal(one.distance, other.distance)
    for point in points[:20]:  # alone: the faces around its foot share no vertex with the nearest one
        one, other = (clsurf.project(mesh, point[None], device) for mesh in (box, apart))
        assert np.allclose(one.normal, other.normal)


def test_patches_are_their_triangles(device):
    ball = perfect_sphere()
    points = 100 * queries(1000)
    found = clsurf.project(ball, points, device)
    assert np.abs(found.distance - (np.linalg.norm(points, axis=1) - 128)).max() < 0.01


def test_placed_meshes_and_scenes_of_nothing(device):
    box = mesh_of(trimesh.creation.box((1, 1, 1)))
    matrix = np.eye(4) * 2
    matrix[:, 3] = 5, 0, 0, 1
    found = clsurf.project(box.moved(matrix), np.array([[9.0, 0, 0]]), device)
    assert np.allclose(found.position, [[6, 0, 0]]) and np.allclose(found.distance, 3)
    assert clsurf.project(box, np.zeros((0, 3)), device).position.shape == (0, 3)
    with pytest.raises(InputError, match="faces"):
        clsurf.project(Mesh(box.vertices, np.zeros((0, 3), np.int32)), [[0.0, 0, 0]], device)
    with pytest.raises(InputError, match="Mesh"):
        clsurf.project("bunny.ply", [[0.0, 0, 0]], device)


def test_triangles_larger_than_a_device_are_looked_through_in_parts(device):
    """Meshes, hybrid hierarchies and scale maps: the nearest places of the whole."""
    mesh = torus_mesh(80, 40)
    for thing in (mesh, clsurf.build_surfels(mesh, hybrid=True, device=device)):
        points = np.random.default_rng(2).uniform(-3, 3, (3000, 3))
        wanted = clsurf.project(thing, points, device=device)
        with small(device, 100_000):
            got = clsurf.project(thing, points, device=device)
        np.testing.assert_allclose(np.abs(got.distance), np.abs(wanted.distance), atol=1e-6)
        # Where two faces are as near, either may be taken.
        assert (np.abs(got.position - wanted.position).max(axis=1) < 1e-5).mean() > 0.99
        assert (np.abs(got.normal - wanted.normal).max(axis=1) < 1e-3).mean() > 0.99


@pytest.mark.parametrize("edge", [1e-7, 3e-4, 1.0, 1e5])
def test_feet_do_not_depend_on_the_unit(device, edge):
    """Scans in metres have edges of a tenth of a millimetre: their feet lie in faces, not on edges."""
    i, j = np.meshgrid(np.arange(24), np.arange(24), indexing="ij")
    grid = np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3)
    a = (np.arange(23)[:, None] * 24 + np.arange(23)).ravel()
    faces = np.concatenate([np.stack([a, a + 24, a + 25], axis=1), np.stack([a, a + 25, a + 1], axis=1)])
    points = np.random.default_rng(2).uniform([0, 0, -3], [23, 23, 3], (3000, 3))
    found = clsurf.project(Mesh(grid * edge, faces), points * edge, device)
    # Near an edge of two faces either is taken: the foot is off by the root of float32's step.
    assert np.abs(found.position / edge - points * [1, 1, 0]).max() < 2e-3
    assert np.abs(found.distance / edge - points[:, 2]).max() < 1e-5


def test_feet_on_needles_and_faces_without_area():
    """The foot is never further than the nearest of a dense sample of the face."""
    rng = np.random.default_rng(3)
    corners = rng.normal(size=(400, 3, 3))
    corners[:100, 2] = corners[:100, 0] + rng.uniform(-1, 2, (100, 1)) * (corners[:100, 1] - corners[:100, 0])
    corners[100:150, 1] = corners[100:150, 0]
    corners[150:170] = corners[150:170, :1]
    corners[170:200, 2] += 1e-9 * (corners[170:200, 2] - corners[170:200, 1])
    points = rng.normal(size=(400, 3)) * 1.5
    foot, weights = barycentric_foot(points, corners)
    s, t = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 60)))
    some = np.stack([1 - s, s * (1 - t), s * t], axis=1)
    nearest = np.linalg.norm(np.einsum("si,nij->nsj", some, corners) - points[:, None], axis=2).min(axis=1)
    away = np.linalg.norm(foot - points, axis=1)
    assert (away <= nearest + 1e-9).all() and (away > nearest - 0.1).all()
    assert (weights >= 0).all() and np.allclose(weights.sum(axis=1), 1)
    assert np.allclose(np.einsum("ni,nij->nj", weights, corners), foot)
