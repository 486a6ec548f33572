"""Surfaces as evenly spread points."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..device import Device, open_device
from ..io.stored import StoredSurface
from ..surface.arrays import box_of
from ..surface.cloud import PointCloud
from ..surface.patch import PatchSurface
from ..surface.patch_mesh import patch_mesh
from ..surface.placed import Placed
from ..surface.slim import SlimSurface
from ..surface.surfel import SurfelHierarchy
from .place_colors import colors_at
from .places import check_surface, checked_spacing, drawn_at, in_memory, oriented, spacing_of
from .project import project
from .sparse_grid import CHUNK, NearCells, coordinates, near_cells, reporter

MOST_CELLS = 2.56e8  # of a spacing that was asked for: 11 million points
DEFAULT_CELLS = 3.2e7  # of one that is chosen here
FINER = 2  # cells along a spacing: the middle of each gives one place to choose from
FIRST = 8  # one place of so many is looked at first
REACH = 0.9  # middles further than this from the surface (cells) are not in a cell that it crosses


def to_points(surface, spacing=None, progress=None, device=None) -> PointCloud:
    """Return points evenly spread over a surface, on it, about `spacing` apart.

    No two points that face the same side are nearer to each other than `spacing`; no place of the surface is further
    than two spacings from a point, at most places no more than one. A wall thinner than `spacing` has points on both
    of its sides; those of an unoriented surface keep the distance from all.

    Parameters
    ----------
    surface : SlimSurface, StoredSurface, PatchSurface, SurfelHierarchy, ScaleMap, Mesh or Placed
        Of SLIM surfaces and hierarchies the blended leaves as far as they are drawn, of patches and scale maps the
        triangles between their nodes.
    spacing : float, optional
        World units; by default that of `to_mesh`, for patches, scale maps and meshes the edge of a triangle of mean
        area, and larger where that makes more than about 1.4 million points.
    progress : callable, optional
        Called as progress(stage, done) with done from 0 to 1; returning False stops the work.
    device : None, str or Device

    Returns
    -------
    PointCloud
        With the surface's normals, and its colours where it has any. The same input gives the same points on one
        device.

    Raises
    ------
    InputError
        A scan of points (`build_slim` makes a surface of it), a surface without leaves or faces, a spacing that is no
        length or that makes more than about 11 million points.
    DeviceMemoryError
    Cancelled
        `progress` returned False.
    """
    spacing = checked_spacing(spacing)
    if isinstance(surface, Placed):
        part = to_points(surface.surface, None if spacing is None else spacing / surface.scale, progress, device)
        linear = surface.matrix[:3, :3]
        return PointCloud((part.points @ linear.T).astype(np.float32),
                          (part.normals @ linear.T / surface.scale).astype(np.float32), part.colors,
                          origin=linear @ part.origin + surface.matrix[:3, 3])
    check_surface(surface)
    surface = in_memory(surface)
    if isinstance(surface, PatchSurface):
        surface = patch_mesh(surface)
    device, report = open_device(device), reporter("to_points", progress)
    chosen = spacing is None
    near = near_cells(surface, (spacing_of(surface) if chosen else spacing) / FINER, device, report,
                      DEFAULT_CELLS if chosen else MOST_CELLS, coarser=chosen)
    positions, normals = _spread(surface, near, device, report)
    origin = surface.bounds.mean(axis=0) if isinstance(surface, StoredSurface) else getattr(
        surface, "origin", getattr(surface, "center", None))
    colors = colors_at(surface, positions, normals, device)
    report("points", 1.0)
    return PointCloud((positions - origin).astype(np.float32), normals.astype(np.float32), colors, origin=origin)


def _spread(surface, near: NearCells, device: Device, report) -> tuple[NDArray, NDArray]:
    """Return world positions and normals (n, 3) float64 of points, chosen part by part along the cells' curve."""
    spacing, sided = FINER * near.spacing, oriented(surface)
    rows = CHUNK // 8
    parts = []  # box, positions and normals of what each part chose
    for start in range(0, len(near.parents), rows):
        report("points", start / len(near.parents))
        place, normal = _places(surface, near, slice(start, start + rows), device)
        if not len(place):
            continue
        low, high = box_of(place)
        low, high = low - spacing, high + spacing
        near_by = [part[1:] for part in parts if (part[0][0] <= high).all() and (part[0][1] >= low).all()]
        taken, taken_normals = _joined(near_by)
        beside = ((taken >= low) & (taken <= high)).all(axis=1)
        sides = (normal, taken_normals[beside]) if sided else (np.zeros_like(normal), np.zeros((beside.sum(), 3)))
        chosen = spread_out(place, sides[0], spacing, taken[beside], sides[1])
        if len(chosen):
            parts.append((box_of(place[chosen]), place[chosen], normal[chosen]))
    return _joined([part[1:] for part in parts])


