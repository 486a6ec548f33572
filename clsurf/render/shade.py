"""Shading: how all surfaces look, the background, and the last stage, which writes the channels of the picture."""

from dataclasses import dataclass, field
from functools import lru_cache
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from ..surface.srgb import linear_color
from .differentials import NAME
from .light import LIGHT_FLOATS, checked_numbers, light_floats
from .light import Light as Light
from .material import LOOKS as MATERIAL_LOOKS
from .material import check_looks
from .patch_drawing import PatchDrawing
from .point_drawing import PointDrawing
from .scale_map_drawing import ScaleMapDrawing
from .slim_drawing import SlimDrawing
from .surfel_drawing import SurfelDrawing
from .tiles import BIN, Grid, Scratch

CHANNELS = {"color": (4, np.float32), "depth": (0, np.float32), "normal": (3, np.float32), "position": (3, np.float32),
            "id": (0, np.int32), "count": (0, np.int32), "level": (0, np.int32), "cost": (0, np.int32)}
LOOKS = (*MATERIAL_LOOKS, "ball_size", "ball_level")
HEAD_FLOATS = 16  # of the shading buffer, before its lamps
STREAMED_BYTES = 8 << 20  # pictures larger than this are stored past the caches
SPAN = 128  # pixels of a row of bins that one work-item shades


@dataclass(frozen=True, eq=False)
class Shading:
    """How surfaces look; `Scene(materials=)` says it for each by itself.

    Parameters
    ----------
    look : str
        "phong"; "physical", "matcap", "normal": see `Material`; "flat": colours without light; "reflection":
        reflection lines, level lines of the mirrored direction to the eye that run across the picture (paper,
        figures 2 and 17; use supersampling); "ball_size", "ball_level": the surfels' balls coloured by size or by
        level (paper, figures 1 and 7), whatever the surfaces' materials.
    level : int, optional
        With "ball_level": draw the surface as it is built up to this level, the leaves up to there pink and the
        level's internal surfels blue (figure 7); None draws the chosen surfels, coloured by level.
    color : (3,) float
        sRGB colour, 0 to 1, of surfaces that have none.
    ambient : float
        Light from all sides, where the scene has no image light.
    diffuse, specular : float
    shininess : int
        Exponent of the highlight (Blinn-Phong).
    model_colors : bool
        Use the colours that a surface carries.
    stripes : float
        With "reflection": dark lines on a sphere.
    metallic, roughness : float
        With "physical"; see `Material`.
    matcap : str, path or array
        With "matcap"; see `Material`.
    shadows : bool
        With "phong" and "physical": the scene's lights throw hard shadows, but for a headlight, which has none, and an
        image, whose shadows are its occlusion. All surfaces and meshes throw and receive them (patches that
        `PatchDrawing` lights at their nodes receive none), clouds and range images receive them only.
    occlusion : int
        With "phong" and "physical": directions above a surface along which ambient occlusion looks for SLIM surfaces
        (32 to 256); what an image light sends along those that are open is the part of its light that is seen,
        without one their part multiplies `ambient`, so give that more weight. 0: none.
    occlusion_reach : float, optional
        How far ambient occlusion looks, world units; by default a quarter of the scene's diagonal.
    mirror : float or sequence of float
        With "phong" and "physical": the share, 0 to 1, of mirror reflection (one bounce) in the colour of all surfaces,
        or of each surface of the scene in turn.
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
    metallic: float = 0.0
    roughness: float = 0.5
    matcap: str | PathLike | NDArray = "clay"

    def __post_init__(self):
        if self.look not in LOOKS:
            raise InputError(f"shading look: expected one of {', '.join(LOOKS)}, got {self.look!r}")
        checked_numbers("shading color", self.color, 3)
        checked_numbers("shading ambient", self.ambient, 0)
        check_looks("shading", self)
        if not isinstance(self.occlusion, int | np.integer) or not 0 <= self.occlusion <= 1024:
            raise InputError("shading occlusion: expected a whole number of directions from 0 to 1024, got "
                             f"{self.occlusion!r}")
        if self.occlusion_reach is not None:
            checked_numbers("shading occlusion_reach", self.occlusion_reach, 0)
        shares = np.asarray(self.mirror)
        if shares.ndim > 1 or shares.dtype.kind not in "fiu" or not ((shares >= 0) & (shares <= 1)).all():
            raise InputError("shading mirror: expected a share from 0 to 1, or one for each surface, got "
                             f"{self.mirror!r}")


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
    points: PointDrawing = field(default_factory=PointDrawing)


def shading_floats(shading: Shading, lights, background, camera) -> np.ndarray:
    """Return the shading buffer of kernels/render/shade.cl; positions and directions in view space.

    `background` is sRGB with straight alpha, 3 or 4 values from 0 to 1. The result is read-only: under headlights alone
    it does not depend on the camera and is looked up.
    """
    if all(light.kind == "headlight" for light in lights):
        try:
            return _same_light(shading, tuple(lights), tuple(background))
        except TypeError:  # a list among them
            pass
    return _shading_floats(shading, lights, background, camera)


@lru_cache(maxsize=64)
def _same_light(shading, lights, background):
    return _shading_floats(shading, lights, background, None)


def _shading_floats(shading, lights, background, camera):
    back = np.asarray(background, np.float64)
    if back.shape not in ((3,), (4,)) or not np.isfinite(back).all():
        raise InputError(f"background: expected 3 or 4 numbers from 0 to 1 (sRGB, alpha), got {background}")
    alpha = back[3] if len(back) == 4 else 1.0
    lamps = light_floats(lights, camera)
    out = np.zeros(HEAD_FLOATS + LIGHT_FLOATS * len(lamps), np.float32)
    out[0:3] = linear_color(shading.color)
    out[3:8] = shading.ambient, shading.diffuse, shading.specular, shading.shininess, shading.stripes
    out[8:11], out[11] = linear_color(back[:3]) * alpha, alpha
    out[12] = len(lamps)
    out[HEAD_FLOATS:] = lamps.ravel()
    out.flags.writeable = False
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
