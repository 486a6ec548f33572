"""Noise and the radius of least risk: known noise is found, radii shrink with it and with the curvature."""

import numpy as np
import pytest
from reference import analysis_curvature as reference

from clsurf import models
from clsurf.analysis import risk
from clsurf.build.point_tree import build_point_tree


def tree_of(points, normals, device, middle=(0, 0, 0), scale=0.25):
    return build_point_tree(np.ascontiguousarray(points, np.float32), np.ascontiguousarray(normals, np.float32),
                            np.array(middle, np.float32), scale, device)


def noisy_torus(sigma, n=6000, seed=3):
    cloud = models.torus(n)
    shift = np.random.default_rng(seed).normal(0, 1, n).astype(np.float32)[:, None] * cloud.normals
    return cloud.points + sigma * shift, cloud.normals


@pytest.mark.parametrize("sigma", [0.002, 0.01])
def test_the_noise_level_is_the_noise(device, sigma):
    tree = tree_of(*noisy_torus(sigma), device)
    samples = risk.spread_samples(tree)
    assert risk.noise_level(tree, samples) / 0.25 == pytest.approx(sigma, rel=0.1)


def test_exact_points_have_next_to_no_noise(device):
    tree = tree_of(*noisy_torus(0), device)
    samples = risk.spread_samples(tree)
    assert risk.noise_level(tree, samples) < 5e-3 * np.median(samples.spacing)


def test_local_spacings_are_those_of_an_even_grid(device):
    side = np.linspace(-1, 1, 101)
    grid = np.stack([*np.meshgrid(side, side), np.zeros((101, 101))], axis=-1).reshape(-1, 3)
    tree = tree_of(grid, np.tile((0, 0, 1.0), (len(grid), 1)), device)
    spacing = risk.local_spacings(tree, np.arange(tree.padded // 16, dtype=np.int32))
    assert np.median(spacing) == pytest.approx(0.02 / 4, rel=0.15)


@pytest.mark.parametrize("lanes", (16, 1))
def test_sample_fits(device, lanes, monkeypatch):
    monkeypatch.setattr(device, "lanes", lanes)
    points, normals = noisy_torus(0.003, 3000)
    tree = tree_of(points, normals, device)
    samples = risk.spread_samples(tree, 20)
    radius = samples.spacing[:, None] * np.array([3.5, 6.0, 12.0])
    found = risk.fit_samples(tree, samples, radius, residual=True)
    host = device.download(tree.sorted)[:, :tree.count].astype(np.float64)
    wanted = reference.sample_fits(host, samples.index, radius)
    np.testing.assert_array_equal(found[..., 0], wanted[..., 0])
    np.testing.assert_allclose(found[..., 1:], wanted[..., 1:], rtol=2e-3, atol=2e-4)
    np.testing.assert_allclose(found[..., 5], wanted[..., 5], rtol=1e-3)
    some = risk.fit_samples(tree, samples, radius, skips=[0, 1, 3])
    for number, step in enumerate((1, 2, 4)):
        np.testing.assert_array_equal(some[::step, number, :5], found[::step, number, :5])
        assert step == 1 or not some[1::step, number].any()


def test_radii_grow_with_the_noise_and_follow_the_shape(device):
    def radii(sigma, quantity="curvature"):
        tree = tree_of(*noisy_torus(sigma, 12000), device)
        samples = risk.spread_samples(tree)
        fits = risk.two_degree_fits(tree, samples)
        return risk.least_risk_radius(samples, fits, risk.noise_level(tree, samples), quantity), samples

    exact, samples = radii(0)
    few, _ = radii(0.002)
    many, _ = radii(0.01)
    assert np.median(exact) < 3.5 * np.median(samples.spacing)
    assert 1.5 * np.median(exact) < np.median(few) and 1.2 * np.median(few) < np.median(many)
    assert (few > 0).all() and np.isfinite(few).all()
    heights, _ = radii(0.002, "height")
    assert 3 < np.median(heights) / np.median(samples.spacing) < 20


def test_block_radii_lie_between_their_samples(device):
    tree = tree_of(*noisy_torus(0, 4000), device)
    samples = risk.spread_samples(tree, 100)
    radius = 0.01 + 0.01 * (samples.position[:, 0] > 0)
    found = risk.block_radii(tree, samples, radius)
    assert found.shape == (250,) and found.min() >= 0.00999 and found.max() <= 0.02001
    host = device.download(tree.sorted)[0, 8::16]
    assert (found[host > 0.1] > 0.0199).all() and (found[host < -0.1] < 0.0101).all()


def test_average_normals(device):
    rng = np.random.default_rng(5)
    points, normals = noisy_torus(0.004, 3000)
    normals = normals + 0.4 * rng.normal(size=normals.shape)
    tree = tree_of(points, normals, device)
    found = risk.with_mean_normals(tree, 0.03)
    host = device.download(tree.sorted)[:, :tree.count].astype(np.float64)
    got = device.download(found.sorted)[:, :tree.count]
    np.testing.assert_array_equal(got[:3], host[:3])
    np.testing.assert_allclose(got[3:], reference.average_normals(host, 0.03), atol=2e-3)


def test_a_small_cloud_gives_all_its_points(device):
    tree = tree_of(*noisy_torus(0, 50), device)
    samples = risk.spread_samples(tree)
    np.testing.assert_array_equal(samples.index, np.arange(50))
    assert np.isfinite(risk.noise_level(tree, samples))
