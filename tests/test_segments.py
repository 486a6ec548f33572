"""Areas of meshes: graph, merging, growing, cutting of long faces."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import patches as twin
from scipy import sparse
from scipy.sparse import csgraph

from clsurf.build.segments import Merging, central_faces, face_graph, grown, ordered, partition, split_faces, turned


def graph_of(mesh):
    return face_graph(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64))


def test_face_graph():
    graph = graph_of(twin.cube(3))
    assert len(graph.pairs) == 3 * len(graph) // 2  # closed: every edge once
    assert graph.area.sum() == pytest.approx(24) and graph.components[0] == 1
    # only the 12 edges of the cube bend, by 90 degrees: 2 (1 - cos) times their length
    assert graph.bend.sum() == pytest.approx(2 * 12 * 2)
    shared = [len(set(graph.corners[a]) & set(graph.corners[b])) for a, b in graph.pairs]
    assert set(shared) == {2}


def test_an_edge_of_many_faces_links_all():
    v = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0]], np.float64)
    graph = face_graph(v, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    assert graph.components[0] == 1


@given(st.lists(st.integers(0, 2**40), max_size=50))
def test_ordered(keys):
    keys = np.array(keys, np.int64)
    assert (ordered(keys) == np.argsort(keys, kind="stable")).all()
    assert (ordered(keys << 20) == np.argsort(keys, kind="stable")).all()


def check_areas(graph, owner, count):
    """Every face has an area, every area a face."""
    assert owner.shape == (len(graph),) and (np.unique(owner) == np.arange(count)).all()


def connected(graph, owner):
    a, b = graph.pairs[owner[graph.pairs[:, 0]] == owner[graph.pairs[:, 1]]].T
    net = sparse.csr_matrix((np.ones(len(a)), (a, b)), (len(graph),) * 2)
    return csgraph.connected_components(net, directed=False)[0]


@settings(max_examples=10, deadline=None)
@given(st.integers(8, 400))
def test_partition_into_a_number(count):
    graph = graph_of(twin.ball(3))
    owner, found = partition(graph, count, exact=True)
    assert found == count
    check_areas(graph, owner, count)


def test_areas_are_connected_compact_and_alike():
    graph = graph_of(twin.ball(4))
    owner, count = partition(graph, 50, exact=True)
    assert connected(graph, owner) <= count + 1
    area = np.bincount(owner, graph.area)
    assert area.max() < 4 * area.min()
    normal = graph.normals_of(owner, count)
    assert np.einsum("ij,ij->i", graph.normal, normal[owner]).min() > 0.7
    # a disc of that area on the sphere has a radius of 0.28
    middle = central_faces(graph, owner, count)
    assert np.linalg.norm(graph.middle - graph.middle[middle][owner], axis=1).max() < 0.6


def test_no_area_crosses_a_crease():
    graph = graph_of(twin.cube(8))
    owner, count = partition(graph, 1)
    assert count == 6
    for k in range(6):
        assert np.ptp(graph.normal[owner == k], axis=0).max() < 1e-6
    for wanted in (6, 12, 40):
        owner, count = partition(graph, wanted, exact=True)
        assert count == wanted
        assert all(np.ptp(graph.normal[owner == k], axis=0).max() < 1e-6 for k in range(count))
    assert partition(graph, 3, exact=True)[1] == 3  # by force


def test_no_area_is_wider_than_asked():
    graph = graph_of(twin.sheet(lambda x, y: 0.1 * x * x, 30))
    owner, count = partition(graph, 1, widest=0.6)
    assert 4 / 0.36 <= count <= 45
    for k in range(count):
        corners = graph.vertices[graph.corners[owner == k]].reshape(-1, 3)
        assert np.ptp(corners, axis=0).max() <= 0.6 + 1e-6


def test_merging_keeps_its_sums():
    """After any number of rounds every sum is what it would be for the areas made anew."""
    graph = graph_of(twin.ball(3))
    merging = Merging(graph, np.arange(len(graph)), len(graph))
    for target in (300, 100, 30):
        merging.merge(target)
        assert merging.count == target
        anew = Merging(graph, merging.owner, merging.count)
        for name in ("area", "normal", "bend", "reach", "a", "b", "border_bend", "border_length"):
            np.testing.assert_allclose(getattr(merging, name), getattr(anew, name), rtol=1e-9, atol=1e-12, err_msg=name)


def test_grown_areas_belong_to_the_nearest_seed():
    graph = graph_of(twin.sheet(lambda x, y: 0 * x, 40))
    seeds = np.array([100, 900, 1500, 2500])
    owner = grown(graph, seeds)
    apart = np.linalg.norm(graph.middle[:, None] - graph.middle[seeds], axis=2)
    assert (owner[seeds] == np.arange(4)).all()
    # paths go over centroids: up to half as long again as the straight line
    assert (apart[np.arange(len(graph)), owner] < 1.5 * apart.min(axis=1) + 0.1).all()


def test_growing_stops_at_creases():
    graph = graph_of(twin.cube(10))
    seeds = central_faces(graph, *partition(graph, 6, exact=True))
    owner = grown(graph, seeds)
    assert np.einsum("ij,ij->i", graph.normal, graph.normal[seeds][owner]).min() > 0.99


def test_turned_faces_go_where_they_suit():
    graph = graph_of(twin.cube(4))
    side = np.argmax(graph.normal @ np.concatenate([np.eye(3), -np.eye(3)]).T, axis=1)
    wrong = side.copy()
    a, b = graph.pairs[side[graph.pairs[:, 0]] != side[graph.pairs[:, 1]]][0]
    wrong[a] = side[b]
    assert (turned(graph, wrong, 6) == side).all()
    lonely = side.copy()
    lonely[a] = 6  # an area of one face keeps it
    assert (np.bincount(turned(graph, lonely, 7), minlength=7) > 0).all()


@pytest.mark.parametrize("longest", [3.0, 0.9, 0.3])
def test_split_faces(longest):
    cube = twin.cube()
    v = cube.vertices.astype(np.float64)
    faces, ends, source = split_faces(cube.faces, v, longest)
    for pair in ends:
        v = np.concatenate([v, v[pair].mean(axis=1)])
    edges = v[faces] - v[faces[:, [1, 2, 0]]]
    assert np.linalg.norm(edges, axis=2).max() <= longest
    graph, whole = face_graph(v, faces), face_graph(cube.vertices.astype(np.float64), cube.faces.astype(np.int64))
    assert len(graph.pairs) == 3 * len(faces) // 2  # still closed: cut alike on both sides
    np.testing.assert_allclose(np.bincount(source, graph.area), whole.area)
    np.testing.assert_allclose(graph.normal, whole.normal[source], atol=1e-12)
