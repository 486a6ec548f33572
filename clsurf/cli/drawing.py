"""Frames of `render`: everything that decides one, checked, as plain data that other machines' processes understand."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from .color_maps import ChannelPicture
from .common import Steps
from .lights import Lighting
from .line_pictures import LinePicture
from .motion import Motion
from .output import Output


@dataclass(frozen=True)
class Drawing:
    """What a frame looks like; call it with a thing, a camera, a size and a device."""

    lit: Lighting
    written: Output
    channels: tuple[str, ...]
    lod: float
    options: dict  # of `clsurf.render`
    colored: ChannelPicture | None = None
    strokes: LinePicture | None = None
    coarse: object = None  # the surface to find lines on, where it is not the shown one

    def __call__(self, thing, camera, size: tuple[int, int], device):
        """Return the frame, without lines."""
        import clsurf
        if self.colored:
            return self.colored.draw(thing, camera, size, self.lit.shading, self.lod, self.options["supersampling"],
                                     self.options["patches"], device)
        return clsurf.render(self.lit.scene(thing, camera), camera, size, self.channels, self.lit.shading, self.lod,
                             self.written.background, device, antialias=self.written.antialias, **self.options)

    def moving(self, thing, camera, size: tuple[int, int], device):
        """Return a frame of a moving picture: its colour alone, with lines."""
        from ..render.frame import Frame
        frame = self(thing, camera, size, device)
        if self.strokes:
            frame = self.strokes.over(frame, self.coarse, camera, size, device)
        return Frame({"color": frame.color}, frame.origin, frame.camera)

    def for_moving(self) -> "Drawing":
        """Return the drawing with no more channels than a moving picture needs."""
        return self if self.strokes or self.colored else replace(self, channels=("color",))


def write_moving(out: Path, motion: Motion, drawing: Drawing, source: str, thing, view, size: tuple[int, int],
                 scheduler: str, device, steps: Steps) -> None:
    """Write a moving picture, drawn here, or by the workers of a scheduler that read `source` themselves.

    `device` is an opened one, or with a scheduler the name of the workers' own.
    """
    from ..render.remote import remote_frames
    drawing = drawing.for_moving()
    draw: Callable = drawing.moving

    def frames(cameras):
        if scheduler:
            return remote_frames(source, cameras, size, device, scheduler, {}, draw)
        return (draw(thing, camera, size, device) for camera in cameras)
    motion.write(out, lambda cameras: map(drawing.written.shown, frames(cameras)), thing, view, size, steps)
