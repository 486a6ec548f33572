"""The scan of `clsurf demo`: a painted amphora with everything that makes a scan hard.

Smooth belly, sharp edges at foot and lip, cusped flutes, a meander in relief, a row of beads, thin handles that meet
the body in a crease, and a dark inside. All of it comes from formulas; nothing is random.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsurf.errors import InputError
from clsurf.surface.cloud import PointCloud

from ..surface.arrays import lengths_of
from .lattice import area_density, points_on

# sRGB
_CLAY, _LIGHT, _BLACK, _CREAM = ((0.80, 0.42, 0.22), (0.88, 0.55, 0.32), (0.13, 0.115, 0.12), (0.93, 0.84, 0.68))

# Profile pieces (radius, height) from the axis below, up the outside, and down the inside; they meet in sharp edges.
_UNDERSIDE = ((0.0, 0.012), (0.06, 0.012), (0.11, 0.006), (0.158, 0.0))
_FOOT = ((0.158, 0.0), (0.170, 0.012), (0.170, 0.030), (0.152, 0.042))
_STEM = ((0.152, 0.042), (0.110, 0.050), (0.086, 0.068), (0.080, 0.092))
_BODY = ((0.080, 0.092), (0.150, 0.190), (0.245, 0.330), (0.318, 0.490), (0.336, 0.610), (0.300, 0.725),
         (0.205, 0.800), (0.118, 0.830))
_COLLAR = ((0.118, 0.830), (0.130, 0.838), (0.130, 0.850), (0.114, 0.858))
_NECK = ((0.114, 0.858), (0.104, 0.900), (0.106, 0.960), (0.128, 1.010), (0.150, 1.030))
_LIP = ((0.150, 1.030), (0.176, 1.036), (0.182, 1.056), (0.168, 1.072))
_RIM = ((0.168, 1.072), (0.155, 1.074), (0.142, 1.072))
_INSIDE = ((0.142, 1.072), (0.100, 1.010), (0.078, 0.950), (0.076, 0.900))
_FLOOR = ((0.076, 0.900), (0.040, 0.890), (0.0, 0.888))
_HANDLE = ((0.098, 0.945), (0.200, 0.985), (0.290, 0.960), (0.325, 0.870), (0.300, 0.770), (0.255, 0.715))

_FLUTES, _BEADS, _KEYS, _TONGUES = 36, 44, 14, 18
_BEAD = 0.0125  # radius; five point spacings across at 100,000 points
_BAND = (0.470, 0.626)  # heights between which the meander runs
_KEY = (((0, 0), (5, 0)), ((0, 0), (0, 4)), ((0, 4), (3.7, 4)), ((3.7, 4), (3.7, 1.3)), ((3.7, 1.3), (1.3, 1.3)),
        ((1.3, 1.3), (1.3, 2.7)), ((1.3, 2.7), (2.4, 2.7)))  # one unit of the meander, five stroke distances wide
_TUBE = 0.021  # radius of a handle


def demo_scan(n: int = 100_000) -> PointCloud:
    """Return the amphora: about `n` points with exact normals and colours, 1.07 high, standing on y = 0, y up.

    The same `n` gives the same points to the last bit.

    Raises
    ------
    InputError
        Fewer than 1000 points.
    """
    if n < 1000:
        raise InputError(f"n: expected at least 1000 points, got {n}")
    pieces = [(_revolved(profile), paint) for profile, paint in (
        (_UNDERSIDE, _plain(_CLAY)), (_FOOT, _plain(_BLACK)), (_STEM, _plain(_BLACK)), (_BODY, _paint_body),
        (_COLLAR, _plain(_BLACK)), (_NECK, _paint_neck), (_LIP, _plain(_BLACK)), (_RIM, _plain(_CLAY)),
        (_INSIDE, _plain(_BLACK)), (_FLOOR, _plain(_BLACK)))]
    pieces += [(_handle(side), _paint_handle) for side in (1, -1)]
    densities = [area_density(surface) for surface, _ in pieces]
    areas = np.array([density.mean() for density in densities])
    counts = np.ceil(1.015 * n * areas / areas.sum()).astype(int)  # 1.5 % end up inside another piece
    tree = _handle_axes()
    points, normals, colors = [], [], []
    for (surface, paint), density, count in zip(pieces, densities, counts, strict=True):
        p, normal, s, t = points_on(surface, count, density)
        if paint is _paint_handle:
            seen = ~_inside_body(p)
        else:
            seen = np.isinf(tree.query(p, distance_upper_bound=0.85 * _TUBE)[0])  # the bound halves the whole
        points.append(p[seen])
        normals.append(normal[seen])
        colors.append(paint(p[seen], s[seen], t[seen]))
    points, normals, colors = (np.concatenate(part) for part in (points, normals, colors))
    colors = np.clip(colors * (1 + _mottle(points))[:, None], 0, 1)
    rgba = np.full((len(points), 4), 255, np.uint8)
    rgba[:, :3] = np.rint(colors * 255)
    turn = np.array(((1, 0, 0), (0, 0, -1), (0, 1, 0)))  # the formulas have z up
    return PointCloud(points @ turn, normals @ turn, rgba, origin=np.zeros(3))


def _curve(profile):
    """Return the smooth curve through `profile`, a CubicSpline, parameter 0 to 1 by chord length."""
    from scipy.interpolate import CubicSpline  # a third of a second of every start
    profile = np.asarray(profile, np.float64)
    chord = np.append(0, np.cumsum(lengths_of(np.diff(profile, axis=0))))
    return CubicSpline(chord / chord[-1], profile, bc_type="natural")


def _revolved(profile):
    """Return the surface of revolution of `profile`, pushed outwards by its relief; d/ds x d/dt points outwards."""
    curve, relief = _curve(profile), {_BODY: _relief, _NECK: _tongues}.get(profile)

    def surface(s, t):
        radius, height = curve(s).T
        angle = -2 * np.pi * t
        if relief is not None:
            radius = radius + relief(height, -t % 1)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)

    return surface


def _relief(height: NDArray, turn: NDArray) -> NDArray:
    """Return how far the body's surface stands out at `height` and `turn` (full turns)."""
    fade = _step(height, 0.105, 0.150) * (1 - _step(height, 0.400, 0.425))
    flutes = -0.011 * fade * np.abs(np.sin(np.pi * _FLUTES * turn)) * _step(height, 0.05, 0.35)
    meander = 0.0075 * _meander(height, turn)
    beads = 0.010 * np.clip(1 - _bead(height, turn), 0, None)
    rings = sum(0.005 * np.exp(-((height - at) / 0.0045) ** 2) for at in (0.440, 0.652, 0.672, 0.728))
    return flutes + meander + beads + rings


