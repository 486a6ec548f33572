"""The further modes of the patch renderer: table of normals, mip levels, subdivision, light at the nodes, alpha."""

import numpy as np
import pytest
from reference import render_patch_modes as twin
from test_surface_patch import bowls

from clsurf.build.quantize import quantized
from clsurf.render.normal_table import half_steps, normal_statistics, ratio_groups
from clsurf.render.patch_mips import halved, mip_levels, tent
from clsurf.render.shade import to_linear
from clsurf.surface.patch import PatchSurface

# Patches to draw ------------------------------------------------------------------------------------------------------


def joined(*surfaces):
    """One surface of the patches of several."""
    names = ("origins", "axis_x", "axis_y", "axis_z_length", "size", "displacements")
    arrays = [np.concatenate([getattr(s, name) for s in surfaces]) for name in names]
    colors = None if surfaces[0].colors is None else np.concatenate([s.colors for s in surfaces])
    return PatchSurface(*arrays, colors, origin=surfaces[0].origin)


def rough(count=6, size=(9, 7), seed=3, ratios=(1.0, 0.5), holes=0.1, colors=False):
    """Patches of random heights over random frames, with transparent nodes; their |a_z| / |a_x| varies."""
    rng = np.random.default_rng(seed)
    frames = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    frames[:, 2] *= np.sign(np.linalg.det(frames))[:, None]
    d = rng.integers(-100, 128, count * size[0] * size[1]).astype(np.int8)
    hole = rng.random(len(d)) < holes
    rgb = rng.integers(1, 255, (len(d), 3)).astype(np.uint8) if colors else None
    if colors:
        rgb[hole] = 0
    else:
        d[hole] = -128
    step = 0.01 * np.asarray(ratios)[np.arange(count) % len(ratios)]
    return PatchSurface(rng.normal(size=(count, 3)), frames[:, 0], frames[:, 1] * 0.5, step, size, d, rgb)


# The table of normals -------------------------------------------------------------------------------------------------


def test_half_steps():
    surface = rough()
    for part in (surface, joined(surface, rough(2, (5, 12)))):
        got = np.stack(half_steps(part), axis=1)
        for k in range(len(part)):
            (m, n), (a, b) = part.size[k], part.node_offset[k:k + 2]
            opaque = part.opaque[a:b].reshape(n, m)
            wanted = 2 * twin.slopes(part.displacements[a:b].reshape(n, m), opaque)
            assert (got[a:b].reshape(n, m, 2)[opaque] == wanted[opaque]).all()


@pytest.mark.parametrize("ratios", [(1.0,), (1.0, 0.5), (1.0, 0.5, 0.25)])
def test_normal_statistics_count_what_a_table_would(ratios):
    surface = rough(6, ratios=ratios)
    got = normal_statistics(surface)
    wanted = twin.table_counts(surface)
    assert (got.normals, got.buffered, got.ordered) == wanted
    assert got.groups == len(ratios) and got.ordered <= got.buffered <= got.normals
    assert got.precomputed < got.ordered if len(ratios) == 1 else got.precomputed == got.ordered
    assert normal_statistics(surface, np.zeros(6, bool)).normals == 0
    one = np.arange(6) == 2
    assert normal_statistics(surface, one).buffered == normal_statistics(surface, one).ordered


def test_equal_patches_share_all_their_normals():
    one = rough(1)
    many = joined(*[one] * 5)
    five, alone = normal_statistics(many), normal_statistics(one)
    assert five.buffered - five.precomputed == alone.buffered - alone.precomputed < alone.normals
    assert five.normals == 5 * alone.normals and five.precomputed == 5 * alone.precomputed


def test_ratio_groups():
    surface = rough(6, ratios=(1.0, 0.5, 0.25))
    group, ratios = ratio_groups(surface)
    assert len(ratios) == 3 and (np.bincount(group) == 2).all()
    own = surface.axis_z_length / np.linalg.norm(surface.axis_x, axis=1)
    assert np.abs(ratios[group, 0] / own - 1).max() < 4e-4


