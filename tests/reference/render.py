"""Plain float64 twins of the kernels in kernels/render: slow, obvious, and the specification.

A `view` is the view buffer (32,) of clsurf.render.tiles.view_floats; `records` are rows of 32 floats as in
kernels/common/slim.clh. Pixels are (p, 2) positions of their centres.
"""

from types import SimpleNamespace

import numpy as np

from clsurf.surface.slim import frame_of_normals

ALPHA, SUPPORT, TRIES, BACK_BIAS, INTERNAL_SCALE, ERROR_RADII, RIM_COSINE = 0.8, 0.3, 4, 0.25, 1.5, 32, 0.4
BUCKETS = 2048
(XR, YR, T_REF, INV_T, UX, UY, VX, VY, WX, WY, U0, V0, W0, DU, DV, DW, K0, K1, K2, K3, K4, K5, RADIUS, RADIUS_PX,
 FOOT_LO, FOOT_HI, BIAS, REACH, K6, K7, K8, K9) = range(32)


def opened(view):
    """The view buffer by name."""
    v = np.asarray(view, np.float64)
    return SimpleNamespace(rotation=v[:9].reshape(3, 3), scale=v[9], offset=v[10:13], fx=v[13], fy=v[14], cx=v[15],
                           cy=v[16], perspective=v[17] > 0, near=v[18], size=v[19:21], lod=v[21], first_depth=v[22],
                           bucket=v[23])


def in_view(view, points):
    return opened(view).scale * points.astype(np.float64) @ opened(view).rotation.T + opened(view).offset


def is_small(view, surface):
    v = opened(view)
    depth = -in_view(view, surface.centers)[:, 2] if v.perspective else 1.0
    size = np.where(surface.leaf, surface.radii, np.maximum(surface.radii, ERROR_RADII * surface.fit_error))
    return 2 * v.scale * max(v.fx, v.fy) * size <= v.lod * depth


def select_slim(view, surface):
    """Surfels that a walk from the roots reaches when only leaves and small surfels stop it."""
    small, seen, todo = is_small(view, surface), set(), list(surface.roots)
    while todo:
        i = int(todo.pop())
        if i in seen:
            continue
        seen.add(i)
        if not surface.leaf[i] and not small[i]:
            todo += list(surface.children[surface.child_offset[i]:surface.child_offset[i + 1]])
    return np.isin(np.arange(len(surface)), list(seen))


def drawn(view, surface):
    """The cut: reached, and a leaf or small."""
    return select_slim(view, surface) & (surface.leaf | is_small(view, surface))


def project_slim(view, surface):
    """Records (n, 32) of all surfels, drawn or not; the footprint is left out."""
    v = opened(view)
    c = in_view(view, surface.centers)
    own = surface.radii.astype(np.float64) * np.where(surface.leaf, 1, INTERNAL_SCALE)
    r = v.scale * own
    n = surface.normals.astype(np.float64)
    axes = [np.asarray(a, np.float64) @ v.rotation.T for a in (*frame_of_normals(n), n)]
    depth = -c[:, 2]
    t = np.maximum(depth, 0.25 * r) if v.perspective else depth
    inv = 1 / t if v.perspective else np.zeros_like(t)
    ray = np.stack([c[:, 0] * inv, c[:, 1] * inv, -np.ones_like(t)], axis=1)
    at = c[:, :2] * inv[:, None] if v.perspective else c[:, :2]
    out = np.zeros((len(r), 32))
    out[:, XR], out[:, YR], out[:, T_REF], out[:, INV_T] = v.cx + v.fx * at[:, 0], v.cy - v.fy * at[:, 1], t, inv
    pixel = t if v.perspective else np.ones_like(t)
    for i, axis in enumerate(axes):
        start = axis[:, 2] * (depth - t) / r
        out[:, UX + 2 * i], out[:, UY + 2 * i] = axis[:, 0] * pixel / v.fx / r, -axis[:, 1] * pixel / v.fy / r
        out[:, U0 + i] = start
        out[:, DU + i] = (axis * ray).sum(axis=1) / r - inv * start
    k = surface.coefficients.astype(np.float64)
    order = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])[:k.shape[1]]
    k = k * own[:, None] ** (order - 1)
    if k.shape[1] > 1:
        k[:, 4] /= 2
    out[:, K0:K0 + min(k.shape[1], 6)] = k[:, :6]
    out[:, K6:K6 + max(k.shape[1] - 6, 0)] = k[:, 6:]
    out[:, RADIUS], out[:, RADIUS_PX] = r, r * inv if v.perspective else r
    out[:, BIAS], out[:, REACH] = BACK_BIAS * r, r + (t - depth)
    return out


