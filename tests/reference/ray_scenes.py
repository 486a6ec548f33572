"""Scenes and rays of tests of tracing."""

import numpy as np

import clsurf
from clsurf import Mesh

from .trace_rays import unit


def sphere_mesh(rings=24, segments=48, radius=1.0):
    """A closed mesh of a sphere around zero."""
    theta = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    phi = np.linspace(0, 2 * np.pi, segments, endpoint=False)[None]
    ring = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=2)
    points = np.concatenate([[[0, 0, 1]], ring.reshape(-1, 3), [[0, 0, -1]]]) * radius
    faces, last = [], len(points) - 1
    for i in range(segments):
        j = (i + 1) % segments
        faces += [[0, 1 + i, 1 + j], [last, last - segments + j, last - segments + i]]
        for row in range(rings - 2):
            a, b = 1 + row * segments + i, 1 + row * segments + j
            faces += [[a, a + segments, b], [b, a + segments, b + segments]]
    return Mesh(points.astype(np.float32), np.array(faces))


def torus_mesh(around=240, across=120):
    """A closed torus of radii 2 and 1."""
    u, v = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(across) * 2 * np.pi / across, indexing="ij")
    points = np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v)], axis=-1).reshape(-1, 3)
    at = np.arange(around * across).reshape(around, across)
    right, down = np.roll(at, -1, axis=0), np.roll(at, -1, axis=1)
    both = np.roll(right, -1, axis=1)
    faces = np.concatenate([np.stack([at, right, both], -1).reshape(-1, 3),
                            np.stack([at, both, down], -1).reshape(-1, 3)])
    return Mesh(points, faces.astype(np.int32))


def random_rays(count, seed=0, radius=2.0, inside=0.9):
    """Rays from outside a ball of 1 toward random points of it."""
    rng = np.random.default_rng(seed)
    origins = unit(rng.normal(size=(count, 3))) * radius
    targets = unit(rng.normal(size=(count, 3))) * inside * rng.uniform(0, 1, (count, 1))
    return origins, targets - origins


def slim_sphere(device):
    """A SLIM surface of a unit sphere."""
    points = unit(np.random.default_rng(1).normal(size=(6000, 3)))
    return clsurf.build_slim(clsurf.PointCloud(points, points), error=0.005, device=device)
