"""Regions of a cloud that one patch each can show: flat, of one sheet, connected, and no larger than a patch.

Seeds are spread over the points and moved by Lloyd's iteration over position and normal (patch_seeds); what hangs
together in a region stays one, what does not is split, what is larger than a patch is cut in two, and neighbours that
fit into one patch are joined.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ..surface.arrays import lengths_of
from ..surface.slim import frame_of_normals
from .patch_points import SheetPoints
from .patch_seeds import FIRST, first_seeds, lloyd, renumbered

# Least cosine between a region's normal and those of its points. With 0.35 the patches' steep rims stood off the
# surface like teeth; 0.5, `ALIKE` and BEND in patch_seeds cost 15 % more patches.
CONE = 0.5
ALIKE = 0.85  # least cosine between the normals of two regions that one patch may hold
SAME_SIDE = 0.35  # least cosine between the normals of neighbours on one sheet
STEEP = 0.7  # sine of the angle of an edge with the tangent planes above which it leads to another sheet
SMALL = 0.06  # of a patch's area: smaller regions join a neighbour where they hang together with one
LEAST = 4  # points of a region; fewer are outliers
LEFT = 10  # points of a region of those that the first patches missed
WIDEN = 0.9  # how far a patch goes beyond its region's points, over their spacing, before it is rounded up to nodes
SPARSE = 3.0  # largest spacing of a region over that of the cloud
MERGES = 6  # rounds of joining two regions that fit into one patch
ANGLES = np.arange(16) * (np.pi / 32)  # orientations tried for the smallest rectangle around a region


@dataclass(eq=False)
class Regions:
    """Regions and the frames of their patches; lengths in the units of the points' tree.

    Attributes
    ----------
    label : (n,) int
        Region of each point, -1 for none.
    center : (r, 3) float64
        Middle of the rectangle around a region's points, in its plane.
    axes : (r, 3, 3) float64
        Unit x, y, z; z is the mean normal, x along the longer side.
    extent : (r, 2) float64
        Sides of the rectangle along x and y.
    low, high : (r,) float64
        Heights of the points over the centre.
    spacing : (r,) float64
        Of the region's points: at least that of the cloud, at most `SPARSE` times as much.
    noise : (r,) float64
        Deviation of neighbouring points across the surface, root mean square.
    """

    label: NDArray
    center: NDArray
    axes: NDArray
    extent: NDArray
    low: NDArray
    high: NDArray
    spacing: NDArray
    noise: NDArray

    def __len__(self):
        return len(self.center)


class Sheet:
    """Points in the tree's coordinates, with the graph of those that lie on one sheet.

    Attributes
    ----------
    position, normals : (n, 3) float64
    rows, columns : (e,) int32
        Edges of the graph, from each point to its neighbours of the same sheet.
    spacing : float
    local : (n,) float64
        Spacing around each point.
    noise2 : (n,) float64
        Mean squared deviation of its neighbours across the surface.
    """

    def __init__(self, points: SheetPoints):
        self.points = points
        self.spacing = points.spacing / points.diagonal
        self.position = (points.position.astype(np.float64) - points.middle) / points.diagonal
        self.normals = points.normals.astype(np.float64)
        self.local = np.clip(points.local / points.diagonal, self.spacing, SPARSE * self.spacing)
        count = len(self)
        kept, agreed, off2 = [np.zeros((0, 2), np.int32)], np.zeros(count, np.int32), np.zeros(count)
        own = np.arange(count, dtype=np.int32)
        for near in points.neighbours[:, 1:].T:  # one neighbour of all points at a time: memory
            edge = self.position[near] - self.position
            m = self.normals[near]
            off = np.abs(np.einsum("ij,ij->i", edge, self.normals + m)) / 2
            agree = (near >= 0) & (np.einsum("ij,ij->i", self.normals, m) > SAME_SIDE)
            agreed += agree
            off2 += np.where(agree, off * off, 0)
            length = np.maximum(np.sqrt(np.einsum("ij,ij->i", edge, edge)), self.spacing)
            keep = agree & (off <= STEEP * length)
            kept.append(np.stack([own[keep], near[keep]], axis=1))
        self.noise2 = off2 / (2 * np.maximum(agreed, 1))
        self.rows, self.columns = np.ascontiguousarray(np.concatenate(kept).T)

    def __len__(self):
        return len(self.position)

    @property
    def area(self) -> float:
        """Area of the points' surface, about, world units."""
        return float((self.local**2).sum()) * self.points.diagonal**2


