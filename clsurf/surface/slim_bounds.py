"""Surfels in their own balls: coefficients for lengths in radii, and bounds of the height polynomial there."""

import numpy as np
from numpy.typing import NDArray


def height_bounds(degree: int, k: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return lower and upper bounds of the height polynomial and of its slope over the unit disc.

    Parameters
    ----------
    k : (n, 1 | 6 | 10)
        Coefficients for lengths in units of the radius.

    Returns
    -------
    low, high, slope : (n,)
        `low` and `high` are clipped to the ball, [-1, 1].
    """
    k = k.astype(np.float64)
    low, high, slope = k[:, 0].copy(), k[:, 0].copy(), np.zeros(len(k))
    if degree >= 2:
        linear = np.hypot(k[:, 1], k[:, 2])
        mean, spread = (k[:, 3] + k[:, 5]) / 2, np.hypot((k[:, 3] - k[:, 5]) / 2, k[:, 4] / 2)
        low += np.minimum(mean - spread, 0) - linear
        high += np.maximum(mean + spread, 0) + linear
        slope += linear + 2 * np.maximum(np.abs(mean - spread), np.abs(mean + spread))
    if degree >= 3:
        # |u^3| <= 1, |u^2 v| <= 2 / sqrt(27) on the unit circle; the gradient of a cubic form is at most 3 times it.
        cubic = np.maximum(np.abs(k[:, 6]), np.abs(k[:, 9])) + (np.abs(k[:, 7]) + np.abs(k[:, 8])) * 0.3850
        low, high, slope = low - cubic, high + cubic, slope + 3 * (np.abs(k[:, 6]) + np.abs(k[:, 9]) + np.abs(k[:, 7])
                                                                 + np.abs(k[:, 8]))
    return np.clip(low, -1, 2), np.clip(high, -2, 1), slope


def scaled_coefficients(degree: int, coefficients: NDArray, radii: NDArray) -> NDArray:
    """Return the coefficients (n, 1 | 6 | 10) for lengths in units of `radii`, the one of u v halved."""
    order = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3][:coefficients.shape[1]])
    k = coefficients.astype(np.float64) * radii.astype(np.float64)[:, None] ** (order - 1)
    if degree >= 2:
        k[:, 4] /= 2
    return k
