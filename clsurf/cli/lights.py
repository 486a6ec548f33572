"""Lights, shadows, ambient occlusion and mirrors: options of `render`."""

from dataclasses import dataclass
from typing import Annotated

import typer

from ..errors import InputError
from .common import parsed_vector

LightOption = Annotated[list[str] | None, typer.Option(help="Direction toward a light: x,y,z, camera axes (right, up, "
                                                       "to the eye); again for more [the eye's own light].")]
ShadowsOption = Annotated[bool, typer.Option("--shadows", help="The lights throw hard shadows; without --light two "
                                             "lights of the scene's own.")]
OcclusionOption = Annotated[int, typer.Option(help="Directions of ambient occlusion, 32 to 256; 0: none.")]
MirrorOption = Annotated[float, typer.Option(help="Share of mirror reflection, 0 to 1.")]

WARM, COOL = ((-1.0, 1.2, 1.0), (0.85, 0.76, 0.66)), ((1.0, 0.7, 1.2), (0.30, 0.35, 0.45))


@dataclass(frozen=True)
class Lighting:
    """The options, checked."""

    lights: tuple  # (direction in camera axes, linear colour) of each
    shading: object

    def scene(self, thing, camera):
        """Return `thing` in a scene with the lights, or as it is where there are none."""
        from ..render.scene import Scene
        from ..render.shade import Light
        if not self.lights:
            return thing
        return Scene([thing], [Light("directional", tuple(direction @ camera.rotation), color)
                               for direction, color in self.lights])


def lighting(look: str, light: list[str] | None, shadows: bool, occlusion: int, mirror: float) -> Lighting:
    """Return the options of light, or raise InputError."""
    import numpy as np

    from ..render.shade import Shading
    if look != "phong" and (light or shadows or occlusion or mirror):
        raise InputError(f"shading: expected phong with --light, --shadows, --occlusion and --mirror, got {look!r}")
    lights = [(parsed_vector("light", text), (0.9 / len(light),) * 3) for text in light or []]
    if not light and shadows:
        lights = [WARM, COOL]
    # What is open to all sides gets about as much light with occlusion as without.
    level = {"ambient": 0.4, "diffuse": 0.65} if occlusion else {}
    return Lighting(tuple((np.array(direction), color) for direction, color in lights),
                    Shading(look=look, shadows=shadows, occlusion=occlusion, mirror=mirror, **level))
