"""Exact differential channels of implicit surfaces F = 0 (float64): what the renderer's channels approximate.

F grows outwards. With unit normal n = g / |g| and a unit tangent t, curvature kappa(t) = t'Ht / |g| (sphere of radius
R: +1/R), its derivative along t is C(t) = (T(t, t, t) - 3 kappa(t) t'Hn) / |g|; H and T are F's second and third
derivatives.
"""

import numpy as np


class Quadric:
    """Ellipsoid about the origin with the given half axes."""

    def __init__(self, axes):
        self.d = 1 / np.asarray(axes, np.float64)**2
        self.reach = float(np.max(axes))

    def value(self, p):
        return (self.d * p * p).sum(axis=-1) - 1

    def derivatives(self, p):
        n = p.shape[0]
        return 2 * self.d * p, np.broadcast_to(np.diag(2 * self.d), (n, 3, 3)), np.zeros((n, 3, 3, 3))

    def hits(self, origins, directions):
        a = (self.d * directions**2).sum(axis=1)
        b = (self.d * origins * directions).sum(axis=1)
        c = (self.d * origins**2).sum(axis=1) - 1
        with np.errstate(invalid="ignore"):
            return (-b - np.sqrt(b * b - a * c)) / a


class Torus:
    """Torus about the z axis: (|p|^2 + R^2 - r^2)^2 = 4 R^2 (x^2 + y^2)."""

    def __init__(self, major=1.0, minor=0.4):
        self.major, self.minor = major, minor
        self.reach = major + minor

    def value(self, p):
        s = (p * p).sum(axis=-1) + self.major**2 - self.minor**2
        return s * s - 4 * self.major**2 * (p[..., 0]**2 + p[..., 1]**2)

    def derivatives(self, p):
        s = (p * p).sum(axis=1) + self.major**2 - self.minor**2
        flat, eye = np.diag([1.0, 1.0, 0.0]), np.eye(3)
        g = 4 * s[:, None] * p - 8 * self.major**2 * p @ flat
        h = 8 * p[:, :, None] * p[:, None, :] + 4 * s[:, None, None] * eye - 8 * self.major**2 * flat
        pe = p[:, :, None, None] * eye
        t = 8 * (pe + np.swapaxes(pe, 1, 2) + np.moveaxis(pe, 1, 3))
        return g, h, t

    def hits(self, origins, directions):
        """Sphere tracing by the torus's exact distance, ended by Newton steps."""
        t = np.maximum(np.linalg.norm(origins, axis=1) - self.reach * 1.01, 0)
        alive = np.ones(len(t), bool)
        for _ in range(80):
            d = self.distance(origins + t[:, None] * directions)
            t = np.where(alive, t + d, t)
            alive &= (d > 1e-9) & (t < 100)
        p = origins + t[:, None] * directions
        hit = np.abs(self.distance(p)) < 1e-6
        for _ in range(3):
            g = self.derivatives(p)[0]
            with np.errstate(all="ignore"):
                step = self.value(p) / (g * directions).sum(axis=1)
            t = np.where(np.abs(step) < 1e-5, t - step, t)
            p = origins + t[:, None] * directions
        return np.where(hit, t, np.nan)

    def distance(self, p):
        return np.hypot(np.hypot(p[:, 0], p[:, 1]) - self.major, p[:, 2]) - self.minor


class Waves:
    """A height field z = a sum of sines of x and y, seen from above: F = z - h(x, y)."""

    def __init__(self, amplitude=0.1, frequency=6.0, half=1.0):
        self.a, self.k, self.half, self.reach = amplitude, frequency, half, half * np.sqrt(2)

    def value(self, p):
        return p[..., 2] - self.a * np.sin(self.k * p[..., 0]) * np.cos(self.k * p[..., 1])

    def derivatives(self, p):
        k, a, n = self.k, self.a, len(p)
        x = np.stack([a * k**i * np.sin(k * p[:, 0] + i * np.pi / 2) for i in range(4)])
        y = np.stack([k**i * np.cos(k * p[:, 1] + i * np.pi / 2) for i in range(4)])
        g, h, t = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3, 3))
        g[:, 2] = 1
        for i in range(2):
            ones = np.bincount([i], minlength=2)
            g[:, i] = -x[ones[0]] * y[ones[1]]
            for j in range(2):
                two = np.bincount([i, j], minlength=2)
                h[:, i, j] = -x[two[0]] * y[two[1]]
                for m in range(2):
                    three = np.bincount([i, j, m], minlength=2)
                    t[:, i, j, m] = -x[three[0]] * y[three[1]]
        return g, h, t

    def hits(self, origins, directions):
        t = (1.01 * self.a - origins[:, 2]) / directions[:, 2]
        for _ in range(200):
            p = origins + t[:, None] * directions
            t = t + np.maximum(self.value(p), -0.01) / (1 + self.a * self.k * 1.5)
        p = origins + t[:, None] * directions
        good = (np.abs(self.value(p)) < 1e-6) & (np.abs(p[:, :2]).max(axis=1) < self.half)
        return np.where(good, t, np.nan)


def implicit_channels(shape, camera, size) -> dict:
    """Return the channels by name, float32, as `clsurf.render` gives them; NaN where nothing is hit."""
    origins, directions = camera.rays(size)
    t = shape.hits(origins, directions)
    hit = np.isfinite(t)
    p, v = origins[hit] + t[hit, None] * directions[hit], -directions[hit]
    values = surface_channels(*shape.derivatives(p), v)
    values["depth"] = (origins[hit] + t[hit, None] * directions[hit] - camera.eye) @ -camera.rotation[2]
    values["position"] = p
    out = {}
    for name, value in values.items():
        whole = np.full((len(t), *value.shape[1:]), np.nan, np.float32)
        whole[hit] = value
        out[name] = whole.reshape(size[1], size[0], *value.shape[1:])
    return out


def surface_channels(g, h, t, v) -> dict:
    """Return normal, mean, gaussian, k1, k2, direction1, direction2, derivative1, derivative2, radial and
    radial_derivative of points with gradients g (n, 3), Hessians h, third derivatives t, and unit vectors v to the eye.
    """
    size = np.linalg.norm(g, axis=1)
    n = g / size[:, None]
    across = np.where(np.abs(n[:, :1]) < 0.7, np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]]))
    a = np.cross(n, across)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(n, a)

    def bend(x, y):
        return np.einsum("ni,nij,nj->n", x, h, y) / size

    def derivative(x):
        return np.einsum("nijk,ni,nj,nk->n", t, x, x, x) / size - 3 * bend(x, x) * bend(x, n)

    e, f, gg = bend(a, a), bend(a, b), bend(b, b)
    mean, spread = (e + gg) / 2, np.hypot((e - gg) / 2, f)
    angle = 0.5 * np.arctan2(2 * f, e - gg)
    d1 = np.cos(angle)[:, None] * a + np.sin(angle)[:, None] * b
    d2 = np.cross(n, d1)
    slope = (n * v).sum(axis=1)
    w = v - slope[:, None] * n
    sine = np.linalg.norm(w, axis=1)
    w = w / np.maximum(sine, 1e-12)[:, None]
    k1, k2 = mean + spread, mean - spread
    flip = np.where(slope < 0, -1.0, 1.0)[:, None]
    return {"normal": n * flip, "mean": mean, "gaussian": k1 * k2, "k1": k1, "k2": k2, "direction1": d1,
            "direction2": d2, "derivative1": derivative(d1), "derivative2": derivative(d2), "radial": bend(w, w),
            "radial_derivative": derivative(w) + 2 * k1 * k2 * slope / np.maximum(sine, 1e-12)}
