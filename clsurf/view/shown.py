"""What of a viewer is shown: its surfaces, the scans that they were made from, or both in one z-buffer."""

from dataclasses import replace

from ..errors import InputError
from ..render.scene import DRAWABLE, Scene
from ..surface.placed import Placed

SHOWS = ("surface", "scan", "both")


def checked_scans(scans, count: int) -> tuple:
    """Return the scan of each of `count` surfaces, None where there is none; empty without any; or raise InputError.

    `scans` is one of them, or a list.
    """
    if scans is None:
        return ()
    scans = tuple(scans) if isinstance(scans, list | tuple) else (scans,)
    if len(scans) != count:
        raise InputError(f"scans: expected one for each of {count} surfaces, or None, got {len(scans)}")
    for i, scan in enumerate(scans):
        own = scan.surface if isinstance(scan, Placed) else scan
        if own is not None and not isinstance(own, DRAWABLE):
            raise InputError(f"scans: number {i} is a {type(own).__name__}, expected a Mesh, PointCloud, RangeScan or "
                             "surface, plain or placed")
    return scans if any(scan is not None for scan in scans) else ()


def checked_shows(shows: str, scans: tuple) -> str:
    """Return what is shown at first, or raise InputError."""
    if shows not in SHOWS:
        raise InputError(f"shows: expected one of {', '.join(SHOWS)}, got {shows!r}")
    if shows != "surface" and not scans:
        raise InputError(f"shows: expected scans= beside {shows!r}, got none")
    return shows


def scene_of(scene: Scene, scans: tuple, shows: str, only: int) -> Scene:
    """Return the scene of what is shown, of all surfaces or the one numbered `only`.

    A surface without a scan is shown in its place; a scan has its surface's material.
    """
    if only < 0 and (shows == "surface" or not scans):
        return scene
    surfaces, materials = [], []
    for number in range(len(scene.surfaces)) if only < 0 else (only,):
        scan = scans[number] if scans else None
        pair = [scene.surfaces[number]] * (scan is None or shows != "scan")
        pair += [scan] * (scan is not None and shows != "surface")
        surfaces += pair
        materials += [scene.surface_materials[number]] * len(pair)
    return replace(scene, surfaces=tuple(surfaces), materials=None if scene.materials is None else tuple(materials))
