"""Small patches along the sharp edges of a mesh.

Paper on spatial patches, section 4.4 and figure 8: "detection of the sharp edges and generation of small patches that
have intermediate orientation with respect to the faces adjacent in the selected edges ... of higher resolution". One
row of their nodes lies on the edge, and the patches of the two faces end before it: nothing stands out over it.
Fandisk, 600 patches (211 of them strips), 500x500, mean of 8 views: 1,198 pixels outside the silhouette without strips,
8 with them, none by more than a pixel; no hole.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from ..surface.arrays import lengths_of
from .patch_edges import ALONG, NO_STRIPS, STEEPEST, Strips, inner_columns, shared_corners, strips_of
from .resample import FaceLists, Frames
from .segments import FaceGraph

LARGEST_SHARE = 0.6  # of a requested number of patches
LEAST_NODES = 5  # a patch of fewer each way is no finer across an edge than the patches beside it
HALF_WIDTH = 1.15  # diagonals of the cells beside the edge: a cell that the edge cuts off ends within one


def cut_graph(graph: FaceGraph, strips: Strips) -> FaceGraph:
    """Return the graph without the strips' edges: faces on the two sides share neither the edge nor its vertices.

    Faces are joined at a vertex where they hang together around it without crossing such an edge; of the others, all
    but the first get vertices of their own, at the end of the list.
    """
    kept = np.ones(len(graph.pairs), bool)
    kept[strips.edges.pair[strips.edges.pair >= 0]] = False
    marked = np.zeros(len(graph.vertices), bool)
    marked[strips.edges.ends] = True
    near = kept & marked[graph.corners].any(axis=1)[graph.pairs].all(axis=1)
    pairs = graph.pairs[near]
    at = 3 * pairs[:, :, None] + shared_corners(graph.corners, pairs)
    a, b = at[:, 0].ravel(), at[:, 1].ravel()
    place = np.flatnonzero(marked[graph.corners].ravel())  # corners of faces, at marked vertices
    number = np.full(graph.corners.size, -1)
    number[place] = np.arange(len(place))
    there = (number[a] >= 0) & (number[b] >= 0)
    net = sparse.csr_matrix((np.ones(there.sum(), bool), (number[a[there]], number[b[there]])), (len(place),) * 2)
    count, part = csgraph.connected_components(net, directed=False)
    vertex = np.zeros(count, np.int64)
    vertex[part] = graph.corners.ravel()[place]
    _, first = np.unique(vertex, return_index=True)
    new = np.ones(count, bool)
    new[first] = False
    renumbered = vertex.copy()
    renumbered[new] = len(graph.vertices) + np.arange(new.sum())
    corners = graph.corners.copy()
    corners.reshape(-1)[place] = renumbered[part]
    return FaceGraph(np.concatenate([graph.vertices, graph.vertices[vertex[new]]]), corners, graph.normal, graph.area,
                     graph.pairs[kept], graph.length[kept], graph.cosine[kept])


def strip_frames(strips: Strips, cell: NDArray, size) -> Frames:
    """Return the frames of the strips' patches.

    Parameters
    ----------
    cell : (s,) float64
        Diagonal of the cells of the patches beside each strip, world units.
    size : (2,) int
        Nodes along the edge, and across it.

    Notes
    -----
    One row of nodes lies on the edge: the middle one of a crease, the first of a border, just inside it.
    """
    m, n = int(size[0]), int(size[1])
    along = strips.end - strips.start
    inner = inner_columns(m)
    axis_x = along / (inner - 1)
    across = np.cross(strips.normal, along / np.maximum(lengths_of(along), 1e-300)[:, None])  # to the left
    crease = strips.slope[:, 1] > 0
    width = HALF_WIDTH * cell * np.where(crease, np.maximum(strips.slope[:, 0], strips.slope[:, 1]), 1)
    ridge = np.where(crease, (n - 1) // 2, 0)
    width = width + np.where(crease, (strips.bow[:, 1] - strips.bow[:, 0]) / 2, 0)
    axis_y = across * (width / np.maximum(np.where(crease, (n - 1) // 2, n - 1), 1))[:, None]
    middle = np.where(crease, strips.bow.mean(axis=1), strips.bow[:, 1])
    origin = strips.start + middle[:, None] * across - ridge[:, None] * axis_y
    return Frames(origin - (m - inner) / 2 * axis_x, axis_x, axis_y,
                  np.broadcast_to(np.array([m, n], np.int32), (len(strips), 2)))


def strip_faces(graph: FaceGraph, strips: Strips, frames: Frames) -> FaceLists:
    """Return the faces under each strip: those reached from its edge without crossing an edge of any strip.

    Parameters
    ----------
    graph : FaceGraph
        As `cut_graph` returns it.
    frames : Frames
        Of the strips.
    """
    a, b = graph.pairs.T
    count = len(graph)
    net = sparse.csr_matrix((np.ones(2 * len(a), bool), (np.r_[a, b], np.r_[b, a])), (count, count))
    strip = np.repeat(np.arange(len(strips)), np.diff(strips.offset))
    seeds, strip = strips.edges.faces.T.ravel(), np.concatenate([strip, strip])
    fresh = np.unique(strip[seeds >= 0] * np.int64(count) + seeds[seeds >= 0])
    known = np.zeros(0, np.int64)
    while len(fresh):
        p, f = np.divmod(fresh, count)
        near = _under(graph.vertices[graph.corners[f]], frames, p)
        known = np.union1d(known, fresh[near])
        p, f = p[near], f[near]
        degree = np.diff(net.indptr)[f]
        at = np.repeat(net.indptr[f] - np.cumsum(degree) + degree, degree) + np.arange(degree.sum())
        fresh = np.setdiff1d(np.repeat(p, degree) * np.int64(count) + net.indices[at], known)
    p, f = np.divmod(known, count)
    own = np.bincount(p, minlength=len(strips)).astype(np.int32)
    return FaceLists(f.astype(np.int32), np.concatenate([[0], np.cumsum(own)]).astype(np.int32), own)


def _under(triangles, frames, p) -> NDArray:
    """Return which triangles (k, 3, 3) face the plane of patch `p` (k,) and meet its grid or come close."""
    apart = triangles - frames.origins[p][:, None]
    out = np.ones(len(p), bool)
    for axis, nodes in ((frames.axis_x, frames.size[:, 0]), (frames.axis_y, frames.size[:, 1])):
        step = axis[p] / np.einsum("ij,ij->i", axis, axis)[p][:, None]
        along = np.einsum("kij,kj->ki", apart, step)
        out &= (along.max(axis=1) >= -1.5) & (along.min(axis=1) <= nodes[p] + 0.5)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    toward = np.einsum("ij,ij->i", normal, frames.unit_z[p])
    return out & (toward > STEEPEST / 2 * lengths_of(normal))


def joined(frames: Frames, lists: FaceLists, more: Frames, their: FaceLists) -> tuple[Frames, FaceLists]:
    """Return patches and their faces, one kind after the other."""
    pairs = ((frames.origins, more.origins), (frames.axis_x, more.axis_x), (frames.axis_y, more.axis_y),
             (frames.size, more.size))
    return (Frames(*(np.concatenate(pair) for pair in pairs)),
            FaceLists(np.concatenate([lists.faces, their.faces]),
                      np.concatenate([lists.offset, lists.offset[-1] + their.offset[1:]]),
                      np.concatenate([lists.own, their.own])))


def cells_beside(strips: Strips, frames: Frames, owner: NDArray) -> NDArray:
    """Return the diagonal (s,) of the largest cell of the areas' patches beside each strip, world units."""
    diagonal = np.sqrt((frames.axis_x**2).sum(axis=1) + (frames.axis_y**2).sum(axis=1))
    faces = strips.edges.faces
    beside = np.where(faces >= 0, diagonal[owner[faces]], 0).max(axis=1)
    return np.maximum.reduceat(beside, strips.offset[:-1]) if len(strips) else np.zeros(0)


def fitting_strips(graph: FaceGraph, nodes, spacing: float, patches: int | None, along: float = ALONG) -> Strips:
    """Return the strips of a mesh, or coarser ones that leave enough of the `patches` for its areas, or none.

    Parameters
    ----------
    nodes : (int, int)
        Along the edges and across them; too few make no strips.
    spacing : float
        Between the nodes of the areas' patches, world units.
    patches : int, optional
        Of areas and strips together; strips are at most `LARGEST_SHARE` of them.
    along : float
        See `strips_of`.
    """
    if min(nodes) < LEAST_NODES:
        return NO_STRIPS
    for factor in (1.0, 2.0, 4.0):
        strips = strips_of(graph, factor * spacing, nodes[0], along)
        if patches is None or not len(strips):
            return strips
        if len(strips) <= LARGEST_SHARE * patches and cut_graph(graph, strips).components[0] <= patches - len(strips):
            return strips
    return NO_STRIPS
