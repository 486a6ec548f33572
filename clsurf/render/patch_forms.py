"""The forms of a surface that modes draw: with coarser levels for minification, with nodes carried on for alpha.

A form is uploaded when the first frame needs it. Kernels: kernels/render/patch_levels.clh, pack_alphas.cl and
cull_patches.cl.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface, facet_cones
from .patch_alpha import extended
from .patch_mips import with_levels

LEVELS = 8  # most levels of a surface
WIDEST_SPACING_PX = 1.0  # the coarsest level whose nodes are at most this far apart is drawn


@dataclass(frozen=True, eq=False)
class Form:
    """A surface as one mode draws it, on a device."""

    upload: object  # PatchUpload: patch k's level l is its patch k * levels + l
    levels: int
    surface: PatchSurface  # the upload refers to it weakly


def surface_form(device: Device, upload, put, view: NDArray, drawing):
    """Return the `Form` that a frame draws `upload` in; None: as it is.

    Parameters
    ----------
    upload : PatchUpload
    put : callable
        ``put(device, surface)`` gives the upload of a surface.
    view : (32,) float32
        The view buffer of the placed surface.
    drawing : PatchDrawing
    """
    # The table of normals holds the normals of a patch's own nodes.
    minified = drawing.mip and not drawing.normal_table and least_spacing_px(upload, view) <= WIDEST_SPACING_PX / 2
    if not (minified or drawing.alpha):
        return None

    def make(surface):
        levels, alphas = 1, None
        if minified:
            surface, levels = with_levels(surface, LEVELS)
        if drawing.alpha:
            surface, alphas = extended(surface)
        made = put(device, surface)
        if alphas is not None:
            nodes = max(surface.node_count, 1)
            device.kernel("render/pack_alphas.cl")((nodes,), (64,), device.upload(np.pad(alphas, (0, 64))),
                                                   surface.node_count, made.nodes)
        return Form(made, levels, surface)

    return upload.once(("form", bool(minified), drawing.alpha), make)


def least_spacing_px(upload, view: NDArray) -> float:
    """Return the least distance in pixels that two nodes of a surface's finest patch may have in the picture."""
    least = upload.once("least_spacing", _least_spacing)
    scale, offset, focal = float(view[9]), view[10:13].astype(np.float64), float(min(view[13], view[14]))
    farthest = scale * upload.reach - (scale * view[6:9].astype(np.float64) @ upload.center + offset[2])
    return least * scale * focal / (max(farthest, 1e-30) if view[17] > 0 else 1.0)


def _least_spacing(surface: PatchSurface) -> float:
    return min(float(lengths_of(axis.astype(np.float64)).min(initial=np.inf))
               for axis in (surface.axis_x, surface.axis_y))


def cull_patches(device: Device, upload, whole, levels_count: int, levels: DeviceArray | None, view: DeviceArray,
                 projected) -> None:
    """Mark the patches that are seen from behind only as not in the picture; surfaces without orientation keep all.

    `whole` is the upload whose surface's patches are `upload`'s levels; the same where there is one level.
    """
    cones = whole.once("cones", lambda surface: _cones(device, surface))
    if cones is not None and upload.count:
        device.kernel("render/cull_patches.cl")(
            (upload.count,), (16,), view, upload.frames, upload.sizes, upload.count, cones, levels_count,
            upload.sizes if levels is None else levels, projected.rectangles, projected.boxes.shape[1], projected.boxes)


def _cones(device, surface):
    """Return the cones (p, 4) float32 of the facet normals, axis and half angle, or None."""
    if not surface.oriented:
        return None
    axes, cosines = facet_cones(surface)
    return device.upload(np.concatenate([axes, np.arccos(np.clip(cosines, -1, 1))[:, None]], axis=1), np.float32)
