"""Spherical scale maps as plain data: a cube map of distances from a centre.

Source: Reiter, "Spherical Scale Mapping", 2005, section 2: for every texel the ray towards the centre of a bounding
sphere meets the model, and the distance from the centre over the sphere's radius is stored.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .arrays import box_of, frozen, lengths_of
from .cube import texel_directions
from .placed import Placed, placed

LARGEST_CODE = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535, np.dtype(np.float32): 1}
NORMAL_HALF = 127.5  # a normal's component c is stored as round((c + 1) 127.5)


@dataclass(frozen=True, eq=False, repr=False)
class ScaleMap:
    """A surface that rays from a centre meet once: its distance in every direction, as a cube map.

    Texel (row i, column j) of face f looks along ``cube.texel_directions(size)[f, i, j]``; faces are +X -X +Y -Y +Z -Z
    in OpenGL's orientation. In that direction the surface lies at `center` + lambda `radius` direction, where lambda is
    the code in `scales` over the largest one (255, 65535; floats are lambda itself). Between texels lambda is
    interpolated on one closed net of texel centres (see clsurf/surface/cube.py), across the edges of the cube too.

    Parameters
    ----------
    center : (3,) float64
        World.
    radius : float
        Of the bounding sphere, world units.
    scales : (layers, 6, s, s) uint8, uint16 or float32
        code = round(lambda max). Layer 0 is the surface; further layers hold the next hits of the same rays.
    valid : (layers, 6, s, s) bool
        False: the ray has no such hit, a hole.
    normals : (layers, 6, s, s, 3) uint8, optional
        Outward unit normals, components from -1 to 1 stored as 0 to 255; one layer may leave out the first axis.
    hit : str
        "outermost" or "innermost": whether layer 0 holds each ray's last or first hit, seen from the centre.
    multiple_share : float
        Share of the sphere of directions (0 to 1) whose ray meets the model more than once: what a single layer loses.
        NaN: not known.
    diagonal : float
        Diagonal of the scan's bounding box, world units.
    bound, bound_share : float
        The distance (world units) within which the surface lies of the share `bound_share` of the scan's points.
    bound_all : float
        The same for all that was measured: the largest distance, and half a step of the codes. NaN: not known, as
        where the map has holes.

    Raises
    ------
    ValueError
        An array of the wrong shape or type, or a radius that is not positive.
    """

    center: NDArray  # (3,) float64, world
    radius: float
    scales: NDArray  # (layers, 6, s, s) uint8, uint16 or float32
    valid: NDArray  # (layers, 6, s, s) bool
    normals: NDArray | None = None  # (layers, 6, s, s, 3) uint8
    hit: str = "outermost"
    multiple_share: float = float("nan")
    diagonal: float = 1.0  # world units
    bound: float = float("nan")  # world units
    bound_share: float = 1.0
    bound_all: float = float("nan")  # world units

    def __post_init__(self):
        put = lambda name, *rest: object.__setattr__(self, name, frozen(name, getattr(self, name), *rest))  # noqa: E731
        put("center", (3,), np.float64)
        object.__setattr__(self, "radius", float(self.radius))
        if not (0 < self.radius < np.inf and np.isfinite(self.center).all()):
            raise ValueError(f"center, radius: expected finite numbers, the radius positive, got {self.center} and "
                             f"{self.radius}")
        scales = np.asarray(self.scales)
        if scales.dtype not in LARGEST_CODE:
            raise ValueError(f"scales: expected uint8, uint16 or float32, got {scales.dtype}")
        size = scales.shape[-1] if scales.ndim else 0
        put("scales", ("layers", 6, size, size), scales.dtype)
        layers = len(self.scales)
        if not layers or not size:
            raise ValueError(f"scales: expected at least one layer and one texel, got shape {scales.shape}")
        put("valid", (layers, 6, size, size), np.bool_)
        if scales.dtype == np.float32:
            known = self.scales[self.valid]
            if not (np.isfinite(known) & (known >= 0)).all():
                raise ValueError("scales: expected finite numbers of at least 0 where valid")
        if self.normals is not None:
            if np.ndim(self.normals) == 4:
                object.__setattr__(self, "normals", np.asarray(self.normals)[None])
            put("normals", (layers, 6, size, size, 3), np.uint8)
        if self.hit not in ("outermost", "innermost"):
            raise ValueError(f"hit: expected outermost or innermost, got {self.hit!r}")

    @property
    def size(self) -> int:
        """Texels along a side of a face."""
        return self.scales.shape[-1]

    @property
    def layers(self) -> int:
        """Number of layers."""
        return len(self.scales)

    @property
    def bits(self) -> int:
        """Bits of a code: 8, 16, or 32 for floats."""
        return 8 * self.scales.itemsize

    @property
    def origin(self) -> NDArray:
        """(3,) float64: the zero of model space, the centre."""
        return self.center

    @property
    def lambdas(self) -> NDArray:
        """(layers, 6, s, s) float32: distance over the radius; NaN in holes."""
        values = self.scales * np.float32(1 / LARGEST_CODE[self.scales.dtype])
        return np.where(self.valid, values, np.float32(np.nan))

    @property
    def hole_share(self) -> float:
        """Share of the texels of layer 0 that are holes."""
        return float(1 - self.valid[0].mean())

    def positions(self) -> NDArray:
        """Return the texels' points (layers, 6, s, s, 3) float64, world; NaN in holes."""
        return self.center + self.radius * self.lambdas[..., None] * texel_directions(self.size)

    def unit_normals(self) -> NDArray | None:
        """Return the stored normals (layers, 6, s, s, 3) float32 of length 1, or None."""
        if self.normals is None:
            return None
        n = self.normals * np.float32(1 / NORMAL_HALF) - np.float32(1)
        return n / np.maximum(lengths_of(n, keepdims=True), np.float32(1e-6))

    @property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64 of the texels' points, world space; NaN where all are holes."""
        points = self.positions()[self.valid]
        if not len(points):
            return np.full((2, 3), np.nan)
        return np.stack(box_of(points))

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays in memory."""
        return sum(a.nbytes for a in (self.scales, self.valid, self.normals) if a is not None)

    def moved(self, matrix) -> Placed:
        """Return this surface placed by the similarity `matrix` (4, 4), the arrays shared."""
        return placed(self, matrix)

    def __repr__(self):
        low, high = self.bounds
        layers = f", {self.layers} layers" if self.layers > 1 else ""
        return (f"ScaleMap(6 x {self.size} x {self.size}, {self.bits} bits{layers}"
                f"{', normals' if self.normals is not None else ''}, {self.hole_share:.1%} holes, "
                f"{self.nbytes:,} bytes, bounds {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()})")


def encoded(lambdas: NDArray, bits: int) -> NDArray:
    """Return the codes of lambda: uint8, uint16 or float32 for 8, 16 or 32 bits; NaN becomes 0, over 1 the largest."""
    values = np.nan_to_num(np.asarray(lambdas))
    if bits == 32:
        return values.astype(np.float32)
    dtype = np.dtype(np.uint8 if bits == 8 else np.uint16)
    return np.rint(np.clip(values, 0, 1) * LARGEST_CODE[dtype]).astype(dtype)


def encoded_normals(normals: NDArray) -> NDArray:
    """Return unit normals (..., 3) as uint8; NaN becomes the middle code."""
    return np.rint((np.nan_to_num(np.clip(normals, -1, 1)) + 1) * NORMAL_HALF).astype(np.uint8)
