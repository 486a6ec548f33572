"""Plain float64 twins of the patch renderer's further modes and of supersampling: slow, obvious, the specification."""

import numpy as np


def average(channels, factor):
    """The channels (by name) of a picture from those of one `factor` times as large each way."""
    def blocks(a):
        h, w = a.shape[0] // factor, a.shape[1] // factor
        return a.reshape(h, factor, w, factor, *a.shape[2:]).swapaxes(1, 2).reshape(h, w, factor ** 2, *a.shape[2:])
    low = (factor - 1) // 2
    middle = [low * factor + low] if factor % 2 else [j * factor + i for j in (low, low + 1) for i in (low, low + 1)]
    depth = np.where(np.isnan(blocks(channels["depth"])), np.inf, blocks(channels["depth"]))[..., middle]
    best = np.array(middle)[depth.argmin(axis=-1)]
    out = {}
    for name, array in channels.items():
        samples = blocks(array)
        if name == "color":
            out[name] = samples.astype(np.float64).mean(axis=2)
        else:
            index = best.reshape(*best.shape, 1, *(1,) * (samples.ndim - 3))
            out[name] = np.take_along_axis(samples, index, axis=2)[:, :, 0]
    return out


def slopes(d, opaque):
    """Slopes (n, m, 2) in steps per node: central differences, one-sided at borders and beside transparent nodes."""
    n, m = d.shape
    out = np.zeros((n, m, 2))
    for j in range(n):
        for i in range(m):
            for axis, (di, dj) in enumerate(((1, 0), (0, 1))):
                ends = []
                for side in (-1, 1):
                    x, y = i + side * di, j + side * dj
                    ends.append((x, y) if 0 <= x < m and 0 <= y < n and opaque[y, x] else (i, j))
                (x0, y0), (x1, y1) = ends
                steps = abs(x1 - x0) + abs(y1 - y0)
                out[j, i, axis] = (float(d[y1, x1]) - float(d[y0, x0])) / max(steps, 1)
    return out


def table_counts(surface):
    """Normals wanted, computed with a table in the order of the patches, and ordered by group: one node at a time."""
    rx = surface.axis_z_length / np.linalg.norm(surface.axis_x, axis=1)
    ry = surface.axis_z_length / np.linalg.norm(surface.axis_y, axis=1)
    ratio = [tuple(np.rint(1024 * np.log2([x, y])).astype(int)) for x, y in zip(rx, ry, strict=True)]
    number = {r: i for i, r in enumerate(sorted(set(ratio)))}
    orders = [range(len(ratio)), sorted(range(len(ratio)), key=lambda k: number[ratio[k]])]
    wanted, computed = 0, []
    for order in orders:
        held, now, count, wanted = set(), None, 0, 0
        for k in order:
            if ratio[k] != now:
                held, now = set(), ratio[k]
            a, b = surface.node_offset[k:k + 2]
            m, n = surface.size[k]
            d, opaque = surface.displacements[a:b].reshape(n, m), surface.opaque[a:b].reshape(n, m)
            for h in np.abs(2 * slopes(d, opaque)[opaque]):
                wanted += 1
                key = tuple(h)
                if max(key) >= 256 or key not in held:
                    count += 1
                held.add(key)
        computed.append(count)
    return wanted, *computed
