"""OFF files: text, with colours and normals where the first word says so (COFF, NOFF, CNOFF).

Own code because trimesh leaves colours out. Source: the file format of Geomview, "OFF".
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import FileFormatError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh

from .colors import as_rgba8
from .rows import digits_of, numbers_in, world_of, write_rows


def read_off(path: Path) -> Mesh | PointCloud:
    """Read an OFF file; polygons become fans of triangles, colours of faces are left out.

    Raises
    ------
    FileFormatError
        Binary, truncated, or not an OFF file.
    """
    data = path.read_bytes()
    match = re.match(rb"\s*(ST)?(C)?(N)?(4)?OFF\b(\s+BINARY)?", data)
    if match is None or match[4] or match[5]:
        raise FileFormatError(f"{path}: expected a text file that starts with OFF, got {data[:16]!r}")
    body = re.sub(rb"#[^\r\n]*", b"", data[match.end():]) if b"#" in data else data[match.end():]
    lines = [line for line in map(bytes.strip, body.splitlines()) if line]
    counts = lines[0].split() if lines else []
    if len(counts) < 2 or not all(word.isdigit() for word in counts[:2]):
        raise FileFormatError(f"{path}: expected the counts of vertices and faces, got {b' '.join(counts)[:60]!r}")
    vertices, faces = int(counts[0]), int(counts[1])
    if vertices + faces > len(lines) - 1:
        raise FileFormatError(f"{path}: truncated: {vertices:,} vertices and {faces:,} faces do not fit in "
                              f"{len(lines) - 1:,} lines")
    table = _table(path, lines[1:1 + vertices])
    points, at = table[:, :3], 3
    normals = colors = None
    if match[3]:
        normals, at = table[:, at:at + 3], at + 3
    if match[2]:
        colors = table[:, at:at + 4]
        whole = (colors == np.floor(colors)).all()
        colors = as_rgba8(colors.clip(0, 65535).astype(np.uint16) if whole else colors) if colors.shape[1] > 2 else None
    triangles = _triangles(path, lines[1 + vertices:1 + vertices + faces])
    if not len(triangles):
        return PointCloud(points, normals, colors)
    if triangles.min() < 0 or triangles.max() >= vertices:
        raise FileFormatError(f"{path}: face index outside the {vertices:,} vertices: damaged file")
    return Mesh(points, triangles, normals, colors)


def _table(path: Path, lines: list[bytes]) -> NDArray:
    width = len(lines[0].split()) if lines else 3
    table = numbers_in(b"\n".join(lines))
    if width < 3 or len(table) != width * len(lines):
        raise FileFormatError(f"{path}: expected vertices of at least three numbers, all of one length")
    return table.reshape(-1, width)


def _triangles(path: Path, lines: list[bytes]) -> NDArray:
    tokens = numbers_in(b"\n".join(lines))
    if len(tokens) == 4 * len(lines) and (tokens[::4] == 3).all():  # triangles without colours
        return np.clip(tokens.reshape(-1, 4)[:, 1:], -1, 2**31 - 1).astype(np.int64)
    out: list[tuple[int, int, int]] = []
    for line in lines:
        words = line.split()
        count = int(words[0])
        if count < 1 or len(words) <= count:
            raise FileFormatError(f"{path}: damaged face {line[:60]!r}")
        corners = [int(word) for word in words[1:1 + count]]
        out.extend((corners[0], corners[k], corners[k + 1]) for k in range(1, count - 1))
    return np.array(out, np.int64).reshape(-1, 3)


def write_off(scan: Mesh | PointCloud, path: Path) -> None:
    """Write OFF, or COFF with colours and alpha."""
    faces, colors = getattr(scan, "faces", np.zeros((0, 3), np.int32)), scan.colors
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(f"{'OFF' if colors is None else 'COFF'}\n{len(scan.points)} {len(faces)} 0\n")
        write_rows(file, [(world_of(scan), digits_of(scan))] + ([] if colors is None else [(colors, "%d")]))
        write_rows(file, [(faces, "%d")], "3 ")
