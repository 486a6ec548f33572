"""Range images as plain data: grids of distances or of points, each from one place, and scans made of them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .arrays import bounds_of, box_of, frozen
from .cloud import PointCloud
from .placed import Placed, placed

FAR = 100.0  # diagonals: where the sensor of a grid of points without an `eye` is taken to stand


@dataclass(frozen=True, eq=False, repr=False)
class RangeImage:
    """What a sensor saw from one place: a depth image with its intrinsics, or a grid of points.

    Depth images have their columns to the right, their rows down and the depth forward along z; the centre of the first
    pixel is (0, 0), so that the point of pixel (column u, row v) is depth * inverse(intrinsics) (u, v, 1).

    Parameters
    ----------
    depth : (h, w) float32, optional
        Distance along z, world units; what is not a positive number is none and becomes NaN.
    intrinsics : (3, 3) float64, optional
        [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] in pixels; needed with `depth`.
    points : (h, w, 3) float32, optional
        In place of both: positions in the sensor's space; NaN for none.
    color : (H, W, 4) uint8, optional
        sRGB with straight alpha, of the same view; it need not have the same number of pixels.
    pose : (4, 4) float64
        From the sensor's space to the world; a rotation (scaled or not) and a translation.
    eye : (3,) float64, optional
        Where the sensor stands, in its own space; by default the zero of a depth image, and for points far along +z,
        as the Stanford range images have it.
    name : str
        Used in messages.

    Raises
    ------
    ValueError
        An array of the wrong shape, or neither or both of `depth` and `points`.
    """

    depth: NDArray | None = None  # (h, w) float32, world units along z; NaN: none
    intrinsics: NDArray | None = None  # (3, 3) float64, pixels
    points: NDArray | None = None  # (h, w, 3) float32, sensor space; NaN: none
    color: NDArray | None = None  # (H, W, 4) uint8 sRGB, straight alpha
    pose: NDArray | None = None  # (4, 4) float64, sensor to world
    eye: NDArray | None = None  # (3,) float64, sensor space
    name: str = ""

    def __post_init__(self):
        put = lambda name, *rest: object.__setattr__(self, name, frozen(name, *rest))  # noqa: E731
        if (self.depth is None) == (self.points is None):
            raise ValueError("range image: expected either depth or points")
        if self.depth is not None:
            depth = np.array(self.depth, np.float32)
            depth[~((depth > 0) & np.isfinite(depth))] = np.nan
            put("depth", depth, ("h", "w"), np.float32)
            if self.intrinsics is None:
                raise ValueError("intrinsics: expected a (3, 3) matrix with a depth image, got None")
            put("intrinsics", self.intrinsics, (3, 3), np.float64)
            k = self.intrinsics
            if not (np.isfinite(k).all() and k[0, 0] > 0 and k[1, 1] > 0 and (k[2] == (0, 0, 1)).all()
                    and k[1, 0] == 0):
                raise InputError(f"intrinsics: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy, "
                                 f"got {k.tolist()}")
        else:
            points = np.array(self.points, np.float32)
            if points.ndim == 3:
                points[~np.isfinite(points).all(axis=2)] = np.nan
            put("points", points, ("h", "w", 3), np.float32)
        if self.color is not None:
            put("color", self.color, ("H", "W", 4), np.uint8)
        put("pose", np.eye(4) if self.pose is None else self.pose, (4, 4), np.float64)
        if self.eye is not None:
            put("eye", self.eye, (3,), np.float64)
        self._check_pose()

    def _check_pose(self):
        turn = self.pose[:3, :3]
        square = turn @ turn.T
        scale = np.trace(square) / 3 if np.isfinite(self.pose).all() else 0.0
        fits = scale > 0 and np.abs(square - scale * np.eye(3)).max() < 1e-3 * scale and np.linalg.det(turn) > 0
        if not fits or not np.allclose(self.pose[3], (0, 0, 0, 1)):
            raise InputError(f"{self.name or 'range image'}: pose: expected a rotation and a translation (4, 4), got "
                             f"{np.round(self.pose, 4).tolist()}")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (self.depth if self.depth is not None else self.points).shape[:2]

    @property
    def valid(self) -> NDArray:
        """(h, w) bool: the samples that are there."""
        return np.isfinite(self.depth if self.depth is not None else self.points[..., 2])

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(a.nbytes for a in (self.depth, self.points, self.color) if a is not None)

    def sensor_points(self) -> NDArray:
        """Return the samples (h, w, 3) float32 in the sensor's space; NaN for none."""
        if self.points is not None:
            return self.points
        h, w = self.shape
        inverse = np.linalg.inv(self.intrinsics)
        u, v = np.arange(w), np.arange(h)[:, None]
        out = np.empty((h, w, 3), np.float32)
        out[..., 0] = self.depth * (inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2]).astype(np.float32)
        out[..., 1] = self.depth * (inverse[1, 1] * v + inverse[1, 2]).astype(np.float32)
        out[..., 2] = self.depth
        return out

    def eye_world(self) -> NDArray:
        """Return where the sensor stands (3,) float64, world space."""
        eye = self.eye
        if eye is None and self.depth is not None:
            eye = np.zeros(3)
        if eye is None:
            points = self.points[self.valid]
            low, high = box_of(points) if len(points) else (np.zeros(3), np.ones(3))
            eye = (low + high).astype(np.float64) / 2 + (0, 0, FAR * float(np.linalg.norm(high - low)))
        return self.pose[:3, :3] @ eye + self.pose[:3, 3]

    def sample_colors(self) -> NDArray | None:
        """Return the colour (h, w, 4) uint8 of every sample, None without a colour image.

        Pixels of the colour image are looked up at the same place of the view, the mean of those around where it has
        more of them than there are samples.
        """
        if self.color is None or self.color.shape[:2] == self.shape:
            return self.color
        rows, columns = (_weights(have, want) for have, want in zip(self.color.shape[:2], self.shape, strict=True))
        mixed = np.einsum("hkwc,hk->hwc", self.color[rows[0]].astype(np.float32), rows[1], optimize=True)
        mixed = np.einsum("hwkc,wk->hwc", mixed[:, columns[0]], columns[1], optimize=True)
        return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)

    def __repr__(self):
        h, w = self.shape
        kind = "depth" if self.depth is not None else "points"
        return (f"RangeImage({self.name + ', ' if self.name else ''}{w} x {h} {kind}, {int(self.valid.sum()):,} samples"
                f"{', color' if self.color is not None else ''})")


