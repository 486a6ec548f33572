"""The Earth as spatial patches, from a colour map, from elevations, from both, or made up."""

import gzip
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..build.quantize import quantized
from ..errors import FileFormatError, InputError
from ..io.files import existing_file
from ..io.images import read_image
from ..surface.arrays import lengths_of
from ..surface.patch import PatchSurface
from ..surface.srgb import LINEAR_OF_BYTE, to_linear, to_srgb
from .continents import continents, tinted
from .rows import latitude_rows
from .sphere_map import SphereMap

_LEVELS = np.array([0.0, 0.3, 0.5, 0.75, 1.0])  # sea, plateaus, ice and drier land, low and high mountains
_SOLVED = 1e-7  # radii


def earth(patches: int = 1128, color=None, elevation=None, radius: float = 128.0, relief: float = 0.03,
          nodes: int = 17, precise: bool = False, seed: int = 7) -> PatchSurface:
    """Return the Earth about the origin as spatial patches, its relief exaggerated.

    +y is the north pole, +z longitude 0, +x 90 degrees east. Patches stand in rows of equal latitude and overlap by
    more than a cell; each node's height and colour is read from the maps, smoothed to the node spacing.

    Parameters
    ----------
    patches : int
        At least 32; the paper's models have 383, 1128 and 2712.
    color : path-like or (h, w, 3 or 4) uint8, optional
        Colours over the whole sphere in the cylindrical projection: north on top, longitude -180 at the left, sRGB.
    elevation : path-like, (h, w) array or (heights, latitudes, longitudes), optional
        Heights over the whole sphere, metres or any other unit, placed as `color`; what lies at most at 0 is sea and
        flat. With latitudes (h,) and longitudes (w,), in degrees, the rows and columns may come in another order, as
        in the files ``NAMEdata.gz``, ``NAMElats.gz``, ``NAMElons.gz`` (text), of which the first is given.
    radius : float
        Of the sea, world units.
    relief : float
        The highest land's height in radii, 0 to 0.2.
    nodes : int
        Nodes of a patch along each side, 5 to 256.
    precise : bool
        8 bytes a node in place of 4.
    seed : int
        Which made-up continents.

    Returns
    -------
    PatchSurface
        `bound` is the largest difference between its cells' middles and the smoothed map.

    Raises
    ------
    InputError, FileFormatError
        A number out of range, or a map that cannot be read.

    Notes
    -----
    The paper on spatial patches, section 4.2. With a colour map alone heights follow its rule: blue sea is flat, green
    land plateaus, brown land mountains, by levels that are then smoothed. With elevations alone colours follow height
    and latitude; with neither, continents are made up by noise. The paper resamples a displaced mesh of 40,000
    triangles; here the nodes are put onto the displaced sphere directly, which keeps what lies between that mesh's
    vertices, 1.4 times as far apart as the nodes of 1128 patches.
    """
    _check(radius, relief, nodes)
    frames, half_width = latitude_rows(patches)
    cells = nodes - 1
    half = half_width * (1 + relief) * cells / (cells - 1)  # half a cell to spare on each side
    spacing = 2 * half / cells  # radii
    colors, heights = _maps(color, elevation, spacing, seed)
    heights = SphereMap(heights.smoothed(0.8 * spacing).values * np.float32(relief))
    colors = colors.smoothed(0.4 * spacing)

    offset = (np.arange(nodes) - cells / 2) * spacing
    local = np.stack(np.broadcast_arrays(offset[None, :], offset[:, None]), axis=-1).reshape(-1, 2)
    z, at = _on_the_surface(frames, local, heights)
    shades = _srgb8(colors.sample(at))
    corner = -half * (frames[:, 0] + frames[:, 1])
    made = dict(origins=radius * corner, axis_x=radius * spacing * frames[:, 0],
                axis_y=radius * spacing * frames[:, 1], heights=radius * z.ravel(), size=(nodes, nodes),
                colors=shades, precise=precise)
    return quantized(**made, bound=radius * _deviation(frames, local, z, heights, nodes),
                     diagonal=2 * np.sqrt(3) * radius)


