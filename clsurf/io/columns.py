"""Tables of numbers as point clouds: text files (XYZ, PTS, CSV) and NumPy arrays without names.

What a column means comes from its name where there is a header, otherwise from how many there are.
"""

import io
import re
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import FileFormatError
from clsurf.surface.cloud import PointCloud

from ..surface.arrays import lengths_of
from .colors import as_rgba8
from .rows import digits_of, world_of, write_rows

_NAMES = {"x": "x", "easting": "x", "east": "x", "y": "y", "northing": "y", "north": "y", "z": "z", "elevation": "z",
          "height": "z", "nx": "nx", "normalx": "nx", "ny": "ny", "normaly": "ny", "nz": "nz", "normalz": "nz",
          "r": "red", "red": "red", "g": "green", "green": "green", "b": "blue", "blue": "blue", "a": "alpha",
          "alpha": "alpha", "i": "intensity", "intensity": "intensity", "reflectance": "intensity",
          "scalarintensity": "intensity", "class": "classification", "classification": "classification"}
_NORMAL, _COLOR = ("nx", "ny", "nz"), ("red", "green", "blue")
_HEAD = 1 << 16  # bytes looked at to find header and separator


def read_text(path: Path) -> PointCloud:
    """Read XYZ, PTS, CSV and their kin: one point a line, columns apart by spaces, tabs, commas or semicolons.

    Lines may start with a comment sign (# // % ; !), the first line may name the columns or, in PTS, count the points.
    Without names, columns beyond x y z are: 1 intensity; 3 normals if of unit length, otherwise colour; 4 intensity
    and colour; 6 both normals and colour; any other number is kept as attributes. Semicolons allow decimal commas.

    Raises
    ------
    FileFormatError
        No numbers, fewer than three columns, lines of different kinds, or fewer points than a PTS file counts.
    """
    data = path.read_bytes()
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = data.decode("utf-16", "replace").encode("utf-8")
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\0" in data[:_HEAD]:
        raise FileFormatError(f"{path}: expected text, got binary data")
    start, separator, names, count = _look(path, data)
    body = data[start:]
    if separator == ";" and b"," in body[:_HEAD]:
        body = body.replace(b",", b".")
    table = _parse(path, body, separator, names, counted=count is not None)
    if count is not None and len(table) < count:
        raise FileFormatError(f"{path}: truncated: its first line counts {count:,} points, got {len(table):,}")
    return cloud_of_table(path, table, names)


def _look(path, data: bytes) -> tuple[int, str | None, list[str] | None, int | None]:
    """Return where the points start, the separator (None: white space), column names and the count of a PTS file."""
    at, names, count = 0, None, None
    while at < len(data):
        end = data.find(b"\n", at)
        end = len(data) if end < 0 else end
        if end - at > _HEAD:
            raise FileFormatError(f"{path}: expected lines of numbers, got a line of {end - at:,} bytes")
        line = data[at:end].decode("utf-8", "replace").strip()
        bare = re.sub(r"^(#|//|%|!|;)+\s*", "", line)
        separator = ";" if ";" in bare else "\t" if "\t" in bare.strip() else "," if "," in bare else None
        words = [w.strip().strip('"') for w in (bare.split(separator) if separator else bare.split())]
        if separator == "\t":
            separator, words = None, bare.replace('"', "").split()
        if line and bare == line and all(_number(w) or not w for w in words):
            if len(words) == 1 and words[0].isdigit() and count is None:
                count = int(words[0])
            else:
                return at, separator, names, count
        elif line and {"x", "y", "z"} <= {_NAMES.get(_plain(w)) for w in words}:
            names = words
        elif line and bare == line:
            if sum(map(_number, words)) >= 3:
                return at, separator, names, count  # words among the numbers, such as a label
            if names is not None or count is not None or at > 8 * _HEAD:
                raise FileFormatError(f"{path}: expected lines of numbers, got {line[:60]!r}")
        at = end + 1
    raise FileFormatError(f"{path}: no line of numbers")


def _parse(path, body: bytes, separator, names, counted: bool) -> NDArray:
    """Return the table (n, columns) float64; columns that hold words are NaN."""
    first = body[:body.find(b"\n") if b"\n" in body else len(body)].decode("utf-8", "replace")
    words = [w.strip() for w in (first.split(separator) if separator else first.split())]
    while words and not words[-1] and (names is None or len(words) > len(names)):
        words.pop()  # a separator at the end of the line
    numbers = [i for i, w in enumerate(words) if _number(w) or not w]
    if len(numbers) < 3:
        raise FileFormatError(f"{path}: expected at least three columns of numbers, got {first[:60]!r}")
    if names is not None and len(names) < len(words):
        raise FileFormatError(f"{path}: expected {len(names)} columns as the header names them, got {len(words)}")
    options = {"delimiter": separator, "comments": ["#", "//", "%", "!"], "ndmin": 2}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            table = np.loadtxt(io.BytesIO(body), usecols=numbers, **options)
        except (ValueError, IndexError, OverflowError):
            table = _parse_slowly(path, body, separator, numbers, counted)
    out = np.full((len(table), len(words)), np.nan)
    out[:, numbers] = table
    return out


