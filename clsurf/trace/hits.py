"""Rays against surfaces: where they hit. The public function `trace`.

The tree and the kernels: clsurf/trace/tree.py, kernels/trace. What can be traced: clsurf/trace/kinds.py.
"""

import contextlib

import numpy as np
from numpy.typing import NDArray

from ..device import Device, open_device
from ..errors import Cancelled, DeviceMemoryError, InputError
from ..io.stored import StoredSurface
from ..surface.placed import Placed
from . import ray_scale_map, ray_slim, ray_surfels, ray_triangles  # noqa: F401  they register their kinds
from .grids import grid_of, grid_view, trace_grid
from .pieces import held
from .rays import Hits, Rays, checked_rays
from .single import has_doubles, placement
from .split import trace_pieces
from .stored import merged, trace_stored
from .tracers import QUERIES, new_tracer


def trace(thing, origins, directions, query: str = "closest", near=0.0, far=np.inf, device=None,
          progress=None) -> Hits:
    """Return where rays hit a surface, a mesh, or the surfaces of a scene.

    A SLIM surface is hit where the renderer draws it without level of detail: frontmost surfels, blended. A mesh and
    the cells of spatial patches (two triangles each; cells with a transparent node are no obstacle) are hit without
    leaks along edges and at vertices. Of a surfel hierarchy the finest level is hit: base surfels, blended, or
    triangles.

    Parameters
    ----------
    thing : SlimSurface, StoredSurface, PatchSurface, SurfelHierarchy, ScaleMap, Mesh, a placed one, a Scene, or a list
        Of a StoredSurface the parts on the rays' way are read, within its budget.
    origins, directions : (..., 3) array_like
        World space, float64; broadcast against each other. Directions need not be unit; a ray whose direction is zero
        or whose numbers are not finite misses.
    query : str
        "closest"; "any": some hit, not always the nearest, and not blended, which is faster; "all": where spatial
        patches overlap, each of them is hit.
    near, far : float or (...) array_like
        Hits are looked for between these distances (world units), `near` itself left out: for rays that start on the
        surface. Rays that start at a hit of SLIM surfels, discs or patches meet their neighbours there: start them
        1/20 of a median radius (of patches: of a node's spacing) up `Hits.normal`, with `near` half of it.
    device : None, str or Device
    progress : function, optional
        ``progress(stage, share done)``; False stops the work.

    Returns
    -------
    Hits

    Raises
    ------
    InputError
        Something that cannot be traced, another query, arrays of the wrong shape or limits that are not numbers.
    DeviceMemoryError
    """
    if query not in QUERIES:
        raise InputError(f"query: expected one of {', '.join(QUERIES)}, got {query!r}")
    opened = open_device(device)
    rays = checked_rays(origins, directions, near, far)
    parts = [(number, *part) for number, part in enumerate(parts_of(thing))]
    if any(isinstance(surface, StoredSurface) for _, surface, _ in parts):
        return _with_stored(parts, rays, query, opened)
    # All surfaces are refused before the first ray.
    parts = [part for part in parts if not held(opened, part[1]).empty]
    if all(held(opened, surface).whole is not None for _, surface, _ in parts):
        with contextlib.suppress(DeviceMemoryError):  # then in parts, one surface after the other
            return _at_once(opened, rays, parts, query, progress)
    return trace_pieces(opened, rays, parts, query, progress)


def _at_once(device: Device, rays: Rays, parts: list, query: str, progress) -> Hits:
    """Trace surfaces (number, surface, matrix) all of which are on the device."""
    wholes = [(number, held(device, surface).whole, matrix) for number, surface, matrix in parts]
    parts = [(number, whole, placement(whole, matrix), matrix) for number, whole, matrix in wholes]
    tracer = new_tracer(device, rays, query)
    grid = ([], [part[:3] for part in parts]) if query == "all" else picture_parts(device, rays, parts, tracer.slab)
    by_packets, parts = grid
    for _, whole, _ in parts:
        whole.ready()
    for start in range(0, rays.count, tracer.slab):
        stop = min(start + tracer.slab, rays.count)
        tracer.open(start, stop, empty=not parts and not by_packets)
        for i, (number, hits, place) in enumerate(by_packets):
            tracer.merge(number, place, hits, start, stop - start, fresh=i == 0)
        for first in range(start, stop, tracer.chunk):
            for i, (number, whole, place) in enumerate(parts):
                tracer.run(number, whole, place, first, min(tracer.chunk, stop - first),
                           fresh=i == 0 and not by_packets)
            if progress is not None and progress("trace", min(first + tracer.chunk, stop) / rays.count) is False:
                raise Cancelled("trace: stopped")
        tracer.close(start, stop)
    return tracer.result()


def _with_stored(parts: list, rays: Rays, query: str, device: Device) -> Hits:
    """Trace surfaces of which some stay in their store: those one by one, all others together."""
    others = [(number, surface if matrix is None else Placed(surface, matrix)) for number, surface, matrix in parts
              if not isinstance(surface, StoredSurface)]
    hits, numbers = [], []
    for number, surface, matrix in parts:
        if isinstance(surface, StoredSurface):
            hits.append(trace_stored(surface, matrix, rays, query, device))
            numbers.append([number])
    if others:
        flat = [np.broadcast_to(array, (rays.count, *array.shape[1:])) for array in
                (rays.origins, rays.directions, rays.near, rays.far)]
        hits.append(trace([surface for _, surface in others], *flat[:2], query, *flat[2:], device))
        numbers.append([number for number, _ in others])
    return merged(hits, numbers, rays, query)


def picture_parts(device: Device, rays: Rays, parts: list, slab: int) -> tuple[list, list]:
    """Trace the parts that packets can, where the rays are those of a picture; return their hits, and other parts."""
    few = [part for part in parts if part[1].packets is not None] if rays.count <= slab and has_doubles(device) else []
    grid = grid_of(device, rays) if few else None
    done, left = [], []
    for number, whole, place, matrix in parts:
        view = grid_view(grid, whole, matrix) if grid is not None and whole.packets is not None else None
        if view is None:
            left.append((number, whole, place))
        else:
            done.append((number, trace_grid(device, grid, whole, view), place))
    return done, left


def parts_of(thing) -> list[tuple[object, NDArray | None]]:
    """Return (surface, matrix model to world or None) of each surface of a scene, a list, or a single surface."""
    if hasattr(thing, "placed"):  # a scene, which lives a layer above
        return list(thing.placed)
    if isinstance(thing, list | tuple):
        return [part for one in thing for part in parts_of(one)]
    if hasattr(thing, "matrix") and hasattr(thing, "surface"):
        return [(thing.surface, thing.matrix)]
    return [(thing, None)]
