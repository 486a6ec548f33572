"""Kernels that smooth, against their plain twins, in both forms where there are two."""

import numpy as np
import pytest
from reference import smooth as twin

from clsurf.analysis import smooth_fits, smooth_mesh
from clsurf.analysis.smooth_fits import Queries, Rings
from clsurf.device import Device


@pytest.fixture(params=[16, 1], ids=["lanes", "items"])
def either_form(request, device):
    """The device in the vector form, and in the form of one work-item a point."""
    other = Device(device.cl_device, device.context, device.queue)
    other.lanes = request.param
    return other


def bumpy(n=14, noise=0.15, seed=0):
    """A noisy sheet of 2 (n - 1)^2 triangles over a paraboloid: vertices and faces."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    vertices = np.stack([x, y, 0.03 * (x * x - 0.5 * y * y)], axis=-1).reshape(-1, 3)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    return (vertices + noise * rng.normal(size=vertices.shape)).astype(np.float32), faces.astype(np.int32)


@pytest.fixture
def net(either_form):
    vertices, faces = bumpy()
    return smooth_mesh.net_of(vertices, faces, either_form)[0]


@pytest.fixture
def samples(net):
    rows, _ = smooth_mesh.guide_rows(net, smooth_mesh.GUIDE_SHARPS)
    spacing = np.full(len(net.faces), smooth_mesh.edge_length(0.5) / net.unit, np.float32)
    return smooth_mesh.samples_of(net, rows, spacing)


def test_net(net):
    vertices, faces = bumpy()
    assert np.allclose(net.vertices * net.unit + net.middle, vertices[net.used], atol=1e-5)
    wanted = {tuple(np.roll(face, -face.argmin())) for face in faces}
    assert {tuple(np.roll(face, -face.argmin())) for face in net.used[net.faces]} == wanted
    n = 14
    inside = np.zeros((n, n), bool)
    inside[1:-1, 1:-1] = True
    assert (net.border == ~inside.ravel()[net.used]).all()
    near = net.device.download(net.rings.near)
    offset = net.device.download(net.rings.offset)
    for v in range(0, len(net.used), 17):
        touching = net.faces[(net.faces == v).any(axis=1)]
        assert sorted(near[offset[v]:offset[v + 1]]) == sorted(touching[touching != v])


def test_guided_planes(net):
    rows = net.device.empty((len(net.faces), 8), np.float32)
    net.device.kernel("analysis/guided_planes.cl")((len(net.faces),), (64,), len(net.faces), net.faces_on_device,
                                                   net.device.upload(net.vertices), 3.0, rows)
    wanted = twin.guided_planes(net.vertices, net.faces)
    wanted[:, 3] *= 3
    assert np.allclose(net.device.download(rows), wanted, atol=2e-5)


def test_guided_normals(net):
    rows = twin.guided_planes(net.vertices, net.faces).astype(np.float32)
    out = net.device.empty(rows.shape, np.float32)
    width2 = 0.02
    net.device.kernel("analysis/guided_normals.cl")((len(rows),), (64,), len(rows), net.faces_on_device, net.offset,
                                                    net.faces_of, net.device.upload(rows), 1 / width2, 4.0, out)
    out = net.device.download(out)
    assert np.allclose(out[:, :3], twin.guided_normals(rows, net.faces, width2, 4.0), atol=2e-5)
    assert (out[:, 3:] == rows[:, 3:]).all()


def test_guided_rows(net, samples):
    rows, _ = smooth_mesh.guide_rows(net, smooth_mesh.GUIDE_SHARPS)
    rows, sorted_ = net.device.download(rows), net.device.download(samples.sorted)
    count = len(rows)
    assert (sorted_[:3, :count].T == rows[:, 4:7]).all() and (sorted_[3:6, :count].T == rows[:, :3]).all()
    assert (sorted_[6, :count] == rows[:, 3]).all()
    assert (sorted_[:3, count:] > 1e5).all() and (sorted_[6, count:] == 0).all()


@pytest.mark.parametrize("factor", [0.9, 1.4, 4.0])  # a constant or a plane for some, quadrics for all
def test_guided_fits(samples, factor):
    radii = np.linspace(1.0, 1.2, samples.count, dtype=np.float32) * factor * samples.spacing
    center = smooth_fits.centers_of(samples, radii)
    fits = smooth_fits.guided_fits(samples, radii, 6.0)
    records = samples.device.download(fits.records)
    arrays = samples.device.download(samples.sorted)[:, :samples.count].astype(np.float64)
    points, normals, weights = arrays[:3].T, arrays[3:6].T, arrays[6]
    for i in range(0, len(center), 7):
        c, count, residual2 = twin.guided_fits(points, normals, weights, center[i], float(radii[center[i]]), 6.0)
        assert records[i, 13] == pytest.approx(count, rel=1e-4)
        assert np.allclose(records[i, :7], [*points[center[i]], radii[center[i]], *normals[center[i]]])
        if abs(count - 8) < 0.01 or abs(count - 3.5) < 0.01:
            continue
        scale = float(radii[center[i]])
        assert np.allclose(records[i, 7:13] * [1 / scale, 1, 1, scale, scale, scale],
                           c * [1 / scale, 1, 1, scale, scale, scale], atol=2e-3)
        assert records[i, 14] == pytest.approx(residual2, rel=2e-3, abs=1e-7 * scale**2)


def test_guided_balls(samples):
    fits = smooth_fits.guided_fits(samples, 3 * samples.spacing, 6.0)
    balls, records = samples.device.download(fits.balls), samples.device.download(fits.records)
    count = int((balls[3] > 0).sum())
    assert 0 < count <= fits.padded < count + 16
    assert (balls[:, :count].T == records[:count, :4]).all() and (balls[3, count:] == -1).all()


def test_guided_blend(samples):
    fits = smooth_fits.guided_fits(samples, 3 * samples.spacing, 6.0)
    found = smooth_fits.blended(fits, Queries(samples.count, samples.padded, samples.sorted))
    device = samples.device
    surfels = device.download(fits.records)[:int((device.download(fits.balls)[3] > 0).sum())]
    arrays = device.download(samples.sorted)[:, :samples.count].astype(np.float64)
    for i in range(0, samples.count, 23):
        offset, normal, points = twin.guided_blend(arrays[:3, i], arrays[3:6, i], surfels, 6.0)
        assert found[0, i] == pytest.approx(offset, abs=1e-6)
        assert np.allclose(found[1:4, i], normal, atol=1e-4)
        assert found[4, i] == pytest.approx(points, rel=1e-4)


def test_ring_means(device):
    rng = np.random.default_rng(0)
    lists = [rng.integers(50, size=k % 9) for k in range(50)]
    offset = np.concatenate([[0], np.cumsum([len(near) for near in lists])]).astype(np.int32)
    rings = Rings(device, 50, device.upload(offset), device.upload(np.concatenate(lists), np.int32))
    values = rng.normal(size=(50, 3))
    assert np.allclose(rings.means(values.T, 1).T, twin.ring_means(values, lists), atol=1e-6)
    assert np.allclose(rings.means(values.T, 2).T, twin.ring_means(twin.ring_means(values, lists), lists), atol=1e-6)


def test_move_vertices(net, monkeypatch):
    monkeypatch.setattr(smooth_mesh, "MOVES", 1)
    rng = np.random.default_rng(3)
    vertices = net.vertices + 0.03 * rng.normal(size=net.vertices.shape).astype(np.float32)  # some faces fold over
    wanted = twin.guided_planes(bumpy(noise=0)[0], bumpy()[1])[:, :3]
    wanted = np.tile(wanted.mean(axis=0) / np.linalg.norm(wanted.mean(axis=0)), (len(net.faces), 1))
    kind = np.where(net.border, 1, 3).astype(np.uint8)
    kind[::5] = 0
    found = smooth_mesh.move_vertices(net, vertices, wanted.T, kind)
    plain = twin.move_vertices(vertices, net.faces, wanted, kind, smooth_mesh.RELAX)
    assert np.allclose(found, plain, atol=1e-5) and (found[::5] == vertices[::5]).all()
    assert np.abs(plain - twin.move_vertices(vertices, net.faces, wanted, np.minimum(kind, 1), 0)).max() > 1e-3


def test_place_vertices(net, samples):
    found = smooth_fits.blended(smooth_fits.guided_fits(samples, 3 * samples.spacing, 6.0),
                                Queries(samples.count, samples.padded, samples.sorted)).copy()
    kind = np.ones(len(net.used), np.uint8)
    kind[0] = 0
    moved = smooth_mesh.place_vertices(net, samples, found, kind)
    centroids = net.device.download(samples.sorted)[:3, :samples.count].T
    normals = found[1:4].T
    plain = twin.place_vertices(net.vertices, net.faces, normals, centroids - found[0][:, None] * normals)
    assert np.allclose(moved[1:], plain[1:], atol=1e-5) and (moved[0] == net.vertices[0]).all()
