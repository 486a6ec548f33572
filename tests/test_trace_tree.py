"""The wide tree: every primitive once, inside every box above it."""

import numpy as np
import pytest
from reference import trace_tree as reference

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
def test_every_primitive_has_one_slot_on_a_path_of_all_levels(device, count):
    tree = plant(device, *boxes(count))
    assert np.array_equal(np.sort(tree.order[tree.order >= 0]), np.arange(count))
    walked = paths(tree)
    assert [slot for slot, _ in walked] == list(range(len(tree.order)))
    assert {len(path) for _, path in walked} == {tree.levels}
    assert tree.first_of_levels()[-2:] == [tree.first_bottom, tree.node_count]


@pytest.mark.parametrize("count", COUNTS)
def test_boxes_hold_all_primitives_below(device, count):
    low, high = boxes(count)
    tree = plant(device, low, high)
    box = node_boxes(tree, low, high)
    for slot, path in paths(tree):
        i = tree.order[slot]
        node, j = path[-1]
        if i < 0:
            assert (box[node, :3, j] == EMPTY).all() and (box[node, 3:, j] == -EMPTY).all()
            continue
        for node, j in path:
            assert (box[node, :3, j] <= low[i]).all() and (box[node, 3:, j] >= high[i]).all()


def test_bottom_nodes_are_full_and_compact(device):
    points = np.stack(np.meshgrid(np.arange(32.0), np.arange(32.0), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    tree = plant(device, points - 0.5, points + 0.5)
    filled = (tree.order.reshape(-1, WIDTH) >= 0).sum(axis=1)
    assert (filled == WIDTH).all()
    parts = points[tree.order].reshape(-1, WIDTH, 3)
    assert (np.ptp(parts, axis=1)[:, :2] == 3).all()  # squares of 4 x 4


def test_boxes_that_are_not_finite_or_turned_inside_out_are_left_out(device):
    low, high = boxes(40)
    low[3], high[7], low[11, 1] = np.nan, np.inf, 1e9
    tree = plant(device, low, high)
    assert np.array_equal(np.sort(tree.order[tree.order >= 0]), np.delete(np.arange(40), [3, 7, 11]))


def test_equal_points_and_large_coordinates(device):
    low = np.full((1000, 3), 1e30)
    tree = plant(device, low, low)
    assert np.array_equal(np.sort(tree.order[tree.order >= 0]), np.arange(1000))


@pytest.mark.parametrize("count", COUNTS)
def test_drivers_that_end_long_loops_get_trees_too(device, count, monkeypatch):
    """The first rounds are made here; what follows on the device has short loops."""
    low, high = boxes(count)
    usual = plant(device, low, high)
    monkeypatch.setattr(device, "loop_turns", 16 * 100)
    tree = plant(device, low, high)
    assert np.array_equal(np.sort(tree.order[tree.order >= 0]), np.arange(count))
    assert (tree.roots, tree.node_count, tree.first_bottom) == (usual.roots, usual.node_count, usual.first_bottom)
    box, other = node_boxes(tree, low, high)[tree.first_bottom:], node_boxes(usual, low, high)[tree.first_bottom:]
    area = [np.prod(np.maximum(b[:, 3:].max(axis=2) - b[:, :3].min(axis=2), 0), axis=1).sum() for b in (box, other)]
    assert area[0] < 2 * area[1] + 1e-6


@pytest.mark.parametrize("count", [300, 1500, 5000])
def test_split_nodes(device, count, monkeypatch):
    monkeypatch.setattr(device, "loop_turns", None)  # all rounds on the device
    low, high = (np.round(1024 * side) / 1024 for side in boxes(count, seed=count))
    low[:, 0], high[:, 0] = low[:, 0] + 0.01 * np.arange(count), high[:, 0] + 0.01 * np.arange(count)  # no equal keys
    tree = plant(device, low, high)
    full = 256 if count > 4096 else 16
    parts = [(np.arange(count), len(tree.order) // WIDTH)]
    while max(room for _, room in parts) > 1:
        parts = [half for items, room in parts for half in reference.split_nodes(low, high, items, room, full)]
        parts = [(items, room) for items, room in parts if room]
    same = [set(items) == set(row[row >= 0]) for (items, _), row in
            zip(parts, tree.order.reshape(-1, WIDTH), strict=True)]
    assert np.mean(same) > 0.97  # rounding tells some halves apart


def test_halves_cost_less_than_those_at_the_median(device):
    """Where primitives crowd, as along a scan's folds: the sum of the bottom nodes' areas is what rays pay for."""
    random = np.random.default_rng(5)
    low = random.normal(size=(4000, 3)) ** 3
    high = low + random.uniform(0, 0.05, (4000, 3))
    tree = plant(device, low, high)
    rows = tree.order.reshape(-1, WIDTH)
    planted = sum(reference.area(low[row[row >= 0]], high[row[row >= 0]]) for row in rows if (row >= 0).any())

    def halved(items):
        if len(items) <= WIDTH:
            return reference.area(low[items], high[items])
        items = items[np.argsort(low[items, np.ptp(low[items], axis=0).argmax()])]
        half = WIDTH * -(-len(items) // (2 * WIDTH))
        return halved(items[:half]) + halved(items[half:])

    assert planted < 0.95 * halved(np.arange(4000))
