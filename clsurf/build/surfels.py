"""Surfel hierarchies with normal maps from scans.

Source: Holst, Schumann, "Normal Mapping for Surfel-Based Rendering", Journal of WSCG 15, 2007.
"""

import os

import numpy as np

from ..device import open_device
from ..errors import Cancelled, DeviceMemoryError, InputError
from ..io import load
from ..surface.arrays import finite_rows, lengths_of, whole_faces
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.ranges import RangeScan
from ..surface.srgb import straight
from ..surface.surfel import SurfelHierarchy
from .slim import face_normals, parse_bytes, vertex_colors
from .surfel_bound import BOUND_SHARE, bounds_of
from .surfel_maps import LARGEST_MAP, draw_maps, light_of
from .surfel_points import base_surfels, unit
from .surfel_tree import Tree, cluster, discs_of

BYTES_PER_POINT = 400  # of a build's memory beyond the scan and the maps


def build_surfels(scan, spacing=None, map_size=16, hybrid=False, memory_limit=None, progress=None,
                  device=None) -> SurfelHierarchy:
    """Build a hierarchy of surfels with normal maps from a scan.

    Parameters
    ----------
    scan : Mesh, PointCloud, RangeScan, str or PathLike
        A path is read with `clsurf.load`. Normals are taken from the scan, computed from the faces, or estimated, in
        this order.
    spacing : float, optional
        World units between base surfels: denser points are averaged, faces are sampled. By default every point of a
        cloud is a base surfel, as is every vertex of a mesh, with more on large faces. Not for the hybrid form.
    map_size : int
        Texels along a side of an inner surfel's normal map, 1 to 64. At least half of the pixels that inner surfels
        may be wide (`SurfelDrawing.interior`) keeps features.
    hybrid : bool
        The finest level is the scan's own triangles in place of base surfels.
    memory_limit : int or str, optional
        Bytes that the build may take beyond the scan, such as "2GB".
    progress : callable, optional
        Called as progress(stage, done) with done from 0 to 1; returning False stops the build.
    device : None, str or Device

    Returns
    -------
    SurfelHierarchy
        `bound` holds for `bound_share` of the scan. The same input gives the same bytes on one device.

    Raises
    ------
    InputError
        No usable point, a file that cannot be read or holds no scan, an option out of range, or the hybrid form of
        something without faces.
    DeviceMemoryError
        More memory needed than the limit or the device allows.
    Cancelled
        `progress` returned False; nothing is left behind.
    """
    checked_options(spacing, map_size, hybrid)
    if isinstance(scan, str | os.PathLike):
        scan = load(scan)
    if isinstance(scan, RangeScan):
        scan = scan.to_points()
    if not isinstance(scan, Mesh | PointCloud):
        raise InputError("scan: expected a Mesh, a PointCloud, a RangeScan or the path of a scan, got "
                         f"{type(scan).__name__}")
    if hybrid and not (isinstance(scan, Mesh) and len(scan.faces)):
        raise InputError("hybrid: expected a mesh with faces, got none: leave hybrid out")
    device = open_device(device)

    def report(stage, done):
        if progress is not None and progress(stage, done) is False:
            raise Cancelled("build_surfels: stopped by the progress callback")

    check_room(scan, int(map_size), hybrid, memory_limit)
    report("points", 0.0)
    build = hybrid_parts if hybrid else pure_parts
    parts, inner = build(scan, spacing, device, report)
    report("maps", 0.0)
    atlas, color_atlas, map_offset, map_sizes = draw_maps(device, parts, inner, int(map_size),
                                                          lambda done: report("maps", done))
    for name in ("lights", "vertex_lights"):
        parts.pop(name, None)
    return SurfelHierarchy(**parts, map_offset=map_offset, map_size=map_sizes, normal_atlas=atlas,
                           color_atlas=color_atlas, origin=scan.origin)


def checked_options(spacing, map_size, hybrid) -> None:
    """Raise InputError where an option of `build_surfels` is out of range."""
    if not isinstance(map_size, int | np.integer) or isinstance(map_size, bool) or not 1 <= map_size <= LARGEST_MAP:
        raise InputError(f"map_size: expected a whole number of texels from 1 to {LARGEST_MAP}, got {map_size!r}")
    number = isinstance(spacing, int | float | np.number) and not isinstance(spacing, bool)
    if spacing is not None and not (number and 0 < spacing < np.inf):
        raise InputError(f"spacing: expected a positive length in world units, got {spacing!r}")
    if hybrid and spacing is not None:
        raise InputError("spacing: expected without hybrid only: the finest level is the mesh itself")


