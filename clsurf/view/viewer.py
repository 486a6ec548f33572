"""The viewer: a scene, what is shown of it, and what the user does.

It knows no window: canvases feed it events and show the pictures it draws.
"""

import contextlib
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DeviceError, InputError
from ..render.camera import Camera
from ..render.checked import checked_size
from ..render.point_drawing import PointDrawing
from ..render.points import is_unlit
from ..render.renderer import Renderer
from ..render.scene import Scene, as_scene
from ..render.shade import Shading
from . import picture
from .controls import HELP, KEYS, Pointer, pointer_event, wheel_event
from .pace import FINE, FULL, Pace
from .shown import checked_scans, checked_shows, scene_of
from .state import ViewState, point_at

SEEN = ("camera", "clip", "only", "shows", "eye_dome")  # of a state: where one differs, the picture is another
WAIT = 0.05  # seconds after which a picture is drawn again that lacks parts of a stored surface
LONGEST_WAIT = 60.0  # seconds that a still picture waits for them


class Viewer:
    """A scene to look at, at any size, by events.

    Parameters
    ----------
    scene : Scene, surface, placed surface, or list of those
    camera : Camera, optional
        By default one that frames the scene.
    size : (int, int)
        Of the picture, pixels.
    up : (3,)
        What an orbit keeps upright, world space.
    folder : path-like
        Where screenshots go.
    device : optional
        See `clsurf.open_device`.
    report : callable, optional
        Called with each line that is worth telling: distances, screenshots.
    clock : callable
        Seconds.
    scans : Mesh, PointCloud, RangeScan, placed, or list of those or None, optional
        What each of the surfaces was made from: a key shows the scan instead of it, or both.
    shows : str
        What is shown at first: "surface", "scan" or "both".
    budget : int or str
        Bytes that each `StoredSurface` may take in memory, such as "2GB".
    options
        Of `Renderer.render`, such as shading and background.

    Attributes
    ----------
    state : ViewState
        What is shown; `camera`, `picks` and `distance` are its own.
    size : (int, int)
        Of the canvas, pixels.
    closed : bool
        Whether the user has asked to leave.
    """

    def __init__(self, scene, camera: Camera | None = None, size: tuple[int, int] = (1024, 768), up=(0, 1, 0),
                 folder=".", device=None, report=None, clock=time.perf_counter, scans=None, shows="surface",
                 budget: int | str = "2GB", **options):
        self.scene, self.size = as_scene(scene), checked_size(size)
        self.scans = checked_scans(scans, len(self.scene.surfaces))
        self.folder, self.report, self.clock, self.options = Path(folder), report or (lambda line: None), clock, options
        up = np.asarray(up, np.float64)
        if up.shape != (3,) or not 0 < np.linalg.norm(up) < np.inf:
            raise InputError(f"up: expected three numbers, not all 0, got {up.tolist()}")
        box = np.asarray(self.scene.bounds)
        box = box if np.isfinite(box).all() else np.array([[-1.0] * 3, [1.0] * 3])
        self.box = box
        framed = camera is None  # then it goes with the size until the user moves it
        if camera is None:
            camera = self._framing(up)
        if not isinstance(camera, Camera):
            raise InputError(f"camera: expected a clsurf.Camera, got {camera!r}")
        # What the camera looks at: where its axis passes the middle of the scene.
        middle = box.mean(axis=0)
        depth = float(-camera.rotation[2] @ (middle - camera.eye))
        target = camera.eye - camera.rotation[2] * (depth if depth > 0 else float(np.linalg.norm(box[1] - box[0])))
        self.state = self.home = ViewState(camera, target, up / np.linalg.norm(up),
                                           shows=checked_shows(shows, self.scans))
        self._framed = framed
        self.pointer, self.pace, self.closed, self.hint = Pointer(), Pace(), False, True
        self.limits: dict = {}
        self.times: list[float] = []  # seconds of the last pictures
        self._parts: dict = {}
        self._seen = None  # the last picture's frame, its state and the canvas's size
        self._complete = True  # whether the last picture lacks no part of a stored surface
        self._renderer: Renderer | None = Renderer(device, budget=budget)

    @property
    def camera(self) -> Camera:
        """Where the scene is seen from now."""
        return self.state.camera

    @property
    def distance(self) -> float | None:
        """Between the two picked points, world units; None with fewer."""
        return self.state.distance

    @property
    def diagonal(self) -> float:
        """Of the scene, world units."""
        return float(np.linalg.norm(self.box[1] - self.box[0])) or 1.0

    @property
    def eye_dome(self) -> bool:
        """Whether points are shown with eye-dome lighting: as a key, the options or the points' own kind have it."""
        points = self._drawing().get("points") or PointDrawing()
        return any(is_unlit(own, points, Shading()) for own, _ in self.shown_scene().placed) \
            if points.eye_dome is None else points.eye_dome

    @property
    def channels(self) -> tuple[str, ...]:
        """What pictures of what is shown can be coloured by."""
        return self._part()[1]

    @property
    def lines(self) -> tuple[tuple[str, ...], ...]:
        """The choices of lines that can be found on what is shown."""
        return self._part()[2]

    # Events -----------------------------------------------------------------------------------------------------------

    def handle(self, event: dict) -> bool:
        """Take an event as rendercanvas gives it; return whether a new picture is wanted.

        Positions are in logical pixels from the top left; see `resize` for how many there are.
        """
        kind, before = event.get("event_type"), self.state
        if kind == "resize":
            return self._resize(event)
        if kind == "close":
            self.closed = True
        elif kind in ("pointer_down", "pointer_move", "pointer_up"):
            pointer_event(self, event)
        elif kind == "wheel":
            wheel_event(self, event)
        elif kind == "key_down":
            key = str(event.get("key", ""))
            if self.hint:
                self.hint, before = False, None
            action = KEYS.get(key) or KEYS.get(key.lower())
            if action is not None and not {"Control", "Alt", "Meta"} & set(event.get("modifiers", ())):
                action(self)
        return self._changed(before)

    def _resize(self, event: dict) -> bool:
        ratio = float(event.get("pixel_ratio", 1.0)) or 1.0
        width, height = (max(1, round(float(event[name]) * ratio)) for name in ("width", "height"))
        self.size = checked_size((min(width, 8192), min(height, 8192)))
        if self._framed:
            first = self._framing()
            if self.state.camera is self.home.camera:
                self.state = replace(self.state, camera=first)
            self.home = replace(self.home, camera=first)
        self.pointer = replace(self.pointer, ratio=ratio)
        self.pace = self.pace.stale()
        return True

    def _changed(self, before: ViewState | None) -> bool:
        if before is self.state:
            return False
        moves = before is not None and (before.camera is not self.state.camera or before.clip is not self.state.clip)
        self.pace = self.pace.touched(self.clock()) if moves else self.pace.stale()
        return True

    def say(self, words: str) -> None:
        """Show words at the picture's bottom, and report them."""
        self.state = replace(self.state, words=words)
        self.report(words)

    def pick(self, x: float, y: float) -> NDArray | None:
        """Return the world position (3,) float64 seen at pixel (x, y) of the canvas; None where there is nothing."""
        seen, state = self._seen, self.state
        if seen is None or any(getattr(seen[1], name) is not getattr(state, name) for name in SEEN) \
                or seen[2] != self.size or seen[0].size != self.size or not self._complete:
            self._whole(FULL)
            seen = self._seen
        column, row = int(x), int(y)
        if not (0 <= column < self.size[0] and 0 <= row < self.size[1]):
            return None
        depth = float(seen[0].depth[row, column])
        return point_at(self.state.camera, self.size, column + 0.5, row + 0.5, depth) if np.isfinite(depth) else None

    def _framing(self, up=None) -> Camera:
        up = self.state.up if up is None else up
        thing = self.scene if np.isfinite(self.scene.bounds).all() else self.box
        return Camera.framing(thing, _toward(up), up=up, aspect=self.size[0] / self.size[1])

    # Pictures ---------------------------------------------------------------------------------------------------------

    def draw(self) -> NDArray:
        """Return the picture to show now, (h, w, 4) uint8 sRGB, opaque; while something moves smaller than `size`."""
        start = self.clock()
        quality = self.pace.quality(start)
        pixels = self._draw(quality)
        pixels = self._written(pixels, quality.reduce)
        now = self.clock()
        self.times = [*self.times[-99:], now - start]
        self.pace = self.pace.drawn(quality, now - start, start)
        return pixels

    def prepare(self) -> None:
        """Draw once in every quality, so that kernels are compiled before someone waits for a picture."""
        for quality in (FULL, FINE):
            self._draw(quality)

    def due(self) -> float | None:
        """Return in how many seconds the picture should be drawn again to refine it; None: it is as fine as it gets."""
        due = self.pace.due(self.clock())
        return WAIT if due is None and not self._complete else due

    def screenshot(self, path=None) -> Path:
        """Write the fine picture, without help and words; return its path, by default a new one in `folder`."""
        from ..io.images import write_image
        path = _new_name(self.folder) if path is None else Path(path)
        write_image(path, self.still())
        return path

    def still(self) -> NDArray:
        """Return the fine picture, (h, w, 4) uint8 sRGB, without help and words."""
        return picture.written(self._whole(FINE), replace(self.state, help=False, words=""), [])

    def shown_scene(self) -> Scene:
        """Return the scene of what is shown: all or one of the surfaces, their scans, or both."""
        return self._part()[0]

    def _part(self) -> tuple[Scene, tuple, tuple]:
        """Return the shown scene, its channels and its lines; the same objects while the same is shown."""
        key = self.state.shows, self.state.only
        if key not in self._parts:
            scene = scene_of(self.scene, self.scans, *key)
            self._parts[key] = scene, picture.channels_of(scene), picture.lines_of(scene)
        return self._parts[key]

    def _draw(self, quality) -> NDArray:
        if self._renderer is None:
            raise DeviceError("viewer: it is closed: make a new one")
        pixels, frame = picture.draw(self._renderer, self.shown_scene(), self.state, self.size, quality,
                                     self.lines[self.state.lines], self.limits, **self._drawing())
        self._complete = self._renderer.complete
        self._seen = frame, self.state, self.size
        return pixels

    def _whole(self, quality) -> NDArray:
        """Draw with all that the view needs of stored surfaces."""
        end = time.monotonic() + LONGEST_WAIT
        pixels = self._draw(quality)
        while not self._complete and time.monotonic() < end:
            time.sleep(WAIT)
            pixels = self._draw(quality)
        return pixels

    def _drawing(self) -> dict:
        """Return the options of `Renderer.render`, with the eye-dome lighting that a key has set."""
        if self.state.eye_dome is None:
            return self.options
        points = self.options.get("points") or PointDrawing()
        return self.options | {"points": replace(points, eye_dome=self.state.eye_dome)}

    def _written(self, pixels: NDArray, reduce: int) -> NDArray:
        state, hint = self.state, "h: help" if self.hint else ""
        if reduce > 1 and (state.help or state.picks):
            # Letters are to stay readable: the picture gets its full size first.
            pixels = pixels.repeat(reduce, axis=0).repeat(reduce, axis=1)[:self.size[1], :self.size[0]]
        elif reduce > 1:
            state, hint = replace(state, words=""), ""
        return picture.written(pixels, state, HELP, hint)

    def close(self) -> None:
        """Give the device memory back. May be called twice."""
        self.closed = True
        if self._renderer is not None:
            with contextlib.suppress(DeviceError):
                self._renderer.close()
            self._renderer = None

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def __repr__(self):
        return f"Viewer({self.scene}, {self.size[0]} x {self.size[1]}{', closed' * self.closed})"


def _toward(up) -> NDArray:
    """Return the default direction from the target to the eye: from the front, a little from the right and above."""
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    side = np.eye(3)[np.argmin(np.abs(up))]
    side = side - (side @ up) * up
    side /= np.linalg.norm(side)
    return side + 0.5 * up + 2 * np.cross(side, up)


def _new_name(folder: Path) -> Path:
    number = 0
    while (folder / f"clsurf-{number:03d}.png").exists():
        number += 1
    return folder / f"clsurf-{number:03d}.png"
