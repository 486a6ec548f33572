"""Plain float64 twins of the patch renderer's further modes and of supersampling: slow, obvious, the specification."""

import numpy as np

from .render import opened, shade


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


def table_normals(d, opaque, rx, ry):
    """Unit normals (n, m, 3) in patch space from one patch's slopes; `rx`, `ry` are |a_z| / |a_x|, |a_z| / |a_y|."""
    g = slopes(d, opaque)
    normal = np.stack([-g[..., 0] * rx, -g[..., 1] * ry, np.ones(d.shape)], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def smooth_height(d, opaque, x, y):
    """Height and slopes at the place (x, y), in nodes, of the bicubic Hermite surface through heights (n, m)."""
    g = slopes(d, opaque)
    twist = slopes(g[..., 0], opaque)[..., 1]
    n, m = d.shape
    i, j = min(int(x), m - 2), min(int(y), n - 2)
    s, t = x - i, y - j
    basis = np.array([[1, 0, -3, 2], [0, 0, 3, -2], [0, 1, -2, 1], [0, 0, -1, 1]])  # value 0, 1, slope 0, 1
    powers = lambda v: np.array([1, v, v * v, v ** 3])  # noqa: E731
    rates = lambda v: np.array([0, 1, 2 * v, 3 * v * v])  # noqa: E731
    at = np.ix_([j, j + 1], [i, i + 1])
    table = np.block([[d[at].astype(float), g[..., 0][at]], [g[..., 1][at], twist[at]]])  # rows: y, columns: x
    a, b = basis @ powers(s), basis @ powers(t)
    return b @ table @ a, b @ table @ (basis @ rates(s)), (basis @ rates(t)) @ table @ a


def bilinear_height(d, x, y):
    """Height and slopes at the place (x, y), in nodes, of the bilinear cells of one patch's heights (n, m)."""
    n, m = d.shape
    i, j = min(int(x), m - 2), min(int(y), n - 2)
    s, t = x - i, y - j
    (a, b), (c, e) = d[j:j + 2, i:i + 2].astype(float)
    twist = a - b - c + e
    return a + s * (b - a) + t * (c - a) + s * t * twist, b - a + t * twist, c - a + s * twist


def seen_places(surface, k, height, origins, directions, start):
    """Where rays (model space) meet one patch: places (q, 2) in nodes and distances, by Newton from `start`."""
    axes = np.stack([surface.axis_x[k], surface.axis_y[k], surface.axis_z[k]]).astype(np.float64)
    inverse = np.linalg.inv(axes.T)
    o, v = (origins - surface.origins[k]) @ inverse.T, directions @ inverse.T  # in nodes, nodes, steps
    out, far = np.array(start, float), np.zeros(len(o))
    m, n = surface.size[k]
    for q in range(len(o)):
        x, y = out[q]
        for _ in range(20):
            z, gx, gy = height(np.clip(x, 0, m - 1), np.clip(y, 0, n - 1))
            # The ray stays at the place (x, y) where o + r v = (x, y, z).
            matrix = np.array([[1, 0, -v[q, 0]], [0, 1, -v[q, 1]], [gx, gy, -v[q, 2]]])
            dx, dy, far[q] = np.linalg.solve(matrix, [o[q, 0] - x, o[q, 1] - y, o[q, 2] - z])
            x, y = x + dx, y + dy
        out[q] = x, y
    return out, far


def light_nodes(view, shading, surface, k, linear):
    """Lit colours (n m, 3) of one patch's nodes of the unlit colours `linear` (n m, 3), worked out in view space."""
    v = opened(view)
    a, b = surface.node_offset[k:k + 2]
    m, n = surface.size[k]
    i, j = np.tile(np.arange(m), n)[:, None], np.repeat(np.arange(n), m)[:, None]
    d = surface.displacements[a:b].astype(float)
    frame = np.stack([surface.axis_x[k], surface.axis_y[k], surface.axis_z[k]]).astype(np.float64)
    p = surface.origins[k] + i * frame[0] + j * frame[1] + d[:, None] * frame[2]
    p = v.scale * p @ v.rotation.T + v.offset
    length = np.linalg.norm(frame, axis=1)
    shows = surface.opaque[a:b].reshape(n, m)
    normal = table_normals(d.reshape(n, m), shows, length[2] / length[0], length[2] / length[1])
    normal = normal.reshape(-1, 3) @ (frame / length[:, None]) @ v.rotation.T
    eye = -p if v.perspective else np.tile([0, 0, 1.0], (len(p), 1))
    normal *= np.where((normal * eye).sum(axis=1) < 0, -1, 1)[:, None]
    depth = -p[:, 2]
    w = depth if v.perspective else 1.0
    pixels = np.stack([v.cx + v.fx * p[:, 0] / w, v.cy - v.fy * p[:, 1] / w], axis=1)
    return shade(view, shading, pixels, depth, normal, linear)[:, :3]


def select_levels(view, levels):
    """The level (p,) of every patch: the coarsest whose nodes are at most a pixel apart at its nearest corner."""
    v = opened(view)
    p = (levels[0].boxes() - levels[0].origin).reshape(-1, 3) @ v.rotation.T * v.scale + v.offset
    near = -p[:, 2].reshape(-1, 8).max(axis=1)
    px = v.scale * max(v.fx, v.fy) / (near if v.perspective else 1.0)
    out = np.zeros(len(levels[0]), int)
    for number, level in enumerate(levels):
        step = np.maximum(*(np.linalg.norm(a, axis=1) for a in (level.axis_x, level.axis_y)))
        out[(px * step <= 1) & ((near > 0) | ~v.perspective)] = number
    return out


def seen_from_behind(surface, eye):
    """Patches (p,) all of whose facets face away from `eye` (world)."""
    out = np.ones(len(surface), bool)
    points = surface.positions()
    for k in range(len(surface)):
        m, n = surface.size[k]
        p = points[surface.node_offset[k]:surface.node_offset[k + 1]].reshape(n, m, 3)
        for j in range(n - 1):
            for i in range(m - 1):
                a, b, c, d = p[j, i], p[j, i + 1], p[j + 1, i], p[j + 1, i + 1]
                if np.isfinite([a, b, c, d]).all():
                    for at, x, y in ((a, b - a, c - a), (b, b - a, d - b), (c, d - c, c - a), (d, d - c, d - b)):
                        out[k] &= np.cross(x, y) @ (eye - at) < 0
    return out
