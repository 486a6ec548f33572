"""Regions of a cloud that one patch each can show: flat, of one sheet, connected, and no larger than a patch.

Seeds are spread over the points and moved by Lloyd's iteration over position and normal; what hangs together in a
region stays one, what does not is split, and what is larger than a patch is cut in two.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from .orientation import cell_numbers
from .patch_points import SheetPoints

ROUNDS = 6  # of Lloyd's iteration
FLATNESS = 3.0  # weight of squared distances from a region's plane, over those along it
BEND = 0.85  # cost of 1 - cosine between normals, over the squared width of a patch: 45 degrees cost half a width
CONE = 0.35  # least cosine between a region's normal and those of its points; 0.35 is 70 degrees
STEEP = 0.7  # sine of the angle of an edge with the tangent planes above which it leads to another sheet
SMALL = 0.06  # of a patch's area: smaller regions join a neighbour where they hang together with one
LEAST = 4  # points of a region; fewer are outliers
ANGLES = 12  # orientations tried for the smallest rectangle around a region


@dataclass(eq=False)
class Regions:
    """Regions and the frames of their patches; lengths in the units of the points' tree.

    Attributes
    ----------
    label : (n,) int32
        Region of each point, -1 for none.
    center : (r, 3) float64
        Middle of the rectangle around a region's points, in its plane.
    axes : (r, 3, 3) float64
        Unit x, y, z; z is the normal.
    extent : (r, 2) float64
        Sides of the rectangle along x and y.
    low, high : (r,) float64
        Heights of the points over the centre.
    """

    label: NDArray
    center: NDArray
    axes: NDArray
    extent: NDArray
    low: NDArray
    high: NDArray

    def __len__(self):
        return len(self.center)


class _Sheet:
    """Points in the tree's coordinates, with the graph of those that lie on one sheet."""

    def __init__(self, points: SheetPoints):
        self.points = points
        self.position = (points.position.astype(np.float64) - points.middle) / points.diagonal
        self.normals = points.normals.astype(np.float64)
        near = points.neighbours[:, 1:]
        rows = np.repeat(np.arange(len(near)), near.shape[1])
        columns = near.ravel()
        keep = columns >= 0
        rows, columns = rows[keep], columns[keep]
        edge = (self.position[columns] - self.position[rows]).astype(np.float32)
        n, m = points.normals[rows], points.normals[columns]
        off = np.abs(np.einsum("ij,ij->i", edge, n + m)) / 2
        length = np.maximum(np.linalg.norm(edge, axis=1), points.spacing / points.diagonal)
        keep = (np.einsum("ij,ij->i", n, m) > CONE) & (off <= STEEP * length)
        self.rows, self.columns = rows[keep], columns[keep]

    def __len__(self):
        return len(self.position)


def find_regions(points: SheetPoints, width: tuple[float, float], step: float) -> Regions:
    """Divide the points into regions whose rectangles are at most `width`.

    Parameters
    ----------
    width : (float, float)
        Largest extent along the longer and the shorter side, in the tree's units.
    step : float
        Node spacing, in the tree's units.
    """
    sheet = _Sheet(points)
    side = float(np.sqrt(width[0] * width[1]))
    label = lloyd(sheet, first_seeds(sheet, 0.8 * side), side)
    label = connected(sheet, label)
    smallest = SMALL * (side / (points.spacing / points.diagonal)) ** 2
    label = joined(sheet, label, smallest)
    for _ in range(12):
        regions = framed(sheet, label)
        cut = oversize(sheet, regions, width)
        if not cut.any():
            break
        label = halved(sheet, label, cut)
    return without_outliers(sheet, label)


def first_seeds(sheet: _Sheet, side: float) -> NDArray:
    """Return a label (n,) for each point: its cube of side `side` and the cube face that its normal points to."""
    cell, _ = cell_numbers(sheet.position.astype(np.float32), side)
    axis = np.argmax(np.abs(sheet.normals), axis=1)
    face = 2 * axis + (sheet.normals[np.arange(len(axis)), axis] < 0)
    return np.unique(cell * 6 + face, return_inverse=True)[1]


def region_sums(label: NDArray, columns, count: int) -> list[NDArray]:
    """Return the sums (count,) of each column (n,) over the labels."""
    return [np.bincount(label, column, count) for column in columns]


