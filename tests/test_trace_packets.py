"""Packets of rays: the pixels of a picture against the tile renderer, the twin and analytic surfaces."""

from dataclasses import replace

import numpy as np
import pytest
from reference import trace as twin
from reference.surfaces import fitted, leaves, plane_points, sphere, torus_points, two_level_sphere
from test_render_project import cameras

from bench.answer_scenes import forms
from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer
from clsurf.render.slim import place_slim, upload_slim
from clsurf.render.tiles import Layout
from clsurf.trace.hits import trace
from clsurf.trace.packets import trace_pixels
from clsurf.trace.slim import upload_traced

FORMS = (16, 1)
SIZE = (90, 70)
SMALL = (44, 35)


@pytest.fixture(scope="module", params=(1, 2, 3))
def torus(request):
    return fitted(*torus_points(3000), 0.2, request.param)


def unbinned(values, size):
    """Planes (bins, ..., 64) as a picture (height, width, ...)."""
    columns, rows = -(-size[0] // 8), -(-size[1] // 8)
    values = values.reshape(rows, columns, -1, 8, 8).transpose(0, 3, 1, 4, 2)
    return values.reshape(8 * rows, 8 * columns, -1)[:size[1], :size[0]]


def traced_picture(device, surface, camera, size, lanes, matrix=None):
    """Depth (inf: none), gradient (view axes) and count of every pixel."""
    layout = Layout(count=True)
    bins = -(-size[0] // 8), -(-size[1] // 8)
    touched = device.upload(np.full(bins[0] * bins[1], -1, np.int32))
    planes = device.empty((bins[0] * bins[1], layout.constants["FIELDS"], 64), np.float32)
    view, _ = place_slim(upload_slim(device, surface), matrix, camera, size, 0.0)
    trace_pixels(device, lanes, upload_traced(device, surface), device.upload(view), layout.constants, 0, None, *bins,
                 touched, planes)
    seen = device.download(touched) >= 0
    values = device.download(planes)
    depth = unbinned(np.where(seen[:, None], values[:, 0], np.inf), size)[..., 0]
    count = unbinned(np.where(seen[:, None], values[:, 4].view(np.int32), -1), size)[..., 0]
    return depth, unbinned(values[:, 1:4], size), count


@pytest.mark.parametrize("lanes", FORMS)
@pytest.mark.parametrize("which", range(3))
def test_traced_and_rasterised_pictures_are_equal(device, torus, which, lanes):
    camera = cameras()[which]
    depth, gradient, count = traced_picture(device, torus, camera, SIZE, lanes)
    with Renderer(device) as r:
        frame = r.render(torus, camera, SIZE, ("depth", "normal", "count"), lod=0)
    hit = np.isfinite(frame.depth)
    assert hit.sum() > 500
    assert (np.isfinite(depth) == hit).mean() >= 0.999
    both = hit & np.isfinite(depth)
    diagonal = np.linalg.norm(np.ptp(torus.bounds, axis=0))
    assert (np.abs(depth[both] - frame.depth[both]) < 1e-5 * diagonal).mean() >= 0.999
    assert (count[both] == frame.count[both]).mean() >= 0.998
    normal = gradient[both] / np.linalg.norm(gradient[both], axis=-1, keepdims=True) @ camera.rotation
    assert (np.abs(normal - frame.normal[both]).max(axis=-1) < 1e-3).mean() >= 0.999


@pytest.mark.parametrize("lanes", FORMS)
def test_trace_pixels(device, torus, lanes):
    camera = cameras()[0]
    depth, gradient, count = (x.reshape(SMALL[0] * SMALL[1], -1) for x in
                              traced_picture(device, torus, camera, SMALL, lanes))
    view, _ = place_slim(upload_slim(device, torus), None, camera, SMALL, 0.0)
    wanted = twin.trace_pixels(torus, view, SMALL)
    both = np.isfinite(depth[:, 0]) & np.isfinite(wanted.depth)
    assert both.sum() > 100 and (np.isfinite(depth[:, 0]) == np.isfinite(wanted.depth)).mean() > 0.998
    assert (np.abs(depth[both, 0] - wanted.depth[both]) < 2e-5).mean() > 0.998
    assert (count[:, 0][both] == wanted.count[both]).mean() > 0.998
    unit = [g / np.linalg.norm(g, axis=1, keepdims=True) for g in (gradient[both], wanted.gradient[both])]
    assert (np.abs(unit[0] - unit[1]).max(axis=1) < 1e-3).mean() > 0.998


@pytest.mark.parametrize("lanes", FORMS)
def test_sphere_and_plane_are_exact(device, lanes):
    camera = Camera.look_at((0.3, 0.2, 4), (0, 0, 0))
    depth, _, _ = traced_picture(device, sphere(), camera, SIZE, lanes)
    origins, directions = camera.rays(SIZE)
    b = (origins * directions).sum(axis=1)
    disc = b * b - (origins**2).sum(axis=1) + 1
    t = (-b - np.sqrt(np.maximum(disc, 0))) * (directions @ -camera.rotation[2])
    exact = np.where(disc > 0, t, np.inf).reshape(SIZE[1], SIZE[0])
    both = np.isfinite(depth) & (disc > 0.02).reshape(exact.shape)
    assert (np.isfinite(depth) == np.isfinite(exact)).mean() > 0.98
    assert np.abs(depth[both] - exact[both]).max() < 3e-3  # Taylor polynomials of the sphere
    points, normals = plane_points(30)
    flat = leaves(points, np.full(900, 0.12), normals, np.zeros((900, 6)), 2)
    down = Camera.look_at((0.1, 0.3, 2), (0, 0, 0))
    depth, _, _ = traced_picture(device, flat, down, SIZE, lanes)
    origins, directions = down.rays(SIZE)
    t = (-origins[:, 2] / directions[:, 2] * (directions @ -down.rotation[2])).reshape(depth.shape)
    assert np.isfinite(depth).all() and np.abs(depth - t).max() < 1e-5


@pytest.mark.parametrize("lanes", FORMS)
def test_internal_surfels_and_useless_ones_are_left_out(device, lanes):
    surface = two_level_sphere()
    camera = Camera.look_at((0, 0, 4), (0, 0, 0))
    whole = traced_picture(device, surface, camera, SMALL, lanes)
    keep = surface.leaf
    alone = leaves(surface.centers[keep], surface.radii[keep], surface.normals[keep], surface.coefficients[keep], 2)
    for got, wanted in zip(whole, traced_picture(device, alone, camera, SMALL, lanes), strict=True):
        assert np.array_equal(got, wanted, equal_nan=True)
    centers = surface.centers.copy()
    centers[keep.argmax()] = np.nan
    depth, _, _ = traced_picture(device, replace(surface, centers=centers), camera, SMALL, lanes)
    assert (np.isfinite(depth) == np.isfinite(whole[0])).mean() > 0.99
    empty = leaves(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 6)), 2)
    assert not np.isfinite(traced_picture(device, empty, camera, SMALL, lanes)[0]).any()


