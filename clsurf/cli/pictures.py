"""Commands that draw: `demo`, `render`, `report`."""

import time
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from .cameras import DirectionOption, EyeOption, FovOption, OrthoOption, TargetOption, UpOption, checked_view
from .color_maps import ChannelOption, LegendOption, LimitOption, channel_picture
from .common import (
    PICTURES,
    DeviceOption,
    ProfileOption,
    QuietOption,
    SizeOption,
    Steps,
    checked_out,
    parsed_size,
)
from .drawing import Drawing, write_moving
from .lights import LightOption, MaterialOption, MirrorOption, OcclusionOption, ShadowsOption, SkyOption, lighting
from .line_pictures import LinesOption, OnWhiteOption, endings, line_picture
from .motion import (
    CameraOption,
    FpsOption,
    FramesOption,
    IgnoreOption,
    PathOption,
    SchedulerOption,
    TurntableOption,
    motion,
)
from .output import AntialiasOption, BackgroundOption, BitsOption, ExposureOption, ToneOption, output
from .raw_scans import AsOption, AttributeOption, EyeDomeOption, PointSizeOption, point_drawing, wants_scan
from .recipe import BitsOption as MapBitsOption
from .recipe import (
    CenterOption,
    DegreeOption,
    ErrorOption,
    HitOption,
    HybridOption,
    KindOption,
    LayersOption,
    MapSizeOption,
    PatchesOption,
    SpacingOption,
    TexelsOption,
    parsed_error,
    recipe,
    with_scale_map,
)
from .sources import TextureOption, loaded_surface, surface_in

SourceArgument = Annotated[str, typer.Argument(help="A surface, or a scan (its surface is then built first), or the "
                                               "address of a streamed surface.")]
LodOption = Annotated[float, typer.Option(help="slim: projected diameter in pixels below which coarser surfels serve; "
                                          "8 is the fast mode, 0 draws leaves only; surfels: the same near "
                                          "silhouettes.")]
InteriorOption = Annotated[float, typer.Option(help="surfels: projected diameter in pixels that they may have away "
                                               "from silhouettes.")]
ReliefOption = Annotated[float, typer.Option(help="surfels: pixels that bumps on a surfel may appear away from where "
                                             "they are; inf: surfels go by their size alone.")]
NoMapsOption = Annotated[bool, typer.Option("--no-maps", help="surfels: one normal each, without normal maps.")]
NodesOption = Annotated[str, typer.Option(help="patches: projection of nodes, exact, trilinear or homogeneous.")]
CellsOption = Annotated[str, typer.Option(help="patches: what fills a cell, quads, triangles, bilinear or smooth.")]
AlphaOption = Annotated[bool, typer.Option("--alpha", help="patches: draw cells with transparent nodes, up to half "
                                           "their alpha.")]
FormOption = Annotated[str, typer.Option(help="scale_map: cast (rays of pixels) or geosphere.")]
FacesOption = Annotated[int, typer.Option(help="scale_map: subdivisions of the geosphere, 0 to 9; 6: 81,920 "
                                          "triangles.")]
MapNormalsOption = Annotated[str, typer.Option(help="scale_map: auto, stored, neighbours or gradient.")]
StoredNormalsOption = Annotated[bool, typer.Option("--stored-normals", help="scale_map: build it with the model's "
                                                   "normals.")]
SamplesOption = Annotated[int, typer.Option(help="Samples along each side of a pixel, 1 to 4.")]
LookOption = Annotated[str, typer.Option(help="phong, physical, matcap, normal, flat, reflection (lines); slim: "
                                              "ball_size, ball_level.")]


def demo(out: Annotated[Path, typer.Argument(help="Picture to write: .png, .jpg, .exr.")] = Path("clsurf-demo.png"),
         size: SizeOption = "1024x768",
         error: Annotated[str, typer.Option(help="T_MDL relative to the diagonal, or 'auto': from the scan's "
                                                 "noise.")] = "0.01",
         degree: Annotated[int, typer.Option(min=1, max=3, help="Degree of the surfels: 1, 2 or 3.")] = 2,
         device: DeviceOption = "", quiet: QuietOption = False):
    """Make a scan, build its surface, draw it, and say where the picture is and how long each step took."""
    import clsurf
    steps, start = Steps(quiet), time.perf_counter()
    picture_size, t_mdl = parsed_size(size), parsed_error(error)
    checked_out(out, PICTURES)
    with steps.step("open the device"):
        chosen = clsurf.open_device(device or None)
    steps.say(f"  {chosen.name} ({chosen.platform_name})")
    with steps.step("make a scan"):
        scan = clsurf.models.demo_scan()
    steps.say(f"  {scan}")
    with steps.step("build the surface"):
        surface = clsurf.build_slim(scan, degree=degree, error=t_mdl, device=chosen, progress=steps.progress)
    steps.say(f"  {surface}")
    camera = clsurf.Camera.framing(surface, aspect=picture_size[0] / picture_size[1])
    with steps.step("draw it"):
        frame = clsurf.render(surface, camera, picture_size, device=chosen)
    with steps.step("draw it again (kernels are ready)"):
        frame = clsurf.render(surface, camera, picture_size, device=chosen)
    with steps.step("write the picture"):
        frame.save(out)
    steps.say(f"picture: {out.resolve()} ({picture_size[0]} x {picture_size[1]}), all in "
              f"{time.perf_counter() - start:.1f} s")
    if quiet:
        print(out.resolve())


