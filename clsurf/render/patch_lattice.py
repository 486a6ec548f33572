"""What the smooth modes of spatial patches need to know of the nodes; kernels/render/patch_heights.clh."""

import numpy as np
from numpy.typing import NDArray

from ..surface.patch import PatchSurface
from .normal_table import half_steps, node_differences

CELLS = ("bilinear", "smooth")  # the modes that subdivide cells into points (paper, section 3)


def node_twists(surface: PatchSurface) -> NDArray:
    """Return the mixed differences (N,) float32 of the displacements, steps per node and node.

    The slopes along x, differenced along y by the same rule as the slopes themselves.
    """
    return (node_differences(surface, half_steps(surface)[0], 1) / 4).astype(np.float32)
