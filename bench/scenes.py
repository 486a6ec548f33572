"""The scans that are measured: real ones where the data is, a generated one everywhere."""

import functools
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clsurf.errors import InputError
from clsurf.io.scans import load_scan
from clsurf.surface.mesh import Mesh

from .truth import mesh_key, vertex_normals

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
    return name == "generated" or (data_folder() / FILES[name]).exists()


@functools.lru_cache(maxsize=8)
def scene(name: str) -> Scene:
    """Return the scene "bunny", "dragon", "fandisk" or "generated".

    Raises
    ------
    InputError
        The scan's file is missing.
    """
    if name == "generated":
        return Scene(name, wavy_torus())
    path = data_folder() / FILES[name]
    if not path.exists():
        raise InputError(f"scene {name}: expected the scan {FILES[name]} in the folder that CLSURF_DATA names, found "
                         f"none: set CLSURF_DATA, or use --quick for a generated scan")
    scan = load_scan(path)
    if scan.normals is None:  # builds are measured from points with normals
        scan = replace(scan, normals=vertex_normals(scan.vertices, scan.faces))
    return Scene(name, scan)


def wavy_torus(around: int = 400, across: int = 150) -> Mesh:
    """Return a closed mesh of about 60,000 vertices with ripples of two sizes: the scene where there is no data.

    It has faces, which the exact pictures need; the generated scans of `clsurf.models` are points.
    """
    t, s = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(across) * 2 * np.pi / across, indexing="ij")
    radius = 0.4 + 0.03 * np.sin(9 * t + 2 * s) + 0.01 * np.sin(31 * t - 8 * s)
    ring = 1 + radius * np.cos(s)
    points = np.stack([ring * np.sin(t), radius * np.sin(s), ring * np.cos(t)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    here, on = i * across + j, (i + 1) % around * across + j
    up, both = i * across + (j + 1) % across, (i + 1) % around * across + (j + 1) % across
    faces = np.stack([here, on, both, here, both, up], axis=-1).reshape(-1, 3)
    return Mesh(points, faces, normals=vertex_normals(points, faces))


def chosen(names, quick: bool) -> list[str]:
    """Return the names that can be measured here; without their data, say so in one line and take the generated one."""
    if quick:
        return ["generated"]
    found = [name for name in names if available(name)]
    missing = [name for name in names if name not in found]
    if missing:
        print(f"scans missing: {', '.join(missing)} (CLSURF_DATA names their folder)"
              + ("; a generated one is measured instead" if not found else ""))
    return found or ["generated"]
