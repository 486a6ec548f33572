"""How many patches a scan is worth: odd requests end soon, with patches or with one line of what to ask for."""

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface.arrays import squared_lengths

NODES_A_FACE = 256  # at most; a mesh's own resolution is about 6
NODES_A_POINT = 64  # at most; the default is about 2
LEAST_NODES = 1 << 24  # that small scans may have as well: two triangles may carry a picture
LEAST_PATCHES = 1 << 16  # the same
POINTS_A_PATCH = 2  # at least
FILLED = 0.6  # of a patch, by the area that it stands for
PIECES = 16  # of a patch of the finest: faces that long edges may be cut into


def most_of_mesh(faces: int, nodes: tuple[int, int]) -> int:
    """Return how many patches of `nodes` a mesh may become."""
    most = max(NODES_A_FACE * faces, LEAST_NODES) // (nodes[0] * nodes[1])
    return max(min(most, max(faces, LEAST_PATCHES)), 1)


def most_of_cloud(points: int, nodes: tuple[int, int]) -> int:
    """Return how many patches of `nodes` a cloud may become."""
    most = max(NODES_A_POINT * points, LEAST_NODES) // (nodes[0] * nodes[1])
    return max(min(most, points // POINTS_A_PATCH), 1)


def widest_spacing(diagonal: float, finest: float, nodes: tuple[int, int]) -> float:
    """Return the spacing at which one patch spans a cloud and the margin around its points."""
    return 1.1 * (diagonal + 2 * finest) / (min(nodes) - 1)


def check_patches(patches: int, most: int, scan: str) -> None:
    """Raise InputError for more than `most` patches."""
    if patches > most:
        raise InputError(f"patches: expected at most {most:,} for {scan}, got {patches:,}: ask for fewer")


def check_spacing(spacing: float, least: float, scan: str) -> None:
    """Raise InputError for a spacing below `least`."""
    if spacing < least:
        raise InputError(f"spacing: expected at least {least:.3g} for {scan}, got {spacing:g}: use a larger one")


def least_width(vertices: NDArray, faces: NDArray, most: int) -> float:
    """Return the width, world units, of patches of which a mesh needs about `most`."""
    v = vertices.astype(np.float64)
    ends = [v[faces[:, k]] for k in range(3)]
    cross = np.cross(ends[1] - ends[0], ends[2] - ends[0])
    area = np.sqrt(np.einsum("ij,ij->i", cross, cross)).sum() / 2
    longest = np.sqrt(np.max([squared_lengths(ends[k] - ends[k - 1]) for k in range(3)], axis=0))
    # Needles have length without area.
    return max(float(np.sqrt(area / (FILLED * most))), float(longest.sum()) / (PIECES * most))
