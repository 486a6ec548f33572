"""Spatial patches from triangle meshes: areas of the mesh, a frame around each, its faces resampled onto the nodes.

Source: the paper on spatial patches, section 4.1.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..io.cleaning import first_of_duplicates
from ..surface.arrays import extent_of, finite_rows, lengths_of, used_numbers, whole_faces
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from .patch_edges import ALONG
from .patch_error import bound_of_all, patch_distances
from .patch_limits import check_patches, check_spacing, least_width, most_of_mesh
from .patch_strips import cells_beside, cut_graph, fitting_strips, joined, strip_faces, strip_frames
from .quantize import quantized
from .resample import REACH, FaceLists, Frames, area_lists, has_colors, resample_faces
from .segments import FaceGraph, face_graph, partition, split_faces, sums

NODES_A_VERTEX = 441_014 / 34_834  # of the paper's bunny (Table 1): the mesh's own resolution
DEFAULT_NODES = 60 * 289  # at least: a cylinder of 66 vertices had teeth along its rims with 6 patches
ANGLES = 12  # within 90 degrees, that rectangles around areas are tried at
UNFILLED = 1.3  # spacing over that of patches that areas fill whole; areas fill 0.6 of them
LONGEST_EDGE = 0.5  # of a patch's width: larger faces are cut, so that areas can end within them
WIDEST = 0.95  # of what a patch spans: widths along segments.DIRECTIONS fall short of those of the rectangle
BOUND_SHARE = 0.999  # of the mesh's vertices lie within `bound` of the patches
BOUND_SAMPLES = 1 << 16
SEARCH_STEPS = 8
BEST_ORDER = 3.0  # power of the spacing that errors never fall faster than; 1.5 to 2 are usual
FAR = 25.0  # times the last spacing: a search leaps to what is further away


@dataclass(frozen=True)
class Conversion:
    """Patches of a mesh, and the area that every face went into."""

    surface: PatchSurface
    graph: FaceGraph
    owner: NDArray  # (f,) int64
    beside: FaceLists  # faces of the strips along sharp edges, which are the last patches


def convert(mesh: Mesh, request, device, progress) -> PatchSurface:
    """Return the patches of a mesh: exactly `request.patches`, or of `request.spacing`, or as good as `request.error`.

    With none of them the number of nodes goes with that of vertices, as in the paper's Table 1, `DEFAULT_NODES` at
    least; more patches are made where cones, creases and separate parts of the mesh ask for them. The strips along
    sharp edges count as patches.

    Raises
    ------
    InputError
        A mesh without usable faces or without extent, or a request that cannot be met.
    """
    usable = whole_faces(mesh.faces, finite_rows(mesh.vertices))
    if not usable.any():
        raise InputError("scan: expected a mesh with faces, got none with finite corners: points need method='local'")
    if not usable.all():
        mesh = _with_faces(mesh, mesh.faces[usable], np.flatnonzero(usable))
        finite = finite_rows(mesh.vertices)  # the others have no face any more
        mesh = replace(mesh, vertices=np.where(finite[:, None], mesh.vertices, mesh.vertices[mesh.faces[0, 0]]))
    used = mesh.vertices.take(mesh.faces.ravel(), 0)
    diagonal = float(np.linalg.norm(extent_of(used).astype(np.float64)))
    if not diagonal > 0:
        raise InputError("scan: expected a mesh with some extent, got all corners at one place")
    spans, most = _spans(request.nodes), most_of_mesh(len(mesh.faces), request.nodes)
    least, widest = least_width(mesh.vertices, mesh.faces, most) / spans.min(), diagonal / spans.min()
    if request.error is not None:
        found = _searched(mesh, request, device, progress, (least, widest), diagonal)
    else:
        if request.patches:
            check_patches(request.patches, most, f"a mesh of {len(mesh.faces):,} faces")
        if request.spacing:
            check_spacing(request.spacing, least, f"a mesh of {len(mesh.faces):,} faces")
            request = replace(request, spacing=min(request.spacing, widest))  # one patch spans all then
        found = converted(mesh, request, device, progress)
    return _with_bound(found, diagonal)


def _spans(nodes) -> NDArray:
    """Return how many node steps (2,) an area may extend along a patch's axes."""
    return np.asarray(nodes) - 1 - 2 * (REACH - 1)


