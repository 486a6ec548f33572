"""Feature lines of a picture: occluding and suggestive contours, ridges, valleys, crest and parabolic lines.

Sources: Ohtake, Belyaev, Alexa, "Sparse Low-degree Implicit Surfaces", SGP 2005, section 4; suggestive contours:
DeCarlo, Finkelstein, Rusinkiewicz, Santella, "Suggestive Contours for Conveying Shape", SIGGRAPH 2003; ridges, valleys
and crest lines: Ohtake, Belyaev, Seidel, "Ridge-Valley Lines on Meshes via Implicit Surface Fitting", SIGGRAPH 2004.
"""


from dataclasses import dataclass

import numpy as np

from ..device import open_device
from ..errors import InputError
from ..render.frame import Frame
from .line_chains import Chains, cell_segments, chains, relaxed
from .line_planes import Crossings, Field, LinePlanes
from .line_strokes import Lines

# Thresholds in units of the median |H| (squared for suggestive contours), found on bunny, dragon, Max Planck and lion.
FIELDS = {
    "suggestive_contours": (Field("radial", "radial_derivative", sines=True, power=2, least=0.6, peak=4.0, full=16.0),),
    "ridges": (Field("derivative1", "k1", axis="direction1", least=1.7, peak=4.0, full=10.0),),
    "valleys": (Field("derivative2", "k2", sign=-1, axis="direction2", extremum=-1, least=1.7, peak=4.0, full=10.0),),
    "crest": (Field("derivative1", "k1", axis="direction1", other="k2", least=1.7, peak=4.0, full=10.0),
              Field("derivative2", "k2", sign=-1, axis="direction2", extremum=-1, other="k1", least=1.7, peak=4.0,
                    full=10.0)),
    "parabolic": (Field("gaussian", "mean", sign=0, least=0.15, peak=0.5, full=2.0),),
}
KINDS = ("contours", *FIELDS)
GAP_STEEPNESS = 6.0  # pixel footprints of depth per pixel that a gap may bridge
RING = 3.0  # closed lines must be this many times longer: bumps of noise are ringed
CONTOUR_LENGTH = 12.0  # pixels; shorter ones are holes and fragments
CONTOUR_ROUNDS, ROUNDS = 6, 2  # of smoothing along the lines
MEDIAN_STEP = 4  # every 4th pixel each way gives the median of |H|
HIDDEN_FOOTPRINTS = 16.0  # a line so far behind the silhouette's surface is hidden


@dataclass(frozen=True)
class Limits:
    """The options of `lines` that are numbers, checked."""

    smoothing: float  # pixels
    detail: float
    length: float  # pixels
    gap: float  # pixels
    unit: float  # 1 / world unit

    def __post_init__(self):
        for name, low, high in (("smoothing", 0, 2.6), ("detail", 1e-3, 1e3), ("length", 0, 1e6), ("gap", 0, 1e3),
                                ("unit", 1e-30, 1e30)):
            value = getattr(self, name)
            if not isinstance(value, int | float | np.number) or not low <= value <= high:
                raise InputError(f"{name}: expected a number from {low:g} to {high:g}, got {value!r}")

    def unit_of(self, field: Field) -> float:
        """Return the unit of a field's strengths."""
        return self.unit**field.power / self.detail


def line_channels(kinds) -> tuple[str, ...]:
    """Return the channels that `lines` needs of a frame, for `render(..., channels=...)`.

    Parameters
    ----------
    kinds : str or sequence of str
        Kinds of lines; see `lines`.

    Returns
    -------
    tuple of str
        Such as ("depth", "normal") for "contours".

    Raises
    ------
    InputError
        An unknown kind.
    """
    names = [name for kind in checked_kinds(kinds) for field in FIELDS.get(kind, ()) for name in field.channels]
    return tuple(dict.fromkeys(("depth", "normal", *names)))


