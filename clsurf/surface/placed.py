"""A surface with a placement in the world."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False, repr=False)
class Placed:
    """A surface moved by a similarity; its arrays are shared with the original.

    Parameters
    ----------
    surface : any surface
    matrix : (4, 4) float64
        Model to world: rotation, translation and one positive scale.
    """

    surface: Any
    matrix: NDArray  # (4, 4) float64, model to world

    @property
    def scale(self) -> float:
        """The uniform scale of the placement."""
        return float(np.cbrt(np.linalg.det(self.matrix[:3, :3])))

    @property
    def bounds(self) -> NDArray:
        """Bounding box (2, 3) float64 in world space of the moved box."""
        box = self.surface.bounds
        corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        corners = corners @ self.matrix[:3, :3].T + self.matrix[:3, 3]
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    @property
    def nbytes(self) -> int:
        """Bytes of the shared surface and the matrix."""
        return self.surface.nbytes + self.matrix.nbytes

    def __repr__(self):
        shift = np.round(self.matrix[:3, 3], 4).tolist()
        return f"Placed({self.surface!r}, scaled by {self.scale:.6g}, moved by {shift})"

    def moved(self, matrix) -> "Placed":
        """Return the surface moved further by `matrix` (4, 4)."""
        return placed(self.surface, np.asarray(matrix, np.float64) @ self.matrix)


def placed(surface, matrix) -> Placed:
    """Check that `matrix` (4, 4) is a similarity and return `surface` placed by it.

    Raises
    ------
    ValueError
        A matrix of another shape, or with shear, mirror, unequal scales or perspective.
    """
    matrix = np.array(matrix, np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"matrix: expected shape (4, 4), got {matrix.shape}")
    linear = matrix[:3, :3]
    gram = linear.T @ linear
    scale2 = np.trace(gram) / 3
    similar = (np.isfinite(matrix).all() and scale2 > 0 and np.abs(gram - scale2 * np.eye(3)).max() <= 1e-6 * scale2
               and np.linalg.det(linear) > 0 and np.allclose(matrix[3], (0, 0, 0, 1)))
    if not similar:
        raise ValueError("matrix: expected a rotation, translation and one positive scale (a similarity), got a matrix "
                         "with shear, mirror, unequal scales or perspective")
    matrix.flags.writeable = False
    return Placed(surface, matrix)
