"""One HTML page about a scene and a view of it: counts, operations, times, pictures, with nothing to fetch."""

import base64
import time
from collections.abc import Callable
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from ..device import Profile, open_device
from ..errors import InputError
from ..io.files import replacing
from ..io.images import png_bytes, to_srgb8
from ..render.camera import Camera
from ..render.checked import checked_lod, checked_size
from ..render.frame import Frame
from ..render.patch_drawing import PatchDrawing
from ..render.renderer import Renderer
from ..render.scale_map_drawing import ScaleMapDrawing
from ..render.scene import Scene, as_scene
from ..render.surfel_drawing import SurfelDrawing
from ..render.tiles import BIN
from ..surface.patch import PatchSurface
from ..surface.placed import Placed
from ..surface.scale_map import ScaleMap
from ..surface.slim import SlimSurface
from ..surface.surfel import SurfelHierarchy
from .charts import bars
from .scale_map import scale_map_sections
from .sections import Section, View, patch_sections, slim_sections, table
from .style import PAGE
from .surfels import surfel_sections

# What a report says of a surface, by its kind: a function from (surface or placed surface, view, number) to sections.
SECTIONS: dict[type, Callable[..., list[Section]]] = {PatchSurface: patch_sections, SlimSurface: slim_sections,
                                                       SurfelHierarchy: surfel_sections, ScaleMap: scale_map_sections}
CHANNELS = ("color", "depth", "id", "count", "level", "cost")
FRAMES = 9  # drawn for the times, after one that compiles the kernels and uploads the surfaces


@dataclass(frozen=True, eq=False)
class Times:
    """Times of frames of one view."""

    first: float  # seconds: kernels compiled or read, surfaces uploaded
    frames: list[float]  # seconds of the frames after it
    profile: Profile  # of as many frames whose launches wait for one another


def report(scene, path, camera: Camera | None = None, size: tuple[int, int] = (500, 500), title: str = "",
           lod: float = 4.0, patches: PatchDrawing | None = None, surfels: SurfelDrawing | None = None,
           scale_map: ScaleMapDrawing | None = None, device=None) -> None:
    """Write one self-contained HTML page about a scene and a view of it.

    Counts of the model and of what the view touches, for spatial patches the paper's statistics (section 5, Table 3)
    and operations by mode, the time of a frame and of its stages, and the picture. The page appears whole or not at
    all, and fetches nothing.

    Parameters
    ----------
    scene : Scene, surface, placed surface, or list of those
    path : path-like
        .html or .htm.
    camera : Camera, optional
        By default one that frames the scene.
    size : (int, int)
        Width and height of the picture in pixels.
    title : str
        By default the kinds of the surfaces.
    lod : float
        As in `render`, pixels.
    patches : PatchDrawing, optional
        How spatial patches are drawn.
    surfels : SurfelDrawing, optional
        How surfel hierarchies are drawn.
    scale_map : ScaleMapDrawing, optional
        How scale maps are drawn.
    device : str, Device, ..., optional

    Raises
    ------
    InputError
        An option that cannot be used, or a place that cannot be written.
    """
    scene, size, lod = as_scene(scene), checked_size(size), checked_lod(lod)
    if not str(path).lower().endswith((".html", ".htm")):
        raise InputError(f"{path}: expected a name that ends in .html or .htm")
    with replacing(path) as temporary:
        opened = open_device(device)
        if camera is None:
            box = scene.bounds if np.isfinite(scene.bounds).all() else np.array([[-1.0] * 3, [1.0] * 3])
            camera = Camera.framing(scene if np.isfinite(scene.bounds).all() else box, aspect=size[0] / size[1])
        frame, times = measured(scene, camera, size, lod, opened, patches=patches, surfels=surfels,
                                scale_map=scale_map)
        view = View(camera, size, frame)
        name = title or ", ".join(type(_own(s)).__name__ for s in scene.surfaces) or "an empty scene"
        sections = [_overview(scene, view, times, opened)]
        for number, surface in enumerate(scene.surfaces):
            several = f"{number}: " if len(scene.surfaces) > 1 else ""
            sections += [Section(several + s.title, s.html) for s in
                         SECTIONS[type(_own(surface))](surface, view, number)]
        sections.append(_stages(times))
        temporary.write_text(page(name, sections), encoding="utf-8")