def find_regions(sheet: Sheet, size: tuple[float, float]) -> Regions:
    """Divide the points into regions that fit into a patch.

    Parameters
    ----------
    size : (float, float)
        Longer and shorter side of a patch, in the tree's units.
    """
    side = max(float(np.sqrt(size[0] * size[1])) - 2 * WIDEN * sheet.spacing, 0.5 * size[1])
    label = lloyd(sheet, first_seeds(sheet, FIRST * side), side)
    label = connected(sheet, label)
    smallest = SMALL * (side / sheet.spacing) ** 2
    label = joined(sheet, label, smallest)
    return without_outliers(sheet, merged(sheet, fitting(sheet, label, size), size), smallest)


def missed_regions(sheet: Sheet, missed: NDArray, size: tuple[float, float]) -> Regions:
    """Return regions of the points `missed` (n,) bool alone, those of at least `LEFT` points."""
    label = connected(sheet, np.where(missed, 0, -1))
    sizes = np.bincount(label[label >= 0], minlength=1)
    _, label = renumbered(np.where((label >= 0) & (sizes[label] >= LEFT), label, -1))
    return fitting(sheet, label, size)


def connected(sheet: Sheet, label: NDArray) -> NDArray:
    """Split the regions whose points do not hang together; -1 stays."""
    inside = (label[sheet.rows] == label[sheet.columns]) & (label[sheet.rows] >= 0)
    graph = sparse.csr_array((np.ones(int(inside.sum()), np.int8), (sheet.rows[inside], sheet.columns[inside])),
                             shape=(len(label), len(label)))
    part = sparse.csgraph.connected_components(graph, directed=False)[1]
    return renumbered(np.where(label >= 0, part, -1))[1]


def beside(sheet: Sheet, label: NDArray) -> NDArray:
    """Return the label of each point and up to two of those within two steps of it in the graph, (3, n); -1: none."""
    out = np.full((3, len(label)), -1, np.int32)
    out[0] = label
    for source in (0, 1):
        near = out[source][sheet.columns]
        keep = np.flatnonzero((near >= 0) & (near != out[0][sheet.rows]))  # few: those at the borders
        rows, near = sheet.rows[keep], near[keep]
        for k in (1, 2):
            new = (out[k, rows] < 0) & (out[1, rows] != near)
            out[k, rows[new]] = near[new]
    return out


def joined(sheet: Sheet, label: NDArray, smallest: float) -> NDArray:
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


def framed(sheet: Sheet, label: NDArray) -> Regions:
    """Return the regions 0, 1, ... of `label` (n,) with their frames: mean normals, the smallest of 16 rectangles."""
    rows = np.flatnonzero(label >= 0)
    count = int(label.max(initial=-1)) + 1
    if not count:
        empty = np.zeros(0)
        return Regions(label, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 2)), *[empty] * 4)
    by_label = sparse.csr_array((rows, (label[rows], np.arange(len(rows)))), shape=(count, len(rows)))  # counting sort
    order, start = by_label.data.astype(np.int32), by_label.indptr.astype(np.int32)
    frames = np.zeros((count, 8), np.float32)
    frames[:, :6] = mean_frames(sheet, order, label[order], count)
    tree = sheet.points.tree
    device = tree.device
    out = device.empty((count, 5, 16), np.float32)
    device.kernel("build/region_extents.cl")((count,), (1,), count, device.upload(start), device.upload(order),
                                             tree.padded, tree.sorted, device.upload(frames), out)
    low_u, high_u, low_v, high_v, heights = device.download(out).astype(np.float64).transpose(1, 0, 2)
    across, along = high_u - low_u, high_v - low_v
    # Short longer sides count more: only they decide how many patches a cloud needs.
    best = np.argmin(np.maximum(across, along) ** 2 + 0.5 * across * along, axis=1)
    pick = lambda a: a[np.arange(count), best]  # noqa: E731
    z = frames[:, 3:6].astype(np.float64)
    u, v = frame_of_normals(z)
    c, s = np.cos(ANGLES[best])[:, None], np.sin(ANGLES[best])[:, None]
    x, y = c * u + s * v, c * v - s * u
    center = (frames[:, :3] + pick(low_u + high_u)[:, None] / 2 * x + pick(low_v + high_v)[:, None] / 2 * y)
    extent = np.stack([pick(across), pick(along)], axis=1)
    turn = (extent[:, 1] > extent[:, 0])[:, None]
    x, y = np.where(turn, y, x), np.where(turn, -x, y)
    sizes = np.maximum(np.diff(start), 1)
    mean = lambda values: np.bincount(label[rows], values[rows], count) / sizes  # noqa: E731
    return Regions(label, center, np.stack([x, y, z], axis=1), np.sort(extent, axis=1)[:, ::-1], heights[:, 0],
                   heights[:, 1], mean(sheet.local), np.sqrt(mean(sheet.noise2)))


