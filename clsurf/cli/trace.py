"""The command `trace`: rays from a file to their hits, or a camera's rays to a picture of depth."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import FileFormatError, InputError
from .cameras import DirectionOption, EyeOption, FovOption, OrthoOption, TargetOption, UpOption, checked_view
from .common import DeviceOption, QuietOption, SizeOption, Steps, checked_out, is_surface, parsed_size
from .recipe import DegreeOption, ErrorOption, KindOption, PatchesOption, SpacingOption, recipe

TABLES, DEPTHS = (".npz", ".csv"), (".exr", ".png")
HEADER = "ray,distance,x,y,z,nx,ny,nz,primitive"


def trace(source: Annotated[Path, typer.Argument(help="A surface, a mesh, or another scan (its surface is then built "
                                                 "first; so is a mesh's where an option of building is given).")],
          rays: Annotated[Path | None, typer.Argument(help="Rays, one a row: origin x, y, z, direction x, y, z; .npy, "
                                                      "or text with commas or spaces. Without it the camera's rays are "
                                                      "traced.")] = None,
          out: Annotated[Path, typer.Option("--output", "-o", help="Hits: .npz, .csv; the camera's depth: .exr (with "
                                            "normals), .png (near is bright).")] = Path("hits.npz"),
          query: Annotated[str, typer.Option(help="closest, any or all.")] = "closest",
          size: SizeOption = "1024x768", direction: DirectionOption = "", up: UpOption = "0,1,0",
          fov: FovOption = None, eye: EyeOption = "", target: TargetOption = "", ortho: OrthoOption = None,
          kind: KindOption = "", degree: DegreeOption = None, error: ErrorOption = "", patches: PatchesOption = None,
          spacing: SpacingOption = None, device: DeviceOption = "", quiet: QuietOption = False):
    """Find where rays hit a surface or a mesh."""
    import clsurf

    from ..render.checked import checked_size
    from ..trace.tracers import QUERIES
    # Every option is checked before the work.
    steps, picture_size = Steps(quiet), checked_size(parsed_size(size))
    checked_out(out, TABLES if rays is not None else TABLES + DEPTHS)
    if query not in QUERIES:
        raise InputError(f"query: expected one of {', '.join(QUERIES)}, got {query!r}")
    if query == "all" and out.suffix.lower() in DEPTHS:
        raise InputError(f"query: expected closest or any for a picture, got all: write {' or '.join(TABLES)}")
    view = checked_view(direction, up, fov, eye, target, ortho)
    how = recipe(kind, degree, error, patches=patches, spacing=spacing)
    build = bool(kind or degree or error or patches or spacing)
    listed = None if rays is None else read_rays(rays)
    chosen = clsurf.open_device(device or None)
    with steps.step("load"):
        thing = clsurf.load(source)
    steps.say(f"  {thing}")
    if not (is_surface(thing) or isinstance(thing, clsurf.Mesh)) or (
            build and isinstance(thing, clsurf.Mesh)):
        with steps.step("build"):
            thing = how.build(thing, chosen, steps)
        steps.say(f"  {thing}")
    camera = None if listed is not None else view.camera(thing, picture_size)
    origins, directions = (listed[:, :3], listed[:, 3:]) if camera is None else camera.rays(picture_size)
    with steps.step("trace"):
        hits = clsurf.trace(thing, origins, directions, query, device=chosen, progress=steps.progress)
    steps.say(f"  {hits}")
    with steps.step("write"):
        if out.suffix.lower() in DEPTHS:
            depth_picture(hits, camera, picture_size).save(out)
        else:
            write_hits(hits, out)
    steps.say(f"written: {out.resolve()}")


def read_rays(path: Path):
    """Return the rays (n, 6) float64 of a file.

    Raises
    ------
    InputError
        No such file.
    FileFormatError
        Something else than rows of six numbers.
    """
    import numpy as np

    from ..io.files import existing_file
    path = existing_file(path)
    try:
        if path.suffix.lower() == ".npy":
            table = np.load(path, allow_pickle=False).astype(np.float64)
        else:
            rows = [line.replace(",", " ").replace(";", " ").split() for line in path.read_text().splitlines()]
            rows = [row for row in rows if row and not row[0].startswith("#")]
            if rows and not _is_number(rows[0][0]):
                del rows[0]  # names of the columns
            table = np.array([[float(word) for word in row] for row in rows]).reshape(len(rows), -1)
    except (ValueError, TypeError, EOFError, UnicodeDecodeError):
        raise FileFormatError(f"{path}: expected rows of six numbers: origin x, y, z, direction x, y, z") from None
    if table.ndim < 1 or table.shape[-1] != 6:
        raise FileFormatError(f"{path}: expected rows of six numbers (origin, direction), got an array of shape "
                              f"{table.shape}")
    return table.reshape(-1, 6)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def write_hits(hits, path: Path) -> None:
    """Write hits as arrays (.npz) or as a table (.csv) of the rays that hit something, one hit a row."""
    import numpy as np

    from ..io.files import replacing
    with replacing(path) as temporary, open(temporary, "wb") as file:
        if path.suffix.lower() == ".npz":
            arrays = {name: getattr(hits, name) for name in ("distance", "position", "normal", "surface", "primitive")}
            if hits.offsets is not None:
                arrays["offsets"] = hits.offsets
            np.savez(file, **arrays)
            return
        found = np.isfinite(hits.distance)
        ray = np.flatnonzero(found) if hits.offsets is None else \
            np.repeat(np.arange(len(hits.offsets) - 1), np.diff(hits.offsets))
        table = np.column_stack([ray, hits.distance[found], hits.position[found], hits.normal[found],
                                 hits.primitive[found]])
        np.savetxt(file, table, fmt=["%d", *["%.17g"] * 4, *["%.9g"] * 3, "%d"], delimiter=",", header=HEADER,
                   comments="")


def depth_picture(hits, camera, size: tuple[int, int]):
    """Return a Frame of the camera's hits: depth and normal, and as colour the depth from white (near) to grey."""
    import numpy as np

    from ..render.frame import Frame
    width, height = size
    depth = -((hits.position - camera.eye) @ camera.rotation[2]).reshape(height, width).astype(np.float32)
    normal = hits.normal.reshape(height, width, 3).astype(np.float32)
    color = np.zeros((height, width, 4), np.float32)
    color[..., 3] = 1
    hit = np.isfinite(depth)
    if hit.any():
        near, far = depth[hit].min(), depth[hit].max()
        color[hit, :3] = (1 - 0.9 * (depth[hit] - near) / max(far - near, np.finfo(np.float32).tiny))[:, None]
    return Frame({"color": color, "depth": depth, "normal": normal}, np.zeros(3), camera)
