"""Materials: how the surfaces of a scene, each by itself, look."""

from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .light import checked_numbers

LOOKS = {"phong": 0, "flat": 1, "reflection": 2, "normal": 3, "matcap": 4, "physical": 5}  # materials.clh
LIT_LOOKS = ("phong", "physical")  # what lights, shadows and occlusion change


@dataclass(frozen=True, eq=False)
class Material:
    """What one surface is made of.

    Parameters
    ----------
    look : str
        "phong"; "physical": glTF's metallic-roughness (GGX, Smith, Schlick; what microfacets lose between each other
        is given back, so that a white surface under light from all sides is white at any roughness); "matcap": a
        picture of a lit sphere says what each direction of the normal looks like; "flat": colours without light;
        "normal": the normal, world space, as colour (each axis from -1 to 1 is sRGB 0 to 1); "reflection":
        reflection lines.
    color : (3,) float, optional
        sRGB, 0 to 1, in place of the surface's own colours; None: its own, or `Shading.color` where it has none (with
        "matcap": the picture's).
    diffuse, specular : float
        "phong": weights of matte light and of highlights.
    shininess : int
        "phong": exponent of the highlight (Blinn-Phong).
    metallic, roughness : float
        "physical": 0 to 1 each. Roughness is perceptual: its square is GGX's alpha.
    matcap : str, path or array
        "matcap": "clay", "pearl", "jade", "bronze" or "chrome", which are built in, a file, or an array (h, w, 3 or 4),
        float linear or uint8 sRGB; the sphere fills the picture.
    stripes : float
        "reflection": dark lines on a sphere.
    mirror : float
        "phong" and "physical": share, 0 to 1, of mirror reflection (one bounce) of surfaces, and past them of the
        image light, or without one of the background.
    """

    look: str = "phong"
    color: tuple[float, float, float] | None = None
    diffuse: float = 0.85
    specular: float = 0.15
    shininess: int = 40
    metallic: float = 0.0
    roughness: float = 0.5
    matcap: str | PathLike | NDArray = "clay"
    stripes: float = 6.0
    mirror: float = 0.0

    def __post_init__(self):
        if self.look not in LOOKS:
            raise InputError(f"material look: expected one of {', '.join(LOOKS)}, got {self.look!r}")
        if self.color is not None:
            checked_numbers("material color", self.color, 3)
        check_looks("material", self)
        checked_numbers("material mirror", self.mirror, 0)
        if not 0 <= self.mirror <= 1:
            raise InputError(f"material mirror: expected a share from 0 to 1, got {self.mirror!r}")


def check_looks(name: str, look) -> None:
    """Raise InputError unless the numbers that a `Material` and a `Shading` share are good."""
    for field in ("diffuse", "specular", "shininess", "stripes", "metallic", "roughness"):
        checked_numbers(f"{name} {field}", getattr(look, field), 0)
    if look.shininess != int(look.shininess) or not 0 <= look.shininess <= 4096:
        raise InputError(f"{name} shininess: expected a whole number from 0 to 4096, got {look.shininess}")
    if not 0 < look.stripes <= 4096:
        raise InputError(f"{name} stripes: expected a number over 0, at most 4096, got {look.stripes}")
    for field in ("metallic", "roughness"):
        if not 0 <= getattr(look, field) <= 1:
            raise InputError(f"{name} {field}: expected a number from 0 to 1, got {getattr(look, field)}")


def checked_materials(materials, count: int) -> tuple[Material | None, ...]:
    """Return the material, or None, of each of `count` surfaces, or raise InputError."""
    if materials is None:
        return (None,) * count
    if isinstance(materials, Material):
        return (materials,) * count
    if not isinstance(materials, list | tuple) or len(materials) != count:
        got = f"{len(materials)}" if isinstance(materials, list | tuple) else type(materials).__name__
        raise InputError(f"materials: expected a Material for all surfaces or a list of {count}, one for each, "
                         f"got {got}")
    for i, material in enumerate(materials):
        if material is not None and not isinstance(material, Material):
            raise InputError(f"materials: expected a clsurf.Material or None for surface {i}, got {material!r}")
    return tuple(materials)


def shading_material(shading) -> Material:
    """Return the material that a `Shading` gives to surfaces that have none; balls shine as "phong"."""
    look = shading.look if shading.look in LOOKS else "phong"
    mirror = float(np.max(shading.mirror, initial=0)) if np.ndim(shading.mirror) == 0 else 0.0
    return Material(look, None, shading.diffuse, shading.specular, shading.shininess, shading.metallic,
                    shading.roughness, shading.matcap, shading.stripes, mirror)