def _joined(parts) -> tuple[NDArray, NDArray]:
    empty = np.zeros((0, 3))
    return tuple(np.concatenate([empty, *(part[k] for part in parts)]) for k in (0, 1))


def _places(surface, near: NearCells, rows: slice, device: Device) -> tuple[NDArray, NDArray]:
    """Return places on the surface and normals (n, 3) float64: one for each cell of `rows` that it may cross."""
    middles = (coordinates(near.cells(rows)) + 0.5) * near.spacing + near.low
    found = project(surface, middles, device)
    kept = np.flatnonzero(np.abs(found.distance) <= REACH * near.spacing)
    place, normal = found.position[kept], found.normal[kept]
    if isinstance(surface, SlimSurface | StoredSurface) or (isinstance(surface, SurfelHierarchy) and
                                                            not surface.hybrid):
        drawn = drawn_at(surface, place, normal, near.spacing / 2, device)
        place, normal = place[drawn], normal[drawn]
    return place, normal


def spread_out(places: NDArray, sides: NDArray, spacing: float, taken: NDArray, taken_sides: NDArray) -> NDArray:
    """Choose places so that no two, nor one and a taken one, are nearer than `spacing`, and no more can be added.

    Parameters
    ----------
    places, sides : (n, 3) float64
        Places whose `sides`, normals, are more than a right angle apart need not keep apart. Zeros: all of them do.
    taken, taken_sides : (m, 3) float64
        Places chosen before.

    Returns
    -------
    (k,) int64
        Ascending.
    """
    order = np.random.default_rng(0).permutation(len(places))
    # Of an eighth of them first, which leave few of the others: a third of the time of all pairs at once.
    chosen = np.zeros(0, np.int64)
    for some in (order[::FIRST], np.delete(order, slice(None, None, FIRST))):
        some = some[_free(places[some], sides[some], spacing, taken, taken_sides)]
        some = some[_first_of_pairs(places[some], sides[some], spacing)]
        chosen = np.append(chosen, some)
        taken, taken_sides = np.concatenate([taken, places[some]]), np.concatenate([taken_sides, sides[some]])
    return np.sort(chosen)


def _alike(one: NDArray, other: NDArray) -> NDArray:
    return np.einsum("ij,ij->i", one, other) >= 0


def _free(places, sides, spacing, taken, taken_sides) -> NDArray:
    """Return the numbers of places that no taken one on their side is nearer to than `spacing`."""
    if not len(taken) or not len(places):
        return np.arange(len(places))
    tree = cKDTree(taken)
    away, at = tree.query(places, distance_upper_bound=spacing)
    near = np.flatnonzero(away < spacing)
    free = np.ones(len(places), bool)
    free[near] = ~_alike(sides[near], taken_sides[at[near]])
    # Where the nearest is on the other side, a further one may still be on this.
    some = near[free[near]]
    if len(some):
        pairs = cKDTree(places[some]).sparse_distance_matrix(tree, spacing, output_type="ndarray")
        pairs = pairs[pairs["v"] < spacing]
        free[some[pairs["i"][_alike(sides[some[pairs["i"]]], taken_sides[pairs["j"]])]]] = False
    return np.flatnonzero(free)


def _first_of_pairs(places, sides, spacing) -> NDArray:
    """Return the numbers of places chosen one after the other, each that is not too near to one before."""
    pairs = np.sort(cKDTree(places).query_pairs(spacing * (1 - 1e-12), output_type="ndarray"), axis=1)
    pairs = pairs[_alike(sides[pairs[:, 0]], sides[pairs[:, 1]])]
    left, chosen = np.ones(len(places), bool), np.zeros(len(places), bool)
    while left.any():
        later = np.zeros(len(places), bool)
        later[pairs[:, 1]] = True  # one that is left goes before it
        now = left & ~later
        chosen |= now
        left &= ~now
        left[pairs[now[pairs[:, 0]], 1]] = False
        pairs = pairs[left[pairs].all(axis=1)]
    return np.flatnonzero(chosen)