def _bead(height: NDArray, turn: NDArray) -> NDArray:
    """Return the squared distance to the nearest bead's middle over the bead's radius."""
    across = height - 0.700
    along = ((turn * _BEADS) % 1 - 0.5) * 2 * np.pi * 0.313 / _BEADS
    return (across**2 + along**2) / _BEAD**2


def _tongues(height: NDArray, turn: NDArray) -> NDArray:
    """Return how far the tongues on the neck stand out: 0.004 with steep sides and a round end."""
    across = np.abs((turn * _TONGUES) % 1 - 0.5) * 2
    top = 0.985 + 0.02 * np.sqrt(1 - across**2)
    return 0.004 * (1 - _step(across, 0.45, 0.75)) * _step(height, 0.868, 0.876) * (1 - _step(height, top - 0.004, top))


def _meander(height: NDArray, turn: NDArray) -> NDArray:
    """Return 1 on the strokes of the Greek key, 0 beside them."""
    unit = (_BAND[1] - _BAND[0]) / 5
    x = (turn * _KEYS * 5 + 0.5) % 5 - 0.5
    y = (height - _BAND[0]) / unit - 0.5
    distance = np.full(np.shape(x), np.inf)
    for shift in (-5, 0, 5):
        for (x0, y0), (x1, y1) in _KEY:
            dx = np.maximum(np.maximum(min(x0, x1) - (x - shift), (x - shift) - max(x0, x1)), 0)
            dy = np.maximum(np.maximum(min(y0, y1) - y, y - max(y0, y1)), 0)
            distance = np.minimum(distance, np.maximum(dx, dy))
    return 1 - _step(distance, 0.30, 0.52)


