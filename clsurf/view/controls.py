"""What the pointer and the keys do to the viewer's state."""

from dataclasses import dataclass, replace

import numpy as np

from ..errors import Error
from .shown import SHOWS
from .state import (
    DOLLY,
    TURN,
    centred,
    clip_moved,
    clipped,
    dollied,
    leveled,
    orbited,
    panned,
    picked,
    toggled_projection,
)

LEFT, RIGHT, MIDDLE = 1, 2, 3  # buttons, as rendercanvas numbers them
CLICK_PX = 4.0  # logical pixels that a click may move
DOUBLE = 0.4  # seconds between the clicks of a double click
CLIP_STEP = 0.01  # of the scene's diagonal, that a key moves the clip plane


@dataclass(frozen=True)
class Pointer:
    """The pointer, logical pixels."""

    ratio: float = 1.0  # pixels of the picture to a logical one
    button: int = 0  # that is down
    x: float = 0.0
    y: float = 0.0
    moved: float = 0.0  # since the button went down
    shift: bool = False  # when the button went down
    clicked: float = float("-inf")  # time of the last click
    where: tuple = (0.0, 0.0)  # of the last click


def pointer_event(viewer, event: dict) -> None:
    """Orbit, pan, pick and centre."""
    pointer = viewer.pointer
    x, y, kind = float(event.get("x", 0)), float(event.get("y", 0)), event["event_type"]
    if kind == "pointer_down":
        if not pointer.button:
            shift = "Shift" in event.get("modifiers", ())
            viewer.pointer = replace(pointer, button=int(event.get("button", LEFT)), x=x, y=y, moved=0.0, shift=shift)
        return
    right, down = x - pointer.x, y - pointer.y
    if kind == "pointer_move":
        # A release outside of the window is told by no event: then no button is among the pressed ones.
        if not pointer.button or not event.get("buttons", (pointer.button,)):
            viewer.pointer = replace(pointer, button=0)
            return
        viewer.pointer = replace(pointer, x=x, y=y, moved=pointer.moved + abs(right) + abs(down))
        if viewer.pointer.moved > CLICK_PX:
            drag(viewer, right, down)
        return
    viewer.pointer = replace(pointer, button=0)
    if pointer.button == LEFT and pointer.moved <= CLICK_PX and event.get("button", LEFT) == LEFT:
        click(viewer, x, y, pointer.shift)


def drag(viewer, right: float, down: float) -> None:
    """Orbit with the left button, pan with the others or with Shift; lengths in logical pixels."""
    pointer, ratio = viewer.pointer, viewer.pointer.ratio
    if viewer.state.words and not viewer.state.picks:
        viewer.state = replace(viewer.state, words="")
    if pointer.button == LEFT and not pointer.shift:
        turn = TURN / max(viewer.size[1] / ratio, 1.0)
        viewer.state = orbited(viewer.state, right * turn, down * turn)
    else:
        viewer.state = panned(viewer.state, right * ratio, down * ratio, viewer.size)


def click(viewer, x: float, y: float, shift: bool) -> None:
    """Pick a point where that is asked for; twice within DOUBLE: look at what is there."""
    pointer, now = viewer.pointer, viewer.clock()
    near = abs(x - pointer.where[0]) + abs(y - pointer.where[1]) <= 2 * CLICK_PX
    double = now - pointer.clicked < DOUBLE and near
    viewer.pointer = replace(pointer, clicked=float("-inf") if double else now, where=(x, y))
    if shift or viewer.state.measuring:
        point = viewer.pick(x * pointer.ratio, y * pointer.ratio)
        if point is None:
            viewer.state = replace(viewer.state, words="nothing there")
            return
        viewer.state = picked(viewer.state, point)
        if viewer.distance is None:
            viewer.say(f"from {_point(point)}: pick a second point")
        else:
            viewer.say(f"distance {viewer.distance:.9g}  from {_point(viewer.state.picks[0])} to {_point(point)}")
    elif double:
        point = viewer.pick(x * pointer.ratio, y * pointer.ratio)
        if point is not None:
            viewer.state = centred(viewer.state, point)


def wheel_event(viewer, event: dict) -> None:
    """Dolly; with Ctrl (or Shift) move the clip plane."""
    down = float(event.get("dy", 0.0)) or float(event.get("dx", 0.0))
    down = float(np.clip(down, -2000, 2000))
    if {"Control", "Shift"} & set(event.get("modifiers", ())) and viewer.state.clip is not None:
        viewer.state = clip_moved(viewer.state, down / 100 * CLIP_STEP * viewer.diagonal)
    else:
        viewer.state = dollied(viewer.state, DOLLY ** down)


def _point(point) -> str:
    return "(" + ", ".join(f"{v:.6g}" for v in point) + ")"


# Keys -----------------------------------------------------------------------------------------------------------------


def _next_channel(viewer, step: int = 1) -> None:
    number = (viewer.channels.index(viewer.state.channel) + step) % len(viewer.channels)
    viewer.state = replace(viewer.state, channel=viewer.channels[number], words=f"channel: {viewer.channels[number]}")


