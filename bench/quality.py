"""How far a rendered picture is from the exact one: holes, silhouettes, fragments, depth and normals.

All counts are pixels of one view. `rendered` is where the frame's depth is finite, `truth.hit` where a ray meets the
mesh. Distances between pixels are Euclidean between centres.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from .truth import Truth

OUTLIER = 0.005  # of the diagonal: a depth further off than this counts as an outlier
EIGHT = np.ones((3, 3), bool)  # pixels that touch at a corner hang together

# Per view; the summary of several views adds worst_ and mean_.
COUNTS = ("holes", "outside", "missing", "fragments", "depth_outliers", "depth_outliers_inner")


def masks(truth: Truth, depth: NDArray, diagonal: float) -> dict[str, NDArray]:
    """Return where each kind of fault is, (h, w) bool each.

    Returns
    -------
    holes
        Not rendered although inside the silhouette eroded by 3 pixels.
    outside, missing
        Rendered more than 1 pixel outside the silhouette; not rendered more than 1 pixel inside it.
    depth_outliers
        Hit by both, depths more than 0.5 % of the diagonal apart. `depth_outliers_inner`: also apart from the exact
        depths of the 8 neighbours, so that an occluding contour shifted by a pixel does not count.
    fragments
        Pixels that float: components (8-connected) of the rendered mask without a pixel within 1 pixel of the
        silhouette's inside, and components of pixels *in front of* the exact depth (by 0.5 % of the diagonal) of
        which no pixel is within 2 pixels of a depth jump or the silhouette, where an edge may rightly be.
    """
    rendered = np.isfinite(depth)
    hit = truth.hit
    inner = ndimage.distance_transform_edt(_padded(hit))[1:-1, 1:-1]
    outer = ndimage.distance_transform_edt(~hit) if hit.any() else np.full(hit.shape, np.inf)
    both = hit & rendered
    error = np.where(both, np.where(both, depth, 0) - np.where(both, truth.depth, 0), 0)
    limit = OUTLIER * diagonal
    filled = np.where(hit, truth.depth, np.inf).astype(np.float64)
    outliers = np.abs(error) > limit
    near = np.zeros(hit.shape, bool)
    padded = np.pad(filled, 1, constant_values=np.inf)
    for dy in range(3):
        for dx in range(3):
            shifted = padded[dy:dy + hit.shape[0], dx:dx + hit.shape[1]]
            near |= np.abs(np.where(both, depth, 0) - shifted) <= limit
    found = {"holes": (inner > 3) & ~rendered, "outside": rendered & (outer > 1), "missing": (inner > 1) & ~rendered,
             "depth_outliers": outliers, "depth_outliers_inner": outliers & ~near}
    low, high = ndimage.minimum_filter(filled, 5, mode="nearest"), ndimage.maximum_filter(filled, 5, mode="nearest")
    edge = ~(high < low + limit)
    found["fragments"] = (_components_without(rendered, hit | (outer <= 1))
                          | _components_without(both & (error < -limit), edge))
    return found


def _padded(mask):
    """Return the mask with a border of False: the picture's edge is an edge of the silhouette as well."""
    return np.pad(mask, 1, constant_values=False)


def _components_without(mask, excluded) -> NDArray:
    """Return the components of `mask` that hold no pixel of `excluded`, as a mask."""
    label, count = ndimage.label(mask, EIGHT)
    spoiled = np.zeros(count + 1, bool)
    spoiled[label[mask & excluded]] = True
    spoiled[0] = True
    return ~spoiled[label]


def measure(truth: Truth, depth: NDArray, normal: NDArray | None, diagonal: float, axis) -> dict[str, float]:
    """Return the figures of one view.

    Parameters
    ----------
    depth : (h, w) float
        Along the viewing axis, world units, NaN where nothing is drawn.
    normal : (h, w, 3) float, optional
        Unit, facing the eye.
    diagonal : float
        Of the scan's box, world units.
    axis : (3,)
        The viewing axis, world space, unit.

    Returns
    -------
    dict
        The counts of `COUNTS` (pixels; fragments: components), ``depth_median`` and ``depth_rms`` in % of the
        diagonal (the median over all pixels hit by both, the root mean square without the outliers),
        ``distance_median`` (the depth error times the cosine between viewing axis and normal: how far the surfaces
        are apart, % of the diagonal), ``normals_missing`` (pixels with a depth and no finite normal), ``normal_median``
        and ``normal_facet_median`` in degrees: against the mesh's interpolated normals and those of its triangles.
    """
    found = masks(truth, depth, diagonal)
    figures = {name: int(np.count_nonzero(found[name])) for name in COUNTS}
    figures["fragments"] = int(ndimage.label(found["fragments"], EIGHT)[1])
    figures["fragment_pixels"] = int(np.count_nonzero(found["fragments"]))
    both = truth.hit & np.isfinite(depth)
    figures["pixels"] = int(np.count_nonzero(truth.hit))
    if not both.any():
        return figures | dict.fromkeys(("depth_median", "depth_rms", "distance_median"), np.nan)
    error = 100 * np.abs(depth[both].astype(np.float64) - truth.depth[both]) / diagonal
    good = error <= 100 * OUTLIER
    figures["depth_median"] = float(np.median(error))
    figures["depth_rms"] = float(np.sqrt(np.mean(error[good] ** 2))) if good.any() else np.nan
    tilt = np.abs((truth.normal[both] * axis).sum(axis=1))
    figures["distance_median"] = float(np.median(error * tilt))
    if normal is not None:
        figures["normals_missing"] = int(np.count_nonzero(np.isfinite(depth) & ~np.isfinite(normal).all(axis=2)))
        good &= np.isfinite(normal[both]).all(axis=1)
        for name, exact in (("normal_median", truth.normal), ("normal_facet_median", truth.facet)):
            cosine = (normal[both][good].astype(np.float64) * exact[both][good]).sum(axis=1)
            figures[name] = float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))) if good.any() else np.nan
    return figures


def summary(views: list[dict[str, float]]) -> dict[str, float]:
    """Return ``worst_NAME`` and ``mean_NAME`` over the views of every figure."""
    names = views[0].keys()
    return ({f"worst_{name}": max(view[name] for view in views) for name in names}
            | {f"mean_{name}": float(np.mean([view[name] for view in views])) for name in names})


def fault_picture(truth: Truth, frame_color: NDArray, depth: NDArray, diagonal: float) -> NDArray:
    """Return the picture (h, w, 3) uint8, dimmed, with its faults in colour.

    Holes red, missing pixels orange, outside blue, depth outliers green, inner ones magenta, fragments yellow.
    """
    found = masks(truth, depth, diagonal)
    picture = (96 + 0.5 * np.asarray(frame_color)[..., :3].astype(np.float64)).astype(np.uint8)
    for name, colour in (("depth_outliers", (0, 160, 0)), ("depth_outliers_inner", (255, 0, 255)),
                         ("missing", (255, 140, 0)), ("holes", (255, 0, 0)), ("outside", (0, 60, 255)),
                         ("fragments", (255, 230, 0))):
        picture[found[name]] = colour
    return picture
