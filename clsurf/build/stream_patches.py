"""Spatial patches of streamed scans: every cell's own points are cut into regions, which end where the cell does."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..errors import InputError
from ..surface.arrays import extent_of
from ..surface.cloud import PointCloud
from ..surface.patch import PatchSurface
from .patches import PatchRequest
from .stream_plan import Plan


def cell_request(request: PatchRequest, plan: Plan, own: int, total: int, extent: float) -> PatchRequest:
    """Return what one cell is asked for, so that the cells together are what the user asked for.

    Parameters
    ----------
    own, total : int
        Points of the cell and of the scan.
    extent : float
        Diagonal of the cell's points, world units.
    """
    if request.patches is not None:
        return replace(request, patches=max(1, round(request.patches * own / total)))
    if request.error is not None:
        return replace(request, error=request.error * plan.diagonal / extent)
    return request


def build_patch_cell(position: NDArray, normals: NDArray, colors: NDArray | None, origin: NDArray, plan: Plan,
                     request: PatchRequest, total: int, device: Device) -> tuple[PatchSurface, NDArray]:
    """Return the patches of a cell's own points, and the distance (1,) that most of these keep; world units.

    Points that form no surface, such as a few strays, give no patches.
    """
    from .patch_local import convert
    extent = float(np.linalg.norm(extent_of(position))) if len(position) else 0.0
    if len(position) < 4 or not extent > 0:
        return no_patches(plan, request, colors is not None, origin), np.zeros(0, np.float32)
    asked = cell_request(request, plan, len(position), total, extent)
    try:
        surface = convert(PointCloud(position, normals, colors, origin=origin), asked, device, lambda *_: None)
    except InputError:
        return no_patches(plan, request, colors is not None, origin), np.zeros(0, np.float32)
    return replace(surface, diagonal=plan.diagonal), np.array([surface.bound], np.float32)


def no_patches(plan: Plan, request: PatchRequest, colored: bool, origin: NDArray) -> PatchSurface:
    """Return a surface without patches."""
    nothing = np.zeros((0, 3), np.float32)
    return PatchSurface(nothing, nothing, nothing, np.zeros(0, np.float32), np.array(request.nodes, np.int32),
                        np.zeros(0, np.int32 if request.precise else np.int8),
                        np.zeros((0, 4 if request.precise else 3), np.uint8) if colored else None,
                        origin=origin, diagonal=plan.diagonal)
