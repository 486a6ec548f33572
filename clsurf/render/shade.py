"""Shading: material, lights, background, and the last stage, which writes the channels of the picture."""

from dataclasses import dataclass, field

import numpy as np

from ..device import Device, DeviceArray
from ..errors import InputError
from ..surface.srgb import to_linear
from .differentials import NAME
from .patch_drawing import PatchDrawing
from .scale_map_drawing import ScaleMapDrawing
from .slim_drawing import SlimDrawing
from .surfel_drawing import SurfelDrawing
from .tiles import BIN, Grid, Scratch

CHANNELS = {"color": (4, np.float32), "depth": (0, np.float32), "normal": (3, np.float32), "position": (3, np.float32),
            "id": (0, np.int32), "count": (0, np.int32), "level": (0, np.int32), "cost": (0, np.int32)}
KINDS = {"headlight": 0, "directional": 1, "point": 2}
LOOKS = ("phong", "flat", "reflection", "ball_size", "ball_level")
STREAMED_BYTES = 8 << 20  # pictures larger than this are stored past the caches
SPAN = 128  # pixels of a row of bins that one work-item shades


@dataclass(frozen=True)
class Light:
    """A light.

    Parameters
    ----------
    kind : str
        "headlight" (at the eye), "directional" or "point".
    vector : (3,) float
        Directional: from the surface to the light, world space. Point: its position, world space.
    color : (3,) float
        Linear red, green, blue; 1 lights a white surface fully.
    """

    kind: str = "headlight"
    vector: tuple[float, float, float] = (0.0, 0.0, 1.0)
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self):
        if self.kind not in KINDS:
            raise InputError(f"light kind: expected one of {', '.join(KINDS)}, got {self.kind!r}")
        if np.shape(self.vector) != (3,) or np.shape(self.color) != (3,):
            raise InputError("light: expected a vector and a color of 3 numbers each")


@dataclass(frozen=True)
class Shading:
    """How surfaces look.

    Parameters
    ----------
    look : str
        "phong"; "flat": colours without light; "reflection": reflection lines, level lines of the mirrored direction
        to the eye that run across the picture (paper, figures 2 and 17; use supersampling); "ball_size",
        "ball_level": the surfels' balls coloured by size or by level (paper, figures 1 and 7).
    level : int, optional
        With "ball_level": draw the surface as it is built up to this level, the leaves up to there pink and the
        level's internal surfels blue (figure 7); None draws the chosen surfels, coloured by level.
    color : (3,) float
        sRGB colour, 0 to 1, of surfaces that have none.
    ambient, diffuse, specular : float
    shininess : int
        Exponent of the highlight (Blinn-Phong).
    model_colors : bool
        Use the colours that a surface carries.
    stripes : float
        With "reflection": dark lines on a sphere.
    shadows : bool
        With "phong": the scene's lights throw hard shadows, but for a headlight, which has none. All surfaces throw
        and receive them (patches that `PatchDrawing` lights at their nodes receive none).
    occlusion : int
        With "phong": directions above a surface along which ambient occlusion looks for SLIM surfaces (32 to 256); the
        part of them that is open multiplies `ambient`, so give that more weight. 0: none.
    occlusion_reach : float, optional
        How far ambient occlusion looks, world units; by default a quarter of the scene's diagonal.
    mirror : float or sequence of float
        With "phong": the share, 0 to 1, of mirror reflection (one bounce) in the colour of all surfaces, or of each
        surface of the scene in turn.
    """

    look: str = "phong"
    level: int | None = None
    color: tuple[float, float, float] = (0.80, 0.78, 0.74)
    ambient: float = 0.12
    diffuse: float = 0.85
    specular: float = 0.15
    shininess: int = 40
    model_colors: bool = True
    stripes: float = 6.0
    shadows: bool = False
    occlusion: int = 0
    occlusion_reach: float | None = None
    mirror: float | tuple[float, ...] = 0.0

    def __post_init__(self):
        if self.look not in LOOKS:
            raise InputError(f"shading look: expected one of {', '.join(LOOKS)}, got {self.look!r}")
        checks = [("color", 3), ("ambient", 0), ("diffuse", 0), ("specular", 0), ("shininess", 0), ("stripes", 0)]
        for name, count in checks:
            _checked_numbers(name, getattr(self, name), count)
        if self.shininess != int(self.shininess) or not 0 <= self.shininess <= 4096:
            raise InputError(f"shading shininess: expected a whole number from 0 to 4096, got {self.shininess}")
        if not 0 < self.stripes <= 4096:
            raise InputError(f"shading stripes: expected a number over 0, at most 4096, got {self.stripes}")
        if not isinstance(self.occlusion, int | np.integer) or not 0 <= self.occlusion <= 1024:
            raise InputError("shading occlusion: expected a whole number of directions from 0 to 1024, got "
                             f"{self.occlusion!r}")
        if self.occlusion_reach is not None:
            _checked_numbers("occlusion_reach", self.occlusion_reach, 0)
        shares = np.asarray(self.mirror)
        if shares.ndim > 1 or shares.dtype.kind not in "fiu" or not ((shares >= 0) & (shares <= 1)).all():
            raise InputError("shading mirror: expected a share from 0 to 1, or one for each surface, got "
                             f"{self.mirror!r}")


