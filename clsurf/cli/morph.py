"""The command `morph`: an animation from one shape to another."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from .cameras import DirectionOption, FovOption, UpOption, checked_view
from .common import DeviceOption, QuietOption, SizeOption, Steps, parsed_size


def morph(first: Annotated[Path, typer.Argument(help="A mesh, a surface or a scale map.")],
          last: Annotated[Path, typer.Argument(help="Another one.")],
          out: Annotated[Path, typer.Argument(help=".mp4, .gif, .webp, a folder of frames (no ending), or .clsurf: one "
                                                   "scale map in between.")],
          frames: Annotated[int, typer.Option(help="Frames from the first shape to the last.")] = 60,
          fps: Annotated[float, typer.Option(help="Frames a second.")] = 30.0,
          back: Annotated[bool, typer.Option("--back", help="And back again.")] = False,
          ease: Annotated[bool, typer.Option("--ease", help="Slower at both ends.")] = False,
          fit: Annotated[bool, typer.Option("--fit", help="Bring both shapes to one place and size: that of the "
                                                          "first.")] = False,
          t: Annotated[float, typer.Option(help="With .clsurf: where in between, 0 to 1.")] = 0.5,
          texels: Annotated[int, typer.Option(help="Texels along a cube face of maps that are built.")] = 128,
          size: SizeOption = "640x480", direction: DirectionOption = "", up: UpOption = "0,1,0", fov: FovOption = None,
          device: DeviceOption = "", quiet: QuietOption = False):
    """Turn one shape into another: frames, a video, or one shape in between."""
    import clsurf

    from ..build.morph import morph_frames
    from ..io.video import ENDINGS, known_video, write_video
    from ..render.checked import checked_size
    steps, picture_size = Steps(quiet), checked_size(parsed_size(size))
    ending = out.suffix.lower()
    if ending not in (*ENDINGS, "", ".clsurf"):
        raise InputError(f"output {out}: expected a name that ends in {', '.join(ENDINGS)} or .clsurf, or a folder")
    if frames < 2:
        raise InputError(f"frames: expected at least 2, got {frames}")
    if not 0 <= t <= 1:
        raise InputError(f"t: expected a number from 0 to 1, got {t}")
    if ending == ".clsurf":
        from .common import checked_out
        checked_out(out, (".clsurf",))
    else:
        known_video(out)
    view = checked_view(direction, up, fov, "", "", None)
    chosen = clsurf.open_device(device or None)
    models = []
    for path in (first, last):
        with steps.step(f"load {path.name}"):
            model = clsurf.load(path)
        steps.say(f"  {model}")
        if not isinstance(model, clsurf.ScaleMap):
            with steps.step("build"):
                model = clsurf.build_scale_map(model, size=texels, bits=16, device=chosen, progress=steps.progress)
            steps.say(f"  {model}")
        models.append(model)
    a, b = models
    if fit:
        scale = a.radius / b.radius
        b = b.moved([[scale, 0, 0, 0], [0, scale, 0, 0], [0, 0, scale, 0], [0, 0, 0, 1]])
        b = b.moved([[1, 0, 0, s] if i == 0 else [0, 1, 0, s] if i == 1 else [0, 0, 1, s]
                     for i, s in enumerate(a.center - scale * models[1].center)] + [[0, 0, 0, 1]])
    if ending == ".clsurf":
        with steps.step("morph"):
            between = clsurf.morph(a, b, t, device=chosen)
        steps.say(f"  {between}")
        clsurf.save(between, out)
        steps.say(f"surface: {out.resolve()}")
        return
    camera = view.camera(clsurf.Scene([a, b]), picture_size)

    def drawn():
        with clsurf.Renderer(chosen) as renderer:
            shapes = morph_frames(a, b, frames, ease, chosen)
            if back:
                there = list(shapes)
                shapes = [*there, *there[-2:0:-1]]
            for k, shape in enumerate(shapes):
                steps.progress("draw", k / (2 * frames - 2 if back else frames))
                yield renderer.render(shape, camera, picture_size, channels=("color",), supersampling=2)

    with steps.step("draw"):
        count = write_video(out, drawn(), fps)
    steps.say(f"video: {out.resolve()} ({count} frames)")
