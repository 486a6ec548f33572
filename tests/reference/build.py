"""Plain float64 twins of the kernels in kernels/build for SLIM surfaces: slow, obvious, and the specification.

Coordinates are those of the sorted points: (n, 3), over the diagonal.
"""

import numpy as np

from clsurf.surface.slim import frame_of_normals

POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
GOLDEN = (np.sqrt(5) - 1) / 2
ALPHA = 2 / 3


def weight(d2, r):
    """G(d / r) = (1 - d^2 / r^2)^3 inside the ball."""
    return np.clip(1 - d2 / r**2, 0, None) ** 3


def terms(degree):
    return (degree + 1) * (degree + 2) // 2


def monomials(u, v, degree):
    return np.stack([u**i * v**j for i, j in POWERS[:terms(degree)]], axis=-1)


def height(coefficients, u, v):
    """The polynomials of surfels (..., 1 | 6 | 10) at (u, v)."""
    return sum(coefficients[..., k] * u**i * v**j
               for k, (i, j) in enumerate(POWERS[:coefficients.shape[-1]]))


def height_gradient(coefficients, u, v):
    hu, hv = np.zeros_like(u), np.zeros_like(v)
    for k, (i, j) in enumerate(POWERS[:coefficients.shape[-1]]):
        if i:
            hu = hu + coefficients[..., k] * i * u ** (i - 1) * v**j
        if j:
            hv = hv + coefficients[..., k] * j * u**i * v ** (j - 1)
    return hu, hv


def morton_codes(points, low, scale, bits):
    cells = ((points.astype(np.float32) - np.float32(low)) * np.float32(scale)).astype(np.int64)
    cells = np.clip(cells, 0, (1 << bits) - 1)
    return np.array([sum((int(cell[axis]) >> b & 1) << (3 * b + axis) for b in range(bits) for axis in range(3))
                     for cell in cells], np.uint64)


def gather_points(points, normals, order, middle, scale):
    n = normals[order].astype(float)
    return (points[order].astype(float) - middle) * scale, n / np.linalg.norm(n, axis=1, keepdims=True)


def gather_weights(weights, order, padded):
    return np.concatenate([weights[order], np.zeros(padded - len(order))])


def block_boxes(points, radius=None):
    """Records (nodes, 6, 16) of the blocks of 16 of `points` (padded, 3)."""
    radius = np.zeros(len(points)) if radius is None else radius
    low = (points - radius[:, None]).reshape(-1, 16, 3).min(axis=1)
    high = (points + radius[:, None]).reshape(-1, 16, 3).max(axis=1)
    return records_of(low, high)


def node_boxes(records, children):
    """Records of the nodes above `records`, of which `children` are real."""
    return records_of(records[:children, :3].min(axis=2), records[:children, 3:].max(axis=2))


