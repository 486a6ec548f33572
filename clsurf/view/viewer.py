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
from ..render.renderer import Renderer, checked_size
from ..render.scene import Scene, as_scene
from . import picture
from .controls import HELP, KEYS, Pointer, pointer_event, wheel_event
from .pace import FINE, FULL, Pace
from .state import ViewState, point_at


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
                 folder=".", device=None, report=None, clock=time.perf_counter, **options):
        self.scene, self.size = as_scene(scene), checked_size(size)
        self.folder, self.report, self.clock, self.options = Path(folder), report or (lambda line: None), clock, options
        up = np.asarray(up, np.float64)
        if up.shape != (3,) or not 0 < np.linalg.norm(up) < np.inf:
            raise InputError(f"up: expected three numbers, not all 0, got {up.tolist()}")
        if options.get("background") is not None and len(options["background"]) == 4 and options["background"][3] < 1:
            raise InputError("background: expected an opaque one to view, got a transparent one")
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
        self.state = self.home = ViewState(camera, target, up / np.linalg.norm(up))
        self._framed = framed
        self.channels, self.lines = picture.channels_of(self.scene), picture.lines_of(self.scene)
        self.pointer, self.pace, self.closed, self.hint = Pointer(), Pace(), False, True
        self.limits: dict = {}
        self.times: list[float] = []  # seconds of the last pictures
        self._parts: dict = {}
        self._seen = None  # the last picture's frame, its state and the canvas's size
        self._renderer: Renderer | None = Renderer(device)

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
        seen = self._seen
        if seen is None or seen[1].camera is not self.state.camera or seen[1].clip is not self.state.clip \
                or seen[1].only != self.state.only or seen[2] != self.size or seen[0].size != self.size:
            self._draw(FULL)
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
        return self.pace.due(self.clock())

    def screenshot(self, path=None) -> Path:
        """Write the fine picture, without help and words; return its path, by default a new one in `folder`."""
        from ..io.images import write_image
        path = _new_name(self.folder) if path is None else Path(path)
        write_image(path, self.still())
        return path

    def still(self) -> NDArray:
        """Return the fine picture, (h, w, 4) uint8 sRGB, without help and words."""
        return picture.written(self._draw(FINE), replace(self.state, help=False, words=""), [])

    def shown_scene(self) -> Scene:
        """Return the scene, or the one surface of it that is shown."""
        only = self.state.only
        if only < 0:
            return self.scene
        if only not in self._parts:
            self._parts[only] = replace(self.scene, surfaces=(self.scene.surfaces[only],))
        return self._parts[only]

    def _draw(self, quality) -> NDArray:
        if self._renderer is None:
            raise DeviceError("viewer: it is closed: make a new one")
        pixels, frame = picture.draw(self._renderer, self.shown_scene(), self.state, self.size, quality,
                                     self.lines[self.state.lines], self.limits, **self.options)
        self._seen = frame, self.state, self.size
        return pixels

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
