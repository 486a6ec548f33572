"""The surface that feature lines are found on: cubic, and as coarse as the scan's noise asks for."""

import os

import numpy as np

from ..build.point_tree import build_point_tree
from ..build.radius import robust_box
from ..build.slim import build_slim
from ..device import open_device
from ..errors import InputError
from ..io import load
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.ranges import RangeScan
from ..surface.slim import SlimSurface
from .risk import noise_level, spread_samples
from .scan_points import scan_points

CUBIC = 3
# T_MDL by the noise's standard deviation over the diagonal: tori and spheres with noise of 0.1, 0.2 and 0.4 % have no
# lines of noise from errors of 0.03, 0.035 and 0.05 on; scans without noise look best at 0.03.
LEAST_ERROR, ERROR_PER_NOISE, CLEAN, LARGEST_ERROR = 0.03, 10.0, 0.0003, 0.2


def line_surface(scan, memory_limit=None, progress=None, device=None) -> SlimSurface:
    """Build the surface on which `lines` finds clean lines: of degree 3, its error from the scan's noise.

    It is coarser than what one would show: draw a finer one, and give its frame to `lines` as the silhouette.

    Parameters
    ----------
    scan : Mesh, PointCloud, RangeScan, str or PathLike
        As for `build_slim`.
    memory_limit : int or str, optional
        As for `build_slim`.
    progress : callable, optional
        As for `build_slim`.
    device : None, str or Device

    Returns
    -------
    SlimSurface
        `error` is 0.03 for scans without noise.

    Raises
    ------
    InputError, DeviceMemoryError, Cancelled
        As for `build_slim`.
    """
    if isinstance(scan, str | os.PathLike):
        scan = load(scan)
    if isinstance(scan, RangeScan):
        scan = scan.to_points()
    if not isinstance(scan, Mesh | PointCloud):
        raise InputError("scan: expected a Mesh, a PointCloud, a RangeScan or the path of a scan, got "
                         f"{type(scan).__name__}")
    device = open_device(device)
    return build_slim(scan, degree=CUBIC, error=line_error(scan, device), memory_limit=memory_limit, progress=progress,
                      device=device)


def line_error(scan, device) -> float:
    """Return T_MDL of the surface that the lines of a Mesh or PointCloud are found on."""
    found = scan_points(scan, device)
    box = robust_box(found.position)
    diagonal = float(np.linalg.norm(box[1] - box[0]))
    if not diagonal > 0:
        raise InputError("scan: expected points with some extent, got all of them at one place")
    tree = build_point_tree(found.position, found.normals, box.mean(axis=0).astype(np.float32), 1.0 / diagonal, device)
    noise = noise_level(tree, spread_samples(tree))
    return float(np.clip(LEAST_ERROR + ERROR_PER_NOISE * max(noise - CLEAN, 0.0), LEAST_ERROR, LARGEST_ERROR))
