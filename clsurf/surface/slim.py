"""Sparse low-degree implicits (SLIM) as plain data.

Source: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces with Applications to High Quality Rendering,
Feature Extraction, and Smoothing", SGP 2005, section 2.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .arrays import box_of, frozen
from .placed import Placed, placed

COEFFICIENTS = {1: 1, 2: 6, 3: 10}  # coefficients of one surfel by degree
FLOATS = {1: 7, 2: 12, 3: 16}  # floats of one stored surfel by degree (paper, section 4, "Sparsity analysis")
GOLDEN = (5 ** 0.5 - 1) / 2
FIRST_RADIUS = 0.1  # r_0 over the diagonal (paper, section 2)


def segment_end(level: int) -> float:
    """Return r_r of the segment of `level` (1 the coarsest), over the diagonal: its surfels are no larger."""
    return FIRST_RADIUS * GOLDEN ** (level - 1)


@dataclass(frozen=True, eq=False, repr=False)
class SlimSurface:
    """A multi-scale set of surfels: balls, each with a local polynomial of degree 1, 2 or 3.

    Inside the ball of centre c and radius r the surface is the zero set of
    f(u, v, w) = w - sum c_ij u^i v^j, monomials in the order 1, u, v, u^2, uv, v^2, u^3, u^2 v, u v^2, v^3 without
    binomial factors, where w runs along the surfel's normal and (u, v) complete the right-handed frame of
    `frame_of_normals` (Duff et al. 2017). A surfel of degree 1 has the fitted plane's normal and one coefficient.

    Leaves alone cover the surface; internal surfels are coarser approximations of what lies below them.

    Parameters
    ----------
    degree : int
        1, 2 or 3.
    error : float
        T_MDL relative to `diagonal` (paper, equation 3).
    origin : (3,) float64
        World position of the centres' zero.
    centers, radii, normals, coefficients
        (n, 3), (n,), (n, 3) and (n, 1 | 6 | 10) float32, world units relative to `origin`; normals are unit.
    level : (n,) int32
        Level in the hierarchy, 1 the coarsest; ascending.
    leaf : (n,) bool
    child_offset, children : (n + 1,), (m,) int32
        The children of surfel i are ``children[child_offset[i]:child_offset[i + 1]]``; a surfel may have several
        parents. The root's children are `roots`.
    fit_error : (n,) float32
        Weighted root mean square of f over the points of the ball, world units.
    diagonal : float
        Diagonal of the scan's bounding box without outliers, world units.
    bound, bound_share : float
        The distance (world units) within which the surface lies of the share `bound_share` of the scan's points.
    bound_all : float
        The same for all that was measured, strays included: the largest distance, and a rounding. NaN: not known.
    footprint : (n, 8) uint8, optional
        Support of the surfel's own points: (u, v) lies inside where u cos(k pi/4) + v sin(k pi/4) is at most
        footprint[k] / 255 of the radius for k = 0...7; 255 everywhere: not limited.
    colors : (n, 4) uint8, optional
        sRGB with straight alpha.
    oriented : bool
        False: the sign of the normals means nothing (two-sided).

    Raises
    ------
    ValueError
        An array of the wrong shape, or a degree other than 1, 2, 3.
    """

    degree: int
    error: float
    centers: NDArray  # (n, 3) float32, relative to origin
    radii: NDArray  # (n,) float32
    normals: NDArray  # (n, 3) float32, unit
    coefficients: NDArray  # (n, 1 or 6 or 10) float32
    level: NDArray  # (n,) int32, 1 is the coarsest
    leaf: NDArray  # (n,) bool
    child_offset: NDArray  # (n + 1,) int32
    children: NDArray  # (m,) int32
    fit_error: NDArray  # (n,) float32, world units
    origin: NDArray = (0.0, 0.0, 0.0)  # (3,) float64, world
    diagonal: float = 1.0  # world units
    bound: float = float("nan")  # world units
    bound_share: float = 1.0
    bound_all: float = float("nan")  # world units
    footprint: NDArray | None = None  # (n, 8) uint8
    colors: NDArray | None = None  # (n, 4) uint8 sRGB
    oriented: bool = True

    def __post_init__(self):
        if self.degree not in COEFFICIENTS:
            raise ValueError(f"degree: expected 1, 2 or 3, got {self.degree}")
        put = lambda name, *rest: object.__setattr__(self, name, frozen(name, getattr(self, name), *rest))  # noqa: E731
        put("centers", ("n", 3), np.float32)
        n = len(self.centers)
        put("radii", (n,), np.float32)
        put("normals", (n, 3), np.float32)
        put("coefficients", (n, COEFFICIENTS[self.degree]), np.float32)
        put("level", (n,), np.int32)
        put("leaf", (n,), np.bool_)
        put("child_offset", (n + 1,), np.int32)
        put("children", ("m",), np.int32)
        put("fit_error", (n,), np.float32)
        put("origin", (3,), np.float64)
        if self.footprint is not None:
            put("footprint", (n, 8), np.uint8)
        if self.colors is not None:
            put("colors", (n, 4), np.uint8)
        offset = self.child_offset
        if offset[0] != 0 or offset[-1] != len(self.children) or np.any(np.diff(offset) < 0):
            raise ValueError(f"child_offset: expected ascending offsets from 0 to {len(self.children)}")
        if len(self.children) and (self.children.min() < 0 or self.children.max() >= n):
            raise ValueError(f"children: expected indices from 0 to {n - 1}")

    def __len__(self):
        return len(self.centers)

    @property
    def roots(self) -> NDArray:
        """(k,) int32: the surfels that are nobody's child, in other words the children of the root."""
        child = np.zeros(len(self), bool)
        child[self.children] = True
        return np.flatnonzero(~child).astype(np.int32)

    @property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64 of the leaves' balls, world space; NaN where there is no surfel.

        The half extent of a ball's surface along an axis is shortened by the surfel's tilt: a flat disc of normal n
        reaches r sqrt(1 - n_x^2) along x.
        """
        use = self.leaf if self.leaf.any() else np.ones(len(self), bool)
        if not use.any():
            return np.full((2, 3), np.nan)
        reach = self.radii[use, None] * np.sqrt(np.clip(1 - self.normals[use].astype(np.float64) ** 2, 0, 1))
        # The alpha-shrunken ball (2/3) is what carries the surface; the rest only blends.
        reach = reach * (2 / 3)
        centers = self.centers[use].astype(np.float64)
        return np.stack([box_of(centers - reach)[0], box_of(centers + reach)[1]]) + self.origin

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays in memory."""
        arrays = (self.centers, self.radii, self.normals, self.coefficients, self.level, self.leaf, self.child_offset,
                  self.children, self.fit_error, self.footprint, self.colors)
        return sum(a.nbytes for a in arrays if a is not None)

    def moved(self, matrix) -> Placed:
        """Return this surface placed by the similarity `matrix` (4, 4), the arrays shared."""
        return placed(self, matrix)

    def __repr__(self):
        low, high = self.bounds
        return (f"SlimSurface(degree {self.degree}, {int(self.leaf.sum()):,} leaves of {len(self):,} surfels, "
                f"{self.nbytes:,} bytes, bounds {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()})")


def powers(u: NDArray, v: NDArray) -> NDArray:
    """Return the terms (..., 10) of a cubic at places u, v in the order of the coefficients."""
    return np.stack([u**0, u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=-1)


def frame_of_normals(normals) -> tuple[NDArray, NDArray]:
    """Return the axes u and v that complete unit normals to right-handed frames.

    Parameters
    ----------
    normals : (n, 3) array_like
        Unit vectors.

    Returns
    -------
    u, v : (n, 3)
        In the dtype of the input; u x v = n.

    Notes
    -----
    Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017; the kernels' twin is `common/frame.clh`.
    """
    n = np.asarray(normals)
    x, y, z = n[..., 0], n[..., 1], n[..., 2]
    sign = np.copysign(np.ones((), n.dtype), z)
    a = -1 / (sign + z)
    b = x * y * a
    u = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    v = np.stack([b, sign + y * y * a, -y], axis=-1)
    return u, v
