"""Pictures of a frame's channels: values as colours on a symmetric scale, with a legend on request.

Source: Ohtake, Belyaev, Alexa, SGP 2005, figures 12 and 16 (colouring by curvature).
"""

import math

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..render.differentials import DIFFERENTIALS
from ..render.frame import Frame
from ..surface.srgb import to_linear
from .bitmap_text import draw_text, text_size

# sRGB, from the least value over 0 to the largest: two hues of equal lightness on each side of a light grey.
ANCHORS = np.array([[0.13, 0.20, 0.56], [0.38, 0.62, 0.90], [0.90, 0.91, 0.92], [0.91, 0.52, 0.23], [0.60, 0.09, 0.11]])
SHARE = 0.95  # of the pixels whose values the scale holds unless a limit is given
DARKEST = 0.55  # light on what is seen edge-on


def color_map(frame: Frame, channel: str, limit: float | None = None, legend: bool = False, reduce: int = 1) -> Frame:
    """Return the frame with the colours of one channel's values, lit a little by its normals where it has them.

    Parameters
    ----------
    frame : Frame
        With `channel`, and "color" for what shows where the channel has no value (white without it).
    channel : str
        One with one value per pixel. Those of curvature get a scale from -limit to limit, others from their least to
        their largest value.
    limit : float, optional
        Value of the last colour, in the channel's unit; by default the one that 95 % of the pixels' absolute values
        stay below, rounded up to two digits.
    legend : bool
        Draw the scale in the corner that the surface leaves free most.
    reduce : int
        Average squares of this many pixels: for clean edges draw the frame that much larger.

    Returns
    -------
    Frame
        Of "color" alone, linear, premultiplied.

    Raises
    ------
    InputError
        A channel that the frame lacks or that has several values per pixel, or a limit that is not positive.
    """
    low, high, values = _scale(frame, channel, limit)
    reduce = int(reduce)
    height, width = values.shape
    if reduce < 1 or height % reduce or width % reduce:
        raise InputError(f"reduce: expected a divisor of the frame's size {width} x {height}, got {reduce}")
    shown = np.isfinite(values)
    colors = np.ones((height, width, 4), np.float32)
    if "color" in frame.channels:
        colors[:] = frame.color
    rgb = mapped(values[shown], low, high)
    if "normal" in frame.channels and frame.camera is not None:
        toward = np.abs(frame.normal[shown] @ frame.camera.rotation[2].astype(np.float32))
        rgb *= (DARKEST + (1 - DARKEST) * np.nan_to_num(toward))[:, None]
    colors[shown, :3], colors[shown, 3] = rgb, 1.0
    if reduce > 1:
        colors = colors.reshape(height // reduce, reduce, width // reduce, reduce, 4).mean(axis=(1, 3))
    if legend:
        draw_legend(colors, shown[::reduce, ::reduce], channel, low, high)
    return Frame({"color": colors}, frame.origin, frame.camera)


def mapped(values: NDArray, low: float, high: float) -> NDArray:
    """Return the linear colours (n, 3) float32 of values (n,) on a scale from `low` to `high`."""
    table = np.stack([np.interp(np.linspace(0, 4, 256), range(5), anchor) for anchor in ANCHORS.T], axis=1)
    t = (values.astype(np.float32) - np.float32(low)) * np.float32(255 / (high - low))
    return to_linear(table).astype(np.float32)[np.clip(t + 0.5, 0, 255).astype(np.intp)]


def _scale(frame, channel, limit) -> tuple[float, float, NDArray]:
    """Return the ends of the scale and the values (h, w), NaN where there is none."""
    if channel not in frame.channels:
        raise InputError(f"channel {channel!r}: this frame has {', '.join(frame.channels)}: ask for it with "
                         f"render(..., channels=(..., {channel!r}))")
    values = frame.channels[channel]
    if values.ndim != 2:
        raise InputError(f"channel {channel}: expected one value per pixel, got {values.shape[2]}")
    if values.dtype.kind in "iu":
        values = np.where(values < 0, np.nan, values)
    given = values[np.isfinite(values)]
    if limit is not None and not 0 < limit < np.inf:
        raise InputError(f"limit: expected a positive number in the channel's unit, got {limit}")
    if channel not in DIFFERENTIALS and limit is None:
        low, high = (float(given.min()), float(given.max())) if len(given) else (0.0, 1.0)
        return low, high if high > low else low + max(abs(low), 1.0) * 1e-6, values
    if limit is None:
        limit = rounded_up(float(np.quantile(np.abs(given), SHARE))) if len(given) else 1.0
    return -float(limit), float(limit), values


def rounded_up(value: float) -> float:
    """Return the least number of two digits that is not below `value`; 1 for 0."""
    if not value > 0:
        return 1.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit * (1 - 1e-9)) * unit:.2g}")


def draw_legend(colors: NDArray, taken: NDArray, name: str, low: float, high: float) -> None:
    """Draw the scale into a linear picture (h, w, 4), in the corner least `taken` (h, w); none in a tiny one."""
    height, width = taken.shape
    size = max(1, round(height / 400))
    bar, tall, border = 10 * size, height // 3, 6 * size
    values = (high, (low + high) / 2, low)
    labels = ["0" if abs(v) < 1e-9 * (high - low) else f"{v:.3g}" for v in values]
    wide = max(bar + 4 * size + max(text_size(label, size)[0] for label in labels), text_size(name, size)[0])
    high_box = tall + 22 * size
    if wide + 2 * border > width or high_box + 2 * border > height or tall < 30 * size:
        return
    corners = [(y, x) for y in (border, height - border - high_box) for x in (width - border - wide, border)]
    y, left = min(corners, key=lambda c: int(taken[c[0]:c[0] + high_box, c[1]:c[1] + wide].sum()))
    ink = np.float32(0.02 if colors[y:y + high_box, left:left + wide, :3].mean() > 0.25 else 0.9)
    top = y + 16 * size
    draw_text(colors, name, left, y, size, ink)
    colors[top - size:top + tall + size, left:left + bar] = (ink, ink, ink, 1)
    colors[top:top + tall, left + size:left + bar - size, :3] = mapped(np.linspace(high, low, tall), low, high)[:, None]
    for label, at in zip(labels, (0, tall / 2, tall), strict=True):
        draw_text(colors, label, left + bar + 4 * size, top + round(at) - 4 * size, size, ink)
