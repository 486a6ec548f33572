"""NumPy float64 twins of the surfel hierarchy's kernels: slow and plain."""

import numpy as np

from clsurf.surface.slim import frame_of_normals
from clsurf.surface.surfel import decoded_normals

FALL, FACING = 4.0, 1e-3  # kernels/build/normal_maps.cl
SLAB, LEAN, EDGE, BACK, CORE = 0.3, 0.25, 0.02, 0.25, 0.85  # clsurf/render/surfels.py, kernels/render/*surfels.cl
RIM_COSINE, RIM, TRIM = 0.4, 0.35, 0.5


def surfel_radii(positions, normals, neighbours, overlap):
    """Radii (n,) and spacings (n,): the farthest reach of each point's Voronoi cell in 16 directions."""
    u, v = frame_of_normals(normals)
    angles = np.arange(16) * np.pi / 8
    radii, spacings = np.zeros(len(positions)), np.zeros(len(positions))
    for i, row in enumerate(neighbours):
        row = row[(row >= 0) & (row != i)]
        d = positions[row] - positions[i]
        flat = np.stack([d @ u[i], d @ v[i]], axis=1)
        d2 = (flat**2).sum(axis=1)
        keep = (normals[row] @ normals[i] > 0) & (d2 > 0.01 * (d**2).sum(axis=1))
        flat, d2 = flat[keep], d2[keep]
        if not len(d2):
            continue
        within = min(len(d2), 12)
        spacing = np.sqrt(d2[:within].max() * np.pi / (within + 0.5))
        reach = 0.55 * spacing
        for direction in np.stack([np.cos(angles), np.sin(angles)], axis=1):
            along = flat @ direction
            nearest = (0.5 * d2[along > 0] / along[along > 0]).min(initial=np.inf)
            rim = not (along > 0.5 * np.sqrt(d2)).any()
            most = (0.6 if rim else 2.0) * spacing
            reach = max(reach, min(nearest, most))
        radii[i], spacings[i] = overlap * reach, spacing
    return radii, spacings


def texel_places(surface, s):
    """Places (w * w, 3) of the texels of surfel s in its plane, model space, float64."""
    w = int(surface.map_size[s])
    t = ((2 * np.arange(w) + 1) / w - 1) * float(surface.radii[s])
    u, v = frame_of_normals(surface.normals[s].astype(np.float64))
    y, x = np.meshgrid(t, t, indexing="ij")
    return surface.positions[s].astype(np.float64) + x.ravel()[:, None] * u + y.ravel()[:, None] * v


def normal_map(surface, s):
    """Algorithm 1: unit normals (w * w, 3), NaN where the line misses; the sphere tests go down from the root."""
    places, n = texel_places(surface, s), surface.normals[s].astype(np.float64)
    base = set(surface.base.tolist())
    total = np.zeros_like(places)

    def meets(other):
        apart = np.linalg.norm(surface.positions[s].astype(np.float64) - surface.positions[other])
        return apart < float(surface.spheres[s]) + float(surface.spheres[other])

    def visit(other):
        if other in base:
            m, p, r = (a[other].astype(np.float64) for a in (surface.normals, surface.positions, surface.radii))
            if m @ n <= FACING:
                return
            height = (p - places) @ m / (n @ m)
            t2 = ((places + height[:, None] * n - p) ** 2).sum(axis=1) / r**2
            total[:] += np.where(t2 < 1, np.exp(-FALL * t2), 0)[:, None] * m
            return
        for child in surface.children[surface.child_offset[other]:surface.child_offset[other + 1]]:
            if meets(child):
                visit(child)

    visit(0)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(length > 0, total / length, np.nan)


def triangle_map(surface, s):
    """Algorithm 2: unit normals (w * w, 3), NaN where the line misses; of several hits that nearest to the plane."""
    places, n = texel_places(surface, s), surface.normals[s].astype(np.float64)
    out, best = np.full_like(places, np.nan), np.full(len(places), 2 * float(surface.spheres[s]))
    corners = surface.vertices[surface.triangles].astype(np.float64)
    for (a, b, c), index in zip(corners, surface.triangles, strict=True):
        e, f = b - a, c - a
        if np.cross(e, f) @ n <= 0:
            continue
        solved = np.linalg.solve(np.stack([e, f, -n], axis=1), (places - a).T)
        j, k, height = solved[0], solved[1], np.abs(solved[2])
        hit = (j >= 0) & (k >= 0) & (j + k <= 1) & (height < best)
        na, nb, nc = surface.vertex_normals[index].astype(np.float64)
        mixed = (1 - j - k)[:, None] * na + j[:, None] * nb + k[:, None] * nc
        out[hit], best[hit] = (mixed / np.linalg.norm(mixed, axis=1, keepdims=True))[hit], height[hit]
    return out


