"""Plain float64 twin of kernels/render/differentials.clh: tensors in view space, eigenvectors, nothing shared."""

from types import SimpleNamespace

import numpy as np

from clsurf.surface.slim import frame_of_normals

from .render import K0, K3, K4, K5, K6, K7, K8, K9, RADIUS, RIM_COSINE, T_REF, height, local, opened, ray_poly, ray_root


def local_tensors(degree, records, at):
    """Second (..., 2, 2) and third (..., 2, 2, 2) derivatives of f = w - h(u, v) in the surfels' unit balls."""
    k, (u, v) = records, (at[..., 0], at[..., 1])
    second, third = np.zeros((*u.shape, 2, 2)), np.zeros((*u.shape, 2, 2, 2))
    if degree >= 2:
        second[..., 0, 0], second[..., 1, 1] = -2 * k[..., K3], -2 * k[..., K5]
        second[..., 0, 1] = second[..., 1, 0] = -2 * k[..., K4]
    if degree >= 3:
        second[..., 0, 0] -= 6 * k[..., K6] * u + 2 * k[..., K7] * v
        second[..., 1, 1] -= 2 * k[..., K8] * u + 6 * k[..., K9] * v
        second[..., 0, 1] -= 2 * k[..., K7] * u + 2 * k[..., K8] * v
        second[..., 1, 0] = second[..., 0, 1]
        third[..., 0, 0, 0], third[..., 1, 1, 1] = -6 * k[..., K6], -6 * k[..., K9]
        for i in ((0, 0, 1), (0, 1, 0), (1, 0, 0)):
            third[(..., *i)] = -2 * k[..., K7]
        for i in ((1, 1, 0), (1, 0, 1), (0, 1, 1)):
            third[(..., *i)] = -2 * k[..., K8]
    return second, third


def blended_tensors(degree, view, records, normals, pixels, hit, side, oriented):
    """Gradients (p, 3), Hessians (p, 3, 3), third derivatives (p, 3, 3, 3), view axes: equation 8, left, times weights.

    `normals` (n, 3) are the surfels', model space; `hit` and `side` (p,) what pass 1 found.
    """
    v = opened(view)
    n = normals.astype(np.float64)
    axes = np.stack([np.asarray(a, np.float64) @ v.rotation.T for a in (*frame_of_normals(n), n)], axis=1)  # (n, 3, 3)
    at, d = local(records, pixels)
    at = at + (hit[:, None] - records[:, T_REF])[..., None] * d
    inside = (at**2).sum(axis=-1) < 1
    poly = ray_poly(degree, records, at, d)
    sides = np.broadcast_to(side[:, None], inside.shape) if oriented else np.where(poly[1] < 0, 1.0, -1.0)
    s, _, good = ray_root(degree, poly, sides)
    with np.errstate(invalid="ignore", over="ignore"):
        q = at + s[..., None] * d
        g = 1 - (q**2).sum(axis=-1)
        weight = np.where(inside & good & (g > 0), np.clip(g, 0, None) ** 3, 0) * (1 if oriented else sides)
    q = np.where((weight != 0)[..., None], q, 0)
    _, gu, gv = height(degree, records, q[..., 0], q[..., 1])
    second, third = local_tensors(degree, records, q)
    r, tangents = records[:, RADIUS], axes[:, :2]
    gradient = np.einsum("pn,pni,nij->pj", weight, np.stack([-gu, -gv, np.ones_like(gu)], axis=-1), axes)
    hessian = np.einsum("pn,n,pnij,nia,njb->pab", weight, 1 / r, second, tangents, tangents)
    cubic = np.einsum("pn,n,pnijk,nia,njb,nkc->pabc", weight, 1 / r**2, third, tangents, tangents, tangents,
                      optimize=True)
    return gradient, hessian, cubic


