"""Commands from file to file: `info`, `build`, `convert`."""

import math
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from ..surface.arrays import lengths_of
from .common import DeviceOption, QuietOption, Steps, checked_out, is_surface
from .recipe import (
    BitsOption,
    CenterOption,
    DegreeOption,
    ErrorOption,
    HitOption,
    HybridOption,
    KindOption,
    LayersOption,
    MapSizeOption,
    MethodOption,
    NodesOption,
    NormalsOption,
    PatchesOption,
    PreciseOption,
    SpacingOption,
    TexelsOption,
    ViewsOption,
    recipe,
    with_scale_map,
    with_tolerance,
)
from .sources import TextureOption, picture_of
from .stream import checked_stream, stream


def info(path: Annotated[Path, typer.Argument(help="A scan or a surface.")],
         against: Annotated[Path | None, typer.Option(help="A scan: measure how far its points are from the surface, "
                                                      "and the surface from its triangles.")] = None,
         study: Annotated[float | None, typer.Option(help="On a scan: the surfels and numbers that surfaces of degree "
                                                     "1, 2 and 3 need for this L2 error, a share of the diagonal such "
                                                     "as 0.0001.")] = None,
         device: DeviceOption = ""):
    """Say what a file holds: counts, bytes, bounds; with a scan beside it, the surface's error."""
    import clsurf
    thing = clsurf.load(path)
    surface = is_surface(thing)
    if against is not None and not surface and not len(getattr(thing, "faces", ())):
        raise InputError(f"{path}: expected a surface or a mesh to measure against {against}, got points only")
    if study is not None and surface:
        raise InputError(f"{path}: expected a scan to study, got a surface ({type(thing).__name__})")
    print(thing)
    low, high = thing.bounds
    print("bounds   " + " to ".join("[" + ", ".join(f"{v:.10g}" for v in corner) + "]" for corner in (low, high)))
    if isinstance(thing, clsurf.SlimSurface):
        _about_slim(thing)
    elif isinstance(thing, clsurf.PatchSurface):
        _about_patches(thing)
    elif isinstance(thing, clsurf.SurfelHierarchy):
        _about_surfels(thing)
    elif isinstance(thing, clsurf.ScaleMap):
        _about_scale_map(thing)
    elif hasattr(thing, "images"):
        for i, image in enumerate(thing.images):
            print(f"image {i:<3}{image}")
    else:
        print("points   " + ", ".join(f"{name} {'yes' if getattr(thing, name, None) is not None else 'no'}"
                                      for name in ("normals", "colors")))
    if against is not None:
        _about_error(thing, against, device)
    if study is not None:
        from ..analysis.sparsity import sparsity
        print(sparsity(thing, study, device=device or None).table())


def _about_error(surface, scan_path, device) -> None:
    import clsurf

    from ..analysis.error import error
    scan = clsurf.load(scan_path)
    found = error(surface, scan, both=len(getattr(scan, "faces", ())) > 0, device=device or None)
    for name, one in (("against", found), ("back", found.backward)):
        if one is not None:
            what = f"{len(one.distance):,} {'points of ' + scan_path.name if one is found else 'points of the surface'}"
            print(f"{name:<8} {what}: L2 error {one.rms:.4g} ({one.rms / one.diagonal:.4%} of the diagonal), median "
                  f"{one.median:.4g}, 99 % within {one.percentile(99):.4g}, max {one.max:.4g}")


def _about_slim(surface) -> None:
    from ..surface.slim import FLOATS
    leaves = int(surface.leaf.sum())
    print(f"surfels  {len(surface):,}, of which {leaves:,} leaves on {int(surface.level.max(initial=0))} levels, "
          f"{len(surface.children):,} links")
    print(f"floats   {FLOATS[surface.degree] * leaves:,} in the leaves, {FLOATS[surface.degree]} a surfel of degree "
          f"{surface.degree}")
    error = "T_MDL not stored" if math.isnan(surface.error) else f"T_MDL {surface.error:g}"
    print(f"error    {error}, diagonal {surface.diagonal:g}; bound {_bound(surface)}")


