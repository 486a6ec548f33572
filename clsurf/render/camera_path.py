"""Cameras that move: paths along key cameras, turntables, and the frames along them; cameras of files."""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from ..errors import InputError
from ..io.cameras import CameraFile, CameraRecord, read_cameras, write_cameras
from ..surface.arrays import lengths_of
from .camera import Camera, _extent, _fitting_distance, _looking

_FLIP = np.diag([1.0, -1.0, -1.0])  # view space to computer vision's camera axes, and back


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A smooth way along key cameras of one kind (all with fov, all orthographic, or all with intrinsics).

    Eyes and rotations follow cubic splines through the keys: positions, directions and their speeds are continuous, and
    so are their accelerations. Fields of view, heights and intrinsics pass from key to key without overshooting.

    Parameters
    ----------
    cameras : list of Camera
        At least one.
    times : (n,) float, optional
        When the path is at each key, growing; by default 0, 1, 2, ...
    closed : bool
        Whether the path returns from the last key to the first, as long as the mean gap between keys.

    Raises
    ------
    InputError
        No cameras, cameras of several kinds, or times that do not grow.
    """

    cameras: tuple[Camera, ...]
    times: NDArray | None = None
    closed: bool = False

    def __post_init__(self):
        cameras = tuple(self.cameras)
        if not cameras or not all(isinstance(camera, Camera) for camera in cameras):
            raise InputError("camera path: expected a list of at least one clsurf.Camera")
        if len({(c.fov is None, c.height is None) for c in cameras}) != 1:
            raise InputError("camera path: expected cameras of one kind, all with fov, orthographic or with intrinsics")
        times = np.arange(len(cameras), dtype=np.float64) if self.times is None else np.array(self.times, np.float64)
        if times.shape != (len(cameras),) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError(f"camera path: expected {len(cameras)} times that grow, got {self.times}")
        object.__setattr__(self, "cameras", cameras)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "_splines", _splines(cameras, *_wrapped(times, self.closed)))

    @classmethod
    def load(cls, path, distortion: str = "refuse") -> "CameraPath":
        """Read the cameras of a file, and their times where it has them, as a path; see `load_cameras`."""
        file = read_cameras(path, distortion)
        times = [record.time for record in file.records]
        return cls(tuple(_of_record(record, path) for record in file.records), None if None in times else times,
                   file.closed)

    def __len__(self):
        return len(self.cameras)

    @property
    def duration(self) -> float:
        """From the first key's time to the last's, or, where closed, back to the first's."""
        return float(_wrapped(self.times, self.closed)[2])

    def at(self, time: float) -> Camera:
        """Return the camera at `time`; before the first key and after the last it stands still, unless closed."""
        first = self.times[0]
        time = first + (float(time) - first) % self.duration if self.closed and self.duration else float(time)
        key = np.flatnonzero(self.times == time)
        if len(self) == 1 or len(key):
            return self.cameras[key[0] if len(key) else 0]
        time = float(np.clip(time, first, first + self.duration))
        eyes, turns, lenses = self._splines
        rotation = turns(time).as_matrix()
        return _camera_of(eyes(time), rotation, lenses(time), self.cameras[0])

    def frames(self, count: int) -> list[Camera]:
        """Return `count` cameras at even times: from the first key to the last, or around without the first again."""
        if not isinstance(count, int | np.integer) or count < 1:
            raise InputError(f"frames: expected at least 1, got {count!r}")
        share = np.arange(count) / (count if self.closed else max(count - 1, 1))
        return [self.at(self.times[0] + t * self.duration) for t in share]

    def __repr__(self):
        return f"CameraPath({len(self)} cameras, {self.duration:g} long{', closed' * self.closed})"


# Keys that a closed path repeats on either side: a key's influence falls to a quarter from key to key, so beyond 12
# less than 1e-7 is left.
_REPEATED = 12


