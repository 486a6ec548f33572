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

from ..device import Device

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
        out = values[np.maximum(self.order, 0)]
        out[self.order < 0] = fill
        return out

    def first_of_levels(self) -> list[int]:
        """Return the number of the first node of every level, and `node_count`."""
        out, count = [0], 1
        while out[-1] + count < self.node_count:
            out.append(out[-1] + count)
            count = self.roots if len(out) == 2 else WIDTH * count
        return [*out, self.node_count]


def plant(device: Device, low: NDArray, high: NDArray) -> Tree:
    """Return the tree of primitives with the boxes `low`, `high` (n, 3), halved by the surface area heuristic.

    Primitives whose box is not finite or is turned inside out are left out. Bottom nodes are filled up, all but the
    last of each half; the result depends on nothing but the input. Against halves at the median along the longest side
    the dragon's rays are 1.1 times as fast.
    """
    low, high = np.asarray(low).reshape(-1, 3), np.asarray(high).reshape(-1, 3)
    with np.errstate(invalid="ignore", over="ignore"):
        fits = (low <= high) & np.isfinite(low) & np.isfinite(high)
    used = np.flatnonzero(fits[:, 0] & fits[:, 1] & fits[:, 2])  # NumPy's reductions along 3 take 10 times as long
    bottoms = max(-(-len(used) // WIDTH), 1)
    if bottoms == 1:
        order = np.full(WIDTH, -1, np.int32)
        order[:len(used)] = used
        return Tree(0, 1, 0, order)
    roots, full = _shape(bottoms)
    if len(used) < len(low):
        low, high = low[used], high[used]
    order, count = _split(device, low, high, roots, full)
    there = np.arange(WIDTH) < count[:, None]
    slots = np.full((roots * full, WIDTH), -1, np.int32)
    slots[there] = used[order]
    first = 1 + roots * ((full - 1) // (WIDTH - 1))
    return Tree(roots, first + roots * full, first, slots.ravel())


def room(count: int) -> tuple[int, int]:
    """Return how many slots and nodes the tree of `count` primitives has at most."""
    bottoms = max(-(-count // WIDTH), 1)
    if bottoms == 1:
        return WIDTH, 1
    roots, full = _shape(bottoms)
    return WIDTH * roots * full, 1 + roots * ((WIDTH * full - 1) // (WIDTH - 1))


def _shape(bottoms: int) -> tuple[int, int]:
    """Return the children of node 0, and the bottom nodes below each of them."""
    full = 1
    while WIDTH * full < bottoms:
        full *= WIDTH
    return -(-bottoms // full), full


def _split(device: Device, low: NDArray, high: NDArray, roots: int, full: int) -> tuple[NDArray, NDArray]:
    """Return the order of boxes (n, 3) along the bottom nodes, and how many of them each node has."""
    n = len(low)
    ends = np.array([[side[:, axis].min(), side[:, axis].max()] for side in (low, high) for axis in range(3)], float)
    middle = ends[:3, 0] / 2 + ends[3:, 1] / 2
    unit = max(float((ends[3:, 1] / 2 - ends[:3, 0] / 2).max()), 1e-300)  # so that float32 holds areas
    boxes = [np.zeros((n, 4), np.float32) for _ in range(2)]
    for values, side in zip(boxes, (low, high), strict=True):
        values[:, :3] = (side - middle) / unit
    boxes = [device.upload(values) for values in boxes]
    order, other = device.upload(np.arange(n, dtype=np.int32)), device.empty((n,), np.int32)
    rest, keys = device.empty((n,), np.int32), device.empty((n,), np.float32)
    parts = np.array([[0, n, roots * full]], np.int32)
    while parts[:, 2].max() > 1:
        if device.loop_turns is not None and 16 * parts[:, 1].max() > device.loop_turns:
            parts, items = _split_at_medians(parts, device.download(order), low, high, full)
            order = device.upload(items)
            continue
        halves = device.empty((2 * len(parts), 3), np.int32)
        device.kernel("trace/split_nodes.cl")((len(parts),), (1,), len(parts), full, device.upload(parts), order,
                                              *boxes, halves, other, rest, keys)
        parts = device.download(halves)
        parts = np.ascontiguousarray(parts[parts[:, 2] > 0])
        order, other = other, order
    return device.download(order, copy=False), parts[:, 1]


def _split_at_medians(parts: NDArray, order: NDArray, low: NDArray, high: NDArray,
                      full: int) -> tuple[NDArray, NDArray]:
    """Return the halves of parts (n, 3) and the new order: a round for devices whose loops end too early for it.

    A part is divided along its centres' longest side, where both halves' nodes become about as full.
    """
    order, halves = order.copy(), []
    for start, count, room in parts.tolist():
        left = -(-(room // full) // 2) * full if room > full else -(-room // 2)
        first = min(count, WIDTH * left)
        if count > WIDTH and room > 1:
            items = order[start:start + count]
            centers = low[items] / 2 + high[items] / 2
            keys = centers[:, np.argmax(np.ptp(centers, axis=0))]
            first = max(min(count // WIDTH * left // room * WIDTH, first), count - WIDTH * (room - left), 0)
            order[start:start + count] = items[np.argsort(keys, kind="stable")]
        halves += [(start, first, left), (start + first, count - first, room - left)]
    return np.array([half for half in halves if half[2] > 0], np.int32), order


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