def _checked_numbers(name, value, count) -> None:
    """Raise InputError unless `value` is `count` finite numbers (0: one number)."""
    try:
        wrong = np.shape(value) != ((count,) if count else ()) or not np.isfinite(np.asarray(value, np.float64)).all()
    except (TypeError, ValueError):
        wrong = True
    if wrong:
        raise InputError(f"shading {name}: expected {f'{count} numbers' if count else 'a number'}, got {value!r}")


@dataclass(frozen=True)
class Look:
    """Everything but the view that decides how the surfaces of a frame are drawn; see `Renderer.render`."""

    shading: Shading
    lod: float
    patches: PatchDrawing
    slim: SlimDrawing
    surfels: SurfelDrawing = field(default_factory=SurfelDrawing)
    scale_map: ScaleMapDrawing = field(default_factory=ScaleMapDrawing)
    lamps: DeviceArray | None = None  # the shading buffer, for what is lit before the last stage
    cost: bool = False  # whether the frame wants the costs of bins


def shading_floats(shading: Shading, lights, background, camera) -> np.ndarray:
    """Return the shading buffer of kernels/render/shade.cl; positions and directions in view space.

    `background` is sRGB with straight alpha, 3 or 4 values from 0 to 1.
    """
    back = np.asarray(background, np.float64)
    if back.shape not in ((3,), (4,)) or not np.isfinite(back).all():
        raise InputError(f"background: expected 3 or 4 numbers from 0 to 1 (sRGB, alpha), got {background}")
    alpha = back[3] if len(back) == 4 else 1.0
    out = np.zeros(16 + 8 * len(lights), np.float32)
    out[0:3] = to_linear(shading.color)
    out[3:8] = shading.ambient, shading.diffuse, shading.specular, shading.shininess, shading.stripes
    out[8:11], out[11] = to_linear(back[:3]) * alpha, alpha
    out[12] = len(lights)
    for i, light in enumerate(lights):
        vector = np.asarray(light.vector, np.float64)
        if light.kind == "directional":
            vector = camera.rotation @ vector / max(np.linalg.norm(vector), 1e-300)
        elif light.kind == "point":
            vector = camera.rotation @ (vector - camera.eye)
        out[16 + 8 * i:24 + 8 * i] = KINDS[light.kind], *vector, *light.color, 0
    return out


def shade_constants(grid: Grid, look: str, channels) -> dict[str, int]:
    """Return the constants of kernels/render/shade.clh."""
    values = sum(max(CHANNELS[name][0], 1) for name in channels) + grid.layout.differential_planes
    pixels = values * grid.size[0] * grid.size[1]
    return {f"WRITE_{name.upper()}": name in channels for name in ("color", "depth", "normal", "position", "cost")} | {
        "LIT": look != "flat", "REFLECTION": look == "reflection", "STREAMED": 4 * pixels > STREAMED_BYTES}


def new_channels(device: Device, size: tuple[int, int], channels, differentials: int = 0) -> dict[str, DeviceArray]:
    """Return room for the channels of a picture by name, and for `differentials` planes of curvature."""
    out = {}
    for name in channels:
        parts, dtype = CHANNELS[name]
        out[name] = device.empty((size[1], size[0], parts) if parts else (size[1], size[0]), dtype)
    if differentials:
        out[NAME] = device.empty((differentials, size[1], size[0]), np.float32)
    return out


def shade(device: Device, scratch: Scratch, grid: Grid, view: DeviceArray, lamps: DeviceArray, look: str,
          channels) -> dict[str, DeviceArray]:
    """Write the channels of the picture from the grid's planes; return them by name, on the device.

    `channels` are of `CHANNELS`; those of curvature, which the grid's layout names, come in one array.
    """
    width, height = grid.size
    out = new_channels(device, grid.size, channels, grid.layout.differential_planes)
    constants = grid.layout.constants | {"VW": scratch.lanes, "SPAN": SPAN} | shade_constants(grid, look, channels)
    items = (width, height) if scratch.lanes == 1 else (-(-width // SPAN), -(-height // BIN))
    unused = scratch.array("unused", (4,), np.float32)
    device.kernel("render/shade.cl", constants=constants)(
        items, (8, 8) if scratch.lanes == 1 else (1, 1), view, lamps, grid.planes, grid.touched, grid.bins_x, width,
        height, *(out.get(name, unused) for name in (*CHANNELS, NAME)))
    return out
