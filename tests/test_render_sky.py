"""Image lights and backdrops: closed forms, seams, the float64 twins, pictures of every kind."""

import numpy as np
import pytest
from reference import light as twin
from reference import render as reference
from reference.surfaces import sphere

from clsurf.errors import InputError
from clsurf.io import images
from clsurf.render.camera import Camera
from clsurf.render.light import Light
from clsurf.render.material import Material
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.skies import SKIES, directions_of, linear_picture, look_up
from clsurf.render.sky import folded, prefilter_sky, prepared_sky, sky_lamps, sky_tree, unfolded
from clsurf.render.tiles import view_floats
from clsurf.surface.srgb import to_linear

CAMERA = Camera.look_at((0.3, 0.9, 3.4), (0, 0, 0), fov=35)
RANDOM = np.random.default_rng(11)


def directions(count=500):
    d = RANDOM.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def of(function, height=128):
    """The picture (h, 2 h, 3) of a function of directions."""
    return np.repeat(function(directions_of(height, 2 * height))[..., None], 3, 2).astype(np.float32)


def part(sky, place):
    return sky.texels[place[0]:place[0] + (place[1] + 1) ** 2, :3]


def blobs(height=64):
    """A sky of a few soft lamps over a gradient."""
    axis = np.array([0.6, 0.3, -0.74])
    return of(lambda d: 0.3 + 0.2 * d[..., 1] + 5 * np.clip(d @ axis, 0, 1) ** 60 + 2 * np.clip(-d[..., 2], 0, 1) ** 9,
              height)


def drawn(device, scene, size=(48, 40), camera=CAMERA, lanes=16, channels=("color", "depth"), **more):
    with Renderer(device, lanes=lanes) as r:
        return r.render(scene, camera, size, channels, **more)


def test_the_square_unfolds_every_direction():
    d = directions()
    assert np.abs(folded(*unfolded(d)) - d).max() < 1e-12
    u, v = np.linspace(-1, 1, 9), np.ones(9)
    for side in (folded(u, v), folded(u, -v), folded(v, u), folded(-v, u)):  # both halves of a rim are one
        assert np.abs(side - side[::-1]).max() < 1e-12


def test_constant_sky_is_constant_at_every_roughness(device):
    sky = prepared_sky(device, np.full((64, 128, 3), 0.7, np.float32))
    assert len(sky.mirror) == 9 and np.abs(sky.texels[:, :3] - 0.7).max() < 1e-4
    assert sum(level[..., 3].sum() for level in sky_tree(np.ones((64, 128, 3)))[:1]) == pytest.approx(4 * np.pi)


def test_matte_light_of_a_cosine_and_of_half_a_sky(device):
    """A sky of 1 + cosine to an axis lights by 1 + 2/3 cosine; one white half, by (1 + cosine) / 2."""
    axis, d = np.array([0.48, 0.6, -0.64]), directions()
    for height, light, wanted in ((64, lambda d: 1 + d @ axis, 1 + 2 / 3 * (d @ axis)),
                                  (512, lambda d: (d @ axis > 0) * 1.0, (1 + d @ axis) / 2)):
        sky = prepared_sky(device, of(light, height))
        got = twin.octahedral(part(sky, sky.matte), d)
        assert np.abs(got - wanted[:, None]).max() < 4e-3
        assert np.abs(got.mean(axis=1) - wanted).mean() < 1e-3


@pytest.mark.parametrize("alpha", (0.05, 0.3, 1.0, None))
def test_prefilter_sky(device, alpha):
    """The quadtree's walk against the sum over all pixels of the picture."""
    picture = blobs()
    levels = sky_tree(picture)
    tree = device.upload(np.concatenate([level.reshape(-1, 4) for level in levels]))
    got = prefilter_sky(device, tree, 3 + len(levels), alpha, 16)[:, :3]
    wanted = twin.prefilter_sky(look_up(picture, directions_of(192, 384)), alpha, twin.corners(16))
    error = np.abs(got - wanted)
    assert error.max() < 0.025 * wanted.max() and error.mean() < 0.004 * wanted.mean()


