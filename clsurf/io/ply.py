"""PLY files: meshes, clouds, range grids and triangle strips, ascii and binary.

Own code because trimesh reads neither triangle strips nor range grids nor further attributes, turns float32 into
float64 and takes 0.8 s for a range image of 40,000 points. Source: Greg Turk, "The PLY Polygon File Format" (1994).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import FileFormatError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh

from .colors import as_rgba8
from .files import write_array
from .rows import numbers_in

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
          "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
          "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"}
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_UVS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_LONGEST_HEADER = 1 << 20


@dataclass
class _Property:
    name: str
    kind: str  # dtype of a value, without byte order
    count_kind: str | None = None  # dtype of the length of a list


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property]


def read_ply(path: Path) -> Mesh | PointCloud:
    """Read a PLY file: a Mesh if it has faces or triangle strips, otherwise a PointCloud of its vertices.

    Raises
    ------
    FileFormatError
        Not a PLY file, truncated, or with impossible counts.
    """
    data = path.read_bytes()
    order, elements, start = _read_header(path, data)
    wanted = {"vertex", "face", "tristrips"} & {element.name for element in elements}
    if "vertex" not in wanted:
        raise FileFormatError(f"{path}: expected an element vertex, got "
                              f"{', '.join(element.name for element in elements) or 'none'}")
    reader = _read_ascii if order is None else _read_binary
    columns = reader(path, data, start, elements, wanted, order)
    faces = [_fans(*columns[name]) for name in ("face",) if isinstance(columns.get(name), tuple)]
    faces += [_strips(*columns[name]) for name in ("tristrips",) if isinstance(columns.get(name), tuple)]
    return _scan_of(path, columns["vertex"], np.concatenate(faces) if faces else None)


def _read_header(path: Path, data: bytes) -> tuple[str | None, list[_Element], int]:
    """Return the byte order (None: ascii), the elements, and where the values start."""
    if data[:3] != b"ply":
        raise FileFormatError(f"{path}: expected a PLY file (it starts with 'ply'), got {data[:12]!r}")
    end = data.find(b"end_header", 0, _LONGEST_HEADER)
    if end < 0:
        raise FileFormatError(f"{path}: the header has no end: truncated file")
    start = data.find(b"\n", end)
    start = len(data) if start < 0 else start + 1
    order, elements = "", []
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if not words or words[0] not in ("format", "element", "property"):
            continue  # comments; the Happy Buddha's range images have stray words as well
        try:
            if words[0] == "format":
                order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2]), []))
            elif words[0] == "property" and words[1] == "list":
                elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
            else:
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
        except (KeyError, IndexError, ValueError):
            raise FileFormatError(f"{path}: damaged header line {line[:80]!r}") from None
    if order == "":
        raise FileFormatError(f"{path}: the header names no format")
    for element in elements:
        names = [p.name for p in element.properties]
        if element.count < 0 or (names and element.count > len(data) - start) or len(set(names)) < len(names):
            raise FileFormatError(f"{path}: {element.count:,} of element {element.name} do not fit in a file of "
                                  f"{len(data):,} bytes, or its properties repeat: truncated or damaged")
    return order, elements, start


def _read_binary(path, data, at, elements, wanted, order) -> dict:
    """Return vertex columns by name and (lengths, values) of the index lists of faces and strips."""
    found = {}
    for element in elements:
        if not wanted:
            break
        lists = [p for p in element.properties if p.count_kind]
        lengths, values = np.zeros(0, np.int64), np.zeros(0, np.int64)
        if lists and element.name == "vertex":
            raise FileFormatError(f"{path}: lists in element vertex are not supported")
        if not element.properties or not element.count:
            rows = {p.name: np.zeros(0, p.kind) for p in element.properties}
        elif not lists:
            dtype = np.dtype([(p.name, order + p.kind) for p in element.properties])
            _check_room(path, element, dtype.itemsize * element.count, len(data) - at)
            rows = np.frombuffer(data, dtype, element.count, at)
            at += dtype.itemsize * element.count
        else:
            lengths, values, at = _binary_lists(path, data, at, element, order)
        if element.name in wanted:
            wanted = wanted - {element.name}
            if element.name == "vertex":
                found["vertex"] = {p.name: rows[p.name] for p in element.properties}
            elif lists:
                found[element.name] = (lengths, values)
    return found


def _binary_lists(path, data, at, element, order) -> tuple[NDArray, NDArray, int]:
    """Return lengths (n,), values and the end of the index list of a binary element (its last list otherwise)."""
    chosen = _index_list(element)
    uniform = _uniform_lists(data, at, element, order, chosen)
    if uniform is not None:
        return uniform
    lengths, starts, size = np.empty(element.count, np.int64), np.empty(element.count, np.int64), len(data)
    steps = [(np.dtype(p.kind).itemsize, p.count_kind and np.dtype(order + p.count_kind), p is chosen)
             for p in element.properties]
    for row in range(element.count):  # 0.15 s per million rows
        for width, count_type, is_chosen in steps:
            if count_type is None:
                at += width
                continue
            step = count_type.itemsize
            length = data[at] if step == 1 and at < size else int.from_bytes(
                data[at:at + step], "little" if order == "<" else "big")
            at += step
            if is_chosen:
                lengths[row], starts[row] = length, at
            at += length * width
        if at > size:
            raise FileFormatError(f"{path}: truncated in {element.name} {row:,} of {element.count:,}")
    dtype = np.dtype(order + chosen.kind)
    offset = np.cumsum(lengths) - lengths
    inside = np.arange(lengths.sum()) - np.repeat(offset, lengths)
    first = np.repeat(starts, lengths) + inside * dtype.itemsize
    raw = np.frombuffer(data, np.uint8)[first[:, None] + np.arange(dtype.itemsize)]
    return lengths, np.ascontiguousarray(raw).view(dtype)[:, 0], at


def _uniform_lists(data, at, element, order, chosen):
    """Return the same for an element whose lists have the lengths of its first row throughout, otherwise None."""
    fields, here = [], at
    for index, p in enumerate(element.properties):
        if p.count_kind:
            count_type = np.dtype(order + p.count_kind)
            if here + count_type.itemsize > len(data):
                return None
            length = int(np.frombuffer(data, count_type, 1, here)[0])
            if length < 0 or length * np.dtype(p.kind).itemsize > len(data) - here:
                return None
            fields += [(f"n{index}", count_type), (f"v{index}", order + p.kind, (length,))]
        else:
            fields.append((f"v{index}", order + p.kind))
        here = at + np.dtype(fields).itemsize
    dtype = np.dtype(fields)
    if dtype.itemsize * element.count > len(data) - at:
        return None
    rows = np.frombuffer(data, dtype, element.count, at)
    for index, p in enumerate(element.properties):
        if p.count_kind and (rows[f"n{index}"] != rows[f"n{index}"][0]).any():
            return None
    index = next(i for i, p in enumerate(element.properties) if p is chosen)
    values = rows[f"v{index}"]
    return np.full(element.count, values.shape[1]), values.reshape(-1), at + dtype.itemsize * element.count


def _read_ascii(path, data, start, elements, wanted, _order) -> dict:
    """Return the same as `_read_binary` for an ascii file."""
    try:
        tokens = numbers_in(data[start:])
    except ValueError:
        raise FileFormatError(f"{path}: expected numbers after the header, got other text") from None
    found, at = {}, 0
    for element in elements:
        if not wanted:
            break
        properties = element.properties
        chosen = _index_list(element)
        if chosen is None:
            need = element.count * len(properties)
            _check_room(path, element, need, len(tokens) - at)
            rows = tokens[at:at + need].reshape(element.count, len(properties)) if properties else None
            at += need
            if element.name == "vertex":
                found["vertex"] = {p.name: _typed(rows[:, i], p.kind) for i, p in enumerate(properties)}
        else:
            if element.name == "vertex":
                raise FileFormatError(f"{path}: lists in element vertex are not supported")
            lengths, values, at = _ascii_lists(path, tokens, at, element, chosen)
            if element.name in wanted:
                found[element.name] = (lengths, values)
        wanted = wanted - {element.name}
    return found


def _ascii_lists(path, tokens, at, element, chosen) -> tuple[NDArray, NDArray, int]:
    if len(element.properties) == 1 and element.count and at < len(tokens) and 0 <= tokens[at] < len(tokens):
        length = int(tokens[at])
        rows = tokens[at:at + element.count * (length + 1)]
        if len(rows) == element.count * (length + 1):
            rows = rows.reshape(element.count, length + 1)
            if (rows[:, 0] == length).all():
                return np.full(element.count, length), rows[:, 1:].reshape(-1), at + rows.size
    lengths, starts, size = np.empty(element.count, np.int64), np.empty(element.count, np.int64), len(tokens)
    for row in range(element.count):
        for p in element.properties:
            if p.count_kind is None:
                at += 1
                continue
            length = tokens[at] if at < size else -1
            if not 0 <= length <= size - at:
                raise FileFormatError(f"{path}: truncated or damaged in {element.name} {row:,} of {element.count:,}")
            if p is chosen:
                lengths[row], starts[row] = length, at + 1
            at += 1 + int(length)
        if at > size:
            raise FileFormatError(f"{path}: truncated in {element.name} {row:,} of {element.count:,}")
    offset = np.cumsum(lengths) - lengths
    inside = np.arange(lengths.sum()) - np.repeat(offset, lengths)
    return lengths, tokens[np.repeat(starts, lengths) + inside], at


def _index_list(element: _Element) -> _Property | None:
    lists = [p for p in element.properties if p.count_kind]
    named = [p for p in lists if p.name in ("vertex_indices", "vertex_index")]
    return (named or lists or [None])[0]


def _check_room(path, element, need, have) -> None:
    if need > have:
        raise FileFormatError(f"{path}: truncated: {element.count:,} of element {element.name} need {need:,} "
                              f"bytes (ascii: numbers), got {max(have, 0):,}")


def _typed(column: NDArray, kind: str) -> NDArray:
    with np.errstate(all="ignore"):
        return column if kind[0] == "f" else np.nan_to_num(column).astype(kind)


def _indices(values: NDArray) -> NDArray:
    if values.dtype.kind == "f":
        values = np.nan_to_num(values, nan=-2)
    return np.clip(values, -2, 2**31 - 1).astype(np.int64)


def _fans(lengths: NDArray, values: NDArray) -> NDArray:
    """Return triangles (f, 3) int64 of polygons, each as a fan about its first corner."""
    values = _indices(values)
    if len(lengths) and (lengths == 3).all():
        return values.reshape(-1, 3)
    offset = np.cumsum(lengths) - lengths
    count = np.maximum(lengths - 2, 0)
    owner = np.repeat(np.arange(len(lengths)), count)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    first = offset[owner]
    return np.stack([values[first], values[first + step + 1], values[first + step + 2]], axis=1)


def _strips(lengths: NDArray, values: NDArray) -> NDArray:
    """Return triangles (f, 3) int64 of triangle strips; -1 starts a new strip, every second triangle is turned."""
    values = _indices(values)
    if len(values) < 3:
        return np.zeros((0, 3), np.int64)
    place = np.arange(len(values))
    begins = np.zeros(len(values), np.int64)
    starts = (np.cumsum(lengths) - lengths)[lengths > 0]
    begins[starts] = starts
    stops = np.flatnonzero(values[:-1] == -1) + 1
    begins[stops] = stops
    begins = np.maximum.accumulate(begins)
    a, b, c = values[:-2], values[1:-1], values[2:]
    whole = (begins[2:] <= place[:-2]) & (a != -1) & (b != -1) & (c != -1) & (a != b) & (b != c) & (c != a)
    odd = ((place - begins)[:-2] & 1).astype(bool)
    return np.stack([a, np.where(odd, c, b), np.where(odd, b, c)], axis=1)[whole]


def _scan_of(path: Path, columns: dict[str, NDArray], faces: NDArray | None) -> Mesh | PointCloud:
    lacking = [name for name in "xyz" if name not in columns]
    if lacking:
        raise FileFormatError(f"{path}: expected vertex properties x, y, z, got {', '.join(columns) or 'none'}")
    columns = dict(columns)

    def take(*choices):
        for names in choices:
            if all(name in columns for name in names):
                return [columns.pop(name) for name in names]
        return None

    with np.errstate(all="ignore"):
        xyz = take(("x", "y", "z"))
        points = np.stack(xyz, axis=1).astype(np.float32 if all(c.dtype == np.float32 for c in xyz) else np.float64)
        normals = take(*_NORMALS)
        normals = None if normals is None else np.stack(normals, axis=1).astype(np.float32)
        colors = take(*((*names, alpha) for names in _COLORS for alpha in ("alpha", "a")), *_COLORS)
        colors = None if colors is None else as_rgba8(np.stack(colors, axis=1))
        uv = take(*_UVS) if faces is not None else None
        uv = None if uv is None else np.stack(uv, axis=1).astype(np.float32)
        rest = {name: value.astype(value.dtype.newbyteorder("=")) for name, value in columns.items()}
    if faces is None or not len(faces):
        return PointCloud(points, normals, colors, attributes=rest)
    if faces.min() < 0 or faces.max() >= len(points):
        raise FileFormatError(f"{path}: face index {faces.min() if faces.min() < 0 else faces.max()} outside the "
                              f"{len(points):,} vertices: damaged file")
    return Mesh(points, faces, normals, colors, uv, attributes=rest)


def write_ply(scan: Mesh | PointCloud, path: Path) -> None:
    """Write binary little-endian PLY: positions float64 where the scan has an origin, otherwise float32."""
    points = scan.points if not scan.origin.any() else scan.points + scan.origin
    fields = [(name, points.dtype, points[:, i]) for i, name in enumerate("xyz")]
    if scan.normals is not None:
        fields += [(name, np.dtype("f4"), scan.normals[:, i]) for i, name in enumerate(("nx", "ny", "nz"))]
    if scan.colors is not None:
        opaque = (scan.colors[:, 3] == 255).all()
        names = ("red", "green", "blue") if opaque else ("red", "green", "blue", "alpha")
        fields += [(name, np.dtype("u1"), scan.colors[:, i]) for i, name in enumerate(names)]
    if getattr(scan, "uv", None) is not None:
        fields += [(name, np.dtype("f4"), scan.uv[:, i]) for i, name in enumerate(("s", "t"))]
    taken = {name for name, *_ in fields}
    kinds = {np.dtype(kind): name for name, kind in list(_TYPES.items())[:8]}
    for name, value in scan.attributes.items():
        value = np.asarray(value)
        if value.ndim == 1 and value.dtype.kind in "iufb" and name not in taken and name.split() == [name]:
            kind = value.dtype if value.dtype in kinds else np.dtype("u1" if value.dtype.kind == "b" else "f8")
            fields.append((name, kind, value))
    rows = np.empty(len(points), [(name, kind.newbyteorder("<")) for name, kind, _ in fields])
    for name, _, column in fields:
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0", "comment clsurf", f"element vertex {len(points)}"]
    header += [f"property {kinds[kind]} {name}" for name, kind, _ in fields]
    faces = getattr(scan, "faces", None)
    with open(path, "wb") as file:
        if faces is not None:
            header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        write_array(file, rows)
        if faces is not None:
            lists = np.empty(len(faces), [("n", "u1"), ("v", "<i4", (3,))])
            lists["n"], lists["v"] = 3, faces
            write_array(file, lists)