def _handle(side: int):
    """Return one handle: a tube of three twisted strands along a curve in the plane y = 0."""
    curve, slope = _curve(_HANDLE), _curve(_HANDLE).derivative()

    def surface(s, t):
        middle, along = curve(s), slope(s)
        along = along / lengths_of(along, keepdims=True)
        angle = -2 * np.pi * t
        radius = _TUBE * (0.90 + 0.10 * np.cos(3 * angle + 40 * s))
        across = radius * np.cos(angle)
        x = middle[:, 0] + across * along[:, 1]
        z = middle[:, 1] - across * along[:, 0]
        return np.stack([side * x, side * radius * np.sin(angle), z], axis=1)

    return surface


def _handle_axes() -> cKDTree:
    middle = _curve(_HANDLE)(np.linspace(0, 1, 4001))
    side = np.stack([middle[:, 0], 0 * middle[:, 0], middle[:, 1]], axis=1)
    return cKDTree(np.concatenate([side, side * (-1, 1, 1)]))


def _inside_body(points: NDArray) -> NDArray:
    """Return which points lie inside the body or neck (their profiles rise throughout)."""
    outline = np.concatenate([_curve(p)(np.linspace(0, 1, 400)) for p in (_BODY, _COLLAR, _NECK)])
    return np.hypot(points[:, 0], points[:, 1]) < np.interp(points[:, 2], outline[:, 1], outline[:, 0])


def _step(x, low: float, high: float):
    """Return 0 below `low`, 1 above `high`, and a smooth rise between."""
    x = np.clip((x - low) / (high - low), 0, 1)
    return x * x * (3 - 2 * x)


def _mix(a, b, share: NDArray) -> NDArray:
    return np.asarray(a) * (1 - share[:, None]) + np.asarray(b) * share[:, None]


def _mottle(points: NDArray) -> NDArray:
    """Return a faint cloudiness, -0.07 to 0.07, as of uneven firing."""
    x, y, z = points.T
    return 0.035 * (np.sin(9 * x + 4 * z) * np.sin(7 * y - 5 * z) + np.sin(23 * z + 6 * x) * np.sin(17 * y + 3 * x))


def _plain(color):
    return lambda points, s, t: np.tile(color, (len(points), 1))


def _paint_body(points: NDArray, s: NDArray, t: NDArray) -> NDArray:
    height, turn = points[:, 2], -t % 1
    color = np.tile(_CLAY, (len(points), 1))
    ridge = np.abs(np.sin(np.pi * _FLUTES * turn))
    color = _mix(color, _mix(_LIGHT, _BLACK, _step(ridge, 0.15, 0.45)), (height < 0.430).astype(float))
    color = _mix(color, np.asarray(_BLACK), _meander(height, turn))
    for low, high in ((0.430, 0.450), (0.643, 0.681), (0.719, 0.737), (0.80, 0.85)):
        color = _mix(color, np.asarray(_BLACK), ((height > low) & (height < high)).astype(float))
    return _mix(color, np.asarray(_CREAM), (_bead(height, turn) < 1).astype(float))


def _paint_neck(points: NDArray, s: NDArray, t: NDArray) -> NDArray:
    """Return black tongues on clay."""
    return _mix(np.asarray(_CLAY), np.asarray(_BLACK), _step(_tongues(points[:, 2], -t % 1) / 0.004, 0.4, 0.6))


def _paint_handle(points: NDArray, s: NDArray, t: NDArray) -> NDArray:
    groove = np.cos(3 * -2 * np.pi * t + 40 * s)
    return _mix(np.asarray(_BLACK), np.asarray(_CLAY), 0.35 * _step(groove, 0.2, 1.0))
