"""Cameras: where the eye is, where it looks, and how space falls onto the picture.

View space has x right, y up and looks along -z (OpenGL). Pixel (0, 0) is the top left one, its centre at (0.5, 0.5).
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface.arrays import finite_rows, lengths_of, used_numbers

SEEN = 0.85  # of the radii of base surfels: kernels/common/surfel.clh, CORE


@dataclass(frozen=True)
class Projection:
    """How view space falls onto a picture of one size, in pixels.

    Perspective: x = cx + fx X / depth, y = cy - fy Y / depth with depth = -Z.
    Orthographic: x = cx + fx X, y = cy - fy Y.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    perspective: bool


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective or orthographic camera; make one with `framing`, `look_at`, `orthographic` or `from_intrinsics`.

    Parameters
    ----------
    eye : (3,) float64
        World position of the eye (orthographic: of the plane that depth is measured from).
    rotation : (3, 3) float64
        World to view: its rows are the camera's right, up and backward axes in world space.
    fov : float or None
        Vertical field of view in degrees; None for the two other kinds.
    height : float or None
        Orthographic: height of the picture in world units.
    intrinsics : (3, 3) float64 or None
        Pinhole matrix in pixels of `intrinsics_size`, y down, pixel centres at +0.5.
    intrinsics_size : (int, int) or None
        Width and height that `intrinsics` belongs to; other sizes scale it.
    near : float
        Depth (world units) in front of which nothing is drawn; 0: everything in front of the eye is.
    """

    eye: NDArray
    rotation: NDArray
    fov: float | None = None
    height: float | None = None
    intrinsics: NDArray | None = None
    intrinsics_size: tuple[int, int] | None = None
    near: float = 0.0

    def __post_init__(self):
        eye, rotation = np.array(self.eye, np.float64), np.array(self.rotation, np.float64)
        if eye.shape != (3,) or not np.isfinite(eye).all():
            raise InputError(f"camera eye: expected 3 finite numbers, got {self.eye}")
        if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) \
                or np.linalg.det(rotation) < 0:
            raise InputError("camera rotation: expected a (3, 3) rotation matrix without mirroring")
        if (self.fov is None) + (self.height is None) + (self.intrinsics is None) != 2:
            raise InputError("camera: expected exactly one of fov, height (orthographic), intrinsics")
        if self.fov is not None and not 0 < self.fov < 180:
            raise InputError(f"camera fov: expected degrees between 0 and 180, got {self.fov}")
        if self.height is not None and not (0 < self.height < np.inf):
            raise InputError(f"camera height: expected a positive length in world units, got {self.height}")
        if self.intrinsics is not None:
            k = np.array(self.intrinsics, np.float64)
            if k.shape != (3, 3) or not (k[0, 0] > 0 and k[1, 1] > 0) or not np.isfinite(k).all():
                raise InputError("camera intrinsics: expected a (3, 3) pinhole matrix with positive focal lengths")
            if k[0, 1] != 0:
                raise InputError(f"camera intrinsics: expected no skew, got {k[0, 1]}: undistort the picture first")
            object.__setattr__(self, "intrinsics", k)
        if not np.isfinite(self.near):
            raise InputError(f"camera near: expected a finite depth in world units, got {self.near}")
        object.__setattr__(self, "eye", eye)
        object.__setattr__(self, "rotation", rotation)

    # Making -----------------------------------------------------------------------------------------------------------

    @classmethod
    def look_at(cls, eye, target, up=(0, 1, 0), fov: float = 40.0, near: float = 0.0) -> "Camera":
        """Return a perspective camera at `eye` that looks at `target` (world space), `fov` vertical in degrees.

        Raises
        ------
        InputError
            `eye` equals `target`, or a value is not finite.
        """
        return cls(np.asarray(eye, np.float64), _looking(np.asarray(target) - np.asarray(eye), up), fov=fov, near=near)

    @classmethod
    def orthographic(cls, eye, target, up=(0, 1, 0), height: float = 2.0, near: float = -np.inf) -> "Camera":
        """Return an orthographic camera; `height` is the picture's height in world units.

        Everything is drawn, also behind the eye's plane (where depth is negative), unless `near` is given.
        """
        near = float(np.finfo(np.float32).min) if near == -np.inf else near
        return cls(np.asarray(eye, np.float64), _looking(np.asarray(target) - np.asarray(eye), up), height=height,
                   near=near)

    @classmethod
    def from_intrinsics(cls, matrix, pose, size: tuple[int, int], near: float = 0.0) -> "Camera":
        """Return a pinhole camera of computer vision.

        Parameters
        ----------
        matrix : (3, 3) array_like
            Focal lengths and principal point in pixels of `size`, pixel centres at +0.5.
        pose : (4, 4) array_like
            Camera to world, camera axes x right, y down, z forward.
        size : (int, int)
            Width and height of the picture that `matrix` belongs to.
        """
        pose = np.asarray(pose, np.float64)
        if pose.shape != (4, 4):
            raise InputError(f"camera pose: expected a (4, 4) matrix camera to world, got shape {pose.shape}")
        rotation = pose[:3, :3].T * np.array([[1.0], [-1.0], [-1.0]])
        return cls(pose[:3, 3], rotation, intrinsics=matrix, intrinsics_size=tuple(size), near=near)

    @classmethod
    def framing(cls, thing, direction=(1, 0.5, 2), fov: float = 40.0, up=(0, 1, 0), aspect: float = 1.0,
                margin: float = 1.05) -> "Camera":
        """Return a perspective camera that sees the whole of `thing`.

        Parameters
        ----------
        thing : anything with ``bounds``
            A scan, a surface, a placed surface or a scene; or a (2, 3) box.
        direction : (3,)
            From the target to the eye, world space.
        fov : float
            Vertical, degrees.
        aspect : float
            Width over height of the picture.
        margin : float
            Free border; 1 touches the edge.

        Raises
        ------
        InputError
            `thing` has no finite extent (an empty scan).
        """
        if not 0 < fov < 180 or not 0 < aspect < np.inf or not 0 < margin < np.inf:
            raise InputError("camera framing: expected fov between 0 and 180 degrees, a positive aspect and margin, "
                             f"got {fov}, {aspect}, {margin}")
        box = np.asarray(getattr(thing, "bounds", thing), np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all():
            raise InputError("camera framing: expected something with a finite bounding box, got an empty one")
        rotation = _looking(-np.asarray(direction, np.float64), up)
        target = box.mean(axis=0)
        points, reach = _extent(thing, box)
        view = np.ascontiguousarray(((points - target) @ rotation.T).T)  # sums over rows take 6 times as long
        tan = np.tan(np.radians(fov) / 2) / margin * np.array([aspect, 1.0])
        shift = np.zeros(2)
        for _ in range(4):  # the nearest distance depends on the centring, and the other way round
            distance = _fitting_distance(view, shift, reach, tan)
            away = np.maximum(distance - view[2], 1e-9 * max(distance, 1e-300))
            slopes = [(view[k] - shift[k]) / away for k in (0, 1)]
            shift = shift + distance * np.array([slope.min() + slope.max() for slope in slopes]) / 2
        distance = _fitting_distance(view, shift, reach, tan)
        distance = distance if distance > 0 else 1.0  # a single point
        return cls(target + shift @ rotation[:2] + distance * rotation[2], rotation, fov=fov)

    # Use --------------------------------------------------------------------------------------------------------------

    def projection(self, size: tuple[int, int]) -> Projection:
        """Return how view space falls onto a picture of `size` (width, height) pixels."""
        width, height = size
        if self.intrinsics is not None:
            k, (own_width, own_height) = self.intrinsics, self.intrinsics_size
            sx, sy = width / own_width, height / own_height
            return Projection(k[0, 0] * sx, k[1, 1] * sy, k[0, 2] * sx, k[1, 2] * sy, True)
        if self.height is not None:
            return Projection(height / self.height, height / self.height, width / 2, height / 2, False)
        focal = height / (2 * math.tan(math.radians(self.fov) / 2))
        return Projection(focal, focal, width / 2, height / 2, True)

    def rays(self, size: tuple[int, int]) -> tuple[NDArray, NDArray]:
        """Return the ray of every pixel's centre, row by row from the top left.

        Parameters
        ----------
        size : (int, int)
            Width and height in pixels.

        Returns
        -------
        origins, directions : (h * w, 3) float64
            World space; directions are unit.
        """
        p = self.projection(size)
        y, x = np.mgrid[:size[1], :size[0]] + 0.5
        right, up = (x.ravel() - p.cx) / p.fx, (p.cy - y.ravel()) / p.fy
        if p.perspective:
            view = np.stack([right, up, -np.ones_like(right)], axis=1)
            view /= lengths_of(view, keepdims=True)
            return np.broadcast_to(self.eye, view.shape).copy(), view @ self.rotation
        offset = np.stack([right, up, np.zeros_like(right)], axis=1)
        return self.eye + offset @ self.rotation, np.broadcast_to(-self.rotation[2], offset.shape).copy()

    def orbited(self, target, degrees: float, axis=(0, 1, 0)) -> "Camera":
        """Return the camera turned around `target` about the world `axis`."""
        axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
        angle = np.radians(degrees)
        cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        target = np.asarray(target, np.float64)
        return replace(self, eye=target + turn @ (self.eye - target), rotation=self.rotation @ turn.T)

    def __repr__(self):
        kind = (f"fov {self.fov:g}" if self.fov is not None else f"height {self.height:g}" if self.height is not None
                else f"intrinsics {self.intrinsics_size}")
        eye, forward = np.round(self.eye, 6).tolist(), np.round(-self.rotation[2], 4).tolist()
        return f"Camera({kind}, eye {eye}, looks along {forward})"


def _fitting_distance(view, shift, reach, tan) -> float:
    """Return the eye's distance at which balls at `view` (3, n) of radius `reach` just fit the half angles `tan`."""
    # A ball at (X, Y, Z) is inside where |X| + reach <= (distance - Z) tan_x, likewise Y.
    half = [(np.abs(view[k] - shift[k]) + reach) / tan[k] for k in (0, 1)]
    return float((np.maximum(*half) + view[2]).max())


