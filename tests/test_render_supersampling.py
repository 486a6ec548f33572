"""Supersampling: the mean of a pixel's samples for the colour, one sample's values for everything else."""

import numpy as np
import pytest
from reference import render_patch_modes as twin
from reference.surfaces import leaves, sphere

from clsurf.errors import InputError
from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer
from clsurf.render.shade import CHANNELS, Shading

SIZE = (45, 31)
CAMERA = Camera.look_at((0.3, 0.8, 3), (0, 0, 0), fov=30)


def half_plane(angle):
    """A flat disc of radius 50 whose rim passes through the origin as a line at `angle` (degrees), facing +z."""
    across = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0])
    ones = np.ones((1, 1))
    return leaves(50 * across[None] * ones, np.full(1, 50 / 0.8), np.array([[0.0, 0, 1]]), np.zeros((1, 1)), 1)


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("factor", (2, 3, 4))
def test_average(device, lanes, factor):
    """Every channel is the twin's of the large picture."""
    ball = sphere(200)
    large = tuple(factor * n for n in SIZE)
    with Renderer(device, lanes=lanes) as r:
        fine = r.render(ball, CAMERA, large, CHANNELS)
        got = r.render(ball, CAMERA, SIZE, CHANNELS, supersampling=factor)
    wanted = twin.average(fine.channels, factor)
    for name in CHANNELS:
        assert got.channels[name].dtype == CHANNELS[name][1]
        if name == "color":
            assert np.abs(got.color - wanted["color"]).max() < 1e-6
        else:
            assert np.array_equal(got.channels[name], wanted[name], equal_nan=got.channels[name].dtype == np.float32)


def test_odd_factors_keep_depth_and_normal(device):
    """The centre sample is the pixel's own: everything but the colour stays as it is without supersampling."""
    camera = Camera.orthographic((1, 2, 3), (0, 0, 0), height=2.5)
    with Renderer(device) as r:
        one, three = (r.render(sphere(300), camera, SIZE, ("depth", "normal", "id"), supersampling=s) for s in (1, 3))
    both = np.isfinite(one.depth) & np.isfinite(three.depth)
    assert (one.id != three.id).mean() < 0.002 and both.sum() > 450
    assert np.abs(one.depth - three.depth)[both].max() < 1e-4


@pytest.mark.parametrize("factor", (1, 2, 3, 4))
def test_a_constant_picture_stays_exact(device, factor):
    with Renderer(device) as r:
        frame = r.render([], CAMERA, SIZE, ("color", "depth"), background=(0.2, 0.4, 0.6, 0.5), supersampling=factor)
        plain = r.render([], CAMERA, SIZE, ("color",), background=(0.2, 0.4, 0.6, 0.5))
    assert np.isnan(frame.depth).all()
    assert np.abs(frame.color - plain.color).max() == 0


@pytest.mark.parametrize("angle", (0, 17, 40, 73))
def test_edge_of_a_half_plane(device, angle):
    """Coverage of the pixels on a straight slanted edge: within what s x s samples can tell, and unbiased."""
    size = (64, 64)
    camera = Camera.orthographic((0, 0, 5), (0.01, 0.02, 0), height=0.5)
    y, x = np.mgrid[:64, :64] + 0.5
    right, up = (x - 32) * 0.5 / 64 + 0.01, (32 - y) * 0.5 / 64 + 0.02
    signed = (right * np.cos(np.radians(angle)) + up * np.sin(np.radians(angle))) * 64 / 0.5  # pixels from the edge
    fine = np.linspace(-0.5, 0.5, 41)[:-1] + 0.0125
    shift = fine[:, None] * np.cos(np.radians(angle)) + fine[None] * np.sin(np.radians(angle))
    wanted = (signed[..., None, None] + shift > 0).mean(axis=(-2, -1))
    error = {}
    with Renderer(device) as r:
        for factor in (1, 2, 4):
            frame = r.render(half_plane(angle), camera, size, ("color",), Shading(look="flat", color=(1, 1, 1)),
                             background=(0, 0, 0, 0), supersampling=factor)
            cover = frame.color[..., 3]
            assert np.allclose(cover, frame.color[..., 0], atol=1e-6)
            assert np.abs(cover - wanted).max() <= 1 / factor + 0.03
            error[factor] = np.sqrt(np.mean((cover - wanted) ** 2))
    if angle:
        assert error[2] < 0.7 * error[1] and error[4] < 0.7 * error[2]


def test_lone_channels(device):
    with Renderer(device) as r:
        for name in CHANNELS:
            frame = r.render(sphere(50), CAMERA, SIZE, (name,), supersampling=2)
            assert list(frame.channels) == [name] and frame.size == SIZE


def test_wrong_factors_are_refused(device):
    with Renderer(device) as r:
        for bad in (0, 5, 1.5, True, "2", None):
            with pytest.raises(InputError, match="supersampling"):
                r.render(sphere(20), CAMERA, SIZE, supersampling=bad)
