"""How a scan becomes a surface: the options of `build`, and of `render` and `report` where they are given a scan."""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import typer

from ..errors import InputError
from .common import Steps

KINDS = ("slim", "patches", "surfels", "scale_map")

KindOption = Annotated[str, typer.Option(help="slim, patches, surfels or scale_map; default: patches for range images "
                                         "or where an option of patches is given, surfels where one of theirs is, "
                                         "otherwise slim.")]
ErrorOption = Annotated[str, typer.Option(help="slim: T_MDL relative to the bounding box's diagonal [0.01], or 'auto': "
                                          "from the scan's noise. patches: root mean square distance relative to the "
                                          "diagonal.")]
DegreeOption = Annotated[int | None, typer.Option(min=1, max=3, help="slim: degree of the surfels, 1, 2 or 3 [2].")]
PatchesOption = Annotated[int | None, typer.Option(help="patches: how many.")]
SpacingOption = Annotated[float | None, typer.Option(help="patches: distance between nodes; surfels: between base "
                                                     "surfels; world units.")]
NodesOption = Annotated[str, typer.Option(help="patches: nodes of one, such as 17 or 17x9 [17].")]
MethodOption = Annotated[str, typer.Option(help="patches: areas (meshes), local or global_views (clouds), ranges "
                                           "(range images); by default what fits the scan.")]
ViewsOption = Annotated[int | None, typer.Option(help="patches: number of views of global_views.")]
TexelsOption = Annotated[int | None, typer.Option(help="scale_map: texels along a cube face [128].")]
BitsOption = Annotated[int | None, typer.Option(help="scale_map: 8, 16, or 32 for floats [8].")]
LayersOption = Annotated[int | None, typer.Option(help="scale_map: hits of every ray that are kept [1].")]
NormalsOption = Annotated[bool, typer.Option("--normals", help="scale_map: store the model's normals.")]
HitOption = Annotated[str, typer.Option(help="scale_map: outermost or innermost [outermost].")]
CenterOption = Annotated[str, typer.Option(help="scale_map: x,y,z, or visible: a place that sees most; default: that "
                                           "of the bounding sphere.")]
PreciseOption = Annotated[bool, typer.Option(help="patches: 32-bit displacements and RGBA, 8 bytes a node.")]
MapSizeOption = Annotated[int | None, typer.Option(help="surfels: texels along a side of a normal map, 1 to 64 [16].")]
HybridOption = Annotated[bool, typer.Option("--hybrid", help="surfels: the mesh's triangles are the finest level.")]


@dataclass(frozen=True)
class Recipe:
    """A kind of surface and the options it is built with, checked."""

    kind: str  # one of `KINDS`, or "": by the scan
    slim: dict = field(default_factory=dict)
    patches: dict = field(default_factory=dict)
    surfels: dict = field(default_factory=dict)
    scale_map: dict = field(default_factory=dict)

    def kind_for(self, scan) -> str:
        """Return the kind of surface that `scan` becomes."""
        return self.kind or ("patches" if hasattr(scan, "images") else "slim")

    def build(self, scan, device, steps: Steps):
        """Return the surface of `scan`; `device` is a name, a `clsurf.Device` or None."""
        import clsurf
        if self.kind_for(scan) == "patches":
            return clsurf.build_patches(scan, **self.patches, device=device, progress=steps.progress)
        if self.kind == "surfels":
            return clsurf.build_surfels(scan, **self.surfels, device=device, progress=steps.progress)
        if self.kind == "scale_map":
            return clsurf.build_scale_map(scan, **self.scale_map, device=device, progress=steps.progress)
        return clsurf.build_slim(scan, **self.slim, device=device, progress=steps.progress)


