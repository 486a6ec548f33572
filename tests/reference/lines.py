"""Twins of kernels/analysis/*line*.cl, *strokes.cl and contour_edges.cl: planes (h, w) without margins, float64."""

import numpy as np

HIT, LINK_RIGHT, LINK_DOWN = 1, 2, 4
LIMIT, SLACK, STEEPEST, CLEAR, FLATTEST = 6.0, 0.75, 100.0, 2, 0.02


def camera_rays(camera, size):
    """Rays G (h, w, 3) that a depth multiplies (orthographic: is added along the view axis to), their steps, kind."""
    p = camera.projection(size)
    right, up, back = camera.rotation
    y, x = np.mgrid[:size[1], :size[0]] + 0.5
    g = ((x - p.cx) / p.fx)[..., None] * right + ((p.cy - y) / p.fy)[..., None] * up
    return (g - back if p.perspective else g), right / p.fx, -up / p.fy, -back, p.perspective


def line_slopes(camera, depth, normal):
    size = depth.shape[::-1]
    g, gx, gy, forward, perspective = camera_rays(camera, size)
    ray = g if perspective else np.broadcast_to(forward, g.shape)
    along = (normal * ray).sum(axis=-1)
    facing = np.where(along < -1e-4, along, -1e-4)
    sx = np.clip(-(normal @ gx) / (facing * np.linalg.norm(gx)), -STEEPEST, STEEPEST)
    sy = np.clip(-(normal @ gy) / (facing * np.linalg.norm(gy)), -STEEPEST, STEEPEST)
    return sx, sy, (np.cross(normal, ray)**2).sum(axis=-1) / (ray**2).sum(axis=-1)


def line_links(camera, depth, slope_x, slope_y):
    _, gx, gy, _, perspective = camera_rays(camera, depth.shape[::-1])
    bits = np.where(np.isfinite(depth), HIT, 0)

    def linked(a, b, s, t, step):
        footprint = np.minimum(a, b) * step if perspective else step
        mean = (s + t) / 2
        with np.errstate(invalid="ignore"):
            return np.abs((b - a) / footprint - mean) <= LIMIT + SLACK * np.abs(mean)

    bits[:, :-1] |= LINK_RIGHT * linked(depth[:, :-1], depth[:, 1:], slope_x[:, :-1], slope_x[:, 1:],
                                        np.linalg.norm(gx))
    bits[:-1] |= LINK_DOWN * linked(depth[:-1], depth[1:], slope_y[:-1], slope_y[1:], np.linalg.norm(gy))
    return bits


def line_values(bits, sine2, field, strength, sign=1.0, other=None, axis=None, sines=False):
    """Return planes (2, h, w), or with an axis (7, h, w)."""
    hit = bits & HIT > 0
    f, s = np.nan_to_num(field, nan=0, posinf=0, neginf=0), np.nan_to_num(strength)
    if other is not None:
        s = np.where(np.abs(np.nan_to_num(other)) > np.abs(s), 0, s)
    s = np.abs(s) if sign == 0 else sign * s
    if sines:
        f, s = f * np.nan_to_num(sine2), s * np.nan_to_num(sine2)
    f, s = np.where(hit, f, 0), np.where(hit, s, 0)
    if axis is None:
        return np.stack([f, s])
    t = np.where(hit[..., None], np.nan_to_num(axis), 0)
    return np.stack([*(f * t[..., c] for c in range(3)), s, *(t[..., c] for c in range(3))])


def _windows(values, link, weights):
    """Means along the last axis over windows that end at missing links, and which windows reach CLEAR pixels."""
    radius, n = len(weights) - 1, link.shape[-1]
    total, sums = np.zeros_like(values), np.zeros(link.shape)
    clear = np.zeros(link.shape, bool)
    for i in np.ndindex(link.shape):
        row, x = link[i[:-1]], i[-1]
        right = left = x
        while right < n - 1 and right < x + radius and row[right]:
            right += 1
        while left > 0 and left > x - radius and row[left - 1]:
            left -= 1
        w = weights[np.abs(np.arange(left, right + 1) - x)]
        total[(slice(None), *i)] = (values[(slice(None), *i[:-1], slice(left, right + 1))] * w).sum(axis=-1)
        sums[i] = w.sum()
        clear[i] = right - x >= CLEAR and x - left >= CLEAR
    return total / sums, clear


def smooth_lines(bits, values, weights):
    """Return the field, NaN where it is not clear, and the strength."""
    axis = len(values) == 7
    rows, clear_row = _windows(values[:4 if axis else 2].astype(np.float64), bits & LINK_RIGHT > 0, weights)
    flip = lambda a: np.swapaxes(a, -1, -2)  # noqa: E731
    both, clear = _windows(flip(rows), flip(bits & LINK_DOWN > 0), weights)
    both, clear = flip(both), flip(clear)
    hit = bits & HIT > 0
    padded = np.pad(clear_row & hit, ((CLEAR, CLEAR), (0, 0)))
    for j in range(2 * CLEAR + 1):
        clear = clear & padded[j:j + len(hit)]
    field = (both[:3] * values[4:]).sum(axis=0) if axis else both[0]
    return np.where(clear & hit, field, np.nan), both[-1]


