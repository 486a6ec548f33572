"""Rays of a picture go to the packets, and hit what single rays hit."""

import numpy as np
import pytest
from reference.surfaces import fitted, torus_points

import clsurf
from clsurf.render.camera import Camera
from clsurf.trace import grids
from clsurf.trace.hits import checked_rays

SIZE = (72, 61)
CAMERAS = {"perspective": Camera.look_at((1.5, -3.0, 2.0), (0, 0, 0), up=(0, 0, 1), fov=40),
           "orthographic": Camera.orthographic((1.5, -3.0, 2.0), (0, 0, 0), up=(0, 0, 1), height=3)}


@pytest.fixture(scope="module")
def torus():
    points, normals = torus_points(4000)
    return fitted(points, normals, 0.16)


def grid(device, origins, directions, near=0.0):
    return grids.grid_of(device, checked_rays(origins, directions, near, np.inf))


@pytest.mark.parametrize("name", CAMERAS)
def test_the_grid_of_a_camera_is_found(device, name):
    camera = CAMERAS[name]
    origins, directions = camera.rays(SIZE)
    found = grid(device, origins, 3 * directions)
    assert (found.width, found.height, found.perspective) == (*SIZE, name == "perspective")
    assert np.allclose(found.axes[0], camera.rotation, atol=1e-9)
    assert grid(device, origins, directions, near=0.1) is None
    turned = directions.copy()
    turned[1234] += [1e-3, 0, 0]
    assert grid(device, origins, turned) is None
    moved = origins.copy()
    moved[4321] += 1e-2
    assert grid(device, moved, directions) is None
    assert grid(device, origins[:-1], directions[:-1]) is None
    mixed = np.random.default_rng(0).permutation(len(origins))
    assert grid(device, origins[mixed], directions[mixed]) is None
    upside_down = slice(None, None, -1)
    flipped = (array.reshape(*SIZE[::-1], 3)[upside_down].reshape(-1, 3) for array in (origins, directions))
    assert grid(device, *flipped) is None


@pytest.mark.parametrize("lanes", [16, 1])
@pytest.mark.parametrize("name", CAMERAS)
def test_packets_hit_what_single_rays_hit(device, monkeypatch, torus, name, lanes):
    monkeypatch.setattr(device, "lanes", lanes)
    matrix = np.diag([1.2, 1.2, 1.2, 1.0])
    matrix[:3, 3] = 0.1, -0.2, 0.05
    behind = torus.moved(np.diag([0.5, 0.5, 0.5, 1.0]))
    origins, directions = CAMERAS[name].rays(SIZE)
    scene = [torus.moved(matrix), behind]
    traced = []
    monkeypatch.setattr(grids, "trace_pixels", lambda *a, run=grids.trace_pixels: traced.append(run(*a)))
    got = clsurf.trace(scene, origins, directions, device=device)
    assert len(traced) == 2
    wanted = clsurf.trace(scene, origins, directions, near=1e-9, device=device)
    assert len(traced) == 2
    both = got.hit & wanted.hit
    assert both.sum() > 1000 and (got.hit != wanted.hit).mean() < 2e-3
    close = np.isclose(got.distance, wanted.distance, rtol=0, atol=1e-5)
    assert close[both].mean() > 0.998 and (got.surface == wanted.surface)[both].mean() > 0.998
    same = both & close
    assert (got.primitive == wanted.primitive)[same].mean() > 0.99
    assert np.abs(got.position - wanted.position)[same].max() < 2e-5
    # At rims that are hit from behind, pictures show the front's normal.
    inner = same & (np.abs((wanted.normal * directions).sum(axis=1)) > 0.45)
    assert np.abs(got.normal - wanted.normal)[inner].max() < 2e-3
    assert np.isnan(got.position[~got.hit]).all() and (got.primitive[~got.hit] == -1).all()
