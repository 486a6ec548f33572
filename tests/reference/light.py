"""Plain float64 twins of materials, skies, backdrops and edges."""

import numpy as np

from .render import opened, reflection_lines, to_lamp

MIN_ROUGHNESS, LEAST_COSINE, STEP_PX, CREASE = 0.045, 1e-3, 1.5, 0.82


def bilinear(texels, x, y):
    """Values (p, k) of a picture (h, w, k) at places in texels, the first one's middle being (0, 0)."""
    i, j = (np.clip(a.astype(int), 0, n - 2) for a, n in ((x, texels.shape[1]), (y, texels.shape[0])))
    u, v = (x - i)[:, None], (y - j)[:, None]
    top = texels[j, i] * (1 - u) + texels[j, i + 1] * u
    return top * (1 - v) + (texels[j + 1, i] * (1 - u) + texels[j + 1, i + 1] * u) * v


def octahedral(texels, d):
    """Values (p, k) of an octahedral map ((n + 1)^2, k) along directions (p, 3)."""
    side = round(len(texels) ** 0.5)
    x, y, z = (d / np.abs(d).sum(axis=1, keepdims=True)).T
    u = np.where(y < 0, (1 - np.abs(z)) * np.where(x < 0, -1, 1), x)
    v = np.where(y < 0, (1 - np.abs(x)) * np.where(z < 0, -1, 1), z)
    half = (side - 1) / 2
    return bilinear(texels.reshape(side, side, -1).astype(np.float64), (u + 1) * half, (v + 1) * half)


def corners(cells):
    """Unit directions ((cells + 1)^2, 3) of an octahedral map's texels."""
    u, v = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-1, 1, cells + 1)]))
    y = 1 - np.abs(u) - np.abs(v)
    x = np.where(y < 0, (1 - np.abs(v)) * np.where(u < 0, -1, 1), u)
    z = np.where(y < 0, (1 - np.abs(u)) * np.where(v < 0, -1, 1), v)
    d = np.stack([x, y, z], axis=1)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def prefilter_sky(picture, alpha, d):
    """What surfaces that face `d` (p, 3) send back of an equirectangular picture: GGX, or None: matte."""
    height, width = picture.shape[:2]
    down, around = np.pi * (np.arange(height) + 0.5) / height, 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    down, around = (a.ravel() for a in np.meshgrid(down, around, indexing="ij"))
    to = np.stack([np.sin(down) * np.sin(around), np.cos(down), np.sin(down) * np.cos(around)], axis=1)
    cosine = d @ to.T
    weight = np.clip(cosine, 0, None) * np.sin(down)
    if alpha is not None:
        weight = weight / ((1 - cosine) / 2 + alpha**2 * (1 + cosine) / 2) ** 2
    return weight @ picture.reshape(-1, 3).astype(np.float64) / weight.sum(axis=1, keepdims=True)


def highlight(cosine, roughness, f0, steps=400):
    """Share of light from all sides that a highlight sends toward the eye: quadrature over the lights' directions."""
    a2 = roughness**4
    up, phi = np.meshgrid((np.arange(steps) + 0.5) / steps, 2 * np.pi * (np.arange(steps) + 0.5) / steps)
    e = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    to = np.stack([np.sqrt(1 - up**2) * np.cos(phi), np.sqrt(1 - up**2) * np.sin(phi), up], axis=-1)
    half = to + e
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    return (2 * microfacets(half[..., 2], up, cosine, (to * half).sum(axis=-1), a2, f0) * up).mean()


def microfacets(nh, nl, ne, lh, a2, f0):
    """pi times GGX's distribution, height-correlated Smith's visibility and Schlick's reflectance."""
    d = a2 / (nh**2 * (a2 - 1) + 1) ** 2
    v = 0.5 / (nl * np.sqrt(ne**2 * (1 - a2) + a2) + ne * np.sqrt(nl**2 * (1 - a2) + a2))
    return d * v * (f0 + (1 - f0) * (1 - lh) ** 5)


