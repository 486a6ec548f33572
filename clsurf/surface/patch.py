"""Spatial patches, range images of small parts of a surface, as plain data.

Source: the paper on spatial patches, sections 2 and 6: a patch is an origin P, an orthogonal frame (a_x, a_y, a_z) and
m x n nodes, each a colour and a displacement d: N_ij = P + i a_x + j a_y + d_ij a_z.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .arrays import finite_rows, frozen, lengths_of
from .placed import Placed, placed

FRAME_BYTES = 40  # 10 floats: origin, a_x, a_y, |a_z| (paper, section 4.3)
DISPLACEMENTS = {np.dtype(np.int8), np.dtype(np.int32)}


@dataclass(frozen=True, eq=False, repr=False)
class PatchSurface:
    """A collection of spatial patches without connectivity; patches may overlap and differ in size.

    Node (i, j) of patch k is node ``node_offset[k] + j * m + i`` of the flat arrays, with ``m, n = size[k]``, and lies
    at origins[k] + i axis_x[k] + j axis_y[k] + d axis_z[k], relative to `origin`. axis_z is axis_x x axis_y scaled to
    `axis_z_length` and points to the outside.

    A node is transparent where its colour is pure black (three channels), where its alpha is 0 (four channels), or,
    where there are no colours, where its displacement is the least that the type holds (-128 for int8).

    Parameters
    ----------
    origins : (p, 3) float32
        Node (0, 0) at displacement 0, world units relative to `origin`.
    axis_x, axis_y : (p, 3) float32
        World units per node step, perpendicular to each other.
    axis_z_length : (p,) float32
        World units per displacement step.
    size : (p, 2) or (2,) int32
        Nodes (m along axis_x, n along axis_y), each at least 2. Equal sizes take no memory.
    displacements : (N,) int8 or int32
    colors : (N, 3) or (N, 4) uint8, optional
        sRGB, or sRGB with straight alpha.
    color : (3,) uint8, optional
        One sRGB colour for all nodes, where there are no `colors`; None: the shading's.
    origin : (3,) float64
        World position of the zero of `origins`.
    diagonal : float
        Diagonal of the scan's bounding box without outliers, world units; NaN: that of the nodes.
    bound, bound_share : float
        The distance (world units) within which the surface lies of the share `bound_share` of the scan's points.
    bound_all : float
        The same for all that was measured, strays included: the largest distance, and half a step of the
        displacements. NaN: not known, as where a part of the scan has no patch.
    oriented : bool
        False: the side that axis_z points to means nothing (two-sided).

    Raises
    ------
    ValueError
        An array of the wrong shape or type, or axes that are zero or not perpendicular.
    """

    origins: NDArray  # (p, 3) float32, relative to origin
    axis_x: NDArray  # (p, 3) float32, world units a node step
    axis_y: NDArray  # (p, 3) float32, world units a node step
    axis_z_length: NDArray  # (p,) float32, world units a displacement step
    size: NDArray  # (p, 2) int32: nodes along axis_x, axis_y
    displacements: NDArray  # (N,) int8 or int32
    colors: NDArray | None = None  # (N, 3 or 4) uint8 sRGB
    color: NDArray | None = None  # (3,) uint8 sRGB
    origin: NDArray = (0.0, 0.0, 0.0)  # (3,) float64, world
    diagonal: float = float("nan")  # world units
    bound: float = float("nan")  # world units
    bound_share: float = 1.0
    bound_all: float = float("nan")  # world units
    oriented: bool = True

    def __post_init__(self):
        put = lambda name, *rest: object.__setattr__(self, name, frozen(name, getattr(self, name), *rest))  # noqa: E731
        put("origins", ("p", 3), np.float32)
        count = len(self.origins)
        put("axis_x", (count, 3), np.float32)
        put("axis_y", (count, 3), np.float32)
        put("axis_z_length", (count,), np.float32)
        put("origin", (3,), np.float64)
        size = np.asarray(self.size, np.int32)
        equal = size.ndim == 1 or len(size) == 0 or bool((size == size[0]).all())
        one = size if size.ndim == 1 else size[0] if len(size) else np.array([17, 17], np.int32)
        if one.shape != (2,) or (size.ndim > 1 and size.shape != (count, 2)):
            raise ValueError(f"size: expected an array of shape ({count}, 2) or (2,), got {size.shape}")
        if (size < 2).any():
            raise ValueError(f"size: expected at least 2 nodes each way, got {size.min()}")
        if equal:
            object.__setattr__(self, "size", np.broadcast_to(one.copy(), (count, 2)))  # read-only, no memory
        else:
            put("size", (count, 2), np.int32)
        nodes = int(self.node_offset[-1])
        if np.asarray(self.displacements).dtype not in DISPLACEMENTS:
            raise ValueError(f"displacements: expected int8 or int32, got {np.asarray(self.displacements).dtype}")
        put("displacements", (nodes,), np.asarray(self.displacements).dtype)
        if self.colors is not None:
            channels = 4 if np.ndim(self.colors) == 2 and np.shape(self.colors)[1] == 4 else 3
            put("colors", (nodes, channels), np.uint8)
        if self.color is not None:
            put("color", (3,), np.uint8)
        self._check_frames()

    def _check_frames(self):
        x, y = self.axis_x.astype(np.float64), self.axis_y.astype(np.float64)
        lengths = lengths_of(x) * lengths_of(y)
        across = np.abs(np.einsum("ij,ij->i", x, y))
        wrong = ~(finite_rows(self.origins) & (lengths > 0) & (across <= 1e-4 * lengths)
                  & (self.axis_z_length > 0) & np.isfinite(lengths) & np.isfinite(self.axis_z_length))
        if wrong.any():
            raise ValueError(f"patch {int(np.argmax(wrong))}: expected a finite origin, perpendicular axes of positive "
                             f"length and a positive axis_z_length ({int(wrong.sum())} patches fail)")

    def __len__(self):
        return len(self.origins)

    @cached_property
    def equal_sizes(self) -> bool:
        """Whether all patches have the same m and n."""
        return len(self) == 0 or bool((self.size == self.size[0]).all())

    @cached_property
    def node_offset(self) -> NDArray:
        """(p + 1,) int64: the first node of each patch, and the number of all nodes."""
        counts = self.size.astype(np.int64).prod(axis=1)
        out = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        out.flags.writeable = False
        return out

    @property
    def node_count(self) -> int:
        """Number of nodes, transparent ones included."""
        return len(self.displacements)

    @property
    def axis_z(self) -> NDArray:
        """(p, 3) float32: the displacement step as a vector, world units."""
        z = np.cross(self.axis_x.astype(np.float64), self.axis_y)
        z *= (self.axis_z_length / lengths_of(z))[:, None]
        return z.astype(np.float32)

    @property
    def opaque(self) -> NDArray:
        """(N,) bool: the nodes that show."""
        return opaque_nodes(self.displacements, self.colors)

    def node_patches(self) -> tuple[NDArray, NDArray, NDArray]:
        """Return the patch and the place (i, j) of every node: three (N,) int64 arrays."""
        counts = np.diff(self.node_offset)
        patch = np.repeat(np.arange(len(self)), counts)
        place = np.arange(self.node_count) - self.node_offset[patch]
        columns = self.size[patch, 0].astype(np.int64)
        return patch, place % columns, place // columns

    def positions(self) -> NDArray:
        """Return all nodes (N, 3) float64 in world space; transparent ones are NaN."""
        out = self._columns().T.copy()
        out[~self.opaque] = np.nan
        return out

    def _columns(self) -> NDArray:
        """Return all nodes, transparent ones too, as (3, N) float64, world space.

        A column at a time, patches of one size by broadcasting: 562,000 nodes in 20 ms, by a patch number each 84.
        """
        out = np.empty((3, self.node_count))
        x, y, z = (a.astype(np.float64) for a in (self.axis_x, self.axis_y, self.axis_z))
        start = self.origin + self.origins
        for which, nodes, m, n in by_size(self):
            d = self.displacements[nodes].reshape(-1, n, m)
            for r in range(3):
                row = start[which, r, None, None] + np.arange(m) * x[which, r, None, None]
                column = row + np.arange(n)[:, None] * y[which, r, None, None]
                column += d * z[which, r, None, None]
                out[r, nodes] = column.ravel()
        return out

    @cached_property
    def displacement_ranges(self) -> NDArray:
        """(p, 2) int32: least and largest displacement of each patch's opaque nodes; (1, 0) where there is none."""
        opaque, d = self.opaque, self.displacements.astype(np.int64)
        if not len(self):
            return np.zeros((0, 2), np.int32)
        far = 1 << 40
        starts = self.node_offset[:-1]
        low = np.minimum.reduceat(np.where(opaque, d, far), starts)
        high = np.maximum.reduceat(np.where(opaque, d, -far), starts)
        return np.where((low <= high)[:, None], np.stack([low, high], axis=1), [1, 0]).astype(np.int32)

    def boxes(self) -> NDArray:
        """Return the corners (p, 8, 3) float64 of the boxes around the patches' opaque displacements, world space.

        Corner c has i = 0 or m - 1 by bit 0, j = 0 or n - 1 by bit 1, the least or largest displacement by bit 2.
        """
        c = np.arange(8)
        i, j = (c & 1) * (self.size[:, :1] - 1), (c >> 1 & 1) * (self.size[:, 1:] - 1)
        d = self.displacement_ranges[:, c >> 2 & 1]
        return (self.origin + self.origins[:, None] + i[..., None] * self.axis_x[:, None].astype(np.float64)
                + j[..., None] * self.axis_y[:, None].astype(np.float64)
                + d[..., None] * self.axis_z[:, None].astype(np.float64))

    @property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64 of the opaque nodes, world space; NaN where there is none."""
        return self._box.copy()

    @cached_property
    def _box(self) -> NDArray:
        # Of 5.5 million nodes 1 s, and a scene asks for that of every placement.
        opaque = self.opaque
        if not opaque.any():
            return np.full((2, 3), np.nan)
        columns = [column[opaque] for column in self._columns()]
        return np.array([[column.min() for column in columns], [column.max() for column in columns]])

    @property
    def nbytes(self) -> int:
        """Bytes of the patches: 40 each and 1, 4, 5 or 8 a node (paper, section 2), and 8 each where sizes differ."""
        colors = 0 if self.colors is None else self.colors.nbytes
        sizes = 0 if self.equal_sizes else self.size.nbytes
        return FRAME_BYTES * len(self) + self.displacements.nbytes + colors + sizes

    def moved(self, matrix) -> Placed:
        """Return this surface placed by the similarity `matrix` (4, 4), the arrays shared."""
        return placed(self, matrix)

    def __repr__(self):
        low, high = self.bounds
        sizes = f"{self.size[0, 0]} x {self.size[0, 1]}" if self.equal_sizes and len(self) else "several sizes"
        return (f"PatchSurface({len(self):,} patches of {sizes}, {self.node_count:,} nodes, {self.nbytes:,} bytes, "
                f"bounds {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()})")


def chosen_patches(surface: PatchSurface, which: NDArray) -> PatchSurface:
    """Return the patches with the numbers `which` (q,), ascending."""
    if len(which) == len(surface):
        return surface
    counts = np.diff(surface.node_offset)[which]
    nodes = np.repeat(surface.node_offset[which] - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    rows = {name: getattr(surface, name)[which] for name in ("origins", "axis_x", "axis_y", "axis_z_length", "size")}
    return replace(surface, **rows, displacements=surface.displacements.take(nodes),
                   colors=None if surface.colors is None else surface.colors.take(nodes, 0))


def by_size(surface: PatchSurface) -> Iterator[tuple[NDArray, NDArray | slice, int, int]]:
    """Yield (patches, an index of all their nodes, m, n) for every size that patches have."""
    sizes = surface.size[:1] if surface.equal_sizes else np.unique(surface.size, axis=0)
    for m, n in sizes.tolist():
        which = np.flatnonzero((surface.size == (m, n)).all(axis=1))
        whole = len(which) == len(surface)
        yield which, slice(None) if whole else (surface.node_offset[which][:, None] + np.arange(m * n)).ravel(), m, n


def opaque_nodes(displacements: NDArray, colors: NDArray | None) -> NDArray:
    """Return which nodes (N,) bool show, by the rules of `PatchSurface`."""
    if colors is None:
        return displacements != np.iinfo(displacements.dtype).min
    # any(axis=1) takes 7 times as long.
    return colors[:, 3] > 0 if colors.shape[1] == 4 else (colors[:, 0] | colors[:, 1] | colors[:, 2]) != 0


def facet_cones(surface: PatchSurface) -> tuple[NDArray, NDArray]:
    """Return a cone around the facet normals of every patch.

    Every opaque cell has four facets, one at each corner, spanned by the two cell edges that meet there: whatever a
    cell is drawn as (two triangles, a bilinear quad), its normals lie between theirs.

    Returns
    -------
    axes : (p, 3) float64
        Unit, world space; zero where a patch has no opaque cell.
    cosines : (p,) float64
        Cosine of the largest angle between the axis and a facet's normal; -1 where there is no cell.
    """
    patch, i, j = surface.node_patches()
    m, n = surface.size[patch].T.astype(np.int64)
    opaque, d = surface.opaque, surface.displacements.astype(np.float64)
    first = np.flatnonzero((i < m - 1) & (j < n - 1))
    step = m[first]
    corners = np.stack([first, first + 1, first + step, first + step + 1])  # by bits: x, y
    whole = opaque[corners].all(axis=0)
    corners, k = corners[:, whole], patch[first[whole]]
    lx, ly = lengths_of(surface.axis_x), lengths_of(surface.axis_y)
    zx, zy = (surface.axis_z_length / lx)[k], (surface.axis_z_length / ly)[k]
    total = np.zeros((len(surface), 3))
    normals = []
    for c in range(4):
        dx = (d[corners[c | 1]] - d[corners[c & 2]]) * zx
        dy = (d[corners[c | 2]] - d[corners[c & 1]]) * zy
        normal = np.stack([-dx, -dy, np.ones_like(dx)], axis=1)
        normal /= lengths_of(normal, keepdims=True)
        normals.append(normal)
        for axis in range(3):
            total[:, axis] += np.bincount(k, normal[:, axis], len(surface))
    length = lengths_of(total)
    total /= np.maximum(length, 1e-300)[:, None]
    cosines = np.where(length > 0, 1.0, -1.0)
    for normal in normals:
        np.minimum.at(cosines, k, np.einsum("ij,ij->i", normal, total[k]))
    z = surface.axis_z.astype(np.float64)
    frames = np.stack([surface.axis_x / lx[:, None], surface.axis_y / ly[:, None],
                       z / lengths_of(z, keepdims=True)], axis=1)
    return np.einsum("pa,pax->px", total, frames), cosines
