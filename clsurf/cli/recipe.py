"""How a scan becomes a surface: the options of `build`, and of `render` and `report` where they are given a scan."""

from dataclasses import dataclass, field, replace
from typing import Annotated

import typer

from ..errors import InputError
from .common import Steps

KINDS = ("slim", "patches")

KindOption = Annotated[str, typer.Option(help="slim or patches; default: patches for range images or where an option "
                                         "of patches is given, otherwise slim.")]
ErrorOption = Annotated[str, typer.Option(help="slim: T_MDL relative to the bounding box's diagonal [0.01], or 'auto': "
                                          "from the scan's noise. patches: root mean square distance relative to the "
                                          "diagonal.")]
DegreeOption = Annotated[int | None, typer.Option(min=1, max=3, help="slim: degree of the surfels, 1, 2 or 3 [2].")]
PatchesOption = Annotated[int | None, typer.Option(help="patches: how many.")]
SpacingOption = Annotated[float | None, typer.Option(help="patches: distance between nodes, world units.")]
NodesOption = Annotated[str, typer.Option(help="patches: nodes of one, such as 17 or 17x9 [17].")]
MethodOption = Annotated[str, typer.Option(help="patches: areas (meshes), local or global_views (clouds), ranges "
                                           "(range images); by default what fits the scan.")]
ViewsOption = Annotated[int | None, typer.Option(help="patches: number of views of global_views.")]
PreciseOption = Annotated[bool, typer.Option(help="patches: 32-bit displacements and RGBA, 8 bytes a node.")]


@dataclass(frozen=True)
class Recipe:
    """A kind of surface and the options it is built with, checked."""

    kind: str  # "slim", "patches", or "": by the scan
    slim: dict = field(default_factory=dict)
    patches: dict = field(default_factory=dict)

    def kind_for(self, scan) -> str:
        """Return the kind of surface that `scan` becomes."""
        return self.kind or ("patches" if hasattr(scan, "images") else "slim")

    def build(self, scan, device, steps: Steps):
        """Return the surface of `scan`; `device` is a name, a `clsurf.Device` or None."""
        import clsurf
        if self.kind_for(scan) == "patches":
            return clsurf.build_patches(scan, **self.patches, device=device, progress=steps.progress)
        return clsurf.build_slim(scan, **self.slim, device=device, progress=steps.progress)


def recipe(kind: str = "", degree: int | None = None, error: str = "", **patch_options) -> Recipe:
    """Return the recipe that a command's options ask for, or raise InputError.

    Parameters
    ----------
    patch_options
        patches, spacing, nodes ("17x9"), method, views, precise; empty ones are not given.
    """
    from ..build.patches import METHODS, checked_request
    given = {name: value for name, value in patch_options.items() if value not in ("", None) and value is not False}
    if kind not in ("", *KINDS):
        raise InputError(f"kind: expected slim or patches, got {kind!r}")
    if kind == "slim" and given:
        raise InputError(f"--{next(iter(given))}: an option of --kind patches, got --kind slim")
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


def with_tolerance(how: Recipe, tolerance: float) -> Recipe:
    """Return the recipe of a surface that keeps `tolerance` (world units) where it can; 0: as it was."""
    if not tolerance:
        return how
    if how.kind == "patches":
        raise InputError("--tolerance: an option of --kind slim, got --kind patches")
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
