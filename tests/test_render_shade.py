"""Shading, the renderer's options and life, and the golden pictures.

``python tests/test_render_shade.py`` writes the golden pictures anew.
"""

import gc
from pathlib import Path

import numpy as np
import pytest
from reference import render as twin
from reference.surfaces import fitted, leaves, sphere, torus_points
from test_render_project import LANES

from clsurf.device import Profile
from clsurf.errors import DeviceError, DeviceMemoryError, InputError
from clsurf.io import images
from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer, render, shared_renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Light, Shading, shading_floats
from clsurf.render.tiles import view_floats
from clsurf.surface.srgb import to_linear

SIZE = (60, 44)
GOLDEN = Path(__file__).parent / "golden"
OUT = Path(__file__).parent / "out"
LIGHTS = (Light(), Light("directional", (1, 2, 0.5), (0.5, 0.4, 0.3)), Light("point", (1, 1, 2), (0.2, 0.3, 0.6)))


def colored(surface):
    values = np.random.default_rng(2).integers(0, 256, (len(surface), 4)).astype(np.uint8)
    return leaves(surface.centers, surface.radii, surface.normals, surface.coefficients, surface.degree, colors=values)


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("camera", [Camera.look_at((0.4, 1.0, 3.2), (0, 0, 0)),
                                    Camera.orthographic((1, -2, 3), (0, 0, 0), height=2.4)],
                         ids=("perspective", "orthographic"))
def test_shade(device, lanes, camera):
    surface, shading = sphere(300), Shading(ambient=0.1, diffuse=0.7, specular=0.4, shininess=13)
    back = (0.2, 0.4, 0.6, 0.5)
    with Renderer(device, lanes=lanes) as r:
        frame = r.render(Scene([surface], LIGHTS), camera, SIZE, shading=shading, background=back)
    depth = np.where(np.isnan(frame.depth), np.inf, frame.depth).ravel().astype(np.float64)
    gradient = frame.normal.reshape(-1, 3).astype(np.float64) @ camera.rotation.T
    base = np.tile(to_linear(shading.color), (len(depth), 1))
    wanted = twin.shade(view_floats(camera, SIZE), shading_floats(shading, LIGHTS, back, camera),
                        twin.pixel_centres(SIZE), depth, gradient, base)
    assert np.isfinite(depth).sum() > 300
    assert np.abs(frame.color.reshape(-1, 4) - wanted).max() < 2e-4


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("camera", [Camera.look_at((0.4, 1.0, 3.2), (0, 0, 0)),
                                    Camera.orthographic((1, -2, 3), (0, 0, 0), height=2.4)],
                         ids=("perspective", "orthographic"))
def test_reflection_lines(device, lanes, camera):
    """Lines where the mirrored direction to the eye says, in the surface's own colour, lights or not."""
    shading = Shading(look="reflection", stripes=5)
    with Renderer(device, lanes=lanes) as r:
        frame = r.render(Scene([sphere(300)], LIGHTS), camera, SIZE, shading=shading)
    hit = np.isfinite(frame.depth)
    gradient = frame.normal[hit].astype(np.float64) @ camera.rotation.T
    wanted = twin.reflection_lines(view_floats(camera, SIZE), 5, twin.pixel_centres(SIZE)[hit.ravel()], gradient)
    assert np.abs(frame.color[..., :3][hit] - wanted[:, None] * to_linear(shading.color)).max() < 2e-4
    assert 0.3 < (wanted > 0.5).mean() < 0.7


def test_headlight_shades_the_visible_side(device):
    """Brightest where the surface faces the eye, and never darker than the ambient light."""
    with Renderer(device) as r:
        frame = r.render(sphere(800), Camera.orthographic((0, 0, 4), (0, 0, 0), height=2.2), (110, 110))
    hit = np.isfinite(frame.depth)
    toward = np.where(hit, frame.normal[..., 2], 0)
    assert (toward[hit] > 0).all()
    assert np.corrcoef(toward[hit], frame.color[..., 0][hit])[0, 1] > 0.9
    assert frame.color[..., :3][hit].min() >= 0.12 * to_linear(Shading().color).min() - 1e-6


@pytest.mark.parametrize("lanes", (16, 1))
def test_colors(device, lanes):
    """One flat colour per surfel where balls do not overlap; blended in between; unlit as stored."""
    surface = colored(sphere(40, reach=1.6))
    camera = Camera.look_at((0, 0, 4), (0, 0, 0))
    with Renderer(device, lanes=lanes) as r:
        frame = r.render(surface, camera, SIZE, ("color", "depth", "count"), shading="flat")
        plain = r.render(surface, camera, SIZE, ("color",), shading=Shading(look="flat", model_colors=False))
        lit = r.render(surface, camera, SIZE, ("color",))
    linear = to_linear(surface.colors[:, :3] / 255)
    hit = np.isfinite(frame.depth)
    alone = frame.color[..., :3][frame.count == 1]
    assert len(alone) and np.abs(alone[:, None] - linear[None]).max(axis=2).min(axis=1).max() < 1e-5
    assert (frame.color[..., :3][hit] <= linear.max(axis=0) + 1e-5).all()
    assert np.allclose(plain.color[..., :3][hit], to_linear(Shading().color), atol=1e-6)
    assert np.std(lit.color[..., :3][hit], axis=0).min() > 0.01


def test_mixed_scene_of_plain_and_colored(device):
    shift = np.eye(4)
    shift[0, 3] = 2.5
    with Renderer(device) as r:
        frame = r.render([colored(sphere(100)), sphere(100).moved(shift)], None, (120, 60), ("color", "id"), "flat")
    assert np.allclose(frame.color[..., :3][frame.id == 1], to_linear(Shading().color), atol=1e-6)
    assert np.std(frame.color[..., 0][frame.id == 0]) > 0.05


