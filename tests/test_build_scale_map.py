"""Building scale maps: closed forms, exact hits of every ray, orders, layers, centres, odd input."""

import logging

import numpy as np
import pytest
from conftest import scan_path
from reference import scale_map as twin
from reference.trace_rays import unit

import clsurf
from clsurf import Mesh
from clsurf.build.bounding import bounding_sphere
from clsurf.errors import Cancelled, InputError
from clsurf.surface.cube import texel_directions


@pytest.fixture(params=[16, 1])
def lanes(request, device, monkeypatch):
    """Both kernel forms."""
    monkeypatch.setattr(device, "lanes", request.param)
    return request.param


def box_mesh(low=(-1, -1, -1), high=(1, 1, 1)):
    """A closed box of twelve triangles."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return Mesh(np.asarray(low) + corners * (np.asarray(high, float) - low), np.array(faces))


def box_distance(d, low, high):
    with np.errstate(divide="ignore"):
        return np.min(np.where(d > 0, high / d, np.where(d < 0, low / d, np.inf)), axis=-1)


def icosphere_mesh(level, center=(0, 0, 0), axes=1.0):
    v, f = twin.icosphere(level)
    return Mesh(v * np.asarray(axes) + center, f)


# Closed forms ---------------------------------------------------------------------------------------------------------


def test_centred_sphere_is_one_everywhere(device, lanes):
    surface = clsurf.build_scale_map(icosphere_mesh(5, (1e5, -2e5, 3)), size=64, device=device)
    assert (surface.scales == 255).all() and surface.valid.all()
    assert surface.radius == pytest.approx(1, abs=1e-7) and surface.multiple_share == 0
    assert np.abs(surface.center - (1e5, -2e5, 3)).max() < 1e-6


def test_offset_sphere_and_ellipsoid_in_16_bits(device):
    """Lambda at the texels within 1e-4 of the closed forms."""
    for mesh, exact in (
            (icosphere_mesh(7, (0.3, -0.2, 0.1)), lambda d: twin.sphere_distance(d, (0.3, -0.2, 0.1))),
            (icosphere_mesh(7, axes=(1, 0.75, 0.5)), lambda d: twin.ellipsoid_distance(d, (1, 0.75, 0.5)))):
        surface = clsurf.build_scale_map(mesh, size=32, center=(0, 0, 0), bits=16, device=device)
        wanted = exact(texel_directions(32)) / surface.radius
        assert np.abs(surface.lambdas[0] - wanted).max() < 1e-4


def test_order_two_of_lambda_between_texels(device):
    """A box off its centre, whose mesh is exact: directions away from its creases, sizes 32 to 256."""
    low, high = np.array([-0.7, -1, -0.9]), np.array([1, 0.8, 0.6])
    d = unit(np.random.default_rng(0).normal(size=(60000, 3)))
    with np.errstate(divide="ignore"):
        both = np.sort(np.where(d > 0, high / d, low / d), axis=1)
    d = d[both[:, 1] > 1.15 * both[:, 0]]
    errors = []
    for size in (32, 64, 128, 256):
        surface = clsurf.build_scale_map(box_mesh(low, high), size=size, center=(0, 0, 0), bits=32, device=device)
        errors.append(np.abs(twin.filtered(surface, d) * surface.radius - box_distance(d, low, high)).max())
    assert len(d) > 20000 and (np.log2(np.divide(errors[:-1], errors[1:])) > 1.8).all() and errors[-1] < 1e-4, errors


@pytest.mark.parametrize(("hit", "layers"), (("outermost", 3), ("innermost", 2)))
def test_scale_hits(device, lanes, hit, layers):
    """Random triangles, some around the centre and some through cube edges: lists, layers and counts of the twin."""
    rng = np.random.default_rng(3)
    corners = np.concatenate([rng.normal(size=(60, 1, 3)) + rng.normal(0, 0.4, (60, 3, 3)),
                              rng.normal(0, 2, (20, 3, 3))])
    vertices, faces, size = corners.reshape(-1, 3).astype(np.float32), np.arange(240).reshape(-1, 3), 9
    radius = float(np.linalg.norm(vertices, axis=1).max())
    surface = clsurf.build_scale_map(Mesh(vertices, faces), size, (0, 0, 0), radius, bits=32, layers=layers, hit=hit,
                                     normals=True, device=device)
    lists = twin.scale_hits(vertices / radius, faces, size)
    distance, triangle = twin.pick_scale_hits(lists, layers, hit == "outermost")
    got, normals = surface.lambdas.reshape(layers, -1), surface.unit_normals().reshape(layers, -1, 3)
    clear = np.isnan(got) == np.isnan(distance)  # a ray within rounding of an edge may go either way
    assert clear.mean() > 0.999 and np.nanmax(np.abs(got - distance)[clear]) < 1e-5
    counts = np.array([len(hits) for hits in lists])
    assert surface.multiple_share == pytest.approx(
        ((counts > 1).reshape(6, size, size) * clsurf.surface.cube.texel_angles(size)).sum(), abs=0.01)
    a, b, c = np.moveaxis(vertices[faces[np.maximum(triangle, 0)]].astype(float), 2, 0)
    plane = unit(np.cross(b - a, c - a))
    known = clear & (triangle >= 0)
    assert np.abs(np.abs((normals * plane).sum(-1))[known]).min() > 0.9995
    assert ((normals * texel_directions(size).reshape(-1, 3)).sum(-1)[known] > -0.01).all()


def test_rays_through_edges_and_vertices_neither_leak_nor_count_twice(device, lanes):
    """Texel rays that run exactly along edges and through vertices of a closed mesh."""
    size = 9  # odd: rays along the axes and diagonals of the box
    surface = clsurf.build_scale_map(box_mesh(), size, center=(0, 0, 0), layers=2, device=device)
    assert surface.valid[0].all() and not surface.valid[1].any() and surface.multiple_share == 0
    nested = Mesh(np.concatenate([box_mesh().vertices, 0.5 * box_mesh().vertices]),
                  np.concatenate([box_mesh().faces, box_mesh().faces + 8]))
    both = clsurf.build_scale_map(nested, size, center=(0, 0, 0), layers=3, bits=32, device=device)
    assert both.valid[:2].all() and not both.valid[2].any() and both.multiple_share == pytest.approx(1)
    assert np.allclose(both.scales[0], 2 * both.scales[1], rtol=1e-6)


def test_layers_and_hits_agree(device):
    """Innermost hits are the outermost ones in reverse where a ray has two; share and holes of an open torus."""
    torus = _torus_mesh()
    out = clsurf.build_scale_map(torus, 24, layers=2, bits=32, device=device)
    inner = clsurf.build_scale_map(torus, 24, layers=2, bits=32, hit="innermost", device=device)
    two = out.valid[1]
    assert 0.2 < two.mean() < 0.8 and np.array_equal(two, inner.valid[1])
    assert np.allclose(out.scales[0][two], inner.scales[1][two])
    assert np.allclose(out.scales[1][two], inner.scales[0][two])
    # Rays within asin(minor / major) of the plane meet the tube twice: a share of minor / major of the sphere.
    assert out.multiple_share == pytest.approx(0.4, abs=0.02)
    assert (out.valid[0] == two).all() and out.hole_share == pytest.approx(1 - two.mean())


def _torus_mesh(n=96, m=48, major=1.0, minor=0.4):
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, n, endpoint=False), np.linspace(0, 2 * np.pi, m, endpoint=False),
                       indexing="ij")
    points = np.stack([(major + minor * np.cos(v)) * np.cos(u), (major + minor * np.cos(v)) * np.sin(u),
                       minor * np.sin(v)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    at = lambda i, j: i % n * m + j % m  # noqa: E731
    a, b, c, d = at(i, j).ravel(), at(i + 1, j).ravel(), at(i, j + 1).ravel(), at(i + 1, j + 1).ravel()
    return Mesh(points, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]))


# Normals, sources, centres --------------------------------------------------------------------------------------------


def test_stored_normals_are_the_models(device):
    """Of faces, and interpolated between vertex normals, against the sphere's own."""
    v, f = twin.icosphere(4)
    plain, smooth = (clsurf.build_scale_map(mesh, 24, (0.5, 0.2, 0.2), normals=True, device=device)
                     for mesh in (Mesh(v + 0.25, f), Mesh(v + 0.25, f, normals=v)))
    exact = unit(smooth.positions()[0] - 0.25)
    angle = lambda s: np.degrees(np.arccos((s.unit_normals()[0] * exact).sum(-1).clip(-1, 1)))  # noqa: E731
    assert angle(plain).max() < 4 and angle(smooth).max() < 1