def recipe(kind: str = "", degree: int | None = None, error: str = "", map_size: int | None = None,
           hybrid: bool = False, **patch_options) -> Recipe:
    """Return the recipe that a command's options ask for, or raise InputError.

    Parameters
    ----------
    patch_options
        patches, spacing, nodes ("17x9"), method, views, precise; empty ones are not given.
    """
    from ..build.patches import METHODS, checked_request
    given = {name: value for name, value in patch_options.items() if value not in ("", None) and value is not False}
    if kind not in ("", *KINDS):
        raise InputError(f"kind: expected {', '.join(KINDS[:-1])} or {KINDS[-1]}, got {kind!r}")
    of_surfels = {"map_size": map_size} if map_size is not None else {}
    of_surfels |= {"hybrid": True} if hybrid else {}
    if kind == "surfels" or (of_surfels and not kind):
        return surfel_recipe(degree, error, of_surfels, given)
    if of_surfels:
        name = next(iter(of_surfels)).replace("_", "-")
        raise InputError(f"--{name}: an option of --kind surfels, got --kind {kind}")
    if kind in ("slim", "scale_map") and given:
        raise InputError(f"--{next(iter(given))}: an option of --kind patches, got --kind {kind}")
    if kind == "scale_map":
        if degree is not None or error:
            raise InputError(f"--{'error' if error else 'degree'}: not an option of --kind scale_map")
        return Recipe(kind)
    if degree is not None and (given or kind == "patches"):
        raise InputError(f"--degree: an option of --kind slim, got --{next(iter(given)) if given else 'kind patches'}")
    kind = kind or ("patches" if given else "")
    if "nodes" in given:
        given["nodes"] = parsed_nodes(given["nodes"])
    if given.get("method", "local") not in METHODS:
        raise InputError(f"method: expected one of {', '.join(METHODS)}, got {given['method']!r}")
    if kind != "slim" and error and (kind or error != "auto"):
        given["error"] = parsed_error(error, "patches" if kind else "")
    checked_request(given.get("nodes", 17), *(given.get(name) for name in ("patches", "spacing", "error", "views")),
                    given.get("precise", False))
    slim = {"degree": degree or 2, "error": parsed_error(error, "slim") if kind != "patches" and error else None}
    return Recipe(kind, slim, given)


def surfel_recipe(degree, error, of_surfels: dict, others: dict) -> Recipe:
    """Return the recipe of a surfel hierarchy, or raise InputError where options of other kinds are given."""
    from ..build.surfels import checked_options
    spacing = others.pop("spacing", None)
    wrong = "degree" if degree is not None else "error" if error else next(iter(others), None)
    if wrong:
        raise InputError(f"--{wrong}: an option of --kind {'slim' if wrong in ('degree', 'error') else 'patches'}, got "
                         "--kind surfels")
    checked_options(spacing, of_surfels.get("map_size", 16), of_surfels.get("hybrid", False))
    return Recipe("surfels", surfels=of_surfels | ({} if spacing is None else {"spacing": spacing}))


def with_scale_map(how: Recipe, size: int | None, bits: int | None, layers: int | None, normals: bool, hit: str,
                   center: str, names: tuple[str, str] = ("size", "normals")) -> Recipe:
    """Return the recipe with the options of scale maps, or raise InputError where it makes something else.

    `names` are those of the command's options for `size` and `normals`.
    """
    options = {"size": size, "bits": bits, "layers": layers, "normals": normals, "hit": hit, "center": center}
    options = {name: value for name, value in options.items() if value not in ("", None) and value is not False}
    if options and how.kind != "scale_map":
        name = next(iter(options))
        raise InputError(f"--{dict(zip(('size', 'normals'), names, strict=True)).get(name, name)}: an option of --kind "
                         f"scale_map, got --kind {how.kind or 'slim'}")
    if options.get("center", "visible") != "visible":
        options["center"] = parsed_center(options["center"])
    from ..build.scale_map import check_options
    check_options(**{name: options.get(name, value) for name, value in (("size", 128), ("bits", 8), ("layers", 1),
                                                                      ("hit", "outermost"))})
    return replace(how, scale_map=options)


def parsed_center(text: str) -> tuple[float, ...]:
    """Return the three numbers of a text such as 0,1.5,0."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
            raise ValueError
    except ValueError:
        raise InputError(f"center: expected three numbers such as 0,1.5,0, or visible, got {text!r}") from None
    return numbers


def with_tolerance(how: Recipe, tolerance: float) -> Recipe:
    """Return the recipe of a surface that keeps `tolerance` (world units) where it can; 0: as it was."""
    if not tolerance:
        return how
    if how.kind not in ("", "slim"):
        raise InputError(f"--tolerance: an option of --kind slim, got --kind {how.kind}")
    return replace(how, kind="slim", slim=how.slim | {"tolerance": tolerance})


def parsed_error(text: str, kind: str = "slim") -> float | str:
    """Return an error relative to the diagonal as a number, or for "slim" 'auto'."""
    if text == "auto" and kind != "patches":
        return text
    try:
        value = float(text)
        if not 0 < value < 1:
            raise ValueError
    except ValueError:
        auto = "" if kind == "patches" else ", or auto"
        raise InputError(f"error: expected a number between 0 and 1 such as 0.01{auto}, got {text!r}") from None
    return value


def parsed_nodes(text: str) -> tuple[int, int]:
    """Return the nodes along both axes of a text such as 17 or 17x9."""
    m, two, n = text.lower().partition("x")
    n = n if two else m
    if not (m.isdecimal() and n.isdecimal()):
        raise InputError(f"nodes: expected a number such as 17, or two such as 17x9, got {text!r}")
    return int(m), int(n)