def test_a_small_sun_is_neither_lost_nor_a_firefly(device):
    """A sun of one pixel, 20,000 times as bright: every map has its light, smooth, and brightest toward it."""
    picture = np.full((256, 512, 3), 0.1, np.float32)
    picture[70, 200] = 2000
    to = directions_of(256, 512)[70, 200]
    solid = 2 * np.pi / 512 * (np.cos(np.pi * 70 / 256) - np.cos(np.pi * 71 / 256))
    sky = prepared_sky(device, picture)
    d = directions()
    wanted = 0.1 + 2000 * solid / np.pi * np.clip(d @ to, 0, None)
    assert np.abs(twin.octahedral(part(sky, sky.matte), d)[:, 0] - wanted).max() < 0.02 * wanted.max()
    rough = twin.octahedral(part(sky, sky.mirror[6]), d)[:, 0]
    near = np.argsort(d @ to)
    assert np.diff(rough[near]).min() > -0.05 * rough.max()  # cells are up to 0.12 of their distance off
    lamps = sky_lamps(sky, d[:128])
    total = (2000 * solid + 0.1 * (4 * np.pi - solid))
    assert np.abs(lamps[:, 0].sum() - total) < 1e-3 * total


@pytest.mark.parametrize("turn", (0, 90, 211))
def test_no_seams(device, turn):
    """A mirroring sphere and a matte one show no step where the square's rims or the picture's edges meet."""
    light = Light("image", picture=of(lambda d: 1 + 0.5 * d[..., 1] + 0.3 * d[..., 0] - 0.2 * d[..., 2]), rotation=turn)
    for back in (False, True):
        camera = Camera.orthographic((0, 0, -4 if back else 4), (0, 0, 0), height=2.0)
        for material in (Material("physical", (1, 1, 1), metallic=1, roughness=0.3), Material(diffuse=1, specular=0)):
            frame = drawn(device, Scene([sphere(900)], [light], material), (64, 64), camera,
                          channels=("color", "depth", "normal"))
            inner = np.nan_to_num(np.abs(frame.normal[..., 2])) > 0.6
            for axis in (0, 1):
                second = np.abs(np.diff(frame.color[..., 0], n=2, axis=axis))
                keep = inner[1:-1] if axis == 0 else inner[:, 1:-1]
                assert second[keep].max() < 0.012


def test_which_way_the_picture_lies(device):
    """Red right of the middle, green up, blue in the middle: +x, +y and -z, turned with `rotation` and `up`."""
    picture = np.zeros((64, 128, 3), np.float32)
    for i, axis in enumerate(([1, 0, 0], [0, 1, 0], [0, 0, 1])):
        picture[..., i] = directions_of(64, 128) @ np.array(axis) > 0.9
    for more, ways in (({}, ((1, 0, 0), (0, 1, 0), (0, 0, -1))),
                       ({"rotation": 90}, ((0, 0, -1), (0, 1, 0), (-1, 0, 0))),
                       ({"up": (0, 0, 1)}, ((1, 0, 0), (0, 0, 1), (0, 1, 0)))):
        light = Light("image", picture=picture, **more)
        for i, way in enumerate(np.array(ways, float)):
            up = (0, 0, 1) if abs(way[1]) > 0.5 else (0, 1, 0)
            frame = drawn(device, [], (4, 4), Camera.look_at((0, 0, 0), way, up, fov=10), background=light)
            assert (frame.color[..., i] == 1).all() and frame.color[..., :3].sum() == 16
            chrome = Material("physical", (1, 1, 1), metallic=1, roughness=0)
            ball = drawn(device, Scene([sphere(300)], [light], chrome), (9, 9),
                         Camera.orthographic(5 * way, (0, 0, 0), up, height=2.4))
            assert ball.color[4, 4, i] > 0.99 and ball.color[4, 4, :3].sum() < 1.02


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("camera", [CAMERA, Camera.orthographic((1, 2, 3), (0, 0, 0), height=3)])
def test_backdrop_of_the_sky(device, camera, lanes):
    picture, size = RANDOM.uniform(size=(12, 20, 3)).astype(np.float32), (37, 29)
    light = Light("image", (0, 0, 1), (0.5, 1, 2), 1.5, picture=picture, rotation=30, up=(0.1, 1, -0.3))
    frame = drawn(device, Scene([sphere(100)], [light]), size, camera, lanes, background="sky")
    wanted = twin.surroundings(view_floats(camera, size), light.axes() @ camera.rotation.T, picture,
                               reference.pixel_centres(size)).reshape(29, 37, 3) * light.radiance
    none = np.isnan(frame.depth)
    assert none.sum() > 200 and (~none).sum() > 50
    assert np.abs(frame.color[..., :3] - wanted)[none].max() < 2e-4 and (frame.color[..., 3] == 1).all()


