"""One picture of the viewer: the scene in the chosen channel, lines over it, and what is written on it."""

import numpy as np
from numpy.typing import NDArray

from ..analysis.color_maps import color_map
from ..analysis.lines import line_channels, lines
from ..errors import InputError
from ..render.differentials import DIFFERENTIALS, check_differentials
from ..render.frame import Frame
from ..render.scene import Scene
from ..render.slim_drawing import SlimDrawing
from ..surface.srgb import to_srgb
from .pace import Quality
from .state import ViewState, pixel_of

# Of these the ones that the scene has, in the order of the key.
CHANNELS = ("color", "normal", "depth", "mean", "gaussian", "k1", "k2", "level", "id")
LINES = ((), ("contours",), ("contours", "suggestive_contours"),
         ("contours", "suggestive_contours", "ridges", "valleys"))
BYTES = np.rint(255 * to_srgb(np.arange(4096) / 4095)).astype(np.uint8)  # of linear values: 37 to 4 ms at 800x600


def channels_of(scene: Scene) -> tuple[str, ...]:
    """Return the channels of CHANNELS that a scene's pictures can be coloured by."""
    return tuple(name for name in CHANNELS if (name not in DIFFERENTIALS or _has(scene, (name,)))
                 and (name != "id" or len(scene.surfaces) > 1))


def lines_of(scene: Scene) -> tuple[tuple[str, ...], ...]:
    """Return the choices of LINES that can be found on a scene."""
    return tuple(kinds for kinds in LINES if _has(scene, [n for n in _line_channels(kinds) if n in DIFFERENTIALS]))


def _line_channels(kinds) -> tuple[str, ...]:
    return line_channels(kinds) if kinds else ()


def _has(scene: Scene, names) -> bool:
    try:
        check_differentials(scene.placed, names, "phong", SlimDrawing())
    except InputError:
        return False
    return True


def to_bytes(color: NDArray) -> NDArray:
    """Return (h, w, 4) uint8 sRGB, opaque, of linear colour (h, w, 4) over an opaque background."""
    out = np.empty(color.shape, np.uint8)
    levels = (color[..., :3] * np.float32(4095) + np.float32(0.5)).astype(np.uint16)
    out[..., :3] = BYTES.take(levels, mode="clip")
    out[..., 3] = 255
    return out


