"""The smallest ball that holds points."""

import itertools

import numpy as np
from numpy.typing import NDArray

from ..surface.arrays import box_of, lengths_of, squared_lengths

ROUNDS = 200  # the support changes about 10 times


def bounding_sphere(points: NDArray) -> tuple[NDArray, float]:
    """Return centre (3,) and radius, float64, of the smallest ball around points (n, 3), n at least 1.

    The farthest point joins the at most four that carry the ball, and the smallest ball of these five takes its place,
    until nothing sticks out by more than 1e-12 of the radius; every round the ball grows.
    """
    points = np.asarray(points, np.float64)
    middle = sum(box_of(points)) / 2
    points = points - middle
    support = points[:1]
    center, radius = support[0], 0.0
    for _ in range(ROUNDS):
        gap = squared_lengths(points - center)
        far = int(gap.argmax())
        if gap[far] <= (radius * (1 + 1e-12)) ** 2:
            break
        center, radius, support = _of_few(np.concatenate([support, points[far:far + 1]]))
    gap = squared_lengths(points - center).max()
    return center + middle, float(np.sqrt(gap))


def _of_few(points: NDArray) -> tuple[NDArray, float, NDArray]:
    """Return centre, radius and carrying points of the smallest ball around at most five points."""
    best = None
    for count in range(1, min(len(points), 4) + 1):
        for chosen in itertools.combinations(range(len(points)), count):
            own = points[list(chosen)]
            edges = own[1:] - own[0]
            # The centre is equally far from all and lies in their span.
            weights = np.linalg.lstsq(2 * edges @ edges.T, (edges**2).sum(axis=1), rcond=None)[0]
            center = own[0] + weights @ edges
            radius = float(lengths_of(own - center).max())
            if (lengths_of(points - center) <= radius * (1 + 1e-10)).all() and \
                    (best is None or radius < best[1]):
                best = center, radius, own
    return best
