"""The points that patches are made from: distinct, with normals, spacing and linear colours, sorted on a device."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import InputError
from ..io.cleaning import first_of_duplicates
from ..surface.arrays import lengths_of
from ..surface.srgb import premultiplied
from .neighbours import BoxTree, box_tree, nearest, sampled_covariance
from .point_tree import PointTree, build_point_tree
from .radius import robust_box
from .slim import usable_points

NEIGHBOURS = 8  # of the graph that says which points hang together
SAMPLES = 50_000  # points that the spacing is taken from
AGREED = 0.99  # share of neighbours that must face one way for a cloud to count as oriented


@dataclass(eq=False)
class SheetPoints:
    """Points of a scan, sorted for the device; positions are relative to the scan's origin.

    Attributes
    ----------
    position, normals : (n, 3) float32
        Distinct positions, in the order of `tree`.
    light : (4, padded) float32 or None
        Linear, premultiplied by alpha, in the same order.
    neighbours : (n, NEIGHBOURS + 1) int32
        Nearest points of each, itself first; -1 where there are fewer.
    local : (n,) float32
        Spacing around each point, world units, from the furthest of its neighbours.
    spacing : float
        World units: side of the squares of an even grid as dense as the points, the median over them.
    nearest : float
        World units: median distance to the nearest other point.
    noise : float
        Deviation of neighbouring points across the surface over `spacing`, median.
    diagonal : float
        Of the box without outliers.
    middle : (3,) float32
        Zero of the tree's coordinates, which are (position - middle) / diagonal.
    oriented : bool
        Whether the normals agree about the outside.
    """

    tree: PointTree
    position: NDArray
    normals: NDArray
    light: NDArray | None
    neighbours: NDArray
    local: NDArray
    spacing: float
    nearest: float
    noise: float
    diagonal: float
    middle: NDArray
    origin: NDArray
    oriented: bool

    def __len__(self):
        return len(self.position)


def sheet_points(scan, device: Device) -> SheetPoints:
    """Return the usable points of a Mesh or PointCloud: finite, with a normal (estimated where there is none).

    Raises
    ------
    InputError
        No such point, or all of them at one place.
    """
    points = usable_points(scan, None, device)
    position, normals = points.position, points.normals
    first, target = first_of_duplicates(position)
    colors = None if points.colors is None else premultiplied(points.colors)
    if len(first) < len(position):
        mean = lambda values: means(values, target, len(first))  # noqa: E731
        position, normals = position[first], _unit_or(mean(normals), normals[first])
        colors = None if colors is None else mean(colors)
    box = robust_box(position)
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    if not diagonal > 0 or len(position) < 2:
        raise InputError("scan: expected points with some extent, got all of them at one place")
    middle = box.mean(axis=0).astype(np.float32)
    tree = build_point_tree(position, normals, middle, 1.0 / diagonal, device)
    position, normals = position[tree.order], normals[tree.order]
    normals = normals / lengths_of(normals, keepdims=True)
    light = None
    if colors is not None:
        light = np.zeros((4, tree.padded), np.float32)
        light[:, :len(position)] = colors[tree.order].T
    boxes = box_tree(position, device)
    neighbours, distance = nearest(boxes, min(NEIGHBOURS + 1, len(position)))
    local = distance[:, -1] / np.float32(math.sqrt((distance.shape[1] - 0.5) / math.pi))
    spacing = even_spacing(boxes, position)
    oriented = getattr(scan, "normals", None) is not None or agreement(position, normals, neighbours) >= AGREED
    return SheetPoints(tree, position, normals, light, neighbours, local, spacing, float(np.median(distance[:, 1])),
                       noise_of(boxes) / spacing, diagonal, middle, scan.origin, oriented)


def means(values: NDArray, target: NDArray, count: int) -> NDArray:
    """Return the means (count, k) float32 of the rows (n, k) that share a target (n,)."""
    sizes = np.maximum(np.bincount(target, minlength=count), 1)
    return np.stack([np.bincount(target, column, count) / sizes for column in values.T], axis=1).astype(np.float32)


def _unit_or(vectors: NDArray, instead: NDArray) -> NDArray:
    """Return unit vectors; where one vanishes, that of `instead`."""
    length = lengths_of(vectors, keepdims=True)
    return np.where(length > 1e-3, vectors / np.maximum(length, 1e-3), instead)


def even_spacing(boxes: BoxTree, points: NDArray) -> float:
    """Return the side of the squares of an even grid as dense as the points, the median of a sample.

    The circle up to the k-th other point holds k + 1/2 points. With k = 12 it means something where points are rounded
    to a lattice or pairs of them nearly coincide, which the distance to the nearest point does not.
    """
    k = min(13, len(points))
    sample = points[:: max(1, len(points) // SAMPLES)]
    distance = nearest(boxes, k, sample)[1][:, -1]
    return float(np.median(distance)) / math.sqrt((k - 0.5) / math.pi)


def noise_of(boxes: BoxTree) -> float:
    """Return how far 16 neighbours spread across the surface (standard deviation), the median of a sample."""
    spread = sampled_covariance(boxes, min(16, len(boxes)), 5000).eigenvalues
    return math.sqrt(float(np.median(spread[:, 0])))


def agreement(position: NDArray, normals: NDArray, neighbours: NDArray) -> float:
    """Return the share of points that face the way of their neighbours in their tangent plane."""
    rows = np.arange(0, len(position), max(1, len(position) // SAMPLES))
    near = neighbours[rows, 1:]
    dot = np.einsum("ik,ijk->ij", normals[rows], normals[near])
    edge = position[near] - position[rows, None]
    off = np.abs(np.einsum("ik,ijk->ij", normals[rows], edge)) < 0.5 * lengths_of(edge)
    clear = (near >= 0) & off & (np.abs(dot) > 0.5)
    return float((dot > 0)[clear].mean()) if clear.any() else 1.0
