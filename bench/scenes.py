"""The scans that are measured: real ones where the data is, a generated one everywhere."""

import functools
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clsurf.errors import InputError
from clsurf.io.scans import load_scan

from .truth import mesh_key

FILES = {"bunny": "bunny/bunny.obj", "dragon": "dragon/dragon.ply", "fandisk": "denoise/Fandisk0.3/Original.obj"}


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan under a name; `diagonal` (world units) is that of its box, the measure of every relative error."""

    name: str
    scan: object

    @property
    def box(self):
        """(2, 3) float64, world space."""
        return self.scan.bounds

    @property
    def diagonal(self) -> float:
        return float(np.linalg.norm(self.box[1] - self.box[0]))

    @functools.cached_property
    def key(self) -> str:
        """Name of the mesh's content, for the cache of exact pictures."""
        return mesh_key(self.scan.vertices, self.scan.faces)


def data_folder() -> Path:
    """Return the folder of real scans: CLSURF_DATA, else `shared/data` beside the checkout."""
    named = os.environ.get("CLSURF_DATA")
    return Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"


def available(name: str) -> bool:
    """Return whether the scan `name` can be loaded here."""
    return name == "demo" or (data_folder() / FILES[name]).exists()


@functools.lru_cache(maxsize=8)
def scene(name: str) -> Scene:
    """Return the scene "bunny", "dragon", "fandisk" or "demo" (generated).

    Raises
    ------
    InputError
        The scan's file is missing.
    """
    if name == "demo":
        from clsurf.models import demo_scan
        return Scene(name, demo_scan())
    path = data_folder() / FILES[name]
    if not path.exists():
        raise InputError(f"scene {name}: expected the scan {FILES[name]} in the folder that CLSURF_DATA names, found "
                         f"none: set CLSURF_DATA, or use --quick for a generated scan")
    return Scene(name, load_scan(path))


def chosen(names, quick: bool) -> list[str]:
    """Return the names that can be measured here; without their data, say so in one line and take the generated one."""
    if quick:
        return ["demo"]
    found = [name for name in names if available(name)]
    missing = [name for name in names if name not in found]
    if missing:
        print(f"scans missing: {', '.join(missing)} (CLSURF_DATA names their folder)"
              + ("; a generated one is measured instead" if not found else ""))
    return found or ["demo"]
