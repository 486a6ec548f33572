"""What is behind a picture, how its edges are drawn, and how its light becomes a file: options of `render`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError

BackgroundOption = Annotated[str, typer.Option(help="Colour r,g,b[,alpha] (0 to 1) or #rrggbb; two with a colon "
                                               "between: from top to bottom; transparent; sky: of --sky; a picture "
                                               "[white].")]
AntialiasOption = Annotated[str, typer.Option(help="none; coverage: edges with 4x4 samples; supersample: everything.")]
ToneOption = Annotated[str, typer.Option(help="Curve that takes bright light into a .png or .jpg: none (clipped), "
                                         "reinhard, aces, agx.")]
ExposureOption = Annotated[float, typer.Option(help="Stops before the curve: each doubles the light.")]
BitsOption = Annotated[int, typer.Option(help="Bits a channel of a .png, 8 or 16.")]


@dataclass(frozen=True)
class Output:
    """The options, checked."""

    background: object
    antialias: str
    tone: str
    exposure: float
    bits: int

    def save(self, frame, path: Path) -> None:
        """Write a frame."""
        frame.save(path, self.tone, self.exposure, self.bits)

    def shown(self, frame):
        """Return a frame of a moving picture as `write_video` is to have it."""
        return frame if self.tone == "none" and not self.exposure else frame.pixels(self.tone, self.exposure)


def output(path: Path, background: str, antialias: str, supersampling: int, tone: str, exposure: float, bits: int,
           lines: str, channel: str, moves: bool = False) -> Output:
    """Return the options of what is written, a moving picture where it `moves`, or raise InputError."""
    from ..io.images import checked_output
    from ..render.coverage import checked_antialias
    checked_antialias(antialias, supersampling)
    plain = not background and antialias == "none" and tone == "none" and not exposure and bits == 8
    if (lines or channel) and not plain:
        raise InputError("--background, --antialias, --tone, --exposure, --bits: expected no --lines and no --channel "
                         "beside them")
    if moves and bits != 8:
        raise InputError(f"bits: expected 8 for a moving picture, got {bits}")
    if not (lines or channel):
        checked_output("frame.png" if moves else path, tone, exposure, bits)
    return Output(parsed_background(background), antialias, tone, exposure, bits)


def parsed_background(text: str):
    """Return what `render` takes as a background of a text, or raise InputError."""
    if not text:
        return (1.0, 1.0, 1.0, 1.0)
    if text in ("transparent", "sky"):
        return text
    ends = [parsed_color(part) for part in text.split(":")]
    if None not in ends and len(ends) <= 2:
        return ends[0] if len(ends) == 1 else tuple(ends)
    if Path(text).is_file():
        return Path(text)
    raise InputError(f"background: expected r,g,b[,alpha] from 0 to 1, #rrggbb, two of those with a colon between, "
                     f"transparent, sky or a picture, got {text!r}")


def parsed_color(text: str) -> tuple | None:
    """Return the colour, sRGB with straight alpha, of a text such as 1,0.5,0 or #ff8000; None: it is none."""
    digits = text.removeprefix("#")
    try:
        if digits != text:
            return tuple(byte / 255 for byte in bytes.fromhex(digits)) if len(digits) in (6, 8) else None
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        return None
    return numbers if len(numbers) in (3, 4) and all(0 <= n <= 1 for n in numbers) else None