def test_gradient_and_transparent(device):
    top, bottom = np.array([0.1, 0.2, 0.9, 1.0]), np.array([1.0, 0.9, 0.3, 0.2])
    frame = drawn(device, sphere(100), background=(tuple(top), tuple(bottom)))
    none = np.isnan(frame.depth)
    for y in (0, 17, 39):
        mixed = top + (y + 0.5) / 40 * (bottom - top)
        here = frame.color[y][none[y]]
        assert len(here) and np.abs(here - [*(to_linear(mixed[:3]) * mixed[3]), mixed[3]]).max() < 1e-6
    bare = drawn(device, sphere(100), background="transparent")
    assert (bare.color[none] == 0).all() and (bare.color[~none, 3] == 1).all()
    assert np.array_equal(bare.color[~none], frame.color[~none])


def test_supersampled_edges_let_the_backdrop_through(device):
    flat, clear = (drawn(device, sphere(200), background=b, supersampling=2) for b in (((0.2,) * 3, (0.2,) * 3),
                                                                                   "transparent"))
    a = clear.color[..., 3:]
    assert ((a > 0) & (a < 1)).sum() > 30
    assert np.abs(flat.color[..., :3] - (clear.color[..., :3] + (1 - a) * to_linear(0.2))).max() < 1e-6


def test_a_picture_fills_the_frame(device, tmp_path):
    """Twice as wide as the frame: its middle half shows."""
    pixels = np.zeros((40, 160, 3), np.uint8)
    pixels[:, :40], pixels[:, 40:80], pixels[:, 80:120] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    images.write_image(tmp_path / "wide.png", pixels)
    frame = drawn(device, [], (80, 40), background=tmp_path / "wide.png")
    assert (frame.color[:, 1:39, 1] == 1).all() and (frame.color[:, 41:79, 2] == 1).all()
    assert (frame.color[..., 0] == 0).all()


def test_pictures_of_every_kind(tmp_path):
    light = RANDOM.uniform(0, 3, (6, 12, 3)).astype(np.float32)
    for ending in (".exr", ".png"):
        images.write_image(tmp_path / f"a{ending}", light)
        back = linear_picture("x", tmp_path / f"a{ending}", SKIES)
        wanted = light if ending == ".exr" else np.clip(light, 0, 1)
        assert back.dtype == np.float32 and np.abs(back - wanted).max() < (1e-6 if ending == ".exr" else 0.005)
    import OpenImageIO as oiio
    out = oiio.ImageOutput.create(str(tmp_path / "a.hdr"))
    out.open(str(tmp_path / "a.hdr"), oiio.ImageSpec(12, 6, 3, "float"))
    out.write_image(light)
    out.close()
    assert np.abs(linear_picture("x", tmp_path / "a.hdr", SKIES) - light).max() < 0.02
    dirty = np.array([[[np.nan, np.inf, -1.0]]])
    assert np.array_equal(linear_picture("x", dirty, SKIES), [[[0, 65504, 0]]])
    for bad in ("moon", tmp_path / "none.exr", np.ones((3, 3)), np.ones((2, 2, 3), np.int32), np.ones((0, 4, 3))):
        with pytest.raises(InputError, match="x: "):
            linear_picture("x", bad, SKIES)


@pytest.mark.parametrize("name", SKIES)
def test_skies_that_are_built_in(name):
    """About as bright as one white lamp, seamless around, no black."""
    picture = SKIES[name]()
    d = directions(4000)
    matte = twin.prefilter_sky(picture[::4, ::4], None, d[:200])
    assert 0.85 < matte.mean(axis=1).max() < 1.15 and matte.min() > 0.05
    assert np.abs(picture[:, 0] - picture[:, -1]).max() <= np.abs(np.diff(picture, axis=1)).max() + 1e-6


@pytest.mark.parametrize("bad", ["sky", "none.png", (1, 1), ((1, 1, 1), (1, 1)), Light(), ((1, 1, 1),) * 3, None])
def test_mistakes_in_backgrounds(device, bad):
    with pytest.raises(InputError, match="background"):
        drawn(device, sphere(20), (8, 8), background=bad)