def _about_patches(surface) -> None:
    import numpy as np
    sizes, counts = np.unique(surface.size, axis=0, return_counts=True)
    sizes = [f"{count:,} of {m} x {n}" for (m, n), count in zip(sizes, counts, strict=True)]
    print(f"patches  {len(surface):,}: " + ", ".join(sizes[:6] + ["..."] * (len(sizes) > 6)))
    opaque = int(surface.opaque.sum())
    colors = "one" if surface.color is not None else "no" if surface.colors is None else "yes"
    print(f"nodes    {surface.node_count:,}, of which {opaque:,} opaque ({opaque / max(surface.node_count, 1):.1%}), "
          f"colors {colors}, {8 * surface.displacements.itemsize}-bit displacements")
    if len(surface):
        steps = lengths_of(np.concatenate([surface.axis_x, surface.axis_y]).astype(np.float64))
        print(f"spacing  {np.median(steps):.4g} ({steps.min():.4g} to {steps.max():.4g}), displacement step "
              f"{np.median(surface.axis_z_length):.3g}")
    print(f"error    diagonal {surface.diagonal:g}; bound {_bound(surface)}")


def _about_surfels(surface) -> None:
    import numpy as np
    inner, levels = len(surface) - len(surface.base), np.bincount(surface.level)[1:]
    finest = f"{len(surface.triangles):,} triangles of {len(surface.vertices):,} vertices" if surface.hybrid else \
        f"{len(surface.base):,} base surfels"
    print(f"finest   {finest}, spacing {surface.spacing:.4g}")
    levels = levels if surface.hybrid else levels[:-1]
    print(f"inner    {inner:,} surfels; by level " + ", ".join(f"{n:,}" for n in levels))
    sizes, counts = np.unique(surface.map_size[:inner], return_counts=True)
    covered = np.mean(surface.normal_atlas[:, 3] > 0) if len(surface.normal_atlas) else 1.0
    print("maps     " + ", ".join(f"{n:,} of {s} x {s}" for s, n in zip(sizes, counts, strict=True)) +
          f"; {covered:.1%} of {len(surface.normal_atlas):,} texels covered, colors "
          f"{'no' if surface.color_atlas is None else 'yes'}")
    print(f"error    bound {_bound(surface)}")
def _about_scale_map(surface) -> None:
    center = ", ".join(f"{v:.10g}" for v in surface.center)
    print(f"texels   6 x {surface.size} x {surface.size}, {surface.bits} bits, layers {surface.layers}, {surface.hit} "
          f"hits, normals {'no' if surface.normals is None else 'yes'}")
    print(f"sphere   center [{center}], radius {surface.radius:.8g}")
    print(f"rays     {surface.hole_share:.2%} of layer 0 without a hit; " +
          ("with several hits: not known" if math.isnan(surface.multiple_share) else
           f"{surface.multiple_share:.2%} of the sphere with several hits"))
    print(f"error    diagonal {surface.diagonal:g}; bound {_bound(surface)}")


def _bound(surface) -> str:
    if math.isnan(surface.bound):
        return "not stored"
    rest = "" if math.isnan(surface.bound_all) else f", {surface.bound_all:g} for all"
    return f"{surface.bound:g} for {surface.bound_share:.1%} of the scan's points{rest}"