def lines(frame: Frame, kinds="suggestive_contours", *, silhouette: Frame | None = None, smoothing: float = 1.3,
          detail: float = 1.0, length: float | None = None, gap: float | None = None, unit: float | None = None,
          device=None) -> Lines:
    """Find feature lines in a picture, as polylines with sub-pixel vertices.

    Parameters
    ----------
    frame : Frame
        With the channels `line_channels(kinds)`, from a surface of degree 3 for the kinds that need third derivatives:
        all but "contours" and "parabolic". A coarse surface gives the cleaner lines: `line_surface` makes it.
    kinds : str or sequence of str
        "contours" (occluding: where the surface seen ends), "suggestive_contours" (where the radial curvature changes
        its sign), "ridges" (maxima of k1 along its direction), "valleys" (minima of k2), "crest" (those of both where
        the other curvature is smaller in size), "parabolic" (where the Gaussian curvature changes its sign).
    silhouette : Frame, optional
        A picture of a finer surface, same camera and size, with depth and normal: occluding contours come from it, and
        the other lines end where it shows no surface or one in front of them.
    smoothing : float
        Standard deviation in pixels, 0 to 2.6, of the Gaussian that smooths the fields; it stops at depth jumps.
    detail : float
        Larger than 1 shows weaker lines, smaller fewer: thresholds are divided by it.
    length : float, optional
        Pixels; shorter lines are dropped, and so are weak ones unless accordingly longer; by default 1.5 % of the
        picture's longer side. Occluding contours: at most 12.
    gap : float, optional
        Pixels; shorter gaps in a line are closed; by default 0.6 % of the longer side, at least 3.
    unit : float, optional
        Curvature (1 / world unit) that all thresholds are multiples of; by default the median size of the mean
        curvature over the picture. Give the `unit` of the first frame's lines to the other frames of an animation.
    device : None, str or Device

    Returns
    -------
    Lines

    Raises
    ------
    InputError
        An unknown kind, a frame without a camera or without a channel that is needed, an option out of range.
    """
    kinds = checked_kinds(kinds)
    check_frame("frame", frame, line_channels(kinds))
    if unit is None:
        unit = median_curvature(frame) if "mean" in frame.channels else 1.0
    limits = Limits(smoothing, detail, 0.015 * max(frame.size) if length is None else length,
                    max(0.006 * max(frame.size), 3.0) if gap is None else gap, unit)
    if silhouette is not None:
        check_frame("silhouette", silhouette, ("depth", "normal"))
        if silhouette.size != frame.size:
            raise InputError(f"silhouette: expected the frame's size {frame.size}, got {silhouette.size}")
    device = open_device(device)
    # Contours, None, last: the silhouette's planes take the place of the frame's.
    searches = [(number, field) for number, kind in enumerate(kinds) for field in FIELDS.get(kind, ())]
    searches += [(kinds.index("contours"), None)] if "contours" in kinds else []
    planes, parts = LinePlanes(device, frame), []

    def begin(field: Field | None):
        if field is not None:
            return planes.field_crossings(field, limits.smoothing, field.least * limits.unit_of(field))
        return (planes if silhouette is None else LinePlanes(device, silhouette)).contour_crossings()

    crossings = begin(searches[0][1])
    for i, (number, field) in enumerate(searches):
        found = crossings()
        if i + 1 < len(searches):  # the device searches while the host joins what it has found
            crossings = begin(searches[i + 1][1])
        parts.append((number, _contours(found, silhouette or frame, limits) if field is None else
                      _field_lines(found, field, frame, silhouette, limits)))
    return _joined(frame, kinds, sorted(parts, key=lambda part: part[0]), unit, device)


def _field_lines(found: Crossings, field: Field, frame: Frame, silhouette, limits: Limits) -> Chains:
    """Return the lines of one field, their strengths from 0 to 1."""
    if silhouette is not None:
        found = found.chosen(_shown(silhouette, found.points))
    pairs = cell_segments(found, contours=False)
    found.points[:, 3] = np.sqrt(np.clip(found.points[:, 3] / (field.full * limits.unit_of(field)), 0, 1))
    joined = chains(found.points, pairs, np.sqrt(field.peak / field.full), limits.length, limits.gap,
                    GAP_STEEPNESS * footprint(frame), RING)
    return Chains(relaxed(joined, ROUNDS), joined.offset, joined.closed)


def _contours(found: Crossings, frame: Frame, limits: Limits) -> Chains:
    """Return the occluding contours of `frame`."""
    pairs = cell_segments(found, contours=True)
    found.points[:, 3] = 1
    joined = chains(found.points, pairs, 0.0, min(limits.length, CONTOUR_LENGTH), limits.gap,
                    GAP_STEEPNESS * footprint(frame))
    return Chains(relaxed(joined, CONTOUR_ROUNDS), joined.offset, joined.closed)


