"""`clsurf render --lines`: feature lines over the picture, on white, or as polylines."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from .common import PICTURES, Steps
from .recipe import Recipe

LinesOption = Annotated[str, typer.Option("--lines", help="Draw feature lines: some of contours,suggestive_contours,"
                                          "ridges,valleys,crest,parabolic. From a scan they are found on a coarser "
                                          "cubic surface than the one shown. A name in .svg gets the polylines.")]
OnWhiteOption = Annotated[bool, typer.Option("--on-white", help="lines: draw them on white instead of over the "
                                             "shaded surface.")]


@dataclass(frozen=True)
class LinePicture:
    """Which lines a picture gets, checked."""

    kinds: tuple[str, ...]
    on_white: bool

    def surfaces(self, source: Path, how: Recipe, device, steps: Steps):
        """Return the surface to show and the one to find lines on; both are the same where the file holds a surface."""
        import clsurf
        with steps.step("load"):
            thing = clsurf.load(source)
        steps.say(f"  {thing}")
        if isinstance(thing, clsurf.SlimSurface | clsurf.PatchSurface):
            return thing, thing
        with steps.step("build"):
            shown = how.build(thing, device, steps)
        steps.say(f"  {shown}")
        if self.kinds == ("contours",):
            return shown, shown
        with steps.step("build for lines"):
            coarse = clsurf.line_surface(thing, device=device, progress=steps.progress)
        steps.say(f"  {coarse}")
        return shown, coarse

    def channels(self, wanted, alone: bool) -> tuple[str, ...]:
        """Return what the picture must have beside the channels `wanted`; `alone`: lines are found on it too."""
        import clsurf
        return tuple(dict.fromkeys((*wanted, "depth", "normal",
                                    *(clsurf.line_channels(self.kinds) if alone else ()))))

    def found(self, frame, coarse, camera, size, device):
        """Return the lines of `coarse`, None where they are those of `frame` itself."""
        import clsurf
        if coarse is None:
            return clsurf.lines(frame, self.kinds, device=device)
        other = clsurf.render(coarse, camera, size, clsurf.line_channels(self.kinds), device=device)
        return clsurf.lines(other, self.kinds, silhouette=frame, device=device)

    def over(self, frame, coarse, camera, size, device):
        """Return `frame`, or white, with the lines drawn over it."""
        return self.found(frame, coarse, camera, size, device).draw(None if self.on_white else frame)

    def save(self, out: Path, frame, coarse, camera, size, device, steps: Steps) -> None:
        """Find the lines of `coarse`, None where they are those of `frame` itself, and write the picture."""
        with steps.step("find lines"):
            found = self.found(frame, coarse, camera, size, device)
        steps.say(f"  {found}")
        with steps.step("write"):
            if out.suffix.lower() == ".svg":
                found.save(out)
            else:
                found.draw(None if self.on_white else frame).save(out)


def line_picture(text: str, on_white: bool) -> LinePicture | None:
    """Return what the options --lines and --on-white ask for, None without lines, or raise InputError."""
    from ..analysis.lines import checked_kinds
    if not text:
        if on_white:
            raise InputError("--on-white: expected --lines too: say which lines to draw")
        return None
    return LinePicture(checked_kinds(tuple(part.strip() for part in text.split(","))), on_white)


def endings(picture: LinePicture | None) -> tuple[str, ...]:
    """Return the endings that the output may have."""
    return PICTURES if picture is None else (*PICTURES, ".svg")
