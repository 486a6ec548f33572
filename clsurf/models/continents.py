"""A planet made up by noise: heights above and below the sea, and colours of land and sea by height and climate."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from .sphere_map import SphereMap

_TABLE = 48  # lattice cells after which the noise repeats; the sphere's largest octave needs no more
# sRGB in 0...1, at heights relative to the highest land: deep sea to shore, and land by climate.
_SEA = np.array([[-1.0, 0.020, 0.045, 0.150], [-0.35, 0.030, 0.080, 0.230], [-0.08, 0.060, 0.200, 0.400],
                 [0.0, 0.130, 0.340, 0.500]])
_WET = np.array([[0.0, 0.150, 0.270, 0.090], [0.25, 0.140, 0.240, 0.075], [0.55, 0.330, 0.290, 0.170],
                 [0.85, 0.450, 0.380, 0.280], [1.0, 0.620, 0.570, 0.500]])
_DRY = np.array([[0.0, 0.700, 0.590, 0.400], [0.25, 0.760, 0.620, 0.400], [0.55, 0.560, 0.410, 0.260],
                 [0.85, 0.500, 0.400, 0.300], [1.0, 0.640, 0.590, 0.530]])
_SNOW = np.array([0.94, 0.96, 0.98])


def noise(points: NDArray, frequency: float, octaves: int, seed: int, ridged: bool = False,
          fall: float = 0.5) -> NDArray:
    """Return fractal noise (n,) float64 of about -1...1 at `points` (n, 3) float32; `ridged`: sharp crests at 1.

    Values on a lattice, smoothstep between them; every octave has twice the frequency and `fall` times the
    height. The same on every machine for a seed.
    """
    rng = np.random.default_rng(seed)
    total, height, sum_of = np.zeros(len(points)), 1.0, 0.0
    for _ in range(octaves):
        table = rng.uniform(-1, 1, (_TABLE, _TABLE, _TABLE)).astype(np.float32)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]  # lattices of the octaves do not line up
        at = (points @ (frequency * turn.T).astype(np.float32) + rng.uniform(0, _TABLE, 3).astype(np.float32)).T
        whole = np.floor(at)
        part = at - whole
        value = map_coordinates(table, whole + part * part * (3 - 2 * part), order=1, mode="grid-wrap")
        total += height * (1 - 2 * np.abs(value) if ridged else value)
        sum_of, frequency, height = sum_of + height, frequency * 2, height * fall
    return total / sum_of * (1.0 if ridged else 1.6)


def continents(pixels: int, seed: int = 7) -> SphereMap:
    """Return heights of a made-up planet, `pixels` rows: 1 the highest land, negative under water (about -1).

    About a third is land.
    """
    empty = SphereMap(np.zeros((pixels, 2 * pixels, 1), np.float32))
    at = empty.directions().reshape(-1, 3).astype(np.float32)
    octaves = int(np.clip(np.log2(pixels / 6), 2, 6))
    bent = at + 0.16 * np.stack([noise(at, 2.3, 3, seed + 10 + k, fall=0.6) for k in range(3)], axis=1)
    land = noise(bent, 1.35, octaves, seed, fall=0.55)
    sea_level = np.sort(land[::7])[int(0.66 * len(land[::7]))]
    land = (land - sea_level) / np.abs(land - sea_level).max()
    crests = noise(bent, 2.6, octaves, seed + 20, ridged=True)
    belts = np.clip(noise(bent, 1.9, 2, seed + 30) * 1.6 + 0.45, 0, 1)  # mountains stand in some places only
    inland = np.clip(land / 0.2, 0, 1)
    high = 0.08 * inland + 0.22 * np.clip(land, 0, 1) + inland * belts * np.clip(crests * 1.3, 0, 1) ** 1.8
    heights = np.where(land > 0, high, land)
    heights[land > 0] /= max(high.max(), 1e-9)
    return SphereMap(heights.reshape(pixels, 2 * pixels, 1).astype(np.float32))


def tinted(heights: SphereMap, seed: int = 7) -> SphereMap:
    """Return colours (h, w, 3) sRGB in 0...1 for heights relative to the highest land; the sea is below 0.

    Green lowlands, deserts around the tropics, brown mountains, snow on peaks and around the poles.
    """
    at, h = heights.directions().reshape(-1, 3).astype(np.float32), heights.values.reshape(-1).astype(np.float64)
    octaves = int(np.clip(np.log2(len(heights.values) / 16), 2, 5))
    rough = noise(at, 5.0, octaves, seed + 40)
    latitude = np.degrees(np.arcsin(np.clip(at[:, 1], -1, 1)))
    dry = np.exp(-((np.abs(latitude) - 24) / 10) ** 2) + 0.8 * noise(at, 1.7, 4, seed + 41) + 0.15 * rough
    dry = np.clip(1.5 * dry - 0.45, 0, 1)[:, None]
    up = np.clip(h + 0.06 * rough, 0, 1)
    land = dry * _ramp(_DRY, up) + (1 - dry) * _ramp(_WET, up)
    land *= (1 + 0.25 * rough)[:, None]
    cold = np.abs(latitude) / 90
    snow = np.clip((h * 1.25 + cold ** 2.2 * 1.9 + 0.12 * rough - 1.28) * 6, 0, 1)[:, None]
    frozen = np.clip((cold * 90 + 5 * rough - 76) / 2, 0, 1)[:, None]  # the sea's ice
    color = np.where(h[:, None] > 0, land + snow * (_SNOW - land), 0)
    sea = _ramp(_SEA, np.minimum(h, 0))
    color = np.where(h[:, None] > 0, color, sea + frozen * (_SNOW - sea))
    return SphereMap(np.clip(color, 0.01, 1).reshape(*heights.values.shape[:2], 3).astype(np.float32))


def _ramp(stops: NDArray, at: NDArray) -> NDArray:
    return np.stack([np.interp(at, stops[:, 0], stops[:, c]) for c in (1, 2, 3)], axis=1)
