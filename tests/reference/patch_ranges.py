"""NumPy twins of the kernels that turn range images into patches, each named as its kernel."""

import numpy as np

MISSING = 1e15


def range_samples(values, matrix, depth):
    """Positions (h, w, 3) of depth (h, w) or points (h, w, 3) by the (3, 4) matrix."""
    values = np.asarray(values, np.float64)
    if depth:
        v, u = np.indices(values.shape)
        values = np.stack([values * u, values * v, values], axis=-1)
    return values @ matrix[:, :3].T + matrix[:, 3]


def smooth_depth(disparity, radius, gate):
    """Depth (h, w) from the weighted plane through the disparities around each pixel."""
    h, w = disparity.shape
    out = np.full((h, w), np.nan)
    for y in range(h):
        for x in range(w):
            if np.isnan(disparity[y, x]):
                continue
            rows, sides, weights = [], [], []
            for j in range(max(-radius, -y), min(radius, h - 1 - y) + 1):
                for i in range(max(-radius, -x), min(radius, w - 1 - x) + 1):
                    difference = disparity[y + j, x + i] - disparity[y, x]
                    near, space = 1 - (difference / gate) ** 2, 1 - (i * i + j * j) / (radius + 1) ** 2
                    if near > 0 and space > 0:
                        rows.append((1, i, j))
                        sides.append(difference)
                        weights.append(near ** 2 * space)
            rows, weights = np.array(rows, float), np.array(weights)
            normal = rows.T @ (weights[:, None] * rows) + np.diag([0, 1, 1]) * 1e-3 * weights.sum()
            value = np.linalg.solve(normal, rows.T @ (weights * sides))[0]
            out[y, x] = 1 / (disparity[y, x] + np.clip(value, -gate, gate))
    return out


def torn(p, q, eye, jump, noise, pitch, squared):
    """Whether a depth jump lies between two samples."""
    edge, view = q - p, eye - (p + q) / 2
    along2 = (edge @ view) ** 2 / (view @ view)
    across2 = edge @ edge - along2
    step = noise * (view @ view if squared else 1)
    gap = pitch > 0 and across2 > 9 * pitch ** 2
    return gap or not (along2 <= jump ** 2 * max(across2, 0.25 * pitch ** 2) or along2 <= step ** 2)


def range_cells(points, eye, jump, noise, pitch, squared):
    """Which cells (h, w) of a grid of points (h, w, 3) are surface; the last row and column never are."""
    h, w = points.shape[:2]
    out = np.zeros((h, w), bool)
    for y in range(h - 1):
        for x in range(w - 1):
            four = [points[y, x], points[y, x + 1], points[y + 1, x], points[y + 1, x + 1]]
            out[y, x] = np.isfinite(four).all() and not any(
                torn(four[a], four[b], eye, jump, noise, pitch, squared) for a in range(4) for b in range(a))
    return out


def cell_areas(points):
    """Area vectors (h, w, 3) of the cells, NaN in the last row and column."""
    out = np.full(points.shape, np.nan)
    out[:-1, :-1] = np.cross(points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]) / 2
    return out


def range_weights(points, cells, border, eye, unit, ramp):
    """Weights (h, w) of the samples, 0 away from every cell."""
    h, w = cells.shape
    total, count = np.zeros((h, w, 3)), np.zeros((h, w))
    areas = np.where(cells[..., None], cell_areas(points), 0)
    for j in (0, 1):
        for i in (0, 1):
            total[j:, i:] += areas[:h - j, :w - i]
            count[j:, i:] += cells[:h - j, :w - i]
    view = eye - points
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.linalg.norm(total, axis=2)
        facing = np.abs((total * view).sum(axis=2)) / (size * np.linalg.norm(view, axis=2))
        density = np.minimum(unit ** 2 * count / size, 4)
    edge = np.minimum(1, (border + 0.5) / ramp)
    return np.where(count > 0, edge ** 2 * facing * density, 0)


def fit_fragments(points, weights, mask, sign, least):
    """Figures (20,) of the fragment whose cells are in `mask` (h, w)."""
    rows, columns = np.nonzero(mask)
    four = np.stack([points[rows + j, columns + i] for j in (0, 1) for i in (0, 1)])
    four_weights = np.stack([weights[rows + j, columns + i] for j in (0, 1) for i in (0, 1)])
    areas = sign * cell_areas(points)[rows, columns]
    center, normal = four.mean(axis=(0, 1)), areas.sum(axis=0)
    normal /= np.linalg.norm(normal)
    across = (four[1] - four[0] + four[3] - four[2]) / 2
    down = (four[2] - four[0] + four[3] - four[1]) / 2
    step_x, step_y = (np.linalg.norm(a, axis=1).mean() for a in (across, down))
    x = sign * np.cross(down.sum(axis=0), normal) if step_y > step_x else across.sum(axis=0)
    x -= (x @ normal) * normal
    x /= np.linalg.norm(x)
    size = np.linalg.norm(areas, axis=1)
    local = (four - center).reshape(-1, 3) @ np.stack([x, np.cross(normal, x), normal]).T
    extent = np.stack([np.minimum(local.min(axis=0), 0), np.maximum(local.max(axis=0), 0)], axis=1)
    behind = size[areas @ normal < least * size].sum() / size.sum()
    return np.concatenate([[len(rows)], center, normal, x, [step_x, step_y, behind], extent.ravel(),
                           [four_weights.mean()]])