def converted(mesh: Mesh, request, device, progress) -> Conversion:
    """Convert `mesh` with a number of patches or a spacing given, or neither."""
    m, n = request.nodes
    spans = _spans(request.nodes)
    area = _doubled_areas(mesh).sum() / 2
    count = request.patches or max(1, round(max(len(mesh.vertices) * NODES_A_VERTEX, DEFAULT_NODES) / (m * n)))
    extent = extent_of(mesh.vertices.take(mesh.faces.ravel(), 0)).max()  # of a needle: its area says little
    width = request.spacing * spans.min() if request.spacing else max(math.sqrt(area / count), extent / (8 * count))
    if request.spacing:
        count = max(1, int(area / width ** 2))
    progress(0.0, "areas")
    least = least_width(mesh.vertices, mesh.faces, most_of_mesh(len(mesh.faces), request.nodes))
    mesh, corners, vertices = _prepared(mesh, LONGEST_EDGE * max(width, least) if width > 0 else np.inf)
    graph = face_graph(vertices, corners)
    if request.patches:
        _check_count(graph, request.patches)
    strips = fitting_strips(graph, request.nodes, request.spacing or UNFILLED * width / spans.min(),
                            None if request.spacing else count, 1.0 if has_colors(mesh) else ALONG)
    marked = np.zeros(len(graph.vertices), bool)
    marked[strips.edges.ends] = True
    graph = cut_graph(graph, strips) if len(strips) else graph
    widest = WIDEST * width if request.spacing else np.inf
    count = 1 if request.spacing else max(1, count - len(strips))
    owner, count = partition(graph, count, widest, exact=bool(request.patches), step=lambda: progress(0.5, "areas"),
                             fits=_fitting(graph, spans, request.spacing) if request.spacing else None)
    frames, owner = framed(graph, owner, count, request.nodes, request.spacing)
    progress(0.0, "nodes")
    lists = area_lists(owner, len(frames), graph.corners)
    along = strip_frames(strips, cells_beside(strips, frames, owner), request.nodes)
    under = strip_faces(graph, strips, along)
    frames, lists = joined(frames, lists, along, under)
    cut = np.zeros(len(mesh.vertices), np.uint8)
    cut[mesh.faces[marked[corners]]] = 1
    heights, colors, _ = resample_faces(device, mesh, frames, lists, request.precise, cut=cut)
    surface = quantized(frames.origins, frames.axis_x, frames.axis_y, heights, frames.size, colors, request.precise,
                        origin=mesh.origin)
    progress(1.0, "nodes")
    return Conversion(surface, graph, owner, under)


def _check_count(graph: FaceGraph, patches: int) -> None:
    parts = graph.components[0]
    if not parts <= patches <= len(graph):
        raise InputError(f"patches: expected from {parts:,} (the separate parts of the mesh) to {len(graph):,} (its "
                         f"faces), got {patches:,}")


# The mesh -----------------------------------------------------------------------------------------------------------


def _prepared(mesh: Mesh, longest: float) -> tuple[Mesh, NDArray, NDArray]:
    """Return the mesh with long edges cut, its faces over welded vertices, and these in float64."""
    v = mesh.vertices.astype(np.float64)
    edge = v.take(mesh.faces, 0) - v.take(mesh.faces[:, [1, 2, 0]], 0)
    if np.einsum("fij,fij->fi", edge, edge).max() > longest ** 2:
        faces, ends, source = split_faces(mesh.faces, v, longest)
        mesh = _with_faces(_with_midpoints(mesh, ends), faces, source)
    first, target = first_of_duplicates(mesh.vertices)
    return mesh, target[mesh.faces], mesh.vertices[first].astype(np.float64)