def mean_frames(sheet: Sheet, order: NDArray, label: NDArray, count: int) -> NDArray:
    """Return means of places and unit mean normals (count, 6) float64 of the points `order` with labels `label`."""
    sizes = np.bincount(label, minlength=count)
    out = np.empty((count, 6))
    for k in range(3):
        out[:, k] = np.bincount(label, sheet.position[order, k], count) / sizes
        out[:, 3 + k] = np.bincount(label, sheet.normals[order, k], count)
    length = lengths_of(out[:, 3:], keepdims=True)
    out[:, 3:] = np.where(length > 1e-9, out[:, 3:] / np.maximum(length, 1e-9), [0, 0, 1])
    return out


def oversize(sheet: Sheet, regions: Regions, size: tuple[float, float]) -> NDArray:
    """Return which regions (r,) do not fit into a patch, or bend by more than `CONE`."""
    used = regions.label >= 0
    label = regions.label[used]
    cosine = np.einsum("ij,ij->i", sheet.normals[used], regions.axes[label, 2])
    # Single wild normals do not count: a twentieth of the points must be off.
    bent = np.bincount(label, cosine < CONE, len(regions)) > 0.05 * np.bincount(label, minlength=len(regions))
    several = np.bincount(label, minlength=len(regions)) >= 2 * LEAST
    room = np.maximum(np.array(size) - 2 * WIDEN * regions.spacing[:, None], 0.5 * size[1])
    return (bent & several) | (regions.extent > room).any(axis=1)


def fitting(sheet: Sheet, label: NDArray, size: tuple[float, float]) -> Regions:
    """Cut the regions of `label` until each fits into a patch."""
    out, count = np.full(len(label), -1), 0
    for _ in range(60):
        regions = framed(sheet, label)
        if not len(regions):
            break
        cut = oversize(sheet, regions, size)
        done = np.append(~cut, False)[label]
        number = np.cumsum(~cut) - 1 + count
        out[done] = number[label[done]]
        count += int((~cut).sum())
        if not cut.any():
            break
        label = halved(sheet, np.where(done, -1, label), cut)
    return framed(sheet, out)


def halved(sheet: Sheet, label: NDArray, cut: NDArray) -> NDArray:
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
    out[rows[upper]] = len(cut) + number[upper]
    return renumbered(out)[1]


def merged(sheet: Sheet, regions: Regions, size: tuple[float, float]) -> NDArray:
    """Return labels with pairs of neighbouring regions joined where one patch holds both.

    Each round joins pairs that want each other: those whose common rectangle wastes the least.
    """
    rows, columns = sheet.rows, sheet.columns
    free = np.ones(len(regions), bool)
    for _ in range(MERGES):
        count = len(regions)
        a, b = regions.label[rows], regions.label[columns]
        keep = (a != b) & (a >= 0) & (b >= 0)
        rows, columns, a, b = rows[keep], columns[keep], a[keep], b[keep]
        keep = free[a] & free[b]
        pair = np.unique(np.minimum(a, b)[keep] * np.int64(count) + np.maximum(a, b)[keep])
        a, b = pair // count, pair % count
        area, fits = common_rectangles(regions, a, b, size)
        own = regions.extent.prod(axis=1)
        first, second = mutual(a[fits], b[fits], (area - own[a] - own[b])[fits], count)
        if not len(first):
            break
        number = np.full(count + 1, -1)
        number[first] = number[second] = np.arange(len(first))
        joint = framed(sheet, number[regions.label])
        good = ~oversize(sheet, joint, size)
        free[first[~good]] = free[second[~good]] = False
        regions, free = replaced(regions, first[good], second[good], joint, good), np.delete(free, second[good])
    return regions.label