def function_tensors(degree, surface, camera, points, facing, step=1e-3):
    """Gradients (p, 3) and Hessians (p, 3, 3), world axes, of sum w f / sum w at points (p, 3): equation 8, right.

    By central differences of the function itself. Surfels count where f falls along the camera's ray (`facing` 1) or
    rises (-1); for a surface that is not oriented f is turned so that it falls, and `facing` is not used.
    """
    n = surface.normals.astype(np.float64)
    axes = np.stack([*(np.asarray(a, np.float64) for a in frame_of_normals(n)), n], axis=1)
    radii, k = surface.radii.astype(np.float64), np.zeros((len(n), 32))
    order = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])[:surface.coefficients.shape[1]]
    scaled = surface.coefficients * radii[:, None] ** (order - 1)
    k[:, K0:K0 + min(scaled.shape[1], 6)], k[:, K6:K6 + max(scaled.shape[1] - 6, 0)] = scaled[:, :6], scaled[:, 6:]
    k[:, K4] /= 2
    ray = points - camera.eye if camera.height is None else np.broadcast_to(-camera.rotation[2], points.shape)

    def unit(x):
        return np.einsum("pnj,nij->pni", x[:, None] - surface.centers - surface.origin, axes) / radii[:, None]

    at = unit(points)
    _, gu, gv = height(degree, k, at[..., 0], at[..., 1])
    falls = np.einsum("pnij,pj->pn", np.broadcast_to(axes, (len(points), *axes.shape))
                      * np.stack([-gu, -gv, np.ones_like(gu)], axis=-1)[..., None], ray)
    sign = np.where(falls < 0, 1.0, -1.0)
    use = sign == facing[:, None] if surface.oriented else np.ones_like(sign, bool)
    sign = np.ones_like(sign) if surface.oriented else sign

    def function(x):
        q = unit(x)
        g = np.where(use, np.clip(1 - (q**2).sum(axis=-1), 0, None), 0) ** 3
        f = sign * radii * (q[..., 2] - height(degree, k, q[..., 0], q[..., 1])[0])
        return (g * f).sum(axis=1) / g.sum(axis=1)

    e = step * np.eye(3)
    gradient = np.stack([function(points + a) - function(points - a) for a in e], axis=1) / (2 * step)
    hessian = np.empty((len(points), 3, 3))
    for i, a in enumerate(e):
        for j, b in enumerate(e):
            corners = function(points + a + b) - function(points + a - b) - function(points - a + b)
            hessian[:, i, j] = (corners + function(points - a - b)) / (4 * step**2)
    return gradient, hessian


def channels(view, gradient, hessian, cubic, pixels, side=None):
    """The channels of kernels/render/differentials.clh by name; directions in view axes.

    `side` (p,): -1 where an oriented surface is hit from behind; at rims directions are mirrored there as normals are.
    """
    v, out = opened(view), {}
    across, up = (pixels[:, 0] - v.cx) / v.fx, (v.cy - pixels[:, 1]) / v.fy
    eye = np.stack([-across, -up, np.ones_like(up)], axis=1) if v.perspective else np.tile([0.0, 0, 1], (len(up), 1))
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    names = ("mean", "gaussian", "k1", "k2", "derivative1", "derivative2", "radial", "radial_derivative")
    out = {name: np.full(len(up), np.nan) for name in names}
    out |= {name: np.full((len(up), 3), np.nan) for name in ("direction1", "direction2")}
    for i in np.flatnonzero(np.linalg.norm(np.nan_to_num(gradient), axis=1) > 0):
        length = np.linalg.norm(gradient[i])
        n = gradient[i] / length
        project = np.eye(3) - np.outer(n, n)
        shape = project @ hessian[i] @ project / length
        values, vectors = np.linalg.eigh(shape)
        order = np.argsort(np.abs(vectors.T @ n))[:2]  # the two tangent ones
        order = order[np.argsort(-values[order])]
        t1, t2 = vectors.T[order]
        k1, k2 = values[order]
        w = project @ eye[i]
        sine = np.linalg.norm(w)
        w = w / sine

        def change(t, i=i, n=n, length=length):
            straight = np.einsum("abc,a,b,c->", cubic[i], t, t, t)
            return (straight - 3 * (t @ hessian[i] @ t) / length * (t @ hessian[i] @ n)) / length

        twist = np.cross(n, w) @ shape @ w
        found = SimpleNamespace(mean=(k1 + k2) / 2, gaussian=k1 * k2, k1=k1, k2=k2, derivative1=change(t1),
                                derivative2=change(t2), radial=w @ shape @ w, direction1=t1, direction2=t2,
                                radial_derivative=change(w) - 2 * (eye[i] @ n) / sine * twist**2)
        if side is not None and side[i] < 0 and abs(n @ eye[i]) < RIM_COSINE:
            mirror = np.eye(3) - 2 * np.outer(eye[i], eye[i])
            found.direction1, found.direction2 = mirror @ t1, mirror @ t2
        for name in out:
            out[name][i] = getattr(found, name)
    return out