def lloyd(sheet: _Sheet, label: NDArray, side: float) -> NDArray:
    """Return the labels (n,) after `ROUNDS` rounds of moving seeds to the means of their points."""
    tree = sheet.points.tree
    device = tree.device
    kernel = device.kernel("build/assign_regions.cl", constants={"VW": device.lanes})
    on_device = np.zeros(tree.padded, np.int32)
    for number in range(ROUNDS):
        seeds, label = seed_records(sheet, label)
        if number == ROUNDS // 2:  # what lost its points to better seeds
            seeds, label = without_small(seeds, label)
        order, boxes = sorted_seeds(seeds)
        place = np.empty(len(order), np.int32)
        place[order] = np.arange(len(order))
        on_device[:len(label)] = place[label]
        labels = device.empty(tree.padded, np.int32)
        device.write(labels, on_device)
        kernel((-(-tree.count // device.lanes),), (1,), tree.count, tree.padded, tree.sorted, len(seeds),
               device.upload(seeds[order]), device.upload(boxes), FLATNESS, BEND * side**2, labels)
        label = device.download(labels)[:tree.count]
    return label


def seed_records(sheet: _Sheet, label: NDArray) -> tuple[NDArray, NDArray]:
    """Return the seeds (s, 8) float32 of the labels in use (place, unit normal, 0, 0), and the labels renumbered."""
    used, label = renumbered(label)
    sizes = np.bincount(label, minlength=used)
    out = np.zeros((used, 8), np.float32)
    for k in range(3):
        out[:, k] = np.bincount(label, sheet.position[:, k], used) / sizes
        out[:, 3 + k] = np.bincount(label, sheet.normals[:, k], used)
    length = np.linalg.norm(out[:, 3:6], axis=1, keepdims=True)
    out[:, 3:6] = np.where(length > 1e-6, out[:, 3:6] / np.maximum(length, 1e-6), [0, 0, 1])
    return out, label


def renumbered(label: NDArray) -> tuple[int, NDArray]:
    """Return how many labels 0, 1, ... are in use, and the labels without the unused; negative ones stay."""
    used = np.bincount(label[label >= 0])
    number = np.cumsum(used > 0) - 1
    return int((used > 0).sum()), np.where(label >= 0, number[np.maximum(label, 0)] if len(number) else -1, -1)


def without_small(seeds: NDArray, label: NDArray) -> tuple[NDArray, NDArray]:
    """Drop the seeds with less than a quarter of the median number of points; these start anew at seed 0."""
    sizes = np.bincount(label, minlength=len(seeds))
    keep = sizes >= 0.25 * np.median(sizes)
    number = np.where(keep, np.cumsum(keep) - 1, 0)
    return seeds[keep], number[label]


def sorted_seeds(seeds: NDArray) -> tuple[NDArray, NDArray]:
    """Return the order (s,) of seeds along a Morton curve, and the boxes (ceil(s / 16), 8) of 16 each."""
    place = seeds[:, :3]
    low, high = place.min(axis=0), place.max(axis=0)
    cell = ((place - low) / max(float((high - low).max()), 1e-30) * 1023).astype(np.int64)
    code = np.zeros(len(seeds), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    order = np.lexsort((*seeds.T[:6], code))
    starts = np.arange(0, len(seeds), 16)
    boxes = np.zeros((len(starts), 8), np.float32)
    boxes[:, :3] = np.minimum.reduceat(place[order], starts)
    boxes[:, 3:6] = np.maximum.reduceat(place[order], starts)
    return order, boxes


def connected(sheet: _Sheet, label: NDArray) -> NDArray:
    """Split the regions whose points do not hang together."""
    inside = label[sheet.rows] == label[sheet.columns]
    graph = sparse.coo_array((np.ones(int(inside.sum()), np.int8), (sheet.rows[inside], sheet.columns[inside])),
                             shape=(len(label), len(label)))
    return sparse.csgraph.connected_components(graph.tocsr(), directed=False)[1]


def joined(sheet: _Sheet, label: NDArray, smallest: float) -> NDArray:
    """Give the regions with fewer than `smallest` points to the neighbour that most of their links lead to."""
    for _ in range(3):
        count, label = renumbered(label)
        sizes = np.bincount(label, minlength=count)
        a, b = label[sheet.rows], label[sheet.columns]
        a, b = np.concatenate([a, b]), np.concatenate([b, a])
        keep = (a != b) & (sizes[a] < smallest)
        if not keep.any():
            break
        pair, links = np.unique(a[keep] * np.int64(count) + b[keep], return_counts=True)
        small, other = pair // count, pair % count
        # The strongest link last, larger neighbours before smaller ones; only to larger regions: no cycles.
        larger = (sizes[other] > sizes[small]) | ((sizes[other] == sizes[small]) & (other < small))
        small, other, links = small[larger], other[larger], links[larger]
        if not len(small):
            break
        order = np.lexsort((other, sizes[other], links, small))
        small, other = small[order], other[order]
        last = np.append(small[1:] != small[:-1], True)
        target = np.arange(count)
        target[small[last]] = other[last]
        for _ in range(count.bit_length() + 1):
            target = target[target]
        label = target[label]
    return renumbered(label)[1]


def framed(sheet: _Sheet, label: NDArray) -> Regions:
    """Return the regions of `label` with their frames: mean normals, and the smallest rectangles of `ANGLES`."""
    used = np.flatnonzero(label >= 0)
    order = used[np.argsort(label[used], kind="stable")]
    sorted_label = label[order]
    starts = np.flatnonzero(np.append(True, sorted_label[1:] != sorted_label[:-1]))
    count = len(starts)
    seeds, _ = seed_records_of(sheet, order, sorted_label, count)
    center, z = seeds[:, :3], seeds[:, 3:]
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z), axis=1)])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    offset = sheet.position[order] - center[sorted_label]
    along = lambda axis: np.einsum("ij,ij->i", offset, axis[sorted_label]).astype(np.float32)  # noqa: E731
    u, v, w = along(x), along(y), along(z)
    span = lambda a: (np.minimum.reduceat(a, starts), np.maximum.reduceat(a, starts))  # noqa: E731
    best, frame = np.full(count, np.inf), np.zeros((count, 5))
    for angle in np.arange(ANGLES) * (np.pi / 2 / ANGLES):
        c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        (u0, u1), (v0, v1) = span(c * u + s * v), span(c * v - s * u)
        area = np.maximum(u1 - u0, v1 - v0).astype(np.float64) ** 2 + 0.5 * (u1 - u0) * (v1 - v0)
        better = area < best * (1 - 1e-5)
        best = np.where(better, area, best)
        frame[better] = np.stack([np.full(count, angle), u0, u1, v0, v1], axis=1)[better]
    angle, u0, u1, v0, v1 = frame.T
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = c * x + s * y, c * y - s * x
    center = center + ((u0 + u1) / 2)[:, None] * x + ((v0 + v1) / 2)[:, None] * y
    turn = (v1 - v0) > (u1 - u0)  # x along the longer side
    x, y = np.where(turn[:, None], y, x), np.where(turn[:, None], -x, y)
    extent = np.sort(np.stack([u1 - u0, v1 - v0], axis=1), axis=1)[:, ::-1]
    low, high = span(w)
    return Regions(label, center, np.stack([x, y, z], axis=1), extent, low.astype(float), high.astype(float))