def replaced(regions: Regions, first: NDArray, second: NDArray, joint: Regions, good: NDArray) -> Regions:
    """Return `regions` with `second` joined to `first`; `joint` (where `good`) are the frames of the pairs."""
    number = np.arange(len(regions) + 1)
    number[second] = first
    kept = np.ones(len(regions), bool)
    kept[second] = False
    place = np.append(np.cumsum(kept) - 1, -1)
    number[-1] = len(regions)
    arrays = {"label": place[number[regions.label]]}
    for field in fields(Regions)[1:]:
        values = getattr(regions, field.name).copy()
        values[first] = getattr(joint, field.name)[good]
        arrays[field.name] = values[kept]
    return replace(regions, **arrays)


def common_rectangles(regions: Regions, a: NDArray, b: NDArray, size) -> tuple[NDArray, NDArray]:
    """Return the areas of rectangles that hold the rectangles of two regions, and whether a patch holds them."""
    swap = regions.extent[a].prod(axis=1) < regions.extent[b].prod(axis=1)
    a, b = np.where(swap, b, a), np.where(swap, a, b)
    offset = regions.center[b] - regions.center[a]
    low, high = -regions.extent[a] / 2, regions.extent[a] / 2
    for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        half = regions.extent[b] / 2 * corner
        place = offset + half[:, :1] * regions.axes[b, 0] + half[:, 1:] * regions.axes[b, 1]
        at = np.stack([np.einsum("ij,ij->i", place, regions.axes[a, k]) for k in (0, 1)], axis=1)
        low, high = np.minimum(low, at), np.maximum(high, at)
    sides = high - low
    room = np.maximum(np.array(size) - 2 * WIDEN * np.maximum(regions.spacing[a], regions.spacing[b])[:, None],
                      0.5 * size[1])
    facing = np.einsum("ij,ij->i", regions.axes[a, 2], regions.axes[b, 2]) > ALIKE
    # Rectangles of slanted regions overlap: a little more than the room is worth a try.
    return sides.prod(axis=1), (np.sort(sides, axis=1)[:, ::-1] <= 1.1 * room).all(axis=1) & facing


def mutual(a: NDArray, b: NDArray, cost: NDArray, count: int) -> tuple[NDArray, NDArray]:
    """Return the pairs that are each other's cheapest."""
    best = np.full(count, np.inf)
    np.minimum.at(best, a, cost)
    np.minimum.at(best, b, cost)
    both = np.flatnonzero((best[a] == cost) & (best[b] == cost))
    _, first = np.unique(a[both], return_index=True)  # equal costs: the first pair of each
    both = both[first]
    _, first = np.unique(b[both], return_index=True)
    both = both[first]
    both = both[~np.isin(b[both], a[both])]
    return a[both], b[both]


def without_outliers(sheet: Sheet, label: NDArray, smallest: float) -> Regions:
    """Return the regions without outliers: those of fewer than `LEAST` points, and small ones close to a larger one.

    The points of the latter, such as strays of overlaid scans, lie within reach of the larger region's patch.
    """
    sizes = np.bincount(label[label >= 0])
    large = np.append(sizes >= smallest, False)[label]  # -1: the last
    near = sheet.points.neighbours
    beside = (large[near] & (near >= 0)).any(axis=1)
    share = np.bincount(label[label >= 0], beside[label >= 0], len(sizes)) / np.maximum(sizes, 1)
    keep = (sizes >= min(LEAST, len(sheet))) & ((sizes >= smallest) | (share < 0.5))
    label = np.where(label >= 0, np.where(keep, np.cumsum(keep) - 1, -1)[np.maximum(label, 0)], -1)
    return framed(sheet, label)
