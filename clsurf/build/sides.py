"""The sides of unoriented SLIM surfaces: which way the normal of each leaf points."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..surface.slim import SlimSurface, frame_of_normals, powers
from .orientation import signs_of

_DEGREE = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])  # of a polynomial's terms


def with_sides(surface: SlimSurface, device: Device) -> SlimSurface:
    """Return a surface whose leaves' normals agree with their neighbours' and point outward, without other surfels."""
    leaf = np.flatnonzero(surface.leaf)
    centers, normals, radii = surface.centers[leaf], surface.normals[leaf], surface.radii[leaf]
    signs = signs_of(centers, normals, float(np.median(radii)), device=device) if len(leaf) else np.zeros(0)
    turned = turned_over(surface, leaf[signs < 0])
    take = lambda array: None if array is None else array[leaf]  # noqa: E731
    names = ("centers", "radii", "normals", "coefficients", "level", "leaf", "fit_error", "footprint", "colors")
    return replace(turned, **{name: take(getattr(turned, name)) for name in names}, oriented=True,
                   child_offset=np.zeros(len(leaf) + 1, np.int32), children=np.zeros(0, np.int32))


def turned_over(surface: SlimSurface, some: NDArray) -> SlimSurface:
    """Return a surface with the normals of some surfels (k,) reversed, the zero sets as they are.

    The frame that belongs to the reversed normal is turned in its plane too: the polynomial is fitted anew to its own
    values in it, which is exact. Footprints, which count from the frame's axes, are opened.
    """
    normals = surface.normals[some].astype(np.float64)
    radii = surface.radii[some, None].astype(np.float64)
    terms = surface.coefficients.shape[1]
    size = radii ** _DEGREE[:terms]
    angle = np.arange(24) * 2 * np.pi / 24
    u, v = (np.append(np.outer((0.5, 1.0), turn(angle)), 0.0) for turn in (np.cos, np.sin))
    old, new = frame_of_normals(normals), frame_of_normals(-normals)
    in_old = [u * np.einsum("ij,ij->i", new[0], axis)[:, None] + v * np.einsum("ij,ij->i", new[1], axis)[:, None]
              for axis in old]
    height = np.einsum("nkm,nm->nk", powers(*in_old)[..., :terms], surface.coefficients[some] * size)
    all_normals, coefficients = surface.normals.copy(), surface.coefficients.copy()
    all_normals[some] = -normals
    coefficients[some] = -(height @ np.linalg.pinv(powers(u, v)[:, :terms]).T) / size
    footprint = None if surface.footprint is None else surface.footprint.copy()
    if footprint is not None:
        footprint[some] = 255
    return replace(surface, normals=all_normals, coefficients=coefficients, footprint=footprint)