def measured(scene: Scene, camera: Camera, size, lod: float, device, **drawing) -> tuple[Frame, Times]:
    """Return a frame with `CHANNELS`, and the times of frames with "color" and "depth" alone."""
    with Renderer(device) as renderer:
        def draw(channels=("color", "depth")) -> tuple[Frame, float]:
            start = time.perf_counter()
            frame = renderer.render(scene, camera, size, channels, lod=lod, **drawing)
            return frame, time.perf_counter() - start
        first = draw()[1]
        frames = [draw()[1] for _ in range(FRAMES)]
        renderer.profile = Profile()
        for _ in range(FRAMES):
            draw()
        profile, renderer.profile = renderer.profile, None
        return draw(CHANNELS)[0], Times(first, frames, profile)


def page(title: str, sections: list[Section]) -> str:
    """Return the whole document."""
    body = "\n".join(f"<section><h2>{escape(s.title)}</h2>\n{s.html}</section>" for s in sections)
    return PAGE.format(title=escape(title), body=body)


def picture(pixels: NDArray, says: str) -> str:
    """Return `pixels` (h, w, 4) uint8 sRGB as an image inside the page, with the text that stands for it."""
    data = base64.b64encode(png_bytes(pixels)).decode()
    return (f'<figure><img src="data:image/png;base64,{data}" width="{pixels.shape[1]}" height="{pixels.shape[0]}" '
            f'alt="{escape(says)}"><figcaption>{escape(says)}</figcaption></figure>')


def heat(values: NDArray, shown: NDArray) -> NDArray:
    """Return values (h, w) as colours (h, w, 4) uint8, dark blue over red to light yellow; transparent elsewhere."""
    stops = np.array([[10, 10, 50], [110, 20, 110], [220, 60, 60], [255, 160, 30], [255, 245, 180]], float)
    top = float(np.percentile(values[shown], 99)) if shown.any() else 1.0
    at = np.clip(values / max(top, 1e-9), 0, 1) * (len(stops) - 1)
    out = np.zeros((*values.shape, 4), np.uint8)
    for c in range(3):
        out[..., c] = np.interp(at, np.arange(len(stops)), stops[:, c])
    out[..., 3] = 255 * shown
    return out


def _overview(scene: Scene, view: View, times: Times, device) -> Section:
    from .. import __version__
    frame, shown = view.frame, view.frame.id >= 0
    width, height = view.size
    middle = float(np.median(times.frames))
    rows = [("Surfaces", "; ".join(map(repr, scene.surfaces)) or "none"), ("Camera", repr(view.camera)),
            ("Picture", f"{width} x {height} pixels, {shown.sum():,} of them ({shown.mean():.1%}) show a surface"),
            ("Frame", f"{1e3 * middle:.2f} ms, the median of {FRAMES}, {1 / middle:.0f} a second; the first, with its "
                      f"kernels and uploads, {1e3 * times.first:.0f} ms"),
            ("Device", f"{device.name} ({device.platform_name}, {device.driver})"), ("clsurf", __version__)]
    cost = frame.cost / BIN ** 2  # the channel counts for all pixels of a bin
    work = f"tests and evaluations per pixel: mean {cost[shown].mean():.1f}, brightest from " \
           f"{np.percentile(cost[shown], 99):.3g} up" if shown.any() else "nothing to see"
    pictures = picture(to_srgb8(frame.color), "the view") + picture(heat(cost, shown), work)
    return Section("Overview", table((), rows) + f'<div class="pictures">{pictures}</div>')


def _stages(times: Times) -> Section:
    rows = times.profile.rows()
    chart = bars([(label, share, f"{share:.1%}") for label, _, _, _, share in rows],
                 "share of the device's time by stage")
    numbers = table(("Stage", "launches a frame", "median, ms", "share"),
                    [(label, f"{calls / FRAMES:.3g}", f"{median:.3f}", f"{share:.1%}")
                     for label, calls, _, median, share in rows])
    total = sum(map(sum, times.profile.seconds.values())) / FRAMES
    return Section("Time by stage", f"<p>{1e3 * total:.2f} ms a frame when every launch waits for the one before, as "
                                    f"it must to be timed.</p>{chart}{numbers}")


def _own(surface):
    return surface.surface if isinstance(surface, Placed) else surface