def _parse_slowly(path, body: bytes, separator, numbers, counted: bool) -> NDArray:
    """Return the same for tables with empty fields (NaN), counts between the blocks, or a bad line, which is named."""
    rows = []
    for line in body.decode("utf-8", "replace").splitlines():
        line = re.split(r"#|//|%|!", line, maxsplit=1)[0].strip()
        words = [w.strip() for w in (line.split(separator) if separator else line.split())]
        if not line or (counted and len(words) == 1 and words[0].isdigit()):
            continue
        try:
            rows.append([float(words[i]) if words[i] else np.nan for i in numbers])
        except (ValueError, IndexError):
            raise FileFormatError(f"{path}: expected {len(numbers)} numbers in point {len(rows) + 1:,}, "
                                  f"got {line[:60]!r}") from None
    return np.array(rows, np.float64).reshape(-1, len(numbers))


def cloud_of_table(path, table: NDArray, names: list[str] | None = None) -> PointCloud:
    """Return the cloud of a table (n, columns) of numbers; `names` are the columns' names if there are any.

    Raises
    ------
    FileFormatError
        Fewer than three columns, or no rows.
    """
    if table.ndim != 2 or table.shape[1] < 3 or not len(table):
        raise FileFormatError(f"{path}: expected rows of at least three numbers, got shape {table.shape}")
    names = _guess(table) if names is None else [_NAMES.get(_plain(n), n) for n in names[:table.shape[1]]]
    columns: dict[str, NDArray] = {}
    for name, column in zip(names, table.T, strict=False):
        if name:
            columns.setdefault(name, column)
    columns = {n: c for n, c in columns.items() if n in "xyz" or not np.isnan(c).all()}
    if not {"x", "y", "z"} <= set(columns):
        raise FileFormatError(f"{path}: expected the columns x, y, z, got {', '.join(columns)}")
    take = lambda wanted: np.stack([columns.pop(n) for n in wanted], axis=1)  # noqa: E731
    with np.errstate(all="ignore"):
        points = take("xyz").astype(table.dtype if table.dtype == np.float32 else np.float64)
        normals = take(_NORMAL).astype(np.float32) if set(_NORMAL) <= set(columns) else None
        colors = None
        if set(_COLOR) <= set(columns):
            colors = take((*_COLOR, "alpha") if "alpha" in columns else _COLOR)
            # Whole numbers are a scale of 255: a dark picture may hold nothing above 1.
            whole = (colors == np.floor(colors)).all()
            colors = as_rgba8(colors.clip(0, 65535).astype(np.uint16) if whole else colors)
        rest = {n: np.ascontiguousarray(c, np.float32) for n, c in columns.items()}
    return PointCloud(points, normals, colors, attributes=rest)


def _guess(table: NDArray) -> list[str]:
    """Name the columns of a table without a header by their number."""
    extra = table.shape[1] - 3
    unit = lambda at: _mostly_unit(table[:, at:at + 3])  # noqa: E731
    if extra == 3:
        names = _NORMAL if unit(3) else _COLOR
    elif extra == 6:
        names = _COLOR + _NORMAL if unit(6) and not unit(3) else _NORMAL + _COLOR
    elif extra in (1, 4):
        # Four: x y z intensity r g b, as PTS has it, or a colour with alpha behind a normal-less point.
        names = ("intensity", *_COLOR)[:extra]
    elif extra == 7:
        names = ("intensity", *_COLOR, *_NORMAL)
    else:
        names = tuple(f"column{i + 4}" for i in range(extra))
    return ["x", "y", "z", *names]


def _mostly_unit(vectors: NDArray) -> bool:
    sample = vectors[:: max(1, len(vectors) // 1000)]
    with np.errstate(all="ignore"):
        return bool(np.mean(np.abs(lengths_of(sample) - 1) < 0.02) > 0.9)


def _plain(word: str) -> str:
    """Reduce `Normal X`, `x [m]` or `Scalar_Intensity` to normalx, x, scalarintensity."""
    return re.sub(r"[^a-z]", "", re.sub(r"[\[(].*", "", word.lower()))


def _number(word: str) -> bool:
    try:
        float(word.replace(",", "."))
    except ValueError:
        return False
    return True


def write_text(scan, path: Path) -> None:
    """Write world positions, normals, colours and attributes as text: .pts with count and intensity, .csv with commas.

    The first line names the columns (.pts: counts the points, then always x y z intensity, and r g b with colours).
    """
    ending = path.suffix.lower()
    world = world_of(scan)
    parts = [(list("xyz"), world, digits_of(scan))]
    attributes = {n: np.asarray(a) for n, a in scan.attributes.items() if np.ndim(a) == 1 and len(n.split()) == 1}
    colors = None if scan.colors is None else scan.colors if (scan.colors[:, 3] < 255).any() else scan.colors[:, :3]
    if ending == ".pts":
        intensity = attributes.get("intensity", np.zeros(len(world)))
        parts.append((["intensity"], intensity[:, None], "%.9g"))
        colors = None if colors is None else colors[:, :3]
    elif scan.normals is not None:
        parts.append((list(_NORMAL), scan.normals, "%.9g"))
    if colors is not None:
        parts.append(([*_COLOR, "alpha"][:colors.shape[1]], colors, "%d"))
    if ending != ".pts":
        parts += [([name], value[:, None], "%.9g") for name, value in attributes.items()]
    separator = "," if ending == ".csv" else " "
    names = [name for part in parts for name in part[0]]
    header = f"{len(world)}" if ending == ".pts" else ("" if ending == ".csv" else "# ") + separator.join(names)
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.write(header + "\n")
        write_rows(file, [(values, form) for _, values, form in parts], separator=separator)