def height(degree, k, u, v):
    """The height polynomial of records k (..., 32) at (u, v), and its gradient; unit ball."""
    h, gu, gv = k[..., K0] + 0 * u, 0 * u, 0 * u
    if degree >= 2:
        a, b, c = k[..., K3], 2 * k[..., K4], k[..., K5]
        h = h + k[..., K1] * u + k[..., K2] * v + a * u * u + b * u * v + c * v * v
        gu, gv = k[..., K1] + 2 * a * u + b * v, k[..., K2] + b * u + 2 * c * v
    if degree >= 3:
        d, e, f, g = k[..., K6], k[..., K7], k[..., K8], k[..., K9]
        h = h + d * u**3 + e * u * u * v + f * u * v * v + g * v**3
        gu, gv = gu + 3 * d * u * u + 2 * e * u * v + f * v * v, gv + e * u * u + 2 * f * u * v + 3 * g * v * v
    return h, gu, gv


def ray_poly(degree, k, p, d):
    """Coefficients a, b, c, d of f(s) = c + b s + a s^2 + d s^3 along p + s d; p and d are (..., 3) in the unit ball.

    By interpolation at four points: independent of the kernel's algebra.
    """
    s = np.array([0.0, 1.0, -1.0, 2.0])
    q = [p + x * d for x in s]
    f = [at[..., 2] - height(degree, k, at[..., 0], at[..., 1])[0] for at in q]
    cubic = np.linalg.solve(np.vander(s, 4, increasing=True), np.stack([np.ravel(x) for x in f]))
    c, b, a, e = (row.reshape(f[0].shape) for row in cubic)
    return a, b, c, e


def ray_root(degree, poly, side):
    """Root where f falls (side 1) or rises (-1), |f'| there, and whether there is one."""
    a, b, c, e = poly
    with np.errstate(all="ignore"):
        if degree == 1:
            return -c / b, -side * b, -side * b > 0
        disc = b * b - 4 * a * c
        below = side * np.sqrt(np.maximum(disc, 0)) - b
        s = 2 * c / below
        if degree == 2:
            return s, np.sqrt(np.maximum(disc, 0)), (disc >= 0) & (below != 0)
        for _ in range(3):
            s = s - (c + s * (b + s * (a + s * e))) / (b + s * (2 * a + 3 * s * e))
        slope = -side * (b + s * (2 * a + 3 * s * e))
        return s, slope, (slope > 0) & (np.abs(c + s * (b + s * (a + s * e))) < 1e-3)


def local(records, pixels):
    """Positions and directions (p, n, 3) in the surfels' unit balls of the pixels' rays at T_REF."""
    x, y = pixels[:, None, 0] - records[:, XR], pixels[:, None, 1] - records[:, YR]
    at = [records[:, U0 + i] + records[:, UX + 2 * i] * x + records[:, UY + 2 * i] * y for i in range(3)]
    at = np.stack(at, axis=-1)
    return at, records[:, DU:DU + 3] + records[:, INV_T, None] * at


def inside_footprint(footprint, at):
    """Whether (..., n, 3) lies in the footprints (n, 8) uint8."""
    angle = np.arange(8) * np.pi / 4
    reach = at[..., :1] * np.cos(angle) + at[..., 1:2] * np.sin(angle)
    return (reach <= footprint / 255).all(axis=-1) | (footprint == 255).all(axis=-1)


