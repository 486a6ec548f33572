"""The command `curvature`: from a scan or a surface to numbers, a coloured scan or a picture."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from .cameras import DirectionOption, EyeOption, FovOption, OrthoOption, TargetOption, UpOption, checked_view
from .common import PICTURES, DeviceOption, QuietOption, SizeOption, Steps, checked_out, is_surface, parsed_size

TABLES, SCANS = (".npz", ".csv"), (".ply",)
CHANNELS = ("mean", "gaussian", "k1", "k2")
HEADER = "x,y,z,nx,ny,nz,mean,gaussian,k1,k2,direction1x,direction1y,direction1z,direction2x,direction2y,direction2z"


def curvature(source: Annotated[Path, typer.Argument(help="A scan or a surface.")],
              out: Annotated[Path | None, typer.Option("--output", "-o", help="The scan in the channel's colours, with "
                                                       "its values: .ply; all numbers: .npz, .csv; a picture: .png, "
                                                       ".jpg, .exr. Without it the values' range is printed.")] = None,
              channel: Annotated[str, typer.Option(help="Colours: mean, gaussian, k1 or k2.")] = "mean",
              radius: Annotated[str, typer.Option(help="Of the surfels fitted to a scan, world units; auto: from its "
                                                  "noise and shape.")] = "auto",
              limit: Annotated[float | None, typer.Option(help="Value of the last colour; by default 95 % of the "
                                                          "values are within.")] = None,
              legend: Annotated[bool, typer.Option("--legend", help="Pictures: draw the scale beside the "
                                                   "surface.")] = False, size: SizeOption = "1024x768",
              direction: DirectionOption = "", up: UpOption = "0,1,0", fov: FovOption = None, eye: EyeOption = "",
              target: TargetOption = "", ortho: OrthoOption = None, device: DeviceOption = "",
              quiet: QuietOption = False):
    """Measure the curvature at every point of a scan, at every surfel of a surface, or at every pixel of a picture."""
    import clsurf
    # Every option is checked before the work.
    steps, picture_size = Steps(quiet), parsed_size(size)
    if channel not in CHANNELS:
        raise InputError(f"channel: expected {', '.join(CHANNELS)}, got {channel!r}")
    if limit is not None and not 0 < limit < float("inf"):
        raise InputError(f"limit: expected a positive number, got {limit:g}")
    view, wide = checked_view(direction, up, fov, eye, target, ortho), parsed_radius(radius)
    if out is not None:
        checked_out(out, SCANS + TABLES + PICTURES)
    chosen = clsurf.open_device(device or None)
    with steps.step("load"):
        thing = clsurf.load(source)
    steps.say(f"  {thing}")
    if out is not None and out.suffix.lower() in PICTURES:
        _picture(thing, view, picture_size, channel, wide, limit, legend, steps, chosen).save(out)
        steps.say(f"picture: {out.resolve()}")
        return
    if isinstance(thing, clsurf.RangeScan):
        thing = thing.to_points()
    with steps.step("curvature"):
        found = clsurf.curvature(thing, radius=wide, progress=steps.progress, device=chosen)
    steps.say(f"  {found}")
    if out is None:
        _print_ranges(found)
        return
    with steps.step("write"):
        if out.suffix.lower() in SCANS:
            clsurf.save(colored(thing, found, channel, limit), out)
        else:
            write_values(found, out)
    steps.say(f"written: {out.resolve()}")


def parsed_radius(text: str) -> float | str:
    """Return a positive length, or 'auto'."""
    if text == "auto":
        return text
    try:
        value = float(text)
        if not 0 < value < float("inf"):
            raise ValueError
    except ValueError:
        raise InputError(f"radius: expected auto or a positive length, got {text!r}") from None
    return value


def _print_ranges(found) -> None:
    import numpy as np
    print(f"{'':10}{'5 %':>12}{'median':>12}{'95 %':>12}")
    for name in CHANNELS:
        values = getattr(found, name)
        known = values[np.isfinite(values)]
        low, middle, high = np.quantile(known, (0.05, 0.5, 0.95)) if len(known) else (np.nan,) * 3
        print(f"{name:10}{low:12.5g}{middle:12.5g}{high:12.5g}")
    print(f"{len(found):,} points, {np.count_nonzero(~np.isfinite(found.mean)):,} of them without curvature")


def colored(thing, found, channel: str, limit: float | None):
    """Return a scan with the channel's colours and the values as attributes; a surface becomes a cloud of its points.

    Points without a curvature are green.
    """
    import numpy as np

    from ..analysis.color_maps import mapped, rounded_up
    from ..io.images import to_srgb8
    from ..surface.cloud import PointCloud
    values = getattr(found, channel)
    known = np.isfinite(values)
    if limit is None:
        limit = rounded_up(float(np.quantile(np.abs(values[known]), 0.95))) if known.any() else 1.0
    linear = np.ones((len(values), 1, 4), np.float32)
    linear[:, 0, :3] = (0.0, 0.5, 0.0)
    linear[known, 0, :3] = mapped(values[known], -limit, limit)
    colors = to_srgb8(linear).reshape(len(values), -1)
    colors = np.concatenate([colors[:, :3], np.full((len(values), 1), 255, np.uint8)], axis=1)
    numbers = {f"{name}_curvature" if name in ("mean", "gaussian") else name: getattr(found, name).astype(np.float32)
               for name in CHANNELS}
    if not hasattr(thing, "points") or len(thing.points) != len(values):
        return PointCloud(found.position, normals=found.normal, colors=colors, attributes=numbers)
    rest = {"uv": None, "texture": None} if hasattr(thing, "uv") else {}
    return dataclasses.replace(thing, colors=colors, attributes={**thing.attributes, **numbers}, **rest)


def write_values(found, out: Path) -> None:
    """Write all numbers: .npz by name, .csv a row a point."""
    import numpy as np

    from ..io.files import replacing
    from ..io.rows import write_rows
    with replacing(out) as temporary:
        if out.suffix.lower() == ".npz":
            np.savez(temporary, **vars(found))
            return
        with open(temporary, "w", encoding="ascii") as file:
            file.write(HEADER + "\n")
            scalars = np.stack([getattr(found, name) for name in CHANNELS], axis=1)
            write_rows(file, [(found.position, "%.15g"), (found.normal, "%.7g"), (scalars, "%.9g"),
                              (found.direction1, "%.7g"), (found.direction2, "%.7g")], separator=",")


def _picture(thing, view, size, channel, radius, limit, legend, steps, device):
    """Return the frame with the channel's colours: curvature of the scan or surface at what every pixel shows."""
    import numpy as np

    import clsurf

    from ..analysis.color_maps import color_map
    surface = thing
    if not is_surface(thing):
        with steps.step("build the surface that is seen"):
            surface = clsurf.build_slim(thing, progress=steps.progress, device=device)
        steps.say(f"  {surface}")
    camera = view.camera(surface, size)
    with steps.step("draw"):
        frame = clsurf.render(surface, camera, size, channels=("color", "position", "normal"), device=device)
    shown = np.isfinite(frame.position).all(axis=2)
    with steps.step("curvature"):
        found = clsurf.curvature(thing, frame.position[shown] + frame.origin, radius, steps.progress, device)
    steps.say(f"  {found}")
    values = np.full(shown.shape, np.nan, np.float32)
    values[shown] = getattr(found, channel)
    seen = dataclasses.replace(frame, channels={**frame.channels, channel: values})
    with steps.step("colours"):
        return color_map(seen, channel, limit, legend)