def _check(radius, relief, nodes) -> None:
    if not isinstance(radius, int | float | np.number) or not 0 < radius < 1e30:
        raise InputError(f"radius: expected a positive length, got {radius!r}")
    if not isinstance(relief, int | float | np.number) or not 0 <= relief <= 0.2:
        raise InputError(f"relief: expected a height of 0 to 0.2 radii, got {relief!r}")
    if not isinstance(nodes, int | np.integer) or not 5 <= nodes <= 256:
        raise InputError(f"nodes: expected a whole number from 5 to 256, got {nodes!r}")


def _on_the_surface(frames, local, heights: SphereMap) -> tuple[NDArray, NDArray]:
    """Return where the lines through `local` (nodes, 2) along each patch's normal meet the displaced unit sphere.

    Returns
    -------
    z : (patches, nodes) float64
        Height above the plane through the sphere's centre.
    directions : (patches * nodes, 3) float64
        Unit vectors to those places.
    """
    flat = np.einsum("na,pax->pnx", local, frames[:, :2])
    squares = (local ** 2).sum(axis=1)
    z = np.broadcast_to(np.sqrt(1 - squares), flat.shape[:2])
    for _ in range(12):  # contracts by slope times tilt, at most a fifth a step
        at = flat + z[..., None] * frames[:, None, 2]
        at /= np.sqrt(squares + z * z)[..., None]
        reach = 1 + heights.sample(at.reshape(-1, 3)).reshape(z.shape).astype(np.float64)
        before, z = z, np.sqrt(reach ** 2 - squares)
        if np.abs(z - before).max() < _SOLVED:
            break
    return z, at.reshape(-1, 3)


def _deviation(frames, local, z, heights: SphereMap, nodes: int) -> float:
    """Return the largest distance from the bilinear cells' middles to the displaced unit sphere, along the radius."""
    def middles(values):
        grid = values.reshape(*values.shape[:-2], nodes, nodes, values.shape[-1])
        return (grid[..., 1:, 1:, :] + grid[..., 1:, :-1, :] + grid[..., :-1, 1:, :] + grid[..., :-1, :-1, :]) / 4

    flat = middles(local).reshape(-1, 2)
    at = np.einsum("na,pax->pnx", flat, frames[:, :2])
    at = at + middles(z[..., None]).reshape(len(frames), -1, 1) * frames[:, None, 2]
    distance = lengths_of(at, keepdims=True)
    there = 1 + heights.sample((at / distance).reshape(-1, 3))
    return float(np.abs(distance.reshape(-1) - there[:, 0]).max())


# Maps ----------------------------------------------------------------------------------------------------------------


def _maps(color, elevation, spacing: float, seed: int) -> tuple[SphereMap, SphereMap]:
    """Return linear colours and heights (1: the highest land, 0: the sea), pixels at most half a node spacing high."""
    pixel = spacing / 2
    heights = None
    if elevation is not None:
        heights = _elevation_map(elevation)
    elif color is None:
        heights = continents(int(np.clip(2 ** np.ceil(np.log2(np.pi / spacing)), 128, 512)), seed)
    if color is not None:
        colors = _color_map(color).reduced(pixel)
        heights = heights_by_color(colors) if heights is None else heights
    else:
        shown = heights.reduced(pixel)
        tints = tinted(SphereMap(shown.values / max(float(shown.values.max()), 1e-9)), seed)
        colors = SphereMap(to_linear(tints.values).astype(np.float32))
    land = np.maximum(heights.values, 0)
    return colors, SphereMap(land / max(float(land.max()), 1e-9)).reduced(pixel)


def heights_by_color(colors: SphereMap) -> SphereMap:
    """Return heights in 0...1 by the paper's rule from linear colours: blue 0, green low, brown high, by levels.

    Ice, which the paper does not speak of, is taken for a plateau. Smooth the result.
    """
    red, green, blue = np.moveaxis(to_srgb(colors.values), -1, 0)
    bright = np.maximum(np.maximum(red, green), np.maximum(blue, 1e-6))
    sea = (blue - np.maximum(red, green)) > 0.12 * bright
    sea |= bright < 0.02
    ice = ~sea & (np.minimum(red, blue) > 0.8 * bright) & (bright > 0.5)
    warm = (red - green) / bright  # below 0 green, above 0 brown
    level = np.digitize(warm, (-0.02, 0.08, 0.17)) + 1
    level[ice] = 2
    level[sea] = 0
    return SphereMap(_LEVELS[level].astype(np.float32)[..., None])


