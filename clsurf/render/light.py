"""Lights: at the eye, from far away, from a place, in a cone, from a picture of the surroundings."""

from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

KINDS = {"headlight": 0, "directional": 1, "point": 2, "spot": 3, "image": 4}
LIGHT_FLOATS = 16  # kernels/render/shade.clh


@dataclass(frozen=True, eq=False)
class Light:
    """A light.

    Parameters
    ----------
    kind : str
        "headlight" (at the eye), "directional", "point", "spot" or "image" (what surrounds the scene, far away; one in
        a scene).
    vector : (3,) float
        Directional: from the surface to the light, world space. Point and spot: its position, world space.
    color : (3,) float
        Linear red, green, blue; 1 lights a white surface fully. An image's colours are multiplied by it.
    intensity : float
        Multiplies `color`.
    range : float, optional
        Of a point or spot light: the distance, world units, at which its light ends. On the way there it falls off as
        (1 - (distance / range)^2)^2; without a range it does not.
    direction : (3,) float
        Where a spot shines to, world space.
    cone : (float, float)
        Half angles, degrees, of a spot's cone: full light within the first, none beyond the second, in between the
        square of the part of the way in cosine (glTF's punctual lights).
    picture : str, path or array
        Of an image light: "sky", "overcast" or "studio", which are built in, a file (.exr, .hdr, .png, .jpg), or an
        array (h, w, 3 or 4), float linear or uint8 sRGB. Equirectangular: the top row is up; without `up` and
        `rotation` the middle looks along -z, +x lies right of it.
    rotation : float
        Turns the picture about `up`, degrees, counterclockwise seen from above.
    up : (3,) float
        The direction of the picture's top row, world space.
    """

    kind: str = "headlight"
    vector: tuple[float, float, float] = (0.0, 0.0, 1.0)
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    intensity: float = 1.0
    range: float | None = None
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    cone: tuple[float, float] = (20.0, 30.0)
    picture: str | PathLike | NDArray = "sky"
    rotation: float = 0.0
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def __post_init__(self):
        if self.kind not in KINDS:
            raise InputError(f"light kind: expected one of {', '.join(KINDS)}, got {self.kind!r}")
        if np.shape(self.vector) != (3,) or np.shape(self.color) != (3,):
            raise InputError("light: expected a vector and a color of 3 numbers each")
        for name, count in (("intensity", 0), ("rotation", 0), ("direction", 3), ("up", 3), ("cone", 2)):
            checked_numbers(f"light {name}", getattr(self, name), count)
        if self.intensity < 0:
            raise InputError(f"light intensity: expected a number of at least 0, got {self.intensity}")
        if self.range is not None:
            checked_numbers("light range", self.range, 0)
            if self.range <= 0:
                raise InputError(f"light range: expected a distance over 0 or None, got {self.range}")
        inner, outer = self.cone
        if not 0 <= inner <= outer <= 180 or outer == 0:
            raise InputError(f"light cone: expected two half angles in degrees, 0 <= inner <= outer <= 180, got "
                             f"{self.cone}")
        for name in ("direction", "up"):
            if not np.any(getattr(self, name)):
                raise InputError(f"light {name}: expected a direction, got {getattr(self, name)}")

    @property
    def radiance(self) -> NDArray:
        """Linear colour (3,) float64 times intensity."""
        return np.asarray(self.color, np.float64) * self.intensity

    def axes(self) -> NDArray:
        """Axes (3, 3) float64 of an image light's picture, world space: to its right, up, and out of its middle."""
        up = np.asarray(self.up, np.float64) / np.linalg.norm(self.up)
        # The middle looks along -z wherever that is not up itself; then along +y, as z-up scans are looked at.
        ahead = np.array([0.0, 0.0, -1.0]) if abs(up[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
        ahead = ahead - (ahead @ up) * up
        ahead /= np.linalg.norm(ahead)
        right, angle = np.cross(ahead, up), np.radians(self.rotation)
        turned = np.cos(angle) * ahead - np.sin(angle) * right
        return np.stack([np.cross(turned, up), up, turned])


def checked_numbers(name: str, value, count: int) -> None:
    """Raise InputError unless `value` is `count` finite numbers (0: one number)."""
    try:
        wrong = np.shape(value) != ((count,) if count else ()) or not np.isfinite(np.asarray(value, np.float64)).all()
    except (TypeError, ValueError):
        wrong = True
    if wrong:
        raise InputError(f"{name}: expected {f'{count} numbers' if count else 'a number'}, got {value!r}")


def light_floats(lights, camera) -> NDArray:
    """Return the lamps (n, 16) float32 of kernels/render/shade.clh, in view space, image lights left out."""
    lamps = [light for light in lights if light.kind != "image"]
    out = np.zeros((len(lamps), LIGHT_FLOATS), np.float32)
    for row, light in zip(out, lamps, strict=True):
        vector = np.asarray(light.vector, np.float64)
        if light.kind == "directional":
            vector = camera.rotation @ vector / max(np.linalg.norm(vector), 1e-300)
        elif light.kind != "headlight":
            vector = camera.rotation @ (vector - camera.eye)
        row[:7] = KINDS[light.kind], *vector, *light.radiance
        if light.kind in ("point", "spot") and light.range is not None:
            row[7] = 1 / light.range**2
        if light.kind == "spot":
            along = np.asarray(light.direction, np.float64)
            row[8:11] = camera.rotation @ along / np.linalg.norm(along)
            inner, outer = np.cos(np.radians(light.cone))
            row[11:13] = outer, 1 / max(inner - outer, 1e-6)
    return out
