"""How many surfels and numbers a surface takes for one error, by the degree of its surfels.

Source: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces with Applications to High Quality Rendering,
Feature Extraction, and Smoothing", SGP 2005, section 4, "Sparsity analysis", figures 21 and 22.
"""

import math
import os
from dataclasses import dataclass, replace

import numpy as np

from ..build.normals import estimate_normals
from ..build.slim import build_slim, face_normals
from ..device import open_device
from ..errors import Cancelled, InputError
from ..io import load
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.ranges import RangeScan
from ..surface.slim import COEFFICIENTS, FLOATS, SlimSurface
from .error import error as measure

LEAST_T, MOST_T = 1e-5, 0.9  # of T_MDL in the search
CURVE = (0.0025, 0.005, 0.01, 0.02, 0.04)  # T_MDL of the curves
CLOSE = 0.005  # of the target: an error so little below it is found
BUILDS = 16  # of one search


@dataclass(frozen=True)
class Sparseness:
    """Size and error of one SLIM surface.

    Attributes
    ----------
    degree : int
    t_mdl : float
        The builder's `error`.
    leaves, floats : int
        Surfels, and the numbers that they store: 7, 12 or 16 each by degree.
    rms, p99 : float
        L2 error and its 99th percentile, over the diagonal.
    """

    degree: int
    t_mdl: float
    leaves: int
    floats: int
    rms: float
    p99: float


@dataclass(frozen=True)
class SparsityStudy:
    """What `sparsity` found.

    Attributes
    ----------
    target : float
        The L2 error asked for, over the diagonal.
    needed : dict of int to Sparseness or None
        By degree the surface of the fewest leaves with this error; None where no surface of this degree reaches it.
    curves : dict of int to list of Sparseness
        By degree surfaces of rising T_MDL.
    """

    target: float
    needed: dict
    curves: dict

    def ratio(self, degree: int, to: int) -> float:
        """Return leaves of `degree` over those of degree `to` for the same error; NaN where either is missing."""
        over, under = self.needed.get(degree), self.needed.get(to)
        return math.nan if over is None or under is None else over.leaves / under.leaves

    def table(self) -> str:
        """Return the study as lines of text: degree, T_MDL, leaves, floats, L2 error and 99th percentile in %."""
        rows = [f"{'degree':>6} {'T_MDL':>9} {'leaves':>9} {'floats':>10} {'L2 %':>9} {'99 % within %':>14}"]
        for degree, found in self.needed.items():
            for mark, one in [*((" ", s) for s in self.curves.get(degree, ())), *([("*", found)] if found else ())]:
                rows.append(f"{degree:>6} {one.t_mdl:>9.5f} {one.leaves:>9,} {one.floats:>10,} {100 * one.rms:>9.5f} "
                            f"{100 * one.p99:>14.5f} {mark}".rstrip())
            if found is None:
                rows.append(f"{degree:>6}   no surface within {100 * self.target:g} %")
        return "\n".join([*rows, f"* the fewest leaves for an L2 error of {100 * self.target:g} % of the diagonal"])


def sparsity(scan, target: float = 1e-4, degrees=(1, 2, 3), curve=CURVE, progress=None, device=None) -> SparsityStudy:
    """Find the surfels and floats that surfaces of each degree need for one L2 error, and their curves.

    Parameters
    ----------
    scan : Mesh, PointCloud, RangeScan or path
    target : float
        L2 error over the diagonal; 1e-4 is the paper's 0.01 %.
    degrees : sequence of int
        From 1, 2, 3.
    curve : sequence of float
        T_MDL of further surfaces to measure, for L2 error over leaves and floats; empty for none.
    progress : callable, optional
        Called as progress(stage, done); returning False stops the study.
    device : None, str or Device

    Returns
    -------
    SparsityStudy
        The same scan gives the same study on one device.

    Raises
    ------
    InputError
        As `build_slim`, or a target or degrees out of range.
    Cancelled
        `progress` returned False.
    """
    if not 0 < target < 1:
        raise InputError(f"target: expected a share of the diagonal between 0 and 1, got {target!r}")
    if not degrees or any(degree not in COEFFICIENTS for degree in degrees):
        raise InputError(f"degrees: expected some of 1, 2 and 3, got {degrees!r}")
    scan, device = _with_normals(scan, device), open_device(device)
    needed, curves = {}, {}
    for k, degree in enumerate(degrees):
        if progress is not None and progress(f"degree {degree}", k / len(degrees)) is False:
            raise Cancelled("sparsity: stopped by the progress callback")
        found = {t: _measured(scan, degree, t, device)[0] for t in sorted(curve)}
        needed[degree] = _search(scan, degree, target, device, found)[0]
        curves[degree] = [found[t] for t in sorted(curve)]
    return SparsityStudy(float(target), needed, curves)


