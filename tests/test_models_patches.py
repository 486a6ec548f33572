"""Generated patch models: on their surface, without gaps, and of the paper's sizes."""

import numpy as np
import pytest

from clsurf import models
from clsurf.errors import InputError
from tests.reference.patch_cover import directions, margin


def test_perfect_sphere_is_the_papers():
    sphere = models.perfect_sphere(step=0.01)
    assert len(sphere) == 1362 and (sphere.size == 17).all() and sphere.node_count == 393_618
    np.testing.assert_allclose(np.linalg.norm(sphere.axis_x, axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(sphere.axis_y, axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(sphere.axis_z_length, 0.01, rtol=1e-6)
    assert sphere.colors is None and sphere.color is not None and sphere.opaque.all()
    assert sphere.nbytes == 448_098 < 440 * 1024
    assert (sphere.displacements.reshape(1362, -1) == sphere.displacements[:289]).all()


@pytest.mark.parametrize("options, nodes_off, middles_off", [({"step": 0.01}, 0.0051, 0.0071), ({}, 0.0023, 0.0013)])
def test_perfect_sphere_is_a_sphere(options, nodes_off, middles_off):
    sphere = models.perfect_sphere(**options)  # half a step of 0.01 off, or raised by what cells dip
    assert sphere.nbytes == 448_098
    assert np.abs(np.linalg.norm(sphere.positions(), axis=1) - 128).max() < nodes_off
    nodes = sphere.positions().reshape(-1, 17, 17, 3)
    middles = (nodes[:, 1:, 1:] + nodes[:, 1:, :-1] + nodes[:, :-1, 1:] + nodes[:, :-1, :-1]) / 4
    assert np.abs(np.linalg.norm(middles, axis=-1) - 128).max() < min(sphere.bound, middles_off)
    assert (np.einsum("pa,pa->p", sphere.axis_z, sphere.origins) > 0).all()


def test_perfect_sphere_fits_as_well_as_bilinear_cells_can():
    # Exact nodes, raised by what cells dip, are off by 0.00040 RMS; nodes rounded to the paper's step by 0.0023.
    nodes = models.perfect_sphere().positions()[:289].reshape(1, 17, 17, 3)
    at = (np.arange(8) + 0.5) / 8
    rows = nodes[:, None, :-1] + at[:, None, None, None] * (nodes[:, None, 1:] - nodes[:, None, :-1])
    places = rows[..., None, :-1, :] + at[:, None, None] * (rows[..., None, 1:, :] - rows[..., None, :-1, :])
    error = np.linalg.norm(places, axis=-1) - 128
    assert np.sqrt((error ** 2).mean()) < 0.00052 and np.abs(error).max() < 0.0018


@pytest.mark.parametrize("options, deep", [({}, 1.4), ({"patches": 32, "nodes": 5}, 0.4), ({"patches": 57}, 0.4),
                                           ({"patches": 2712, "radius": 1e-3, "nodes": 9}, 0.4)])
def test_perfect_sphere_has_no_gap(options, deep):
    sphere = models.perfect_sphere(**options)
    assert margin(sphere, options.get("radius", 128) * directions(200_000)).min() > deep


@pytest.mark.parametrize("options, word", [({"patches": 31}, "patches"), ({"radius": 0}, "radius"),
                                           ({"step": 0}, "step"),
                                           ({"nodes": 4}, "nodes"), ({"patches": 40.5}, "patches")])
def test_perfect_sphere_says_what_it_cannot_do(options, word):
    with pytest.raises(InputError, match=word):
        models.perfect_sphere(**options)
