"""Frames: the channels of one rendered picture."""

from dataclasses import dataclass, field
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from ..io import images


@dataclass(frozen=True, eq=False, repr=False)
class Frame:
    """A rendered picture: arrays by channel, row 0 on top, pixel centres at +0.5.

    Parameters
    ----------
    channels : dict of str to array
        ``color`` (h, w, 4) float32, linear light, premultiplied alpha, never NaN; float channels such as ``depth``
        (h, w), ``position`` (h, w, 3) relative to `origin` and ``normal`` (h, w, 3) are NaN where nothing is hit;
        ``level``, ``id`` and ``count`` are int32, -1 for none. Each is an attribute too: ``frame.depth``.
    origin : (3,) float64
        World position of the zero of ``position``.
    camera : Camera
        The camera that was used.
    """

    channels: dict[str, NDArray]
    origin: NDArray = field(default_factory=lambda: np.zeros(3))
    camera: object = None

    def __getattr__(self, name):
        channels = self.__dict__.get("channels", {})  # a copy or unpickling asks before there are any
        if name in channels:
            return channels[name]
        if name.startswith("__"):
            raise AttributeError(name)
        raise AttributeError(f"frame.{name}: this frame has the channels {', '.join(channels)}; "
                             f"ask for it with render(..., channels=(..., \"{name}\"))")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = next(iter(self.channels.values())).shape[:2]
        return width, height

    def save(self, path: str | PathLike, tone: str = "none", exposure: float = 0.0, bits: int = 8,
             dither: bool = False) -> None:
        """Write the picture: .png and .jpg the colour (sRGB), .exr every channel (float32, linear, premultiplied).

        Parameters
        ----------
        path : path-like
        tone, exposure, bits, dither
            See `pixels`; .exr stays linear and takes none of them, 16 bits are for .png only.

        Raises
        ------
        InputError
            Another extension, a folder that cannot be written, or no colour where one is needed.
        """
        images.write_frame(path, self.channels, None, tone, exposure, bits, dither)

    def pixels(self, tone: str = "none", exposure: float = 0.0, bits: int = 8, dither: bool = False) -> NDArray:
        """Return the colour (h, w, 4) as sRGB with straight alpha, uint8 or uint16.

        Parameters
        ----------
        tone : str
            "none": light over 1 is clipped; "reinhard", "aces" or "agx": it is taken into the range by a curve.
        exposure : float
            Stops, before the curve: each doubles the light.
        bits : int
            8 or 16.
        dither : bool
            Hide the steps of slow gradients under an ordered pattern.
        """
        return images.to_srgb_bytes(self.color, None, tone, exposure, bits, dither)

    def __array__(self, dtype=None, copy=None):
        return np.array(images.to_srgb8(self.color), dtype=dtype)

    def _repr_png_(self) -> bytes | None:
        return images.png_bytes(images.to_srgb8(self.color)) if "color" in self.channels else None

    def __repr__(self):
        width, height = self.size
        return f"Frame({width} x {height}, {', '.join(self.channels)})"
