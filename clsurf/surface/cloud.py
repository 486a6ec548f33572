"""Point clouds as plain data."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .arrays import bounds_of, frozen, recentred
from .placed import Placed, placed


@dataclass(frozen=True, eq=False, repr=False)
class PointCloud:
    """Scattered points; positions are float32 relative to a float64 `origin`.

    Parameters
    ----------
    points : (n, 3) array_like
        Positions. float64 input without `origin` is re-origined to the centre of its box.
    normals : (n, 3) float32, optional
        Unit normals; builders estimate them where they are missing.
    colors : (n, 4) uint8, optional
        sRGB with straight alpha.
    scanners : (n, 3) float32, optional
        Position of the sensor that saw each point, relative to `origin`; orients the estimated normals.
    origin : (3,) float64, optional
        World position of the points' zero.
    attributes : dict of str to array, optional
        Further per-point arrays (intensity, class), carried along.

    Raises
    ------
    ValueError
        An array of the wrong shape.
    """

    points: NDArray  # (n, 3) float32, relative to origin
    normals: NDArray | None = None  # (n, 3) float32, unit
    colors: NDArray | None = None  # (n, 4) uint8 sRGB, straight alpha
    scanners: NDArray | None = None  # (n, 3) float32, relative to origin
    origin: NDArray | None = None  # (3,) float64, world
    attributes: dict[str, NDArray] = field(default_factory=dict)

    def __post_init__(self):
        points, origin = recentred(self.points, self.origin)
        put = lambda name, *rest: object.__setattr__(self, name, frozen(name, *rest))  # noqa: E731
        put("points", points, ("n", 3), np.float32)
        put("origin", origin, (3,), np.float64)
        count = len(points)
        if self.normals is not None:
            put("normals", self.normals, (count, 3), np.float32)
        if self.colors is not None:
            put("colors", self.colors, (count, 4), np.uint8)
        if self.scanners is not None:
            put("scanners", self.scanners, (count, 3), np.float32)
        for name, value in self.attributes.items():
            if len(value) != count:
                raise ValueError(f"attributes[{name!r}]: expected {count} values, got {len(value)}")

    @property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64, world space; NaN where there is no point."""
        return bounds_of(self.points, self.origin)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        arrays = (self.points, self.normals, self.colors, self.scanners, *self.attributes.values())
        return sum(a.nbytes for a in arrays if a is not None)

    def moved(self, matrix) -> Placed:
        """Return this cloud placed by the similarity `matrix` (4, 4), the arrays shared."""
        return placed(self, matrix)

    def __repr__(self):
        low, high = self.bounds
        kept = [name for name in ("normals", "colors", "scanners") if getattr(self, name) is not None]
        return (f"PointCloud({len(self.points):,} points{', ' + ', '.join(kept) if kept else ''}, "
                f"{self.nbytes:,} bytes, bounds {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()})")
