"""What is asked of a picture: every option checked, and what follows from them for the stages."""

from dataclasses import dataclass

from ..errors import InputError
from .average import fine_channels
from .backdrop import Backdrop, checked_background
from .checked import checked_channels, checked_lod, checked_size
from .clip import checked_clip
from .coverage import checked_antialias, edge_channels
from .differentials import wanted_differentials
from .mirror import CHANNELS as MIRROR_CHANNELS
from .mirror import wants_mirror
from .patch_drawing import PatchDrawing
from .point_drawing import PointDrawing
from .scale_map_drawing import ScaleMapDrawing
from .scene import Scene, as_scene
from .shade import CHANNELS, Shading
from .slim_drawing import SlimDrawing
from .surfel_drawing import SurfelDrawing

# Made and checked once: 14 us.
DEFAULT_SHADING = Shading()
DEFAULT_DRAWINGS = {"patches": PatchDrawing(), "slim": SlimDrawing(), "surfels": SurfelDrawing(),
                    "scale_map": ScaleMapDrawing(), "points": PointDrawing()}


@dataclass(frozen=True, eq=False)
class Request:
    """What a picture shall show, and how; see `Renderer.render` for the options.

    Attributes
    ----------
    scene : Scene
    size : (int, int)
        Width and height in pixels.
    factor : int
        Samples along each side of a pixel.
    channels : tuple of str
        Of the frame, in its order.
    sampled : list of str
        Channels that are written for each sample: also those that mirrors, edges and means need.
    kept : list of str
        Those of `channels` that are in `CHANNELS`.
    curved : tuple of str
        What is asked of curvature.
    covered : bool
        Whether pixels at edges are drawn again, finer.
    mirrored : bool
        Whether materials reflect the scene.
    back : Backdrop
    drawings : dict
        Name of a kind to how it is drawn.
    clip : (n, 4) float64 array
    """

    scene: Scene
    size: tuple[int, int]
    factor: int
    channels: tuple[str, ...]
    sampled: list[str]
    kept: list[str]
    curved: tuple
    covered: bool
    mirrored: bool
    shading: Shading
    lod: float
    back: Backdrop
    drawings: dict
    clip: object

    def samples(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return how many samples a picture of `size` has, across and down."""
        return size[0] * self.factor, size[1] * self.factor


def checked_request(scene, size, channels, shading, lod, background, supersampling, drawings: dict, clip,
                    antialias) -> Request:
    """Return a `Request` of the options of `Renderer.render`, or raise InputError."""
    scene, size, asked, lod = as_scene(scene), checked_size(size), checked_channels(channels), checked_lod(lod)
    (factor, covered), clip = checked_antialias(antialias, supersampling), checked_clip(clip)
    checked_size([n * factor for n in size])
    fine = fine_channels(asked, factor)
    sampled, kept = ([name for name in names if name in CHANNELS] for names in (fine, asked))
    shading = checked_shading(shading)
    covered = covered and "color" in sampled
    if covered:
        sampled = edge_channels(sampled, len(scene.surfaces))
    back = checked_background(background, scene)
    mirrored = wants_mirror(scene, shading, sampled)
    if mirrored:
        sampled = list(dict.fromkeys([*sampled, *MIRROR_CHANNELS]))
    return Request(scene, size, factor, asked, sampled, kept, wanted_differentials(fine), covered, mirrored, shading,
                   lod, back, {name: checked_drawing(name, given) for name, given in drawings.items()}, clip)


def checked_shading(shading) -> Shading:
    """Return a `Shading`, of the look that is named or the default where nothing is given, or raise InputError."""
    shading = DEFAULT_SHADING if shading is None else Shading(look=shading) if isinstance(shading, str) else shading
    if not isinstance(shading, Shading):
        raise InputError(f"shading: expected a clsurf.Shading or the name of a look, got {shading!r}")
    return shading


def checked_drawing(name: str, given):
    """Return how a kind is drawn, the default where nothing is given, or raise InputError."""
    drawing = DEFAULT_DRAWINGS[name] if given is None else given
    kind = type(DEFAULT_DRAWINGS[name])
    if not isinstance(drawing, kind):
        raise InputError(f"{name}: expected a clsurf.{kind.__name__}, got {drawing!r}")
    return drawing
