"""The paper's perfect sphere: spatial patches that follow the formula of a sphere."""

import numpy as np

from ..errors import InputError
from ..surface.patch import PatchSurface
from .rows import latitude_rows

PATCHES, RADIUS, NODES = 1362, 128.0, 17  # the paper's: node spacing 1, displacement step 0.01
PAPER_STEP = 0.01  # the paper's displacement step, of the node spacing
_MOST = 127  # displacements -127...127
_LONGER = np.linspace(1.0, 1.08, 12)  # steps that are tried, of the least that 8 bits allow
_SHIFTS = np.arange(8) / 8  # places of the steps that are tried, of a step
_IN_CELL = (np.arange(4) + 0.5) / 4  # places in a cell that errors are taken at


def perfect_sphere(patches: int = PATCHES, radius: float = RADIUS, nodes: int = NODES,
                   color=(200, 200, 200), step: float | None = None) -> PatchSurface:
    """Return a sphere about the origin made of spatial patches, one byte a node.

    The defaults are the paper's model: nodes 1 unit apart, 1362 patches of 17 x 17 nodes, 448,098 bytes (437.6 KiB),
    but with displacements in steps of 0.0020 units instead of 0.01, the finest that let 8 bits reach over a patch.
    Cells, drawn bilinearly, dip between their nodes by up to 0.0020 units, so the nodes stand out of the sphere by as
    much as makes the mean square of the surface's error least: 0.0017 units at most, 0.0005 RMS (0.0059 and 0.0023 with
    the paper's step). Every point of the sphere is covered by a cell that lies at least 1.4 nodes inside its patch's
    border.

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
    step : float, optional
        Displacement step in node spacings, or more where 8 bits would not reach, with nodes rounded to the sphere;
        0.01 gives the paper's own. None: the step and the places that fit best.

    Returns
    -------
    PatchSurface
        All patches have the same nodes. The node spacing scales with the radius, and with the number of patches and
        nodes so that patches overlap as the paper's do, by 1.69 times the sphere's area.

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
    if step is not None and not (isinstance(step, int | float | np.number) and 0 < step < 1e30):
        raise InputError(f"step: expected a positive number of node spacings, got {step!r}")
    frames, half_width = latitude_rows(patches)
    half = (NODES - 1) / 2 / RADIUS * np.sqrt(PATCHES / patches)  # half a side, radii
    cells = nodes - 1
    half = max(half, half_width * cells / (cells - 1))  # half a cell to spare, which the paper's have anyway
    offset = (np.arange(nodes) - cells / 2) * (2 * half / cells)
    heights = np.sqrt(1 - offset[:, None] ** 2 - offset[None, :] ** 2)
    spacing = 2 * half / cells
    least = (heights.max() - heights.min()) / (2 * _MOST)
    if step is None:
        displacements, step, middle = _fitted(heights, offset, least)
    else:
        step, middle = max(step * spacing, least), (heights.min() + heights.max()) / 2
        displacements = np.rint((heights - middle) / step)
    corner = np.array([-half, -half, middle])
    bound = radius * _bound(middle + step * displacements, offset)
    return PatchSurface(origins=radius * np.einsum("a,pax->px", corner, frames),
                        axis_x=radius * spacing * frames[:, 0], axis_y=radius * spacing * frames[:, 1],
                        axis_z_length=np.full(patches, radius * step), size=(nodes, nodes),
                        displacements=np.tile(displacements.astype(np.int8).ravel(), patches), color=color,
                        diagonal=2 * np.sqrt(3) * radius, bound=bound, bound_all=bound)


def _fitted(heights, offset, least):
    """Return displacements (n, n), step and height of displacement 0 with the least mean square error found, radii.

    Steps and their places are tried; moving single nodes afterwards gained 1 % more.
    """
    raised = heights - _errors(heights, offset, _IN_CELL).mean()  # cells dip between nodes
    middle, found = (raised.min() + raised.max()) / 2, []
    one = slice((len(offset) - 1) // 2, None)  # of four equal quarters
    for step in least * _LONGER:
        for zero in middle + step * _SHIFTS:
            displacements = np.rint((raised[one, one] - zero) / step)
            if np.abs(displacements).max() <= _MOST:
                errors = _errors(zero + step * displacements, offset[one], _IN_CELL)
                found.append(((errors ** 2).mean(), step, zero))
    _, step, zero = min(found)
    return np.rint((raised - zero) / step), step, zero


def _errors(heights, offset, places):
    """Return how far bilinear cells through nodes (n, n) lie outside of the unit sphere, at `places` x `places`."""
    out = []
    for s in places:
        rows = heights[:-1] + s * (heights[1:] - heights[:-1])
        y = offset[:-1, None] + s * (offset[1:, None] - offset[:-1, None])
        for t in places:
            z = rows[:, :-1] + t * (rows[:, 1:] - rows[:, :-1])
            x = offset[:-1] + t * (offset[1:] - offset[:-1])
            out.append(np.sqrt(x * x + y * y + z * z) - 1)
    return np.array(out)


def _bound(heights, offset) -> float:
    """Return the largest distance of a patch from the unit sphere; that of a cell lies near a corner or a middle."""
    return 1.05 * float(np.abs(_errors(heights, offset, (0.0, 0.5, 1.0))).max())
