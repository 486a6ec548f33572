"""Maps of a sphere in the cylindrical projection: sampled by direction, smoothed evenly on the sphere."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates


@dataclass(frozen=True, eq=False)
class SphereMap:
    """Values over the whole sphere; row 0 begins at latitude +90 degrees, column 0 at longitude -180.

    Parameters
    ----------
    values : (h, w, channels) float32
        At the pixels' middles. Longitudes wrap; across a pole the map goes on at the opposite longitude.
    """

    values: NDArray

    @property
    def pixel(self) -> float:
        """Height of a pixel, radians."""
        return np.pi / len(self.values)

    def directions(self) -> NDArray:
        """Return the unit vectors (h, w, 3) float64 of the pixels' middles; +y is north, +z has longitude 0."""
        height, width = self.values.shape[:2]
        latitude = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * np.pi
        longitude = ((np.arange(width) + 0.5) / width - 0.5)[None, :] * 2 * np.pi
        flat = np.cos(latitude)
        return np.stack(np.broadcast_arrays(flat * np.sin(longitude), np.sin(latitude), flat * np.cos(longitude)), -1)

    def reduced(self, pixel: float) -> "SphereMap":
        """Return the map averaged over whole blocks of pixels, as long as those stay at most `pixel` radians high."""
        height, width, channels = self.values.shape
        wanted = int(pixel / self.pixel)
        factor = max((f for f in range(1, wanted + 1) if height % f == 0 and width % f == 0), default=1)
        blocks = self.values.reshape(height // factor, factor, width // factor, factor, channels)
        return SphereMap(blocks.mean(axis=(1, 3), dtype=np.float32))

    def smoothed(self, width: float) -> "SphereMap":
        """Return the map under a Gaussian of standard deviation `width` radians on the sphere.

        Rows are smoothed in the frequency domain by width / cos(latitude), which knows no date line and leaves one
        value around a pole; columns go on beyond the poles.
        """
        height, columns = self.values.shape[:2]
        latitude = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
        sigma = width / np.maximum(np.cos(latitude), 1e-6)  # radians of longitude
        frequency = np.arange(columns // 2 + 1)  # cycles around the sphere
        gain = np.exp(-0.5 * (sigma[:, None] * frequency) ** 2).astype(np.float32)
        values = np.fft.irfft(np.fft.rfft(self.values, axis=1) * gain[..., None], columns, axis=1).astype(np.float32)
        reach = min(height, int(np.ceil(4 * width / self.pixel)))
        if reach:
            over = np.roll(values, columns // 2, axis=1)
            values = np.concatenate([over[:reach][::-1], values, over[height - reach:][::-1]])
            values = gaussian_filter1d(values, width / self.pixel, axis=0, mode="nearest")[reach:reach + height]
        return SphereMap(values)

    def sample(self, directions: NDArray) -> NDArray:
        """Return the values (n, channels) float32, bilinear between pixels, at unit vectors (n, 3)."""
        height, width, channels = self.values.shape
        over = np.roll(self.values, width // 2, axis=1)
        rows = np.concatenate([over[:1], self.values, over[-1:]])  # a row beyond either pole
        latitude = np.arcsin(np.clip(directions[:, 1], -1, 1))
        longitude = np.arctan2(directions[:, 0], directions[:, 2])
        row = (0.5 - latitude / np.pi) * height + 0.5
        column = (longitude / (2 * np.pi) + 0.5) * width - 0.5
        out = np.empty((len(directions), channels), np.float32)
        for c in range(channels):
            map_coordinates(rows[..., c], [row, column], output=out[:, c], order=1, mode="grid-wrap")
        return out
