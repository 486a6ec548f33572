"""Odd requests for patches end soon: with patches that make sense, or with one line of what to ask for."""

import numpy as np
import pytest
from reference import patches as twin

from clsurf.build.patch_areas import DEFAULT_NODES
from clsurf.build.patch_limits import LEAST_NODES, NODES_A_FACE, least_width, most_of_cloud, most_of_mesh
from clsurf.build.patch_search import with_count
from clsurf.build.patch_views import sphere_directions
from clsurf.build.patches import build_patches
from clsurf.errors import InputError
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.surface.cloud import PointCloud


def cloud(count=1500):
    points = sphere_directions(count)
    return PointCloud(points, points)


def widest(surface):
    points = surface.positions()[surface.opaque]
    return np.ptp(points, axis=0).max()


@pytest.mark.parametrize("request_", [{"patches": 1_000_000}, {"patches": 10**30}, {"spacing": 1e-9}, {"error": 1e-12},
                                      {"nodes": 256, "patches": 1_000}, {"nodes": 2, "spacing": 1e-9}])
def test_too_much_of_a_mesh_is_said_in_one_line(device, request_):
    name = "patches" if "patches" in request_ else next(key for key in request_ if key != "nodes")
    with pytest.raises(InputError, match=rf"^{name}: expected [^\n]*, got [^\n]*: [^\n]*$"):
        build_patches(twin.ball(4), device=device, **request_)


@pytest.mark.parametrize("method", ["local", "global_views"])
@pytest.mark.parametrize("request_", [{"patches": 100_000}, {"spacing": 1e-9}])
def test_too_much_of_a_cloud_is_said_in_one_line(device, method, request_):
    with pytest.raises(InputError, match=rf"^{next(iter(request_))}: expected at (most|least) [^\n]*: [^\n]*$"):
        build_patches(cloud(), method=method, device=device, **request_)


@pytest.mark.parametrize("request_", [{"spacing": 1e9}, {"error": 1.0}])
def test_coarse_requests_of_a_mesh_end_at_patches_that_span_it(device, request_):
    surface = build_patches(twin.ball(3), device=device, **request_)
    step = np.linalg.norm(surface.axis_x, axis=1)
    assert len(surface) < 60 and (step * 16 < 1.2 * surface.diagonal).all() and widest(surface) < 2.5


@pytest.mark.parametrize("method", ["local", "global_views"])
@pytest.mark.parametrize("request_", [{"patches": 1}, {"spacing": 1e9}, {"error": 1.0}])
def test_coarse_requests_of_a_cloud_show_all_of_it(device, method, request_):
    surface = build_patches(cloud(), method=method, device=device, **request_)
    assert len(surface) < 30 and 1.8 < widest(surface) < 2.4


def test_one_patch_of_a_plane(device):
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3)) * [1, 1, 0]
    flat = PointCloud(points, np.broadcast_to([0.0, 0, 1], points.shape))
    for request in ({"patches": 1}, {"spacing": 1e9}):
        surface = build_patches(flat, device=device, **request)
        assert len(surface) == 1 and 1.8 < widest(surface) < 2.5


def test_few_vertices_get_patches_enough(device):
    surface = build_patches(twin.ball(1), device=device)
    assert surface.size.prod(axis=1).sum() >= 0.9 * DEFAULT_NODES


def test_three_points_stay_small(device):
    surface = build_patches(PointCloud(np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])), device=device)
    assert len(surface) == 1 and 0.7 < widest(surface) < 2.5


def test_limits_of_meshes():
    assert most_of_mesh(12, (17, 17)) * 289 <= LEAST_NODES and most_of_mesh(12, (2, 2)) == 1 << 16
    assert most_of_mesh(10**6, (17, 17)) == NODES_A_FACE * 10**6 // 289 and most_of_mesh(10**6, (2, 2)) == 10**6
    assert most_of_mesh(1, (256, 256)) == 256 and most_of_cloud(3, (17, 17)) == 1
    # A square of side 2: its patches' width goes with the root of their number.
    square = twin.sheet(lambda x, y: 0 * x, 5)
    assert least_width(square.vertices, square.faces, 100) == pytest.approx(0.2 / np.sqrt(0.6))
    needle = np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert least_width(needle, np.array([[0, 1, 2]]), 100) == pytest.approx(2 / 1600)


def test_a_search_for_a_number_goes_on_where_a_spacing_fails():
    tried = []

    def at(spacing, progress):
        tried.append(spacing)
        if not 0.1 <= spacing <= 1:
            raise InputError("scan: nothing")
        return range(round(10 / spacing**2)), 0.0

    assert len(with_count(at, 1, 5.0, 0.5, (0.01, 9.0), lambda *_: None)) <= 20 and len(tried) <= 8  # 10 at least
    assert len(with_count(at, 90, 0.02, 0.5, (0.01, 9.0), lambda *_: None)) in range(80, 91)
    with pytest.raises(InputError, match="nothing"):
        with_count(at, 1, 5.0, 3.0, (2.0, 9.0), lambda *_: None)


@pytest.mark.parametrize("option", [{"alpha": "yes"}, {"direct": 1}, {"mip": None}, {"cull": np.ones(2)},
                                    {"nodes": None}, {"cells": ["quads"]}, {"shading": np.ones(2)},
                                    {"normal_table": 1}, {"normals": True}])
def test_drawing_options_of_wrong_types(option):
    with pytest.raises(InputError, match=rf"^patches {next(iter(option))}: expected [^\n]*, got [^\n]*$"):
        PatchDrawing(**option)
