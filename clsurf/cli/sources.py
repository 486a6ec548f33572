"""What commands draw: the surfaces and scans in files, and streamed surfaces that stay where they are."""

from typing import Annotated

import typer

from ..errors import InputError
from .common import Steps, is_surface
from .recipe import Recipe

TextureOption = Annotated[str, typer.Option(help="Picture for a mesh whose file has texture coordinates but names no "
                                            "picture: FILE, or FILE:flip where it is upside down.")]
FLIP = ":flip"


def picture_of(texture: str):
    """Return what `clsurf.load` takes for the option --texture."""
    if texture.endswith(FLIP):
        from ..io.images import read_image
        return read_image(texture.removesuffix(FLIP))[::-1]
    return texture or None


def loaded(source, steps: Steps, texture: str = ""):
    """Return what the file `source` holds; a surface in parts, in a folder or on the web, is only opened."""
    import clsurf

    from ..io.stored import in_parts
    with steps.step("load"):
        stays = "://" in str(source) or in_parts(source)
        thing = clsurf.open_surface(source) if stays and not texture else clsurf.load(source, picture_of(texture))
    steps.say(f"  {thing}")
    return thing


def loaded_surface(source, how: Recipe, device, steps: Steps, as_it_is: bool = False, whole: bool = False,
                   texture: str = ""):
    """Return the surface in the file `source`, or the one built from the scan in it.

    `as_it_is`: the scan; `whole`: read a surface in parts as one.
    """
    import clsurf
    thing = loaded(source, steps, texture)
    if not as_it_is and not is_surface(thing):
        thing = built(thing, how, device, steps)
    return thing.load() if whole and isinstance(thing, clsurf.StoredSurface) else thing


def surface_in(source, as_it_is: bool, steps: Steps):
    """Return the surface in a file, or with `as_it_is` the scan: what workers of a scheduler read for themselves."""
    thing = loaded(source, steps)
    if not as_it_is and not is_surface(thing):
        raise InputError(f"scheduler: expected a surface, which the workers read, got a {type(thing).__name__} in "
                         f"{source}: build it first (clsurf build), or draw it --as scan")
    return thing


def built(scan, how: Recipe, device, steps: Steps):
    """Return the surface of a scan."""
    with steps.step("build"):
        surface = how.build(scan, device, steps)
    steps.say(f"  {surface}")
    return surface


def scans_and_surfaces(sources, how: Recipe, drawn_as: str, device, steps: Steps,
                       texture: str = "") -> tuple[list, list | None]:
    """Return what the files are shown as, and the scan behind each where it was built from one; None without any.

    `texture`: of the first.

    Raises
    ------
    InputError
        `drawn_as` is none of the ways, or asks for scans where there are only surfaces.
    """
    from ..view.shown import SHOWS
    if drawn_as not in SHOWS:
        raise InputError(f"as: expected {', '.join(SHOWS[:-1])} or {SHOWS[-1]}, got {drawn_as!r}")
    if drawn_as == "scan" and how.kind:
        raise InputError(f"kind: expected none with --as scan, got {how.kind!r}: no surface is built")
    things = [loaded(source, steps, texture if i == 0 else "") for i, source in enumerate(sources)]
    scans = [None if is_surface(thing) else thing for thing in things]
    if drawn_as != "surface" and not any(scan is not None for scan in scans):
        raise InputError(f"as: expected a scan to show as {drawn_as}, got surfaces only")
    if drawn_as == "scan":
        return things, None
    surfaces = [thing if scan is None else built(scan, how, device, steps)
                for thing, scan in zip(things, scans, strict=True)]
    return surfaces, scans if any(scan is not None for scan in scans) else None
