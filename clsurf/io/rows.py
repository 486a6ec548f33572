"""Rows of numbers as text, as several formats have them."""

import warnings

import numpy as np
from numpy.typing import NDArray

BLOCK = 65536  # rows formatted at once


def world_of(scan) -> NDArray:
    """Return a scan's positions in world space: float64 where it has an origin, otherwise its float32."""
    return scan.points + scan.origin if scan.origin.any() else scan.points


def digits_of(scan) -> str:
    """Return a number format that keeps the positions of `world_of`."""
    return "%.15g" if scan.origin.any() else "%.9g"


def write_rows(file, parts, prefix: str = "", separator: str = " ") -> None:
    """Write a line for each row of `parts`, pairs of an (n, k) array and a number format such as "%d".

    One format string for a block of rows is five times as fast as np.savetxt.
    """
    line = prefix + separator.join(separator.join([form] * array.shape[1]) for array, form in parts) + "\n"
    for at in range(0, len(parts[0][0]), BLOCK):
        rows = np.concatenate([np.asarray(array[at:at + BLOCK], np.float64) for array, _ in parts], axis=1)
        file.write((line * len(rows)) % tuple(rows.ravel().tolist()))


def numbers_in(text: bytes) -> NDArray:
    """Return all numbers in white space as float64; ten times as fast as splitting the text.

    Raises
    ------
    ValueError
        Anything that is not a number.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # how NumPy tells of text that is no number
        try:
            return np.fromstring(text.decode("latin-1"), np.float64, sep=" ")
        except DeprecationWarning:
            raise ValueError("expected numbers, got other text") from None
