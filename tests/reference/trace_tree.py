"""Twins of the kernels that plant the wide tree: float64, slow and obvious."""

import numpy as np

WIDTH, BINS = 16, 32


def area(low, high):
    """Half the surface area of the box around boxes `low`, `high` (n, 3)."""
    x, y, z = high.max(axis=0) - low.min(axis=0)
    return x * y + y * z + z * x


def split_nodes(low, high, items, room, full):
    """Return the two halves of `items` (indices), with their rooms: [(items, room), (items, room)]."""
    count = len(items)
    left = (room // full + 1) // 2 * full if room > full else (room + 1) // 2
    least, most = max(count - WIDTH * (room - left), 0), min(count, WIDTH * left)
    if count <= WIDTH or room == 1:
        return [(items[:most], left), (items[most:], room - left)]
    center = (low + high)[items]
    best = np.inf, None, int(np.clip(count // WIDTH * left // room * WIDTH, least, most))
    for axis in range(3):
        reach = np.ptp(center[:, axis])
        if not reach > 0:
            continue
        bins = np.clip(((center[:, axis] - center[:, axis].min()) * (BINS * (1 - 1e-6) / reach)).astype(int), 0,
                       BINS - 1)
        for border in range(1, BINS):
            before = bins < border
            k = int(np.clip(before.sum(), least, most))
            reached = (bins == (border - 1 if k < before.sum() else border)).sum() >= abs(k - before.sum())
            if not before.any() or before.all() or not reached:
                continue
            cost = area(low[items[before]], high[items[before]]) * k \
                + area(low[items[~before]], high[items[~before]]) * (count - k)
            if cost < best[0]:
                best = cost, axis, int(np.clip((k + WIDTH // 2) // WIDTH * WIDTH, least, most))
    _, axis, first = best
    order = items if axis is None else items[np.argsort(center[:, axis], kind="stable")]
    return [(order[:first], left), (order[first:], room - left)]