def render(source: SourceArgument,
           out: Annotated[Path, typer.Argument(help="Picture: .png, .jpg, or .exr with every channel; with "
                                               "--turntable or --path .mp4, .gif, .webp or a folder.")],
           size: Annotated[str, typer.Option(help="Picture size [1024x768, or that of --camera or --path].")] = "",
           direction: DirectionOption = "", up: UpOption = "0,1,0",
           fov: FovOption = None, eye: EyeOption = "", target: TargetOption = "", ortho: OrthoOption = None,
           turntable: TurntableOption = None, path: PathOption = None, frames: FramesOption = None,
           fps: FpsOption = 30.0, camera: CameraOption = "", ignore_distortion: IgnoreOption = False,
           scheduler: SchedulerOption = "",
           channels: Annotated[str, typer.Option(help="From color,depth,normal,position,level,count,cost,id, and "
                                                      "those of --channel; .png and .jpg show "
                                                      "color.")] = "color,depth,normal",
           shading: LookOption = "phong", material: MaterialOption = "", light: LightOption = None,
           sky: SkyOption = "", shadows: ShadowsOption = False, occlusion: OcclusionOption = 0,
           mirror: MirrorOption = 0.0, background: BackgroundOption = "", supersampling: SamplesOption = 1,
           antialias: AntialiasOption = "none", tone: ToneOption = "none", exposure: ExposureOption = 0.0,
           bits: BitsOption = 8,
           lod: LodOption = 4.0, nodes: NodesOption = "exact", cells: CellsOption = "quads", alpha: AlphaOption = False,
           channel: ChannelOption = "", legend: LegendOption = False, limit: LimitOption = 0.0,
           interior: InteriorOption = 16.0, relief: ReliefOption = 0.75, no_maps: NoMapsOption = False,
           lines: LinesOption = "", on_white: OnWhiteOption = False,
           form: FormOption = "cast", faces: FacesOption = 6, normals: MapNormalsOption = "auto",
           drawn_as: AsOption = "surface", point_size: PointSizeOption = "", eye_dome: EyeDomeOption = None,
           attribute: AttributeOption = "", texture: TextureOption = "",
           kind: KindOption = "", degree: DegreeOption = None, error: ErrorOption = "",
           patches: PatchesOption = None, spacing: SpacingOption = None, map_size: MapSizeOption = None,
           hybrid: HybridOption = False, profile: ProfileOption = False, device: DeviceOption = "",
           quiet: QuietOption = False):
    """Draw a surface, or a scan or its surface, into a picture, or into a moving one."""
    import clsurf

    from ..device import Profile
    from ..render.checked import checked_channels, checked_lod, checked_size
    # Every option is checked before the work.
    seen_from = direction or eye or target or (fov, ortho) != (None, None)
    moving = motion(out, turntable, path, frames, fps, camera, ignore_distortion, bool(seen_from), scheduler)
    if scheduler and profile:
        raise InputError("--profile: expected no --scheduler beside it: the workers draw")
    steps, picture_size = Steps(quiet), checked_size(parsed_size(size) if size else moving.size)
    wanted = checked_channels(filter(None, channels.split(",")))
    strokes, colored = line_picture(lines, on_white), channel_picture(channel, legend, limit, lines, out)
    if not moving.moves:
        checked_out(out, endings(strokes))
    if out.suffix.lower() not in (".exr", ".svg") and "color" not in wanted:
        raise InputError(f"channels: expected color among them for a {out.suffix} picture, got {channels}: add it, or "
                         "write .exr")
    view = checked_view(direction, up, fov, eye, target, ortho)
    how = recipe(kind, degree, error, map_size, hybrid, patches=patches, spacing=spacing)
    surfels = clsurf.SurfelDrawing(interior, not no_maps, relief)
    lit = lighting(shading, light, shadows, occlusion, mirror, sky, material, up)
    lod, patch_drawing = checked_lod(lod), checked_drawing(nodes, cells, alpha)
    scale_map = clsurf.ScaleMapDrawing(form, faces, normals)
    written = output(out, background, antialias, supersampling, tone, exposure, bits, lines, channel, moving.moves)
    if written.background == "sky" and not sky:
        raise InputError("--background sky: expected --sky beside it")
    as_it_is, points = wants_scan(drawn_as, lines, channel, kind), point_drawing(point_size, eye_dome, attribute)
    if colored:
        colored.prepared(how, degree)
    if texture and (scheduler or strokes):
        raise InputError(f"texture: expected none with --{'scheduler' if scheduler else 'lines'}, got {texture}")
    # Workers have devices of their own.
    chosen = device or None if scheduler else clsurf.open_device(device or None)
    coarse = None
    if scheduler:
        thing = surface_in(source, as_it_is, steps)
        wanted = strokes.channels(wanted, True) if strokes else wanted
    elif strokes:
        thing, found_on = strokes.surfaces(source, how, chosen, steps)
        coarse = None if found_on is thing else found_on
        wanted = strokes.channels(wanted, coarse is None)
    else:
        thing = loaded_surface(source, how, chosen, steps, as_it_is, texture=texture)
    drawing = Drawing(lit, written, wanted, lod, {
        "supersampling": supersampling, "patches": patch_drawing, "surfels": surfels, "scale_map": scale_map,
        "points": points}, colored, strokes, coarse)
    if not scheduler:
        chosen.profile = Profile() if profile else None
    if moving.moves:
        write_moving(out, moving, drawing, source, thing, view, picture_size, scheduler, chosen, steps)
    else:
        seen = moving.camera or view.camera(thing, picture_size)
        with steps.step("draw"):
            frame = drawing(thing, seen, picture_size, chosen)
    if profile:
        print(chosen.profile)
        chosen.profile = None
    if strokes and not moving.moves:
        strokes.save(out, frame, coarse, seen, picture_size, chosen, steps)
    elif not moving.moves:
        with steps.step("write"):
            written.save(frame, out)
    steps.say(f"{'video' if moving.moves else 'picture'}: {out.resolve()}")


