"""Square patches spread over a sphere in rows of equal latitude, with a proof of their coverage."""

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

LEAST_PATCHES = 32  # fewer would have to reach so far around the sphere that their heights vary by half the radius


def latitude_rows(patches: int) -> tuple[NDArray, float]:
    """Spread square patches over the unit sphere.

    Patch k looks along ``frames[k, 2]``; the part of the sphere that falls upon its square |x|, |y| <= half_width,
    x and y measured along ``frames[k, 0]`` (east) and ``frames[k, 1]`` (north), is what it covers. Rows of equal
    latitude, one patch at each pole, have as many patches as make the squares smallest; each patch is given the
    quadrilateral of latitudes and longitudes around its centre, and `half_width` is the least that holds all of these.

    Parameters
    ----------
    patches : int
        At least 32.

    Returns
    -------
    frames : (patches, 3, 3) float64
        East, north and outward unit vectors of each patch; y is the north pole's axis, z has longitude 0.
    half_width : float
        In radii. Squares of this half width leave no point of the sphere uncovered: 6.55 / 128 for 1362 patches,
        where a perfect tiling of the sphere's area would need 6.15 / 128.

    Raises
    ------
    InputError
        Fewer than 32 patches.

    Notes
    -----
    The paper on spatial patches, section 4.3: "almost evenly distributed points ... utilizing spherical coordinates".
    """
    if isinstance(patches, bool) or not isinstance(patches, int | np.integer) or patches < LEAST_PATCHES:
        raise InputError(f"patches: expected a whole number of at least {LEAST_PATCHES} for a closed sphere, "
                         f"got {patches!r}")
    even = np.pi / np.sqrt(4 * np.pi / patches)  # rows where squares tile the area
    choices = [_row_counts(rows, int(patches)) for rows in range(max(3, int(0.8 * even)), int(1.3 * even) + 3)]
    half_width, counts = min((c for c in choices if c is not None), key=lambda c: c[0])
    colatitude = np.repeat(np.linspace(0, np.pi, len(counts)), counts)
    place = np.arange(patches) - np.repeat(np.cumsum(counts) - counts, counts)
    row = np.repeat(np.arange(len(counts)), counts)
    longitude = 2 * np.pi * (place + 0.5 * (row % 2)) / np.repeat(counts, counts)
    return tangent_frames(np.pi / 2 - colatitude, longitude), half_width


def tangent_frames(latitude, longitude) -> NDArray:
    """Return east, north and outward unit vectors (n, 3, 3) float64 at latitudes and longitudes (n,) in radians."""
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    east = np.stack([cos_lon, 0 * cos_lon, -sin_lon], axis=-1)
    north = np.stack([-sin_lat * sin_lon, cos_lat, -sin_lat * cos_lon], axis=-1)
    outward = np.stack([cos_lat * sin_lon, sin_lat, cos_lat * cos_lon], axis=-1)
    return np.stack([east, north, outward], axis=-2)


def _row_counts(rows: int, patches: int) -> tuple[float, NDArray] | None:
    """Return the half width and the patches in each of `rows` rows, or None where so many rows need more patches."""
    middle = np.linspace(0, np.pi, rows)
    reach = np.pi / (2 * (rows - 1))  # a patch is given the colatitudes middle -reach...+reach
    widest = np.sin(np.where(middle < np.pi / 2, np.minimum(middle + reach, np.pi / 2),
                             np.maximum(middle - reach, np.pi / 2)))[1:-1]
    counts = np.full(rows - 2, 3)
    if counts.sum() + 2 > patches:
        return None
    low, high = np.sin(reach), 1.0  # no half width below `low` covers the rows' own reach
    for _ in range(60):  # the least half width that the patches suffice for along the rows
        half_width = (low + high) / 2
        need = np.maximum(3, np.ceil(np.pi / np.arcsin(np.minimum(half_width / widest, 1.0))))
        low, high = (half_width, high) if need.sum() + 2 > patches else (low, half_width)
    counts = np.maximum(3, np.ceil(np.pi / np.arcsin(np.minimum(high / widest, 1.0)))).astype(int)
    for _ in range(patches - 2 - int(counts.sum())):
        counts[np.argmax(widest * np.sin(np.pi / counts))] += 1
    half = np.pi / counts
    along = widest * np.sin(np.minimum(half, np.pi / 2))
    edges = middle[1:-1] + np.array([[-reach], [reach]])
    across = [np.cos(edges) * np.sin(middle[1:-1]) - np.sin(edges) * np.cos(middle[1:-1]) * np.cos(turn)
              for turn in (0 * half, half)]  # north coordinate, monotone between the two longitudes
    return max(np.sin(reach), along.max(), np.abs(across).max()), np.concatenate([[1], counts, [1]])