def _weights(have: int, want: int) -> tuple[NDArray, NDArray]:
    """Return which (want, k) of `have` pixels in a row make each of `want`, and their weights: a tent filter."""
    scale = have / want
    reach = max(1.0, scale)
    center = (np.arange(want) + 0.5) * scale - 0.5
    at = np.floor(center - reach).astype(int)[:, None] + 1 + np.arange(int(np.ceil(2 * reach)))
    weight = np.maximum(0, 1 - np.abs(at - center[:, None]) / reach)
    return np.clip(at, 0, have - 1), (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)


@dataclass(frozen=True, eq=False, repr=False)
class RangeScan:
    """A scan made of range images that lie in one world.

    Parameters
    ----------
    images : sequence of RangeImage
        At least one.
    """

    images: tuple[RangeImage, ...]

    def __post_init__(self):
        images = (self.images,) if isinstance(self.images, RangeImage) else tuple(self.images)
        if not images or not all(isinstance(image, RangeImage) for image in images):
            raise ValueError("images: expected at least one RangeImage, got "
                             f"{', '.join(sorted({type(i).__name__ for i in images})) or 'none'}")
        object.__setattr__(self, "images", images)

    def __len__(self):
        return len(self.images)

    @cached_property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64 of all samples, world space; NaN where there is none."""
        boxes = []
        for image in self.images:
            points = image.sensor_points()[image.valid]
            if len(points):
                world = points @ image.pose[:3, :3].T.astype(np.float32)
                boxes.append(bounds_of(world, image.pose[:3, 3]))
        if not boxes:
            return np.full((2, 3), np.nan)
        return np.stack([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(image.nbytes for image in self.images)

    @property
    def origin(self) -> NDArray:
        """World position (3,) float64 that the points of `to_points` are relative to: the middle of the box."""
        return np.zeros(3) if np.isnan(self.bounds).any() else self.bounds.mean(axis=0)

    def moved(self, matrix) -> Placed:
        """Return this scan placed by the similarity `matrix` (4, 4), the arrays shared."""
        return placed(self, matrix)

    @property
    def sample_count(self) -> int:
        """Samples of all images."""
        return sum(int(image.valid.sum()) for image in self.images)

    def to_points(self) -> PointCloud:
        """Return all samples as a point cloud in world space, with the sensor's position and the colour of each.

        Rows of the images come one after the other, images in their order. Colours are there if every image has one.
        """
        origin = self.origin
        points, scanners, colors = [], [], []
        for image in self.images:
            valid = image.valid
            turn, shift = image.pose[:3, :3].astype(np.float32), image.pose[:3, 3] - origin
            here = image.sensor_points()[valid] @ turn.T + shift.astype(np.float32)
            points.append(here)
            scanners.append(np.broadcast_to((image.eye_world() - origin).astype(np.float32), here.shape))
            color = image.sample_colors()
            colors.append(None if color is None else color[valid])
        return PointCloud(np.concatenate(points), scanners=np.concatenate(scanners), origin=origin,
                          colors=None if any(c is None for c in colors) else np.concatenate(colors))

    def __repr__(self):
        low, high = self.bounds
        colored = ", colors" if all(image.color is not None for image in self.images) else ""
        return (f"RangeScan({len(self)} images, {self.sample_count:,} samples{colored}, {self.nbytes:,} bytes, "
                f"bounds {np.round(low, 4).tolist()} to {np.round(high, 4).tolist()})")
