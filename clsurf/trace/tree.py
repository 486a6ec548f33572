"""The wide tree that every traced primitive is kept in: 16 children a node, no pointers.

The layout, which the kernels of kernels/trace share (tree.clh):

* A *bottom* node holds up to 16 primitives, its *slots*; every other node holds up to 16 nodes. Node 0 is the top; it
  has `roots` children, 1 to `roots`; child j of any other inner node i is node ``16 * i + roots - 15 + j``. So all
  bottom nodes are of one level and come last: node i >= `first_bottom` holds the slots
  ``16 * (i - first_bottom) + j``, and ``order[slot]`` is the primitive, -1 where there is none. With at most 16
  primitives node 0 is itself the bottom node.
* What is tested of the children stands in the parent, a vector of 16 floats for each number: ``boxes[i, axis, j]`` is
  the least coordinate of child j (a node or a primitive) of node i, ``boxes[i, 3 + axis, j]`` the largest. A child that
  does not exist has `EMPTY` for the least and ``-EMPTY`` for the largest coordinate, so that every test that takes the
  face of a box by the sign of its own direction drops it.

One tree may carry several sets of boxes (of a surfel: of its piece of surface, and of its whole ball): all of them come
from `node_boxes` for the same `order`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

WIDTH = 16
EMPTY = 1e30


@dataclass(frozen=True, eq=False)
class Tree:
    """The shape of a tree, and where its primitives went; see the head of this file."""

    roots: int  # children of node 0; 0: node 0 is the bottom node
    node_count: int
    first_bottom: int
    order: NDArray  # (16 * bottom nodes,) int32: primitive of each slot, -1: none

    @property
    def levels(self) -> int:
        """Levels of nodes, at least 1; a walk in depth never has more than ``15 * levels + 1`` nodes waiting."""
        level, first, count = 1, 0, 1
        while first + count < self.node_count:
            first, count = first + count, self.roots if level == 1 else WIDTH * count
            level += 1
        return level

    def in_slots(self, values: NDArray, fill=0) -> NDArray:
        """Return `values` (n, ...) of the primitives in the order of the slots (16 * bottom nodes, ...)."""
        values = np.asarray(values)
        if not len(values):
            return np.full((len(self.order), *values.shape[1:]), fill, values.dtype)
        mask = (self.order >= 0).reshape(-1, *[1] * (values.ndim - 1))
        return np.where(mask, values[np.maximum(self.order, 0)], np.asarray(fill, values.dtype))

    def first_of_levels(self) -> list[int]:
        """Return the number of the first node of every level, and `node_count`."""
        out, count = [0], 1
        while out[-1] + count < self.node_count:
            out.append(out[-1] + count)
            count = self.roots if len(out) == 2 else WIDTH * count
        return [*out, self.node_count]


def plant(low: NDArray, high: NDArray) -> Tree:
    """Return the tree of primitives with the boxes `low`, `high` (n, 3), halved at the median along the longest side.

    Primitives whose box is not finite or is turned inside out are left out. Bottom nodes are filled up, all but the
    last of each split; the result depends on nothing but the input.
    """
    low, high = np.asarray(low, np.float64).reshape(-1, 3), np.asarray(high, np.float64).reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        used = np.flatnonzero(np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1) & (low <= high).all(axis=1))
    bottoms = max(-(-len(used) // WIDTH), 1)
    if bottoms == 1:
        order = np.full(WIDTH, -1, np.int32)
        order[:len(used)] = used
        return Tree(0, 1, 0, order)
    full = 1  # bottom nodes below one root
    while WIDTH * full < bottoms:
        full *= WIDTH
    roots = -(-bottoms // full)
    order, start, count = _split((low[used] / 2 + high[used] / 2).astype(np.float32), roots, full)
    slots = np.full((roots * full, WIDTH), -1, np.int32)
    bottom = np.repeat(np.arange(roots * full), count)
    slots[bottom, np.arange(len(used)) - start[bottom]] = used[order]
    first = 1 + roots * ((full - 1) // (WIDTH - 1))
    return Tree(roots, first + roots * full, first, slots.ravel())


def _split(points: NDArray, roots: int, full: int) -> tuple[NDArray, NDArray, NDArray]:
    """Return the order of `points` (n, 3) along the bottom nodes; and where each node's part starts, and its length."""
    order = np.arange(len(points))
    start, count, room = np.array([0]), np.array([len(points)]), np.array([roots * full])
    while room.max() > 1:
        segment = np.repeat(np.arange(len(start)), count)
        own = points[order]
        key = own[np.arange(len(own)), _longest(own, start, count)[segment]] + np.float32(0)  # -0 becomes 0
        bits = key.view(np.int32).astype(np.int64)
        bits = np.where(bits < 0, -(bits & 0x7FFFFFFF), bits) + (segment.astype(np.int64) << 33)
        order = order[np.argsort(bits, kind="stable")]
        # Whole roots are told apart first, then each root's nodes are halved.
        left = np.where(room > full, -(-(room // full) // 2) * full, -(-room // 2))
        units = -(-count // WIDTH)
        first = np.minimum(count, WIDTH * -(-units * left // room))
        start = np.stack([start, start + first], axis=1).ravel()
        count = np.stack([first, count - first], axis=1).ravel()
        room = np.stack([left, room - left], axis=1).ravel()
        start, count, room = start[room > 0], count[room > 0], room[room > 0]
    return order, start, count


def _longest(points: NDArray, start: NDArray, count: NDArray) -> NDArray:
    """Return the axis along which each segment of `points` reaches farthest."""
    out = np.zeros(len(start), np.int64)
    some = count > 0
    if some.any():
        at = start[some]
        out[some] = (np.maximum.reduceat(points, at) - np.minimum.reduceat(points, at)).argmax(axis=1)
    return out


def node_boxes(tree: Tree, low: NDArray, high: NDArray) -> NDArray:
    """Return the boxes (node_count, 6, 16) float32 of a tree's children for boxes `low`, `high` (n, 3) of primitives.

    Each primitive's box is widened to the next float32 number, so that nothing sticks out by rounding.
    """
    out = np.empty((tree.node_count, 6, WIDTH), np.float32)
    out[:, :3], out[:, 3:] = EMPTY, -EMPTY
    low, high = np.asarray(low).reshape(-1, 3), np.asarray(high).reshape(-1, 3)
    below = np.nextafter(low.astype(np.float32), np.float32(-np.inf))
    above = np.nextafter(high.astype(np.float32), np.float32(np.inf))
    below, above = tree.in_slots(below, EMPTY), tree.in_slots(above, -EMPTY)
    firsts = tree.first_of_levels()
    for level in reversed(range(len(firsts) - 1)):
        nodes = slice(firsts[level], firsts[level + 1])
        count = nodes.stop - nodes.start
        if len(below) < WIDTH * count:  # only node 0 may have fewer than 16 children
            missing = WIDTH * count - len(below)
            below = np.concatenate([below, np.full((missing, 3), EMPTY, np.float32)])
            above = np.concatenate([above, np.full((missing, 3), -EMPTY, np.float32)])
        out[nodes, :3] = below.reshape(count, WIDTH, 3).transpose(0, 2, 1)
        out[nodes, 3:] = above.reshape(count, WIDTH, 3).transpose(0, 2, 1)
        below, above = out[nodes, :3].min(axis=2), out[nodes, 3:].max(axis=2)
    return out