def _with_faces(mesh: Mesh, faces: NDArray, source: NDArray) -> Mesh:
    """Return the mesh with other faces; colours of faces come from the old faces `source`."""
    kept = {}
    if "face_colors" in mesh.attributes:
        kept["face_colors"] = np.asarray(mesh.attributes["face_colors"])[source]
    return replace(mesh, faces=faces, attributes=kept)


def _with_midpoints(mesh: Mesh, ends: list[NDArray]) -> Mesh:
    """Return the mesh with vertices added halfway between the pairs `ends`."""
    v, colors, uv = mesh.vertices.astype(np.float64), mesh.colors, mesh.uv
    for pair in ends:
        v = np.concatenate([v, v[pair].mean(axis=1)])
        if colors is not None:
            colors = np.concatenate([colors, np.rint(colors[pair].mean(axis=1)).astype(np.uint8)])
        if uv is not None:
            uv = np.concatenate([uv, uv[pair].mean(axis=1)])
    return replace(mesh, vertices=v.astype(np.float32), normals=None, colors=colors, uv=uv)


def _doubled_areas(mesh: Mesh) -> NDArray:
    v = mesh.vertices.astype(np.float64).take(mesh.faces, 0)
    return lengths_of(np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]))


# Frames -------------------------------------------------------------------------------------------------------------


def framed(graph: FaceGraph, owner: NDArray, count: int, nodes, spacing: float | None = None):
    """Return the frames of areas: the rectangle of least spacing among `ANGLES`, z along the area's mean normal.

    With `spacing` given, every frame has it, and areas that their patch does not span are halved until it does.

    Returns
    -------
    frames : Frames
        Square cells; relative to the zero of the graph's vertices.
    owner : (f,) int64
    """
    spans = _spans(nodes)
    normal = graph.normals_of(owner, count)
    box = _rectangles(graph.vertices, graph.corners, owner, count, normal, spans)
    while spacing is not None:
        large = np.flatnonzero((box.high - box.low > spans * spacing * (1 + 1e-9)).any(axis=1))
        halved, more = _halved(graph, owner, count, large, box)
        if more == count:
            break
        owner, count = halved, more
        normal = graph.normals_of(owner, count)
        box = _rectangles(graph.vertices, graph.corners, owner, count, normal, spans)
    step = ((box.high - box.low) / spans).max(axis=1)
    least = max(extent_of(graph.vertices).max() * 1e-6, 1e-30)  # an area of one face without extent
    step = np.full(count, spacing, np.float64) if spacing is not None else np.maximum(step, least)
    corner = (box.low + box.high) / 2 - step[:, None] * (np.asarray(nodes) - 1) / 2
    origins = corner[:, :1] * box.axis_x + corner[:, 1:] * box.axis_y + box.height[:, None] * normal
    return Frames(origins, box.axis_x * step[:, None], box.axis_y * step[:, None],
                  np.broadcast_to(np.asarray(nodes, np.int32), (count, 2))), owner


@dataclass(frozen=True)
class Rectangles:
    """Rectangles around areas, in the planes of their normals."""

    axis_x: NDArray  # (p, 3) float64, unit
    axis_y: NDArray  # (p, 3) float64, unit
    low: NDArray  # (p, 2) float64: least x and y of the area's vertices
    high: NDArray  # (p, 2) float64
    height: NDArray  # (p,) float64: mean of the area along its normal