def _color_map(color) -> SphereMap:
    """Return the linear colours of a path or an array."""
    if isinstance(color, str | Path) or hasattr(color, "__fspath__"):
        pixels = read_image(color)
        if pixels.dtype == np.uint16:
            pixels = (pixels >> 8).astype(np.uint8)
    else:
        pixels = np.asarray(color)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] < 3 or min(pixels.shape[:2]) < 2:
        raise InputError(f"color: expected a picture (h, w, 3) uint8 of the whole sphere, got {pixels.dtype} "
                         f"{pixels.shape}")
    table = LINEAR_OF_BYTE.astype(np.float32)
    return SphereMap(table[pixels[..., :3]])


def _elevation_map(elevation) -> SphereMap:
    """Return the heights of a path, an array, or a tuple with latitudes and longitudes."""
    latitudes = longitudes = None
    if isinstance(elevation, str | Path) or hasattr(elevation, "__fspath__"):
        elevation = _read_elevation(existing_file(elevation))
    if isinstance(elevation, tuple):
        if len(elevation) != 3:
            raise InputError(f"elevation: expected heights, latitudes and longitudes, got {len(elevation)} arrays")
        elevation, latitudes, longitudes = elevation
    heights = np.asarray(elevation, np.float64)
    if heights.ndim != 2 or min(heights.shape) < 2 or not np.isfinite(heights).all():
        raise InputError(f"elevation: expected finite heights (h, w) of the whole sphere, got shape {heights.shape}")
    if latitudes is not None:
        heights = _ordered(heights, np.asarray(latitudes, np.float64), np.asarray(longitudes, np.float64))
    return SphereMap(heights[..., None].astype(np.float32))


def _ordered(heights, latitudes, longitudes) -> NDArray:
    """Return the heights with north on top and longitude -180 at the left, a column that comes twice left out."""
    if latitudes.shape != heights.shape[:1] or longitudes.shape != heights.shape[1:]:
        raise InputError(f"elevation: expected {heights.shape[0]} latitudes and {heights.shape[1]} longitudes, got "
                         f"{latitudes.shape} and {longitudes.shape}")
    if latitudes[0] < latitudes[-1]:
        heights = heights[::-1]
    turned = (longitudes + 180) % 360
    order = np.argsort(turned, kind="stable")
    step = 360 / len(order)
    keep = np.concatenate([[True], np.diff(turned[order]) > step / 4])
    if turned[order][-1] - turned[order][0] > 360 - step / 4:
        keep[-1] = False
    order = order[keep]
    # Columns of a grid begin anywhere; here the first one's middle lies half a column east of -180.
    shift = turned[order][0] / 360 * len(order) - 0.5
    columns = np.arange(len(order)) - shift
    whole = np.floor(columns).astype(int)
    part = columns - whole
    ring = heights[:, order]
    return ring[:, whole % len(order)] * (1 - part) + ring[:, (whole + 1) % len(order)] * part


def _read_elevation(path: Path):
    """Return what `_elevation_map` takes from a picture, a .npy file, or a (gzipped) text grid."""
    ending = path.suffix.lower()
    if ending == ".npy":
        try:
            return np.load(path, allow_pickle=False)
        except (OSError, EOFError, ValueError) as error:
            raise FileFormatError(f"{path}: expected an array of heights, got {error}") from None
    if ending not in (".gz", ".txt", ".asc", ".csv"):
        return read_image(path)[..., 0]
    heights = _read_numbers(path)
    if path.name.endswith("data.gz"):
        beside = [path.with_name(path.name.replace("data.gz", f"{kind}.gz")) for kind in ("lats", "lons")]
        if all(p.exists() for p in beside):
            return (heights, *(_read_numbers(p).ravel() for p in beside))
    return heights


def _read_numbers(path: Path) -> NDArray:
    """Return the rows of numbers of a text file, gzipped or not."""
    opened = gzip.open if path.suffix == ".gz" else open
    try:
        with opened(path, "rt", encoding="ascii") as file:
            lines = [line.replace(",", " ") for line in file if line.strip() and not line.startswith("#")]
        widths = len(lines[0].split())
        return np.fromstring(" ".join(lines), sep=" ").reshape(len(lines), widths)
    except (OSError, EOFError, ValueError, IndexError) as error:
        raise FileFormatError(f"{path}: expected rows of numbers, got {error}") from None


def _srgb8(linear: NDArray) -> NDArray:
    return np.rint(255 * to_srgb(linear)).astype(np.uint8)
