"""Smoothing of triangle meshes: guide normals, fits at the faces, vertices moved to the blended normals or planes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..build.point_tree import BLOCK, build_boxes, morton_order
from ..build.radius import robust_box
from ..device import Device
from ..device.arrays import DeviceArray
from ..io.cleaning import first_of_duplicates
from ..surface.arrays import finite_rows, lengths_of, whole_faces
from .smooth_fits import (
    ITEMS,
    LAST_STEP,
    SHARP,
    Queries,
    Rings,
    Samples,
    blended,
    choose_radii,
    guided_fits,
    has_edges,
    queries_of,
)

ROW = 8  # floats a face (guided_planes.cl)
# Of the bilateral iterations on normals. Started sharper, the bunny with 0.2 % noise keeps 400 folded faces, not 15.
GUIDE_SHARPS, GUIDE_SHARPS_CAD = (0.3, 1.2, 2.5, 3.0, 3.0), (1.0, 2.0, 4.0, 4.0, 4.0)
GUIDE_WIDTH = 2.0  # their standard deviation in space, over the edge length
SHARP_CAD = 10.0  # of the weights of fits and blend, of shapes with sharp edges
RADIUS_CAD = 1.3  # of the chosen radius: flat faces have no bias to be wary of
# Radii over the spacing from and up to which vertices are projected first, by a growing share. Where faces only turn,
# long waves stay: a noisy plane kept 0.17 of its noise instead of 0.13. With sharp edges all are projected.
PROJECTED = (4.0, 8.0)
MOVES = 10  # steps of vertices toward the blended normals
RELAX = 0.5  # share of the way to the middle that a vertex at a folded face takes within the surface
AREA_ROUNDS = 6  # means over neighbours of the faces' areas, whose root is the spacing
STAYS, SLIDES, MOVES_FREELY = 0, 1, 3  # kinds of vertices (move_vertices.cl)


@dataclass(eq=False)
class Net:
    """The usable part of a mesh on a device: faces along the Morton curve, vertices in the order of their first use.

    Attributes
    ----------
    used : (u,) int64
        Welded vertex of every vertex of the net.
    vertices : (u, 3) float32
        Relative to `middle`, over `unit`.
    faces : (f, 3) int32
    """

    device: Device
    used: NDArray
    vertices: NDArray
    faces: NDArray
    middle: NDArray  # (3,) float64
    unit: float
    faces_on_device: DeviceArray
    offset: DeviceArray  # (u + 1,) int32
    faces_of: DeviceArray  # (3 f,) int32
    averaging: sparse.csr_matrix  # (u, f): sums over the faces of a vertex
    rings: Rings
    border: NDArray  # (u,) bool: at a face's edge that no other face shares

    def at_faces(self, values: NDArray) -> NDArray:
        """Return means (f,) of values (u,) over the corners of faces."""
        return values[self.faces].mean(axis=1)


def net_of(points: NDArray, faces: NDArray, device: Device) -> tuple[Net, NDArray] | None:
    """Return the net of the faces whose corners are finite and three, and the welded index of every vertex.

    None where there is no such face, or all corners are at one place.
    """
    first, target = first_of_duplicates(points)
    faces = target[faces]
    a, b, c = faces.T
    good = (a != b) & (b != c) & (c != a)
    finite = finite_rows(points[first])
    if not finite.all():
        good &= whole_faces(faces, finite)
    faces = faces if good.all() else faces[good]
    if not len(faces):
        return None
    corners = points if len(first) == len(points) else points[first]
    inside = np.zeros(len(corners), bool)
    inside[faces] = True
    box = robust_box(corners if inside.all() else corners[inside])
    unit = float(np.linalg.norm(box[1] - box[0]))
    if not (np.isfinite(unit) and unit > 0):
        return None
    middle = box.mean(axis=0)
    corners = ((corners - middle) / unit).astype(np.float32)
    corners[~inside] = 0.0  # may be infinite
    order, _, _ = morton_order(corners[faces[:, 0]] + corners[faces[:, 1]] + corners[faces[:, 2]], device)
    faces = faces[order]
    flat = faces.ravel()
    place = np.zeros(len(corners), np.int64)
    place[flat[::-1]] = np.arange(len(flat))[::-1]  # the last write, at the first use, stays
    used = flat[place[flat] == np.arange(len(flat))]
    number = np.zeros(len(corners), np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    return _net(used, np.ascontiguousarray(corners[used]), number[faces], middle, unit, device), target


def _net(used, vertices, faces, middle, unit, device) -> Net:
    count = len(used)
    rows = sparse.csr_matrix((np.arange(faces.size, dtype=np.int32), faces.ravel(), np.arange(0, faces.size + 1, 3)),
                             shape=(len(faces), count)).tocsc()
    corner, offset = rows.data, rows.indptr.astype(np.int32)
    face = corner // 3
    following, before = (faces.ravel()[3 * face + (corner + step) % 3] for step in (1, 2))
    near = np.stack([following, before], axis=1).ravel()
    # Around an inner vertex every neighbour follows one face's corner and comes before another's: hashes cancel.
    code = np.random.default_rng(1).integers(1 << 62, size=count).astype(np.uint64)
    border = np.add.reduceat(code[following] - code[before], offset[:-1]) != 0
    averaging = sparse.csr_matrix((np.ones(len(face), np.float32), face, offset), shape=(count, len(faces)))
    rings = Rings(device, count, device.upload(2 * offset), device.upload(near, np.int32))
    return Net(device, used, vertices, faces, middle, unit, device.upload(faces), device.upload(offset),
               device.upload(face, np.int32), averaging, rings, border)


def guide_rows(net: Net, sharps: tuple) -> tuple[DeviceArray, NDArray]:
    """Return rows (f, ROW) of the faces with filtered normals, and the faces' areas."""
    device, count = net.device, len(net.faces)
    rows, other = device.empty((count, ROW), np.float32), device.empty((count, ROW), np.float32)
    device.kernel("analysis/guided_planes.cl")((count,), ITEMS, count, net.faces_on_device, device.upload(net.vertices),
                                               1.0, rows)
    areas = device.download(rows)[:, 3].copy()
    mean = max(float(areas.mean(dtype=np.float64)), 1e-30)
    device.kernel("analysis/guided_planes.cl")((count,), ITEMS, count, net.faces_on_device, device.upload(net.vertices),
                                               1.0 / mean, rows)
    width2 = 2 * GUIDE_WIDTH**2 * edge_length(mean) ** 2
    for sharp in sharps:
        device.kernel("analysis/guided_normals.cl")((count,), ITEMS, count, net.faces_on_device, net.offset,
                                                    net.faces_of, rows, 1.0 / width2, sharp, other)
        rows, other = other, rows
    return rows, areas