def _wrapped(times: NDArray, closed: bool):
    """Return the numbers of the keys, their times and the path's duration; a closed path's keys go on both ways."""
    n = len(times)
    if not closed or n == 1:
        return np.arange(n), times, times[-1] - times[0]
    period = times[-1] - times[0] + (times[-1] - times[0]) / (n - 1)
    keys = np.arange(-_REPEATED, n + _REPEATED + 1)
    return keys % n, times[keys % n] + (keys // n) * period, period


def _splines(cameras, keys, times, _):
    from scipy.interpolate import CubicSpline, PchipInterpolator  # a third of a second of every start
    from scipy.spatial.transform import Rotation, RotationSpline
    if len(cameras) == 1:
        return None
    eyes = np.array([cameras[k].eye for k in keys])
    turns = Rotation.from_matrix([cameras[k].rotation for k in keys])
    first = cameras[0]
    lenses = np.array([_lens(cameras[k], first) for k in keys])
    lenses[:, 1:] -= lenses[0, 1:]
    shift = np.array([0, *_lens(first, first)[1:]])
    middle = eyes.mean(axis=0)  # far-away coordinates keep their digits
    around = CubicSpline(times, eyes - middle, bc_type="natural" if len(times) > 2 else "not-a-knot")
    smooth = PchipInterpolator(times, lenses)
    return (lambda t: middle + around(t)), RotationSpline(times, turns), lambda t: smooth(t) + shift


def _lens(camera: Camera, first: Camera) -> list[float]:
    """Return near and what else is interpolated: log of fov or height, or the four intrinsics in the first's size."""
    if camera.fov is not None:
        return [camera.near, np.log(camera.fov)]
    if camera.height is not None:
        return [camera.near, np.log(camera.height)]
    p = camera.projection(first.intrinsics_size)
    return [camera.near, np.log(p.fx), np.log(p.fy), p.cx, p.cy]


def _camera_of(eye, rotation, lens, first: Camera) -> Camera:
    near, *rest = (float(v) for v in lens)
    if first.fov is not None:
        return Camera(eye, rotation, fov=float(np.exp(rest[0])), near=near)
    if first.height is not None:
        return Camera(eye, rotation, height=float(np.exp(rest[0])), near=near)
    matrix = np.array([[np.exp(rest[0]), 0, rest[2]], [0, np.exp(rest[1]), rest[3]], [0, 0, 1]])
    return Camera(eye, rotation, intrinsics=matrix, intrinsics_size=first.intrinsics_size, near=near)


def turntable(thing, count: int = 120, direction=(1, 0.5, 2), fov: float = 40.0, up=(0, 1, 0), aspect: float = 1.0,
              margin: float = 1.05, turns: float = 1.0) -> list[Camera]:
    """Return the cameras of a turn around `thing`, which is whole in every picture; they pass it from left to right.

    Parameters
    ----------
    thing : anything with ``bounds``
        A scan, a surface, a placed surface or a scene; or a (2, 3) box.
    count : int
        Number of cameras; the first is not repeated at the end.
    direction, fov, up, aspect, margin : optional
        As of `Camera.framing`, for the first camera; the turn is about `up`.
    turns : float
        Negative: the other way round.

    Returns
    -------
    list of Camera

    Raises
    ------
    InputError
        `thing` has no finite extent, or an option that cannot be used.
    """
    if not isinstance(count, int | np.integer) or count < 1:
        raise InputError(f"turntable: expected at least one frame, got {count!r}")
    if not np.isfinite(turns):
        raise InputError(f"turntable: expected a finite number of turns, got {turns}")
    first = Camera.framing(thing, direction, fov, up, aspect, margin)  # checks its arguments
    box = np.asarray(getattr(thing, "bounds", thing), np.float64)
    target, axis = box.mean(axis=0), np.asarray(up, np.float64) / np.linalg.norm(up)
    rotation = _looking(-np.asarray(direction, np.float64), up)
    rings = _rings(*_extent(thing, box), target, axis)
    # A point's way around the axis, as seen by the first camera.
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)[:, None]
    side = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
    side /= np.linalg.norm(side)
    ways = rings[:, 0, None, None] * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side)) \
        + rings[:, 1, None, None] * axis
    view = np.ascontiguousarray((ways.reshape(-1, 3) @ rotation.T).T)
    tan = np.tan(np.radians(fov) / 2) / margin * np.array([aspect, 1.0])
    shift = np.zeros(2)
    for _ in range(4):  # the nearest distance depends on the centring, and the other way round
        distance = _fitting_distance(view, shift, 0.0, tan)
        slope = (view[1] - shift[1]) / np.maximum(distance - view[2], 1e-9 * max(distance, 1e-300))
        shift[1] += distance * (slope.min() + slope.max()) / 2
    distance = _fitting_distance(view, shift, 0.0, tan)
    eye = target + shift[1] * rotation[1] + (distance if distance > 0 else 1.0) * rotation[2]
    first = Camera(eye, rotation, fov=fov)
    return [first.orbited(target, 360 * turns * i / count, axis) for i in range(count)]