# Mip levels -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nodes", (2, 3, 4, 5, 6, 7, 9, 16, 17))
def test_coarser_rows_keep_ends_and_straight_lines(nodes):
    weights = tent(nodes)
    assert weights.shape == ((nodes + 2) // 2, nodes)
    assert np.allclose(weights.sum(axis=1), 1) and weights[0, 0] == weights[-1, -1] == 1
    step = (nodes - 1) / (len(weights) - 1)
    assert np.allclose(weights @ np.arange(nodes), np.arange(len(weights)) * step)


@pytest.mark.parametrize("size", [(17, 9), (6, 8), (5, 2)])
def test_levels_keep_the_outline(size):
    """Corners stay where they are, border nodes on the border, and a plane stays that plane."""
    rng = np.random.default_rng(1)
    i, j = np.tile(np.arange(size[0]), size[1]), np.repeat(np.arange(size[1]), size[0])
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    surface = quantized(np.zeros((1, 3)), frame[:1] * 0.5, frame[1:2] * 0.25, 0.2 * i - 0.1 * j, size, precise=True)
    levels = mip_levels(surface)
    assert (levels[-1].size == 2).all()
    fine = surface.positions().reshape(size[1], size[0], 3)
    normal = np.cross(fine[0, -1] - fine[0, 0], fine[-1, 0] - fine[0, 0])
    normal /= np.linalg.norm(normal)
    for level in levels[1:]:
        nodes = level.positions().reshape(level.size[0, 1], level.size[0, 0], 3)
        for a, b in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
            assert np.abs(nodes[a, b] - fine[a, b]).max() < 2e-6
        assert np.abs((nodes - fine[0, 0]) @ normal).max() < 2e-5


def test_levels_average_linear_light_and_keep_most_of_what_shows():
    rng = np.random.default_rng(5)
    colors = np.where(rng.random((81, 1)) < 0.5, [[255, 255, 255]], [[1, 1, 1]])
    flat = PatchSurface(np.zeros((1, 3)), [[1, 0, 0]], [[0, 1, 0]], [0.1], (9, 9), np.zeros(81, np.int8), colors)
    level = halved(flat)
    inner = to_linear(level.colors.reshape(5, 5, 3)[1:-1, 1:-1] / 255)
    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16
    linear = to_linear(colors.reshape(9, 9, 3) / 255)
    wanted = [[(linear[j - 1:j + 2, i - 1:i + 2] * kernel[..., None]).sum(axis=(0, 1)) for i in (2, 4, 6)]
              for j in (2, 4, 6)]
    assert np.abs(inner - wanted).max() < 0.006  # 8 bits of sRGB
    surface = rough(20, (17, 17), holes=0.3)
    shares = [s.opaque.mean() for s in mip_levels(surface)[:3]]
    assert shares[1] > shares[0] and (halved(rough(3, holes=1.0)).opaque == 0).all()


def test_levels_of_all_kinds():
    for surface in (bowls(2, colors=True)[0], bowls(2, precise=True)[0], bowls(2, colors=True, precise=True)[0],
                    joined(rough(2), rough(1, (4, 11)))):
        levels = mip_levels(surface)
        assert all(len(s) == len(surface) for s in levels) and (levels[-1].size == 2).all()
        low, high = surface.bounds
        reach = 1e-3 * np.ptp(surface.bounds, axis=0) + np.linalg.norm(surface.axis_z, axis=1).max()
        for level in levels:
            assert (level.bounds[0] >= low - reach).all() and (level.bounds[1] <= high + reach).all()
    mixed = joined(rough(2), rough(1, (4, 11)))
    assert np.array_equal(halved(mixed).displacements[:2 * 5 * 4], halved(rough(2)).displacements)
