"""Plain float64 twins of the triangle renderer's kernels: slow, obvious, the specification."""

import numpy as np

from .render import in_view, opened

CUT = 24  # of the view buffer: kernels/render/triangles.clh


def project_vertices(view, positions):
    """x px, y px, v and depth (n, 4) of vertices (n, 3)."""
    v = opened(view)
    finite = np.isfinite(positions).all(axis=1)
    p = in_view(view, np.where(finite[:, None], positions, 0))
    z = -p[:, 2]
    w = z if v.perspective else np.ones_like(z)
    out = np.stack([v.fx * p[:, 0] / w + v.cx, v.cy - v.fy * p[:, 1] / w, -1 / z if v.perspective else z, z], axis=1)
    out[~finite] = 0, 0, 0, -np.inf
    return out


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def weights(view, positions, faces, pixels):
    """Weights (p, f, 3) of every face's corners where pixels (p, 2) see its plane, and the depths (p, f) there."""
    v = opened(view)
    p = in_view(view, positions)
    z = -p[:, 2]
    w = z if v.perspective else np.ones_like(z)
    xy = np.stack([v.fx * p[:, 0] + v.cx * w, v.cy * w - v.fy * p[:, 1]], axis=1)
    q = xy[faces][None] - pixels[:, None, None, :] * w[faces][None, ..., None]
    areas = np.stack([cross(q[..., 1, :], q[..., 2, :]), cross(q[..., 2, :], q[..., 0, :]),
                      cross(q[..., 0, :], q[..., 1, :])], axis=-1)
    with np.errstate(all="ignore"):
        shares = areas / areas.sum(axis=-1, keepdims=True)
    return shares, (shares * z[faces]).sum(axis=-1)


def hits(view, positions, faces, pixels, margin=0.0):
    """Depth (p, f) of every face at every pixel, inf where it is not there; a `margin` > 0 leaves out its rim."""
    v = opened(view)
    shares, depth = weights(view, positions, faces, pixels)
    inside = (shares >= margin).all(axis=-1) & (depth > (max(v.near, 0) if v.perspective else v.near))
    return np.where(inside, depth, np.inf)


def tile_triangles(view, positions, faces, pixels):
    """Depth (p,) of what is nearest at pixels (p, 2), inf for nothing, and its face (p,), -1 for none."""
    depth = hits(view, positions, faces, pixels)
    best = depth.argmin(axis=1)
    found = depth[np.arange(len(pixels)), best]
    return found, np.where(np.isfinite(found), best, -1)
