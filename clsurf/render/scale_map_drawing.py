"""How scale maps are drawn."""

from dataclasses import dataclass

from ..errors import InputError

CHOICES = {"form": ("cast", "geosphere"), "normals": ("auto", "stored", "neighbours", "gradient")}
LARGEST_LEVEL = 9  # 5,242,880 triangles


@dataclass(frozen=True)
class ScaleMapDrawing:
    """How scale maps are drawn (Reiter, "Spherical Scale Mapping", section 3).

    Parameters
    ----------
    form : str
        "cast": the ray of every pixel meets the map's own interpolated surface; "geosphere": a subdivided icosahedron
        is displaced by the map and drawn, as in the paper. Steep slopes need more triangles than a geosphere has.
    level : int
        Subdivisions of the icosahedron, 0 to 9: 20 4^level triangles; 6 has 81,920.
    normals : str
        "stored"; "neighbours": from four neighbours of every texel, as in the paper; "gradient": from the gradient of
        the map, exact to second order; "auto": stored ones where the map has them, otherwise the gradient's. Layers
        other than the first have their own.
    epsilon : float, optional
        With "neighbours": their distance on the unit sphere; by default a texel in the middle of a face.
    """

    form: str = "cast"
    level: int = 6
    normals: str = "auto"
    epsilon: float | None = None

    def __post_init__(self):
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise InputError(f"scale map {name}: expected one of {', '.join(choices)}, got {getattr(self, name)!r}")
        if not isinstance(self.level, int) or isinstance(self.level, bool) or not 0 <= self.level <= LARGEST_LEVEL:
            raise InputError(f"scale map level: expected a whole number from 0 to {LARGEST_LEVEL}, got {self.level!r}")
        if self.epsilon is not None and not (isinstance(self.epsilon, int | float) and 0 < self.epsilon < 1):
            raise InputError(f"scale map epsilon: expected a number between 0 and 1, got {self.epsilon!r}")
