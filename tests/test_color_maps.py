"""Colours of channels: the scale, the legend, what shows where there is no value, and `clsurf render --channel`."""

import numpy as np
import pytest
from reference.surfaces import fitted, sphere, torus_points
from typer.testing import CliRunner

import clsurf
from clsurf.analysis.bitmap_text import DOTS, draw_text, text_size
from clsurf.analysis.color_maps import color_map, mapped, rounded_up
from clsurf.cli import app
from clsurf.errors import InputError
from clsurf.io import images
from clsurf.render.camera import Camera
from clsurf.render.frame import Frame
from clsurf.render.renderer import Renderer
from clsurf.surface.srgb import to_srgb

CAMERA = Camera.look_at((0.4, 1.0, 3.2), (0, 0, 0))


def test_scale_is_symmetric():
    """0 is grey, signs are two hues, equal amounts are about equally bright, and what is beyond the ends keeps them."""
    srgb = to_srgb(mapped(np.array([-5.0, -2, -1, 0, 1, 2, 5]), -2, 2))
    assert np.ptp(srgb[3]) < 0.03 and srgb[3].mean() > 0.85
    assert (srgb[:3, 2] > srgb[:3, 0] + 0.2).all() and (srgb[4:, 0] > srgb[4:, 2] + 0.2).all()
    assert np.array_equal(srgb[0], srgb[1]) and np.array_equal(srgb[5], srgb[6])
    light = srgb @ (0.3, 0.59, 0.11)
    assert np.abs(light - light[::-1]).max() < 0.12 and (np.diff(light[1:4]) > 0.1).all()


def test_default_scale():
    """The 95 % of the values, rounded up to two digits; the same for a channel and its opposite."""
    values = np.full((20, 30), np.nan, np.float32)
    values[2:18, 3:27] = np.linspace(-1, 0.5, 384).reshape(16, 24)
    colors = color_map(Frame({"mean": values}), "mean").color
    assert np.array_equal(colors[~np.isfinite(values)], np.ones((216, 4)))
    wanted = mapped(values[np.isfinite(values)], -0.93, 0.93)  # 95 % of |values| stay below 0.925
    assert np.abs(colors[np.isfinite(values)][:, :3] - wanted).max() < 1e-6
    assert [rounded_up(v) for v in (0, 0.123, 129.7, 130, 1e-7, 99.5)] == [1, 0.13, 130, 130, 1e-7, 100]


def test_what_has_no_value_keeps_its_color(device):
    with Renderer(device) as r:
        frame = r.render(sphere(300), CAMERA, (120, 90), ("color", "normal", "mean", "direction1", "level"),
                         background=(0.2, 0.4, 0.6, 0.5))
    picture = color_map(frame, "mean", limit=2.0)
    empty = np.isnan(frame.mean)
    assert list(picture.channels) == ["color"] and np.array_equal(picture.color[empty], frame.color[empty])
    assert (picture.color[~empty][:, 3] == 1).all() and picture.color.dtype == np.float32
    facing = np.abs(frame.normal[~empty] @ CAMERA.rotation[2])
    order = picture.color[~empty][:, 0] / mapped(frame.mean[~empty], -2, 2)[:, 0]
    assert np.allclose(order, 0.55 + 0.45 * facing, atol=1e-4)
    assert np.isfinite(color_map(frame, "level", legend=True).color).all()
    halved = color_map(frame, "mean", limit=2.0, reduce=2)
    assert halved.size == (60, 45)
    assert np.allclose(halved.color, picture.color.reshape(45, 2, 60, 2, 4).mean(axis=(1, 3)), atol=1e-6)
    for bad in (dict(channel="gaussian"), dict(channel="direction1"), dict(channel="mean", limit=-1),
                dict(channel="mean", reduce=7)):
        with pytest.raises(InputError):
            color_map(frame, **bad)


def test_nothing_to_see():
    none = np.full((40, 50), np.nan, np.float32)
    for legend in (False, True):
        assert np.isfinite(color_map(Frame({"mean": none}), "mean", legend=legend).color).all()
        assert np.isfinite(color_map(Frame({"depth": none}), "depth", legend=legend).color).all()


def test_legend(device):
    """Its ramp runs from the limit to its opposite, where the surface leaves room."""
    with Renderer(device) as r:
        frame = r.render(fitted(*torus_points(1000), 0.3, 2), CAMERA, (600, 400), ("mean",))
    plain, picture = (color_map(frame, "mean", limit=3.0, legend=on).color for on in (False, True))
    drawn = (plain != picture).any(axis=2)
    assert 500 < drawn.sum() < 0.05 * drawn.size
    assert drawn[np.isfinite(frame.mean)].mean() < 0.01
    y, x = np.nonzero(drawn & (np.ptp(picture[..., :3], axis=2) > 0.1))  # coloured: the ramp
    column = picture[y.min():y.max() + 1, x[0], :3]
    rising = mapped(np.linspace(3, -3, len(column)), -3, 3)
    assert np.abs(column - rising).max() < 0.06


def test_text():
    picture = np.ones((20, 60, 4), np.float32)
    draw_text(picture, "1e-0", 2, 3, 2, 0.0)
    assert text_size("1e-0", 2) == (48, 16)
    inked = picture[..., 0] == 0
    assert inked.sum() == 4 * sum(bin(byte).count("1") for c in "1e-0" for byte in bytes.fromhex(DOTS[c]))
    assert inked[:, 50:].sum() == 0 and inked[:3].sum() == 0
    draw_text(picture, "wide text that ends outside", -7, 14, 1, 0.5)
    letters = [DOTS[c] for c in DOTS]
    assert len(set(letters)) == len(letters) and all(len(dots) == 10 for dots in letters)


def test_command(tmp_path, device):
    surface, runner = tmp_path / "torus.clsurf", CliRunner()
    clsurf.save(fitted(*torus_points(1000), 0.3, 3), surface)
    out = tmp_path / "mean.png"
    for channel in ("mean", "radial_derivative", "depth"):
        done = runner.invoke(app, ["render", str(surface), str(out), "--size", "160x120", "--channel", channel,
                                   "--legend", "--supersampling", "2", "--device", "pocl", "--quiet"])
        assert done.exit_code == 0, done.output
        pixels = images.read_image(out)
        assert pixels.shape[:2] == (120, 160) and np.ptp(pixels[..., :3].astype(int), axis=2).max() > 60
    for options, word in ((["--legend"], "--channel"), (["--channel", "normal"], "one value"),
                          (["--channel", "slope"], "slope"), (["--channel", "mean", "--limit", "-1"], "--limit"),
                          (["--channel", "mean", "--lines", "suggestive_contours"], "--lines")):
        done = runner.invoke(app, ["render", str(surface), str(out), *options, "--device", "pocl"])
        assert done.exit_code != 0 and word in str(done.output) + str(done.exception), options
