"""Patches as plain data: the paper's sizes, nodes, boxes, cones, transparent nodes, the store."""

import pickle

import numpy as np
import pytest

import clsurf
from clsurf.build.quantize import quantized
from clsurf.surface.patch import PatchSurface, facet_cones


def bowls(count=3, size=(17, 9), colors=False, precise=False, seed=0):
    """Return patches over z = x^2 / 40 + y / 50 in random frames, and the nodes they were made from."""
    rng = np.random.default_rng(seed)
    frames = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    frames[:, 2] *= np.sign(np.linalg.det(frames))[:, None]
    origins = rng.normal(size=(count, 3)) * 5
    m, n = size
    i, j = np.tile(np.arange(m), n), np.repeat(np.arange(n), m)
    height = i ** 2 / 40 + j / 50
    heights = np.tile(height, count)
    heights[::7] = np.nan
    rgb = rng.integers(0, 255, (len(heights), 3)) if colors else None
    surface = quantized(origins, frames[:, 0] * 0.5, frames[:, 1] * 0.25, heights * 0.5, size, rgb, precise,
                        origin=(1e6, 0, 0))
    nodes = (origins[:, None] + i[:, None] * frames[:, None, 0] * 0.5 + j[:, None] * frames[:, None, 1] * 0.25
             + (height * 0.5)[:, None] * frames[:, None, 2]) + np.array([1e6, 0, 0])
    return surface, nodes.reshape(-1, 3), np.isfinite(heights)


@pytest.mark.parametrize(("patches", "megabytes"),
                         [(1526, 1.83), (1145, 1.37), (383, 0.45), (1128, 1.35), (2712, 3.24)])
def test_size_is_the_papers_arithmetic(patches, megabytes):
    ones = np.ones((patches, 1))
    surface = PatchSurface(np.zeros((patches, 3)), ones * [1, 0, 0], ones * [0, 1, 0], np.ones(patches), (17, 17),
                           np.zeros(patches * 289, np.int8), np.ones((patches * 289, 3), np.uint8))
    assert surface.nbytes == patches * (40 + 4 * 289)
    assert abs(surface.nbytes / 1e6 - megabytes) < 0.01 or abs(surface.nbytes / 2 ** 20 - megabytes) < 0.01


def test_perfect_sphere_fits_440_kilobytes():
    ones = np.ones((1362, 1))
    surface = PatchSurface(np.zeros((1362, 3)), ones * [1, 0, 0], ones * [0, 1, 0], np.full(1362, 0.01), (17, 17),
                           np.zeros(1362 * 289, np.int8), color=(255, 255, 255))
    assert surface.nbytes == 1362 * 329 < 450_560  # 440 KB


@pytest.mark.parametrize("colors", [False, True])
@pytest.mark.parametrize("precise", [False, True])
def test_nodes_lie_where_they_were_put(colors, precise):
    surface, nodes, shown = bowls(colors=colors, precise=precise)
    assert (surface.opaque == shown).all()
    assert np.isnan(surface.positions()[~shown]).all()
    step = surface.axis_z_length.max()
    assert np.abs(surface.positions() - nodes)[shown].max() <= step / 2 + 2e-6
    assert step < (1e-6 if precise else 0.06)
    per_node = {(False, False): 1, (True, False): 4, (False, True): 4, (True, True): 8}[colors, precise]
    assert surface.nbytes == 40 * len(surface) + per_node * surface.node_count


def test_black_nodes_stay_visible():
    surface = quantized(np.zeros((1, 3)), np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]),
                        np.array([0, 1, np.nan, 1.0]), (2, 2), np.zeros((4, 3), np.uint8))
    assert surface.colors.tolist() == [[1, 1, 1], [1, 1, 1], [0, 0, 0], [1, 1, 1]]
    assert surface.opaque.tolist() == [True, True, False, True]


def test_boxes_hold_the_nodes_and_cones_hold_the_facets():
    surface, _, shown = bowls()
    patch, _, _ = surface.node_patches()
    boxes = surface.boxes()
    for k in range(len(surface)):
        own = surface.positions()[(patch == k) & shown]
        frame = np.stack([surface.axis_x[k], surface.axis_y[k], surface.axis_z[k]]).astype(np.float64)
        inside, corners = own @ frame.T, boxes[k] @ frame.T
        assert (inside >= corners.min(axis=0) - 1e-6 * np.abs(corners).max()).all()
        assert (inside <= corners.max(axis=0) + 1e-6 * np.abs(corners).max()).all()
    axes, cosines = facet_cones(surface)
    grid = surface.positions().reshape(len(surface), 9, 17, 3)
    one = np.cross(grid[:, :-1, 1:] - grid[:, :-1, :-1], grid[:, 1:, :-1] - grid[:, :-1, :-1])
    two = np.cross(grid[:, 1:, 1:] - grid[:, 1:, :-1], grid[:, 1:, 1:] - grid[:, :-1, 1:])
    whole = np.isfinite(grid).all(axis=-1)
    whole = whole[:, :-1, :-1] & whole[:, 1:, :-1] & whole[:, :-1, 1:] & whole[:, 1:, 1:]
    for normals in (one, two):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        cosine = np.einsum("pjik,pk->pji", normals, axes)
        assert (cosine >= cosines[:, None, None] - 1e-6)[whole].all()
    assert (cosines > 0.5).all()


def test_patches_of_several_sizes():
    parts = [bowls(1, (5, 3), seed=1)[0], bowls(1, (4, 9), seed=2)[0]]
    both = PatchSurface(*(np.concatenate([getattr(s, name) for s in parts])
                          for name in ("origins", "axis_x", "axis_y", "axis_z_length", "size", "displacements")),
                        origin=parts[0].origin)
    assert not both.equal_sizes and both.node_offset.tolist() == [0, 15, 51]
    wanted = np.concatenate([s.positions() for s in parts])
    assert np.array_equal(both.positions(), wanted, equal_nan=True)
    assert np.allclose(facet_cones(both)[0], np.concatenate([facet_cones(s)[0] for s in parts]))


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("colors", [False, True])
def test_store_and_pickle_keep_patches(tmp_path, count, colors):
    surface = bowls(count, colors=colors)[0] if count else PatchSurface(
        np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), (17, 17), np.zeros(0, np.int8))
    clsurf.save(surface, tmp_path / "a.clsurf")
    for again in (clsurf.load(tmp_path / "a.clsurf"), pickle.loads(pickle.dumps(surface))):
        assert isinstance(again, PatchSurface) and repr(again) == repr(surface)
        assert np.array_equal(again.positions(), surface.positions(), equal_nan=True)
        assert again.equal_sizes == surface.equal_sizes and again.nbytes == surface.nbytes


@pytest.mark.parametrize(("change", "word"), [
    ({"axis_x": [[0, 1, 0.0]]}, "perpendicular"), ({"size": (1, 9)}, "size"), ({"displacements": np.zeros(9)}, "int8"),
    ({"axis_z_length": [0.0]}, "patch 0"), ({"displacements": np.zeros(8, np.int8)}, "displacements")])
def test_wrong_patches_are_refused(change, word):
    fields = {"origins": [[0, 0, 0]], "axis_x": [[1, 0, 0]], "axis_y": [[0, 1, 0]], "axis_z_length": [1.0],
              "size": (3, 3), "displacements": np.zeros(9, np.int8)}
    with pytest.raises(ValueError, match=word):
        PatchSurface(**(fields | change))