def _fitting(graph: FaceGraph, spans, spacing: float):
    """Return the function that tells which areas have a rectangle within `spans` node spacings."""
    def fits(owner, count):
        faces = np.flatnonzero(owner >= 0)
        owner = owner[faces]
        total = sums(owner, graph.area[faces, None] * graph.normal[faces], count)
        length = lengths_of(total, keepdims=True)
        normal = np.where(length > 0, total / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
        box = _rectangles(graph.vertices, graph.corners[faces], owner, count, normal, spans)
        return (box.high - box.low <= spans * spacing).all(axis=1)
    return fits


def _rectangles(vertices, corners, owner, count, normal, spans) -> Rectangles:
    """Return for every area the rectangle that asks for the least spacing."""
    sign = np.where(normal[:, 2] < 0, -1.0, 1.0)
    a = -1 / (sign + normal[:, 2])
    b = normal[:, 0] * normal[:, 1] * a
    u = np.stack([1 + sign * normal[:, 0] ** 2 * a, sign * b, -sign * normal[:, 0]], axis=1)
    v = np.stack([b, sign + normal[:, 1] ** 2 * a, -normal[:, 1]], axis=1)
    key = (owner[:, None] * np.int64(len(vertices)) + corners).ravel()
    key.sort()
    area, vertex = np.divmod(key[np.append(True, key[1:] != key[:-1])], len(vertices))
    starts = np.searchsorted(area, np.arange(count))
    place = vertices[vertex]
    x, y, z = (np.einsum("ij,ij->i", place, axis[area]) for axis in (u, v, normal))
    best, found = np.full(count, np.inf), np.zeros((count, 5))
    turns = ANGLES if spans[0] == spans[1] else 2 * ANGLES
    for angle in np.arange(turns) * (np.pi / 2 / ANGLES):
        c, s = math.cos(angle), math.sin(angle)
        along, across = c * x + s * y, c * y - s * x
        box = [np.minimum.reduceat(along, starts), np.maximum.reduceat(along, starts),
               np.minimum.reduceat(across, starts), np.maximum.reduceat(across, starts)]
        step = np.maximum((box[1] - box[0]) / spans[0], (box[3] - box[2]) / spans[1])
        better = step < best * (1 - 1e-9)
        best[better] = step[better]
        found[better] = np.stack([np.full(count, angle), *box], axis=1)[better]
    c, s = np.cos(found[:, :1]), np.sin(found[:, :1])
    height = np.add.reduceat(z, starts) / np.diff(np.append(starts, len(z)))
    return Rectangles(c * u + s * v, c * v - s * u, found[:, 1::2], found[:, 2::2], height)


def _halved(graph, owner, count, large, box: Rectangles) -> tuple[NDArray, int]:
    """Return areas with the areas `large` cut across their longer side, and their number."""
    if not len(large):
        return owner, count
    chosen = np.zeros(count, bool)
    chosen[large] = True
    longer = (box.high - box.low).argmax(axis=1)
    axis = np.where(longer[:, None] == 0, box.axis_x, box.axis_y)
    middle = ((box.low + box.high) / 2)[np.arange(count), longer]
    faces = np.flatnonzero(chosen[owner])
    beyond = np.einsum("ij,ij->i", graph.middle[faces], axis[owner[faces]]) > middle[owner[faces]]
    # An area whose faces are all on one side stays as it is.
    both = (np.bincount(owner[faces], beyond, count) > 0) & (np.bincount(owner[faces], ~beyond, count) > 0)
    number = np.cumsum(both) - 1 + count
    moved = faces[beyond & both[owner[faces]]]
    out = owner.copy()
    out[moved] = number[owner[moved]]
    return out, count + int(np.count_nonzero(both))


# How good it is -----------------------------------------------------------------------------------------------------


def _face_of_vertices(graph: FaceGraph) -> NDArray:
    """Return a face (v,) of every vertex."""
    face = np.zeros(len(graph.vertices), np.int64)
    face[graph.corners.ravel()] = np.repeat(np.arange(len(graph)), 3)
    return face


def _distances(found: Conversion, face: NDArray, points: NDArray) -> tuple[NDArray, NDArray]:
    """Return patch_distances of points on the faces `face`: to their area's patch or a nearer strip."""
    strips, listed = len(found.beside.own), found.beside.faces
    strip = np.repeat(np.arange(strips), found.beside.own) + len(found.surface) - strips
    order = np.argsort(listed, kind="stable")
    first, last = (np.searchsorted(listed[order], face, side=side) for side in ("left", "right"))
    row = np.repeat(np.arange(len(face)), last - first)
    at = np.arange(len(row)) - np.repeat(np.cumsum(last - first) - last, last - first)
    rows = np.concatenate([np.arange(len(face)), row])
    patch = np.concatenate([found.owner[face], strip[order[at]]])
    best = np.full((2, len(face)), np.inf)
    for to_nodes in (False, True):  # nodes only for the few points that no cell lies over
        left = np.flatnonzero(~np.isfinite(best[0, rows]))
        for mine, theirs in zip(best, patch_distances(found.surface, patch[left], points[rows[left]], to_nodes),
                                strict=True):
            np.minimum.at(mine, rows[left], theirs)
    return best[0], best[1]


def _with_bound(found: Conversion, diagonal: float) -> PatchSurface:
    graph = found.graph
    chosen = used_numbers(graph.corners, len(graph.vertices))[::max(1, len(graph.vertices) // BOUND_SAMPLES)]
    upper, _ = _distances(found, _face_of_vertices(graph)[chosen], graph.vertices[chosen])
    upper = upper[np.isfinite(upper)]  # the others' patches are wholly transparent, as the scan is there
    bound = float(np.quantile(upper, BOUND_SHARE, method="higher")) if len(upper) else float("nan")
    return replace(found.surface, diagonal=diagonal, bound=bound, bound_share=BOUND_SHARE,
                   bound_all=bound_of_all(found.surface, upper))


def _rms(found: Conversion) -> float:
    """Return the root mean square distance of the mesh from its patches, world units, by area."""
    graph = found.graph
    step = max(1, len(graph) // BOUND_SAMPLES)
    faces = np.arange(len(graph))[::step]
    total = weight = 0.0
    for k in range(3):  # the three points that are exact for quadratics; corners alone are the worst places
        points = (graph.middle[faces] + graph.vertices[graph.corners[faces, k]]) / 2
        _, near = _distances(found, faces, points)
        total, weight = total + (graph.area[faces] * near ** 2).sum(), weight + graph.area[faces].sum()
    return math.sqrt(total / max(weight, 1e-300))


def _searched(mesh, request, device, progress, limits, diagonal) -> Conversion:
    """Return the coarsest conversion whose root mean square distance is at most `request.error` of the diagonal.

    `limits` are the least and the largest spacing to try.
    """
    goal, tried = request.error * diagonal, {}
    m, n = request.nodes
    best, area = None, _doubled_areas(mesh).sum() / 2
    spacing = math.sqrt(area / max(len(mesh.vertices) * NODES_A_VERTEX / (m * n), 1)) / (min(m, n) - 1)
    spacing = min(max(spacing, limits[0]), limits[1])
    for step in range(SEARCH_STEPS):
        done = step / SEARCH_STEPS
        found = converted(mesh, replace(request, error=None, spacing=spacing), device,
                          lambda *_, done=done: progress(done, "spacing"))
        rms = _rms(found)
        tried[spacing] = rms
        if rms <= goal and (best is None or spacing > best[0]):
            best = spacing, found
        if best is not None and 0.93 * goal <= tried[best[0]]:
            break
        if best is None and rms * min(limits[0] / spacing, 1) ** BEST_ORDER > goal:
            break  # not even the finest patches would do
        spacing = min(max(_next_spacing(tried, goal), limits[0]), limits[1])
        if spacing in tried:
            break
    if best is None:
        finest, rms = min(tried.items())
        reached = rms * min(limits[0] / finest, 1) ** 1.5 / diagonal  # its usual order
        raise InputError(f"error: expected about {reached:.1g} of the diagonal or more, which the finest patches of "
                         f"this mesh reach, got {request.error:g}: use a larger one, or more faces")
    return best[1]


def _next_spacing(tried: dict[float, float], goal: float) -> float:
    """Return the spacing to try: between those around the goal, else carried on as its 1.5th power."""
    good = [s for s, rms in tried.items() if rms <= goal]
    bad = [s for s, rms in tried.items() if rms > goal]
    if good and bad and max(good) < min(bad):
        a, b = max(good), min(bad)
        at = math.log(0.97 * goal / max(tried[a], 1e-300)) / math.log(tried[b] / max(tried[a], 1e-300))
        return a * (b / a) ** min(max(at, 0.1), 0.9)
    nearest = max(good) if good else min(bad)
    times = (0.95 * goal / max(tried[nearest], 1e-300)) ** (1 / 1.5)
    return nearest * (times if times > FAR else min(max(times, 0.2), 5.0))