def check_room(scan, map_size: int, hybrid: bool, memory_limit) -> None:
    """Raise DeviceMemoryError where building takes more than the limit; a seventh as many inner surfels as elements."""
    count = len(scan.faces) if hybrid else len(scan.points)
    texel = 8 if vertex_colors(scan) is not None else 4
    needed = count * (BYTES_PER_POINT + texel * map_size**2 // 6)
    limit = parse_bytes(memory_limit)
    if limit is not None and needed > limit:
        raise DeviceMemoryError(f"memory_limit: the build of {count:,} {'faces' if hybrid else 'points'} with maps of "
                                f"{map_size} x {map_size} needs {needed / 1e6:.0f} MB, got {limit / 1e6:.0f} MB: raise "
                                "the limit, or give a larger spacing or smaller maps")


def pure_parts(scan, spacing, device, report) -> tuple[dict, int]:
    """Return the fields of the pure form but for its maps, and the number of inner surfels."""
    base = base_surfels(scan, spacing, device)
    report("points", 1.0)
    tree = cluster(base.positions, base.normals, lambda done: report("clusters", done))
    discs = discs_of(tree, base.positions, base.normals, base.radii, base.colors)
    inner, n = len(tree.start), len(base.positions)
    order = tree.order
    bound, largest = bounds_of(scan, base, device)
    join = lambda above, below: np.concatenate([above, below]).astype(np.float32)  # noqa: E731
    child_offset, children = tree_links(tree, n)
    lights = None if base.colors is None else join(discs.colors, base.colors[order])
    return dict(
        positions=join(discs.positions, base.positions[order]), normals=join(discs.normals, base.normals[order]),
        radii=join(discs.radii, base.radii[order]), spheres=join(widened(discs.spheres), base.radii[order]),
        heights=join(discs.heights, np.zeros(n)), spreads=join(discs.spreads, np.zeros(n)),
        level=np.concatenate([tree.level, np.full(n, tree.level.max() + 1)]), child_offset=child_offset,
        children=children, lights=lights, colors=None if lights is None else straight(lights.astype(np.float64)),
        spacing=base.spacing, bound=bound, bound_share=BOUND_SHARE, bound_all=largest), inner


def widened(spheres):
    """Return radii a little larger: float32 roundings of the positions stay inside."""
    return spheres * (1 + 1e-5)


def tree_links(tree: Tree, elements: int):
    """Return child_offset and children: those of a last cluster are its elements, numbered after the clusters."""
    inner = len(tree.start)
    last = tree.child_count == 0
    count = np.concatenate([np.where(last, tree.count, tree.child_count), np.zeros(elements, np.int64)])
    first = np.where(last, inner + tree.start, tree.child_start)
    child_offset = np.concatenate([[0], np.cumsum(count)])
    children = np.repeat(first - child_offset[:inner], count[:inner]) + np.arange(child_offset[-1])
    return child_offset.astype(np.int32), children.astype(np.int32)


def hybrid_parts(mesh: Mesh, spacing, device, report) -> tuple[dict, int]:
    """Return the fields of the hybrid form but for its maps, and the number of surfels."""
    finite = finite_rows(mesh.vertices)
    faces = mesh.faces[whole_faces(mesh.faces, finite)]
    corners = mesh.vertices.take(faces, 0).astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = lengths_of(cross)
    faces, corners, cross, length = (a[length > 0] for a in (faces, corners, cross, length))
    if not len(faces):
        raise InputError("scan: expected at least one face with an area, got none")
    middle = (corners.min(axis=1) + corners.max(axis=1)) / 2
    reach = lengths_of(corners - middle[:, None]).max(axis=1)
    facing = cross / length[:, None]
    normals = mesh.normals
    if normals is None or not np.isfinite(normals).all():
        normals = face_normals(mesh.vertices, faces)
    zero = lengths_of(normals) == 0
    normals = unit(np.where(zero[:, None], (0, 0, 1), normals))
    report("points", 1.0)
    tree = cluster(middle.astype(np.float32), facing.astype(np.float32), lambda done: report("clusters", done))
    vertex_lights = light_of(vertex_colors(mesh))
    face_lights = None if vertex_lights is None else vertex_lights[faces].mean(axis=1)
    discs = discs_of(tree, middle, facing, reach, face_lights)
    last = tree.child_count == 0
    child_count = np.where(last, 0, tree.child_count)
    child_offset = np.concatenate([[0], np.cumsum(child_count)])
    children = np.repeat(tree.child_start - child_offset[:-1], child_count) + np.arange(child_offset[-1])
    # The last clusters' triangles, in the order of the clusters.
    own = np.where(last, tree.count, 0)
    triangle_offset = np.concatenate([[0], np.cumsum(own)])
    at = np.repeat(tree.start - triangle_offset[:-1], own) + np.arange(triangle_offset[-1])
    edges = lengths_of(corners - np.roll(corners, 1, axis=1))
    return dict(
        positions=discs.positions, normals=discs.normals, radii=discs.radii, spheres=widened(discs.spheres),
        heights=discs.heights, spreads=discs.spreads, level=tree.level, child_offset=child_offset, children=children,
        lights=None if discs.colors is None else discs.colors.astype(np.float32), vertex_lights=vertex_lights,
        colors=None if discs.colors is None else straight(discs.colors),
        vertices=np.where(finite[:, None], mesh.vertices, 0), vertex_normals=normals,
        vertex_colors=vertex_colors(mesh), triangles=faces[tree.order[at]],
        triangle_offset=triangle_offset, spacing=float(np.median(edges)), bound=0.0, bound_share=1.0,
        bound_all=0.0), len(tree.start)
