"""What the viewer shows, as plain data, and the functions that move the camera."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..render.camera import Camera, _looking

CLOSEST_TO_POLE = 0.5  # degrees between the direction of view and up that an orbit keeps
TURN = 180.0  # degrees that a drag across the picture's height turns
DOLLY = 1.0015  # factor of the distance per unit of a wheel, of which a notch has about 100


@dataclass(frozen=True, eq=False)
class ClipPlane:
    """A plane in front of which nothing is drawn."""

    axis: str  # "x", "y", "z", or "view" for a plane that faced the eye when it was set
    normal: NDArray  # (3,) float64, unit, world: towards what is kept
    offset: float  # what is kept has normal . position >= offset

    @property
    def equation(self) -> NDArray:
        """(4,) float64 as `Renderer.render` takes it."""
        return np.array([*self.normal, -self.offset])


@dataclass(frozen=True, eq=False)
class ViewState:
    """Everything that decides what a still picture shows, but its size."""

    camera: Camera
    target: NDArray  # (3,) float64, world: what orbits and dollies are about
    up: NDArray  # (3,) float64, unit, world
    channel: str = "color"
    lines: int = 0  # index into the viewer's choices of lines
    only: int = -1  # the one surface that is shown, -1: all
    shows: str = "surface"  # "surface", "scan" or "both"
    eye_dome: bool | None = None  # of points; None: as the options of the pictures say
    clip: ClipPlane | None = None
    picks: tuple = ()  # up to two world positions (3,) float64
    measuring: bool = False  # whether a click picks a point
    help: bool = False
    words: str = ""  # said at the bottom of the picture

    @property
    def distance(self) -> float | None:
        """Between the two picked points, world units; None with fewer."""
        return float(np.linalg.norm(self.picks[1] - self.picks[0])) if len(self.picks) == 2 else None


def orbited(state: ViewState, right: float, down: float) -> ViewState:
    """Return the state with the camera turned about the target, by degrees; the pole is not crossed."""
    camera = state.camera.orbited(state.target, -right, state.up)
    angle = np.degrees(np.arccos(np.clip(camera.rotation[2] @ state.up, -1, 1)))  # of the way to the eye, from up
    new = np.clip(angle - down, min(angle, CLOSEST_TO_POLE), max(angle, 180 - CLOSEST_TO_POLE))
    if abs(new - angle) > 1e-9:
        camera = camera.orbited(state.target, new - angle, _level_axis(camera, state.up))
    return replace(state, camera=camera)


def _level_axis(camera: Camera, up: NDArray) -> NDArray:
    """Return the axis that turns the camera away from `up`: level, also where the camera is tilted."""
    axis = np.cross(up, camera.rotation[2])
    length = np.linalg.norm(axis)
    return axis / length if length > 1e-9 else camera.rotation[0]


def panned(state: ViewState, right: float, down: float, size: tuple[int, int]) -> ViewState:
    """Return the state moved so that the target follows the pointer, by pixels of a picture of `size`."""
    p = state.camera.projection(size)
    depth = max(_depth(state), 1e-12) if p.perspective else 1.0
    move = (-right * depth / p.fx) * state.camera.rotation[0] + (down * depth / p.fy) * state.camera.rotation[1]
    return replace(state, camera=replace(state.camera, eye=state.camera.eye + move), target=state.target + move)


def dollied(state: ViewState, factor: float) -> ViewState:
    """Return the state at `factor` times the distance from the target (orthographic: showing so much more)."""
    camera = state.camera
    if camera.height is not None:
        return replace(state, camera=replace(camera, height=camera.height * factor))
    if not 1e-12 < _depth(state) * factor < 1e30:
        return state
    return replace(state, camera=replace(camera, eye=state.target + (camera.eye - state.target) * factor))


def centred(state: ViewState, point: NDArray) -> ViewState:
    """Return the state that looks at `point`, from the same side and distance, and turns about it."""
    move = point - state.target
    eye = state.camera.eye + move
    if state.camera.height is None:  # where the target was off the axis, the point comes onto it
        depth = -(state.camera.rotation[2] @ (state.target - state.camera.eye))
        eye = point + max(depth, 1e-12) * state.camera.rotation[2]
    return replace(state, camera=replace(state.camera, eye=eye), target=np.asarray(point, np.float64))


def leveled(state: ViewState) -> ViewState:
    """Return the state with the camera upright."""
    rotation = _looking(-state.camera.rotation[2], state.up)
    depth = _depth(state)
    return replace(state, camera=replace(state.camera, eye=state.target + depth * rotation[2], rotation=rotation))


def toggled_projection(state: ViewState) -> ViewState:
    """Return the state seen orthographically, or in perspective again; the target keeps its size."""
    camera, depth = state.camera, max(_depth(state), 1e-12)
    if camera.height is not None:
        fov = 40.0
        far = camera.height / (2 * np.tan(np.radians(fov) / 2))
        return replace(state, camera=Camera(state.target + far * camera.rotation[2], camera.rotation, fov=fov))
    p = camera.projection((1000, 1000))
    height = camera.intrinsics_size[1] / camera.intrinsics[1, 1] if camera.intrinsics is not None else 1000 / p.fy
    return replace(state, camera=Camera(camera.eye, camera.rotation, height=height * depth,
                                        near=float(np.finfo(np.float32).min)))


def clipped(state: ViewState, axis: str) -> ViewState:
    """Return the state with a clip plane across `axis` ("x", "y", "z", "view") through the target.

    The same axis again keeps the other side, and a third time removes the plane.
    """
    plane = state.clip
    if plane is not None and plane.axis == axis:
        if axis != "view" and plane.normal[("x", "y", "z").index(axis)] < 0:
            return replace(state, clip=ClipPlane(axis, -plane.normal, -plane.offset))
        return replace(state, clip=None)
    normal = -state.camera.rotation[2] if axis == "view" else -np.eye(3)[("x", "y", "z").index(axis)]
    return replace(state, clip=ClipPlane(axis, normal, float(normal @ state.target)))


def clip_moved(state: ViewState, distance: float) -> ViewState:
    """Return the state with its clip plane further in, by world units."""
    if state.clip is None:
        return state
    return replace(state, clip=replace(state.clip, offset=state.clip.offset + distance))


def picked(state: ViewState, point: NDArray) -> ViewState:
    """Return the state with one more picked point; a third one starts again."""
    return replace(state, picks=((*state.picks, point) if len(state.picks) < 2 else (point,)))


def pixel_of(camera: Camera, size: tuple[int, int], point: NDArray) -> tuple[float, float] | None:
    """Return where a world position falls in a picture, x, y in pixels; None behind the eye."""
    p = camera.projection(size)
    x, y, z = camera.rotation @ (np.asarray(point, np.float64) - camera.eye)
    if not p.perspective:
        return p.cx + p.fx * x, p.cy - p.fy * y
    return (p.cx - p.fx * x / z, p.cy + p.fy * y / z) if z < 0 else None


def point_at(camera: Camera, size: tuple[int, int], x: float, y: float, depth: float) -> NDArray:
    """Return the world position (3,) float64 seen at pixel (x, y) at `depth`."""
    p = camera.projection(size)
    scale = depth if p.perspective else 1.0
    view = np.array([(x - p.cx) / p.fx * scale, (p.cy - y) / p.fy * scale, -depth])
    return camera.eye + view @ camera.rotation


def _depth(state: ViewState) -> float:
    """Return the target's distance along the axis of view."""
    return float(state.camera.rotation[2] @ (state.camera.eye - state.target))
