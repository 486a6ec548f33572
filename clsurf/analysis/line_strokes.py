"""Feature lines as data, and their drawing: anti-aliased strokes over a picture, polylines as SVG."""

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..io import images
from ..io.files import replacing
from ..render.checked import checked_size
from ..render.frame import Frame
from ..surface.arrays import frozen
from ..surface.srgb import to_linear

# sRGB, 0 to 1; ridges blue and valleys red as in the paper's figure 12.
COLORS = {"contours": (0.0, 0.0, 0.0), "suggestive_contours": (0.0, 0.0, 0.0), "ridges": (0.05, 0.15, 0.60),
          "valleys": (0.65, 0.08, 0.05), "crest": (0.0, 0.0, 0.0), "parabolic": (0.0, 0.35, 0.15)}
WIDTHS = (0.7, 2.2)  # pixels of the weakest and the strongest line
INKS = (0.35, 1.0)  # opacity of both


@dataclass(frozen=True, eq=False, repr=False)
class Lines:
    """Feature lines of one picture: polylines, one after the other in flat arrays.

    Parameters
    ----------
    size : (int, int)
        Width and height of the picture in pixels.
    kinds : tuple of str
    points : (n, 2) float32
        x, y in pixels, y down, pixel centres at +0.5.
    positions : (n, 3) float64
        World positions.
    strength : (n,) float32
        0 to 1; occluding contours have 1.
    offset : (k + 1,) int64
        Line i has the vertices ``offset[i]:offset[i + 1]``.
    kind : (k,) int32
        Index into `kinds`.
    closed : (k,) bool
        Whether the last vertex is joined to the first.
    unit : float
        Curvature (1 / world unit) that the thresholds were multiples of.
    device : Device, optional
        What draws them.
    """

    size: tuple[int, int]
    kinds: tuple[str, ...]
    points: NDArray
    positions: NDArray
    strength: NDArray
    offset: NDArray
    kind: NDArray
    closed: NDArray
    unit: float = 1.0
    device: object = None

    def __post_init__(self):
        n, k = len(self.strength), len(self.kind)
        for name, shape, dtype in (("points", (n, 2), np.float32), ("positions", (n, 3), np.float64),
                                   ("strength", (n,), np.float32), ("offset", (k + 1,), np.int64),
                                   ("kind", (k,), np.int32), ("closed", (k,), np.bool_)):
            object.__setattr__(self, name, frozen(name, getattr(self, name), shape, dtype))

    def __getstate__(self):
        return self.__dict__ | {"device": None}  # a device belongs to its process

    def __len__(self):
        return len(self.kind)

    @property
    def polylines(self) -> list[NDArray]:
        """The lines' points, (m, 2) float32 each; a closed line ends with its first point again."""
        return [self.points[i] for i in self._walks()]

    def _walks(self) -> list[NDArray]:
        walks = [np.arange(a, b) for a, b in zip(self.offset[:-1], self.offset[1:], strict=True)]
        return [np.append(walk, walk[0]) if closed else walk for walk, closed in zip(walks, self.closed, strict=True)]

    @property
    def segments(self) -> NDArray:
        """Pairs (m, 2) int32 of vertices that are joined by a straight piece."""
        after = np.arange(1, len(self.points) + 1)
        last = self.offset[1:] - 1
        after[last] = np.where(self.closed, self.offset[:-1], last)
        pairs = np.stack([np.arange(len(self.points)), after], axis=1)
        return pairs[pairs[:, 0] != pairs[:, 1]].astype(np.int32)

    @property
    def lengths(self) -> NDArray:
        """(k,) float64: the lines' lengths in pixels."""
        pairs = self.segments
        d = (self.points[pairs[:, 0]] - self.points[pairs[:, 1]]).astype(np.float64)
        line = np.searchsorted(self.offset, pairs[:, 0], side="right") - 1
        return np.bincount(line, np.hypot(d[:, 0], d[:, 1]), len(self))

    def of(self, kind: str) -> "Lines":
        """Return the lines of one kind."""
        if kind not in self.kinds:
            raise InputError(f"kind: expected one of {', '.join(self.kinds)}, got {kind!r}")
        keep = self.kind == self.kinds.index(kind)
        counts = np.diff(self.offset)
        vertex = np.repeat(keep, counts)
        return replace(self, kinds=(kind,), points=self.points[vertex], positions=self.positions[vertex],
                       strength=self.strength[vertex], offset=np.concatenate([[0], np.cumsum(counts[keep])]),
                       kind=np.zeros(keep.sum(), np.int32), closed=self.closed[keep])

    def draw(self, on=None, width=WIDTHS, ink=INKS, colors=None, background=(1.0, 1.0, 1.0)) -> Frame:
        """Draw the lines as anti-aliased strokes whose width and darkness follow their strength.

        Parameters
        ----------
        on : Frame or (int, int), optional
            The picture to draw over, which needs the channel color, or a size in pixels; by default the own size. The
            lines are scaled to it.
        width : (float, float) or float
            Pixels of the weakest and the strongest strokes.
        ink : (float, float) or float
            Opacity of both, 0 to 1.
        colors : dict of str to (3,) float, or (3,) float, optional
            sRGB, 0 to 1, by kind or for all; by default black, ridges blue, valleys red.
        background : (3,) float
            sRGB, where there is no picture.

        Returns
        -------
        Frame
            ``color``, ``lines`` (h, w) float32, the strokes' ink from 0 to 1, and the other channels of `on`.

        Raises
        ------
        InputError
            A picture without color, or an option out of range.
        """
        from .line_draw import draw_lines
        picture = on if isinstance(on, Frame) else None
        if picture is not None and "color" not in picture.channels:
            raise InputError("draw: expected a frame with the channel color: add it to channels=, or give a size")
        size = picture.size if picture is not None else checked_size(self.size if on is None else on)
        width, ink = checked_range("width", width, 100.0), checked_range("ink", ink, 1.0)
        palette = np.ones((1 + len(self.kinds), 4), np.float32)
        for i, color in enumerate([background, *(checked_colors(colors, kind) for kind in self.kinds)]):
            palette[i, :3] = to_linear(color)
        color, inked = draw_lines(self, size, None if picture is None else picture.color, width, ink, palette)
        others = {} if picture is None else picture.channels
        origin = {} if picture is None else {"origin": picture.origin, "camera": picture.camera}
        return Frame({**others, "color": color, "lines": inked}, **origin)

    def save(self, path: str | PathLike, **options) -> None:
        """Write the lines: .svg as polylines, .png, .jpg or .exr as a picture on white.

        Parameters
        ----------
        path : path-like
        **options
            As for `draw`; .svg takes width, ink and colors.

        Raises
        ------
        InputError
            An unknown ending, or a place that cannot be written.
        """
        if Path(path).suffix.lower() != ".svg":
            if Path(path).suffix.lower() not in images.ENDINGS:
                raise InputError(f"{path}: unknown format {Path(path).suffix or '(no ending)'}: expected .svg, "
                                 f"{', '.join(images.ENDINGS)}")
            self.draw(**options).save(path)
            return
        text = self.svg(**options)
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def svg(self, width=WIDTHS, ink=INKS, colors=None) -> str:
        """Return an SVG document: a group per kind, a polyline per line, its width and opacity by its mean strength."""
        width, ink = checked_range("width", width, 100.0), checked_range("ink", ink, 1.0)
        w, h = self.size
        rows = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}" height="{h}" viewBox="0 0 {w} {h}">']
        walks = self._walks()
        for number, kind in enumerate(self.kinds):
            red, green, blue = (round(255 * float(c)) for c in checked_colors(colors, kind))
            rows.append(f'<g id="{kind}" fill="none" stroke="rgb({red},{green},{blue})" stroke-linecap="round" '
                        'stroke-linejoin="round">')
            for i in np.flatnonzero(self.kind == number):
                s = float(self.strength[walks[i]].mean())
                places = " ".join(f"{x:.2f},{y:.2f}" for x, y in self.points[walks[i]].tolist())
                rows.append(f'<polyline stroke-width="{width[0] + s * (width[1] - width[0]):.2f}" stroke-opacity="'
                            f'{ink[0] + s * (ink[1] - ink[0]):.2f}" points="{places}"/>')
            rows.append("</g>")
        return "\n".join([*rows, "</svg>", ""])

    def _repr_svg_(self) -> str:
        return self.svg()

    def __repr__(self):
        counts = ", ".join(f"{int((self.kind == i).sum())} {kind}" for i, kind in enumerate(self.kinds))
        return f"Lines({self.size[0]} x {self.size[1]}, {counts}, {len(self.points):,} vertices)"


def checked_range(name: str, value, most: float) -> tuple[float, float]:
    """Return (weakest, strongest) of one number or two, or raise InputError."""
    try:
        pair = np.broadcast_to(np.asarray(value, np.float64), (2,))
        good = bool(np.all((pair >= 0) & (pair <= most)))
    except (TypeError, ValueError):
        good = False
    if not good:
        raise InputError(f"{name}: expected one or two numbers from 0 to {most:g}, got {value!r}")
    return float(pair[0]), float(pair[1])


def checked_colors(colors, kind: str):
    """Return the sRGB colour (3,) of a kind, or raise InputError."""
    chosen = COLORS | (colors if isinstance(colors, dict) else {}) if colors is None or isinstance(colors, dict) \
        else {kind: colors}
    try:
        value = np.asarray(chosen[kind], np.float64)
        good = value.shape == (3,) and bool(np.all((value >= 0) & (value <= 1)))
    except (TypeError, ValueError):
        good = False
    if not good:
        raise InputError(f"colors: expected 3 numbers from 0 to 1 (sRGB) for {kind}, got {chosen[kind]!r}")
    return value
