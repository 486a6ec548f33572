"""Surfaces as triangle meshes: for programs that know meshes only, and for printing."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from ..device import Device, open_device
from ..errors import InputError
from ..io.stored import StoredSurface
from ..surface.arrays import lengths_of, used_numbers
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.patch_mesh import patch_mesh
from ..surface.placed import Placed
from ..surface.scale_map import ScaleMap
from ..surface.scale_mesh import scale_mesh
from ..surface.surfel import SurfelHierarchy
from .marching import marching_cubes
from .place_colors import colors_at
from .places import check_surface, checked_spacing, drawn_at, in_memory, oriented, spacing_of
from .project import project
from .sides import with_sides
from .sparse_grid import CHUNK, SparseGrid, distances, near_cells, projected, reporter, stepped

MOST_CELLS = 1.6e7  # of a spacing that was asked for: 6 million vertices, 3 GB
DEFAULT_CELLS = 8e6  # of one that is chosen here: 2 GB
# All lengths in spacings.
LONGEST = 1.5  # of the two distances at a crossed edge: 1 where a flat surface crosses it
SHARE = 0.1  # an edge is crossed this far from its ends at least: no needles, and the projection puts it right
FARTHEST = 0.9  # a vertex may be moved onto the surface
BESIDE = 0.1  # a foot may be off the normal through the vertex: more, and the surface ends before it
BISECTIONS = 4  # of a border's vertices towards the surface: to a sixteenth
LEAST = 0.3  # of the way out is left: triangles keep some area
SPECK = 12  # faces of an enclosed hole that is none, and of a fragment that is left out


def to_mesh(surface, spacing=None, progress=None, device=None) -> Mesh:
    """Return a surface as a triangle mesh.

    SLIM surfaces, in memory or in their store, and surfel hierarchies without triangles: marching cubes of the blended
    surface on a grid of edge `spacing` that has cells near the surface only, the vertices projected onto it. The mesh
    of a closed surface is closed; open ones end where they are drawn to end. Sheets nearer to each other than a spacing
    or two are kept apart, but where no node of the grid lies between them, a thin wall has holes: take a smaller
    spacing. Holes of the surface smaller than a spacing or two close. The sides of an unoriented surface (.slim2t of
    negative degree) are found first.

    Spatial patches become their nodes, two triangles a cell (overlaps overlap), scale maps their texels, hybrid surfel
    hierarchies their mesh; a mesh stays as it is.

    Parameters
    ----------
    surface : SlimSurface, StoredSurface, PatchSurface, SurfelHierarchy, ScaleMap, Mesh or Placed
    spacing : float, optional
        World units: edge of the grid's cells, about the length of the triangles' edges. By default a quarter of the
        median radius of the leaves, of hierarchies `surface.spacing`, or larger where the mesh would have more than
        about 3 million vertices (2 GB). Patches, scale maps and meshes have their own and ignore it.
    progress : callable, optional
        Called as progress(stage, done) with done from 0 to 1; returning False stops the work.
    device : None, str or Device

    Returns
    -------
    Mesh
        Faces counter-clockwise seen from the side that the normals point to, normals of the surface itself, its colours
        where it has any. The same input gives the same mesh on one device.

    Raises
    ------
    InputError
        A scan of points (`build_slim` makes a surface of it), a surface without leaves, a spacing that is no length,
        makes more than about 6 million vertices (3 GB), or is as large as the surface.
    DeviceMemoryError
    Cancelled
        `progress` returned False.
    """
    spacing = checked_spacing(spacing)
    if isinstance(surface, Placed):
        part = to_mesh(surface.surface, None if spacing is None else spacing / surface.scale, progress, device)
        return placed_mesh(part, surface)
    if isinstance(surface, Mesh):
        return surface
    if isinstance(surface, PatchSurface):
        return patch_mesh(surface)
    if isinstance(surface, ScaleMap):
        return scale_mesh(surface)
    if isinstance(surface, SurfelHierarchy) and surface.hybrid:
        return surface.mesh
    check_surface(surface)
    surface = in_memory(surface)
    device = open_device(device)
    if not oriented(surface):
        if isinstance(surface, StoredSurface):
            raise InputError("surface: expected normals with a side, or a budget that holds it whole, got an "
                             "unoriented surface in its store: to_points takes it")
        surface = with_sides(surface, device)
    return _marched(surface, spacing, device, reporter("to_mesh", progress))


def placed_mesh(mesh: Mesh, at: Placed) -> Mesh:
    """Return a mesh moved as `at` is."""
    linear = at.matrix[:3, :3]
    normals = None if mesh.normals is None else (mesh.normals @ linear.T / at.scale).astype(np.float32)
    return Mesh((mesh.vertices @ linear.T).astype(np.float32), mesh.faces, normals, mesh.colors, mesh.uv, mesh.texture,
                linear @ mesh.origin + at.matrix[:3, 3], mesh.attributes)


@dataclass(eq=False)
class _Vertices:
    """Where edges of the grid cross the surface."""

    place: NDArray  # (v, 3) float64 world: on the edges
    position: NDArray  # (v, 3) float64 world: projected
    normal: NDArray  # (v, 3) float64
    inside: NDArray  # (v,) bool: the surface is there, not beyond its border
    near: NDArray  # (v,) bool: it was found where the grid said


def _marched(surface, spacing: float | None, device: Device, report) -> Mesh:
    """Return the mesh of a surface of blended leaves or discs."""
    chosen = spacing is None
    grid = near_cells(surface, spacing_of(surface) if chosen else spacing, device, report,
                      DEFAULT_CELLS if chosen else MOST_CELLS, coarser=chosen).grid()
    away = distances(surface, grid.low, grid.spacing, grid.nodes, device, report, "distances")
    report("triangles", 0.0)
    faces, edges = _numbered(marching_cubes(grid, away))
    ends, share = _crossings(grid, away, edges)
    found = _on_surface(surface, grid, ends, share, device, report)
    found.near &= np.abs(away[ends]).sum(axis=1) <= LONGEST * grid.spacing
    faces = _kept(faces, found)
    _drawn_in(surface, faces, found, grid.spacing, device)
    if not len(faces):
        raise InputError(f"spacing: expected a smaller one for a surface from {_corner(surface, 0)} to "
                         f"{_corner(surface, 1)}, of which no triangle is left at {grid.spacing:.4g}")
    used, faces = _used(faces, len(edges))
    origin = surface.bounds.mean(axis=0) if isinstance(surface, StoredSurface) else surface.origin
    position, normal = found.position[used], found.normal[used]
    colors = colors_at(surface, position, normal, device)
    report("triangles", 1.0)
    return Mesh((position - origin).astype(np.float32), faces, normal.astype(np.float32), colors, origin=origin)


def _corner(surface, which: int) -> str:
    return "(" + ", ".join(f"{value:.10g}" for value in surface.bounds[which]) + ")"


def _numbered(faces: NDArray) -> tuple[NDArray, NDArray]:
    """Return faces (f, 3) as numbers of the edges that they use, and those edges (v,), ascending."""
    edges = np.sort(faces.ravel())
    edges = edges[np.append(True, edges[1:] != edges[:-1])] if len(edges) else edges
    return np.searchsorted(edges, faces), edges


def _crossings(grid: SparseGrid, away: NDArray, edges: NDArray) -> tuple[NDArray, NDArray]:
    """Return the nodes (v, 2) at the ends of edges, and where (v,) between them the distances are 0."""
    low, axis = edges // 3, edges % 3
    high = np.empty_like(low)
    for k in range(3):
        high[axis == k] = grid.find(stepped(grid.nodes[low[axis == k]], k))
    ends = np.stack([low, high], axis=1)
    a, b = away[ends].T.astype(np.float64)
    return ends, np.clip(a / np.where(a == b, 1, a - b), SHARE, 1 - SHARE)


def _on_surface(surface, grid: SparseGrid, ends, share, device: Device, report) -> _Vertices:
    a, b = (grid.positions(grid.nodes[ends[:, k]]) for k in (0, 1))
    place = a + share[:, None] * (b - a)
    found = _Vertices(place, np.empty_like(place), np.empty_like(place), *np.zeros((2, len(place)), bool))
    for rows, near in projected(surface, place, device, report, "vertices"):
        found.position[rows], found.normal[rows] = near.position, near.normal
        moved = near.position - place[rows]
        beside = lengths_of(moved - (moved * near.normal).sum(axis=1, keepdims=True) * near.normal)
        found.near[rows] = lengths_of(moved) <= FARTHEST * grid.spacing
        found.inside[rows] = ((beside <= BESIDE * grid.spacing) &
                              drawn_at(surface, near.position, near.normal, grid.spacing / 2, device))
    return found


def _kept(faces: NDArray, found: _Vertices) -> NDArray:
    """Return the faces that lie on the surface: not beyond its border, nor between two sheets of it."""
    # Half way between two sheets that face the same side the sign changes too, the wrong way round.
    on = (_rise(found.place, found.normal, faces) > 0) & found.near[faces].all(axis=1) & found.inside[faces].any(axis=1)
    on |= _enclosed(faces, ~on)
    return _without_specks(faces[on])


def _drawn_in(surface, faces: NDArray, found: _Vertices, spacing: float, device: Device) -> None:
    """Move the vertices beyond the border to where the surface ends, each towards its neighbours on the surface."""
    one, other = _beyond_border(faces, found.inside)
    rim, at = np.unique(one, return_inverse=True)
    if not len(rim):
        return
    place, normal = (np.stack([np.bincount(at, array[other, k]) for k in range(3)], axis=1) /
                     np.bincount(at)[:, None] for array in (found.position, found.normal))
    way, turn = found.position[rim] - place, found.normal[rim] - normal
    low, high = np.full(len(rim), LEAST), np.ones(len(rim))
    for _ in range(BISECTIONS):
        share = (low + high) / 2
        there = normal + share[:, None] * turn
        there /= np.maximum(lengths_of(there, keepdims=True), 1e-300)
        drawn = drawn_at(surface, place + share[:, None] * way, there, spacing / 2, device)
        low, high = np.where(drawn, share, low), np.where(drawn, high, share)
    near = project(surface, place + low[:, None] * way, device)
    _move(faces, found, rim, near.position, near.normal)


def _beyond_border(faces: NDArray, inside: NDArray) -> tuple[NDArray, NDArray]:
    """Return pairs (k,), (k,) of vertices that share an edge: one beyond the border, and one on the surface."""
    some = faces[~inside[faces].all(axis=1)]
    first, second = some.ravel(), np.roll(some, -1, axis=1).ravel()
    # Vertices that are not drawn lie at creases too, amid faces: only those at edges of a single face are moved.
    key = np.minimum(first, second) * len(inside) + np.maximum(first, second)
    _, index, count = np.unique(key, return_index=True, return_counts=True)
    open_edges = index[count == 1]
    at_border = np.zeros(len(inside), bool)
    at_border[first[open_edges]] = at_border[second[open_edges]] = True
    one, other = np.append(first, second), np.append(second, first)
    pairs = ~inside[one] & at_border[one] & inside[other]
    return one[pairs], other[pairs]


def _move(faces: NDArray, found: _Vertices, some: NDArray, positions: NDArray, normals: NDArray) -> None:
    """Move some vertices, except where a face would turn over by it: two of 154,388 on an indoor scan."""
    before = found.position[some].copy(), found.normal[some].copy()
    found.position[some], found.normal[some] = positions, normals
    moved = np.zeros(len(found.inside), bool)
    moved[some] = True
    while moved.any():
        touched = faces[moved[faces].any(axis=1)]
        back = np.zeros(len(moved), bool)
        back[touched[_rise(found.position, found.normal, touched) <= 0]] = True
        back &= moved
        if not back.any():
            return
        found.position[some[back[some]]], found.normal[some[back[some]]] = (array[back[some]] for array in before)
        moved &= ~back


def _rise(positions: NDArray, normals: NDArray, faces: NDArray) -> NDArray:
    """Return above 0 for faces (f,) that look the way that the normals (v, 3) of their corners do."""
    out = np.empty(len(faces))
    for start in range(0, len(faces), CHUNK):
        some = faces[start:start + CHUNK]
        a, b, c = (positions[some[:, k]] for k in range(3))
        out[start:start + CHUNK] = np.einsum("ij,ij->i", np.cross(b - a, c - a), normals[some].sum(axis=1))
    return out


def _components(faces: NDArray, chosen: NDArray) -> tuple[int, NDArray, NDArray, NDArray]:
    """Return the number of connected parts (k) of chosen faces, each face's part (f,), and of the parts how many open
    edges they have (k,), and whether they border on faces that are not chosen (k,) bool.

    Faces are connected by common edges; an edge is open that has one face among all.
    """
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    key = edges[:, 0] * (int(faces.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = key[order[1:]] == key[order[:-1]]
    one, other = order[:-1][same] // 3, order[1:][same] // 3
    single = np.ones(len(key), bool)
    single[order[1:][same]] = single[order[:-1][same]] = False
    both = chosen[one] & chosen[other]
    graph = sparse.coo_matrix((np.ones(int(both.sum()), bool), (one[both], other[both])), (len(faces), len(faces)))
    count, part = csgraph.connected_components(graph, directed=False)
    borders = np.zeros(count, bool)
    borders[part[np.concatenate([one[~both], other[~both]])]] = True
    return count, part, np.bincount(part, single.reshape(-1, 3).sum(axis=1), count), borders


def _enclosed(faces: NDArray, off: NDArray) -> NDArray:
    """Return which of the faces `off` the surface are small patches amid ones that are on it: no hole, but a crease."""
    out, touched = np.zeros(len(faces), bool), np.zeros(int(faces.max(initial=-1)) + 1, bool)
    touched[faces[off]] = True
    some = np.flatnonzero(touched[faces].any(axis=1))  # they and their neighbours
    count, part, rim, borders = _components(faces[some], off[some])
    small = (np.bincount(part, off[some], count) <= SPECK) & (rim == 0) & borders
    out[some] = off[some] & small[part]
    return out


def _without_specks(faces: NDArray) -> NDArray:
    """Return the faces without open fragments of a few."""
    if not len(faces):
        return faces
    count, part, rim, _ = _components(faces, np.ones(len(faces), bool))
    return faces[((np.bincount(part, minlength=count) > SPECK) | (rim == 0))[part]]


def _used(faces: NDArray, count: int) -> tuple[NDArray, NDArray]:
    """Return the vertices that faces use, and the faces in their numbers."""
    used, number = used_numbers(faces, count), np.empty(count, np.int32)
    number[used] = np.arange(len(used))
    return used, number[faces]
