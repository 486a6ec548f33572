"""Moving pictures and cameras of files: the options `--turntable`, `--path` and `--camera` of `render`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from .common import Steps

TurntableOption = Annotated[int | None, typer.Option(help="Turn around the model once, in this many frames: .mp4, "
                                                     ".gif, .webp, or without an ending a folder of pictures.")]
PathOption = Annotated[Path | None, typer.Option(help="Move along the cameras of a file: .json of intrinsics and "
                                                 "poses, or the folder of a COLMAP model.")]
FramesOption = Annotated[int | None, typer.Option(help="--path: number of frames; by default 30 from camera to "
                                                  "camera.")]
FpsOption = Annotated[float, typer.Option(help="Frames a second of a moving picture.")]
CameraOption = Annotated[str, typer.Option("--camera", help="Camera of such a file, FILE or FILE:NAME; the first by "
                                           "default.")]
SchedulerOption = Annotated[str, typer.Option(help="--turntable, --path: have the frames drawn by the workers of a "
                                              "Dask scheduler, tcp://host:8786 or local; they see the same files.")]
IgnoreOption = Annotated[bool, typer.Option("--ignore-distortion", help="Use cameras whose lens bends straight lines, "
                                            "as if it did not.")]


@dataclass(frozen=True)
class Motion:
    """The options, checked; the model completes them."""

    turntable: int | None
    path: object  # CameraPath
    frames: int
    fps: float
    camera: object  # Camera

    @property
    def moves(self) -> bool:
        """Whether the output is a moving picture."""
        return self.turntable is not None or self.path is not None

    @property
    def size(self) -> tuple[int, int]:
        """The picture's size where none is asked for: that of the cameras' own pictures, where they have one."""
        given = self.path.cameras[0] if self.path is not None else self.camera
        return getattr(given, "intrinsics_size", None) or (1024, 768)

    def cameras(self, thing, view, size: tuple[int, int]) -> list:
        """Return the camera of every frame."""
        from ..render.camera_path import turntable
        if self.path is not None:
            return self.path.frames(self.frames)
        if view.eye is None and view.target is None and view.ortho is None:
            return turntable(thing, self.turntable, view.direction, view.fov, view.up, size[0] / size[1])
        import numpy as np
        first = view.camera(thing, size)  # a camera of the user's own, around what it looks at
        target = np.asarray(thing.bounds).mean(axis=0) if view.target is None else view.target
        return [first.orbited(target, 360 * i / self.turntable, view.up) for i in range(self.turntable)]

    def write(self, out: Path, draw, thing, view, size: tuple[int, int], steps: Steps) -> None:
        """Write the frames that `draw` gives for the cameras, as they come."""
        from ..io.video import write_video
        cameras = self.cameras(thing, view, size)

        def frames():
            for number, frame in enumerate(draw(cameras)):
                yield frame
                steps.progress("draw", (number + 1) / len(cameras))
        with steps.step("draw"):
            count = write_video(out, frames(), self.fps)
        steps.say(f"  {count} frames, {count / self.fps:.3g} s")


def motion(out: Path, turntable: int | None, path: Path | None, frames: int | None, fps: float, camera: str,
           ignore_distortion: bool, view_given: bool, scheduler: str = "") -> Motion:
    """Return the options of moving pictures, or raise InputError.

    `view_given`: whether an option says where the picture is seen from.
    """
    from ..io.video import checked_fps, known_video
    if (turntable is not None) + (path is not None) + bool(camera) > 1:
        raise InputError("camera: expected one of --turntable, --path and --camera")
    if frames is not None and path is None:
        raise InputError("frames: an option of --path; --turntable takes their number itself")
    if (path is not None or camera) and view_given:
        raise InputError(f"camera: expected --{'path' if path is not None else 'camera'} or options of a camera "
                         "(--direction, --fov, --eye, --target, --ortho), got both")
    for name, value in (("turntable", turntable), ("frames", frames)):
        if value is not None and value < 1:
            raise InputError(f"{name}: expected at least 1 frame, got {value}")
    checked_fps(out, fps)
    if scheduler and turntable is None and path is None:
        raise InputError("scheduler: expected --turntable or --path beside it: one picture is drawn here")
    lens = "ignore" if ignore_distortion else "refuse"
    if turntable is None and path is None:
        return Motion(None, None, 0, fps, camera_of(camera, lens) if camera else None)
    known_video(out)
    if path is None:
        return Motion(turntable, None, turntable, fps, None)
    from ..render.camera_path import CameraPath
    way = CameraPath.load(path, lens)
    gaps = len(way) if way.closed else max(len(way) - 1, 1)
    return Motion(None, way, 30 * gaps + (not way.closed) if frames is None else frames, fps, None)


def camera_of(text: str, distortion: str):
    """Return the camera that FILE or FILE:NAME means."""
    from ..render.camera_path import load_cameras
    path, name = text, ""
    if not Path(text).exists() and ":" in text:
        path, _, name = text.rpartition(":")
    cameras = load_cameras(path, distortion)
    if name and name not in cameras:
        few = ", ".join(list(cameras)[:5]) + ", ..." * (len(cameras) > 5)
        raise InputError(f"camera: {path} has no camera {name!r}: it has {few}")
    return cameras[name] if name else next(iter(cameras.values()))
