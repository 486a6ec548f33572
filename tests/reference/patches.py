"""NumPy float64 twins of the kernels that turn meshes into patches, and meshes for tests."""

import numpy as np

from clsurf.build.resample import FaceLists, Frames
from clsurf.surface.mesh import Mesh

REACH, CARRY, FALL, SLOPE_LIMIT, GAP_LIMIT, FLAT_AREA = 1.25, 0.8, 1.2, 2.0, 1.5, 1e-9


def sheet(height, n=21, half=1.0, **more):
    """A mesh over a square grid of n x n vertices; height(x, y)."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n)))
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    return Mesh(np.stack([x, y, height(x, y)], axis=1).astype(np.float32), faces, **more)


def ball(rounds=3, radius=1.0, center=(0, 0, 0)):
    """A sphere of 8 * 4^rounds faces, from an octahedron."""
    v = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
    f = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(rounds):
        edges = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
        pairs, which = np.unique(edges, axis=0, return_inverse=True)
        x, y, z = len(v) + which.reshape(3, -1)
        a, b, c = f.T
        v = np.concatenate([v, v[pairs].mean(axis=1)])
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        f = np.concatenate([np.stack(t, axis=1) for t in ((a, x, z), (x, b, y), (z, y, c), (x, y, z))])
    return Mesh((radius * v + np.asarray(center)).astype(np.float32), f)


def cube(parts=1):
    """A cube of side 2 about the origin, each side of parts x parts x 2 faces, corners shared."""
    side = sheet(lambda x, y: np.ones_like(x), parts + 1)
    v, f = [], []
    for axis in range(3):
        for sign in (1, -1):
            turned = np.roll(side.vertices * [1, 1, sign], axis, axis=1)
            f.append((side.faces if sign > 0 else side.faces[:, ::-1]) + sum(map(len, v)))
            v.append(turned)
    v, where = np.unique(np.concatenate(v).round(6) + 0.0, axis=0, return_inverse=True)
    return Mesh(v.astype(np.float32), where.reshape(-1)[np.concatenate(f)])


def joined(*meshes):
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes])
    return Mesh(np.concatenate([m.vertices for m in meshes]),
                np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=False)]))


def random_case(seed, patches=2):
    """A bumpy sheet, some frames over it and lists of its faces."""
    rng = np.random.default_rng(seed)
    k = rng.uniform(1, 4, 4)
    mesh = sheet(lambda x, y: 0.15 * np.sin(k[0] * x + k[1] * y) + 0.1 * np.cos(k[2] * x - k[3] * y), 19)
    origins, axis_x, axis_y, faces, own = [], [], [], [], []
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    for _ in range(patches):
        q, _ = np.linalg.qr(np.eye(3) + 0.3 * rng.normal(size=(3, 3)))
        q *= np.sign(np.diag(q))[:, None] if np.linalg.det(q) > 0 else 1
        x, y = np.array([1, 0, 0.2]) + 0.2 * rng.normal(size=3), np.array([0, 1, 0.1]) + 0.2 * rng.normal(size=3)
        x /= np.linalg.norm(x)
        y -= (y @ x) * x
        y /= np.linalg.norm(y)
        step = rng.uniform(0.04, 0.07)
        center = rng.uniform(-0.5, 0.5, 3) * [1, 1, 0]
        origins.append(center - 8 * step * (x + y))
        axis_x.append(step * x)
        axis_y.append(1.3 * step * y)
        mine = np.linalg.norm((middle - center)[:, :2], axis=1) < rng.uniform(0.2, 0.3)
        near = np.linalg.norm((middle - center)[:, :2], axis=1) < 0.4
        faces += [np.flatnonzero(mine), np.flatnonzero(near & ~mine)]
        own.append(mine.sum())
    counts = [len(a) + len(b) for a, b in zip(faces[::2], faces[1::2], strict=True)]
    frames = Frames(np.array(origins), np.array(axis_x), np.array(axis_y), np.tile(np.int32([17, 13]), (patches, 1)))
    lists = FaceLists(np.concatenate(faces).astype(np.int32), np.cumsum([0, *counts]).astype(np.int32),
                      np.array(own, np.int32))
    return mesh, frames, lists


# Twins --------------------------------------------------------------------------------------------------------------


def flat_triangle(frames, p, corners):
    """The corners of a triangle (3, 3) as x, y in node steps and z in steps of the mean spacing; that spacing."""
    x, y = frames.axis_x[p], frames.axis_y[p]
    step = np.sqrt(np.linalg.norm(x) * np.linalg.norm(y))
    d = corners - frames.origins[p]
    return np.stack([d @ x / (x @ x), d @ y / (y @ y), d @ frames.unit_z[p] / step], axis=1), step


def doubled_area(t):
    return np.linalg.det(np.stack([t[1, :2] - t[0, :2], t[2, :2] - t[0, :2]]))


def nearest_weights(t, at):
    """Weights (3,) of the point of the flat triangle nearest to `at` (2,), and its squared distance."""
    area = doubled_area(t)
    if area != 0:
        a, b, c = t[:, :2]
        w = np.array([doubled_area(np.array(part)) for part in ([at, b, c], [a, at, c], [a, b, at])]) / area
        if (w >= 0).all():
            return w, 0.0
    best = None, np.inf
    for k in range(3):
        a, b = t[k, :2], t[(k + 1) % 3, :2]
        s = np.clip((at - a) @ (b - a) / max((b - a) @ (b - a), 1e-300), 0, 1)
        d2 = ((a + s * (b - a) - at) ** 2).sum()
        if d2 < best[1]:
            w = np.zeros(3)
            w[k], w[(k + 1) % 3] = 1 - s, s
            best = w, d2
    return best


def meets(t, side, reach, at):
    """Whether the square of half side `reach` around `at` meets the flat triangle."""
    if (t[:, :2].min(axis=0) > at + reach).any() or (t[:, :2].max(axis=0) < at - reach).any():
        return False
    for k in range(3):
        dx, dy = side * (t[(k + 1) % 3, :2] - t[k, :2])
        if dx * (at[1] - t[k, 1]) - dy * (at[0] - t[k, 0]) + reach * (abs(dx) + abs(dy)) < 0:
            return False
    return True


def carried_height(t, at, w):
    near = w @ t
    if abs(doubled_area(t)) <= FLAT_AREA:
        return near[2]
    slope = np.linalg.solve(t[1:, :2] - t[0, :2], t[1:, 2] - t[0, 2])
    slope *= min(1, SLOPE_LIMIT / max(np.linalg.norm(slope), 1e-300))
    return near[2] + slope @ (at - near[:2])


def resample_heights(mesh, frames, lists):
    """Heights (N,) in world units, NaN where transparent, and the faces they come from."""
    vertices = mesh.vertices.astype(np.float64)
    heights, source = [], []
    for p in range(len(frames)):
        begin, end = lists.offset[p], lists.offset[p + 1]
        flat = [flat_triangle(frames, p, vertices[mesh.faces[f]]) for f in lists.faces[begin:end]]
        own = range(lists.own[p])
        for j in range(frames.size[p, 1]):
            for i in range(frames.size[p, 0]):
                h, s = _node_height(np.array([i, j], float), [t for t, _ in flat], own, lists.faces[begin:end])
                heights.append(h * flat[0][1] if flat else np.nan)
                source.append(s)
    return np.array(heights), np.array(source)


def _node_height(at, triangles, own, faces):
    reached = [k for k in own if meets(triangles[k], np.sign(doubled_area(triangles[k])) or 1, REACH, at)]
    if not reached:
        return np.nan, -1
    found = []
    for k in reached:
        w, d2 = nearest_weights(triangles[k], at)
        found.append((d2, -carried_height(triangles[k], at, w), k))
    d2, z, k = min(found)
    if d2 == 0:
        return -z, faces[k]
    over = []
    for f in range(len(own), len(triangles)):
        w, apart2 = nearest_weights(triangles[f], at)
        if doubled_area(triangles[f]) > FLAT_AREA and apart2 == 0:
            over.append((abs(w @ triangles[f][:, 2] + z), w @ triangles[f][:, 2], f))
    over = [o for o in over if o[0] <= GAP_LIMIT]
    if over:
        _, height, f = min(over)
        return height, faces[f]
    for f in range(len(own), len(triangles)):
        w, apart2 = nearest_weights(triangles[f], at)
        if doubled_area(triangles[f]) > FLAT_AREA and apart2 < d2 and -z - w @ triangles[f][:, 2] > FALL:
            return np.nan, -1
    if any(meets(triangles[k], np.sign(doubled_area(triangles[k])) or 1, CARRY, at) for k in reached):
        return -z, faces[k]
    return np.nan, -1


def resample_colors(mesh, frames, source):
    """Colours (N, 4) in 0...255, not rounded, of a mesh with a texture."""
    linear = np.arange(256) / 255
    linear = np.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    rows, columns = mesh.texture.shape[:2]
    out, at = np.zeros((len(source), 4)), 0
    for p in range(len(frames)):
        for j in range(frames.size[p, 1]):
            for i in range(frames.size[p, 0]):
                if source[at] >= 0:
                    corners = mesh.faces[source[at]]
                    t, _ = flat_triangle(frames, p, mesh.vertices[corners].astype(np.float64))
                    uv = mesh.uv[corners].astype(np.float64)
                    gradient = np.linalg.solve(t[1:, :2] - t[0, :2], uv[1:] - uv[0]) * [columns, rows]
                    n = int(np.clip(np.ceil(np.abs(gradient).max() - 1e-5), 1, 8))
                    total = np.zeros(4)
                    for s in range(n * n):
                        place = np.array([i, j]) + (np.array([s % n, s // n]) + 0.5) / n - 0.5
                        total += _texel(mesh.texture, nearest_weights(t, place)[0] @ uv, linear)
                    total /= n * n
                    rgb = total[:3] / max(total[3], 1e-300)
                    srgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)
                    out[at] = 255 * np.append(srgb, total[3])
                at += 1
    return out


def _texel(texture, uv, linear):
    """The bilinear colour at uv, linear and premultiplied."""
    rows, columns = texture.shape[:2]
    x, y = uv[0] % 1 * columns - 0.5, (1 - uv[1] % 1) * rows - 0.5
    total = np.zeros(4)
    for dy in (0, 1):
        for dx in (0, 1):
            cx, cy = int(np.floor(x)) + dx, int(np.floor(y)) + dy
            weight = (1 - abs(x - cx)) * (1 - abs(y - cy))
            r, g, b, a = texture[cy % rows, cx % columns]
            total += weight * a / 255 * np.array([linear[r], linear[g], linear[b], 1])
    return total
