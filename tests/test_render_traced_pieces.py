"""Models larger than a device's largest buffer in pictures with traced light: that of the whole."""

import logging

import numpy as np
import pytest
from reference.ray_scenes import torus_mesh
from reference.small_device import small
from test_trace_pieces import fresh

import clsurf
from clsurf import Light, Scene, Shading, models
from clsurf.render.renderer import Renderer

SIZE = (64, 64)
SUN = [Light("directional", (0.5, 0.3, 1.0)), Light("point", (2.0, 1.0, 6.0))]
# What limits the largest buffer: more than the picture takes, and less than rays want of the thing.
LIMITS = {"mesh": 400_000, "slim": 500_000, "patches": 400_000, "surfels": 300_000, "scale_map": 700_000}


@pytest.fixture(scope="module")
def things(device):
    scan, globe = torus_mesh(180, 90), models.earth(patches=32)
    return {"mesh": scan, "slim": clsurf.build_slim(scan, error=0.0004, device=device), "patches": globe,
            "surfels": clsurf.build_surfels(scan, device=device),
            "scale_map": clsurf.build_scale_map(globe, size=80, layers=2, device=device)}


def floor(thing):
    """A mirror below a thing."""
    low, high = thing.bounds
    reach = 2 * (high - low).max()
    x, y, z = *((low + high) / 2)[:2], low[2] - 0.1 * (high - low)[2]
    return clsurf.Mesh(np.array([[x - reach, y - reach, z], [x + reach, y - reach, z], [x, y + 2 * reach, z]]),
                       np.array([[0, 1, 2]]))


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("kind", LIMITS)
def test_light_is_that_of_the_whole(things, device, caplog, kind, lanes):
    thing = things[kind]
    camera = clsurf.Camera.framing(thing, direction=(0.4, -0.6, 1), aspect=SIZE[0] / SIZE[1])
    for shading in (Shading(shadows=True, occlusion=16), Shading(shadows=True, mirror=(0.0, 0.6))):
        with Renderer(device, lanes=lanes) as renderer:
            wanted = renderer.render(Scene([thing, floor(thing)], lights=SUN), camera, SIZE, ("color", "depth"),
                                     shading)
        again, below = fresh(thing), floor(thing)
        with small(device, LIMITS[kind]), caplog.at_level(logging.INFO, "clsurf"):
            with Renderer(device, lanes=lanes) as renderer:
                got = renderer.render(Scene([again, below], lights=SUN), camera, SIZE, ("color", "depth"), shading)
            assert "traced in parts" in caplog.text
        caplog.clear()
        np.testing.assert_array_equal(np.isfinite(got.depth), np.isfinite(wanted.depth))
        apart = np.abs(got.color - wanted.color).max(axis=-1)
        # Of overlapping discs and patches another may be seen at a cut of what is drawn.
        assert (apart < 0.02).mean() > (0.97 if kind == "surfels" else 0.99) and apart.mean() < 0.002
