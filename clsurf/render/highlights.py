"""The table of what microfacets of any roughness send to the eye of light that comes from all sides."""

import functools

import numpy as np
from numpy.typing import NDArray

CELLS = 32  # in the root of the cosine of the eye's angle, and in roughness; bilinear between: 0.002 off at most
LEAST_COSINE, LEAST_ROUGHNESS = 1e-3, 0.045  # kernels/render/materials.clh


@functools.cache
def highlight_table() -> NDArray:
    """Return the table ((CELLS + 1)^2, 4) float32: what F0 multiplies and what is added to that product, 0, 0.

    Rows are roughness from 0 to 1, columns the root of the cosine. GGX, height-correlated Smith, Schlick (glTF 2.0,
    appendix B.3), by the split of Karis 2013.
    """
    cosine = np.maximum((np.arange(CELLS + 1) / CELLS) ** 2, LEAST_COSINE)
    rough = np.maximum(np.arange(CELLS + 1) / CELLS, LEAST_ROUGHNESS)
    out = np.zeros((CELLS + 1, CELLS + 1, 4), np.float32)
    for row, r in enumerate(rough):
        out[row, :, :2] = highlight_parts(cosine, r)
    return out.reshape(-1, 4)


def highlight_parts(cosine: NDArray, roughness: float, steps: int = 64) -> NDArray:
    """Return both parts (n, 2) for the `cosine` (n,) of the eye's angle: quadrature over half vectors by GGX's own
    density, `steps` x `steps` midpoints.
    """
    a2 = roughness**4
    t = (np.arange(steps) + 0.5) / steps
    angle, part = np.meshgrid(np.pi * t, t)  # half of the circle: the other one mirrors it
    # More points where the density's tail is: grazing light comes from there.
    weight, part = 2 * (1 - part), 1 - (1 - part) ** 2
    up = np.sqrt((1 - part) / (1 + (a2 - 1) * part))
    flat = np.sqrt(1 - up**2)
    c = np.asarray(cosine, np.float64)[:, None, None]
    eh = np.sqrt(1 - c**2) * flat * np.cos(angle) + c * up
    light = 2 * eh * up - c
    good = (light > 0) & (eh > 0)
    light, eh = np.where(good, light, 1), np.where(good, eh, 1)
    smith = 2 * light / (light * np.sqrt(a2 + (1 - a2) * c**2) + c * np.sqrt(a2 + (1 - a2) * light**2))
    sends = np.where(good, smith * eh / up * weight, 0)
    fresnel = (1 - np.clip(eh, 0, 1)) ** 5
    return np.stack([(sends * (1 - fresnel)).mean(axis=(1, 2)), (sends * fresnel).mean(axis=(1, 2))], axis=-1)
