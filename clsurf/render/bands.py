"""Pictures that do not fit on a device at once: drawn in bands of rows, each from what of the models may touch it.

What a band shows does not depend on the rest of the picture, so that the bands together are the picture, up to the
rounding of places in it.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import DeviceMemoryError
from ..surface.placed import Placed
from ..surface.slim import SlimSurface
from .camera import Camera, Projection
from .frame import Frame
from .scene import Scene

log = logging.getLogger("clsurf")

ROWS = 32  # of pixels: bands begin at multiples, where tiles begin
INTERNAL_SCALE = 1.5  # render/slim.py


@dataclass(frozen=True, eq=False)
class BandCamera(Camera):
    """A camera that sees the rows from `first_row` on of a picture of `whole` (width, height) pixels."""

    whole: tuple[int, int] = (1, 1)
    first_row: int = 0

    def projection(self, size: tuple[int, int]) -> Projection:
        """Return how view space falls onto the band; a `size` wider than the picture has samples inside pixels."""
        factor = size[0] // self.whole[0]
        p = Camera.projection(self, (self.whole[0] * factor, self.whole[1] * factor))
        return replace(p, cy=p.cy - factor * self.first_row)


@dataclass(frozen=True, eq=False, repr=False)
class BandScene(Scene):
    """What of a scene a band may show; `whole` throws shadows and is mirrored."""

    whole: Scene | None = None


def whole_of(scene: Scene) -> Scene:
    """Return the scene that a scene is a band's part of, or itself."""
    return getattr(scene, "whole", None) or scene


def band_of(camera: Camera, whole: tuple[int, int], first_row: int) -> BandCamera:
    """Return `camera` for the rows from `first_row` on of a picture of size `whole`."""
    return BandCamera(camera.eye, camera.rotation, camera.fov, camera.height, camera.intrinsics,
                      camera.intrinsics_size, camera.near, whole, first_row)


def draw_in_bands(draw, scene: Scene, camera: Camera, size: tuple[int, int]) -> Frame:
    """Return the frame of a picture whose parts `draw` can draw.

    Parameters
    ----------
    draw : callable
        draw(scene, camera, size) gives a Frame or raises DeviceMemoryError.
    """
    def band(first: int, rows: int) -> list[Frame]:
        seen = band_of(camera, size, first)
        try:
            frame = draw(culled(scene, seen, (size[0], rows)), seen, (size[0], rows))
            return [Frame({name: np.array(array) for name, array in frame.channels.items()}, frame.origin)]
        except DeviceMemoryError:
            if rows <= ROWS:
                raise
            half = -(-rows // (2 * ROWS)) * ROWS
            return band(first, half) + band(first + half, rows - half)

    if size[1] <= ROWS:
        frames = band(0, size[1])
    else:
        half = -(-size[1] // (2 * ROWS)) * ROWS
        frames = band(0, half) + band(half, size[1] - half)
    log.info("%d x %d pixels are more than the device holds at once: drawn in %d bands", *size, len(frames))
    channels = {name: np.concatenate([frame.channels[name] for frame in frames]) for name in frames[0].channels}
    return Frame(channels, frames[0].origin, camera)


def culled(scene: Scene, camera: Camera, size: tuple[int, int]) -> Scene:
    """Return the scene with the surfels of SLIM surfaces that may touch the picture, and those above them."""
    surfaces = []
    for surface, (own, matrix) in zip(scene.surfaces, scene.placed, strict=True):
        if isinstance(own, SlimSurface) and len(own):
            part = restricted(own, seen_surfels(own, matrix, camera, size))
            surfaces.append(Placed(part, matrix) if isinstance(surface, Placed) else part)
        else:
            surfaces.append(surface)
    return BandScene(surfaces, scene.lights, scene.materials, scene)


def seen_surfels(surface: SlimSurface, matrix: NDArray | None, camera: Camera, size: tuple[int, int]) -> NDArray:
    """Return which balls (n,) bool may touch the picture."""
    matrix = np.eye(4) if matrix is None else matrix
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    world = (surface.centers.astype(np.float64) + surface.origin) @ matrix[:3, :3].T + matrix[:3, 3]
    x, y, z = ((world - camera.eye) @ camera.rotation.T).T
    radius = scale * surface.radii.astype(np.float64) * np.where(surface.leaf, 1.0, INTERNAL_SCALE) * (1 + 1e-5)
    p = camera.projection(size)
    depth = -z if p.perspective else np.ones_like(z)
    seen = np.ones(len(surface), bool)
    # Signed distances from the planes of the picture's sides, times the length of their normals.
    for side, focal, near, far in ((x, p.fx, p.cx, size[0] - p.cx), (-y, p.fy, p.cy, size[1] - p.cy)):
        for sign, room in ((1, near), (-1, far)):
            length = np.hypot(focal, room) if p.perspective else focal
            seen &= sign * focal * side + room * depth > -radius * length
    return seen


def restricted(surface: SlimSurface, keep: NDArray) -> SlimSurface:
    """Return the surfels `keep` (n,) bool and all that are above them, linked as they were."""
    keep = keep.copy()
    parent = np.repeat(np.arange(len(surface)), np.diff(surface.child_offset))
    for level in np.unique(surface.level)[::-1]:
        links = surface.level[surface.children] == level
        keep[parent[links][keep[surface.children[links]]]] = True
    if keep.all():
        return surface
    number = np.cumsum(keep) - 1
    links = keep[parent] & keep[surface.children]
    count = np.bincount(number[parent[links]], minlength=int(keep.sum()))
    take = lambda array: None if array is None else array[keep]  # noqa: E731
    return replace(surface, **{name: take(getattr(surface, name)) for name in (
        "centers", "radii", "normals", "coefficients", "level", "leaf", "fit_error", "footprint", "colors")},
        child_offset=np.concatenate([[0], np.cumsum(count)]).astype(np.int32),
        children=number[surface.children[links]].astype(np.int32))