def report(source: SourceArgument,
           out: Annotated[Path, typer.Option("--out", "-o", help="The page to write: .html.")] = Path("report.html"),
           size: SizeOption = "500x500", direction: DirectionOption = "", up: UpOption = "0,1,0",
           fov: FovOption = None, eye: EyeOption = "", target: TargetOption = "", ortho: OrthoOption = None,
           lod: LodOption = 4.0, nodes: NodesOption = "exact", cells: CellsOption = "quads", alpha: AlphaOption = False,
           kind: KindOption = "", degree: DegreeOption = None, error: ErrorOption = "", patches: PatchesOption = None,
           spacing: SpacingOption = None, map_size: MapSizeOption = None, hybrid: HybridOption = False,
           texels: TexelsOption = None, bits: MapBitsOption = None, layers: LayersOption = None,
           stored_normals: StoredNormalsOption = False, hit: HitOption = "", center: CenterOption = "",
           interior: InteriorOption = 16.0, relief: ReliefOption = 0.75, no_maps: NoMapsOption = False,
           form: FormOption = "cast", faces: FacesOption = 6, normals: MapNormalsOption = "auto",
           device: DeviceOption = "", quiet: QuietOption = False):
    """Write one HTML page about a surface and a view of it: counts, operations, times, the picture."""
    import clsurf

    from ..render.checked import checked_lod, checked_size
    steps, picture_size = Steps(quiet), checked_size(parsed_size(size))
    checked_out(out, (".html", ".htm"))
    view = checked_view(direction, up, fov, eye, target, ortho)
    how = recipe(kind, degree, error, map_size, hybrid, patches=patches, spacing=spacing)
    how = with_scale_map(how, texels, bits, layers, stored_normals, hit, center, ("texels", "stored-normals"))
    lod, drawing = checked_lod(lod), checked_drawing(nodes, cells, alpha)
    surfels = clsurf.SurfelDrawing(interior, not no_maps, relief)
    scale_map = clsurf.ScaleMapDrawing(form, faces, normals)
    chosen = clsurf.open_device(device or None)
    thing = loaded_surface(source, how, chosen, steps, whole=True)
    with steps.step("report"):
        clsurf.report(thing, out, view.camera(thing, picture_size), picture_size, title=Path(source).name, lod=lod,
                      patches=drawing, surfels=surfels, scale_map=scale_map, device=chosen)
    steps.say(f"page: {out.resolve()}")


def checked_drawing(nodes: str, cells: str, alpha: bool):
    """Return how patches are drawn, or raise InputError."""
    from ..render.patch_drawing import PatchDrawing
    return PatchDrawing(nodes=nodes, cells=cells, alpha=alpha)