def rasterised(place, size, points, weights, colors, mask, sign, steepest=0.2):
    """Yield (node, height, weight, colour) of every node in every triangle of the cells in `mask`."""
    m, n = size
    local = points - place[:3]
    uvh = np.stack([local @ place[3:6], local @ place[6:9], local @ place[9:12]], axis=-1)
    xx, yy = place[3:6] @ place[3:6], place[6:9] @ place[6:9]
    for r, c in zip(*np.nonzero(mask), strict=True):
        for corners in (((r, c), (r, c + 1), (r + 1, c + 1)), ((r, c), (r + 1, c + 1), (r + 1, c))):
            at = tuple(np.array(corners).T)
            (u, v, h), w, rgb = uvh[at].T, weights[at], colors[at]
            solve = np.stack([u, v, np.ones(3)], axis=1)
            if sign * np.linalg.det(np.stack([u[1:] - u[0], v[1:] - v[0]])) <= 0:
                continue
            slope = np.linalg.solve(solve, h)
            if slope[0] ** 2 * xx + slope[1] ** 2 * yy > 1 / steepest ** 2 - 1:
                continue
            for j in range(max(0, int(np.ceil(v.min() - 1e-4))), min(n - 1, int(np.floor(v.max() + 1e-4))) + 1):
                for i in range(max(0, int(np.ceil(u.min() - 1e-4))), min(m - 1, int(np.floor(u.max() + 1e-4))) + 1):
                    share = np.linalg.solve(solve.T, (i, j, 1))
                    if (share >= -1e-4).all():
                        yield j * m + i, share @ h, share @ w, share @ rgb


def widened(reference, size, rounds):
    """The reference (nodes,) continued by `rounds` nodes."""
    m, n = size
    grid = reference.reshape(n, m).copy()
    for _ in range(rounds):
        before, grid = grid, grid.copy()
        inside = lambda x, y: 0 <= x < m and 0 <= y < n  # noqa: E731
        for y, x in np.argwhere(np.isnan(before)):
            lines, singles = [], []
            for j in (-1, 0, 1):
                for i in (-1, 0, 1):
                    if (i or j) and inside(x + i, y + j) and np.isfinite(before[y + j, x + i]):
                        singles.append(before[y + j, x + i])
                        if inside(x + 2 * i, y + 2 * j) and np.isfinite(before[y + 2 * j, x + 2 * i]):
                            lines.append(2 * singles[-1] - before[y + 2 * j, x + 2 * i])
            if singles:
                grid[y, x] = np.mean(lines or singles)
    return grid.ravel()


def resample_ranges(place, size, parts, margin=2):
    """Heights (nodes,) and colours (nodes, 3) of a patch; NaN where no cell is.

    Parameters
    ----------
    place : (13,) float64
    size : (int, int)
    parts : list of (points, weights, colors, mask, sign)
        The own fragment, the other cells of the own image, the fragments' cells of each other image.
    """
    nodes, tolerance = size[0] * size[1], place[12]
    sums, heights, lights = np.zeros(nodes), np.zeros(nodes), np.zeros((nodes, 3))
    reference = np.full(nodes, np.nan)
    for number, part in enumerate(parts):
        image, taken = np.full(nodes, np.nan), sums > 0
        weight, light = np.zeros(nodes), np.zeros((nodes, 3))
        for node, h, w, rgb in rasterised(place, size, *part):
            if number == 0:
                better = not h <= image[node]
            else:
                gap = abs(h - reference[node])
                better = (gap < tolerance and not (number == 1 and taken[node])
                          and not gap >= abs(image[node] - reference[node]))
            if better:
                image[node], weight[node], light[node] = h, w, rgb
        found = np.isfinite(image)
        t = (image - reference) / tolerance if number > 1 else np.zeros(nodes)
        w = np.where(found, (weight + 1e-6) * (1 - t ** 2) ** 2, 0)
        sums += w
        heights += np.where(found, w * image, 0)
        lights += w[:, None] * light
        if number == 0:
            reference = widened(image, size, margin)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(sums > 0, heights / sums, np.nan), lights / sums[:, None]


def range_distances(place, size, heights, points, mask, parity, reach):
    """Codes (h, w) uint8 of the corners of the cells in `mask`, 127 elsewhere; `parity` (h, w): those in question."""
    m, n = size
    grid = heights.reshape(n, m)
    corner = np.zeros(mask.shape, bool)
    for j in (0, 1):
        for i in (0, 1):
            corner[j:, i:] |= mask[:mask.shape[0] - j, :mask.shape[1] - i]

    def cell(u, v):
        if not (0 <= u <= m - 1 and 0 <= v <= n - 1):
            return None
        i, j = min(int(u), m - 2), min(int(v), n - 2)
        four = grid[j:j + 2, i:i + 2]
        return (u - i, v - j, four) if np.isfinite(four).all() else None

    out = np.full(mask.shape, 127, np.uint8)
    for r, c in np.argwhere(corner & parity):
        local = points[r, c] - place[:3]
        u, v, d = local @ place[3:6], local @ place[6:9], local @ place[9:12]
        found = cell(u, v)
        if found is None:
            continue
        s, t, four = found
        there = (1 - t) * ((1 - s) * four[0, 0] + s * four[0, 1]) + t * ((1 - s) * four[1, 0] + s * four[1, 1])
        distance = 100 * np.sqrt(abs(d - there) / place[12])
        if distance <= 100:
            inside = all(cell(u + a * reach, v + b * reach) is not None for a in (-1, 1) for b in (-1, 1))
            out[r, c] = int(np.ceil(distance)) | (128 if inside else 0)
    return out
