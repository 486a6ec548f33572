"""The node spacing that gives a wanted number of patches, or a wanted error."""

import logging

import numpy as np

from ..errors import InputError
from .patch_limits import FILLED, check_patches, check_spacing, most_of_cloud, widest_spacing

log = logging.getLogger("clsurf")

TRIALS = 8  # spacings tried


def searched(at, request, count: int, default: float, area: float, finest: float, diagonal: float, step,
             sparse: float = 0.0):
    """Return the surface that `request` asks for.

    Parameters
    ----------
    at : callable
        at(spacing, progress) gives a PatchSurface and its root mean square error, world units.
    request : PatchRequest
    count : int
        Points of the scan.
    default : float
        Spacing where nothing is asked for, world units.
    area : float
        Of the scan, about.
    finest : float
        Least spacing that the points allow.
    diagonal : float
        What the error is relative to.
    step : callable
        step(fraction, what), from 0 to 1.
    sparse : float
        Spacing below which no number of patches leads: most nodes would be missing.
    """
    m, n = request.nodes
    widest = max(widest_spacing(diagonal, finest, request.nodes), default)
    most, scan = most_of_cloud(count, request.nodes), f"a cloud of {count:,} points"
    least = min(float(np.sqrt(area / (FILLED * most * (m - 1) * (n - 1)))), finest, widest)
    if request.patches is not None:
        check_patches(request.patches, most, scan)
        first = float(np.sqrt(area / (0.4 * request.patches * (m - 1) * (n - 1))))
        return with_count(at, request.patches, first, default, (max(least, sparse), widest), step)
    if request.error is not None:
        coarsest = max(0.5 * diagonal / (min(request.nodes) - 1), 1.01 * finest)
        return with_error(at, request.error * diagonal, finest, coarsest, step)
    if request.spacing is not None:
        check_spacing(request.spacing, least, scan)
    return at(default if request.spacing is None else min(float(request.spacing), widest), step)[0]


def with_count(at, wanted: int, spacing: float, default: float, limits, step):
    """Return a surface of at most `wanted` patches and close to as many, or else that of the fewest found.

    `limits` are the least and the largest spacing to try; `default` is one that shows the surface if any does.
    """
    best, low, high = None, 0.0, np.inf  # spacings known to give too many, and few enough
    failed, tried = None, set()
    for trial in range(TRIALS):
        spacing = float(min(max(spacing, limits[0]), limits[1]))
        if spacing in tried:
            break
        tried.add(spacing)
        try:
            surface, _ = at(spacing, _part(step, trial))
        except InputError as error:  # too coarse for anything to show, or too fine for the images of views
            failed = error
            low, high = (low, min(high, spacing)) if spacing > default else (max(low, spacing), high)
            spacing = default if default not in tried else np.sqrt(spacing * default)
            continue
        count = len(surface)
        if best is None or _rank(count, wanted) < _rank(len(best), wanted):
            best = surface
        if 0.96 * wanted <= count <= wanted:
            break
        low, high = (max(low, spacing), high) if count > wanted else (low, min(high, spacing))
        guess = spacing * np.sqrt(count / (0.98 * wanted))
        inside = low * 1.002 < guess < high * 0.998
        spacing = guess if inside else np.sqrt(low * high) if 0 < low and high < np.inf else guess
    if best is None:
        raise failed
    return best


def _rank(count, wanted):
    """Return what sorts numbers of patches: those up to the wanted one, the most first; then the fewest."""
    return count > wanted, abs(wanted - count)


def with_error(at, wanted: float, finest: float, coarsest: float, step):
    """Return the coarsest surface found whose error (world units) is at most `wanted`, or else the finest."""
    low, high, best = np.log(finest), np.log(coarsest), None
    spacing = min(low + np.log(2.0), (low + high) / 2)
    for trial in range(TRIALS):
        surface, error = at(float(np.exp(spacing)), _part(step, trial))
        if error <= wanted:
            best, low = surface, spacing
        else:
            high = spacing
        if high - low < 0.05 or spacing == np.log(finest):
            break
        spacing = (low + high) / 2 if best is not None or trial < TRIALS - 2 else np.log(finest)
    if best is None and spacing != np.log(finest):
        surface, error = at(finest, _part(step, TRIALS - 1))
        best = surface if error <= wanted else None
    if best is None:
        log.warning("build_patches: error %.3g (world units) not reached: %.3g at the finest spacing that the points "
                    "allow", wanted, error)
    return surface if best is None else best


def _part(step, trial):
    """Return the progress of one of `TRIALS` trials."""
    return lambda share, what: step((trial + share) / TRIALS, what)
