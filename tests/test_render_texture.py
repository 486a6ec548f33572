"""Textures on meshes: which way up, exact texels, filtering, smaller levels, repetition."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer
from clsurf.render.shade import Shading
from clsurf.render.texture import texture_levels
from clsurf.surface.mesh import Mesh
from clsurf.surface.srgb import LINEAR_OF_BYTE

FLAT = Shading(look="flat")


@pytest.fixture(scope="module")
def renderers(device):
    """Renderers in both kernel forms."""
    with Renderer(device) as lanes, Renderer(device, lanes=1) as items:
        yield lanes, items


def square(texture, repeats=1.0):
    """The square from (-1, -1) to (1, 1) in the plane z = 0 under a texture."""
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    uv = (points[:, :2] + 1) / 2 * repeats
    return Mesh(points, [[0, 1, 2], [0, 2, 3]], uv=uv, texture=texture)


def picture(h, w, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (h, w, 4)).astype(np.uint8)


def test_levels_keep_the_mean():
    for h, w in ((64, 32), (37, 51), (1, 9), (1, 1)):
        levels = texture_levels(picture(h, w))
        assert levels[-1].shape[:2] == (1, 1)
        for a, b in itertools.pairwise(levels):
            assert b.shape[0] == max(a.shape[0] // 2, 1) and b.shape[1] == max(a.shape[1] // 2, 1)
        if h == 64:
            mean = LINEAR_OF_BYTE[levels[0][..., :3]].mean((0, 1))
            assert np.abs(LINEAR_OF_BYTE[levels[-1][0, 0, :3]] - mean).max() < 0.01
    assert (np.concatenate([x.ravel() for x in texture_levels(np.full((37, 51, 4), 99, np.uint8))])[:5] == 99).all()


def test_a_texel_a_pixel(renderers):
    """A picture of as many texels as pixels is shown as it is, row 0 on top."""
    texture = picture(16, 16)
    camera = Camera.orthographic((0, 0, 3), (0, 0, 0), height=2)
    for renderer in renderers:
        frame = renderer.render(square(texture), camera, size=(16, 16), shading=FLAT)
        assert np.abs(frame.color[..., :3] - LINEAR_OF_BYTE[texture[..., :3]]).max() < 1e-3
        repeated = renderer.render(square(texture[:8, :8], 2.0), camera, size=(16, 16), shading=FLAT)
        tiled = LINEAR_OF_BYTE[np.tile(texture[:8, :8], (2, 2, 1))[..., :3]]
        assert np.abs(repeated.color[..., :3] - tiled).max() < 1e-3


def test_magnified_texels_are_blended_and_minified_ones_averaged(renderers):
    ramp = np.zeros((4, 4, 4), np.uint8)
    ramp[..., :3] = np.array([0, 80, 160, 240], np.uint8)[None, :, None]
    camera = Camera.orthographic((0, 0, 3), (0, 0, 0), height=2)
    for renderer in renderers:
        color = renderer.render(square(ramp), camera, size=(64, 64), shading=FLAT).color[32, :, 0]
        want = np.interp((np.arange(64) + 0.5) / 16 - 0.5, range(4), LINEAR_OF_BYTE[[0, 80, 160, 240]])
        assert np.abs(color[8:56] - want[8:56]).max() < 1e-3
        noise = picture(512, 512)
        far = Camera.look_at((0, 0, 3), (0, 0, 0), fov=170)
        frame = renderer.render(square(noise), far, size=(64, 64), shading=FLAT, channels=("color", "depth"))
        seen = np.isfinite(frame.depth)
        mean = LINEAR_OF_BYTE[noise[..., :3]].mean((0, 1))
        assert seen.sum() > 3 and np.abs(frame.color[seen, :3].mean(0) - mean).max() < 0.05
        assert frame.color[seen, :3].std(0).max() < 0.05


def test_textures_wait_for_model_colors(renderers):
    mesh = square(picture(16, 16))
    camera = Camera.orthographic((0, 0, 3), (0, 0, 0), height=2)
    bare = replace(mesh, texture=None)
    for renderer in renderers:
        plain, off = (renderer.render(m, camera, size=(16, 16), shading=replace(FLAT, model_colors=on)).color
                      for m, on in ((bare, True), (mesh, False)))
        assert np.array_equal(plain, off)
