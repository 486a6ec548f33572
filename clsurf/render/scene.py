"""Scenes: several surfaces and their lights in one picture."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..io.stored import StoredSurface
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.placed import Placed
from ..surface.ranges import RangeScan
from ..surface.scale_map import ScaleMap
from ..surface.slim import SlimSurface
from ..surface.surfel import SurfelHierarchy
from .light import Light
from .material import Material, checked_materials

DRAWABLE = (SlimSurface, PatchSurface, SurfelHierarchy, ScaleMap, Mesh, PointCloud, RangeScan, StoredSurface)


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Surfaces that meet in one z-buffer.

    Parameters
    ----------
    surfaces : list of surfaces or placed surfaces
        Place a surface with ``surface.moved(matrix)``. The number in the list is the channel "id".
    lights : list of Light, optional
        By default one headlight.
    materials : Material, or list of Material or None, optional
        Of all surfaces, or of each; a surface without one looks as the `Shading` of the picture says.

    Raises
    ------
    InputError
        Something that cannot be drawn, lights that are none, or another number of materials than of surfaces.
    """

    surfaces: tuple
    lights: tuple[Light, ...] = (Light(),)
    materials: Material | tuple[Material | None, ...] | None = None

    def __post_init__(self):
        if not isinstance(self.surfaces, list | tuple):
            raise InputError(f"scene: expected a list of surfaces, got a {type(self.surfaces).__name__}")
        object.__setattr__(self, "surfaces", tuple(self.surfaces))
        object.__setattr__(self, "lights", (self.lights,) if isinstance(self.lights, Light) else tuple(self.lights))
        wrong = next((light for light in self.lights if not isinstance(light, Light)), None)
        if wrong is not None:
            raise InputError(f"scene lights: expected clsurf.Light objects, got {wrong!r}")
        checked_materials(self.materials, len(self.surfaces))
        for i, surface in enumerate(self.surfaces):
            own = surface.surface if isinstance(surface, Placed) else surface
            if not isinstance(own, DRAWABLE):
                raise InputError(f"scene: surface {i} is a {type(own).__name__}, expected one of "
                                 f"{', '.join(kind.__name__ for kind in DRAWABLE)}, plain or placed: build a surface "
                                 "from a scan first (clsurf.build_slim, clsurf.build_patches, clsurf.build_scale_map)")

    def __repr__(self):
        return f"Scene({len(self.surfaces)} surfaces, {len(self.lights)} lights)"

    @property
    def surface_materials(self) -> tuple[Material | None, ...]:
        """The material of each surface, None for the shading's."""
        return checked_materials(self.materials, len(self.surfaces))

    @property
    def placed(self) -> list[tuple[object, NDArray | None]]:
        """(surface, matrix model to world or None) of each surface."""
        return [(s.surface, s.matrix) if isinstance(s, Placed) else (s, None) for s in self.surfaces]

    @property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64 in world space; NaN where there is nothing."""
        boxes = [b for b in (s.bounds for s in self.surfaces) if np.isfinite(b).all()]
        if not boxes:
            return np.full((2, 3), np.nan)
        return np.stack([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])


def as_scene(thing) -> Scene:
    """Return `thing`, a scene, a surface, a placed surface or a list of those, as a scene."""
    if isinstance(thing, Scene):
        return thing
    return Scene(thing if isinstance(thing, list | tuple) else [thing])


def scene_origin(scene) -> NDArray:
    """Return the world position (3,) float64 that the channel "position" is relative to: the first surface's zero."""
    if not scene.surfaces:
        return np.zeros(3)
    surface, matrix = scene.placed[0]
    return surface.origin.copy() if matrix is None else matrix[:3, :3] @ surface.origin + matrix[:3, 3]