def line_edges(camera, depth, field, strength, least, axis=None, extremum=1):
    """Return bytes (h, w): 1 for the edge to the right, 2 for the one downwards."""
    g, _, _, forward, perspective = camera_rays(camera, depth.shape[::-1])
    place = depth[..., None] * g if perspective else g + depth[..., None] * forward
    codes = np.zeros(depth.shape, np.uint8)
    for code, a, b in ((1, np.s_[:, :-1], np.s_[:, 1:]), (2, np.s_[:-1], np.s_[1:])):
        f, h = field[a], field[b]
        good = np.isfinite(f) & np.isfinite(h)
        if axis is not None:
            t, u = axis[a], axis[b]
            sign = np.where((t * u).sum(axis=-1) > 0, 1.0, -1.0)
            h = h * sign
            along = ((t + sign[..., None] * u) * (place[b] - place[a])).sum(axis=-1)
            k = np.abs(strength[a] + strength[b]) / 2
            good &= (h - f) * along * extremum < 0
            good &= np.abs(h - f) >= FLATTEST * k**3 * np.abs(along) / 2
        with np.errstate(all="ignore"):
            good &= (f > 0) != (h > 0)
            good &= strength[a] + f / (f - h) * (strength[b] - strength[a]) >= least
        codes[a] |= np.where(good, code, 0).astype(np.uint8)
    return codes


def contour_edges(bits, depth):
    codes = np.zeros(bits.shape, np.uint8)
    h, w = bits.shape
    for code, link, (dx, dy) in ((1, LINK_RIGHT, (1, 0)), (2, LINK_DOWN, (0, 1))):
        for y in range(h - dy):
            for x in range(w - dx):
                own, after = bits[y, x], bits[y + dy, x + dx]
                if own & link or not (own | after) & HIT:
                    continue
                if own & after & HIT:
                    if depth[y + dy, x + dx] > depth[y, x]:
                        fringe = not after & link
                    else:
                        fringe = y < dy or x < dx or not bits[y - dy, x - dx] & link
                    if fringe:
                        continue
                codes[y, x] |= code
    return codes


def line_points(edges, columns, bits, depth, sine2, field=None, strength=None, axis=None):
    """Return points (n, 4) of edges by number; without a field, those of contours."""
    out = []
    for edge in edges:
        down, (y, x) = edge & 1, divmod(edge >> 1, columns)
        a, b = (y, x), (y + down, x + 1 - down)
        if field is not None:
            f, g = field[a], field[b]
            g = g if axis is None or axis[a] @ axis[b] > 0 else -g
            share = 0.5 if f == g else f / (f - g)
            z, s = depth[a] + share * (depth[b] - depth[a]), strength[a] + share * (strength[b] - strength[a])
        else:
            from_b = bool(bits[b] & HIT) and not depth[a] <= depth[b]
            near = b if from_b else a
            inner = tuple(2 * n - o for n, o in zip(near, a if from_b else b, strict=True))
            inside = 0 <= inner[0] < bits.shape[0] and 0 <= inner[1] < bits.shape[1]
            joint = near if from_b else inner
            on = inside and bits[joint] & (LINK_DOWN if down else LINK_RIGHT)
            q = 1 - sine2[near]
            fall = 1 - sine2[inner] - q if on else 0
            beyond = q / fall if fall > 0 else 1
            beyond = beyond if beyond < 1 else 0.5
            share = 1 - beyond if from_b else beyond
            z, s = depth[near], 1 if bits[a] & bits[b] & HIT else 2
        out.append((x + 0.5 + (0 if down else share), y + 0.5 + (share if down else 0), z, s))
    return np.array(out)


def draw_strokes(points, segments, colors, size):
    """Return the ink (h, w), 0 to 1, and the colour's number of the strongest stroke."""
    y, x = np.mgrid[:size[1], :size[0]] + 0.5
    ink, color = np.zeros(x.shape), np.zeros(x.shape, int)
    for (i, j), number in zip(segments, colors, strict=True):
        a, b = points[i].astype(np.float64), points[j].astype(np.float64)
        d = b[:2] - a[:2]
        t = np.clip(((x - a[0]) * d[0] + (y - a[1]) * d[1]) / max(d @ d, 1e-30), 0, 1)
        far = np.hypot(x - a[0] - t * d[0], y - a[1] - t * d[1])
        half, tone = a[2] + t * (b[2] - a[2]), a[3] + t * (b[3] - a[3])
        cover = np.clip(np.minimum(far + 0.5, half) - np.maximum(far - 0.5, -half), 0, None) * tone
        color = np.where((cover > ink) & (cover > 0), number, color)
        ink = np.maximum(ink, cover)
    return ink, color


def blend_strokes(picture, ink, color, palette):
    return picture + ink[..., None] * (palette[color] - picture)
