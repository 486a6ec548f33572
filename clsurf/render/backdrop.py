"""What is behind everything: a colour, nothing, a gradient, the surroundings, a picture. Kernel: backdrop.cl."""

from dataclasses import dataclass
from functools import lru_cache
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from ..surface.srgb import to_linear
from .light import Light
from .lighting import image_light, kept_by
from .skies import SKIES, linear_picture, look_up, picture_key
from .tiles import view_floats

NOTHING = (0.0, 0.0, 0.0, 0.0)
KINDS = {"gradient": 0, "sky": 1, "picture": 2}  # kernels/render/backdrop.cl
SPAN = 64


@dataclass(frozen=True, eq=False)
class Backdrop:
    """A checked background."""

    kind: str = "color"
    color: tuple = NOTHING  # sRGB, straight alpha: what the last stage puts where nothing is hit
    ends: NDArray | None = None  # "gradient": (2, 4), sRGB, straight alpha, top and bottom
    light: Light | None = None  # "sky"
    picture: object = None  # "sky" and "picture": file, name or array
    pixels: NDArray | None = None  # "sky" and "picture": (h, w, 3) float32, linear

    def seen(self, directions: NDArray, camera) -> NDArray:
        """Return the linear premultiplied light (n, 3) of what rays with unit directions (n, 3), world, run into."""
        if self.kind == "sky":
            return look_up(self.pixels, directions @ self.light.axes().T) * self.light.radiance
        if self.kind == "picture":
            return np.tile(self.pixels.mean(axis=(0, 1), dtype=np.float64), (len(directions), 1))
        if self.kind == "gradient":
            part = 0.5 - 0.5 * (directions @ camera.rotation[1])[:, None]
            return _premultiplied(self.ends[0] + part * (self.ends[1] - self.ends[0]))[:, :3]
        return np.tile(_premultiplied(np.array([self.color]))[:, :3], (len(directions), 1))


def checked_background(background, scene) -> Backdrop:
    """Return what is behind a scene, or raise InputError; see `Renderer.render`."""
    if type(background) is tuple and all(type(part) is float for part in background):
        return _plain(background)
    if isinstance(background, Light):
        if background.kind != "image":
            raise InputError(f"background: expected an image light, got a {background.kind} light")
        return _surroundings(background)
    if isinstance(background, str) and background == "sky":
        light = image_light(scene.lights)
        if light is None:
            raise InputError("background 'sky': expected an image light in the scene: add clsurf.Light(\"image\") to "
                             "its lights, or give one as the background")
        return _surroundings(light)
    if isinstance(background, str) and background == "transparent":
        return Backdrop()
    if isinstance(background, str | PathLike) or getattr(background, "ndim", 0) == 3:
        return Backdrop("picture", picture=background, pixels=linear_picture("background", background, {}))
    if isinstance(background, list | tuple | np.ndarray) and len(background) == 2:
        try:
            ends = np.stack([_four(end) for end in background])
        except InputError:
            raise InputError("background: expected two colours, top and bottom, of 3 or 4 numbers from 0 to 1 each, "
                             f"got {background}") from None
        return Backdrop("gradient", ends=ends)
    return Backdrop(color=tuple(_four(background)))


@lru_cache(maxsize=64)
def _plain(color: tuple[float, ...]) -> Backdrop:
    return Backdrop(color=tuple(_four(color)))  # 20 us of every frame


def around(backdrop: Backdrop, scene) -> Backdrop:
    """Return what mirrors see where they see no surface: the scene's image light, else what is behind the picture."""
    light = image_light(scene.lights)
    return backdrop if light is None else _surroundings(light)


def _surroundings(light: Light) -> Backdrop:
    return Backdrop("sky", light=light, picture=light.picture,
                    pixels=linear_picture("light picture", light.picture, SKIES))


def _four(color) -> NDArray:
    """Return a colour (4,) float64 of 3 or 4 numbers."""
    try:
        out = np.asarray(color, np.float64)
    except (TypeError, ValueError):
        out = np.zeros(0)  # told below
    if out.shape not in ((3,), (4,)) or not np.isfinite(out).all():
        raise InputError(f"background: expected 3 or 4 numbers from 0 to 1 (sRGB, alpha), two such colours (top, "
                         f"bottom), 'transparent', 'sky', an image light, or a picture, got {color!r}")
    return np.append(out, 1.0) if len(out) == 3 else out


def _premultiplied(colors: NDArray) -> NDArray:
    """Return sRGB with straight alpha (n, 4) as linear light premultiplied by alpha."""
    return np.concatenate([to_linear(colors[:, :3]) * colors[:, 3:], colors[:, 3:]], axis=1)


def lay_over(device: Device, backdrop: Backdrop, camera, size: tuple[int, int], color: DeviceArray, lanes: int) -> None:
    """Put the backdrop behind the picture `color` (h, w, 4); a plain colour is there already."""
    if backdrop.kind == "color":
        return
    width, height = size
    turn = np.zeros(12, np.float32)
    if backdrop.kind == "gradient":
        part = ((np.arange(height) + 0.5) / height)[:, None]
        rows = _premultiplied(backdrop.ends[0] + part * (backdrop.ends[1] - backdrop.ends[0]))
        texels, shape = device.upload(rows.astype(np.float32)), (1, height)
    else:
        texels, shape = kept_by(device, "backdrops", (backdrop.kind, picture_key(backdrop.picture), size),
                                lambda: _texels(device, backdrop, size))[:2]
        if backdrop.kind == "sky":
            turn[:9], turn[9:] = (backdrop.light.axes() @ camera.rotation.T).ravel(), backdrop.light.radiance
    span = 1 if lanes == 1 else SPAN
    device.kernel("render/backdrop.cl", constants={"VW": 1, "KIND": KINDS[backdrop.kind], "SPAN": span})(
        (-(-width // span), height), (8, 8) if lanes == 1 else (1, 1), device.upload(view_floats(camera, size)),
        device.upload(turn), texels, shape[0], shape[1], width, height, color)


def _texels(device: Device, backdrop: Backdrop, size):
    """Return the pixels of a picture on the device, their width and height, and what they were made of."""
    pixels = backdrop.pixels
    if backdrop.kind == "picture":  # no finer than twice the frame's pixels
        step = max(1, min(pixels.shape[1] // (2 * size[0]), pixels.shape[0] // (2 * size[1])))
        height, width = (n // step * step for n in pixels.shape[:2])
        pixels = pixels[:height, :width].reshape(height // step, step, width // step, step, 3).mean(axis=(1, 3))
    pixels = np.repeat(np.repeat(pixels, 1 + (len(pixels) < 2), 0), 1 + (pixels.shape[1] < 2), 1)
    out = np.ones((*pixels.shape[:2], 4), np.float32)
    out[..., :3] = pixels
    return device.upload(out), (out.shape[1], out.shape[0]), backdrop.picture
