"""Global range images: the paper's conversion of point clouds (section 4.5).

The points are flushed into the z-buffers of orthographic views from directions spread evenly over the sphere; gaps of
one or two pixels are filled from their neighbours, never across a jump of depth; rectangles of pixels that show points
which no earlier view did become patches. What no view sees stays out: local range images (patch_local) cover more.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..device import Device
from ..errors import InputError
from ..surface.patch import PatchSurface
from ..surface.srgb import straight
from .patch_local import FINEST, SPACING, in_whole_cells, nothing_shows, with_bound
from .patch_points import SheetPoints, sheet_points
from .patch_search import searched
from .quantize import quantized
from .radius import robust_box

VIEWS = 32  # directions; those that show nothing new are left out
JUMP = 3.0  # difference of depth between neighbouring pixels, over their side, that is a jump
THICKNESS = 1.5  # points this far behind the nearest one of a pixel, over its side, count as the same sheet
FLAT = 0.35  # least cosine between a pixel's normal and the view for it to be a node
GOOD = 0.55  # the same for points that a view is chosen for and that count as shown
NOISY = 0.2  # noise over the spacing from which the images are smoothed
SPARSE = 0.6  # times the points' spacing: images with smaller pixels have more gaps than points
LEAST = 6  # points not shown before that a patch must show
SIDE_LIMIT = 1 << 14  # pixels of a range image along a side


@dataclass(eq=False)
class View:
    """An orthographic range image, units of the points' tree.

    Attributes
    ----------
    corner, axes : (3,), (3, 3) float64
        Middle of pixel (0, 0) at height 0; unit x, y, z, z to the eye.
    height : (h, w) float64
        NaN where there is nothing.
    facing : (h, w) float64
        Mean cosine between the points' normals and z.
    light : (h, w, 4) float64 or None
    """

    corner: NDArray
    axes: NDArray
    height: NDArray
    facing: NDArray
    light: NDArray | None


def convert(scan, request, device: Device, step) -> PatchSurface:
    """Return the patches of a cloud by global range images; see `clsurf.build.patches.build_patches`."""
    step(0.0, "points")
    points = sheet_points(scan, device)
    area = float((points.local.astype(np.float64) ** 2).sum())
    surface = searched(lambda spacing, progress: patches_at(points, spacing, request, progress), request, len(points),
                       SPACING * points.spacing, area, FINEST * points.spacing, points.diagonal,
                       lambda share, what: step(0.3 + 0.7 * share, what), SPARSE * points.spacing)
    step(1.0, "done")
    return surface


def sphere_directions(count: int) -> NDArray:
    """Return `count` unit directions (count, 3), evenly spread: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    radius = np.sqrt(np.maximum(1 - z * z, 0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def patches_at(points: SheetPoints, spacing: float, request, step) -> tuple[PatchSurface, float]:
    """Return the patches of views whose pixels are `spacing` wide, and their root mean square error; world units."""
    gap = spacing / points.diagonal
    position = (points.position.astype(np.float64) - points.middle) / points.diagonal
    normals = points.normals.astype(np.float64)
    directions = sphere_directions(request.views or VIEWS)
    box = robust_box(position.astype(np.float32))
    patch = np.full(len(points), -1)  # that shows each point
    left, parts, count = np.ones(len(directions), bool), [], 0
    for number in range(len(directions)):
        step(number / len(directions), "views")
        rest = np.flatnonzero(patch < 0)
        sample = rest[:: max(1, len(rest) // 20_000)]
        gain = ((normals[sample] @ directions.T) > GOOD).sum(axis=0) * left
        best = int(np.argmax(gain))
        if gain[best] < LEAST:
            break
        left[best] = False
        view = range_image(points, directions[best], box, gap)
        found, owner = extracted(view, position, normals, patch < 0, gap, request.nodes)
        if len(found[0]):
            patch = np.where(owner >= 0, owner + count, patch)
            parts.append(found)
            count += len(found[0])
    if not count:
        raise nothing_shows(points, spacing, ": use method local")
    corner, axes, height = (np.concatenate(part) for part in list(zip(*parts, strict=True))[:3])
    light = None if points.light is None else np.concatenate([part[3] for part in parts])
    colors = None
    if light is not None:
        colors = straight(light.reshape(-1, 4))
        colors = colors if request.precise else colors[:, :3]
    surface = quantized(corner * points.diagonal + points.middle, axes[:, 0] * spacing, axes[:, 1] * spacing,
                        height.ravel() * points.diagonal, request.nodes, colors, request.precise, origin=points.origin,
                        diagonal=points.diagonal, oriented=points.oriented)
    return with_bound(surface, points, patch)


def range_image(points: SheetPoints, direction: NDArray, box: NDArray, gap: float) -> View:
    """Return the range image seen from `direction`, pixels `gap` wide; gaps are filled and jumps cut."""
    tree = points.tree
    device = tree.device
    side = np.eye(3)[np.argmin(np.abs(direction))]
    x = np.cross(side, direction)
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(direction, x), direction])
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3) @ axes.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    columns, rows = (int(k) for k in np.ceil((high - low)[:2] / gap) + 3)
    if max(columns, rows) > SIDE_LIMIT:
        raise InputError(f"spacing: range images of {columns} x {rows} pixels, expected at most {SIDE_LIMIT} along a "
                         "side: use a larger spacing, or method local")
    corner = (low[0] - gap) * axes[0] + (low[1] - gap) * axes[1]
    colored = points.light is not None
    device.check_memory(sums=28 * rows * columns, nearest=4 * rows * columns)
    view = device.upload(np.concatenate([corner, axes.ravel()]).astype(np.float32))
    nearest, sums = device.empty((rows, columns), np.uint32), device.zeros((7, rows, columns), np.int32)
    device.fill(nearest, 0xFFFFFFFF)
    given = (tree.count, tree.padded, tree.sorted, view, 1 / gap, columns, rows, nearest)
    unit = gap / 1024
    device.kernel("build/splat_depths.cl")((tree.count,), (64,), *given)
    device.kernel("build/splat_means.cl", constants={"COLORED": int(colored)})(
        (tree.count,), (64,), *given, THICKNESS * gap, 1 / unit,
        device.upload(points.light) if colored else tree.sorted, sums)
    bits, sums = device.download(nearest), device.download(sums).astype(np.float64)
    number = np.maximum(sums[0], 1)
    front = -np.where(bits & 0x80000000, bits & 0x7FFFFFFF, ~bits).astype(np.uint32).view(np.float32).astype(np.float64)
    height = np.where(sums[0] > 0, front + sums[1] / number * unit, np.nan)
    light = np.ascontiguousarray(np.moveaxis(sums[3:] / number / 4096, 0, -1)) if colored else None
    image = View(corner, axes, height, sums[2] / number / 4096, light)
    hidden = neighbours_over(image.height, JUMP * gap) >= 3  # seen between the points of a nearer sheet
    image.height[hidden] = np.nan
    fill_gaps(image, gap)
    image.height[neighbours_over(image.height, JUMP * gap, diagonal=False) > 0] = np.nan
    if points.noise > NOISY:
        smooth(image, gap)
    return image


def shifted(image: NDArray, j: int, i: int) -> NDArray:
    """Return the image moved so that each pixel holds its neighbour (j rows, i columns) on; NaN beyond the edge."""
    out = np.full_like(image, np.nan)
    h, w = image.shape[:2]
    out[max(0, -j):h - max(0, j), max(0, -i):w - max(0, i)] = image[max(0, j):h + min(0, j), max(0, i):w + min(0, i)]
    return out


AROUND = [(j, i) for j in (-1, 0, 1) for i in (-1, 0, 1) if (j, i) != (0, 0)]


def neighbours_over(height: NDArray, limit: float, diagonal: bool = True) -> NDArray:
    """Return how many neighbours (h, w) of each pixel are nearer to the eye by more than `limit`."""
    steps = AROUND if diagonal else [step for step in AROUND if 0 in step]
    return sum((shifted(height, *step) - height > limit).astype(np.int8) for step in steps)


def fill_gaps(image: View, gap: float) -> None:
    """Fill gaps of one or two pixels, in place, by interpolation between known pixels on opposite sides.

    Two of the four directions through a pixel must have such a pair; where the pairs' depths differ by a jump, the gap
    stays.
    """
    known = np.isfinite(image.height)
    rows, columns = np.nonzero(ndimage.binary_dilation(known, np.ones((3, 3), bool)) & ~known)
    padded = np.pad(image.height, 2, constant_values=np.nan)
    pairs = []  # weight, first and second pixel (places in the padded image) of the nearest pair in each direction
    for dj, di in ((0, 1), (1, 0), (1, 1), (1, -1)):
        at = lambda k: (rows + 2 + k * dj, columns + 2 + k * di)  # noqa: B023, E731
        one, two, back_one, back_two = (np.isfinite(padded[at(k)]) for k in (1, 2, -1, -2))
        ahead, behind = np.where(one, 1, 2), np.where(back_one, 1, 2)
        whole = (one | two) & (back_one | back_two) & (ahead + behind < 4)
        pairs.append((whole, behind / (ahead + behind), at(ahead), at(-behind)))
    number = sum(whole.astype(int) for whole, *_ in pairs)

    def between(values):
        values = np.pad(values, 2, constant_values=np.nan)
        total, low, high = np.zeros(len(rows)), np.full(len(rows), np.inf), np.full(len(rows), -np.inf)
        for whole, share, a, b in pairs:
            a, b = np.where(whole, values[a], 0), np.where(whole, values[b], 0)
            total += share * a + (1 - share) * b
            low = np.where(whole, np.minimum(low, np.minimum(a, b)), low)
            high = np.where(whole, np.maximum(high, np.maximum(a, b)), high)
        return total / np.maximum(number, 1), high - low

    height, spread = between(image.height)
    fill = (number >= 2) & (spread < JUMP * gap)
    for channel in (image.facing, *([] if image.light is None else np.moveaxis(image.light, -1, 0))):
        channel[rows[fill], columns[fill]] = between(channel)[0][fill]
    image.height[rows[fill], columns[fill]] = height[fill]


def smooth(image: View, gap: float) -> None:
    """Average each height, in place, with its neighbours within one pixel of it (weights 1, 2, 4)."""
    total, weight = 4 * image.height, np.full(image.height.shape, 4.0)
    for j, i in AROUND:
        near = shifted(image.height, j, i)
        w = np.where(np.abs(near - image.height) < gap, 2.0 / (1 if 0 in (j, i) else 2), 0.0)
        total, weight = total + w * np.nan_to_num(near), weight + w
    image.height[:] = total / weight


def extracted(view: View, position: NDArray, normals: NDArray, open_points: NDArray, gap: float, nodes):
    """Cut rectangles of m x n pixels that show points which nothing showed before.

    Returns
    -------
    patches : tuple
        corner (p, 3), axes (p, 3, 3), height (p, n, m) with NaN, light (p, n, m, 4) or None.
    owner : (n,) int
        Patch of every point that is shown now, -1 for the others.
    """
    m, n = nodes
    rows, columns = view.height.shape
    usable = np.isfinite(view.height) & (view.facing > FLAT)
    rest = np.flatnonzero(open_points & (normals @ view.axes[2] > GOOD))
    offset = position[rest] - view.corner
    u, v, w = (offset @ axis for axis in view.axes)
    i, j = np.floor(u / gap).astype(np.int64), np.floor(v / gap).astype(np.int64)
    inside = (i >= 0) & (j >= 0) & (i < columns - 1) & (j < rows - 1)
    rest, i, j, u, v, w = (a[inside] for a in (rest, i, j, u, v, w))
    a, b, c, d = (np.where(usable, view.height, np.nan)[j + dj, i + di] for dj, di in ((0, 0), (0, 1), (1, 0), (1, 1)))
    s, t = u / gap - i, v / gap - j
    away = np.abs((1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * c + s * d) - w)
    shown = away < gap  # NaN is not
    rest, i, j = rest[shown], i[shown], j[shown]
    needed = np.zeros(view.height.shape, bool)
    needed[j, i] = True  # cells; a margin of one more cell joins what earlier views showed
    needed = ndimage.binary_dilation(needed, np.ones((3, 3), bool))
    node = ndimage.binary_dilation(needed, np.ones((2, 2), bool), origin=(-1, -1)) & usable
    columns_of, rows_of, place = rectangles(i, j, (m - 1, n - 1))
    owner = np.full(len(position), -1)
    owner[rest] = place
    grid_i, grid_j = columns_of[:, None, None] + np.arange(m), rows_of[:, None, None] + np.arange(n)[:, None]
    grid_i, grid_j = np.broadcast_arrays(grid_i, grid_j)
    valid = (grid_i >= 0) & (grid_j >= 0) & (grid_i < columns) & (grid_j < rows)
    grid_i, grid_j = np.clip(grid_i, 0, columns - 1), np.clip(grid_j, 0, rows - 1)
    height = np.where(in_whole_cells(valid & node[grid_j, grid_i]), view.height[grid_j, grid_i], np.nan)
    corner = view.corner + gap * (columns_of[:, None] * view.axes[0] + rows_of[:, None] * view.axes[1])
    axes = np.broadcast_to(view.axes, (len(corner), 3, 3))
    return (corner, axes, height, None if view.light is None else view.light[grid_j, grid_i]), owner


def rectangles(i: NDArray, j: NDArray, size) -> tuple[NDArray, NDArray, NDArray]:
    """Return the first columns and rows (p,) of rectangles of cells, and the rectangle (c,) of every cell, -1: none.

    The rectangles tile the image in rows; the rows start where the first cell is, and each row's rectangles where its
    first cell is, and again after every gap. Rectangles with less than `LEAST` cells are left out.
    """
    place = np.full(len(i), -1)
    if not len(i):
        return place, place, place
    row = (j - j.min()) // size[1]
    key = row * (int(i.max()) + 2) + i
    order = np.argsort(key, kind="stable")
    starts, first, last = [], -1, -1
    number = np.empty(len(order), np.int64)
    unique, inverse = np.unique(key[order], return_inverse=True)
    of_unique = np.empty(len(unique), np.int64)
    width = int(i.max()) + 2
    for k, value in enumerate(unique.tolist()):
        if value // width != last or value - first >= size[0]:
            first, last = value, value // width
            starts.append(value)
        of_unique[k] = len(starts) - 1
    number[order] = of_unique[inverse]
    starts = np.array(starts)
    keep = np.bincount(number, minlength=len(starts)) >= LEAST
    place = np.where(keep[number], (np.cumsum(keep) - 1)[number], -1)
    return starts[keep] % width, starts[keep] // width * size[1] + j.min(), place