def _extent(thing, box) -> tuple[NDArray, NDArray | float]:
    """Return positions (n, 3) float64, world space, and the radii around them that a picture of `thing` must hold."""
    placed = getattr(thing, "placed", None)
    if placed is not None:  # a scene: unmoved surfaces by themselves, moved ones by their boxes
        parts = [_extent(surface, surface.bounds) if matrix is None else _extent(None, whole.bounds)
                 for (surface, matrix), whole in zip(placed, thing.surfaces, strict=True)
                 if np.isfinite(whole.bounds).all()]
        reach = [np.broadcast_to(np.asarray(r, np.float64), len(p)) for p, r in parts]
        return np.concatenate([p for p, _ in parts]), np.concatenate(reach)
    if hasattr(thing, "centers") and len(thing.centers):
        leaf = thing.leaf if thing.leaf.any() else np.ones(len(thing.centers), bool)
        flat = np.sqrt(np.clip(1 - thing.normals[leaf].astype(np.float64) ** 2, 0, 1)).max(axis=1)
        return thing.centers[leaf] + thing.origin, thing.radii[leaf] * flat * (2 / 3)
    if hasattr(thing, "boxes") and hasattr(thing, "displacement_ranges"):
        points = thing.positions()
        return points[np.isfinite(points[:, 0])], 0.0
    if hasattr(thing, "normal_atlas") and not thing.hybrid and np.isfinite(box).all():
        base = thing.base
        base = base[finite_rows(thing.positions[base]) & np.isfinite(thing.radii[base])]
        flat = np.sqrt(np.clip(1 - thing.normals[base].astype(np.float64) ** 2, 0, 1)).max(axis=1)
        return thing.positions[base] + thing.origin, SEEN * thing.radii[base] * flat
    if hasattr(thing, "normal_atlas") and thing.hybrid:
        return thing.vertices[used_numbers(thing.triangles, len(thing.vertices))] + thing.origin, 0.0
    if hasattr(thing, "scales") and thing.valid.any():
        return thing.positions()[thing.valid], 0.0
    if hasattr(thing, "points") and len(thing.points):
        return thing.points + thing.origin, 0.0
    return np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]), 0.0


def _looking(forward, up) -> NDArray:
    """Return the world-to-view rotation of a camera that looks along `forward` with `up` above."""
    forward, up = np.asarray(forward, np.float64), np.asarray(up, np.float64)
    length = np.linalg.norm(forward)
    if forward.shape != (3,) or up.shape != (3,) or not np.isfinite(length) or length == 0 \
            or not 0 < np.linalg.norm(up) < np.inf:
        raise InputError("camera: expected an eye, target (or direction) and up of 3 finite numbers each, eye and "
                         "target apart")
    back = -forward / length
    right = np.cross(up, back)
    if np.linalg.norm(right) < 1e-9 * max(np.linalg.norm(up), 1e-300):
        # Looking along up: any other axis will do.
        right = np.cross(np.eye(3)[np.argmin(np.abs(back))], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])
