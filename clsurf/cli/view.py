"""The command `view`: look at surfaces and scans interactively."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from .cameras import DirectionOption, EyeOption, FovOption, OrthoOption, TargetOption, UpOption, checked_view
from .common import DeviceOption, QuietOption, SizeOption, Steps, parsed_size
from .motion import CameraOption, IgnoreOption, camera_of
from .raw_scans import AttributeOption, EyeDomeOption, PointSizeOption, point_drawing
from .recipe import DegreeOption, ErrorOption, KindOption, PatchesOption, SpacingOption, recipe
from .sources import TextureOption, scans_and_surfaces

BackendOption = Annotated[str, typer.Option(help="window, browser, terminal, or auto: a window where there is a "
                                            "display, else the browser.")]
HostOption = Annotated[str, typer.Option(help="browser: where it is served; 0.0.0.0: to other machines too, to whoever "
                                         "has the URL with its token.")]
ShowsOption = Annotated[str, typer.Option("--as", help="What of scans is shown at first: surface, built from them; "
                                          "scan, their own triangles or points, at once, and no surface is built; "
                                          "both. Key t switches.")]
BudgetOption = Annotated[str, typer.Option(help="Bytes of a streamed surface that are kept in memory, such as 2GB.")]
PortOption = Annotated[int, typer.Option(min=0, max=65535, help="browser: 0 takes a free one.")]


def view(sources: Annotated[list[str], typer.Argument(help="Surfaces or scans, shown in one scene; addresses of "
                                                      "streamed surfaces too.", metavar="FILE...")],
         backend: BackendOption = "auto", host: HostOption = "127.0.0.1", port: PortOption = 0,
         folder: Annotated[Path, typer.Option(help="Where screenshots go.")] = Path("."),
         size: SizeOption = "1024x768", direction: DirectionOption = "", up: UpOption = "0,1,0",
         fov: FovOption = None, eye: EyeOption = "", target: TargetOption = "", ortho: OrthoOption = None,
         camera: CameraOption = "", ignore_distortion: IgnoreOption = False,
         kind: KindOption = "", degree: DegreeOption = None, error: ErrorOption = "", patches: PatchesOption = None,
         spacing: SpacingOption = None, drawn_as: ShowsOption = "surface", point_size: PointSizeOption = "",
         eye_dome: EyeDomeOption = None, attribute: AttributeOption = "", texture: TextureOption = "",
         budget: BudgetOption = "2GB",
         device: DeviceOption = "", quiet: QuietOption = False):
    """Look at surfaces and scans: turn, measure, cut, take pictures; h shows the keys."""
    import clsurf

    from ..render.checked import checked_size
    from ..sizes import checked_budget
    from ..view.canvas import BACKENDS, backend_module, chosen_backend
    # Every option is checked before the work.
    steps, picture_size = Steps(quiet), checked_size(parsed_size(size))
    seen_from = checked_view(direction, up, fov, eye, target, ortho)
    plain = not (direction or eye or target) and fov is None and ortho is None
    if camera and not plain:
        raise InputError("camera: expected --camera or options of a camera (--direction, --fov, --eye, --target, "
                         "--ortho), got both")
    if backend in ("notebook", "offscreen") or backend not in BACKENDS:
        raise InputError(f"backend: expected window, browser, terminal or auto, got {backend!r}")
    chosen = chosen_backend(backend)
    backend_module(chosen)
    if not folder.is_dir():
        raise InputError(f"folder {folder}: expected an existing folder for screenshots")
    given = camera_of(camera, "ignore" if ignore_distortion else "refuse") if camera else None
    how = recipe(kind, degree, error, patches=patches, spacing=spacing)
    points, kept = point_drawing(point_size, eye_dome, attribute), checked_budget(budget)
    opened = clsurf.open_device(device or None)
    surfaces, scans = scans_and_surfaces(sources, how, drawn_as, opened, steps, texture)
    scene = clsurf.Scene(surfaces)
    seen = given if given or plain else seen_from.camera(scene, picture_size)
    viewer = clsurf.view(scene, seen, chosen, picture_size, seen_from.up, host, port, folder, opened,
                         None if chosen != "terminal" else lambda line: None, scans,
                         drawn_as if scans is not None else "surface", points=points, budget=kept)
    if viewer.distance is not None and chosen == "terminal":
        print(f"distance {viewer.distance:.9g}")