def material_light(material, lamps, ambient, table, point, normal, eye, base, dark, mirror=None, matte=None,
                   sphere=None):
    """Linear light (p, 3) of points with unit normals and directions to the eye, in view space.

    `table` gives both parts of a highlight; `mirror` (directions, roughness) and `matte` (directions) give the sky's
    light where there is one; `sphere` is a matcap.
    """
    look, ne = material.look, (normal * eye).sum(axis=1)
    if look == "flat":
        return base
    if look == "normal":  # with the camera's axes those of the world
        s = normal / 2 + 0.5
        return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    if look == "matcap":
        right = np.stack([eye[:, 2], np.zeros(len(eye)), -eye[:, 0]], axis=1)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        x, y = (normal * right).sum(axis=1), (normal * np.cross(eye, right)).sum(axis=1)
        h, w = sphere.shape[:2]
        x, y = np.clip((x + 1) * w / 2 - 0.5, 0, w - 1), np.clip((1 - y) * h / 2 - 0.5, 0, h - 1)
        return base * bilinear(sphere, x, y)
    mirrored = 2 * ne[:, None] * normal - eye
    if look == "phong":
        rough = (2 / (material.shininess + 2)) ** 0.25
        reflected, gloss = np.full_like(base, ambient), np.zeros_like(base)
        if mirror:
            reflected, gloss = material.diffuse * matte(normal), material.specular * mirror(mirrored, rough)
        out = base * reflected + gloss
    else:
        rough = max(material.roughness, MIN_ROUGHNESS)
        a, b = table(np.clip(ne, LEAST_COSINE, 1), rough).T[:, :, None]
        f0 = 0.04 * (1 - material.metallic) + material.metallic * base
        again = 1 + f0 * (1 / (a + b) - 1)
        shine = (f0 * a + b) * again
        color = base * (1 - material.metallic) * (1 - shine)
        out = color * matte(normal) + shine * mirror(mirrored, rough) if mirror else ambient * (color + shine)
    for i, lamp in enumerate(lamps):
        to, arrives = to_lamp(lamp, point, eye)
        half = to + eye
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        nl, nh, lh = ((u * v).sum(axis=1)[:, None] for u, v in ((normal, to), (normal, half), (to, half)))
        if look == "phong":
            sends = material.diffuse * base * nl + material.specular * np.clip(nh, 0, None) ** material.shininess
        else:
            sight = np.clip(ne, LEAST_COSINE, 1)[:, None]
            with np.errstate(invalid="ignore"):
                sends = nl * (color + again * microfacets(nh, nl, sight, lh, rough**4, f0))
        seen = (nl[:, 0] > 0) & (dark >> i & 1 == 0)
        out = out + np.where(seen, arrives, 0)[:, None] * np.nan_to_num(sends) * lamp[4:7]
    return out


def stripes(material, view, pixels, gradient):
    """Brightness (p,) of a material's reflection lines."""
    return reflection_lines(view, material.stripes, pixels, gradient)


def surroundings(view, turn, picture, pixels):
    """Light (p, k) of an equirectangular picture along the rays of pixels; `turn` is view axes to the picture's."""
    v = opened(view)
    ray = np.tile([0.0, 0.0, -1.0], (len(pixels), 1))
    if v.perspective:
        ray[:, 0], ray[:, 1] = (pixels[:, 0] - v.cx) / v.fx, (v.cy - pixels[:, 1]) / v.fy
    d = ray @ np.asarray(turn).T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    h, w = picture.shape[:2]
    x = (np.arctan2(d[:, 0], d[:, 2]) / (2 * np.pi) + 0.5) * w - 0.5
    y = np.clip(np.arccos(np.clip(d[:, 1], -1, 1)) / np.pi * h - 0.5, 0, h - 1)
    around = np.concatenate([picture[:, -1:], picture, picture[:, :1]], axis=1).astype(np.float64)
    return bilinear(around, x + 1, y)


def mark_edges(view, depth, normal, number):
    """Which pixels (h, w) hold an edge; `normal` (h, w, 3) in view space, NaN and -1 where nothing is hit."""
    v, (height, width) = opened(view), depth.shape
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(x - v.cx) / v.fx, (v.cy - y) / v.fy, -np.ones_like(x)], axis=-1)
    out = np.zeros(depth.shape, bool)
    for j in range(height):
        for i in range(width):
            for k in range(max(j - 1, 0), min(j + 2, height)):
                for m in range(max(i - 1, 0), min(i + 2, width)):
                    a, b = (j, i), (k, m)
                    hits = np.isfinite(depth[a]), np.isfinite(depth[b])
                    if hits[0] != hits[1]:
                        out[a] = True
                    if not all(hits) or a == b:
                        continue
                    if number[a] != number[b] or normal[a] @ normal[b] < CREASE:
                        out[a] = True
                        continue
                    px = min(depth[a], depth[b]) / v.fx if v.perspective else 1 / v.fx
                    off = []
                    for c, d in ((a, b), (b, a)):
                        if v.perspective:
                            there = depth[c] * (normal[c] @ rays[c]) / (normal[c] @ rays[d])
                        else:
                            step = rays[d] - rays[c]
                            there = depth[c] + (normal[c][:2] @ step[:2]) / normal[c][2]
                        off.append(abs(there - depth[d]))
                    out[a] |= abs(depth[a] - depth[b]) > STEP_PX * px and min(off) > STEP_PX * px
    return out
