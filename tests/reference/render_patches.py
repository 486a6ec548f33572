"""Plain float64 twins of the patch renderer's kernels: slow, obvious, the specification."""

import numpy as np

from .render import in_view, opened
from .render_patch_modes import slopes

LAYER, BORDER_SCALE = 24, 25  # of the view buffer: kernels/common/patch.clh


def drawn_cells(opaque):
    """Which nodes (n, m) bool name a cell that is drawn: all four corners show."""
    out = np.zeros_like(opaque)
    out[:-1, :-1] = opaque[:-1, :-1] & opaque[1:, :-1] & opaque[:-1, 1:] & opaque[1:, 1:]
    return out


def border_distances(opaque, dx, dy):
    """Distance (n, m) of every node to the border of what is drawn, along the eight directions, shortest path."""
    cells = np.pad(drawn_cells(opaque)[:-1, :-1], 1)
    inner = cells[:-1, :-1] & cells[1:, :-1] & cells[:-1, 1:] & cells[1:, 1:]
    out = np.where(inner, np.inf, 0.0)
    for _ in range(out.size):
        before, wide = out, np.pad(out, 1, constant_values=np.inf)
        n, m = out.shape
        for j in (-1, 0, 1):
            for i in (-1, 0, 1):
                step = np.hypot(i * dx, j * dy)
                out = np.minimum(out, wide[1 + j:1 + j + n, 1 + i:1 + i + m] + step)
        if (out == before).all():
            return out
    return out


def prepare_patches(surface):
    """Cells (N,) bool, border distances (N,) and slopes (N, 2) of all nodes."""
    cells, borders, gradients = [], [], []
    for k, (m, n) in enumerate(surface.size):
        part = slice(*surface.node_offset[k:k + 2])
        opaque, d = surface.opaque[part].reshape(n, m), surface.displacements[part].reshape(n, m).astype(float)
        cells.append(drawn_cells(opaque).ravel())
        steps = (np.linalg.norm(axis[k]) for axis in (surface.axis_x, surface.axis_y))
        borders.append(border_distances(opaque, *steps).ravel())
        gradients.append(slopes(d, opaque).reshape(-1, 2))
    return np.concatenate(cells), np.concatenate(borders), np.concatenate(gradients)


def project_nodes(view, surface):
    """x w, y w, depth and w (N, 4) of all nodes."""
    v = opened(view)
    p = in_view(view, np.nan_to_num(surface.positions() - surface.origin))
    z = -p[:, 2]
    w = z if v.perspective else np.ones_like(z)
    return np.stack([v.fx * p[:, 0] + v.cx * w, -v.fy * p[:, 1] + v.cy * w, z, w], axis=1)


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def covers(q):
    """Whether the quadrilaterals (..., 4, 2), relative to the pixel, cover it: as two triangles, edges included."""
    inside = False
    for a, b, c in ((0, 1, 3), (0, 3, 2)):
        turns = np.stack([cross(q[..., i, :], q[..., j, :]) for i, j in ((a, b), (b, c), (c, a))])
        inside = inside | (turns >= 0).all(axis=0) | (turns <= 0).all(axis=0)
    return inside


def places(q, z, near):
    """Where (s, t) bilinear cells with corners q (..., 4, 2) and depths z (..., 4) are 0, and the depth there.

    The root inside of the cell, else the one nearest to it; the front one of two.
    """
    a, b, c = q[..., 0, :], q[..., 1, :] - q[..., 0, :], q[..., 2, :] - q[..., 0, :]
    d = q[..., 3, :] - q[..., 1, :] - c
    k0, k1, k2 = cross(b, a), cross(b, c) + cross(d, a), cross(d, c)
    best, out = np.full(k0.shape, np.inf), [np.zeros(k0.shape) for _ in range(3)]
    with np.errstate(all="ignore"):
        h = -0.5 * (k1 + np.where(k1 < 0, -1, 1) * np.sqrt(np.maximum(k1 * k1 - 4 * k0 * k2, 0)))
        for t in (k0 / h, h / k2):
            t = np.clip(np.nan_to_num(t, nan=1e12), -1e12, 1e12)
            e, f = b + t[..., None] * d, a + t[..., None] * c
            s = np.clip(np.nan_to_num(-(e * f).sum(-1) / (e * e).sum(-1), nan=1e12), -1e12, 1e12)
            cs, ct = np.clip(s, 0, 1), np.clip(t, 0, 1)
            off = np.abs(s - cs) + np.abs(t - ct)
            depth = mixed(z, cs, ct)
            off = np.where(off < 1e-3, 0, off) + np.where(depth > near, 0, 2e30)
            better = (off < best) | ((off == best) & (depth < out[2]))
            best = np.where(better, off, best)
            out = [np.where(better, new, old) for new, old in zip((cs, ct, depth), out, strict=True)]
    return out


def mixed(v, s, t):
    low, high = v[..., 0] + s * (v[..., 1] - v[..., 0]), v[..., 2] + s * (v[..., 3] - v[..., 2])
    return low + t * (high - low)


def tile_patches(view, surface, pixels):
    """Depth (p,) of what wins at pixel centres (p, 2), inf for nothing, and its cell (p,), named by its first node.

    No patch may reach the near plane. The layer of a sample is that of its exact depth.
    """
    cells, borders, _ = prepare_patches(surface)
    first = np.flatnonzero(cells)
    patch = surface.node_patches()[0][first]
    row = surface.size[patch, 0]
    corners = first[:, None] + np.stack([0 * row, 0 * row + 1, row, row + 1], axis=1)
    nodes = project_nodes(view, surface)[corners]
    q = nodes[None, ..., :2] - pixels[:, None, None, :] * nodes[None, ..., 3:]
    s, t, depth = places(q, np.broadcast_to(nodes[None, ..., 2], q.shape[:-1]), opened(view).near)
    border = mixed(borders[corners][None] * float(view[BORDER_SCALE]), s, t)
    layer = np.floor((depth - opened(view).first_depth) * float(view[LAYER]))
    hit = covers(q / nodes[None, ..., 3:])
    rank = np.where(hit, layer * 4096 + 4095 - np.floor(np.clip(border, 0, 4095)), np.inf)
    best = rank.argmin(axis=1)
    found = np.isfinite(rank.min(axis=1))
    return np.where(found, depth[np.arange(len(pixels)), best], np.inf), np.where(found, first[best], -1)
