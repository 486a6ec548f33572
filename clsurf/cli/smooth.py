"""The command `smooth`: from scan to scan."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from ..surface.arrays import lengths_of
from .common import DeviceOption, QuietOption, Steps, checked_out


def smooth(scan: Annotated[Path, typer.Argument(help="A mesh or point cloud: PLY OBJ STL OFF GLB XYZ PTS CSV NPY LAS "
                                                "LAZ.")],
           out: Annotated[Path, typer.Option("--out", "-o", help="The smoothed scan; its ending chooses the "
                                             "format.")],
           strength: Annotated[str, typer.Option(help="auto (1) or a number: below 1 points move by that share, above "
                                                 "1 the radii grow by it.")] = "auto",
           iterations: Annotated[int, typer.Option(min=0, help="Smooth the result again.")] = 1,
           method: Annotated[str, typer.Option(help="auto, normals, quadrics or projection.")] = "auto",
           fixed_border: Annotated[bool, typer.Option("--fixed-border", help="Vertices at open borders stay where they "
                                                      "are.")] = False,
           device: DeviceOption = "", quiet: QuietOption = False):
    """Take the noise out of a mesh or a point cloud; noise level and radii are found from the scan itself."""
    import numpy as np

    import clsurf

    from ..io.scans import WRITES
    steps, force = Steps(quiet), _parsed(strength)
    checked_out(out, WRITES)
    with steps.step("load"):
        loaded = clsurf.load(scan)
    steps.say(f"  {loaded}")
    if not isinstance(loaded, clsurf.Mesh | clsurf.PointCloud):
        raise InputError(f"{scan}: expected a mesh or a point cloud, got {type(loaded).__name__}")
    with steps.step("smooth"):
        clean = clsurf.smooth(loaded, force, iterations, method, fixed_border, progress=steps.progress,
                              device=device or None)
    moved = lengths_of(clean.points - loaded.points)
    low, high = loaded.bounds
    steps.say(f"  moved by {np.sqrt(np.mean(moved**2, dtype=np.float64)):.4g} (root mean square), "
              f"{np.sqrt(np.mean(moved**2, dtype=np.float64)) / max(np.linalg.norm(high - low), 1e-300):.3%} of the "
              "diagonal")
    with steps.step("save"):
        clsurf.save(clean, out)
    steps.say(f"written: {out.resolve()}")


def _parsed(text: str) -> float | str:
    from ..analysis.smooth import checked_strength
    try:
        return checked_strength(text if text == "auto" else float(text))
    except (ValueError, InputError):
        raise InputError(f"strength: expected auto or a number from 0 to 100, got {text!r}") from None
