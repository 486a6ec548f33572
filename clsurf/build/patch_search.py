"""The node spacing that gives a wanted number of patches, or a wanted error."""

import logging

import numpy as np

log = logging.getLogger("clsurf")

TRIALS = 8  # spacings tried


def searched(at, request, default: float, area: float, finest: float, diagonal: float, step):
    """Return the surface that `request` asks for.

    Parameters
    ----------
    at : callable
        at(spacing, progress) gives a PatchSurface and its root mean square error, world units.
    request : PatchRequest
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
    """
    if request.patches is not None:
        m, n = request.nodes
        return with_count(at, request.patches, float(np.sqrt(area / (0.4 * request.patches * (m - 1) * (n - 1)))), step)
    if request.error is not None:
        coarsest = max(0.5 * diagonal / (min(request.nodes) - 1), 1.01 * finest)
        return with_error(at, request.error * diagonal, finest, coarsest, step)
    return at(default if request.spacing is None else float(request.spacing), step)[0]


def with_count(at, wanted: int, spacing: float, step):
    """Return a surface of at most `wanted` patches and close to as many, or else that of the fewest found."""
    best, low, high = None, 0.0, np.inf  # spacings known to give too many, and few enough
    for trial in range(TRIALS):
        surface, _ = at(spacing, _part(step, trial))
        count = len(surface)
        if best is None or _rank(count, wanted) < _rank(len(best), wanted):
            best = surface
        if 0.96 * wanted <= count <= wanted:
            break
        low, high = (max(low, spacing), high) if count > wanted else (low, min(high, spacing))
        guess = spacing * np.sqrt(count / (0.98 * wanted))
        inside = low * 1.002 < guess < high * 0.998
        spacing = guess if inside else np.sqrt(low * high) if 0 < low and high < np.inf else guess
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
