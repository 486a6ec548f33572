"""Generated patch models: on their surface, without gaps, and of the paper's sizes."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsurf import models
from clsurf.errors import InputError
from clsurf.models.lattice import GOLDEN


def directions(count):
    """Return `count` evenly spread unit vectors and, since gaps hide there, the poles and the date line."""
    i = np.arange(count)
    y = 1 - (2 * i + 1) / count
    turn = 2 * np.pi * (i * GOLDEN % 1)
    r = np.sqrt(1 - y * y)
    spread = np.stack([r * np.sin(turn), y, r * np.cos(turn)], axis=1)
    lat = np.linspace(-np.pi / 2, np.pi / 2, 2001)
    line = np.stack([0 * lat, np.sin(lat), -np.cos(lat)], axis=1)
    return np.concatenate([spread, line])


def margin(surface, points):
    """Return how many nodes deep each point (n, 3) lies inside the best of the patches that it projects into."""
    centers = surface.origins + ((surface.size[:, :1] - 1) * surface.axis_x + (surface.size[:, 1:] - 1)
                                 * surface.axis_y) / 2.0
    x, y = surface.axis_x.astype(np.float64), surface.axis_y.astype(np.float64)
    near = cKDTree(centers).query(points, 12)[1]
    offset = points[:, None] - centers[near]
    i = np.einsum("nka,nka->nk", offset, x[near]) / (x ** 2).sum(axis=1)[near]
    j = np.einsum("nka,nka->nk", offset, y[near]) / (y ** 2).sum(axis=1)[near]
    half = (surface.size[near] - 1) / 2
    return np.minimum(half[..., 0] - np.abs(i), half[..., 1] - np.abs(j)).max(axis=1)


def test_perfect_sphere_is_the_papers():
    sphere = models.perfect_sphere()
    assert len(sphere) == 1362 and (sphere.size == 17).all() and sphere.node_count == 393_618
    np.testing.assert_allclose(np.linalg.norm(sphere.axis_x, axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(sphere.axis_y, axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(sphere.axis_z_length, 0.01, rtol=1e-6)
    assert sphere.colors is None and sphere.color is not None and sphere.opaque.all()
    assert sphere.nbytes == 448_098 < 440 * 1024
    assert (sphere.displacements.reshape(1362, -1) == sphere.displacements[:289]).all()


def test_perfect_sphere_is_a_sphere():
    sphere = models.perfect_sphere()
    assert np.abs(np.linalg.norm(sphere.positions(), axis=1) - 128).max() < 0.0051  # half a step of 0.01
    nodes = sphere.positions().reshape(-1, 17, 17, 3)
    middles = (nodes[:, 1:, 1:] + nodes[:, 1:, :-1] + nodes[:, :-1, 1:] + nodes[:, :-1, :-1]) / 4
    assert np.abs(np.linalg.norm(middles, axis=-1) - 128).max() < sphere.bound < 0.0071
    assert (np.einsum("pa,pa->p", sphere.axis_z, sphere.origins) > 0).all()


@pytest.mark.parametrize("options, deep", [({}, 1.4), ({"patches": 32, "nodes": 5}, 0.4), ({"patches": 57}, 0.4),
                                           ({"patches": 2712, "radius": 1e-3, "nodes": 9}, 0.4)])
def test_perfect_sphere_has_no_gap(options, deep):
    sphere = models.perfect_sphere(**options)
    assert margin(sphere, options.get("radius", 128) * directions(200_000)).min() > deep


@pytest.mark.parametrize("options, word", [({"patches": 31}, "patches"), ({"radius": 0}, "radius"),
                                           ({"nodes": 4}, "nodes"), ({"patches": 40.5}, "patches")])
def test_perfect_sphere_says_what_it_cannot_do(options, word):
    with pytest.raises(InputError, match=word):
        models.perfect_sphere(**options)