def draw(renderer, scene: Scene, state: ViewState, size: tuple[int, int], quality: Quality, kinds=(),
         limits: dict | None = None, **options) -> tuple[NDArray, Frame]:
    """Draw one picture.

    Parameters
    ----------
    renderer : Renderer
    scene : Scene
    state : ViewState
    size : (int, int)
        Of the canvas, pixels.
    quality : Quality
    kinds : sequence of str
        Lines to draw over it where the quality has them.
    limits : dict
        Scales of the channels that are coloured by value; filled in by full pictures, so that colours stay.
    options
        Of `Renderer.render`.

    Returns
    -------
    pixels : (h, w, 4) uint8
        sRGB, opaque, smaller than `size` by ``quality.reduce``.
    frame : Frame
        Of the same size, with "depth".
    """
    size = tuple(-(-n // quality.reduce) for n in size)
    clip = [] if state.clip is None else [state.clip.equation]
    channel = state.channel
    options = {"lod": quality.lod, "clip": clip, **options}
    # Normals always: no kernel is to be compiled when someone asks for the channel.
    frame = renderer.render(scene, state.camera, size, tuple(dict.fromkeys(("color", "depth", "normal", channel))),
                            supersampling=quality.supersampling, **options)
    shown = frame
    if channel == "normal":
        pixels = normal_colors(frame, state.camera)
    elif channel != "color":
        limits = {} if limits is None else limits
        known = limits.get((channel, scene))
        shown = color_map(frame, channel, known if channel in DIFFERENTIALS else None, legend=quality.reduce == 1)
        if known is None and channel in DIFFERENTIALS:
            limits[channel, scene] = largest_value(frame.channels[channel])
    if kinds and quality.lines:
        plain = renderer.render(scene, state.camera, size, line_channels(kinds), **options)
        found = lines(plain, kinds, device=renderer.device)
        if channel == "normal":
            shown = Frame({"color": linear(pixels)}, frame.origin, frame.camera)
        pixels = to_bytes(found.draw(shown).color)
    elif channel != "normal":
        pixels = to_bytes(shown.color)
    return pixels, frame


def largest_value(values: NDArray) -> float | None:
    """Return the end of a scale that 95 % of the values lie within; None without values."""
    from ..analysis.color_maps import SHARE, rounded_up
    given = np.abs(values[np.isfinite(values)])
    return rounded_up(float(np.quantile(given, SHARE))) if len(given) else None


def normal_colors(frame: Frame, camera) -> NDArray:
    """Return (h, w, 4) uint8: normals in the camera's axes as colours, the frame's own where there is none."""
    turned = frame.normal @ camera.rotation.T.astype(np.float32)
    hit = np.isfinite(frame.depth)
    pixels = to_bytes(frame.color)
    pixels[hit, :3] = np.clip(127.5 * turned[hit] + 128, 0, 255).astype(np.uint8)
    return pixels


def linear(pixels: NDArray) -> NDArray:
    """Return linear colour (h, w, 4) float32 of sRGB bytes."""
    from ..io.images import from_srgb8
    return from_srgb8(pixels)


# What is written on the picture ---------------------------------------------------------------------------------------

INK, PAPER, MARK = (255, 255, 255, 255), (30, 30, 34, 215), (214, 40, 40, 255)


def written(pixels: NDArray, state: ViewState, help_text: list[tuple[str, str]], hint: str = "") -> NDArray:
    """Return the picture with marks of measuring, the help panel, and the words at its bottom; `pixels` stays."""
    height, width = pixels.shape[:2]
    if not (state.picks or state.help or state.words or hint):
        return pixels
    from PIL import Image, ImageDraw
    image = Image.fromarray(pixels)
    pen = ImageDraw.Draw(image, "RGBA")
    _measure(pen, state, (width, height))
    if width >= 240 and height >= 160:  # a terminal's picture has no room for letters
        if state.help:
            _panel(pen, help_text, (width, height))
        _say(pen, state.words or hint, (width, height))
    return np.asarray(image)


def font(size: float):
    """Return letters of `size` pixels."""
    from PIL import ImageFont
    return ImageFont.load_default(size)


def _measure(pen, state: ViewState, size) -> None:
    places = [pixel_of(state.camera, size, point) for point in state.picks]
    places = [p for p in places if p is not None and max(map(abs, p)) < 1e5]
    scale = max(1.0, size[1] / 600)
    if len(places) == 2:
        pen.line([*places[0], *places[1]], fill=(255, 255, 255, 220), width=round(4 * scale))
        pen.line([*places[0], *places[1]], fill=MARK, width=round(2 * scale))
        text, letters = f"{state.distance:.6g}", font(14 * scale)
        x, y = np.mean(places, axis=0)
        box = pen.textbbox((x, y), text, font=letters, anchor="mm")
        pen.rounded_rectangle([box[0] - 5, box[1] - 3, box[2] + 5, box[3] + 4], 4, fill=PAPER)
        pen.text((x, y), text, fill=INK, font=letters, anchor="mm")
    for x, y in places:
        r = 4 * scale
        pen.ellipse([x - r, y - r, x + r, y + r], fill=MARK, outline=INK, width=round(1.5 * scale))


def _panel(pen, rows, size) -> None:
    scale = min(size[1] / (22 * len(rows) + 60), size[0] / 520, max(1.0, size[1] / 700))
    letters, step = font(13 * scale), 19 * scale
    wide = max(pen.textlength(key, font=letters) for key, _ in rows)
    box = [10, 10, 34 + wide + max(pen.textlength(text, font=letters) for _, text in rows) + 24, 22 + step * len(rows)]
    pen.rounded_rectangle(box, 6, fill=PAPER)
    for i, (key, text) in enumerate(rows):
        pen.text((22, 16 + step * i), key, fill=(255, 214, 120, 255), font=letters)
        pen.text((42 + wide, 16 + step * i), text, fill=INK, font=letters)


def _say(pen, text: str, size) -> None:
    if not text:
        return
    letters = font(13 * max(1.0, size[1] / 700))
    while pen.textlength(text, font=letters) > size[0] - 40 and len(text) > 8:
        text = text[:len(text) - 5].rstrip() + " ..."
    box = pen.textbbox((20, size[1] - 14), text, font=letters, anchor="ls")
    pen.rounded_rectangle([box[0] - 8, box[1] - 5, box[2] + 8, box[3] + 6], 5, fill=PAPER)
    pen.text((20, size[1] - 14), text, fill=INK, font=letters, anchor="ls")
