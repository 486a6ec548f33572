"""Cleaning: what is dropped, what is counted, and what stays in which order."""

import logging

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clsurf.io.cleaning import clean_scan, first_of_duplicates
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh

NAN = np.nan


def test_clean_scan_is_the_same_object():
    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.random((50, 3)))
    assert clean_scan(cloud) is cloud
    mesh = Mesh(rng.random((3, 3)), [(0, 1, 2)])
    assert clean_scan(mesh) is mesh


def test_cloud_counts_in_one_line(caplog):
    points = [(0, 0, 0), (1, 0, 0), (0, 0, -0.0), (NAN, 0, 0), (2, 0, 0), (1, 0, 0), (np.inf, 0, 0)]
    points = np.array(points, np.float32)
    normals = np.array([(0, 0, 1), (0, 1, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0), (0, 2, 0), (0, 0, 1)], np.float32)
    colors = np.arange(28).reshape(7, 4)
    with caplog.at_level(logging.INFO, "clsurf"):
        cloud = clean_scan(PointCloud(points, normals, colors, attributes={"k": np.arange(7)}), "a.ply")
    assert len(caplog.records) == 1
    assert caplog.messages[0] == "a.ply: dropped 2 not finite, 1 points with a zero normal, 2 duplicates; 2 points left"
    assert cloud.points.tolist() == [[0, 0, 0], [1, 0, 0]] and cloud.attributes["k"].tolist() == [0, 1]
    assert cloud.colors.tolist() == colors[:2].tolist()
    np.testing.assert_allclose(cloud.normals, [(0, np.sqrt(0.5), np.sqrt(0.5)), (0, 1, 0)], atol=1e-6)


def test_opposite_normals_keep_the_first():
    cloud = clean_scan(PointCloud(np.zeros((2, 3), np.float32), [(0, 0, 1), (0, 0, -1)]))
    assert cloud.normals.tolist() == [[0, 0, 1]]


def test_all_normals_zero_are_no_normals():
    cloud = clean_scan(PointCloud(np.eye(3, dtype=np.float32), np.zeros((3, 3))))
    assert cloud.normals is None and len(cloud.points) == 3


def test_long_normals_become_unit():
    cloud = clean_scan(PointCloud(np.eye(3, dtype=np.float32), np.eye(3) * 7))
    np.testing.assert_allclose(cloud.normals, np.eye(3), atol=1e-7)


def test_mesh_is_renumbered(caplog):
    vertices = np.array([(9, 9, 9), (0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (NAN, 0, 0)], np.float32)
    faces = [(1, 2, 3), (4, 5, 3), (2, 4, 3), (1, 2, 6)]
    with caplog.at_level(logging.INFO, "clsurf"):
        mesh = clean_scan(Mesh(vertices, faces, attributes={"k": np.arange(7)}), "m")
    assert caplog.messages == ["m: dropped 1 not finite, 1 duplicates, 2 faces without three corners, "
                               "1 unreferenced vertices; 4 vertices left"]
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2], [1, 3, 2]] and mesh.attributes["k"].tolist() == [1, 2, 3, 5]


def test_split_normals_of_a_mesh_are_averaged():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 0), (0, 0, 1), (1, 0, 0)], np.float32)
    normals = np.array([(0, 0, 1)] * 3 + [(0, 1, 0)] * 3, np.float32)
    mesh = clean_scan(Mesh(vertices, [(0, 1, 2), (3, 4, 5)], normals))
    assert len(mesh.vertices) == 4
    np.testing.assert_allclose(mesh.normals[:2], [(0, 0.70710678, 0.70710678)] * 2, atol=1e-6)


def test_a_mesh_with_a_zero_normal_loses_its_normals():
    mesh = clean_scan(Mesh(np.eye(3, dtype=np.float32), [(0, 1, 2)], [(0, 0, 1), (0, 0, 0), (0, 0, 1)]))
    assert mesh.normals is None and len(mesh.vertices) == 3


def test_seams_stay():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)] * 2, np.float32)
    uv = np.array([(0, 0), (1, 0), (0, 1), (0, 0), (0.5, 0.5), (0, 1)], np.float32)
    mesh = clean_scan(Mesh(vertices, [(0, 1, 2), (3, 5, 4)], uv=uv))
    assert len(mesh.vertices) == 4 and mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert mesh.uv.tolist() == [[0, 0], [1, 0], [0, 1], [0.5, 0.5]]


def test_nothing_left():
    assert len(clean_scan(PointCloud(np.full((4, 3), NAN, np.float32))).points) == 0
    assert len(clean_scan(PointCloud(np.zeros((0, 3)))).points) == 0
    assert len(clean_scan(Mesh(np.full((3, 3), NAN, np.float32), [(0, 1, 2)])).vertices) == 0


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(*[st.sampled_from([0.0, -0.0, 1.0, 1e-45, 3.5])] * 3), max_size=40), st.integers(0, 3))
def test_first_of_duplicates(rows, width):
    keys = np.array(rows, np.float32).reshape(-1, 3)[:, :width]
    first, target = first_of_duplicates(keys)
    seen = {}
    wanted = [seen.setdefault(tuple(row), len(seen)) for row in (keys + 0).tolist()]
    assert target.tolist() == wanted
    assert first.tolist() == sorted({w: k for k, w in reversed(list(enumerate(wanted)))}.values())


def test_equal_hashes_are_compared(monkeypatch):
    """Rows that share a hash are not taken for equal."""
    keys = np.random.default_rng(0).integers(0, 3, (500, 3)).astype(np.float32)
    wanted = first_of_duplicates(keys)
    monkeypatch.setattr("clsurf.io.cleaning.MIX", np.uint64(0))
    for got, want in zip(first_of_duplicates(keys), wanted, strict=True):
        np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("count", [10, 100_000])
def test_order_is_kept(count):
    points = np.random.default_rng(1).random((count, 3)).astype(np.float32)
    twice = np.concatenate([points, points[::-1]])
    assert (clean_scan(PointCloud(twice)).points == points).all()


def test_few_duplicates_among_many():
    points = np.random.default_rng(2).random((20_000, 3)).astype(np.float32)
    points[[7000, 19_000]] = points[11]
    points[15_000] = points[4]
    first, target = first_of_duplicates(points)
    assert np.array_equal(first, np.delete(np.arange(20_000), [7000, 15_000, 19_000]))
    assert target[[7000, 15_000, 19_000]].tolist() == [11, 4, 11] and (points[first][target] == points).all()
