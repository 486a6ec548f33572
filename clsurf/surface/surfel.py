"""Hierarchies of surfels with normal maps as plain data.

Source: Holst, Schumann, "Normal Mapping for Surfel-Based Rendering", Journal of WSCG 15, 2007.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .arrays import bounds_of, box_of, frozen, lengths_of, used_numbers
from .cloud import PointCloud
from .mesh import Mesh
from .placed import Placed, placed

COVERED = 255  # fourth byte of a texel whose line meets the surface; 0 elsewhere


@dataclass(frozen=True, eq=False, repr=False)
class SurfelHierarchy:
    """A tree of surfels: discs, the base surfels fine, the inner ones standing for all that lies below them.

    Inner surfels come first, level by level, then the base surfels; the children of a surfel stand together. A normal
    map is a raster of `map_size` squared texels over the square of half side `radii` about a surfel's position in its
    plane, rows along v, columns along u of the frame of `clsurf.surface.slim.frame_of_normals`; texel (x, y) lies at
    ((2 x + 1) / w - 1, (2 y + 1) / w - 1) radii. It holds the unit normal of the surface above or below that point,
    each component as round(127.5 n + 127.5), and whether there is any.

    In the hybrid form there are no base surfels: below the inner surfels of the last level are the triangles of a mesh.

    Parameters
    ----------
    positions, normals, radii
        (n, 3), (n, 3) and (n,) float32, world units relative to `origin`; normals are unit.
    spheres : (n,) float32
        Radius of a sphere about the position that holds the spheres of all children (of a base surfel: its radius), or
        the triangles.
    heights : (n,) float32
        Farthest distance of a base surfel's position, or of a triangle's corner, below the surfel from its plane.
    spreads : (n,) float32
        About the sine of the half angle of the cone that holds the normals below; 1: there may be any.
    level : (n,) int32
        1 the coarsest; ascending. Base surfels are of the last one.
    child_offset, children : (n + 1,), (m,) int32
        The children of surfel i are ``children[child_offset[i]:child_offset[i + 1]]``.
    map_offset, map_size : (n,) int32
        The map of surfel i is ``normal_atlas[map_offset[i]:map_offset[i] + map_size[i]**2]``, row by row; base surfels
        have one texel.
    normal_atlas : (t, 4) uint8
        The normal's code, and 255 where the texel's line meets the surface, 0 where not.
    colors : (n, 4) uint8, optional
        sRGB with straight alpha.
    color_atlas : (t, 4) uint8, optional
        Colours of the texels of `normal_atlas`.
    vertices, vertex_normals, vertex_colors : (v, 3) float32, (v, 3) float32, (v, 4) uint8, optional
        Of the hybrid form.
    triangles : (f, 3) int32, optional
        Indices of vertices, counter-clockwise seen from outside.
    triangle_offset : (n + 1,) int32, optional
        The triangles right below surfel i are ``triangles[triangle_offset[i]:triangle_offset[i + 1]]``.
    spacing : float
        Median distance between neighbouring base surfels or vertices, world units.
    bound, bound_share : float
        The distance (world units) within which the finest level, as it is drawn, lies of the share `bound_share` of
        the scan: of its points, its faces, and the surface between points that their normals give. Coarser levels lie
        up to `heights` farther off.
    bound_all : float
        The same for all that was measured, with every disc taken to its rim, whatever it is blended with.

    Raises
    ------
    ValueError
        An array of the wrong shape, or indices that do not fit.
    """

    positions: NDArray  # (n, 3) float32, relative to origin
    normals: NDArray  # (n, 3) float32, unit
    radii: NDArray  # (n,) float32
    spheres: NDArray  # (n,) float32
    heights: NDArray  # (n,) float32
    spreads: NDArray  # (n,) float32
    level: NDArray  # (n,) int32, 1 is the coarsest
    child_offset: NDArray  # (n + 1,) int32
    children: NDArray  # (m,) int32
    map_offset: NDArray  # (n,) int32, texels
    map_size: NDArray  # (n,) int32, texels along a side
    normal_atlas: NDArray  # (t, 4) uint8
    colors: NDArray | None = None  # (n, 4) uint8 sRGB
    color_atlas: NDArray | None = None  # (t, 4) uint8 sRGB
    vertices: NDArray | None = None  # (v, 3) float32, relative to origin
    vertex_normals: NDArray | None = None  # (v, 3) float32, unit
    vertex_colors: NDArray | None = None  # (v, 4) uint8 sRGB
    triangles: NDArray | None = None  # (f, 3) int32
    triangle_offset: NDArray | None = None  # (n + 1,) int32
    origin: NDArray = (0.0, 0.0, 0.0)  # (3,) float64, world
    spacing: float = float("nan")  # world units
    bound: float = float("nan")  # world units
    bound_share: float = 1.0
    bound_all: float = float("nan")  # world units

    def __post_init__(self):
        put = lambda name, *rest: object.__setattr__(self, name, frozen(name, getattr(self, name), *rest))  # noqa: E731
        put("positions", ("n", 3), np.float32)
        n = len(self.positions)
        put("normals", (n, 3), np.float32)
        for name in ("radii", "spheres", "heights", "spreads"):
            put(name, (n,), np.float32)
        for name in ("level", "map_offset", "map_size"):
            put(name, (n,), np.int32)
        put("child_offset", (n + 1,), np.int32)
        put("children", ("m",), np.int32)
        put("normal_atlas", ("t", 4), np.uint8)
        put("origin", (3,), np.float64)
        if self.colors is not None:
            put("colors", (n, 4), np.uint8)
        if self.color_atlas is not None:
            put("color_atlas", self.normal_atlas.shape, np.uint8)
        self._check_triangles(put, n)
        _check_offsets("child_offset", self.child_offset, len(self.children))
        _check_indices("children", self.children, n)
        _check_tree(self.child_offset, self.children, self.level)
        if n and (self.map_size.min() < 1 or self.map_offset.min() < 0 or
                  (self.map_offset + self.map_size.astype(np.int64)**2).max() > len(self.normal_atlas)):
            raise ValueError(f"map_offset, map_size: expected maps within the atlas of {len(self.normal_atlas)} texels")

    def _check_triangles(self, put, n: int) -> None:
        parts = [name for name in ("vertices", "vertex_normals", "triangles", "triangle_offset")
                 if getattr(self, name) is None]
        if len(parts) == 4:
            return
        if parts:
            raise ValueError(f"{parts[0]}: expected with vertices, vertex_normals, triangles and triangle_offset, "
                             "got None")
        put("vertices", ("v", 3), np.float32)
        put("vertex_normals", self.vertices.shape, np.float32)
        put("triangles", ("f", 3), np.int32)
        put("triangle_offset", (n + 1,), np.int32)
        if self.vertex_colors is not None:
            put("vertex_colors", (len(self.vertices), 4), np.uint8)
        _check_offsets("triangle_offset", self.triangle_offset, len(self.triangles))
        _check_indices("triangles", self.triangles.ravel(), len(self.vertices))

    def __len__(self):
        return len(self.positions)

    @property
    def hybrid(self) -> bool:
        """Whether the finest level is a mesh."""
        return self.triangles is not None

    @property
    def base(self) -> NDArray:
        """(b,) int32: the base surfels, those with nothing below them; none in the hybrid form."""
        below = np.diff(self.child_offset)
        if self.hybrid:
            below = below + np.diff(self.triangle_offset)
        return np.flatnonzero(below == 0).astype(np.int32)

    @property
    def mesh(self) -> Mesh | None:
        """The mesh below the hybrid form; None in the pure one."""
        if not self.hybrid:
            return None
        return Mesh(self.vertices, self.triangles, self.vertex_normals, self.vertex_colors, origin=self.origin)

    @property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64 of the base surfels' discs, or of the mesh; NaN where there is nothing."""
        if self.hybrid:
            return bounds_of(self.vertices[used_numbers(self.triangles, len(self.vertices))], self.origin)
        base = self.base
        if not len(base):
            return np.full((2, 3), np.nan)
        reach = self.radii[base, None] * np.sqrt(np.clip(1 - self.normals[base].astype(np.float64) ** 2, 0, 1))
        positions = self.positions[base].astype(np.float64)
        return np.stack([box_of(positions - reach)[0], box_of(positions + reach)[1]]) + self.origin

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays in memory."""
        return sum(a.nbytes for a in vars(self).values() if isinstance(a, np.ndarray)) - self.origin.nbytes

    def moved(self, matrix) -> Placed:
        """Return this surface placed by the similarity `matrix` (4, 4), the arrays shared."""
        return placed(self, matrix)

    def __repr__(self):
        low, high = self.bounds
        finest = f"{len(self.triangles):,} triangles" if self.hybrid else f"{len(self.base):,} base surfels"
        inner = len(self) - len(self.base)
        across = int(self.map_size.max(initial=0))
        return (f"SurfelHierarchy({finest}, {inner:,} inner surfels with maps up to {across} x {across}, "
                f"{self.nbytes:,} bytes, bounds {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()})")


def finest_scan(surface: SurfelHierarchy) -> Mesh | PointCloud:
    """Return the finest level as a scan: the base surfels as points, or the mesh."""
    if surface.hybrid:
        return surface.mesh
    base = surface.base
    return PointCloud(surface.positions[base], surface.normals[base],
                      None if surface.colors is None else surface.colors[base], origin=surface.origin)


def _check_offsets(name: str, offset: NDArray, count: int) -> None:
    if offset[0] != 0 or offset[-1] != count or np.any(np.diff(offset) < 0):
        raise ValueError(f"{name}: expected ascending offsets from 0 to {count}")


def _check_indices(name: str, indices: NDArray, count: int) -> None:
    if len(indices) and (indices.min() < 0 or indices.max() >= count):
        raise ValueError(f"{name}: expected indices from 0 to {count - 1}")


def _check_tree(offset: NDArray, children: NDArray, level: NDArray) -> None:
    """Refuse children with two parents, apart from each other, or not below their parents; and levels out of order."""
    if np.any(np.diff(level) < 0):
        raise ValueError("level: expected in ascending order, the coarsest first")
    if len(used_numbers(children, len(level))) < len(children):
        raise ValueError("children: expected every surfel below one other only")
    step = np.diff(children)
    first = np.zeros(len(children) + 1, bool)
    first[offset] = True
    if np.any((step != 1) & ~first[1:-1]):
        raise ValueError("children: expected those of one surfel to stand together, in ascending order")
    parent = np.repeat(np.arange(len(level)), np.diff(offset))
    if np.any(level[children] <= level[parent]):
        raise ValueError("children: expected at a finer level than their parent")


def encoded_normals(normals) -> NDArray:
    """Return the codes (..., 3) uint8 of unit normals: round(127.5 n + 127.5)."""
    return np.clip(np.rint(np.asarray(normals, np.float64) * 127.5 + 127.5), 0, 255).astype(np.uint8)


def decoded_normals(codes) -> NDArray:
    """Return unit normals (..., 3) float64 from the first three bytes of texels."""
    n = np.asarray(codes, np.float64)[..., :3] / 127.5 - 1
    return n / lengths_of(n, keepdims=True)
