"""Generated patch models: on their surface, without gaps, and of the paper's sizes."""

import numpy as np
import pytest

from clsurf import models
from clsurf.errors import InputError
from tests.reference.patch_cover import directions, margin


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
