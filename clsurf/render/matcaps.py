"""Matcaps that are built in: pictures of lit spheres, made here from a few lamps each."""

import numpy as np
from numpy.typing import NDArray

from ..surface.srgb import to_linear

SIZE = 256  # pixels across


def lit_sphere(base, lamps, ambient: float, rim=(0.0, 0.0, 0.0), wrap: float = 0.0) -> NDArray:
    """Return the linear picture (SIZE, SIZE, 3) of a sphere.

    Parameters
    ----------
    base : (3,) float
        sRGB.
    lamps : list of (direction, color, shininess, gloss)
        Directions in view space; `gloss` is added, `color` multiplies the base.
    ambient : float
    rim : (3,) float
        Linear light that comes in at the outline.
    wrap : float
        How far light reaches past the terminator, 0 to 1: skin and wax.
    """
    at = (2 * (np.arange(SIZE) + 0.5) / SIZE - 1)
    x, y = np.meshgrid(at, -at)
    radius = np.maximum(np.hypot(x, y), 1e-9)
    inside = np.minimum(radius, 0.999) / radius  # past the outline the rim goes on
    n = np.stack([x * inside, y * inside, np.sqrt(1 - (radius * inside) ** 2)], axis=-1)
    light, shine = np.full(n.shape, ambient), np.zeros_like(n)
    for direction, color, power, gloss in lamps:
        to = np.array(direction) / np.linalg.norm(direction)
        light = light + np.clip((n @ to + wrap) / (1 + wrap), 0, None)[..., None] * np.array(color)
        half = to + np.array([0, 0, 1])
        shine = shine + gloss * np.clip(n @ half / np.linalg.norm(half), 0, None)[..., None] ** power * np.array(color)
    edge = (1 - n[..., 2:]) ** 3
    return light * to_linear(base) + shine + edge * np.array(rim)


def clay() -> NDArray:
    """Return warm matte clay, lit from the upper left."""
    return lit_sphere((0.80, 0.62, 0.52), [((-0.6, 0.9, 0.9), (0.95, 0.92, 0.86), 12, 0.06),
                                           ((0.9, 0.1, 0.5), (0.20, 0.24, 0.32), 8, 0.02)], 0.10, (0.05, 0.045, 0.05))


def pearl() -> NDArray:
    """Return pale, softly shining white."""
    return lit_sphere((0.90, 0.89, 0.88), [((-0.5, 0.9, 1.0), (0.72, 0.70, 0.68), 60, 0.35),
                                           ((0.8, 0.3, 0.6), (0.18, 0.21, 0.27), 20, 0.2)], 0.16, (0.16, 0.14, 0.19),
                      0.3)


def jade() -> NDArray:
    """Return green stone into which light sinks."""
    return lit_sphere((0.36, 0.66, 0.48), [((-0.5, 0.8, 0.9), (0.85, 0.9, 0.8), 90, 0.45),
                                           ((0.7, -0.5, 0.4), (0.25, 0.30, 0.24), 20, 0.05)], 0.16, (0.02, 0.10, 0.06),
                      0.5)


def bronze() -> NDArray:
    """Return dark polished bronze."""
    return lit_sphere((0.55, 0.36, 0.20), [((-0.6, 0.8, 0.8), (1.0, 0.82, 0.6), 28, 0.55),
                                           ((0.8, 0.4, 0.3), (0.35, 0.30, 0.28), 14, 0.3)], 0.04, (0.20, 0.13, 0.07))


def chrome() -> NDArray:
    """Return polished metal between a bright sky and a dark ground."""
    at = (2 * (np.arange(SIZE) + 0.5) / SIZE - 1)
    x, y = np.meshgrid(at, -at)
    r2 = np.minimum(x * x + y * y, 0.998)
    up = 2 * np.sqrt(1 - r2) * y  # of the mirrored direction
    sky = np.array([0.45, 0.55, 0.72]) + np.array([0.5, 0.45, 0.35]) * np.exp(-4 * np.clip(up, 0, 1))[..., None]
    ground = np.array([0.12, 0.10, 0.09]) * (1 + 1.5 * np.exp(3 * np.clip(up, -1, 0)))[..., None]
    part = np.clip(up / 0.06 + 0.5, 0, 1)[..., None]
    return ground + (sky - ground) * part * part * (3 - 2 * part)


MATCAPS = {"clay": clay, "pearl": pearl, "jade": jade, "bronze": bronze, "chrome": chrome}
