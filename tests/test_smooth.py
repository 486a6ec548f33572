"""Smoothing: what must stay stays, noise falls by known factors, and nothing depends on where or how a scan stands."""

import dataclasses

import numpy as np
import pytest
from conftest import scan_path
from reference.surfaces import sphere_points

import clsurf
from clsurf.analysis import smooth_mesh
from clsurf.analysis.smooth_fits import choose_radii
from clsurf.cli import main
from clsurf.errors import Cancelled, InputError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh


def sheet(n=50, seed=0):
    """An even triangulation of a square of n x n vertices with edges of about 1: vertices, faces, inner vertices."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:n, :n].astype(float)
    vertices = np.stack([x + 0.5 * (y % 2), y * np.sqrt(3) / 2, 0 * x], axis=-1).reshape(-1, 3)
    vertices[:, :2] += 0.1 * rng.normal(size=(n * n, 2))
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]
    even = np.stack([np.stack([a, b, c], axis=-1), np.stack([b, d, c], axis=-1)], axis=2)
    odd = np.stack([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)], axis=2)
    faces = np.where((np.arange(n - 1) % 2 == 0)[:, None, None, None], even, odd).reshape(-1, 3)
    border = np.ones((n, n), bool)
    border[1:-1, 1:-1] = False
    return vertices, faces, ~border.ravel()


def ball(n=4000, noise=0.0, seed=0):
    """A closed mesh of a unit sphere with noise."""
    from scipy.spatial import ConvexHull
    points, _ = sphere_points(n)
    faces = ConvexHull(points).simplices
    a, b, c = (points[faces[:, k]] for k in range(3))
    outward = (np.cross(b - a, c - a) * a).sum(axis=1) > 0
    faces = np.where(outward[:, None], faces, faces[:, ::-1])
    return points + noise * np.random.default_rng(seed).normal(size=points.shape), faces


def box(n=24, noise=0.0, seed=0):
    """A cube of side 2 with n x n squares a side, and the distance function of its surface."""
    g = np.linspace(-1, 1, n + 1)
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    quad = np.stack([i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]], axis=-1).reshape(-1, 4)
    vertices, faces = [], []
    for axis in range(3):
        for side in (-1, 1):
            p = np.zeros((n + 1, n + 1, 3))
            p[..., axis] = side
            p[..., (axis + 1) % 3], p[..., (axis + 2) % 3] = np.meshgrid(g, g, indexing="ij")
            q = (quad if side > 0 else quad[:, ::-1]) + len(vertices) * (n + 1) ** 2
            vertices.append(p.reshape(-1, 3))
            faces += [q[:, [0, 1, 2]], q[:, [0, 2, 3]]]
    vertices, inverse = np.unique(np.concatenate(vertices).round(9), axis=0, return_inverse=True)
    faces = inverse.ravel()[np.concatenate(faces)]
    return vertices + noise * np.random.default_rng(seed).normal(size=vertices.shape), faces, vertices


def rms(values):
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


# What must not change -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["normals", "quadrics", "projection"])
def test_a_clean_plane_stays(device, method):
    vertices, faces, _ = sheet(20)
    clean = clsurf.smooth(Mesh(vertices, faces), method=method, device=device)
    assert np.abs(clean.vertices + clean.origin - vertices).max() < 1e-4


@pytest.mark.parametrize(("method", "limit"), [("normals", 1e-3), ("projection", 1e-3), ("quadrics", 3e-3)])
def test_a_clean_sphere_nearly_stays(device, method, limit):
    points, faces = ball()
    clean = clsurf.smooth(Mesh(points, faces), method=method, device=device)
    assert np.abs(np.linalg.norm(clean.vertices + clean.origin, axis=1) - 1).max() < limit
    cloud = clsurf.smooth(PointCloud(points, normals=points), device=device)
    assert np.abs(np.linalg.norm(cloud.points + cloud.origin, axis=1) - 1).max() < 1e-3


def test_connectivity_and_attributes_are_kept(device):
    vertices, faces = ball(500, 0.01)
    rng = np.random.default_rng(0)
    mesh = Mesh(vertices, faces, normals=vertices, uv=rng.random((500, 2)), colors=rng.integers(255, size=(500, 4)),
                texture=np.zeros((2, 2, 4), np.uint8), attributes={"heat": np.arange(500)})
    clean = clsurf.smooth(mesh, device=device)
    assert clean.faces is mesh.faces or (clean.faces == mesh.faces).all()
    assert (clean.uv == mesh.uv).all() and (clean.colors == mesh.colors).all() and clean.texture is mesh.texture
    assert (clean.attributes["heat"] == np.arange(500)).all() and (clean.origin == mesh.origin).all()
    assert np.allclose(np.linalg.norm(clean.normals, axis=1), 1, atol=1e-5)
    assert (clean.normals * vertices).sum(axis=1).min() > 0.9
    cloud = clsurf.smooth(PointCloud(vertices, colors=mesh.colors, attributes={"heat": np.arange(500)}), device=device)
    assert cloud.normals is None and (cloud.colors == mesh.colors).all() and len(cloud.points) == 500


def test_strength_0_returns_the_scan(device):
    mesh = Mesh(*ball(200, 0.01))
    assert clsurf.smooth(mesh, strength=0, device=device) is mesh
    assert clsurf.smooth(mesh, iterations=0, device=device) is mesh


def test_borders(device):
    vertices, faces, inside = sheet(30)
    vertices[:, 2] += 0.15 * np.random.default_rng(1).normal(size=len(vertices))
    mesh = Mesh(vertices, faces)
    fixed = clsurf.smooth(mesh, fixed_border=True, device=device)
    assert (fixed.vertices == mesh.vertices)[~inside].all() and rms(fixed.vertices[inside, 2]) < 0.08
    clean = clsurf.smooth(mesh, device=device)
    moved = (clean.vertices - mesh.vertices)[~inside]
    assert rms(moved[:, :2]) < 0.03 and rms(clean.vertices[~inside, 2]) < 0.12  # the outline keeps its shape


# How much noise goes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "left"), [("normals", 0.17), ("quadrics", 0.17), ("projection", 0.17)])
def test_a_noisy_plane_becomes_flat(device, method, left):
    vertices, faces, inside = sheet()
    noise = 0.2 * np.random.default_rng(1).normal(size=len(vertices))
    vertices[:, 2] = noise
    clean = clsurf.smooth(Mesh(vertices, faces), method=method, device=device)
    heights = (clean.vertices + clean.origin)[:, 2]
    # Noise of less than a radius goes, longer waves stay: a disc of 7.3 edges has the mean of 190 vertices.
    assert rms(heights[inside]) < left * 0.2
    assert np.abs(clean.vertices + clean.origin - vertices)[inside, :2].max() < 0.3


def test_a_noisy_cloud_becomes_flat(device):
    vertices, _, inside = sheet()
    vertices[:, 2] = 0.2 * np.random.default_rng(1).normal(size=len(vertices))
    clean = clsurf.smooth(PointCloud(vertices, normals=np.tile([0, 0, 1.0], (len(vertices), 1))), device=device)
    assert rms((clean.points + clean.origin)[inside, 2]) < 0.17 * 0.2
    assert np.degrees(np.arccos(clean.normals[inside, 2].clip(-1, 1))).mean() < 2
    unoriented = clsurf.smooth(PointCloud(vertices), device=device)
    assert rms((unoriented.points + unoriented.origin)[inside, 2]) < 0.2 * 0.2


def test_strength_and_iterations_smooth_more(device):
    vertices, faces, inside = sheet(40)
    vertices[:, 2] = 0.2 * np.random.default_rng(1).normal(size=len(vertices))
    mesh = Mesh(vertices, faces)
    left = lambda clean: rms(clean.vertices[inside, 2] + mesh.origin[2])  # noqa: E731
    errors = [left(clsurf.smooth(mesh, strength=s, device=device)) for s in (0.25, 0.5, 1, 1.5)]
    assert errors[0] < 0.18 and (np.diff(errors) < 0).all()
    assert errors == [left(clsurf.smooth(mesh, strength=s, device=device)) for s in (0.25, 0.5, "auto", 1.5)]
    twice = clsurf.smooth(mesh, iterations=2, device=device)
    again = clsurf.smooth(clsurf.smooth(mesh, device=device), device=device)
    assert (twice.vertices == again.vertices).all() and left(twice) < errors[2]


def test_the_features_of_a_box_are_kept(device):
    noisy, faces, exact = box(noise=0.012)
    clean = clsurf.smooth(Mesh(noisy, faces), device=device)
    shape = clean.vertices + clean.origin
    corner_or_edge = (np.abs(exact) > 0.999).sum(axis=1) > 1
    assert rms(np.abs(shape).max(axis=1) - 1) < 0.25 * 0.012
    # Edges stay edges: none is rounded by more than the noise was, over a spacing of 1/12.
    assert rms((shape - exact)[corner_or_edge]) < 0.012
    normal = lambda v: np.cross(v[faces[:, 1]] - v[faces[:, 0]], v[faces[:, 2]] - v[faces[:, 0]])  # noqa: E731
    n = normal(shape)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.abs(n).max(axis=1).clip(-1, 1)))
    assert angle.mean() < 2.5 and np.percentile(angle, 99) < 20


def test_noise_and_radii_are_found(device):
    vertices, faces, _ = sheet(60)
    vertices[:, 2] = 0.2 * np.random.default_rng(1).normal(size=len(vertices))
    net, _ = smooth_mesh.net_of(vertices.astype(np.float32), faces, device)
    flat, factor = smooth_mesh.guide_and_radii(net)
    found = choose_radii(flat.samples, flat.queries, net.rings, flat.sharp)
    assert found.noise * net.unit == pytest.approx(0.2, rel=0.1)
    assert np.median(factor) > 6 and flat.sharp == smooth_mesh.SHARP
    # Waves as long as 10 edges and 5 times the noise do not let the radius grow.
    vertices[:, 2] += np.sin(vertices[:, 0] * 0.6)
    waves, factor = smooth_mesh.guide_and_radii(smooth_mesh.net_of(vertices.astype(np.float32), faces, device)[0])
    assert np.median(factor) < 4.5 and waves.sharp == smooth_mesh.SHARP
    cube, _ = smooth_mesh.guide_and_radii(smooth_mesh.net_of(*box(noise=0.012)[:2], device)[0])
    assert cube.sharp == smooth_mesh.SHARP_CAD


def test_noise_that_differs_from_place_to_place(device):
    points, faces = ball(4000)
    rough = points[:, 2] < 0
    noise = np.where(rough, 0.015, 0.0015)[:, None] * np.random.default_rng(3).normal(size=(4000, 1))
    clean = clsurf.smooth(Mesh(points * (1 + noise), faces), device=device)
    error = np.linalg.norm(clean.vertices + clean.origin, axis=1) - 1
    assert rms(error[points[:, 2] > 0.2]) < 0.0009 and rms(error[points[:, 2] < -0.2]) < 0.0055


def test_folded_faces_unfold(device):
    vertices, faces, inside = sheet(30)
    rng = np.random.default_rng(2)
    vertices += 0.3 * rng.normal(size=vertices.shape)
    normal_z = lambda v: np.cross(v[faces[:, 1]] - v[faces[:, 0]], v[faces[:, 2]] - v[faces[:, 0]])[:, 2]  # noqa: E731
    assert (normal_z(vertices) < 0).sum() > 40
    clean = clsurf.smooth(Mesh(vertices, faces), device=device)
    inner = inside[faces].all(axis=1)
    assert (normal_z(clean.vertices.astype(float))[inner] < 0).sum() <= 4


# Where and how a scan stands ------------------------------------------------------------------------------------------


def similarity(seed=4):
    rotation, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return rotation * np.sign(np.linalg.det(rotation)), np.array([3.0e6, -4.0e5, 12.0]), 7.3


@pytest.mark.parametrize("kind", ["mesh", "cloud"])
def test_moved_turned_scaled_and_shuffled(device, kind):
    points, faces = ball(2000, 0.015)
    rotation, shift, scale = similarity()
    order = np.random.default_rng(5).permutation(len(points))
    place = np.argsort(order)
    if kind == "mesh":
        make = lambda p: Mesh(p, faces)  # noqa: E731
        other = Mesh((points @ rotation.T * scale + shift)[order], place[faces][::-1])
    else:
        make = lambda p: PointCloud(p, normals=points)  # noqa: E731
        other = PointCloud((points @ rotation.T * scale + shift)[order], normals=(points @ rotation.T)[order])
    plain = clsurf.smooth(make(points), device=device)
    plain = plain.points + plain.origin
    other = clsurf.smooth(other, device=device)
    back = ((other.points + other.origin)[place] - shift) @ rotation / scale
    # Only the choice of the surfels' centres along the curve differs.
    assert rms(back - plain) < 0.15 * rms(plain - points)
    moved = clsurf.smooth(make(points + shift), device=device)
    assert rms(moved.points + moved.origin - shift - plain) < 1e-2 * rms(plain - points)


def test_same_input_same_bytes(device):
    mesh = Mesh(*ball(1500, 0.015))
    assert (clsurf.smooth(mesh, device=device).vertices == clsurf.smooth(mesh, device=device).vertices).all()


# Odd input ------------------------------------------------------------------------------------------------------------


def test_odd_meshes(device):
    points, faces = ball(800, 0.01)
    points = points.astype(np.float32)
    usual = clsurf.smooth(Mesh(points, faces), device=device).vertices
    # Isolated vertices, faces without area, a face twice, an edge of three faces, NaN.
    extra = np.array([[9.0, 9, 9], [np.nan, 0, 0], [1.2, 0, 0]])
    more = np.array([[0, 0, 1], [5, 5, 5], faces[0], [faces[3, 0], faces[3, 1], 802], [0, 1, 801]])
    mesh = Mesh(np.concatenate([points, extra.astype(np.float32)]), np.concatenate([faces, more]))
    clean = clsurf.smooth(mesh, device=device)
    assert np.isfinite(clean.vertices[:801]).all() and (clean.vertices[800] == mesh.vertices[800]).all()
    assert np.isnan(clean.vertices[801]).any() and np.isfinite(clean.vertices[802]).all()
    assert rms(np.linalg.norm(clean.vertices[:800], axis=1) - 1) < 0.008
    # A vertex far away changes nothing else.
    far = Mesh(np.concatenate([points, [[1e5, 0, 0]]]).astype(np.float32), np.concatenate([faces, [[0, 1, 800]]]))
    assert rms(clsurf.smooth(far, device=device).vertices[2:800] - usual[2:]) < 2e-3
    # Vertices at the same place (texture seams) move together.
    split = Mesh(points[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    assert rms(clsurf.smooth(split, device=device).vertices - usual[faces.ravel()]) < 2e-3


@pytest.mark.parametrize("count", [1, 2, 3, 4])
@pytest.mark.parametrize("method", ["normals", "quadrics", "projection"])
def test_a_few_faces(device, count, method):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])[:count]
    clean = clsurf.smooth(Mesh(vertices, faces), method=method, device=device)
    assert np.isfinite(clean.vertices).all() and np.abs(clean.vertices + clean.origin - vertices).max() < 1


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 8, 17])
def test_a_few_points(device, count):
    points = np.random.default_rng(count).random((count, 3))
    for cloud in (PointCloud(points), PointCloud(points, normals=np.tile([0, 0, 1.0], (count, 1))), Mesh(points)):
        clean = clsurf.smooth(cloud, device=device)
        assert type(clean) is type(cloud) and clean.points.shape == (count, 3)
        assert np.isfinite(clean.points).all() and (not count or np.abs(clean.points - cloud.points).max() < 1)
    same = clsurf.smooth(PointCloud(np.ones((count, 3))), device=device)
    assert (same.points + same.origin == 1).all()


def test_odd_clouds(device):
    points, _ = sphere_points(1000)
    points = np.concatenate([points, points[:50], [[np.nan] * 3, [np.inf, 0, 0]]]).astype(np.float32)
    clean = clsurf.smooth(PointCloud(points), device=device)
    assert (clean.points[1000:1050] == clean.points[:50]).all()
    assert not np.isfinite(clean.points[1050:]).all(axis=1).any()
    assert np.abs(np.linalg.norm(clean.points[:1000], axis=1) - 1).max() < 5e-3
    empty = np.zeros((len(points), 3))
    assert np.isfinite(clsurf.smooth(PointCloud(points, normals=empty), device=device).points[:1050]).all()


@pytest.mark.parametrize("options", [{"strength": -1}, {"strength": "much"}, {"strength": np.nan}, {"iterations": -1},
                                     {"iterations": 1.5}, {"method": "magic"}])
def test_refusals(options):
    with pytest.raises(InputError, match=next(iter(options))):
        clsurf.smooth(Mesh(*ball(50)), **options)
    with pytest.raises(InputError, match="faces"):
        clsurf.smooth(PointCloud(np.eye(3)), method="quadrics")
    with pytest.raises(InputError, match="expected a Mesh"):
        clsurf.smooth(np.eye(3))


def test_progress_can_stop(device):
    seen = []
    clsurf.smooth(Mesh(*ball(100)), progress=lambda *p: seen.append(p), device=device)
    assert seen[0][1] == 0 and seen[-1][1] == 1
    with pytest.raises(Cancelled):
        clsurf.smooth(Mesh(*ball(100)), progress=lambda *_: False, device=device)


# A real pair, and the command -----------------------------------------------------------------------------------------


def test_fandisk(device):
    noisy = clsurf.load(scan_path("denoise/Fandisk0.3/Noisy.obj"))
    exact = clsurf.load(scan_path("denoise/Fandisk0.3/Original.obj"))
    clean = clsurf.smooth(noisy, device=device)
    diagonal = np.linalg.norm(np.diff(exact.bounds, axis=0))
    vertex = lambda m: m.vertices + m.origin - (exact.vertices + exact.origin)  # noqa: E731
    assert rms(np.linalg.norm(vertex(noisy), axis=1)) / diagonal > 0.0042
    assert rms(np.linalg.norm(vertex(clean), axis=1)) / diagonal < 0.0014


def test_command(device, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "Intel" in device.platform_name else "pocl")
    points, faces = ball(500, 0.02)
    clsurf.save(Mesh(points, faces), tmp_path / "rough.ply")
    assert main(["smooth", str(tmp_path / "rough.ply"), "-o", str(tmp_path / "fine.ply"), "--strength", "1.2"]) == 0
    assert "moved by" in capsys.readouterr().err
    fine = clsurf.load(tmp_path / "fine.ply")
    assert len(fine.faces) == len(faces) and rms(np.linalg.norm(fine.vertices, axis=1) - 1) < 0.013
    assert main(["smooth", str(tmp_path / "rough.ply"), "-o", str(tmp_path / "fine.png")]) == 2
    assert main(["smooth", str(tmp_path / "rough.ply"), "-o", str(tmp_path / "x.ply"), "--strength", "much"]) == 2
    assert "strength" in capsys.readouterr().err and dataclasses.is_dataclass(fine)
