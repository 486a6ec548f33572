"""Faults of pictures of closed patch models: pinholes, speckle, and how far a sphere's depth is from its formula."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, binary_fill_holes

from clsurf.io.images import to_srgb8
from clsurf.render.camera import Camera

EIGHT = np.ones((3, 3), bool)  # a pixel and its neighbours
DEPTH_LIMIT = 0.02  # world units: no pixel of the perfect sphere may be further off
# Cosine between normal and ray from which on depth is compared by itself: 70 degrees. A surface e off its formula is
# e / cosine off along the ray: 0.001, half of what bilinear cells of 1 unit dip, passes the limit from 87 degrees on.
FACING = 0.34
SPECKLE_SPACINGS = 0.25  # node spacings that a pixel stands out of all its neighbours by
SPECKLE_DEGREES = 20.0  # or its normal off the mean of theirs
SPECKLE_STEPS = 8  # or one of its colours, in sRGB steps of 255, out of all of theirs


def sphere_faults(frame, camera: Camera, size, radius: float) -> dict:
    """Return how a picture of the sphere of `radius` about the origin differs from its formula.

    Returns
    -------
    dict
        ``pinholes``: pixels not drawn although their rays and all neighbours' hit the sphere; ``outside``: drawn, no
        neighbour's ray hits; ``radial``: largest distance of a pixel's place from the sphere; ``depth_facing``:
        largest error along the viewing axis where the sphere is seen at up to 70 degrees; ``off``: pixels whose depth
        is more than 0.02 off; ``off_facing``: those of them that are seen at up to 70 degrees. Lengths in world units.
    """
    exact, facing = sphere_depth(camera, size, radius)
    hit, drawn = np.isfinite(exact), np.isfinite(frame.depth)
    both = hit & drawn
    error = np.where(both, np.abs(frame.depth - exact), 0)
    origins, directions = camera.rays(size)
    along = -directions @ camera.rotation[2]
    place = origins + directions * (frame.depth.reshape(-1) / along)[:, None]
    radial = np.abs(np.linalg.norm(place, axis=1) - radius)[drawn.ravel()]
    off, faces = error > DEPTH_LIMIT, both & (facing >= FACING)
    return {"pinholes": int((binary_erosion(hit, EIGHT) & ~drawn).sum()),
            "outside": int((drawn & ~binary_dilation(hit, EIGHT)).sum()), "radial": float(radial.max(initial=0)),
            "depth_facing": float(error[faces].max(initial=0)), "off": int(off.sum()),
            "off_facing": int((off & faces).sum()), "pixels": int(drawn.sum())}


def sphere_depth(camera: Camera, size, radius: float) -> tuple[NDArray, NDArray]:
    """Return depth and cosine between normal and ray, (h, w) float64, of a sphere about the origin; NaN: missed."""
    origins, directions = camera.rays(size)
    b = np.einsum("na,na->n", origins, directions)
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - (np.einsum("na,na->n", origins, origins) - radius ** 2))
    depth = (root + b) * (directions @ camera.rotation[2])
    return depth.reshape(size[1], size[0]), (root / radius).reshape(size[1], size[0])


def faults(frame, spacing: float) -> dict:
    """Return pinholes and speckle of a picture of a closed model, by the picture alone.

    Parameters
    ----------
    frame : Frame
        With colour, depth and normal.
    spacing : float
        Of the nodes, world units.

    Returns
    -------
    dict
        ``pinholes``: undrawn pixels that drawn ones enclose; ``depth_speckle``, ``color_speckle``,
        ``normal_speckle``: pixels away from the silhouette whose depth or colour differs from each of the 8 beside them
        by a quarter of a node spacing or 8 of 255 steps and more than those do among each other, or whose normal
        differs from the mean of theirs by 20 degrees and more than each of theirs does. At an edge the neighbours
        differ as much.
    """
    drawn = np.isfinite(frame.depth)
    pinholes = binary_fill_holes(drawn) & ~drawn
    inner = binary_erosion(drawn, EIGHT, iterations=2)
    depth, normal = np.where(drawn, frame.depth, 0).astype(np.float64), np.nan_to_num(frame.normal)
    ring = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]
    depth_speckle = _stands_out(depth, ring, SPECKLE_SPACINGS * spacing)
    shown = to_srgb8(frame.color)[..., :3].astype(np.float32)
    color_speckle = np.any([_stands_out(shown[..., c], ring, SPECKLE_STEPS) for c in range(3)], axis=0)
    mean = sum(np.roll(normal, at, (0, 1)) for at in ring)
    mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-9)
    own = (normal * mean).sum(axis=-1)
    others = np.stack([(np.roll(normal, at, (0, 1)) * mean).sum(axis=-1) for at in ring]).min(axis=0)
    normal_speckle = (own < np.cos(np.radians(SPECKLE_DEGREES))) & (own < others)
    specks = {"depth_speckle": depth_speckle, "color_speckle": color_speckle, "normal_speckle": normal_speckle}
    return {"pinholes": int(pinholes.sum()), "pixels": int(drawn.sum())} | {
        name: int((found & inner).sum()) for name, found in specks.items()}


def _stands_out(values: NDArray, ring, limit: float) -> NDArray:
    """Return where values (h, w) differ from each of their neighbours by `limit` and more than those do."""
    low = high = np.roll(values, ring[0], (0, 1))
    for at in ring[1:]:
        beside = np.roll(values, at, (0, 1))
        low, high = np.minimum(low, beside), np.maximum(high, beside)
    return np.maximum(low - values, values - high) > np.maximum(limit, high - low)
