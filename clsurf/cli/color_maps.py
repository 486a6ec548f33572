"""The options of `render` that colour a picture by one channel."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from .recipe import Recipe

ChannelOption = Annotated[str, typer.Option(help="Colour the picture by a channel with one value per pixel: mean, "
                                            "gaussian, k1, k2, radial, derivative1, derivative2, radial_derivative "
                                            "(the last three: --degree 3), depth, level, count, cost.")]
LegendOption = Annotated[bool, typer.Option("--legend", help="With --channel: draw the scale beside the surface.")]
LimitOption = Annotated[float, typer.Option(help="With --channel: value of the last colour; 0: from the picture.")]


@dataclass(frozen=True)
class ChannelPicture:
    """A picture by one channel, its options checked."""

    channel: str
    legend: bool
    limit: float

    def prepared(self, how: Recipe, degree: int | None) -> None:
        """Have surfels of degree 3 built where the channel needs them and no degree was given."""
        from ..render.differentials import DIFFERENTIALS
        if degree is None and DIFFERENTIALS.get(self.channel, (0, 0))[1] == 3:
            how.slim["degree"] = 3

    def draw(self, thing, camera, size, looks, lod, supersampling, drawing, device):
        """Return the picture; its edges are averaged from a frame drawn `supersampling` times as large."""
        import clsurf
        large = tuple(supersampling * n for n in size)
        frame = clsurf.render(thing, camera, large, ("color", "normal", self.channel), looks, lod, device=device,
                              patches=drawing)
        return clsurf.color_map(frame, self.channel, self.limit or None, self.legend, supersampling)


def channel_picture(channel: str, legend: bool, limit: float, lines: str, out: Path) -> ChannelPicture | None:
    """Return the picture by a channel that the options ask for, None without one, or raise InputError."""
    from ..render.checked import checked_channels
    if not channel:
        if legend or limit:
            raise InputError(f"--{'legend' if legend else 'limit'}: an option of --channel: name one")
        return None
    if lines:
        raise InputError("--channel: expected no --lines beside it: draw two pictures")
    if out.suffix.lower() == ".exr":
        raise InputError(f"--channel: expected a .png or .jpg picture, got {out.suffix}: --channels writes the values")
    if checked_channels(channel)[0] in ("color", "normal", "position", "direction1", "direction2"):
        raise InputError(f"--channel: expected one with one value per pixel, got {channel}")
    if not 0 <= limit < float("inf"):
        raise InputError(f"--limit: expected a positive number, got {limit}")
    return ChannelPicture(channel, legend, limit)
