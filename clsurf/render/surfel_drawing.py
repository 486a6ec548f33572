"""How surfel hierarchies are drawn."""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError


@dataclass(frozen=True)
class SurfelDrawing:
    """How surfel hierarchies are drawn.

    Parameters
    ----------
    interior : float
        Pixels that surfels may be wide inside a surface's picture; near silhouettes the `lod` of the frame holds,
        which never exceeds this, and `lod` 0 draws the finest level only. A map of half as many texels along a side, or
        more, keeps features.
    maps : bool
        Normals come from the surfels' normal maps; False: every surfel has its one normal, as in QSplat.
    relief : float
        Pixels that a bumpy surfel seen at an angle may show its relief away from where it is; more of its relief calls
        for finer surfels, however small it is. Infinite: as in the paper, which looks at sizes only.
    """

    interior: float = 16.0
    maps: bool = True
    relief: float = 0.75

    def __post_init__(self):
        good = isinstance(self.interior, int | float | np.number) and not isinstance(self.interior, bool)
        if not good or not 0 <= self.interior < np.inf:
            raise InputError(f"surfels interior: expected a diameter in pixels of at least 0, got {self.interior!r}")
        good = isinstance(self.relief, int | float | np.number) and not isinstance(self.relief, bool)
        if not good or not self.relief >= 0:
            raise InputError(f"surfels relief: expected a distance in pixels of at least 0, got {self.relief!r}")
        if not isinstance(self.maps, bool):
            raise InputError(f"surfels maps: expected True or False, got {self.maps!r}")
