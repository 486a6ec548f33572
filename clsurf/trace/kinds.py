"""What can be traced: each kind of surface registers how it is put on a device; rays know no more than `Traced`."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError

CLOSEST, ANY, NEXT = 0, 1, 2  # kernels/trace/ray_walk.clh, MODE
RAYS_OF_ITEM = 128


@dataclass(frozen=True, eq=False)
class Traced:
    """A surface on a device, ready for rays in its own frame: frame = (model - center) / unit.

    Parameters
    ----------
    center : (3,) float64
        Model space.
    unit : float
        Model length of one unit of the frame.
    box : (2, 3) float64
        The surface lies inside; frame. Least above largest: nothing is hit. Of a piece: where hits are looked for.
    launch : function
        ``launch(mode, count, rays, hits)`` enqueues the kernel that fills hits (count, 8) from rays (count, 8), both
        float32 and in the frame (kernels/trace/ray_walk.clh).
    grain : float
        Model length within which the surface's own points, as drawn, are no obstacles to rays that leave it; by default
        a thousandth of the box's diagonal.
    packets : TracedSlim, optional
        What packets trace in place of single rays (clsurf/trace/packets.py), for kinds that have them.
    order : (slots,) int32, optional
        Primitive of each slot of the packets' tree.
    colors : function, optional
        Linear colours (n, 3) float64 of primitives (n,), as `Hits.primitive` numbers them.
    ready : function
        ``ready()`` puts what only single rays need on the device, before the first of them.
    """

    center: NDArray
    unit: float
    box: NDArray
    launch: Callable[[int, int, DeviceArray, DeviceArray], None]
    grain: float | None = None
    packets: object | None = None
    order: DeviceArray | None = None
    colors: Callable[[NDArray], NDArray] | None = None
    ready: Callable[[], None] = lambda: None

    def __post_init__(self):
        if self.grain is None or not np.isfinite(self.grain):
            diagonal = 0.0 if self.empty else float(np.linalg.norm(self.box[1] - self.box[0]))
            object.__setattr__(self, "grain", 1e-3 * self.unit * diagonal)

    @property
    def empty(self) -> bool:
        """Whether there is nothing to hit."""
        return not (self.box[0] <= self.box[1]).all()


@dataclass(frozen=True, eq=False)
class Plan:
    """A surface on the host, all or some of whose primitives go to a device; all of them share one frame.

    Parameters
    ----------
    hold : function
        ``hold(device, rows)`` puts the primitives `rows` (k,) int on the device, None: all, and returns `Traced`.
    reaches : function
        ``reaches()`` returns the boxes, low and high (n, 3) float64 of the frame, within which primitives count.
    grain, colors
        Those of the whole surface; see `Traced`.
    radii : (n,) float64, optional
        Of kinds whose hits blend what is around them: how far a primitive blends; frame.
    blend : float
        Largest radii beyond a hit within which others are blended that do not hold it.
    same : float
        Frame length within which hits of a ray in two pieces are one.
    packets : bool
        Whether packets trace it; see `Traced`.
    """

    hold: Callable[[Device, NDArray | None], Traced]
    reaches: Callable[[], tuple[NDArray, NDArray]]
    grain: float
    colors: Callable[[NDArray], NDArray] | None = None
    radii: NDArray | None = None
    blend: float = 0.0
    same: float = 0.0
    packets: bool = False


KINDS: dict[type, Callable[[object], Plan]] = {}
NOTHING = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]])


def register(kind: type):
    """Make surfaces of `kind` traceable by the decorated function (surface) -> Plan."""
    def enter(prepare):
        KINDS[kind] = prepare
        return prepare
    return enter


def traceable(surface) -> bool:
    """Return whether rays can meet `surface`: points, which have no extent, cannot be hit."""
    return any(kind in KINDS for kind in type(surface).__mro__)


def plan_of(surface) -> Plan:
    """Return how a surface is put on a device.

    Raises
    ------
    InputError
        Something that cannot be traced.
    """
    prepare = next((KINDS[kind] for kind in type(surface).__mro__ if kind in KINDS), None)
    if prepare is None:
        names = ", ".join(sorted(kind.__name__ for kind in KINDS))
        raise InputError(f"trace: expected one of {names}, plain or placed, or a scene or list of them, got "
                         f"{type(surface).__name__}: build a surface from a scan first (clsurf.build_slim, "
                         "clsurf.build_patches)")
    return prepare(surface)


def items(device: Device, count: int) -> tuple[tuple, tuple, int]:
    """Return global size, local size and rays of a work-item for `count` rays."""
    batch = RAYS_OF_ITEM if device.lanes > 1 else 1
    return (-(-count // batch),), (1 if device.lanes > 1 else 64,), batch