class View:
    """A camera's picture of a surface whose model space is the world's."""

    def __init__(self, surface, camera, size):
        p = camera.projection(size)
        self.p, self.size, self.near = p, size, camera.near
        self.rotation = camera.rotation
        self.zero = camera.rotation @ (surface.origin - camera.eye)
        x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
        sx, sy = (x.ravel() - p.cx) / p.fx, (p.cy - y.ravel()) / p.fy
        one, none = np.ones_like(sx), np.zeros_like(sx)
        self.starts = np.stack([none, none, none] if p.perspective else [sx, sy, none], axis=1)
        self.rays = np.stack([sx, sy, -one] if p.perspective else [none, none, -one], axis=1)


def select_surfels(surface, view, lod, interior, relief=0.75):
    """State of every surfel: 2 is drawn, 1 looked into, 3 drawn by its triangles, 0 neither."""
    n = len(surface)
    state = np.ones(n, int)
    state[surface.children] = 0
    base = np.zeros(n, bool)
    base[surface.base] = True
    p = surface.positions.astype(np.float64) @ view.rotation.T + view.zero
    normal = surface.normals.astype(np.float64) @ view.rotation.T
    f = max(view.p.fx, view.p.fy)
    d = -p[:, 2] if view.p.perspective else np.ones(n)
    w, h, cx, cy = *view.size, view.p.cx, view.p.cy
    slope = 1 if view.p.perspective else 0
    out = -p[:, 2] + surface.spheres < view.near
    for along, focal, side in ((p[:, 0], view.p.fx, w - cx), (-p[:, 0], view.p.fx, cx), (p[:, 1], view.p.fy, cy),
                               (-p[:, 1], view.p.fy, h - cy)):
        out |= along * focal - side * d > surface.spheres * np.hypot(focal, slope * side)
    distance = np.linalg.norm(p, axis=1) if view.p.perspective else np.ones(n)
    facing = np.abs(-(normal * p).sum(axis=1) / distance if view.p.perspective else normal[:, 2])
    spread = surface.spreads + slope * surface.radii / distance
    most = np.where(facing < RIM * spread, lod, interior)
    small = (2 * f * surface.radii <= most * d) & (f * surface.heights * np.sqrt(np.maximum(1 - facing**2, 0))
                                                   <= relief * d)
    small &= (-p[:, 2] > surface.radii) if view.p.perspective else True
    for i in range(n):
        if not state[i]:
            continue
        if base[i] or (not out[i] and small[i] and lod > 0):
            state[i] = 2
        elif out[i]:
            state[i] = 0
        else:
            for c in range(surface.child_offset[i], surface.child_offset[i + 1]):
                state[surface.children[c]] = 1
            if surface.hybrid and surface.triangle_offset[i + 1] > surface.triangle_offset[i]:
                state[i] = 3
    return state


def tile_surfels(surface, view, drawn, maps=True):
    """Depth (pixels,), normal (pixels, 3) in the world toward the eye, count and surfel: every disc at every pixel."""
    base = np.zeros(len(surface), bool)
    base[surface.base] = True
    rows = []
    for s in drawn:
        p = view.rotation @ surface.positions[s].astype(np.float64) + view.zero
        n = view.rotation @ surface.normals[s].astype(np.float64)
        u, v = (view.rotation @ a for a in frame_of_normals(surface.normals[s].astype(np.float64)))
        r = float(surface.radii[s])
        with np.errstate(all="ignore"):
            along = view.rays @ n
            t = (p - view.starts) @ n / along
            place = (view.starts + t[:, None] * view.rays - p) / r
            a, b = place @ u, place @ v
        ray = p / -p[2] if view.p.perspective else np.array([0, 0, -1.0])
        cosine = n @ ray
        face = -np.sign(n @ p if view.p.perspective else cosine)
        ahead = not view.p.perspective or -p[2] > 0.5 * r
        if ahead and abs(cosine) < EDGE * np.linalg.norm(ray):
            continue
        inside = (a**2 + b**2 < 1) & (t > 0 if view.p.perspective else True)
        normal, rest = np.broadcast_to(surface.normals[s].astype(np.float64), (len(t), 3)), inside
        seen = inside & (a**2 + b**2 < CORE**2) if base[s] else inside
        if maps and not base[s]:
            w = int(surface.map_size[s])
            x, y = (np.clip(np.nan_to_num((c + 1) * w / 2), 0, w - 0.5).astype(int) for c in (a, b))
            texel = surface.normal_atlas[surface.map_offset[s] + y * w + x]
            normal = texel[:, :3] / 127.5 - 1
            toward = -((normal @ view.rotation.T) * view.rays).sum(axis=1)
            past = ((normal - TRIM * surface.normals[s]) @ view.rotation.T * view.rays).sum(axis=1)
            steep = plain_cosine(surface, s) + (r / -p[2] if view.p.perspective else 0)
            rest = inside & (texel[:, 3] > 0)
            if cosine**2 <= steep**2 * (ray @ ray):
                seen = seen & (texel[:, 3] > 0) & (face * past < 0)
                rest = rest & (toward > 0)
            inside = inside & (texel[:, 3] > 0)
        deep = max(abs(n @ p), -LEAN * p[2]) if view.p.perspective else max(abs(cosine), LEAN)
        slab = (SLAB * r + float(surface.heights[s])) / deep
        rows.append((t, a**2 + b**2, inside, seen, rest & (face > 0), face, r * BACK, slab, normal, s))
    pixels = len(view.rays)
    best, hit, side = np.full(pixels, np.inf), np.full(pixels, np.nan), np.zeros(pixels)
    nearest, front, front_nearest = np.full(pixels, -1), np.full(pixels, np.inf), np.full(pixels, -1)
    for t, _, _, seen, rest, face, bias, _, _, s in rows:
        with np.errstate(all="ignore"):
            key = t if face > 0 else (1 / (1 / t - bias / t**2) if view.p.perspective else t + bias)
            key = np.where(key <= 0, np.inf, key) if view.p.perspective else key
            better = seen & (t > view.near) & (key < best)
        best, hit, side = np.where(better, key, best), np.where(better, t, hit), np.where(better, face, side)
        nearest = np.where(better, s, nearest)
        better = rest & (t > view.near) & (t < front)
        front, front_nearest = np.where(better, t, front), np.where(better, s, front_nearest)
    # Through a gap: discs seen from behind give way to what else lies before them.
    through = (side < 0) & (front < hit)
    hit, side, nearest = (np.where(through, *pair) for pair in ((front, hit), (1, side), (front_nearest, nearest)))
    weight, depth, normal, count = np.zeros(pixels), np.zeros(pixels), np.zeros((pixels, 3)), np.zeros(pixels, int)
    for t, t2, inside, _, _, face, _, slab, n, _ in rows:
        with np.errstate(all="ignore"):
            apart = np.abs(hit / t - 1) if view.p.perspective else np.abs(hit - t)
            use = inside & (apart < slab) & (face == side)
            g = np.where(use, (1 - t2) ** 3, 0)
        weight += g
        depth += np.where(use, g * t, 0)
        normal += g[:, None] * n
        count += g > 0
    with np.errstate(all="ignore"):
        n = side[:, None] * (normal @ view.rotation.T)
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        ray = view.rays / np.linalg.norm(view.rays, axis=1, keepdims=True)
        along = (n * ray).sum(axis=1)
        rim = (side < 0) & (along**2 < RIM_COSINE**2)
        n = np.where(rim[:, None], 2 * along[:, None] * ray - n, n)
        along = (n * ray).sum(axis=1)
        n -= np.maximum(along, 0)[:, None] * ray
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        return depth / weight, n @ view.rotation, count, nearest


