"""Rays of a picture go to the packets, and hit what single rays hit."""

import numpy as np
import pytest
from reference import trace_rays as twin
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


@pytest.mark.float64
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


@pytest.mark.float64
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


@pytest.mark.float64
@pytest.mark.parametrize("perspective", [True, False])
def test_on_grid(device, perspective):
    """Rays off by a little and by too much, against the twin, one at a time."""
    random, width, tolerance = np.random.default_rng(1), 5, 1e-3
    grid = np.array([[0.3, 0.2, 0.1], [-1, 1, -4], [0.5, 0.1, 0], [0.05, -0.4, 0.1]])
    grid[0] /= 1.0 if perspective else np.linalg.norm(grid[0])
    number = np.arange(40)
    at = grid[1] + (number % width)[:, None] * grid[2] + (number // width)[:, None] * grid[3]
    for trial in range(60):
        size = (0, 5e-4, 2e-3)[trial % 3] * (1 if perspective or trial % 2 else 1e-7)
        moved, off = random.normal(size=3), trial % len(number)
        moved *= size / np.linalg.norm(moved)
        if perspective:
            origins, directions = grid[:1].copy(), 2 * at / np.linalg.norm(at, axis=1, keepdims=True)
            directions[off] = (at[off] + moved) * (-1 if trial == 42 else 1)
        else:
            origins, directions = at.copy(), np.tile(grid[0], (len(at), 1))
            if trial % 2:
                origins[off] += moved
            else:
                directions[off] += moved
        on_device = device.upload(np.zeros(1, np.int32))
        device.kernel("trace/on_grid.cl")(
            (len(at),), (64,), len(at), width, int(perspective), device.upload(grid.ravel()), tolerance,
            device.upload(origins), 0 if len(origins) == 1 else 3, device.upload(directions), 3, on_device)
        wanted = twin.on_grid(grid, width, perspective, tolerance, origins, directions)
        assert wanted.sum() >= len(at) - 1 and bool(device.download(on_device)[0]) == (not wanted.all())


@pytest.mark.parametrize("perspective", [1.0, 0.0])
def test_grid_hits(device, perspective):
    random, width, height = np.random.default_rng(2), 13, 10
    planes = random.normal(size=(4, 5, 64)).astype(np.float32)
    planes[:, 0] = np.where(random.random((4, 64)) < 0.3, np.inf, random.uniform(1, 5, (4, 64)))
    slots = random.integers(0, 20, (4, 64)).astype(np.int32)
    planes[:, 4] = slots.view(np.float32)
    view = np.zeros(grids.VIEW_FLOATS, np.float32)
    view[:9] = np.linalg.qr(random.normal(size=(3, 3)))[0].ravel()
    view[9], view[13:17], view[17] = 1.7, (20, 22, 6.1, 4.9), perspective
    touched, order = np.array([1, -1, 0, 5], np.int32), random.permutation(20).astype(np.int32)
    out = device.empty((width * height, 8), np.float32)
    device.kernel("trace/grid_hits.cl", constants=grids.LAYOUT)(
        (width * height,), (64,), width * height, width, 2, device.upload(view), device.upload(touched),
        device.upload(planes), device.upload(order), 0.3, out)
    got = device.download(out)
    exact = planes.astype(float)
    exact[:, 4] = slots
    wanted = twin.grid_hits(width, width * height, view.astype(float), touched, exact, order, 0.3)
    hit = np.isfinite(wanted[:, 0])
    assert 20 < hit.sum() < 100 and (np.isfinite(got[:, 0]) == hit).all()
    assert np.array_equal(got[:, 4].view(np.int32), wanted[:, 4].astype(int))
    assert np.allclose(got[hit, :4], wanted[hit, :4], atol=1e-5) and np.allclose(got[:, 5:], 0)
