"""The plain data types."""

import pickle

import numpy as np
import pytest

from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh
from clsurf.surface.slim import SlimSurface, frame_of_normals


def small_slim(**changes):
    fields = dict(degree=2, error=0.01, centers=np.eye(3), radii=np.ones(3), normals=np.eye(3),
                  coefficients=np.zeros((3, 6)), level=[1, 2, 2], leaf=[False, True, True], child_offset=[0, 2, 2, 2],
                  children=[1, 2], fit_error=np.zeros(3))
    return SlimSurface(**fields | changes)


def test_survey_coordinates_keep_their_millimetres():
    points = np.array([[7691239.553, 532101.127, 12.001], [7691240.553, 532102.127, 13.002]])
    for scan in (PointCloud(points), Mesh(points)):
        np.testing.assert_allclose(scan.points + scan.origin, points, atol=1e-6)
        np.testing.assert_allclose(scan.bounds, points, atol=1e-6)
        assert scan.points.dtype == np.float32


def test_extents_beyond_float32_are_refused():
    with pytest.raises(ValueError, match="extent that float32 holds"):
        PointCloud(np.array([[-1e308, 0, 0], [1e308, 0, 0]]))
    assert np.isfinite(PointCloud(np.array([[-1e38, 0, 0], [1e38, 0, 0]])).points).all()


def test_float32_stays_as_it_is():
    points = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    cloud = PointCloud(points)
    np.testing.assert_array_equal(cloud.points, points)
    assert not cloud.origin.any()
    points[0] = 0  # the caller's array stays writeable


def test_arrays_are_read_only():
    cloud = PointCloud(np.zeros((4, 3)))
    with pytest.raises(ValueError, match="read-only"):
        cloud.points[0] = 1


@pytest.mark.parametrize("make", [
    lambda: PointCloud(np.zeros((4, 2))), lambda: PointCloud(np.zeros((4, 3)), normals=np.zeros((3, 3))),
    lambda: PointCloud(np.zeros((4, 3)), attributes={"intensity": np.zeros(3)}),
    lambda: Mesh(np.zeros((3, 3)), [[0, 1, 3]]), lambda: Mesh(np.zeros((3, 3)), [[0, 1, -1]]),
    lambda: Mesh(np.zeros((3, 3)), colors=np.zeros((3, 3))),
    lambda: small_slim(degree=4), lambda: small_slim(radii=np.ones(2)), lambda: small_slim(children=[1, 3]),
    lambda: small_slim(child_offset=[0, 2, 1, 2]), lambda: small_slim(coefficients=np.zeros((3, 10))),
])
def test_wrong_arrays_are_refused(make):
    with pytest.raises(ValueError, match="expected"):
        make()


def test_repr_is_one_line():
    for thing in (PointCloud(np.zeros((4, 3))), Mesh(np.zeros((4, 3))), small_slim(), PointCloud(np.zeros((0, 3)))):
        assert "\n" not in repr(thing) and "bytes" in repr(thing)


def test_surfaces_pickle():
    surface = pickle.loads(pickle.dumps(small_slim()))
    np.testing.assert_array_equal(surface.centers, np.eye(3))
    assert surface.roots.tolist() == [0]


def test_moved_shares_arrays_and_moves_bounds():
    surface = small_slim()
    matrix = np.diag([2.0, 2, 2, 1])
    matrix[:3, 3] = 5, 0, 0
    placed = surface.moved(matrix)
    assert placed.surface is surface and placed.scale == pytest.approx(2)
    np.testing.assert_allclose(placed.bounds, 2 * surface.bounds + (5, 0, 0))
    twice = placed.moved(matrix)
    np.testing.assert_allclose(twice.matrix, matrix @ matrix)


@pytest.mark.parametrize("matrix", [np.diag([1, 1, 2, 1.0]), np.diag([1, 1, -1, 1.0]), np.zeros((4, 4)), np.eye(3),
                                    np.full((4, 4), np.nan)])
def test_only_similarities_move(matrix):
    with pytest.raises(ValueError, match="expected"):
        small_slim().moved(matrix)


def test_frames_are_right_handed_everywhere():
    n = np.random.default_rng(0).normal(size=(100, 3))
    n = np.concatenate([n / np.linalg.norm(n, axis=1, keepdims=True), [[0, 0, 1], [0, 0, -1], [0, 0, -1.0]]])
    u, v = frame_of_normals(n)
    np.testing.assert_allclose(np.cross(u, v), n, atol=1e-12)
    np.testing.assert_allclose((u * v).sum(axis=1), 0, atol=1e-12)