def hits(degree, records, pixels, side, footprint=None):
    """Depth (p, n) of every surfel's hit in its alpha-shrunken ball, inf where there is none."""
    at, d = local(records, pixels)
    s, _, good = ray_root(degree, ray_poly(degree, records, at, d), side)
    with np.errstate(invalid="ignore"):
        hit = at + s[..., None] * d
        good &= (hit**2).sum(axis=-1) < ALPHA**2
        if footprint is not None:
            good &= inside_footprint(footprint, hit)
    return np.where(good, s + records[:, T_REF], np.inf)


def tile_slim(degree, view, records, pixels, oriented=True, footprint=None):
    """Depth, gradient in view space, number of surfels blended and frontmost surfel of every pixel.

    Only drawn surfels may be given. No bins, no order: every pixel asks every surfel.
    """
    v, p = opened(view), len(pixels)
    z = np.stack([hits(degree, records, pixels, side, footprint) for side in (1.0, -1.0)])  # (side, p, n)
    low, active = np.full(p, v.near), np.ones(p, bool)
    out = SimpleNamespace(depth=np.full(p, np.inf), gradient=np.full((p, 3), np.nan), count=np.zeros(p, int),
                          nearest=np.full(p, -1), weight=np.zeros(p), hit=np.zeros(p), side=np.ones(p))
    for _ in range(TRIES):
        key = np.where(z > low[:, None], z, np.inf)
        key[1] += records[:, BIAS] if oriented else 0
        flat = key.transpose(1, 0, 2).reshape(p, -1)
        best = flat.argmin(axis=1)
        found = active & np.isfinite(flat.min(axis=1))
        if not found.any():
            break
        side = np.where(best < len(records), 1.0, -1.0)
        nearest = best % len(records)
        hit = np.where(found, z.transpose(1, 0, 2).reshape(p, -1)[np.arange(p), best], 0)
        weight, depth, gradient, count = blended(degree, view, records, pixels, hit, side, oriented)
        found &= weight > 0
        for name, value in (("depth", depth), ("gradient", gradient), ("count", count), ("nearest", nearest),
                            ("weight", weight), ("hit", hit), ("side", side)):
            getattr(out, name)[found] = value[found]
        active = found & (weight < SUPPORT)
        low = np.where(active, hit, low)
    if oriented:
        out.gradient = outward_at_rims(view, pixels, out.gradient, out.side)
    return out


def blended(degree, view, records, pixels, hit, side, oriented):
    """Equations 6 and 7 of the paper: weights, depths, gradients and numbers of the surfels that hold the points."""
    v = opened(view)
    at, d = local(records, pixels)
    at = at + (hit[:, None] - records[:, T_REF])[..., None] * d
    inside = (at**2).sum(axis=-1) < 1
    poly = ray_poly(degree, records, at, d)
    sides = np.broadcast_to(side[:, None], inside.shape) if oriented else np.where(poly[1] < 0, 1.0, -1.0)
    s, slope, good = ray_root(degree, poly, sides)
    with np.errstate(invalid="ignore", over="ignore"):
        q = at + s[..., None] * d
        g = 1 - (q**2).sum(axis=-1)
        weight = np.where(inside & good & (g > 0), np.clip(g, 0, None) ** 3, 0)
        _, gu, gv = height(degree, records, q[..., 0], q[..., 1])
        tilt = weight * sides * records[:, RADIUS_PX]
        use = weight > 0
        fx = np.where(use, tilt * (records[:, WX] - gu * records[:, UX] - gv * records[:, VX]), 0).sum(axis=1)
        fy = np.where(use, tilt * (records[:, WY] - gu * records[:, UY] - gv * records[:, VY]), 0).sum(axis=1)
        ft = -np.where(use, weight * records[:, RADIUS] * slope, 0).sum(axis=1)
        total = weight.sum(axis=1)
        depth = hit + np.where(use, weight * s, 0).sum(axis=1) / total
    gx, gy = fx * v.fx, -fy * v.fy
    gz = -ft
    if v.perspective:
        gz = gx * (pixels[:, 0] - v.cx) / v.fx + gy * (v.cy - pixels[:, 1]) / v.fy - ft
    return total, depth, np.stack([gx, gy, gz], axis=1), use.sum(axis=1)