def footprint(frame: Frame) -> float:
    """Return the median size of a pixel on the surface, world units across the ray; 1 where there is no surface."""
    p = frame.camera.projection(frame.size)
    depth = frame.depth[MEDIAN_STEP // 2::MEDIAN_STEP, MEDIAN_STEP // 2::MEDIAN_STEP]
    depth = depth[np.isfinite(depth)]
    return (float(np.median(np.abs(depth))) if p.perspective and len(depth) else 1.0) / p.fx


def _shown(silhouette: Frame, points):
    """Which points (n, 4) lie on what `silhouette` shows."""
    x, y = (points[:, i].astype(np.int64).clip(0, silhouette.size[i] - 1) for i in (0, 1))
    depth, p = silhouette.depth[y, x], silhouette.camera.projection(silhouette.size)
    footprint = (np.abs(depth) if p.perspective else 1.0) / p.fx
    with np.errstate(invalid="ignore"):
        return points[:, 2] - depth <= HIDDEN_FOOTPRINTS * footprint


def _joined(frame, kinds, parts, unit, device) -> Lines:
    """Return all lines of all kinds in one result."""
    points = np.concatenate([np.empty((0, 4), np.float32), *(part.points for _, part in parts)])
    counts = np.concatenate([np.empty(0, np.int64), *(np.diff(part.offset) for _, part in parts)])
    numbers = [np.full(len(part.closed), number, np.int32) for number, part in parts]
    return Lines(
        size=frame.size, kinds=kinds, points=points[:, :2], positions=world_positions(frame, points),
        strength=points[:, 3], offset=np.concatenate([[0], np.cumsum(counts)]),
        kind=np.concatenate([np.empty(0, np.int32), *numbers]),
        closed=np.concatenate([np.empty(0, bool), *(part.closed for _, part in parts)]), unit=unit, device=device)


def world_positions(frame: Frame, points) -> np.ndarray:
    """Return world positions (n, 3) float64 of points (n, 3 or more): x, y (pixels) and depth."""
    camera, p = frame.camera, frame.camera.projection(frame.size)
    x, y, depth = (points[:, i].astype(np.float64) for i in range(3))
    view = np.stack([(x - p.cx) / p.fx, (p.cy - y) / p.fy, -np.ones_like(x)], axis=1)
    view = view * depth[:, None] if p.perspective else np.stack([view[:, 0], view[:, 1], -depth], axis=1)
    return camera.eye + view @ camera.rotation


def median_curvature(frame: Frame) -> float:
    """Return the median of |H| over the picture (1 / world unit), the unit of strengths; 1 without a surface."""
    mean = np.abs(frame.mean[MEDIAN_STEP // 2::MEDIAN_STEP, MEDIAN_STEP // 2::MEDIAN_STEP])
    mean = mean[np.isfinite(mean)]
    if len(mean) == 0:
        mean = np.abs(frame.mean[np.isfinite(frame.mean)])
    value = float(np.median(mean)) if len(mean) else 1.0
    return max(value, 1e-30)


def checked_kinds(kinds) -> tuple[str, ...]:
    """Return the kinds of lines as a tuple, or raise InputError."""
    if not isinstance(kinds, str | list | tuple):
        raise InputError(f"kinds: expected some of {', '.join(KINDS)}, got {kinds!r}")
    kinds = (kinds,) if isinstance(kinds, str) else tuple(dict.fromkeys(map(str, kinds)))
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not kinds:
        raise InputError(f"kinds: expected some of {', '.join(KINDS)}, got {', '.join(kinds) or 'none'}")
    return kinds


def check_frame(name: str, frame, channels) -> None:
    """Raise InputError unless `frame` is one that `clsurf.render` made with these channels."""
    if not isinstance(frame, Frame) or frame.camera is None:
        raise InputError(f"{name}: expected a clsurf.Frame with its camera, as clsurf.render gives it, got {frame!r}")
    missing = [channel for channel in channels if channel not in frame.channels]
    if missing:
        raise InputError(f"{name}: expected the channels {', '.join(channels)}, got none of the name "
                         f"{', '.join(missing)}: ask for them with render(..., channels=clsurf.line_channels(kinds))")
