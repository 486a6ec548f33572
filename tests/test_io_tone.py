"""Tone curves, exposure, 16 bits and dithering of pictures that are written."""

import numpy as np
import pytest

from clsurf.errors import InputError
from clsurf.io import images
from clsurf.io.tone import TONES, WHITE, tone_mapped
from clsurf.render.frame import Frame

RAMP = np.linspace(0, 6, 601, dtype=np.float32)
CURVES = TONES[1:]


def frame_of(rgb):
    color = np.ones((*np.shape(rgb)[:2], 4), np.float32)
    color[..., :3] = rgb
    return Frame({"color": color})


@pytest.mark.parametrize("tone", CURVES)
def test_curves_rise_from_black_to_white_and_keep_grey(tone):
    out = tone_mapped(np.repeat(RAMP[:, None], 3, 1), tone)
    assert np.ptp(out, axis=1).max() < 4e-3 and np.abs(out[0]).max() < 2e-3
    rise = np.diff(out[:, 1])
    assert (rise >= -1e-6).all() and (rise[RAMP[1:] < 3] > 0).all()
    assert out.max() <= 1.2 and tone_mapped(np.full((1, 3), 100.0), tone)[0, 0] >= 0.97


def test_reinhard_is_exact():
    out = tone_mapped(np.repeat(RAMP[:, None], 3, 1).astype(np.float64), "reinhard")[:, 0]
    assert np.abs(out - RAMP * (1 + RAMP / WHITE**2) / (1 + RAMP)).max() < 1e-6
    assert tone_mapped(np.full((1, 3), WHITE), "reinhard")[0, 0] == pytest.approx(1)


@pytest.mark.parametrize(("tone", "grey"), [("aces", 0.105), ("agx", 0.2147)])
def test_middle_grey_of_the_films(tone, grey):
    """Where the published curves put 18 % grey."""
    assert tone_mapped(np.full((1, 3), 0.18), tone)[0, 1] == pytest.approx(grey, rel=0.03)


def test_agx_turns_bright_colors_pale():
    red = tone_mapped(np.array([[40.0, 0.2, 0.1]]), "agx")[0]
    assert red[1] > 0.3 and tone_mapped(np.array([[40.0, 0.2, 0.1]]), "none")[0, 1] < 0.3


@pytest.mark.parametrize("tone", TONES)
def test_exposure_doubles_light(tone):
    light = np.random.default_rng(1).uniform(0, 2, (5, 7, 3)).astype(np.float32)
    assert np.allclose(tone_mapped(light, tone, 1.5), tone_mapped(light * np.float32(2**1.5), tone), atol=1e-6)


def test_alpha_is_left_alone(tmp_path):
    """Tone and exposure work on straight colour: a half transparent pixel has the colour of an opaque one."""
    color = np.array([[[0.4, 0.2, 0.1, 0.5], [0.8, 0.4, 0.2, 1.0]]], np.float32)
    out = images.to_srgb_bytes(color, None, "agx", 1.0)
    assert np.abs(out[0, 0, :3].astype(int) - out[0, 1, :3]).max() <= 1 and out[0, 0, 3] == 128


def test_sixteen_bits(tmp_path):
    light = np.linspace(0, 1, 3000, dtype=np.float32).reshape(50, 60)[..., None] * np.ones(3, np.float32)
    frame_of(light).save(tmp_path / "deep.png", bits=16)
    read = images.read_image(tmp_path / "deep.png")
    assert read.dtype == np.uint16 and np.array_equal(read, frame_of(light).pixels(bits=16))
    assert len(np.unique(read[..., 0])) > 2900
    assert np.abs(images.to_srgb8(light)[..., :3] - read[..., :3] / 257).max() <= 0.51


def test_dithering_keeps_the_mean():
    """A flat grey between two steps comes out as both, in the right shares; a step itself stays."""
    step = np.float32(1 / 255)
    for part in (0.125, 0.5, 0.8):
        grey = images.from_srgb8(np.array([[[100, 100, 100]]], np.uint8))[0, 0, 0]
        above = images.from_srgb8(np.array([[[101, 101, 101]]], np.uint8))[0, 0, 0]
        flat = np.full((64, 64, 3), grey + part * (above - grey), np.float32)
        got = frame_of(flat).pixels(dither=True)[..., 0].astype(float)
        assert set(np.unique(got)) == {100, 101} and got.mean() == pytest.approx(100 + part, abs=0.02)
    assert step and (frame_of(np.full((9, 9, 3), grey)).pixels(dither=True)[..., 0] == 100).all()


def test_defaults_change_nothing(tmp_path):
    light = np.random.default_rng(3).uniform(0, 1.5, (12, 9, 3)).astype(np.float32)
    assert np.array_equal(frame_of(light).pixels(), images.to_srgb8(frame_of(light).color))
    assert np.array_equal(np.asarray(frame_of(light)), frame_of(light).pixels())


def test_exr_stays_linear(tmp_path):
    light = np.random.default_rng(3).uniform(0, 30, (4, 5, 3)).astype(np.float32)
    frame_of(light).save(tmp_path / "a.exr")
    assert np.array_equal(images.read_channels(tmp_path / "a.exr")["G"], light[..., 1])
    for bad in ({"tone": "aces"}, {"exposure": 1.0}, {"bits": 16}):
        with pytest.raises(InputError, match="linear"):
            frame_of(light).save(tmp_path / "b.exr", **bad)
    assert not (tmp_path / "b.exr").exists()


@pytest.mark.parametrize("bad", [{"tone": "film"}, {"exposure": np.nan}, {"exposure": "1"}, {"bits": 12}, {"bits": 16}])
def test_mistakes_say_what_is_expected(tmp_path, bad):
    path = tmp_path / ("a.jpg" if bad == {"bits": 16} else "a.png")
    with pytest.raises(InputError, match="expected" if "bits" not in bad else "bits"):
        frame_of(np.ones((4, 4, 3), np.float32)).save(path, **bad)
