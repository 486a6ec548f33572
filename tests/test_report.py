"""Statistics of patches against plain loops, and on patches whose counts are known; the page in a browser."""

import dataclasses

import numpy as np
import pytest
from reference.report import patch_counts

import clsurf
from clsurf.build.quantize import quantized
from clsurf.report import statistics
from clsurf.report.statistics import patch_statistics


def flat(count=1, nodes=(5, 4), spacing=1.0, height=0.0, **rest):
    """Return `count` flat patches side by side along x, in the plane z = 0 unless `height` says otherwise."""
    m, n = nodes
    origins = np.zeros((count, 3))
    origins[:, 0] = np.arange(count) * spacing * (m - 1)
    heights = np.broadcast_to(np.asarray(height, float), (count, m * n)).ravel()
    x, y = (np.tile(np.multiply(axis, spacing), (count, 1)) for axis in ([1, 0, 0], [0, 1, 0]))
    return quantized(origins, x, y, heights, nodes, **rest)


def facing(surface, height, aside=(0.0, 0.0)):
    """Return an orthographic camera above the surface's middle; the picture is `height` world units high."""
    middle = surface.bounds.mean(axis=0) + np.array([*aside, 0])
    return clsurf.Camera.orthographic(middle + np.array([0, 0, 5]), middle, height=height)


def bumps(seed=0, count=6, sizes=None):
    """Return rough patches in random frames with transparent nodes, of one size or several."""
    rng = np.random.default_rng(seed)
    frames = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    frames[:, 2] *= np.linalg.det(frames)[:, None]
    sizes = np.tile([6, 4], (count, 1)) if sizes is None else sizes
    total = int(np.prod(sizes, axis=1).sum())
    heights = rng.normal(size=total) * 0.1
    heights[rng.random(total) < 0.08] = np.nan
    return quantized(rng.normal(size=(count, 3)), frames[:, 0] * 0.3, frames[:, 1] * 0.2, heights, sizes,
                     origin=(7e6, -5.0, 100.0))


CAMERAS = {"whole": lambda s: clsurf.Camera.framing(s),
           "inside": lambda s: clsurf.Camera.look_at(s.bounds.mean(axis=0), s.bounds[1], fov=70),
           "near plane": lambda s: clsurf.Camera.look_at(s.bounds[1], s.bounds[0], near=1.0),
           "orthographic": lambda s: clsurf.Camera.orthographic(s.bounds[1], s.bounds[0], height=2.0)}


@pytest.mark.parametrize("block", [40, 1 << 19])
@pytest.mark.parametrize("view", CAMERAS)
@pytest.mark.parametrize("size", [(40, 30), (300, 500)])
def test_counts_are_those_of_plain_loops(view, size, block, monkeypatch):
    monkeypatch.setattr(statistics, "BLOCK_NODES", block)
    rng = np.random.default_rng(1)
    for surface in (bumps(), bumps(1, sizes=rng.integers(2, 8, (6, 2)))):
        camera = CAMERAS[view](surface)
        found = dataclasses.asdict(patch_statistics(surface, camera, size))
        for name, count in patch_counts(surface, camera, size).items():
            assert found[name] == count, name
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = [[0, -2, 0], [2, 0, 0], [0, 0, 2]], surface.origin
        moved = surface.moved(matrix)
        camera = CAMERAS[view](moved)
        found = dataclasses.asdict(patch_statistics(moved, camera, size))
        for name, count in patch_counts(surface, camera, size, matrix).items():
            assert found[name] == count, f"placed, {name}"


@pytest.mark.parametrize(("pixels", "created", "level"), [(0.5, 0, 0), (1.0, 0, 0), (1.01, 5, 1), (2.0, 5, 1),
                                                          (2.1, 21, 2), (4.0, 21, 2), (4.5, 77, 3)])
def test_a_flat_patch_of_known_spacing(pixels, created, level):
    """5 x 4 nodes, `pixels` apart on the picture: 12 cells of (2^k + 1)^2 - 4 created nodes."""
    surface = flat()
    got = patch_statistics(surface, facing(surface, 100 / pixels), (100, 100))
    assert (got.patches, got.nodes, got.opaque_nodes, got.projected_nodes) == (1, 20, 20, 20)
    assert (got.cells, got.cells_touched, got.interpolated_nodes) == (12, 12, 12 * created)
    assert got.cell_levels == (0,) * level + (12,)
    assert got.plain_patches == got.cheap_patches == (created == 0)
    assert abs(got.pixels - 12 * pixels ** 2) < 1e-6
    assert got.parts == 12 * sum(4 ** k for k in range(level + 1))
    assert got.operations["bilinear"].shifts == 6 * 12 * created
    assert got.operations["smooth"].total - 8 * got.parts == 3 * (got.operations["bilinear"].total - 8 * got.parts)