def _rings(points, reach, target, axis) -> NDArray:
    """Return radius and height (n, 2) of the rings that hold what turns: the hull's of its profile."""
    along = (points - target) @ axis
    radius = lengths_of(points - target - along[:, None] * axis) + reach
    rings = np.concatenate([np.stack([radius, along + side * reach], axis=1) for side in (-1, 1)])
    try:
        mirrored = np.concatenate([rings, rings * (-1, 1)])
        hull = mirrored[ConvexHull(mirrored).vertices]
        return hull[hull[:, 0] >= 0]
    except QhullError:  # flat or a single point
        return rings[[rings[:, 0].argmax(), rings[:, 1].argmin(), rings[:, 1].argmax()]]


def render_frames(scene, cameras: Iterable[Camera], size: tuple[int, int] = (1024, 768), device=None, scheduler=None,
                  **options) -> Iterator:
    """Yield a `Frame` per camera, drawn when it is asked for.

    Parameters
    ----------
    scene : Scene, surface, scan, or path-like
        As of `render`; with `scheduler` the path of a surface's file, which all workers see.
    cameras : iterable of Camera
        Such as `turntable` or `CameraPath.frames`.
    size, device, options : optional
        As of `render`.
    scheduler : str or distributed.Client, optional
        A Dask scheduler whose workers draw: "tcp://host:8786", or "local" for processes of this machine.

    Returns
    -------
    iterator of Frame
        See `write_video`, which takes them one by one.

    Raises
    ------
    InputError
        Something that cannot be drawn; with `scheduler` a scene that is not the path of a file.
    """
    if scheduler is not None:
        from .remote import remote_frames
        yield from remote_frames(scene, cameras, size, device, scheduler, options)
        return
    from .renderer import Renderer
    from .scene import as_scene
    scene = as_scene(scene)
    with Renderer(device) as renderer:
        for camera in cameras:
            yield renderer.render(scene, camera, size, **options)


# Files ----------------------------------------------------------------------------------------------------------------


def load_cameras(path, distortion: str = "refuse") -> dict[str, Camera]:
    """Read cameras from a file of intrinsics and poses, .json, or from a COLMAP model; see `clsurf.io.cameras`.

    Parameters
    ----------
    path : path-like
        .json, or the folder of COLMAP's cameras and images (.txt or .bin), or one of these files.
    distortion : str
        "refuse" lenses that bend straight lines, or "ignore" it with a logged line.

    Returns
    -------
    dict of name to Camera
        In the file's order; COLMAP's by the name of the image.

    Raises
    ------
    InputError
        No such file, or distortion where it is refused.
    FileFormatError
        A malformed file.
    """
    return {record.name: _of_record(record, path) for record in read_cameras(path, distortion).records}


def save_cameras(cameras, path, names=None) -> None:
    """Write cameras as .json; see `clsurf.io.cameras` for the file.

    Parameters
    ----------
    cameras : dict of name to Camera, list of Camera, or CameraPath
    path : path-like
        .json
    names : list of str, optional
        Of a list or path; by default their numbers.

    Raises
    ------
    InputError
        Something else than cameras, names that are not theirs, or a place that cannot be written.
    """
    moving = isinstance(cameras, CameraPath)
    if isinstance(cameras, dict):
        names, cameras = list(cameras), list(cameras.values())
    keys = cameras.cameras if moving else [cameras] if isinstance(cameras, Camera) else list(cameras)
    names = [str(i) for i in range(len(keys))] if names is None else [str(name) for name in names]
    if len(names) != len(keys) or len(set(names)) != len(names) or not all(isinstance(key, Camera) for key in keys):
        raise InputError("cameras: expected a list of clsurf.Camera, and a name of its own for each")
    times = cameras.times if moving else itertools.repeat(None)
    records = []
    for name, camera, time in zip(names, keys, times, strict=False):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.rotation.T @ _FLIP, camera.eye
        near = None if camera.height is not None and camera.near <= np.finfo(np.float32).min else camera.near
        records.append(CameraRecord(name, pose, camera.intrinsics_size, camera.intrinsics, camera.fov, camera.height,
                                    near, None if time is None else float(time)))
    write_cameras(path, CameraFile(tuple(records), moving and cameras.closed))


def _of_record(record: CameraRecord, path) -> Camera:
    near = record.near if record.near is not None else \
        0.0 if record.height is None else float(np.finfo(np.float32).min)
    try:
        return Camera(record.pose[:3, 3], _FLIP @ record.pose[:3, :3].T, record.fov, record.height, record.intrinsics,
                      record.size if record.intrinsics is not None else None, near)
    except InputError as error:
        raise InputError(f"{path}: camera {record.name}: {error}") from None
