"""Triangle meshes as plain data."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .arrays import bounds_of, frozen, recentred
from .placed import Placed, placed


@dataclass(frozen=True, eq=False, repr=False)
class Mesh:
    """A triangle mesh; positions are float32 relative to a float64 `origin`.

    Parameters
    ----------
    vertices : (v, 3) array_like
        Positions. float64 input without `origin` is re-origined to the centre of its box.
    faces : (f, 3) array_like of int, optional
        Vertex indices, counter-clockwise seen from outside.
    normals : (v, 3) float32, optional
        Unit normals.
    colors : (v, 4) uint8, optional
        sRGB with straight alpha.
    uv : (v, 2) float32, optional
        Texture coordinates, origin at the bottom left.
    texture : (h, w, 4) uint8, optional
        sRGB with straight alpha, row 0 on top.
    origin : (3,) float64, optional
        World position of the vertices' zero.
    attributes : dict of str to array, optional
        Further per-vertex arrays, carried along.

    Raises
    ------
    ValueError
        An array of the wrong shape, or a face index outside the vertices.
    """

    vertices: NDArray  # (v, 3) float32, relative to origin
    faces: NDArray | None = None  # (f, 3) int32
    normals: NDArray | None = None  # (v, 3) float32
    colors: NDArray | None = None  # (v, 4) uint8 sRGB, straight alpha
    uv: NDArray | None = None  # (v, 2) float32
    texture: NDArray | None = None  # (h, w, 4) uint8
    origin: NDArray | None = None  # (3,) float64, world
    attributes: dict[str, NDArray] = field(default_factory=dict)

    def __post_init__(self):
        points, origin = recentred(self.vertices, self.origin)
        faces = np.zeros((0, 3), np.int32) if self.faces is None else self.faces
        put = lambda name, *rest: object.__setattr__(self, name, frozen(name, *rest))  # noqa: E731
        put("vertices", points, ("v", 3), np.float32)
        put("origin", origin, (3,), np.float64)
        put("faces", faces, ("f", 3), np.int32)
        count = len(points)
        if len(self.faces) and (self.faces.min() < 0 or self.faces.max() >= count):
            raise ValueError(f"faces: expected indices from 0 to {count - 1}, got {self.faces.min()} to "
                             f"{self.faces.max()}")
        if self.normals is not None:
            put("normals", self.normals, (count, 3), np.float32)
        if self.colors is not None:
            put("colors", self.colors, (count, 4), np.uint8)
        if self.uv is not None:
            put("uv", self.uv, (count, 2), np.float32)
        if self.texture is not None:
            put("texture", self.texture, ("h", "w", 4), np.uint8)

    @property
    def points(self) -> NDArray:
        """The vertices, under the name that point clouds use."""
        return self.vertices

    @property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64, world space; NaN where there is no vertex."""
        return bounds_of(self.vertices, self.origin)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        arrays = (self.vertices, self.faces, self.normals, self.colors, self.uv, self.texture,
                  *self.attributes.values())
        return sum(a.nbytes for a in arrays if a is not None)

    def moved(self, matrix) -> Placed:
        """Return this mesh placed by the similarity `matrix` (4, 4), the arrays shared."""
        return placed(self, matrix)

    def __repr__(self):
        low, high = self.bounds
        return (f"Mesh({len(self.vertices):,} vertices, {len(self.faces):,} faces, {self.nbytes:,} bytes, "
                f"bounds {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()})")
