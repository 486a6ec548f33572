"""SLIM trees of other programs: cuts, conversion of polynomials, round trips, damaged files."""

import numpy as np
import pytest
from conftest import scan_path
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clsurf.errors import FileFormatError, InputError
from clsurf.io.slim2t import ALPHA, load_slim2t, save_slim2t
from clsurf.surface.cuts import cut, cut_surface
from clsurf.surface.slim import COEFFICIENTS, SlimSurface, frame_of_normals

EXPONENTS = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]


def random_surface(degree, count=60, seed=0, bend=0.5, **more):
    """A surface whose surfels bend by at most `bend` over their radius, in a hierarchy with shared children."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radii = rng.uniform(0.1, 2, count)
    power = np.array([1 - i - j for i, j in EXPONENTS[:COEFFICIENTS[degree]]])
    coefficients = rng.uniform(-bend, bend, (count, len(power))) * 0.3 * radii[:, None] ** power
    leaf = np.arange(count) >= count // 3
    inner = count // 3
    links = [sorted({*rng.integers(inner, count, 4).tolist(), *range(inner + k, count, inner)}) if k < inner else []
             for k in range(count)]
    return SlimSurface(degree, 0.01, rng.normal(size=(count, 3)), radii, normals, coefficients,
                       np.where(leaf, 2, 1), leaf, np.cumsum([0, *map(len, links)]),
                       np.array([c for link in links for c in link], int), rng.random(count) + ~leaf, **more)


def heights_on(surface, other):
    """Distance along the other surface's normals of points on `surface`'s patches, over the radius; (n, samples)."""
    rng = np.random.default_rng(9)
    s, t = rng.uniform(-0.6, 0.6, (2, 40))
    n, m = surface.normals.astype(float), other.normals.astype(float)
    (u, v), (u2, v2), r = frame_of_normals(n), frame_of_normals(m), surface.radii.astype(float)[:, None]
    value = lambda of, a, b: sum(of.coefficients[:, k, None].astype(float) * a**i * b**j  # noqa: E731
                                 for k, (i, j) in enumerate(EXPONENTS[:COEFFICIENTS[of.degree]]))
    a, b = s * r, t * r
    p = a[..., None] * u[:, None] + b[..., None] * v[:, None] + value(surface, a, b)[..., None] * n[:, None]
    w = np.einsum("nsi,ni->ns", p, m)
    return (w - value(other, np.einsum("nsi,ni->ns", p, u2), np.einsum("nsi,ni->ns", p, v2))) / r


def test_pai_cuts():
    surface = load_slim2t(scan_path("slim/pai.slim2t"))
    assert len(surface) == 49_367 and surface.leaf.sum() == 24_684 and not surface.oriented and surface.degree == 2
    assert len(surface.roots) == 1 and surface.level.max() == 19  # a tree of depth 18 below the root
    for error, count in ((1e-2, 1_636), (1e-3, 5_113), (1e-4, 15_957), (1e-5, 24_669)):
        assert len(cut(surface, error)) == count
        assert len(cut_surface(surface, error)) == count
    assert np.linalg.norm(surface.normals, axis=1) == pytest.approx(1, abs=1e-6)


def test_pai_polynomials_are_kept():
    """Leaves are planes and exact; balls inside are general quadrics, fitted over the shrunken ball."""
    path = scan_path("slim/pai.slim2t")
    surface = load_slim2t(path)
    rows = np.fromfile(path, "<f4", offset=12).reshape(-1, 16).astype(float)
    at = {tuple(row): k for k, row in enumerate(rows[:, [0, 1, 2, 13]].astype(np.float32).tolist())}
    order = [at[tuple(row)] for row in np.column_stack(
        [surface.centers, (surface.radii.astype(float) * ALPHA).astype(np.float32)]).astype(np.float32).tolist()
        if tuple(row) in at]
    assert len(order) > 0.5 * len(rows)  # the radius comes back to the last bit in most rows
    normals, (u, v) = surface.normals.astype(float), frame_of_normals(surface.normals.astype(float))
    rng = np.random.default_rng(0)
    rest = []
    for s, t in rng.uniform(-0.65, 0.65, (20, 2)):
        a, b = s * surface.radii * ALPHA, t * surface.radii * ALPHA
        h = sum(surface.coefficients[:, k] * a**i * b**j for k, (i, j) in enumerate(EXPONENTS[:6]))
        p = a[:, None] * u + b[:, None] * v + h[:, None] * normals
        rest.append(p)
    points = np.stack(rest, axis=1)
    level = np.ones(len(rows), int)
    parent = rows[:, 14].astype(int)
    for k in range(len(rows)):
        level[k] = level[parent[k] - 1] + 1 if parent[k] > 0 else 1
    rows = rows[np.argsort(level, kind="stable")]
    x, y, z = points.transpose(2, 0, 1)
    q = rows[:, 3:13, None].transpose(1, 0, 2)
    value = (q[0] * x * x + q[1] * y * y + q[2] * z * z + q[3] * x * y + q[4] * y * z + q[5] * z * x + q[6] * x
             + q[7] * y + q[8] * z + q[9])
    slope = np.sqrt((2 * q[0] * x + q[3] * y + q[5] * z + q[6])**2 + (2 * q[1] * y + q[3] * x + q[4] * z + q[7])**2
                    + (2 * q[2] * z + q[4] * y + q[5] * x + q[8])**2)
    rms = np.sqrt(np.mean((value / slope)**2, axis=1)) / rows[:, 13]
    assert rms[surface.leaf].max() < 1e-6
    assert np.median(rms[~surface.leaf]) < 1e-3 and np.percentile(rms[~surface.leaf], 90) < 0.03


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("bend", [0.5, 1e-3, 0])
def test_round_trip(tmp_path, degree, bend):
    surface = random_surface(degree, bend=bend, oriented=degree != 2)
    save_slim2t(surface, tmp_path / "a.slim2t")
    again = load_slim2t(tmp_path / "a.slim2t")
    assert again.degree == degree and again.oriented == surface.oriented
    np.testing.assert_array_equal(again.centers, surface.centers)
    np.testing.assert_allclose(again.radii, surface.radii, rtol=2e-7)
    np.testing.assert_array_equal(again.fit_error, surface.fit_error)
    np.testing.assert_array_equal(again.level, surface.level)
    assert np.abs(heights_on(surface, again)).max() < 3e-6
    first = {child: parent for parent in range(19, -1, -1)
             for child in surface.children[surface.child_offset[parent]:surface.child_offset[parent + 1]]}
    tree = load_slim2t(tmp_path / "a.slim2t")
    assert len(tree.children) == len(first)
    save_slim2t(tree, tmp_path / "b.slim2t")
    twice = load_slim2t(tmp_path / "b.slim2t")
    np.testing.assert_array_equal(twice.children, tree.children)
    np.testing.assert_array_equal(twice.child_offset, tree.child_offset)


def test_world_origin_is_written(tmp_path):
    surface = random_surface(2, origin=(100, 200, 300))
    save_slim2t(surface, tmp_path / "a.slim2t")
    np.testing.assert_allclose(load_slim2t(tmp_path / "a.slim2t").centers, surface.centers + surface.origin, rtol=1e-6)


def test_cut_counts_a_shared_child_once():
    surface = random_surface(2)
    assert np.array_equal(np.unique(cut(surface, -1)), cut(surface, -1))
    assert surface.leaf[cut(surface, -1)].all()
    assert set(cut(surface, 10)) == set(surface.roots) == set(range(20))
    assert cut(surface, 0.5).tolist() == list(range(20, 60))


def test_circle_and_bad_parents(tmp_path):
    rows = np.zeros((3, 16), "<f4")
    rows[:, 9], rows[:, 13] = 1, 1
    for parents in ([2, 3, 1], [-1, 5, 1], [-1, 0, 1], [-1, 2, 1], [-1, 1.5, 1], [-1, np.nan, 1]):
        rows[:, 14] = parents
        path = tmp_path / "a.slim2t"
        path.write_bytes(np.array([2, 3, 1], "<i4").tobytes() + rows.tobytes())
        with pytest.raises(FileFormatError):
            load_slim2t(path)


def test_children_before_parents(tmp_path):
    rows = np.zeros((3, 16), "<f4")
    rows[:, 9], rows[:, 13], rows[:, 0] = 1, 1, [0, 1, 2]
    rows[:, 14] = [3, 3, -1]
    path = tmp_path / "a.slim2t"
    path.write_bytes(np.array([-2, 3, 1], "<i4").tobytes() + rows.tobytes())
    surface = load_slim2t(path)
    assert surface.centers[:, 0].tolist() == [2, 0, 1] and surface.roots.tolist() == [0]
    assert surface.children.tolist() == [1, 2] and surface.level.tolist() == [1, 2, 2]


def test_nothing_to_write(tmp_path):
    with pytest.raises(InputError):
        save_slim2t(random_surface(2, 0), tmp_path / "a.slim2t")
    assert not list(tmp_path.iterdir())


@settings(max_examples=150, deadline=20000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.one_of(
    st.binary(min_size=1, max_size=200),
    st.tuples(st.integers(-4, 4), st.integers(-5, 2**31 - 1), st.integers(-5, 2**31 - 1), st.binary(max_size=300)).map(
        lambda t: np.array(t[:3], "<i4").tobytes() + t[3]),
    st.tuples(st.integers(1, 4), st.lists(st.floats(width=32), min_size=15, max_size=60)).map(
        lambda t: np.array([2, t[0], 0], "<i4").tobytes() + np.resize(np.array(t[1], "<f4"), 15 * t[0]).tobytes())))
def test_garbage_is_a_clear_error(tmp_path, data):
    path = tmp_path / "x.slim2t"
    path.write_bytes(data)
    try:
        load_slim2t(path)
    except FileFormatError as error:
        assert "\n" not in str(error)
