"""Tone mapping: linear light of any brightness to what a picture of 8 or 16 bits holds, 0 to 1."""

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import InputError
from clsurf.surface.srgb import to_linear

TONES = ("none", "reinhard", "aces", "agx")
WHITE = 4.0  # light that Reinhard's curve takes to 1

# AgX (Sobotka 2022): linear sRGB to its own primaries and back; the curve over log2 light is Wrensch's fit, degree 6.
AGX_IN = np.array([[0.842479062253094, 0.0784335999999992, 0.0792237451477643],
                   [0.0423282422610123, 0.878468636469772, 0.0791661274605434],
                   [0.0423756549057051, 0.0784336, 0.879142973793104]])
AGX_STOPS = (-12.47393, 4.026069)
AGX_CURVE = (15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232)
# ACES (Hill's fit of the reference and output transforms): linear sRGB to its primaries and back.
ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])


def checked_tone(tone: str, exposure: float) -> None:
    """Raise InputError unless a tone curve of that name and a finite exposure are given."""
    if tone not in TONES:
        raise InputError(f"tone: expected one of {', '.join(TONES)}, got {tone!r}")
    if not isinstance(exposure, int | float | np.number) or isinstance(exposure, bool) or not abs(exposure) <= 64:
        raise InputError(f"exposure: expected stops, a number from -64 to 64, got {exposure!r}")


def tone_mapped(rgb: NDArray, tone: str = "none", exposure: float = 0.0) -> NDArray:
    """Return linear light (..., 3) after an exposure and a tone curve.

    Parameters
    ----------
    rgb : (..., 3) float
        Linear light, not premultiplied.
    tone : str
        "none": only clipped later; "reinhard": extended, by luminance, white at 4; "aces": the film curve of ACES
        (Hill's fit); "agx": AgX, whose bright colours turn pale instead of garish.
    exposure : float
        Stops: each doubles the light.

    Raises
    ------
    InputError
        Another name, or an exposure that is no number.
    """
    checked_tone(tone, exposure)
    if exposure:
        rgb = rgb * np.float32(2.0**exposure)
    if tone == "none":
        return rgb
    rgb = np.maximum(np.nan_to_num(rgb), 0)
    if tone == "reinhard":
        luminance = rgb @ np.array([0.2126, 0.7152, 0.0722], rgb.dtype)
        scale = (1 + luminance / WHITE**2) / (1 + luminance)
        return rgb * scale[..., None]
    if tone == "aces":
        v = rgb @ ACES_IN.T.astype(rgb.dtype)
        v = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
        return np.clip(v @ ACES_OUT.T.astype(rgb.dtype), 0, 1)
    low, high = AGX_STOPS
    v = np.log2(np.maximum(rgb @ AGX_IN.T.astype(rgb.dtype), 2.0**low))
    v = np.polyval(AGX_CURVE, np.clip((v - low) / (high - low), 0, 1))
    return to_linear(np.clip(v @ np.linalg.inv(AGX_IN).T, 0, 1)).astype(rgb.dtype)