def edge_length(area):
    """Return the edge of an equilateral triangle of `area`."""
    return np.sqrt(4 / np.sqrt(3) * area)


def samples_of(net: Net, rows: DeviceArray, spacing: NDArray) -> Samples:
    """Return the faces' centroids with the normals of `rows`; spacing: (f,)."""
    device, count = net.device, len(net.faces)
    padded = -(-count // BLOCK) * BLOCK
    arrays = device.empty((7, padded), np.float32)
    device.kernel("analysis/guided_rows.cl")((padded,), ITEMS, count, padded, rows, arrays)
    boxes, node_offset, top_level = build_boxes(arrays, padded, device)
    return Samples(device, count, padded, arrays, boxes, node_offset, top_level, spacing, 2.0)


@dataclass(eq=False)
class Guided:
    """A net with the normals that guide its fits.

    Attributes
    ----------
    sharp : float
        Of the weights of fits and blend.
    spacing : (u,) float32
        Edge length around each vertex.
    """

    samples: Samples
    queries: Queries  # the vertices
    sharp: float
    spacing: NDArray


def guided(net: Net, guide_sharps: tuple, sharp: float) -> Guided:
    """Return the net's faces and vertices with normals filtered by `guide_sharps`."""
    rows, areas = guide_rows(net, guide_sharps)
    degree = np.maximum(np.diff(net.averaging.indptr), 1).astype(np.float32)
    area = net.rings.means((net.averaging @ areas / degree)[None], AREA_ROUNDS)[0]
    spacing = edge_length(np.maximum(area, 1e-14))
    samples = samples_of(net, rows, net.at_faces(spacing))
    normals = net.averaging @ net.device.download(rows, copy=False)[:, :3]
    length = lengths_of(normals, keepdims=True)
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), (0.0, 0.0, 1.0)).astype(np.float32)
    return Guided(samples, queries_of(net.vertices, normals, net.device), sharp, spacing)


