"""How point clouds are drawn."""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError


@dataclass(frozen=True)
class PointDrawing:
    """How point clouds and the points of range images are drawn.

    Points are discs, across their normals and seen in perspective, or, without normals, across the view.

    Parameters
    ----------
    size : float, optional
        Diameter of the discs; None: by the points' local spacing, so that they close the gaps between them.
    unit : str
        What `size` is in: "world" units or "pixels".
    eye_dome : bool, optional
        Eye-dome lighting in place of lights: points darker the nearer their neighbours in the picture are, which shows
        shape without normals. None: for clouds without normals. With the look "phong" only.
    strength : float
        Of eye-dome lighting; 1 is usual.
    reach : float
        How far eye-dome lighting looks around, pixels, up to 16.
    attribute : str, optional
        Colour the points by this attribute of the cloud (``cloud.attributes``), from blue over green to red, between
        its 1st and 99th percentile.
    """

    size: float | None = None
    unit: str = "world"
    eye_dome: bool | None = None
    strength: float = 1.0
    reach: float = 1.4
    attribute: str | None = None

    def __post_init__(self):
        if self.unit not in ("world", "pixels"):
            raise InputError(f"points unit: expected world or pixels, got {self.unit!r}")
        if self.eye_dome not in (None, True, False):
            raise InputError(f"points eye_dome: expected True, False or None, got {self.eye_dome!r}")
        limits = {"size": (0, np.inf), "strength": (-1e-300, 1000), "reach": (0, 16)}
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if name == "size" and value is None:
                continue
            if not isinstance(value, int | float | np.number) or isinstance(value, bool) or not low < value <= high \
                    or not np.isfinite(value):
                raise InputError(f"points {name}: expected a number over {max(low, 0):g}"
                                 f"{'' if high == np.inf else f', at most {high:g}'}, got {value!r}")
        if self.attribute is not None and not isinstance(self.attribute, str):
            raise InputError("points attribute: expected the name of an attribute of the cloud, got "
                             f"{self.attribute!r}")
