"""Options of `render` for scans that are drawn as they are: triangles and points."""

from typing import Annotated

import typer

from ..errors import InputError

AsOption = Annotated[str, typer.Option("--as", help="What a scan is drawn as: surface, built first, or scan, its own "
                                       "triangles or points.")]
PointSizeOption = Annotated[str, typer.Option(help="scan: diameter of points, 0.01 in world units or 3px in pixels "
                                                   "[by their spacing].")]
EyeDomeOption = Annotated[bool | None, typer.Option("--eye-dome/--no-eye-dome", help="scan: shade points by their "
                                                    "neighbours' depth [where they have no normals].")]
AttributeOption = Annotated[str, typer.Option(help="scan: colour points by this attribute, such as intensity.")]


def wants_scan(drawn_as: str, lines: str, channel: str, kind: str) -> bool:
    """Return whether a scan is drawn as it is; raises InputError where other options ask for its surface."""
    if drawn_as not in ("surface", "scan"):
        raise InputError(f"as: expected surface or scan, got {drawn_as!r}")
    for name, value in (("lines", lines), ("channel", channel), ("kind", kind)):
        if drawn_as == "scan" and value:
            raise InputError(f"{name}: expected none with --as scan, got {value!r}: it needs a surface")
    return drawn_as == "scan"


def point_drawing(size: str, eye_dome: bool | None, attribute: str):
    """Return how points are drawn, or raise InputError."""
    from ..render.point_drawing import PointDrawing
    number, unit = (size[:-2], "pixels") if size.endswith("px") else (size, "world")
    try:
        diameter = float(number) if size else None
    except ValueError:
        raise InputError(f"point-size: expected a diameter such as 0.01 or 3px, got {size!r}") from None
    return PointDrawing(size=diameter, unit=unit, eye_dome=eye_dome, attribute=attribute or None)
