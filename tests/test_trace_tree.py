"""The wide tree: every primitive once, inside every box above it."""

import numpy as np
import pytest

from clsurf.trace.tree import EMPTY, WIDTH, node_boxes, plant

COUNTS = (0, 1, 16, 17, 100, 256, 257, 4097)


def boxes(count, seed=0):
    random = np.random.default_rng(seed)
    center, reach = random.normal(size=(count, 3)) * [4, 1, 2], random.uniform(0, 0.1, (count, 3))
    return center - reach, center + reach


def paths(tree):
    """(slot, [(node, child), ...]) of every slot, from the top to the bottom, by the rule in the file's head."""
    def walk(node, path):
        if node >= tree.first_bottom:
            for j in range(WIDTH):
                yield WIDTH * (node - tree.first_bottom) + j, [*path, (node, j)]
            return
        for j in range(WIDTH if node else tree.roots):
            yield from walk((WIDTH * node + tree.roots - 15 if node else 1) + j, [*path, (node, j)])
    return list(walk(0, []))


@pytest.mark.parametrize("count", COUNTS)
def test_every_primitive_has_one_slot_on_a_path_of_all_levels(count):
    tree = plant(*boxes(count))
    assert np.array_equal(np.sort(tree.order[tree.order >= 0]), np.arange(count))
    walked = paths(tree)
    assert [slot for slot, _ in walked] == list(range(len(tree.order)))
    assert {len(path) for _, path in walked} == {tree.levels}
    assert tree.first_of_levels()[-2:] == [tree.first_bottom, tree.node_count]


@pytest.mark.parametrize("count", COUNTS)
def test_boxes_hold_all_primitives_below(count):
    low, high = boxes(count)
    tree = plant(low, high)
    box = node_boxes(tree, low, high)
    for slot, path in paths(tree):
        i = tree.order[slot]
        node, j = path[-1]
        if i < 0:
            assert (box[node, :3, j] == EMPTY).all() and (box[node, 3:, j] == -EMPTY).all()
            continue
        for node, j in path:
            assert (box[node, :3, j] <= low[i]).all() and (box[node, 3:, j] >= high[i]).all()


def test_bottom_nodes_are_full_and_compact():
    points = np.stack(np.meshgrid(np.arange(32.0), np.arange(32.0), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    tree = plant(points, points)
    filled = (tree.order.reshape(-1, WIDTH) >= 0).sum(axis=1)
    assert (filled == WIDTH).all()
    parts = points[tree.order].reshape(-1, WIDTH, 3)
    assert (np.ptp(parts, axis=1)[:, :2] == 3).all()  # squares of 4 x 4


def test_boxes_that_are_not_finite_or_turned_inside_out_are_left_out():
    low, high = boxes(40)
    low[3], high[7], low[11, 1] = np.nan, np.inf, 1e9
    tree = plant(low, high)
    assert np.array_equal(np.sort(tree.order[tree.order >= 0]), np.delete(np.arange(40), [3, 7, 11]))


def test_equal_points_and_large_coordinates():
    low = np.full((1000, 3), 1e30)
    tree = plant(low, low)
    assert np.array_equal(np.sort(tree.order[tree.order >= 0]), np.arange(1000))