def seed_records_of(sheet: _Sheet, order: NDArray, label: NDArray, count: int) -> tuple[NDArray, NDArray]:
    """Return means of places and unit mean normals (count, 6) float64 of the points `order` with labels `label`."""
    sizes = np.bincount(label, minlength=count)
    out = np.empty((count, 6))
    for k in range(3):
        out[:, k] = np.bincount(label, sheet.position[order, k], count) / sizes
        out[:, 3 + k] = np.bincount(label, sheet.normals[order, k], count)
    length = np.linalg.norm(out[:, 3:], axis=1, keepdims=True)
    out[:, 3:] = np.where(length > 1e-9, out[:, 3:] / np.maximum(length, 1e-9), [0, 0, 1])
    return out, sizes


def oversize(sheet: _Sheet, regions: Regions, width: tuple[float, float]) -> NDArray:
    """Return which regions (r,) do not fit into a patch, or bend by more than `CONE`."""
    used = regions.label >= 0
    label = regions.label[used]
    cosine = np.einsum("ij,ij->i", sheet.normals[used], regions.axes[label, 2])
    # Single wild normals do not count: a twentieth of the points must be off.
    bent = np.bincount(label, cosine < CONE, len(regions)) > 0.05 * np.bincount(label, minlength=len(regions))
    several = np.bincount(label, minlength=len(regions)) >= 2 * LEAST
    wide = (regions.extent[:, 0] > width[0]) | (regions.extent[:, 1] > width[1])
    return (bent & several) | wide


def halved(sheet: _Sheet, label: NDArray, cut: NDArray) -> NDArray:
    """Cut the regions `cut` (r,) in two across the direction in which places and normals spread most."""
    rows = np.flatnonzero((label >= 0) & cut[np.maximum(label, 0)])
    number = (np.cumsum(cut) - 1)[label[rows]]
    count = int(cut.sum())
    place, normals = sheet.position[rows], sheet.normals[rows]
    sizes = np.bincount(number, minlength=count)
    mean = lambda values: np.stack([np.bincount(number, c, count) / sizes for c in values.T], axis=1)  # noqa: E731
    place = place - mean(place)[number]
    spread = np.sqrt(np.bincount(number, np.einsum("ij,ij->i", place, place), count) / sizes)
    feature = np.concatenate([place / np.maximum(spread, 1e-30)[number, None], normals - mean(normals)[number]], axis=1)
    product = np.empty((count, 6, 6))
    for i in range(6):
        for j in range(i + 1):
            product[:, i, j] = product[:, j, i] = np.bincount(number, feature[:, i] * feature[:, j], count)
    direction = np.linalg.eigh(product)[1][:, :, -1]
    across = np.einsum("ij,ij->i", feature, direction[number])
    order = np.lexsort((across, number))
    starts = np.concatenate([[0], np.cumsum(sizes)])[:-1]
    low, high = across[order[starts]], across[order[starts + sizes - 1]]
    upper = across > ((low + high) / 2)[number]
    out = label.copy()
    out[rows[upper]] = int(label.max()) + 1 + number[upper]
    return renumbered(out)[1]


def without_outliers(sheet: _Sheet, label: NDArray) -> Regions:
    """Return the regions with at least `LEAST` points."""
    sizes = np.bincount(label[label >= 0])
    keep = sizes >= min(LEAST, len(sheet))
    label = np.where(label >= 0, np.where(keep, np.cumsum(keep) - 1, -1)[np.maximum(label, 0)], -1)
    return framed(sheet, label)
