"""Lights, sky, material, shadows, ambient occlusion and mirrors: options of `render`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError
from .common import parsed_vector

LightOption = Annotated[list[str] | None, typer.Option(help="Direction toward a light: x,y,z, camera axes (right, up, "
                                                       "to the eye); again for more [the eye's own light].")]
ShadowsOption = Annotated[bool, typer.Option("--shadows", help="The lights throw hard shadows; without --light two "
                                             "lights of the scene's own.")]
OcclusionOption = Annotated[int, typer.Option(help="Directions of ambient occlusion, 32 to 256; 0: none.")]
SkyOption = Annotated[str, typer.Option(help="Light from all around: sky, overcast, studio, or an equirectangular "
                                        "picture (.exr, .hdr, .png, .jpg); with ,DEGREES after it: turned about --up.")]
MaterialOption = Annotated[str, typer.Option(help="plastic, matte, metal, gold or copper, lit by --sky and --light; "
                                             "matcaps: clay, pearl, jade, bronze, chrome, a picture of a lit sphere.")]
MirrorOption = Annotated[float, typer.Option(help="Share of mirror reflection, 0 to 1.")]

WARM, COOL = ((-1.0, 1.2, 1.0), (0.85, 0.76, 0.66)), ((1.0, 0.7, 1.2), (0.30, 0.35, 0.45))
# Physical materials by name: sRGB colour (None: the surface's own), metallic, roughness.
PHYSICAL = {"plastic": (None, 0.0, 0.35), "matte": (None, 0.0, 0.95), "metal": ((0.77, 0.78, 0.79), 1.0, 0.3),
            "gold": ((1.0, 0.86, 0.57), 1.0, 0.25), "copper": ((0.98, 0.82, 0.76), 1.0, 0.3)}


@dataclass(frozen=True)
class Lighting:
    """The options, checked."""

    lights: tuple  # (direction in camera axes, linear colour) of each
    shading: object
    sky: object = None  # a Light
    material: object = None

    def scene(self, thing, camera):
        """Return `thing` in a scene with the lights, or as it is where there are none."""
        from ..render.light import Light
        from ..render.scene import Scene
        lights = [Light("directional", tuple(direction @ camera.rotation), color) for direction, color in self.lights]
        lights += [] if self.sky is None else [self.sky]
        if not lights and self.material is None:
            return thing
        return Scene([thing], lights or [Light()], self.material)


def lighting(look: str, light: list[str] | None, shadows: bool, occlusion: int, mirror: float, sky: str = "",
             material: str = "", up: str = "0,1,0") -> Lighting:
    """Return the options of light, or raise InputError."""
    import numpy as np

    from ..render.shade import Shading
    if look not in ("phong", "physical") and (light or shadows or occlusion or mirror or sky):
        raise InputError("shading: expected phong or physical with --light, --sky, --shadows, --occlusion and "
                         f"--mirror, got {look!r}")
    if material and look != "phong":
        raise InputError(f"--material: expected no --shading beside it, got {look!r}")
    lights = [(parsed_vector("light", text), (0.9 / len(light),) * 3) for text in light or []]
    if not light and shadows and not sky:
        lights = [WARM, COOL]
    # What is open to all sides gets about as much light with occlusion as without.
    level = {"ambient": 0.4, "diffuse": 0.65} if occlusion and not sky else {}
    return Lighting(tuple((np.array(direction), color) for direction, color in lights),
                    Shading(look=look, shadows=shadows, occlusion=occlusion, mirror=mirror, **level),
                    parsed_sky(sky, up) if sky else None, parsed_material(material, mirror) if material else None)


def parsed_sky(text: str, up: str):
    """Return the image light of a text such as studio or room.exr,90."""
    from ..render.light import Light
    from ..render.skies import SKIES
    name, _, degrees = text.rpartition(",")
    try:
        turn = float(degrees) if name else 0.0
    except ValueError:
        name, turn = "", 0.0
    name = name or text
    if name not in SKIES and not Path(name).is_file():
        raise InputError(f"--sky: expected {', '.join(SKIES)} or a picture, with ,DEGREES after it or not, got "
                         f"{text!r}")
    return Light("image", picture=name if name in SKIES else Path(name), rotation=turn, up=parsed_vector("up", up))


def parsed_material(text: str, mirror: float):
    """Return the material of a name, or the matcap in a file."""
    from ..render.matcaps import MATCAPS
    from ..render.material import Material
    if text in PHYSICAL:
        color, metallic, roughness = PHYSICAL[text]
        return Material("physical", color, metallic=metallic, roughness=roughness, mirror=mirror)
    if text in MATCAPS or Path(text).is_file():
        if mirror:
            raise InputError(f"--mirror: expected no matcap beside it, got --material {text}")
        return Material("matcap", matcap=text)
    raise InputError(f"--material: expected {', '.join((*PHYSICAL, *MATCAPS))} or a picture of a lit sphere, got "
                     f"{text!r}")