def plain_cosine(surface, s):
    """Cosine between disc and ray from which every texel of surfel s is seen; 2 where some may always be hidden."""
    w = int(surface.map_size[s])
    edge = 2 * np.arange(w + 1) / w - 1
    least = np.where(edge[:-1] * edge[1:] <= 0, 0, np.minimum(np.abs(edge[:-1]), np.abs(edge[1:])))
    texels = surface.normal_atlas[surface.map_offset[s]:surface.map_offset[s] + w * w]
    texels = texels[(least[:, None] ** 2 + least**2 < 1).ravel()]
    a = np.arccos(np.clip((decoded_normals(texels) @ surface.normals[s].astype(np.float64)).min(), -1, 1))
    if (texels[:, 3] == 0).any() or np.cos(a) <= TRIM:
        return 2.0
    # cos(t + a) = TRIM cos t at tan t = (cos a - TRIM) / sin a
    return np.cos(np.arctan2(np.cos(a) - TRIM, np.sin(a)))


def angles(codes, normals):
    """Angles in degrees between coded and given normals."""
    cosine = (decoded_normals(codes) * normals).sum(axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def ray_surfels(surface, origins, directions):
    """Distance (n,), normal (n, 3) and surfel (n,) of the closest hits on the base surfels; directions are unit."""
    base = surface.base
    p, n, r = (a[base].astype(np.float64) for a in (surface.positions, surface.normals, surface.radii))
    count = len(origins)
    distance, normal, number = np.full(count, np.inf), np.full((count, 3), np.nan), np.full(count, -1)
    for i, (o, d) in enumerate(zip(origins - surface.origin, directions, strict=True)):
        along = n @ d
        with np.errstate(all="ignore"):
            t = ((p - o) * n).sum(axis=1) / along
        away2 = ((o + t[:, None] * d - p) ** 2).sum(axis=1)
        face = np.where(along < 0, 1, -1)
        key = np.where((away2 < (CORE * r) ** 2) & (t > 0), t + np.where(face < 0, BACK * r, 0), np.inf)
        k = np.argmin(key)
        if not np.isfinite(key[k]):
            continue
        front = np.where((away2 < r**2) & (t > 0) & (face > 0), t, np.inf)
        if face[k] < 0 and front.min() < t[k]:
            k = np.argmin(front)
        use = (away2 < r**2) & (np.abs(t - t[k]) * np.maximum(np.abs(along), LEAN) < SLAB * r) & (face == face[k])
        g = np.where(use, (1 - away2 / r**2) ** 3, 0)
        distance[i], number[i] = (g[use] @ t[use]) / g.sum(), base[k]
        mean = face[k] * (g[:, None] * n).sum(axis=0)
        mean /= np.linalg.norm(mean)
        normal[i] = -mean if mean @ d > 0 else mean
    return distance, normal, number
