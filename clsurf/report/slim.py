"""What a view of a SLIM surface consists of."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..render.frame import Frame
from ..render.tiles import BIN
from ..surface.placed import Placed
from ..surface.slim import FLOATS, SlimSurface


@dataclass(frozen=True, eq=False)
class SlimStatistics:
    """Counts of a `SlimSurface` and of one frame of it."""

    size: tuple[int, int]  # width, height of the picture, pixels
    nbytes: int
    surfels: int
    leaves: int
    links: int
    floats: int  # numbers that the leaves store (paper on SLIM, section 4)
    leaves_by_level: NDArray  # (levels,) int: level 1 first
    internal_by_level: NDArray  # (levels,) int
    covered: int  # pixels that show the surface
    pixels_by_level: NDArray  # (levels,) int: covered pixels by the level of the surfel in front
    blended: NDArray  # (covered,) int: surfels blended at each covered pixel
    cost: NDArray  # (covered,) float: evaluations of surfels per pixel, the mean of the pixel's bin of 8 x 8


def slim_statistics(surface: SlimSurface | Placed, frame: Frame, number: int = 0) -> SlimStatistics:
    """Count what `surface` consists of and what a frame of it took.

    Parameters
    ----------
    surface : SlimSurface or Placed
    frame : Frame
        With the channels "id", "level", "count" and "cost".
    number : int
        The surface's place in the scene, the channel "id".

    Returns
    -------
    SlimStatistics
    """
    own = surface.surface if isinstance(surface, Placed) else surface
    levels = int(own.level.max(initial=0))
    count = lambda values: np.bincount(values, minlength=levels + 1)[1:levels + 1]  # noqa: E731
    shown = frame.id == number
    leaves = int(own.leaf.sum())
    return SlimStatistics(
        size=frame.size, nbytes=own.nbytes, surfels=len(own), leaves=leaves, links=len(own.children),
        floats=FLOATS[own.degree] * leaves, leaves_by_level=count(own.level[own.leaf]),
        internal_by_level=count(own.level[~own.leaf]), covered=int(shown.sum()),
        pixels_by_level=count(np.maximum(frame.level[shown], 0)), blended=frame.count[shown].astype(np.int64),
        cost=frame.cost[shown] / BIN ** 2)
