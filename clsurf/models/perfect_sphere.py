"""The paper's perfect sphere: spatial patches that follow the formula of a sphere."""

import numpy as np

from ..errors import InputError
from ..surface.patch import PatchSurface
from .rows import latitude_rows

PATCHES, RADIUS, NODES = 1362, 128.0, 17  # the paper's: node spacing 1, displacement step 0.01
_STEP = 0.01  # of the node spacing
_MOST = 127  # displacements -127...127


def perfect_sphere(patches: int = PATCHES, radius: float = RADIUS, nodes: int = NODES,
                   color=(200, 200, 200)) -> PatchSurface:
    """Return a sphere about the origin made of spatial patches, one byte a node.

    The defaults are the paper's model: nodes 1 unit apart, displacements in steps of 0.01, 1362 patches of 17 x 17
    nodes, 448,098 bytes (437.6 KiB). Nodes lie within half a displacement step of the sphere, there 0.005 units; the
    cells between them, drawn bilinearly, dip below it by at most 0.0020 units more. Every point of the sphere is
    covered by a cell that lies at least 1.4 nodes inside its patch's border.

    Parameters
    ----------
    patches : int
        At least 32.
    radius : float
        World units.
    nodes : int
        Nodes of a patch along each side, 5 to 256.
    color : (3,) uint8
        sRGB of all nodes.

    Returns
    -------
    PatchSurface
        All patches have the same nodes. The node spacing scales with the radius, and with the number of patches and
        nodes so that patches overlap as the paper's do, by 1.69 times the sphere's area; the displacement step is
        0.01 spacings, or more where 8 bits would not reach.

    Raises
    ------
    InputError
        A number out of range.

    Notes
    -----
    The paper on spatial patches, section 4.3.
    """
    if not isinstance(radius, int | float | np.number) or not 0 < radius < 1e30:
        raise InputError(f"radius: expected a positive length, got {radius!r}")
    if not isinstance(nodes, int | np.integer) or not 5 <= nodes <= 256:
        raise InputError(f"nodes: expected a whole number from 5 to 256, got {nodes!r}")
    frames, half_width = latitude_rows(patches)
    half = (NODES - 1) / 2 / RADIUS * np.sqrt(PATCHES / patches)  # half a side, radii
    cells = nodes - 1
    half = max(half, half_width * cells / (cells - 1))  # half a cell to spare, which the paper's have anyway
    offset = (np.arange(nodes) - cells / 2) * (2 * half / cells)
    heights = np.sqrt(1 - offset[:, None] ** 2 - offset[None, :] ** 2)
    low, high = heights.min(), heights.max()
    spacing = 2 * half / cells
    step = max(_STEP * spacing, (high - low) / (2 * _MOST))
    middle = (low + high) / 2
    displacements = np.rint((heights - middle) / step).astype(np.int8)
    corner = np.array([-half, -half, middle])
    return PatchSurface(origins=radius * np.einsum("a,pax->px", corner, frames),
                        axis_x=radius * spacing * frames[:, 0], axis_y=radius * spacing * frames[:, 1],
                        axis_z_length=np.full(patches, radius * step), size=(nodes, nodes),
                        displacements=np.tile(displacements.ravel(), patches), color=color,
                        diagonal=2 * np.sqrt(3) * radius, bound=radius * _bound(heights, middle, step, spacing))


def _bound(heights, middle, step, spacing) -> float:
    """Return the largest distance of the patches from the unit sphere: half a step and the dip between nodes."""
    steepest = 1 / heights.min()  # 1 / cosine between the patch's plane and the sphere
    return step / 2 + spacing ** 2 / 4 * steepest
