"""The raw range images of the Happy Buddha: 1.1M points of 15 views, each with the direction to its sensor."""

import numpy as np

from .scenes import data_folder


def load_happy() -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) float64 in world space and the unit direction (n, 3) from each to its own sensor.

    The scanner is orthographic across the beam, so that one direction holds for a whole image: +z of its own frame.
    """
    folder = data_folder() / "range_scans" / "happy"
    points, directions = [], []
    for line in (folder / "happyStandRight.conf").read_text().splitlines():
        words = line.split()
        if not words or words[0] != "bmesh":
            continue
        numbers = np.array(words[2:], np.float64)
        rotation = _rotation(numbers[3:])
        local = _read_vertices(folder / words[1])
        points.append(local @ rotation.T + numbers[:3])
        directions.append(np.broadcast_to(rotation[:, 2], local.shape))
    return np.concatenate(points), np.concatenate(directions)


def _rotation(quaternion) -> np.ndarray:
    """Return the matrix (3, 3) of a .conf quaternion x y z w, which must be conjugated to bring scans together."""
    x, y, z, w = quaternion * (-1, -1, -1, 1) / np.linalg.norm(quaternion)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def _read_vertices(path) -> np.ndarray:
    """Return the vertices (v, 3) float64 of an ASCII PLY file whose first element they are."""
    with open(path, "rb") as file:
        count = 0
        for line in file:
            if line.startswith(b"element vertex"):
                count = int(line.split()[2])
            if line.strip() == b"end_header":
                break
        return np.fromstring(file.read(), sep=" ", count=3 * count).reshape(-1, 3)
