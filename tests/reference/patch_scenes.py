"""Patches, cameras and a picture size that the tests of the patch renderer draw."""

import numpy as np

from clsurf.build.quantize import quantized
from clsurf.render.camera import Camera
from clsurf.surface.patch import PatchSurface

SIZE = (61, 47)
FRONT = Camera.orthographic((0, 0, 5), (0, 0, 0), height=2.2)
CAMERAS = {"orthographic": Camera.orthographic((2, 3, 7), (0, 0, 0), height=2.6),
           "perspective": Camera.look_at((1.6, 3.0, 4.8), (0, 0, 0), fov=24)}


def joined(*surfaces):
    """One surface of the patches of several."""
    names = ("origins", "axis_x", "axis_y", "axis_z_length", "size", "displacements")
    arrays = [np.concatenate([getattr(s, name) for s in surfaces]) for name in names]
    colors = None if surfaces[0].colors is None else np.concatenate([s.colors for s in surfaces])
    return PatchSurface(*arrays, colors, origin=surfaces[0].origin)


def rough(count=6, size=(9, 7), seed=3, ratios=(1.0, 0.5), holes=0.1, colors=False):
    """Patches of random heights over random frames, with transparent nodes; their |a_z| / |a_x| varies."""
    rng = np.random.default_rng(seed)
    frames = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    frames[:, 2] *= np.sign(np.linalg.det(frames))[:, None]
    d = rng.integers(-100, 128, count * size[0] * size[1]).astype(np.int8)
    hole = rng.random(len(d)) < holes
    rgb = rng.integers(1, 255, (len(d), 3)).astype(np.uint8) if colors else None
    if colors:
        rgb[hole] = 0
    else:
        d[hole] = -128
    step = 0.01 * np.asarray(ratios)[np.arange(count) % len(ratios)]
    return PatchSurface(rng.normal(size=(count, 3)), frames[:, 0], frames[:, 1] * 0.5, step, size, d, rgb)


def sheet(height, nodes=(9, 9), spacing=0.25, precise=True, colors=None, center=(0.0, 0.0)):
    """One patch over the xy plane, facing +z, of heights `height(x, y)`, and its nodes' x and y."""
    m, n = nodes
    x = (np.tile(np.arange(m), n) - (m - 1) / 2) * spacing + center[0]
    y = (np.repeat(np.arange(n), m) - (n - 1) / 2) * spacing + center[1]
    origin = np.array([[x[0], y[0], 0]])
    return quantized(origin, np.array([[spacing, 0, 0]]), np.array([[0, spacing, 0]]), height(x, y), nodes, colors,
                     precise), x, y


def wavy(x, y):
    return 0.12 * np.sin(5 * x) * np.cos(4 * y) + 0.1 * x


def steps(surface, places):
    """Places (q, 2) in nodes to the surface's own x and y."""
    return surface.origins[0, :2] + places * [surface.axis_x[0, 0], surface.axis_y[0, 1]]


def disc(nodes, radius=0.9, colors=None, tilt=0.2):
    """A tilted disc in one patch of side 2.2; nodes outside are transparent."""
    spacing = 2.2 / (nodes - 1)
    return sheet(lambda x, y: np.where(np.hypot(x, y) <= radius, tilt * x, np.nan), (nodes, nodes), spacing,
                 colors=colors)[0]


def globe(count=60, bump=0.0, checks=0):
    """A bumpy unit sphere of 17 x 17 patches, with a fine chequer of colours."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + 5 ** 0.5) * k
    normal = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    x = np.cross(np.where(np.abs(normal[:, 2:]) < 0.9, [[0, 0, 1.0]], [[1.0, 0, 0]]), normal)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y, step = np.cross(normal, x), 1.6 * np.sqrt(4 * np.pi / count) / 16
    u, v = (np.tile(np.arange(17), 17) - 8) * step, (np.repeat(np.arange(17), 17) - 8) * step
    height = np.sqrt(1 - u * u - v * v) - 1 + 0 * k[:, None]
    p = normal[:, None] * (1 + height[..., None]) + u[:, None] * x[:, None] + v[:, None] * y[:, None]
    height = height + bump * np.sin(9 * p[..., 0]) * np.sin(8 * p[..., 1])
    check = np.floor(p * checks).sum(axis=2) % 2 if checks else np.zeros(p.shape[:2])
    colors = np.repeat((255 - 250 * check).reshape(-1, 1), 3, axis=1)
    return quantized(normal - 8 * step * (x + y), x * step, y * step, height.ravel(), (17, 17), colors)