def build(scan: Annotated[Path, typer.Argument(help="A scan: PLY OBJ STL OFF GLB XYZ PTS CSV NPY LAS LAZ, or range "
                                               "images: CONF, a folder of depth and colour frames.")],
          out: Annotated[Path, typer.Argument(help="The surface to write: .clsurf, or for slim .slim2t.")],
          kind: KindOption = "", degree: DegreeOption = None, error: ErrorOption = "", patches: PatchesOption = None,
          spacing: SpacingOption = None, nodes: NodesOption = "", method: MethodOption = "", views: ViewsOption = None,
          precise: PreciseOption = False, map_size: MapSizeOption = None, hybrid: HybridOption = False,
          size: TexelsOption = None, bits: BitsOption = None, layers: LayersOption = None,
          normals: NormalsOption = False, hit: HitOption = "", center: CenterOption = "",
          tolerance: Annotated[float, typer.Option(help="slim: world units; points that the surface does not come so "
                                                   "near get surfels of their own [off].")] = 0.0,
          memory: Annotated[str, typer.Option(help="Stream a LAS, LAZ, PLY or text scan within this memory, such "
                                              "as 1GB; stopped builds go on with the same command.")] = "",
          scheduler: Annotated[str, typer.Option(help="Stream the scan on the workers of a Dask scheduler, "
                                                 "tcp://host:8786 or local; they see the same files.")] = "",
          texture: TextureOption = "", device: DeviceOption = "", quiet: QuietOption = False):
    """Turn a scan into a surface: SLIM surfels, spatial patches, surfels with normal maps, or a spherical scale map."""
    import clsurf
    steps = Steps(quiet)
    how = recipe(kind, degree, error, map_size, hybrid, patches=patches, spacing=spacing, nodes=nodes, method=method,
                 views=views, precise=precise)
    how = with_scale_map(how, size, bits, layers, normals, hit, center)
    how = with_tolerance(how, tolerance)
    if memory or scheduler:
        if texture:
            raise InputError(f"texture: expected none for a streamed scan, got {texture}")
        stream(scan, checked_stream(memory, out), how, memory, scheduler, device or None, steps)
        return
    checked_out(out, (".clsurf", ".slim2t") if how.kind in ("", "slim") else (".clsurf",))
    with steps.step("load"):
        loaded = clsurf.load(scan, picture_of(texture))
    steps.say(f"  {loaded}")
    if is_surface(loaded) and how.kind != "scale_map":
        raise InputError(f"{scan}: expected a scan, got a surface ({type(loaded).__name__})")
    if how.kind_for(loaded) == "patches":
        checked_out(out, (".clsurf",))
    with steps.step("build"):
        surface = how.build(loaded, device or None, steps)
    steps.say(f"  {surface}")
    if not math.isnan(surface.bound):
        steps.say(f"  within {surface.bound:g} of {surface.bound_share:.1%} of the scan's points")
    with steps.step("save"):
        clsurf.save(surface, out)
    steps.say(f"surface: {out.resolve()}")


def convert(source: Annotated[Path, typer.Argument(help="A scan or a surface.")],
            out: Annotated[Path, typer.Argument(help="The file to write; its ending chooses the format. In formats of "
                                                "meshes surfaces become triangles: SLIM surfaces and surfels are "
                                                "meshed, patches their nodes, scale maps their texels, hybrid surfels "
                                                "their mesh. In formats of points (XYZ TXT ASC PTS CSV NPY LAS LAZ) "
                                                "they become evenly spread points.")],
            spacing: Annotated[float | None, typer.Option(help="World units: length of the triangles' edges, distance "
                                                          "of the points [from the surface].")] = None,
            device: DeviceOption = "", quiet: QuietOption = False):
    """Write a scan or a surface in another format."""
    import clsurf

    from ..build.places import checked_spacing
    from ..io.dispatch import WRITES
    from ..io.scans import POINTS
    from ..io.scans import WRITES as SCANS
    steps = Steps(quiet)
    checked_out(out, WRITES)
    checked_spacing(spacing)
    with steps.step("load"):
        thing = clsurf.load(source)
    steps.say(f"  {thing}")
    ending = out.suffix.lower()
    resampled = ending in SCANS and (is_surface(thing) or (spacing is not None and isinstance(thing, clsurf.Mesh) and
                                                           ending in POINTS))
    if spacing is not None and not resampled:
        raise InputError(f"spacing: expected a surface and a format of meshes or points, or a mesh and one of points, "
                         f"got {source} ({type(thing).__name__}) and {out}")
    if resampled:
        make = clsurf.to_points if ending in POINTS else clsurf.to_mesh
        with steps.step("points" if ending in POINTS else "mesh"):
            thing = make(thing, spacing, steps.progress, device or None)
        steps.say(f"  {thing}")
    with steps.step("save"):
        clsurf.save(thing, out)
    steps.say(f"written: {out.resolve()}")
