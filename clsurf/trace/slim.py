"""SLIM surfaces for tracing: the leaves in a wide tree, with what rays ask of them.

Kernels: kernels/trace/packet.clh. Source of the surface: Ohtake, Belyaev, Alexa, SGP 2005, section 2.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from ..io.stored_leaves import only
from ..surface.arrays import box_of, finite_rows, lengths_of
from ..surface.slim import SlimSurface
from ..surface.slim_bounds import height_bounds, scaled_coefficients
from ..surface.srgb import LINEAR_OF_BYTE
from .tree import WIDTH, Tree, node_boxes, plant, room

ALPHA = 0.8  # hits lie in balls shrunken by this, as in the renderer
SURFEL_FLOATS = 21  # vectors of 16 of a bottom node; the planes of kernels/common/select_slim.clh
TAIL_FLOATS = 16  # of a slot; fields 16 to 31 of kernels/common/slim.clh


@dataclass(frozen=True, eq=False)
class TracedSlim:
    """The leaves of a `SlimSurface` on a device, in the slots of a `Tree`; model space, relative to `origin`.

    A surfel that is not finite or has no radius is in no slot.
    """

    degree: int
    oriented: bool
    tree: Tree
    boxes: DeviceArray  # (nodes, 6, 16) float32: of the pieces of surface in the balls shrunken by ALPHA
    balls: DeviceArray  # (nodes, 6, 16) float32: of the whole balls
    surfels: DeviceArray  # (bottom nodes, 21, 16) float32
    tails: DeviceArray  # (slots, 16) float32
    colors: DeviceArray | None  # (slots, 4) float32, linear
    origin: NDArray  # (3,) float64, world position of the model's zero
    center: NDArray  # (3,) float64, model space
    reach: float  # every ball lies within this of `center`

    @property
    def constants(self) -> dict[str, int]:
        """The constants of kernels/trace/packet.clh."""
        return {"DEGREE": self.degree, "ORIENTED": self.oriented, "STACK": 15 * self.tree.levels + 1}


def piece_boxes(surface: SlimSurface, low: NDArray, high: NDArray, alpha: float = ALPHA) -> tuple[NDArray, NDArray]:
    """Return the boxes (n, 3) float64 of the pieces of surface inside the balls shrunken by `alpha`.

    A piece lies in a disc around the normal, `low` to `high` radii along it, and in the ball.
    """
    normals, radii = surface.normals.astype(np.float64), surface.radii.astype(np.float64)[:, None]
    flat = alpha * np.sqrt(np.clip(1 - normals**2, 0, 1))
    a, b = normals * low[:, None], normals * high[:, None]
    least = np.maximum(np.minimum(a, b) - flat, -alpha)
    largest = np.minimum(np.maximum(a, b) + flat, alpha)
    centers = surface.centers.astype(np.float64)
    slack = 2e-6 * (radii + np.abs(centers))  # float32 rounding in the kernels
    return centers + radii * least - slack, centers + radii * largest + slack


def upload_traced(device: Device, surface: SlimSurface) -> TracedSlim:
    """Plant the leaves of a surface and put them on the device.

    Raises
    ------
    InputError
        More surfels than a slot's number holds.
    DeviceMemoryError
    """
    surface = leaves_of(surface)
    n = len(surface)
    if n > 1 << 27:
        raise InputError(f"surface: expected at most {1 << 27:,} surfels to trace, got {n:,}: split it")
    slots, nodes = room(n)
    device.check_memory(surfels=4 * SURFEL_FLOATS * slots, tails=4 * TAIL_FLOATS * slots, boxes=24 * WIDTH * nodes,
                        balls=24 * WIDTH * nodes, colors=0 if surface.colors is None else 16 * slots)
    degree, radii = surface.degree, surface.radii.astype(np.float64)
    with np.errstate(all="ignore"):
        k = scaled_coefficients(degree, surface.coefficients, surface.radii)
        full = k.copy()
        if degree >= 2:
            full[:, 4] *= 2
        low, high, slope = height_bounds(degree, full)
        usable = (finite_rows(k) & finite_rows(surface.centers)
                  & finite_rows(surface.normals) & (radii > 0) & np.isfinite(radii) & (low <= high))
        below, above = piece_boxes(surface, low, high)
    below[~usable], above[~usable] = 1, -1
    tree = plant(device, below, above)
    centers = surface.centers.astype(np.float64)
    reach = radii[:, None] * (1 + 2e-6) + 2e-6 * np.abs(centers)
    planes = np.zeros((len(tree.order), SURFEL_FLOATS))
    planes[:, [3, 4, 7, 8, 9]] = 1, 1, 1, 1, -1  # an empty slot: a ball at zero with nothing in it
    used = tree.order >= 0
    at = tree.order[used]
    for i, values in enumerate([*surface.centers.T, radii, radii, *surface.normals.T, low, high, slope, *k.T]):
        planes[used, i] = values[at]
    tails = np.zeros((len(tree.order), TAIL_FLOATS), np.float32)
    tails[used, :min(k.shape[1], 6)] = k[at, :6]
    tails[used, 6] = radii[at]
    tails[:, 8:10].view(np.uint32)[:] = 0xFFFFFFFF
    if surface.footprint is not None:
        tails[used, 8:10] = np.ascontiguousarray(surface.footprint[at]).view("<f4")
    tails[used, 12:12 + max(k.shape[1] - 6, 0)] = k[at, 6:]
    colors = None
    if surface.colors is not None:
        colors = np.ones((len(tree.order), 4), np.float32)
        colors[used, :3] = LINEAR_OF_BYTE[surface.colors[at, :3]]
    points = centers[at]
    center = sum(box_of(points)) / 2 if len(points) else np.zeros(3)
    boxes, balls = node_boxes(tree, below, above), node_boxes(tree, centers - reach, centers + reach)
    return TracedSlim(
        degree, surface.oriented, tree, device.upload(boxes), device.upload(balls),
        device.upload(planes.reshape(-1, WIDTH, SURFEL_FLOATS).transpose(0, 2, 1).astype(np.float32)),
        device.upload(tails), None if colors is None else device.upload(colors), surface.origin, center,
        float((lengths_of(points - center) + radii[at]).max()) if len(points) else 0.0)


def leaves_of(surface: SlimSurface) -> SlimSurface:
    """Return the leaves alone; a surface without leaves as it is."""
    if surface.leaf.all() or not surface.leaf.any():
        return surface
    return only(surface, np.flatnonzero(surface.leaf))