def slim_of_error(scan, target: float = 1e-4, degree: int = 2, device=None) -> tuple[SlimSurface, Sparseness]:
    """Return the sparsest SLIM surface whose L2 error is at most `target`, and its figures.

    Parameters
    ----------
    scan : Mesh, PointCloud, RangeScan or path
    target : float
        L2 error over the diagonal; 1e-4 is the paper's 0.01 %.
    degree : int
        1, 2 or 3.
    device : None, str or Device

    Returns
    -------
    surface : SlimSurface
    figures : Sparseness

    Raises
    ------
    InputError
        As `build_slim`, or an error that no T_MDL reaches.
    """
    if not 0 < target < 1:
        raise InputError(f"target: expected a share of the diagonal between 0 and 1, got {target!r}")
    figures, surface = _search(_with_normals(scan, device), degree, target, open_device(device), {})
    if surface is None:
        raise InputError(f"target: expected an L2 error that surfels of degree {degree} reach on this scan, got "
                         f"{target:g} of the diagonal: its noise or spacing is too large for it")
    return surface, figures


def _with_normals(scan, device) -> Mesh | PointCloud:
    """Return the scan with normals, so that they are estimated once, not for every surface."""
    if isinstance(scan, str | os.PathLike):
        scan = load(scan)
    if isinstance(scan, RangeScan):
        scan = scan.to_points()
    if isinstance(scan, PointCloud) and scan.normals is None:
        return estimate_normals(scan, device=device)
    if isinstance(scan, Mesh) and scan.normals is None and len(scan.faces) and np.isfinite(scan.vertices).all():
        return replace(scan, normals=face_normals(scan.vertices, scan.faces))
    return scan


def _measured(scan, degree: int, t_mdl: float, device) -> tuple[Sparseness, SlimSurface]:
    surface = build_slim(scan, degree=degree, error=t_mdl, device=device)
    found = measure(surface, scan, device=device).relative
    leaves = int(surface.leaf.sum())
    return Sparseness(degree, t_mdl, leaves, FLOATS[degree] * leaves, found.rms, found.percentile(99)), surface


def _search(scan, degree: int, target: float, device, known: dict) -> tuple[Sparseness | None, SlimSurface | None]:
    """Find the largest T_MDL whose surface keeps the target, by false position in the logarithms.

    L2 error rises as a power of T_MDL over most of its range; at both ends it is flat (the fewest points of a fit, the
    largest ball), which halving copes with. `known` are surfaces measured already, by T_MDL.
    """
    below = max((s for s in known.values() if s.rms <= target), key=lambda s: s.t_mdl, default=None)
    above = min((s for s in known.values() if s.rms > target), key=lambda s: s.t_mdl, default=None)
    best, surface = below, None
    for build in range(BUILDS):
        low, high = (below.t_mdl if below else LEAST_T), (above.t_mdl if above else MOST_T)
        share = 0.5
        if below and above and below.rms < above.rms and build % 3 < 2:
            share = math.log(target * (1 - CLOSE / 2) / below.rms) / math.log(above.rms / below.rms)
        t_mdl = low * (high / low) ** min(max(share, 0.02), 0.98)
        found, candidate = _measured(scan, degree, t_mdl, device)
        if found.rms <= target:
            below = found
            if best is None or found.leaves <= best.leaves:
                best, surface = found, candidate
        else:
            above = found
        if high / low < 1.005 or (best is not None and best.rms > (1 - CLOSE) * target):
            break
    return best, surface
