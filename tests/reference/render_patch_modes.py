"""Plain float64 twins of the patch renderer's further modes and of supersampling: slow, obvious, the specification."""

import numpy as np


def average(channels, factor):
    """The channels (by name) of a picture from those of one `factor` times as large each way."""
    def blocks(a):
        h, w = a.shape[0] // factor, a.shape[1] // factor
        return a.reshape(h, factor, w, factor, *a.shape[2:]).swapaxes(1, 2).reshape(h, w, factor ** 2, *a.shape[2:])
    low = (factor - 1) // 2
    middle = [low * factor + low] if factor % 2 else [j * factor + i for j in (low, low + 1) for i in (low, low + 1)]
    depth = np.where(np.isnan(blocks(channels["depth"])), np.inf, blocks(channels["depth"]))[..., middle]
    best = np.array(middle)[depth.argmin(axis=-1)]
    out = {}
    for name, array in channels.items():
        samples = blocks(array)
        if name == "color":
            out[name] = samples.astype(np.float64).mean(axis=2)
        else:
            index = best.reshape(*best.shape, 1, *(1,) * (samples.ndim - 3))
            out[name] = np.take_along_axis(samples, index, axis=2)[:, :, 0]
    return out
