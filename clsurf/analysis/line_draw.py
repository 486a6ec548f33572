"""The stages that draw feature lines on the device: strokes into ink, ink over a picture."""

import numpy as np
from numpy.typing import NDArray

from ..device import open_device
from .line_planes import shared_scratch

SPAN = 1024  # pixels that one work-item of blend_strokes blends


def draw_lines(found, size, picture: NDArray | None, width, ink, palette: NDArray) -> tuple[NDArray, NDArray]:
    """Return the picture (h, w, 4) with the strokes over it and their ink (h, w), float32.

    Parameters
    ----------
    found : Lines
    size : (int, int)
    picture : (h, w, 4) float32, optional
        Linear, premultiplied; None: `palette[0]` everywhere.
    width, ink : (float, float)
        Pixels and opacity at strength 0 and 1.
    palette : (1 + kinds, 4) float32
        Linear: the background, and the colour of every kind.
    """
    device = open_device(found.device)
    w, h = size
    scratch = shared_scratch(device, device.lanes)
    inked = scratch.array("ink", (h, w), np.uint32)
    device.fill(inked, 0)
    segments = found.segments
    if len(segments):
        strokes = np.empty((len(found.points), 4), np.float32)
        strokes[:, :2] = found.points * np.array([w / found.size[0], h / found.size[1]], np.float32)
        strokes[:, 2] = 0.5 * (width[0] + found.strength * (width[1] - width[0]))
        strokes[:, 3] = ink[0] + found.strength * (ink[1] - ink[0])
        line = np.repeat(found.kind, np.diff(found.offset))
        device.kernel("analysis/draw_strokes.cl")(
            (len(segments),), (min(64, len(segments)),), len(segments), w, h, device.upload(strokes),
            device.upload(segments), device.upload(1 + line[segments[:, 0]], np.int32), inked)
    span = 1 if device.lanes == 1 else SPAN
    color, lines = device.empty((h, w, 4), np.float32), device.empty((h, w), np.float32)
    colors = device.upload(palette, np.float32)
    device.kernel("analysis/blend_strokes.cl", constants={"SPAN": span, "PLAIN": picture is None})(
        (-(-w * h // span),), (64,) if span == 1 else (1,), w * h,
        colors if picture is None else device.upload(picture, np.float32), inked, colors, color, lines)
    return device.download(color, copy=False), device.download(lines, copy=False)