def guide_and_radii(net: Net) -> tuple[Guided, NDArray]:
    """Return the net guided as suits its shape, with sharp edges or without, and the radii (u,) over the spacing."""
    found = guided(net, GUIDE_SHARPS, SHARP)
    choice = choose_radii(found.samples, found.queries, net.rings, SHARP)
    if not has_edges(found.samples, found.queries, choice):
        return found, choice.factor
    found = guided(net, GUIDE_SHARPS_CAD, SHARP_CAD)
    return found, RADIUS_CAD * choose_radii(found.samples, found.queries, net.rings, SHARP_CAD).factor


def smooth_net(net: Net, method: str, strength: float, kind: NDArray) -> NDArray:
    """Return smoothed vertices (u, 3) float32 of the net.

    Parameters
    ----------
    method : str
        "normals", "quadrics" or "projection".
    strength : float
        Above 1 radii are multiplied by it.
    kind : (u,) uint8
        How each vertex may move.
    """
    guide, factor = guide_and_radii(net)
    samples = guide.samples
    radii = net.at_faces(factor * guide.spacing) * max(strength, 1.0)
    fits = guided_fits(samples, radii, guide.sharp, LAST_STEP)
    start = net.vertices
    if method != "quadrics":
        offset, *normal, _ = blended(fits, guide.queries)
        share = np.ones(len(factor), np.float32) if method == "projection" or guide.sharp == SHARP_CAD else \
            np.clip((factor - PROJECTED[0]) / (PROJECTED[1] - PROJECTED[0]), 0, 1)
        start = start - np.where(kind > 0, share * offset, 0)[:, None] * np.stack(normal, axis=1)
    if method == "projection":
        return start
    found = blended(fits, Queries(samples.count, samples.padded, samples.sorted))
    if method == "quadrics":
        return place_vertices(net, samples, found, kind)
    return move_vertices(net, start, found[1:4], kind)


def move_vertices(net: Net, vertices: NDArray, normals: NDArray, kind: NDArray) -> NDArray:
    """Move `vertices` (u, 3) of the net so that its faces turn to `normals` (3, f)."""
    device, count = net.device, len(net.used)
    wanted = np.zeros((len(net.faces), 4), np.float32)
    wanted[:, :3] = normals.T
    wanted, kind = device.upload(wanted), device.upload(kind)
    start = device.upload(vertices, np.float32)
    a, b = device.empty((count, 3), np.float32), device.empty((count, 3), np.float32)
    kernel = device.kernel("analysis/move_vertices.cl")
    for step in range(MOVES):
        kernel((count,), ITEMS, count, net.offset, net.faces_of, net.faces_on_device, wanted, kind, RELAX,
               a if step else start, b)
        a, b = b, a
    return device.download(a)


def place_vertices(net: Net, samples: Samples, found: NDArray, kind: NDArray) -> NDArray:
    """Place vertices by quadric minimisation over the planes of the projected centroids."""
    device, count = net.device, len(net.used)
    centroid = device.download(samples.sorted, copy=False)[:3, :samples.count]
    planes = np.empty((len(net.faces), 4), np.float32)
    planes[:, :3] = found[1:4].T
    planes[:, 3] = (centroid * found[1:4]).sum(axis=0) - found[0]
    out = device.empty((count, 3), np.float32)
    device.kernel("analysis/place_vertices.cl")((count,), ITEMS, count, net.offset, net.faces_of,
                                                device.upload(planes), device.upload(kind),
                                                device.upload(net.vertices), out)
    return device.download(out)