def test_surfaces_patches_and_placed_ones(device, lanes):
    """SLIM surfaces by rays, patches and moved meshes as triangles: the same sphere."""
    cloud = clsurf.models.sphere(4000)
    slim = clsurf.build_slim(cloud, error=0.005, device=device)
    turn = np.array([[0, -2, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1.0]])
    for thing, middle, radius in ((slim, (0, 0, 0), 1), (slim.moved(turn), (5, 6, 7), 2),
                                  (clsurf.models.perfect_sphere(), (0, 0, 0), None),
                                  (clsurf.surface.placed.placed(icosphere_mesh(4), turn), (5, 6, 7), 2)):
        surface = clsurf.build_scale_map(thing, 16, center=middle, normals=True, device=device)
        assert surface.valid.all() and surface.scales.min() >= 252
        assert radius is None or surface.radius == pytest.approx(radius, rel=2e-3)
        n = surface.unit_normals()[0]
        assert (n * texel_directions(16)).sum(-1).min() > 0.995


def test_radius_leaves_out_what_lies_outside(device):
    nested = Mesh(np.concatenate([box_mesh().vertices, 0.5 * box_mesh().vertices]),
                  np.concatenate([box_mesh().faces, box_mesh().faces + 8]))
    surface = clsurf.build_scale_map(nested, 16, (0, 0, 0), radius=0.9, bits=32, device=device)
    assert surface.valid.all() and surface.radius == 0.9 and surface.multiple_share == 0
    assert np.allclose(surface.scales[0] * 0.9, 0.5 * box_distance(texel_directions(16), -np.ones(3), np.ones(3)))