def records_of(low, high):
    nodes = -(-len(low) // 16)
    boxes = np.empty((nodes * 16, 6))
    boxes[:, :3], boxes[:, 3:] = 1e30, -1e30
    boxes[:len(low), :3], boxes[:len(low), 3:] = low, high
    return boxes.reshape(nodes, 16, 6).transpose(0, 2, 1)


def open_points(overlap, held, threshold):
    return (overlap < threshold) & (held == 0)


def choose_centers(points, open_, cells, spacing):
    """Greedy centres; `cells`: for each colour in turn, (first, last + 1) of its cells."""
    open_ = open_.copy()
    chosen = []
    for first, last in cells:
        for a, b in zip(first, last, strict=True):
            for i in range(a, b):
                if open_[i]:
                    open_[((points - points[i]) ** 2).sum(axis=1) < spacing**2] = False
                    chosen.append(i)
    return np.sort(chosen)


def off_surfel(points, place, surfel, count):
    """Distances of points from a surfel's graph along its normal; `count` coefficients."""
    u, v = frame_of_normals(surfel[1:4])
    d = points - place
    return d @ surfel[1:4] - height(surfel[6:6 + count], d @ u, d @ v)


def cover_points(points, normals, center, record, cosine=0.2, tolerance=np.inf):
    """Overlap of the leaves and points held by internal surfels."""
    overlap, held = cover_leaves(points, normals, points[center], record, cosine, tolerance)
    np.add.at(overlap, center, record[:, 5] > 0)
    return overlap, held


def cover_leaves(points, normals, place, record, cosine=0.2, tolerance=np.inf):
    """The same of leaves at places (m, 3), which need not be points."""
    overlap, held = np.zeros(len(points)), np.zeros(len(points), bool)
    for at, surfel in zip(place, record.astype(float), strict=True):
        d2 = ((points - at) ** 2).sum(axis=1)
        if surfel[5]:
            near = (normals @ surfel[1:4] >= cosine) & (np.abs(off_surfel(points, at, surfel, 6)) <= tolerance)
            overlap += np.where(near, weight(d2, ALPHA * surfel[0]), 0)
        else:
            held |= d2 < surfel[0] ** 2
    return overlap, held


def check_leaves(points, own, place, record):
    """Sums of G and G f^2 over the own points of leaves' balls, (m, 2)."""
    out = []
    for at, surfel in zip(place, record.astype(float), strict=True):
        g = own * weight(((points - at) ** 2).sum(axis=1), surfel[0])
        out.append((g.sum(), (g * off_surfel(points, at, surfel, 6) ** 2).sum()))
    return np.array(out)


def neighbor_spread(points, query, neighbors=10):
    """Smallest covariance eigenvalue of a point and its neighbours, and the squared distance of the last of them."""
    d2 = ((points - points[query]) ** 2).sum(axis=1)
    near = points[np.argsort(d2)[:neighbors + 1]]
    return np.linalg.eigvalsh(np.cov(near.T, bias=True))[0], np.sort(d2)[neighbors]


def polynomial_fit(local, weights, radius, degree):
    """Weighted least squares of w over (u, v); coefficients in units of the coordinates."""
    u, v, w = (local / radius).T
    root = np.sqrt(weights)
    solution = np.linalg.lstsq(monomials(u, v, degree) * root[:, None], w * root, rcond=None)[0]
    return solution * radius ** (1.0 - np.array([i + j for i, j in POWERS[:terms(degree)]]))


def fit_at(points, normals, center, radius, frame_radius, degree):
    """Frame (3, 3: u, v, n), coefficients and mean squared residual of the surfel at `center` with `radius`."""
    d = points - points[center]
    d2 = (d**2).sum(axis=1)
    n = (weight(d2, frame_radius)[:, None] * normals).sum(axis=0)
    n /= np.linalg.norm(n)
    frame = np.stack([*frame_of_normals(n), n])
    g = weight(d2, radius)
    local = d[g > 0] @ frame.T
    g = g[g > 0]
    c = polynomial_fit(local, g, radius, degree)
    f = local[:, 2] - monomials(local[:, 0], local[:, 1], degree) @ c
    return frame, c, (g * f**2).sum() / g.sum()


def fit_surfels(points, normals, center, r_r, noise, penalty, need, degree, refit=True):
    """Radius, normal, e, leaf and coefficients of the surfel at `center` in the segment that ends at r_r."""
    radii = r_r * GOLDEN ** (2 * (14 - np.arange(15)) / 14)
    d2 = ((points - points[center]) ** 2).sum(axis=1)
    count = np.array([(d2 < r**2).sum() for r in radii])
    full = 22 if degree == 3 else 0  # points of a cubic; with fewer it is a quadratic
    lowest, lowest_full = int(np.argmax(count >= need)), int(np.argmax(count >= max(need, full)))
    fits = {i: fit_at(points, normals, center, radii[i], 0.618034 * r_r, degree if count[i] >= full else 2)
            for i in range(lowest, 15)}
    e2 = np.array([fits[max(i, lowest)][2] for i in range(15)])
    energy = e2 + penalty / radii**2
    best = max(range(lowest, 15), key=lambda i: (-energy[i], i))
    first = lowest if best < lowest_full else lowest_full
    rising = e2[first] <= e2[max(first, 7)] <= e2[14]
    plateau = lowest == 0 and e2[best] > 4 * penalty / radii[best] ** 2 + 3 * noise
    leaf = not plateau and (best == 14 or (best > lowest and rising) or (best == lowest and lowest > 0))
    best = best if leaf else 14
    if refit and leaf and lowest > 0 and e2[best] > 4 * penalty / radii[best] ** 2:  # perhaps a sheet behind
        own = normals @ normals[center] >= -0.2
        need = min(need, int((own & (d2 < r_r**2)).sum()))
        return fit_surfels(points[own], normals[own], own[:center].sum(), r_r, noise, penalty, need, degree, False)
    frame, c, mean2 = fits[best]
    normal = frame[2]
    if degree == 1:
        k = 1 / np.sqrt(1 + c[1] ** 2 + c[2] ** 2)
        normal, c, mean2 = (frame[2] - c[1] * frame[0] - c[2] * frame[1]) * k, c[:1] * k, mean2 * k * k
    return radii[best], normal, np.sqrt(mean2), leaf, c


def surfel_footprints(points, normals, center, record, degree, limited=0.7):
    """Shares (8,) of the radius that the surfel's own points reach, or ones where it is no border surfel."""
    surfel = record.astype(float)
    u_axis, v_axis = frame_of_normals(surfel[1:4])
    d = points - points[center]
    u, v, w = d @ u_axis, d @ v_axis, d @ surfel[1:4]
    c = surfel[6:6 + (1 if degree == 1 else terms(degree))]
    own = ((d**2).sum(axis=1) < surfel[0] ** 2) & (normals @ surfel[1:4] > 0.3)
    own &= np.abs(w - height(c, u, v)) < max(0.15 * surfel[0], 4 * surfel[4])
    angle = np.arange(8) * np.pi / 4
    reach = (u[own, None] * np.cos(angle) + v[own, None] * np.sin(angle)).max(axis=0) / surfel[0]
    share = reach + 0.08 * np.sqrt(np.pi / own.sum())
    return np.minimum(share, 1) if share.min() < limited else np.ones(8)


def surfel_colors(points, normals, center, record, colors):
    surfel = record.astype(float)
    g = weight(((points - points[center]) ** 2).sum(axis=1), surfel[0]) * (normals @ surfel[1:4] > 0)
    return (g[:, None] * colors).sum(axis=0) / g.sum()


def blend(surface, q, facing):
    """Sums of G, G f and G grad f at q over the leaves that face `facing`; coordinates relative to the origin."""
    use = surface.leaf & (surface.normals @ facing > 0)
    c, r, n = (a[use].astype(float) for a in (surface.centers, surface.radii, surface.normals))
    k = surface.coefficients[use].astype(float)
    u_axis, v_axis = frame_of_normals(n)
    d = q - c
    g = weight((d**2).sum(axis=1), r)
    u, v, w = (d * u_axis).sum(axis=1), (d * v_axis).sum(axis=1), (d * n).sum(axis=1)
    hu, hv = height_gradient(k, u, v)
    slope = n - hu[:, None] * u_axis - hv[:, None] * v_axis
    return g.sum(), (g * (w - height(k, u, v))).sum(), (g[:, None] * slope).sum(axis=0)


def project_points(surface, p, rounds=5):
    """Nearest position, normal and signed distance of the blended surface for one point relative to the origin."""
    c, r, n = (a[surface.leaf].astype(float) for a in (surface.centers, surface.radii, surface.normals))
    k = surface.coefficients[surface.leaf].astype(float)
    u_axis, v_axis = frame_of_normals(n)
    d = p - c
    u, v, w = (d * u_axis).sum(axis=1), (d * v_axis).sum(axis=1), (d * n).sum(axis=1)
    rho = np.hypot(u, v)
    trim = np.where(rho > ALPHA * r, ALPHA * r / np.maximum(rho, 1e-30), 1)
    a, b = u * trim, v * trim
    h = np.clip(height(k, a, b), -r, r)
    best = int(np.argmin((u - a) ** 2 + (v - b) ** 2 + (w - h) ** 2))
    q = c[best] + a[best] * u_axis[best] + b[best] * v_axis[best] + h[best] * n[best]
    facing, normal = n[best], n[best]
    for i in range(rounds):
        total, f, slope = blend(surface, q, facing)
        if total <= 1e-9:
            break
        length = np.linalg.norm(slope)
        normal = slope / length
        slide = p - q - ((p - q) @ normal) * normal
        far = np.linalg.norm(slide)
        slide *= min(1, 0.25 * r[best] / max(far, 1e-30)) if i + 1 < rounds else 0
        q = q + slide - np.clip(f / length, -r[best], r[best]) * normal
    d = p - q
    return q, normal, np.linalg.norm(d) * (-1 if d @ normal < 0 else 1)