def _next_lines(viewer) -> None:
    number = (viewer.state.lines + 1) % len(viewer.lines)
    names = ", ".join(viewer.lines[number]).replace("_", " ") or "none"
    viewer.state = replace(viewer.state, lines=number, words=f"lines: {names}")


def _next_surface(viewer) -> None:
    count = len(viewer.scene.surfaces)
    if count > 1:
        only = viewer.state.only + 1 if viewer.state.only + 1 < count else -1
        words = f"surface {only + 1} of {count}" if only >= 0 else "all surfaces"
        viewer.state = replace(viewer.state, only=only, words=words)


def _next_shown(viewer) -> None:
    if not viewer.scans:
        viewer.state = replace(viewer.state, words="no scan beside the surface")
        return
    shows = SHOWS[(SHOWS.index(viewer.state.shows) + 1) % len(SHOWS)]
    viewer.state = replace(viewer.state, shows=shows, words="surface and scan" if shows == "both" else shows)
    if viewer.state.channel not in viewer.channels or viewer.state.lines >= len(viewer.lines):
        viewer.state = replace(viewer.state, channel="color", lines=0)


def _eye_dome(viewer) -> None:
    on = not viewer.eye_dome
    words = f"eye-dome lighting of points: {'on' if on else 'off'}"
    viewer.state = replace(viewer.state, eye_dome=on, words=words)


def _clip(axis: str):
    def set_plane(viewer):
        state = clipped(viewer.state, axis)
        word = "no clip plane" if state.clip is None else f"clip plane across {axis}: [ ] or Ctrl + wheel move it"
        viewer.state = replace(state, words=word)
    return set_plane


def _move_clip(steps: float):
    return lambda viewer: _set(viewer, clip_moved(viewer.state, steps * CLIP_STEP * viewer.diagonal))


def _turn(right: float, down: float):
    return lambda viewer: _set(viewer, orbited(viewer.state, right, down))


def _dolly(factor: float):
    return lambda viewer: _set(viewer, dollied(viewer.state, factor))


def _set(viewer, state) -> None:
    viewer.state = state


def _measure(viewer) -> None:
    on = not viewer.state.measuring
    words = "measuring: click two points" if on else ""
    viewer.state = replace(viewer.state, measuring=on, picks=viewer.state.picks if on else (), words=words)


def _reset(viewer) -> None:
    viewer.state = replace(viewer.state, camera=viewer.home.camera, target=viewer.home.target, words="")


def _projection(viewer) -> None:
    viewer.state = toggled_projection(viewer.state)


def _level(viewer) -> None:
    viewer.state = leveled(viewer.state)


def _help(viewer) -> None:
    viewer.state = replace(viewer.state, help=not viewer.state.help, words="")


def _escape(viewer) -> None:
    viewer.state = replace(viewer.state, help=False, measuring=False, picks=(), words="")


def _screenshot(viewer) -> None:
    try:
        viewer.say(f"picture: {viewer.screenshot().resolve()}")
    except Error as error:
        viewer.say(str(error))


def _leave(viewer) -> None:
    viewer.closed = True


KEYS = {
    "c": _next_channel, "C": lambda viewer: _next_channel(viewer, -1), "l": _next_lines, "Tab": _next_surface,
    "n": _next_surface, "t": _next_shown, "e": _eye_dome, "x": _clip("x"), "y": _clip("y"), "z": _clip("z"),
    "v": _clip("view"), "[": _move_clip(-1), "]": _move_clip(1), "m": _measure, "s": _screenshot, "r": _reset,
    "Home": _reset, "o": _projection, "u": _level, "h": _help, "?": _help, "F1": _help, "Escape": _escape,
    "q": _leave, "+": _dolly(0.9), "=": _dolly(0.9), "-": _dolly(1 / 0.9), "ArrowLeft": _turn(-5, 0),
    "ArrowRight": _turn(5, 0), "ArrowUp": _turn(0, -5), "ArrowDown": _turn(0, 5)}

# Of the help panel and of docs/viewer.md.
HELP = [
    ("drag, arrows", "orbit"), ("right or Shift drag", "pan"), ("wheel, + -", "dolly"),
    ("double click", "look at that point"), ("c, Shift c", "next channel, one back"),
    ("l", "lines: contours, suggestive contours, ..."), ("n, Tab", "surfaces one by one, or all"),
    ("t", "surface, its scan as it is, or both"), ("e", "eye-dome lighting of points, on or off"),
    ("x y z, v", "clip plane: across an axis or the view; other side; off"), ("[ ], Ctrl wheel", "move the clip plane"),
    ("m, Shift click", "distance between two points"), ("s", "screenshot"), ("r, Home", "the first view again"),
    ("u", "upright"), ("o", "orthographic or perspective"), ("Esc", "clear"), ("q", "leave"), ("h", "this help"),
]
