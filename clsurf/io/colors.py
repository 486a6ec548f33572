"""Colours of any file as 8-bit sRGB with straight alpha."""

import numpy as np
from numpy.typing import NDArray


def as_rgba8(values) -> NDArray:
    """Convert (n, 3 or 4) sRGB colours of any scale to (n, 4) uint8; alpha is opaque where there is none.

    uint8 stays. Other integers are 16-bit colours if any exceeds 255 (LAS files and PLY files both hold 8-bit values in
    16-bit fields as well). Floats are shares of one if none exceeds 1, otherwise 0 to 255.
    """
    values = np.asarray(values)
    rgba = np.full((len(values), 4), 255, np.uint8)
    if not values.size:
        return rgba
    if values.dtype != np.uint8:
        if values.dtype.kind == "f":
            values = np.nan_to_num(values.astype(np.float32), posinf=0, neginf=0)
            if values.max() <= 1:
                values = values * 255
            elif values.max() > 255:
                values = values / 257
            values = np.floor(values + 0.5)
        elif values.max() > 255:
            values = values >> 8
        values = np.clip(values, 0, 255).astype(np.uint8)
    rgba[:, :values.shape[1]] = values
    return rgba