def outward_at_rims(view, pixels, gradient, side):
    """Gradients (p, 3) to the eye; where the ray grazes a surface from behind, the outward one mirrored on the ray."""
    v = opened(view)
    ray = np.tile([0.0, 0.0, -1.0], (len(pixels), 1))
    if v.perspective:
        ray[:, 0], ray[:, 1] = (pixels[:, 0] - v.cx) / v.fx, (v.cy - pixels[:, 1]) / v.fy
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = (gradient * ray).sum(axis=1)
    rim = (side < 0) & (np.abs(along) < RIM_COSINE * np.linalg.norm(gradient, axis=1))
    return np.where(rim[:, None], 2 * along[:, None] * ray - gradient, gradient)


def tile_balls(view, records, pixels):
    """Depth of the frontmost ball, its number, and its outward normal in view space (n, 3)."""
    v = opened(view)
    at, d = local(records, pixels)
    a, b, c = (d * d).sum(axis=-1), (at * d).sum(axis=-1), (at * at).sum(axis=-1) - 1
    disc = b * b - a * c
    t = np.where(disc >= 0, records[:, T_REF] + (-b - np.sqrt(np.maximum(disc, 0))) / a, np.inf)
    t = np.where(t > v.near, t, np.inf)
    return t.min(axis=1), np.where(np.isfinite(t.min(axis=1)), t.argmin(axis=1), -1)


def bucket_of(view, near):
    v = opened(view)
    return np.clip((near - v.first_depth) / v.bucket, 0, BUCKETS - 1).astype(int)


def chunks(count, parts, length):
    """The ranges that each of `parts` work-items handles."""
    return [range(min(part * length, count), min((part + 1) * length, count)) for part in range(parts)]


def shown(full):
    """Which primitives touch the picture."""
    return full[:, 0] <= full[:, 2]


def count_depths(full, buckets, parts, length):
    """Number (parts, BUCKETS) of drawn primitives of every bucket in every chunk."""
    out = np.zeros((parts, BUCKETS), int)
    for part, chunk in enumerate(chunks(len(full), parts, length)):
        for i in chunk:
            out[part, buckets[i]] += shown(full)[i]
    return out


def scan_bins(counts):
    """Offsets (parts, bins) of every chunk within its bin, and the bins' totals."""
    return np.cumsum(counts, axis=0) - counts, counts.sum(axis=0)


def scan_totals(totals):
    """Offsets (bins + 1,) of the bins."""
    return np.concatenate([[0], np.cumsum(totals)])


def order_depths(full, buckets):
    """The drawn primitives by depth bucket, then by number."""
    drawn = np.flatnonzero(shown(full))
    return drawn[np.argsort(buckets[drawn], kind="stable")]


