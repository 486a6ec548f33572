"""Smoothing of noisy meshes and point clouds by blended local surfaces, with everything found automatically.

Source: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces", SGP 2005, section 4, "Smoothing".
"""

import os
from dataclasses import replace

import numpy as np

from ..build.slim import face_normals
from ..device import open_device
from ..errors import Cancelled, InputError
from ..io import load
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from .smooth_cloud import smooth_points
from .smooth_mesh import MOVES_FREELY, SLIDES, STAYS, net_of, smooth_net

METHODS = ("auto", "normals", "quadrics", "projection")


def smooth(scan, strength="auto", iterations=1, method="auto", fixed_border=False, progress=None, device=None):
    """Smooth a noisy mesh or point cloud; noise level and radii are found from the scan itself, place by place.

    Parameters
    ----------
    scan : Mesh, PointCloud, str or PathLike
        A path is read with `clsurf.load`.
    strength : float or "auto"
        "auto" is 1. Below 1 points move by that share of the way, 0 returns the scan itself; above 1 the radii of the
        local surfaces are that many times as large.
    iterations : int
        Smooths the result again; noise and radii are found anew.
    method : str
        "normals" (the default for meshes): faces turn to the blended surfaces' normals. "quadrics": vertices minimise
        the distances to the planes of the projected centroids (the paper's). "projection" (the default for clouds):
        points go to the blended surfaces along the normal (equation 6).
    fixed_border : bool
        Vertices at open borders stay where they are; by default they move, but only along normals.
    progress : callable, optional
        Called as progress(stage, share done); returning False stops the work.
    device : None, str or Device

    Returns
    -------
    Mesh or PointCloud
        The scan's type, with its faces, order, colours, texture and attributes; normals, where it has some, follow the
        new shape. Vertices without a face with three distinct, finite corners stay.

    Raises
    ------
    InputError
        Not a mesh or a cloud, or an option out of range.
    Cancelled
        `progress` returned False.
    """
    if isinstance(scan, str | os.PathLike):
        scan = load(scan)
    if not isinstance(scan, Mesh | PointCloud):
        raise InputError(f"smooth: expected a Mesh, a PointCloud or the path of one, got {type(scan).__name__}: "
                         "range images have to_points()")
    strength = checked_strength(strength)
    if not (isinstance(iterations, int | np.integer) and iterations >= 0):
        raise InputError(f"iterations: expected a whole number of 0 or more, got {iterations!r}")
    if method not in METHODS:
        raise InputError(f"method: expected {', '.join(METHODS)}, got {method!r}")
    is_mesh = isinstance(scan, Mesh) and len(scan.faces) > 0
    if not is_mesh and method in ("normals", "quadrics"):
        raise InputError(f"method: {method!r} needs the faces of a mesh, got points only: use 'projection'")
    if strength == 0:
        return scan
    device = open_device(device)
    for i in range(iterations):
        if progress is not None and progress("smooth", i / iterations) is False:
            raise Cancelled("smooth: stopped by the progress callback")
        scan = _smooth_mesh(scan, strength, method, fixed_border, device) if is_mesh \
            else smooth_points(scan, strength, device)
    if progress is not None:
        progress("smooth", 1.0)
    return scan


def checked_strength(strength) -> float:
    """Return the strength as a number, 1 for "auto", or raise InputError."""
    if isinstance(strength, str) and strength == "auto":
        return 1.0
    if not isinstance(strength, int | float | np.number) or not 0 <= strength <= 100:
        raise InputError(f"strength: expected 'auto' or a number from 0 to 100, got {strength!r}")
    return float(strength)


def _smooth_mesh(mesh: Mesh, strength: float, method: str, fixed_border: bool, device) -> Mesh:
    made = net_of(mesh.vertices, mesh.faces, device)
    if made is None:
        return mesh
    net, target = made
    kind = np.where(net.border, STAYS if fixed_border else SLIDES, MOVES_FREELY).astype(np.uint8)
    moved = smooth_net(net, "normals" if method == "auto" else method, strength, kind)
    shift = np.zeros((int(target.max()) + 1, 3), np.float32)
    shift[net.used] = (moved - net.vertices) * np.float32(net.unit * min(strength, 1.0))
    vertices = mesh.vertices + shift[target]
    normals = None if mesh.normals is None else _unit_or(face_normals(vertices, mesh.faces), mesh.normals)
    return replace(mesh, vertices=vertices, normals=normals)


def _unit_or(normals, others):
    """Return `normals` (n, 3), those of length 0 replaced by the `others`."""
    return np.where((normals * normals).sum(axis=1, keepdims=True) > 0, normals, others)