def test_transparent_nodes_take_their_cells_along():
    heights = np.zeros(20)
    heights[7] = np.nan  # an inner node: four cells
    surface = flat(height=heights)
    got = patch_statistics(surface, facing(surface, 10), (100, 100))
    assert (got.opaque_nodes, got.cells, got.cells_touched) == (19, 8, 8)


def test_patches_outside_and_across_the_border():
    surface = flat(5, nodes=(9, 9))  # 40 units wide, patches of 8
    got = patch_statistics(surface, facing(surface, 20), (20, 20))  # sees 20 x 20 units around the third
    assert (got.visible_patches, got.partial_patches) == (3, 2)
    assert got.projected_nodes == 3 * 81 and got.cells == 5 * 64
    assert got.cells_touched == 20 * 8 + 2 * 8  # cells that only touch the picture's border count as well
    gone = patch_statistics(surface, facing(surface, 20, aside=(100, 0)), (20, 20))
    assert (gone.visible_patches, gone.projected_nodes, gone.cells_touched, gone.interpolated_nodes) == (0, 0, 0, 0)
    assert np.isnan(gone.plain_share) and np.isnan(gone.cheap_share)


def test_backs():
    """A patch seen from behind is visible but not facing; one that nothing tells the sides of always is."""
    surface = flat()
    behind = clsurf.Camera.orthographic([2, 2, -5], [2, 2, 0], height=10)
    assert patch_statistics(surface, facing(surface, 10), (100, 100)).facing_patches == 1
    assert patch_statistics(surface, behind, (100, 100)).facing_patches == 0
    assert patch_statistics(surface, behind, (100, 100)).visible_patches == 1
    both = dataclasses.replace(surface, oriented=False)
    assert patch_statistics(both, behind, (100, 100)).facing_patches == 1
    turned = np.diag([1.0, -1.0, -1.0, 1.0])  # placed upside down
    assert patch_statistics(surface.moved(turned), behind, (100, 100)).facing_patches == 1


@pytest.mark.parametrize("seed", range(20))
def test_the_cheap_test_is_never_wrong(seed):
    """Whatever it finds to be plain is plain: random views from near and far, rough and smooth patches."""
    rng = np.random.default_rng(seed)
    surface = bumps(seed, 30)
    eye = surface.bounds.mean(axis=0) + rng.normal(size=3) * rng.uniform(0.5, 8)
    camera = clsurf.Camera.look_at(eye, surface.bounds.mean(axis=0), fov=60)
    for pixels in (20, 40, 60, 100):
        view = statistics._View.of(surface, camera, (pixels, pixels))
        found = statistics._found_plain(view)
        visible = np.ones(len(surface), bool)
        needs = np.zeros(len(surface), bool)
        statistics._count_cells(view, 0, len(surface), visible, statistics._Totals(), needs)
        assert not (found & needs).any()


def test_the_cheap_test_finds_smooth_patches():
    """Gently curved patches at 0.8 pixels a node: all are found, so the bound is not idle."""
    i, j = np.tile(np.arange(17), 17) - 8, np.repeat(np.arange(17), 17) - 8
    surface = flat(4, (17, 17), 1.0, (i ** 2 + j ** 2) / 100)
    camera = facing(surface, 125)
    got = patch_statistics(surface, camera, (100, 100))
    assert (got.plain_patches, got.cheap_patches) == (4, 4)


def test_no_patches_at_all():
    empty = clsurf.PatchSurface(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), (17, 17),
                                np.zeros(0, np.int8))
    got = patch_statistics(empty, clsurf.Camera.look_at((0, 0, 5), (0, 0, 0)), (50, 50))
    assert (got.patches, got.visible_patches, got.cells, got.cell_levels) == (0, 0, 0, ())


def test_a_cell_against_the_eye_counts_up_to_the_picture():
    """A cell a thousand pictures wide creates no more nodes than the picture has pixels along its sides."""
    surface = flat()
    got = patch_statistics(surface, clsurf.Camera.look_at((1.5, 1.5, 1e-4), (1.5, 1.5, 0)), (64, 64))
    assert got.cells_touched >= 1 and got.interpolated_nodes <= got.cells_touched * (65 ** 2 - 4)
