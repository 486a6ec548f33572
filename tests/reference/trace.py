"""Plain float64 twins of the packet kernels in kernels/trace: every ray asks every surfel, without a tree."""

import numpy as np

from clsurf.surface.slim import frame_of_normals

from . import render


def trace_pixels(surface, view, size):
    """Depth, gradient, weight and number of surfels of every pixel: what the tile renderer's twin sees of leaves."""
    keep = np.flatnonzero(surface.leaf)
    footprint = None if surface.footprint is None else surface.footprint[keep]
    return render.tile_slim(surface.degree, view, render.project_slim(view, surface)[keep], render.pixel_centres(size),
                            surface.oriented, footprint)


OFFSET_RADII, GRAZING_RADII, FRONT_RADII, LARGEST_OFFSET, RIM_COSINE, RIM_OFFSET = 0.25, 0.04, 1.0, 2.0, 0.2, 1.0


def trace_lights(surface, view, lamps, reach, points, normals, eye):
    """Bits (p,) of the lamps that points do not see because of a surface; points, normals, eye in view space.

    `lamps` are rows of kind (1: directional, 2: point) and vector; `eye` (p, 3) points from the points to the eye.
    """
    v = render.opened(view)
    keep = np.flatnonzero(surface.leaf)
    k = render.project_slim(view, surface)[keep]  # only its coefficients, which no view changes
    centers = render.in_view(view, surface.centers[keep])
    radii = v.scale * surface.radii[keep].astype(np.float64)
    n = surface.normals[keep].astype(np.float64)
    axes = np.stack([np.asarray(a, np.float64) @ v.rotation.T for a in (*frame_of_normals(n), n)], axis=1)  # (n, 3, 3)
    footprint = None if surface.footprint is None else surface.footprint[keep]
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    rim = np.abs((unit * eye).sum(axis=1)) < RIM_COSINE
    out = np.zeros(len(points), np.int64)
    for bit, lamp in enumerate(lamps):
        to = np.broadcast_to(lamp[1:4], points.shape) if lamp[0] == 1 else lamp[1:4] - points
        away = np.linalg.norm(to, axis=1) if lamp[0] == 2 else np.full(len(points), np.inf)
        ray = -to / np.linalg.norm(to, axis=1, keepdims=True)  # from the lamp
        cosine = -(unit * ray).sum(axis=1)
        with np.errstate(divide="ignore"):
            offset = np.clip(np.where(cosine > 0, GRAZING_RADII / cosine, LARGEST_OFFSET), OFFSET_RADII, LARGEST_OFFSET)
        offset = np.where(rim, np.maximum(offset, RIM_OFFSET), offset)[:, None] * radii
        at = np.einsum("pnj,nij->pni", points[:, None] - centers, axes) / radii[:, None]
        d = np.einsum("pj,nij->pni", ray, axes) / radii[:, None]
        # Lengths along the ray are the same for directional and point lamps, but depths are those of a packet's axis:
        # offsets and reach are shorter by the ray's slant to it, which the tests' small packets do not show.
        for side, least in ((-1.0, offset), (1.0, offset + FRONT_RADII * radii)):
            s, _, good = render.ray_root(surface.degree, render.ray_poly(surface.degree, k, at, d), side)
            with np.errstate(invalid="ignore", over="ignore"):
                hit = at + s[..., None] * d
                good &= ((hit**2).sum(axis=-1) < render.ALPHA**2) & (s < -least) & (s > -reach) & (-s < away[:, None])
                if footprint is not None:
                    good &= render.inside_footprint(footprint, hit)
            out |= (good.any(axis=1) & (cosine > 0)).astype(np.int64) << bit
    return out


def lamp_rays(pixels, view, place, lamp, bit, step, reach, bins_x, planes, mask):
    """Return the rays (n, 8) from the points of `pixels` to one lamp, in the frame of `place`."""
    bins, at = pixels // 64, pixels % 64
    depth, normal = planes[bins, 0, at].astype(float), planes[bins, 1:4, at].astype(float)
    x, y = bins % bins_x * 8 + at % 8 + 0.5, bins // bins_x * 8 + at // 8 + 0.5
    across = depth if view[17] else 1.0
    points = np.stack([(x - view[15]) / view[13] * across, (view[16] - y) / view[14] * across, -depth], axis=1)
    points += step * normal / np.linalg.norm(normal, axis=1, keepdims=True)
    to = np.tile(lamp[1:4].astype(float), (len(pixels), 1)) - (points if lamp[0] == 2 else 0)
    length = np.linalg.norm(to, axis=1)
    far = np.minimum(length, reach) if lamp[0] == 2 else np.full(len(pixels), reach)
    want = ((to * normal).sum(axis=1) > 0) & (mask[bins, at] >> np.uint32(bit) & 1 == 0)
    linear, zero, unit = place[:12].reshape(3, 4)[:, :3], place[:12].reshape(3, 4)[:, 3], place[12]
    out = np.zeros((len(pixels), 8))
    out[:, :3], out[:, 3] = points @ linear.T + zero, step / unit
    out[:, 4:7] = to @ linear.T * (unit / length)[:, None]
    out[:, 7] = np.where(want, np.minimum(far, 1e30) / unit, -1)
    return out


def light_bins(view, shading, pixels, depth, gradient, base, shadows, directions=None, hidden=None):
    """Linear colours (p, 3) of hit pixels: what `render.shade` gives, without hidden lamps and ambient light.

    `shadows` (p,) are bits of lamps; `hidden` (p, n) says which of the `directions` (n, 3) a point does not see.
    """
    s = np.array(shading, np.float64)
    lamps = s[16:].reshape(-1, 16)
    unit = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    open_part = np.ones(len(pixels))
    if directions is not None:
        weight = np.clip(unit @ np.asarray(directions, np.float64).T, 0, None)
        open_part = np.where(hidden, 0, weight).sum(axis=1) / weight.sum(axis=1)
    alone = np.concatenate([s[:16], np.zeros(16)])
    alone[12] = 1
    color = base * s[3] * open_part[:, None]
    alone[3] = 0
    for i, lamp in enumerate(lamps[:int(s[12])]):
        alone[16:32] = lamp
        seen = 1 - (np.asarray(shadows) >> i & 1)
        color = color + seen[:, None] * render.shade(view, alone, pixels, depth, gradient, base)[:, :3]
    return color
