"""How SLIM surfaces are drawn."""

from dataclasses import dataclass

from ..errors import InputError

DERIVATIVES = ("separate", "function")


@dataclass(frozen=True)
class SlimDrawing:
    """How SLIM surfaces are drawn.

    Parameters
    ----------
    derivatives : str
        Where normals and curvature come from (paper, equation 8). "separate": the derivatives of the surfels'
        functions are blended, the left side. "function": the derivatives of the blended function sum w f / sum w,
        those of the weights among them, at the same points; the right side, which the paper compares: seams between
        surfels show in it. It has no channels that need third derivatives.
    """

    derivatives: str = "separate"

    def __post_init__(self):
        if self.derivatives not in DERIVATIVES:
            raise InputError(f"slim derivatives: expected one of {', '.join(DERIVATIVES)}, got {self.derivatives!r}")