def test_cost_is_where_the_work_is(device):
    with Renderer(device) as r:
        frame = r.render(sphere(300), Camera.look_at((0, 0, 6), (0, 0, 0)), (160, 160), ("depth", "cost"))
    hit = np.isfinite(frame.depth)
    assert frame.cost.dtype == np.int32 and (frame.cost[hit] > 0).all() and (frame.cost[:8, :8] == 0).all()
    assert (frame.cost.reshape(20, 8, 20, 8) == frame.cost.reshape(20, 8, 20, 8)[:, :1, :, :1]).all()


# The renderer ---------------------------------------------------------------------------------------------------------


def test_options_are_checked(device):
    ball = sphere(20)
    with Renderer(device) as r:
        for bad in (dict(size=(0, 5)), dict(size=(5.5, 5)), dict(size=5), dict(size=(70000, 5)),
                    dict(channels=("colour",)), dict(channels=()), dict(lod=-1),
                    dict(lod=np.nan), dict(background=(1, 1)), dict(shading="shiny")):
            with pytest.raises(InputError):
                r.render(ball, **({"size": (8, 8)} | bad))
        with pytest.raises(InputError, match="build_slim"):
            r.render(np.zeros((4, 3)))
    for bad in (dict(lanes=3), dict(tile=12), dict(tile=0)):
        with pytest.raises(InputError):
            Renderer(device, **bad)
    with pytest.raises(InputError):
        Light("laser")
    with pytest.raises(InputError):
        Shading(shininess=0.5)


def test_too_large_a_picture_is_refused_before_it_is_made(device):
    with Renderer(device) as r, pytest.raises(DeviceMemoryError, match="GB"):
        r.render(sphere(20), None, (65536, 65536))


def test_more_than_a_buffer_may_have_is_a_clear_error(device):
    with pytest.raises(DeviceMemoryError, match="no room"):
        device.empty((device.largest_buffer_bytes + 4096,), np.uint8)


def test_close(device):
    r = Renderer(device)
    r.render(sphere(20), None, (8, 8))
    r.close()
    r.close()
    with pytest.raises(DeviceError, match="closed"):
        r.render(sphere(20), None, (8, 8))


def test_frames_own_their_arrays(device):
    camera = Camera.look_at((0, 0, 4), (0, 0, 0))
    with Renderer(device) as r:
        first = r.render(sphere(200), camera, (64, 64))
        kept = first.depth.copy()
        for i in range(3):
            r.render(sphere(200), camera.orbited((0, 0, 0), 20 * i + 20), (64, 64))
    assert np.array_equal(first.depth, kept, equal_nan=True)


def test_uploads_live_as_long_as_their_surface(device):
    with Renderer(device) as r:
        surface = sphere(50)
        r.render(surface, None, (16, 16))
        r.render(surface, None, (16, 16))
        assert len(r._uploads) == 1
        del surface
        gc.collect()
        assert len(r._uploads) == 0


def test_profile(device):
    with Renderer(device, profile=True) as r:
        r.render(sphere(200), None, (64, 64))
        assert {"project_slim", "count_bins", "fill_bins", "tile_slim", "shade"} <= set(r.profile.seconds)
        assert "tile_slim" in str(r.profile)
    assert isinstance(r.profile, Profile) and device.profile is None


def test_render_once(device):
    surface = sphere(100)
    frame = render(surface, size=(40, 30), device=device)
    assert frame.size == (40, 30) and np.isfinite(frame.depth).any()
    assert shared_renderer(device) is shared_renderer(device)
    with pytest.raises(AttributeError, match="channels"):
        frame.level  # noqa: B018


# Golden pictures ------------------------------------------------------------------------------------------------------


def golden_pictures(device):
    torus, ball = fitted(*torus_points(3000), 0.2, 2), sphere(200)
    camera = Camera.look_at((0.6, 2.0, 4.2), (0, 0, 0))
    sizes = ball.radii * np.random.default_rng(4).uniform(0.5, 1.2, len(ball))
    balls = leaves(ball.centers, sizes, ball.normals, ball.coefficients, 2)
    with Renderer(device) as r:
        return {"torus": images.to_srgb8(r.render(Scene([torus], LIGHTS), camera, (128, 128)).color),
                "balls": images.to_srgb8(r.render(balls, camera, (128, 128), shading="ball_size").color)}


@pytest.mark.parametrize("name", ("torus", "balls"))
def test_golden(device, name):
    got = golden_pictures(device)[name][..., :3]
    with np.load(GOLDEN / "render.npz") as kept:
        wanted = kept[name]
    difference = np.abs(got.astype(int) - wanted).max(axis=2)
    if (difference > 3).mean() > 0.002:
        OUT.mkdir(exist_ok=True)
        gray = np.repeat(difference[..., None], 3, 2)
        for label, picture in (("got", got), ("wanted", wanted), ("difference", gray)):
            path = OUT / f"{name}_{label}.png"
            path.write_bytes(images.png_bytes(np.clip(picture, 0, 255).astype(np.uint8)))
            print(path)
        pytest.fail(f"{name}: {(difference > 3).sum()} pixels differ; got, wanted and difference are in {OUT}")


if __name__ == "__main__":
    from clsurf.device import open_device
    GOLDEN.mkdir(exist_ok=True)
    pictures = golden_pictures(open_device("pocl"))
    np.savez_compressed(GOLDEN / "render.npz", **{name: picture[..., :3] for name, picture in pictures.items()})
