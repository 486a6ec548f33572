"""Scale maps as data, and interpolation on the cube's closed net."""

import pickle

import numpy as np
import pytest

import clsurf
from clsurf.surface import cube
from clsurf.surface.scale_map import ScaleMap, encoded, encoded_normals


def made(size=8, layers=1, bits=8, **more):
    """A map of a bumpy sphere."""
    d = cube.texel_directions(size)
    values = np.broadcast_to(0.8 + 0.15 * d[..., 0] * d[..., 2], (layers, 6, size, size))
    return ScaleMap((1e6, 2, 3), 2.5, encoded(values, bits), np.ones(values.shape, bool), **more)


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_faces_are_those_of_opengl():
    """Texel (row 0, column 0) and the middles of edges, from the tables of the OpenGL specification."""
    d = cube.texel_directions(1)[:, 0, 0]
    assert np.allclose(d, [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    fine = cube.texel_directions(101)
    for face, sc, tc in ((0, -2, -1), (1, 2, -1), (2, 0, 2), (3, 0, -2), (4, 0, -1), (5, -0.0, -1)):
        axis_s, axis_t = int(abs(sc)), int(abs(tc))
        sign_s = -1 if np.signbit(sc) else 1
        assert np.sign(fine[face, 50, 100, axis_s]) == sign_s
        assert np.sign(fine[face, 100, 50, axis_t]) == np.sign(tc)


@pytest.mark.parametrize("size", (1, 2, 5, 16))
def test_border_holds_the_partner_across_every_edge(size):
    index = cube.border_index(size)
    d = cube.texel_directions(size).reshape(-1, 3)
    at = np.concatenate([np.stack([index[:, 0, 1:-1], index[:, 1, 1:-1]]), np.stack([index[:, -1, 1:-1],
                        index[:, -2, 1:-1]]), np.stack([index[:, 1:-1, 0], index[:, 1:-1, 1]]),
                         np.stack([index[:, 1:-1, -1], index[:, 1:-1, -2]])], axis=2).reshape(2, -1)
    # Partners are mirror images in the plane through the edge, and the relation goes both ways.
    assert np.allclose(np.sort(np.abs(d[at[0]]), axis=1), np.sort(np.abs(d[at[1]]), axis=1))
    pairs = set(map(tuple, at.T.tolist()))
    assert all((b, a) in pairs for a, b in pairs) and len(pairs) == 24 * size


@pytest.mark.parametrize("size", (1, 2, 3, 8))
def test_interpolation_is_continuous_over_edges_and_corners(size):
    """Points a hair's breadth apart, across edges, at corners, and at the net's own seams, have the same value."""
    rng = np.random.default_rng(size)
    values, valid = rng.uniform(size=(6, size, size)), np.ones((6, size, size), bool)
    d = unit(rng.normal(size=(20000, 3)))
    near = d.copy()
    near[:12000, 1] = near[:12000, 0] * rng.choice([-1, 1], 12000)  # on edges
    near[:3000, 2] = near[:3000, 0] * rng.choice([-1, 1], 3000)     # at corners
    near[12000:] *= np.where(rng.uniform(size=(8000, 1)) < 0.5, 1, np.sign(near[12000:]))
    near = unit(near)
    step = 1e-7 * rng.normal(size=near.shape)
    one, _ = cube.interpolated(values, valid, near + step)
    two, _ = cube.interpolated(values, valid, near - step)
    assert np.abs(one - two).max() < 2e-6 * size
    assert np.isfinite(one).all() and one.min() >= values.min() - 1e-12 and one.max() <= values.max() + 1e-12


def test_interpolation_is_of_second_order_at_edges_too():
    """A smooth function between texels: a quarter of the error at half the spacing, also in the outer half texels."""
    rng = np.random.default_rng(0)
    f = lambda d: np.sin(2 * d[..., 0] + d[..., 1]) + d[..., 2] ** 2 * d[..., 0]  # noqa: E731
    d = unit(rng.normal(size=(40000, 3)))
    largest = np.sort(np.abs(d), axis=1)
    edge = largest[:, 1] / largest[:, 2] > 1 - 1 / 64
    errors = []
    for size in (16, 32, 64):
        got, _ = cube.interpolated(f(cube.texel_directions(size)), np.ones((6, size, size), bool), d)
        errors.append([np.abs(got - f(d))[part].max() for part in (edge, ~edge)])
    errors = np.array(errors)
    assert edge.sum() > 300 and (np.log2(errors[:-1] / errors[1:]) > 1.8).all(), errors


def test_holes_take_no_part_and_rule_where_they_weigh_more():
    values, valid = np.full((6, 8, 8), 0.7), np.ones((6, 8, 8), bool)
    values[0, 3, 3], valid[0, 3, 3] = np.nan, False
    d = cube.texel_directions(8)
    at = np.stack([d[0, 3, 3], d[0, 3, 4], unit(d[0, 3, 3] + 2 * d[0, 3, 4])])
    got, known = cube.interpolated(values, valid, at)
    assert known.tolist() == [False, True, True] and np.allclose(got[1:], 0.7)


def test_angles_add_up_to_the_sphere():
    assert 6 * cube.texel_angles(7).sum() == pytest.approx(1)


@pytest.mark.parametrize("bits", (8, 16, 32))
def test_codes_and_normals(bits):
    surface = made(bits=bits)
    d = cube.texel_directions(8)
    exact = 0.8 + 0.15 * d[..., 0] * d[..., 2]
    assert surface.bits == bits
    assert np.abs(surface.lambdas[0] - exact).max() <= {8: 0.5 / 255, 16: 0.5 / 65535, 32: 1e-7}[bits] + 1e-7
    normals = encoded_normals(np.broadcast_to(d, (1, 6, 8, 8, 3)))
    assert np.abs(np.degrees(np.arccos((made(normals=normals).unit_normals()[0] * d).sum(-1).clip(-1, 1)))).max() < 0.5


def test_plain_data(tmp_path):
    normals = encoded_normals(cube.texel_directions(8))  # of one layer, without its axis
    surface = made(bits=16, normals=normals, hit="innermost", multiple_share=0.25, bound=0.125, bound_share=0.99)
    low, high = surface.bounds
    assert (low < surface.center).all() and (high > surface.center).all() and (high - low < 5).all()
    assert surface.nbytes == 6 * 64 * (2 + 1 + 3) and "16 bits" in repr(surface) and "\n" not in repr(surface)
    moved = surface.moved(np.diag([2.0, 2, 2, 1]))
    assert np.allclose(moved.bounds, 2 * surface.bounds)
    clsurf.save(surface, tmp_path / "a.clsurf")
    for again in (pickle.loads(pickle.dumps(surface)), clsurf.load(tmp_path / "a.clsurf")):
        for name in ("center", "scales", "valid", "normals"):
            got, kept = getattr(again, name), getattr(surface, name)
            assert got.dtype == kept.dtype and np.array_equal(got, kept)
        assert (again.radius, again.hit, again.multiple_share, again.bound, again.bound_share) == \
            (2.5, "innermost", 0.25, 0.125, 0.99)


@pytest.mark.parametrize("wrong", (
    dict(radius=0), dict(radius=np.nan), dict(center=(0, 0)), dict(hit="nearest"),
    dict(scales=np.zeros((1, 6, 4, 4), np.int32)), dict(scales=np.zeros((6, 4, 4), np.uint8)),
    dict(scales=np.zeros((1, 6, 4, 5), np.uint8)), dict(valid=np.ones((1, 6, 4, 3), bool)),
    dict(scales=np.zeros((0, 6, 4, 4), np.uint8)), dict(scales=np.full((1, 6, 4, 4), np.nan, np.float32)),
    dict(normals=np.zeros((1, 6, 3, 4, 3), np.uint8))))
def test_wrong_arrays_are_refused(wrong):
    good = dict(center=(0, 0, 0), radius=1.0, scales=np.zeros((1, 6, 4, 4), np.uint8),
                valid=np.ones((1, 6, 4, 4), bool))
    ScaleMap(**good)
    with pytest.raises(ValueError, match=r"expected|radius"):
        ScaleMap(**good | wrong)