@pytest.mark.parametrize("lanes", FORMS)
def test_a_similarity_scales_the_depth(device, lanes):
    surface, camera = fitted(*torus_points(3000), 0.2), cameras()[0]
    matrix = np.eye(4)
    matrix[:3, :3] *= 3
    matrix[:3, 3] = 10, -20, 5
    moved = Camera.look_at(3 * camera.eye + matrix[:3, 3], matrix[:3, 3])
    depth, _, _ = traced_picture(device, surface, camera, SIZE, lanes)
    scaled, _, _ = traced_picture(device, surface, moved, SIZE, lanes, matrix)
    both = np.isfinite(depth) & np.isfinite(scaled)
    assert (np.isfinite(depth) == np.isfinite(scaled)).mean() > 0.999
    assert (np.abs(scaled[both] / 3 - depth[both]) < 1e-5).mean() > 0.998


def test_both_forms_see_the_same(device):
    surface = fitted(*torus_points(3000), 0.2)
    one, two = (traced_picture(device, surface, cameras()[1], SIZE, lanes)[0] for lanes in (forms(device)[0], 1))
    both = np.isfinite(one) & np.isfinite(two)
    assert (np.isfinite(one) == np.isfinite(two)).all() and np.abs(one[both] - two[both]).max() < 1e-5


def test_packets_and_single_rays_hit_the_same(device):
    surface, camera = fitted(*torus_points(3000), 0.2), cameras()[0]
    depth, _, _ = traced_picture(device, surface, camera, SIZE, forms(device)[0])
    origins, directions = camera.rays(SIZE)
    hits = trace(surface, origins, directions, device=device)
    along = (hits.distance * (directions @ -camera.rotation[2])).reshape(depth.shape)
    both = np.isfinite(depth) & np.isfinite(along)
    assert both.sum() > 500 and (np.isfinite(depth) == np.isfinite(along)).mean() >= 0.999
    assert (np.abs(depth[both] - along[both]) < 1e-5).mean() >= 0.998