def test_visible_finds_a_centre_that_sees_more(device, caplog):
    """A sphere with a bump on a thin neck: from the middle of the box much is hidden."""
    scene = Mesh(np.concatenate([box_mesh((-1, -1, -1), (1, 1, 1)).vertices,
                                 box_mesh((2, 2, -1), (2.5, 2.5, 1)).vertices]),
                 np.concatenate([box_mesh().faces, box_mesh().faces + 8]))
    with caplog.at_level(logging.WARNING, "clsurf"):
        default = clsurf.build_scale_map(scene, 24, device=device)
        assert "more than once" in caplog.text
    seen = clsurf.build_scale_map(scene, 24, center="visible", device=device)
    once = lambda s: 1 - s.multiple_share - s.hole_share  # noqa: E731
    assert once(seen) > once(default) + 0.05


def test_bounding_sphere():
    rng = np.random.default_rng(0)
    for points, center, radius in (
            (unit(rng.normal(size=(500, 3))) * 3 + 7, (7, 7, 7), 3), (np.array([[1.0, 2, 3]]), (1, 2, 3), 0),
            (np.array([[0.0, 0, 0], [2, 0, 0], [1, 0.1, 0]]), (1, 0, 0), 1), (np.zeros((5, 3)), (0, 0, 0), 0),
            (box_mesh().vertices + np.array([1e6, 0, 0]), (1e6, 0, 0), 3**0.5)):
        got, r = bounding_sphere(points)
        assert np.abs(got - center).max() < 0.02 + 1e-9 and r == pytest.approx(radius, rel=1e-3, abs=1e-12)
        assert (np.linalg.norm(points - got, axis=1) <= r * (1 + 1e-9)).all()


def test_bound_holds(device):
    mesh = icosphere_mesh(4, axes=(1, 0.7, 0.8))
    surface = clsurf.build_scale_map(mesh, 32, device=device)
    d = mesh.vertices - surface.center
    gap = np.abs(twin.filtered(surface, d) * surface.radius - np.linalg.norm(d, axis=1))
    assert surface.bound_share == 0.95 and np.mean(gap <= surface.bound * (1 + 1e-6)) >= 0.95
    assert surface.bound < 0.01
    assert surface.diagonal == pytest.approx(np.linalg.norm(np.ptp(mesh.vertices, axis=0)), 1e-5)


@pytest.mark.parametrize("options", (
    dict(size=0), dict(size=2.5), dict(size=10**6), dict(bits=12), dict(layers=0), dict(hit="first"), dict(radius=-1),
    dict(center="middle"), dict(center=(0, 0)), dict(center=(0, 0, np.nan)), dict(center=(50, 50, 50), radius=1.0)))
def test_bad_options(device, options):
    with pytest.raises(InputError, match=r"expected|meets"):
        clsurf.build_scale_map(box_mesh(), **{"size": 8} | options, device=device)


def test_bad_input(device, tmp_path):
    for thing in (Mesh(np.zeros((3, 3))), Mesh(np.full((3, 3), np.nan), [[0, 1, 2]]), clsurf.models.sphere(100), 7,
                  Mesh(np.ones((3, 3)), [[0, 1, 2]])):
        with pytest.raises(InputError):
            clsurf.build_scale_map(thing, 8, device=device)
    with pytest.raises(InputError):
        clsurf.build_scale_map(tmp_path / "missing.ply", device=device)
    with pytest.raises(Cancelled):
        clsurf.build_scale_map(box_mesh(), 8, progress=lambda *_: False, device=device)


def test_order_of_faces_does_not_matter(device, lanes):
    mesh = _torus_mesh(24, 12)
    order = np.random.default_rng(0).permutation(len(mesh.faces))
    one, two = (clsurf.build_scale_map(m, 12, layers=2, bits=32, device=device)
                for m in (mesh, Mesh(mesh.vertices, mesh.faces[order], origin=mesh.origin)))
    assert np.array_equal(one.scales, two.scales) and np.array_equal(one.valid, two.valid)


def test_bunny(device):
    mesh = clsurf.load(scan_path("bunny/bunny.obj"))
    surface = clsurf.build_scale_map(mesh, device=device)
    assert surface.nbytes == 6 * 128 * 128 * 2 and 0.02 < surface.multiple_share < 0.12 and surface.hole_share < 0.02
