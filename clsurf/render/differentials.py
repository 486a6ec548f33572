"""Channels of curvature: their names, what they need, and how one device array holds them.

Source: Ohtake, Belyaev, Alexa, SGP 2005, section 4, equation 8. Kernel: kernels/render/differentials.clh.
"""

from numpy.typing import NDArray

from ..errors import InputError
from ..io.stored import StoredSurface
from ..surface.slim import SlimSurface
from .slim_drawing import SlimDrawing

# Values per pixel (0: one) and the order of derivatives that a channel needs; scalars come before vectors.
DIFFERENTIALS = {"mean": (0, 2), "gaussian": (0, 2), "k1": (0, 2), "k2": (0, 2), "derivative1": (0, 3),
                 "derivative2": (0, 3), "radial": (0, 2), "radial_derivative": (0, 3), "direction1": (3, 2),
                 "direction2": (3, 2)}
NAME = "differentials"  # of the device array that holds them all


def wanted_differentials(channels) -> tuple[str, ...]:
    """Return those of `channels` that are of curvature, in the order of their planes."""
    return tuple(name for name in DIFFERENTIALS if name in channels)


def plane_counts(names) -> tuple[int, int]:
    """Return the number of scalars and of vectors among channels of curvature."""
    vectors = sum(DIFFERENTIALS[name][0] > 0 for name in names)
    return len(names) - vectors, vectors


def order_of(names) -> int:
    """Return the order of the derivatives that channels of curvature need; 0 for none."""
    return max((DIFFERENTIALS[name][1] for name in names), default=0)


def field_constants(names, first: int) -> dict[str, int]:
    """Return the constants of kernels/common/planes.clh for channels whose planes start at number `first`."""
    scalars, vectors = plane_counts(names)
    out = {"FIELD_DIFFERENTIAL": first, "DIFFERENTIAL_SCALARS": scalars, "DIFFERENTIAL_VECTORS": vectors,
           "DERIVATIVES": order_of(names)}
    for name in names:
        out[f"FIELD_{name.upper()}"] = first
        first += max(DIFFERENTIALS[name][0], 1)
    return out


def check_differentials(placed, names, look: str, drawing: SlimDrawing) -> None:
    """Raise InputError where the surfaces of a scene cannot give the channels of curvature `names`.

    `placed` has pairs (surface, matrix).
    """
    if not names:
        return
    degrees = [surface.degree for surface, _ in placed if isinstance(surface, SlimSurface | StoredSurface)]
    if not degrees:
        raise InputError(f"channel {names[0]}: expected a SlimSurface in the scene, got none: only they have "
                         "curvature; build one with clsurf.build_slim")
    if look.startswith("ball"):
        raise InputError(f"channel {names[0]}: expected the look phong or flat, got {look!r}, which draws "
                         "balls")
    if drawing.derivatives == "function":
        if order_of(names) > 2:
            raise InputError(f"channel {max(names, key=lambda n: DIFFERENTIALS[n][1])}: expected "
                             'SlimDrawing(derivatives="separate"), got "function", which has no third derivatives')
        return
    name = max(names, key=lambda n: DIFFERENTIALS[n][1])
    if min(degrees) < order_of(names):
        raise InputError(f"channel {name}: expected surfels of degree {order_of(names)} or more, got degree "
                         f"{min(degrees)}: use build_slim(..., degree={order_of(names)})")


def split_differentials(array: NDArray, names) -> dict[str, NDArray]:
    """Return views of the channels `names` in an array (planes, h, w) of all of them: (h, w), or (h, w, 3)."""
    height, width = array.shape[1:]
    out, at = {}, 0
    for name in names:
        parts = max(DIFFERENTIALS[name][0], 1)
        out[name] = array[at:at + parts].reshape((height, width, 3) if parts == 3 else (height, width))
        at += parts
    return out