def bins_of(blocks, bins_x):
    """The bins that a range of blocks (4,) touches, row by row."""
    x0, y0, x1, y1 = (int(b) // 2 for b in blocks)
    return [y * bins_x + x for y in range(y0, y1 + 1) for x in range(x0, x1 + 1)]


def count_bins(order, full, parts, bins_x, bin_count):
    """Number (parts, bins) of primitives that may touch every bin, for every chunk of `order`."""
    out = np.zeros((parts, bin_count), int)
    for part, chunk in enumerate(chunks(len(order), parts, -(-len(order) // parts))):
        for i in chunk:
            out[part, bins_of(full[order[i]], bins_x)] += 1
    return out


def fill_bins(order, full, core, keys, bins_x, bin_count):
    """The pairs (n, 2) of all bins, bin after bin, each in the given order (kernels/common/bins.clh)."""
    lists = [[] for _ in range(bin_count)]
    for i in order:
        for b in bins_of(full[i], bins_x):
            x, y = b % bins_x, b // bins_x
            bits = block_bits(core[i], x, y) << 4 | block_bits(full[i], x, y)
            lists[b].append((int(i) | (int(keys[i]) & 3) << 30, int(keys[i]) & 0xFFFFFF00 | bits))
    return np.array([pair for pairs in lists for pair in pairs], np.uint32).reshape(-1, 2)


def block_bits(blocks, x, y):
    """Bits of the four blocks of bin (x, y) inside the range `blocks` (4,)."""
    return sum(1 << (i + 2 * j) for j in range(2) for i in range(2)
               if blocks[0] <= 2 * x + i <= blocks[2] and blocks[1] <= 2 * y + j <= blocks[3])


def shade(view, shading, pixels, depth, gradient, base):
    """Linear colours (p, 4) of pixels: Blinn-Phong in view space; `base` (p, 3) linear; depth inf: background."""
    v, s = opened(view), np.asarray(shading, np.float64)
    hit = np.isfinite(depth)
    t = np.where(hit, depth, 1)
    across, up = (pixels[:, 0] - v.cx) / v.fx, (v.cy - pixels[:, 1]) / v.fy
    if v.perspective:
        ray = np.stack([across, up, -np.ones_like(up)], axis=1)
        point, eye = ray * t[:, None], -ray / np.linalg.norm(ray, axis=1, keepdims=True)
    else:
        point, eye = np.stack([across, up, -t], axis=1), np.tile([0.0, 0.0, 1.0], (len(t), 1))
    n = np.where(hit[:, None], gradient, 1.0)
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    color = base * s[3]
    for lamp in s[16:].reshape(-1, 16)[:int(s[12])]:
        to, arrives = to_lamp(lamp, point, eye)
        half = to + eye
        half = half / np.linalg.norm(half, axis=1, keepdims=True)
        cosine = (n * to).sum(axis=1)
        shine = np.clip((n * half).sum(axis=1), 0, None) ** s[6] * s[5]
        lit = base * s[4] * cosine[:, None] + shine[:, None]
        color = color + np.where(cosine > 0, 1, 0)[:, None] * lamp[4:7] * lit * arrives[:, None]
    out = np.tile(s[8:12], (len(t), 1))
    out[hit] = np.concatenate([color, np.ones((len(t), 1))], axis=1)[hit]
    return out


def to_lamp(lamp, point, eye):
    """Unit directions (p, 3) to a lamp of the shading buffer, and the part (p,) of its light that arrives."""
    to = {0: eye, 1: np.broadcast_to(lamp[1:4], eye.shape)}.get(int(lamp[0]), lamp[1:4] - point)
    away = np.linalg.norm(to, axis=1)
    to, arrives = to / away[:, None], np.ones(len(to))
    if lamp[0] >= 2:
        arrives = np.clip(1 - away**2 * lamp[7], 0, None) ** 2
    if lamp[0] == 3:
        arrives = arrives * np.clip((-to @ lamp[8:11] - lamp[11]) * lamp[12], 0, 1) ** 2
    return to, arrives


def reflection_lines(view, stripes, pixels, gradient, dark=0.06, soft=0.05):
    """Brightness (p,) of reflection lines: level lines of the height of the mirrored direction to the eye."""
    v = opened(view)
    eye = np.tile([0.0, 0.0, 1.0], (len(pixels), 1))
    if v.perspective:
        eye = np.stack([(v.cx - pixels[:, 0]) / v.fx, (pixels[:, 1] - v.cy) / v.fy, np.ones(len(pixels))], axis=1)
        eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    n = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    mirrored = 2 * (n * eye).sum(axis=1, keepdims=True) * n - eye
    part = np.mod((mirrored[:, 1] + 1) / 2 * stripes, 1)
    away = np.minimum(part, 1 - part)
    return dark + (1 - dark) * np.clip((away - 0.25) / soft + 0.5, 0, 1)


def pixel_centres(size):
    """(h * w, 2) centres of the pixels, row by row."""
    y, x = np.mgrid[:size[1], :size[0]] + 0.5
    return np.stack([x.ravel(), y.ravel()], axis=1)
