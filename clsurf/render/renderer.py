"""The renderer: a list of stages from a scene to a frame."""

import contextlib
import os
import threading
import weakref
from dataclasses import replace

import numpy as np

from ..device import Device, Profile, host_memory_bytes, open_device
from ..errors import DeviceError, DeviceMemoryError, InputError
from ..sizes import checked_budget
from ..surface.cloud import PointCloud
from ..surface.mesh import Mesh
from ..surface.patch import PatchSurface
from ..surface.ranges import RangeScan
from ..surface.scale_map import ScaleMap
from ..surface.slim import SlimSurface
from ..surface.surfel import SurfelHierarchy
from ..trace.pieces import forget
from .average import average
from .backdrop import around, lay_over
from .bands import draw_in_bands, whole_of
from .camera import Camera
from .checked import picture_bytes
from .clip import view_clip
from .coverage import FACTOR, cover_edges, edge_layout, mark_edges
from .differentials import NAME, check_differentials, split_differentials
from .eye_dome import eye_dome
from .frame import Frame
from .lighting import OWN_COLORS, prepared_lighting, surface_shading, wants_lighting
from .mesh import draw_mesh, upload_mesh
from .mirror import reflect
from .patch_drawing import PatchDrawing
from .patch_tiles import tile_bins_of_patches
from .patches import draw_patches, shade_patches, upload_patches
from .pieces import CloudPiece, draw_pieces, halves, upload_piece
from .point_drawing import PointDrawing
from .points import draw_points, is_unlit, upload_cloud
from .request import Request, checked_request
from .resident import Resident, resident_scene
from .scale_map import draw_scale_map, upload_scale_map
from .scale_map_drawing import ScaleMapDrawing
from .scene import scene_origin
from .shade import CHANNELS, Look, Shading, shade, shading_floats
from .slim import draw_slim, upload_slim
from .slim_drawing import SlimDrawing
from .surfel_drawing import SurfelDrawing
from .surfels import draw_surfels, upload_surfels
from .tiles import BIN, Grid, Scratch, same_layout, view_floats
from .traced_light import light_grid

# How each kind of surface is put on the device, and drawn into a grid.
KINDS = {SlimSurface: (upload_slim, draw_slim), PatchSurface: (upload_patches, draw_patches),
         SurfelHierarchy: (upload_surfels, draw_surfels), ScaleMap: (upload_scale_map, draw_scale_map),
         Mesh: (upload_mesh, draw_mesh), PointCloud: (upload_cloud, draw_points),
         RangeScan: (upload_cloud, draw_points), CloudPiece: (upload_piece, draw_points)}


class Renderer:
    """Draws scenes on one device; keeps uploaded surfaces and buffers between frames. One per thread.

    Parameters
    ----------
    device : str, Device, ..., optional
        See `clsurf.open_device`.
    lanes : int, optional
        Kernel form: 16, 8 or 4 vector lanes per work-item, or 1 for a work-group per tile; by default the device's.
    tile : int, optional
        Pixels across a tile, a multiple of 8; by default 32 (8 for work-groups).
    profile : bool
        Time every launch; see the attribute `profile`.
    budget : int or str
        Bytes that each `StoredSurface` may take in memory, such as "2GB".
    wait : bool
        Draw a `StoredSurface` when all that the view needs of it has been read. Otherwise a frame shows what is there,
        and `complete` says whether that is all; later frames show more.

    Attributes
    ----------
    complete : bool
        Whether the last frame shows all that it should of the stored surfaces in it, within the budget.
    profile : Profile or None
        Print it for a table of kernels and times.
    """

    def __init__(self, device=None, lanes: int | None = None, tile: int | None = None, profile: bool = False,
                 budget: int | str = "2GB", wait: bool = False):
        self.device: Device = open_device(device)
        lanes = self.device.lanes if lanes is None else lanes
        if lanes not in (16, 8, 4, 1):
            raise InputError(f"lanes: expected 16, 8, 4 or 1, got {lanes}")
        self._tile_given = tile is not None
        tile = (BIN if lanes == 1 else 32) if tile is None else tile
        if tile != int(tile) or tile <= 0 or tile % BIN:
            raise InputError(f"tile: expected a positive multiple of {BIN} pixels, got {tile}")
        self.tile_bins = int(tile) // BIN
        self.profile = Profile() if profile else None
        self._scratch: Scratch | None = Scratch(self.device, lanes)
        self._uploads = weakref.WeakKeyDictionary()
        self._residents = weakref.WeakKeyDictionary()
        self._pieces = weakref.WeakKeyDictionary()  # halves of surfaces that the device does not hold at once
        self.budget, self.wait, self.complete = checked_budget(budget), wait, True

    def render(self, scene, camera: Camera | None = None, size: tuple[int, int] = (1024, 768),
               channels=("color", "depth", "normal"), shading: Shading | None = None, lod: float = 4.0,
               background=(1.0, 1.0, 1.0, 1.0), supersampling: int = 1, patches: PatchDrawing | None = None,
               slim: SlimDrawing | None = None, surfels: SurfelDrawing | None = None,
               scale_map: ScaleMapDrawing | None = None, points: PointDrawing | None = None, clip=None,
               antialias: str = "none") -> Frame:
        """Draw a scene.

        Parameters
        ----------
        scene : Scene, surface, placed surface, or list of those
        camera : Camera, optional
            By default one that frames the scene.
        size : (int, int)
            Width and height in pixels.
        channels : sequence of str
            Of "color", "depth", "normal", "position", "id", "count", "level", "cost" (see `Frame`); "cost" is the
            number of surfel evaluations per pixel of the pixel's bin of 8x8, or that of tests of a pixel against a
            cell of a patch or a scale map. For patches "count" is 1 and "level" the mip level, 0 for the patch's own
            nodes; for scale maps 1 and the layer.
            Curvature of SLIM surfaces (float32, NaN elsewhere), from blended derivatives of the surfels (paper,
            equation 8, left), world units: "mean", "gaussian", "k1" >= "k2" (1/length; positive where the surface
            curves away from the side its stored normals point to, that of the eye where it is not oriented),
            "direction1", "direction2" (world, unit; their sign is arbitrary), "radial": the normal curvature along
            the direction to the eye in the tangent plane. With surfels of degree 3, in 1/length^2: "derivative1",
            that of k1 along direction1, "derivative2", "radial_derivative", that of "radial" along its direction.
        shading : Shading, optional
        lod : float
            Surfels that appear up to this many pixels wide are drawn in place of the finer ones below them: 4 is safe,
            8 a fast mode that shows, 0 draws the leaves only.
        background : 3 or 4 floats, two of those, str, path, array or Light
            A colour, sRGB with straight alpha, 0 to 1; two: a gradient from top to bottom; "transparent"; "sky": the
            scene's image light itself (orthographic cameras see one place of it); an image light that need not be in
            the scene; a picture, file or array (h, w, 3), that fills the frame.
        supersampling : int
            1 to 4: samples along each side of a pixel. The picture is drawn that much larger, so thresholds in pixels
            count samples; "color" is the mean, every other channel that of the sample at the pixel's centre, or, for 2
            and 4, of the nearest in depth of the four around it.
        patches, slim, surfels, scale_map, points : optional
            A `PatchDrawing`, `SlimDrawing`, `SurfelDrawing`, `ScaleMapDrawing`, `PointDrawing`: how spatial patches,
            SLIM surfaces, surfel hierarchies, scale maps, and clouds and the points of range images are drawn.
        clip : (4,) or (n, 4) array_like, optional
            Up to 8 planes a, b, c, d, world space: only what has a x + b y + c z + d >= 0 for all of them is drawn, so
            that the inside is seen. What is cut off still throws shadows and is seen in mirrors.
        antialias : str
            "none"; "coverage": the colour of pixels at edges, of outlines, depth, surfaces and creases, is the mean of
            4 x 4 samples, that of all others one sample's, a fraction of the work of "supersample", which is
            ``supersampling=4``.

        Returns
        -------
        Frame

        Raises
        ------
        InputError
            An option that cannot be used.
        DeviceError
            The renderer is closed, or the device lacks memory even for a band of the picture.
        """
        self._check_usable()
        asked = checked_request(scene, size, channels, shading, lod, background, supersampling,
                                {"patches": patches, "slim": slim, "surfels": surfels, "scale_map": scale_map,
                                 "points": points}, clip, antialias)
        samples = asked.samples(asked.size)
        camera = framing(asked.scene, samples) if camera is None else camera
        if not isinstance(camera, Camera):
            raise InputError(f"camera: expected a clsurf.Camera, got {camera!r}")
        scene, self.complete = resident_scene(asked.scene, self._residents, camera, samples, asked.lod, self._resident)
        check_differentials(scene.placed, asked.curved, asked.shading.look, asked.drawings["slim"])
        own_profile, self.device.profile = self.device.profile, self.profile or self.device.profile
        try:
            return self._drawn(asked, scene, camera)
        finally:
            self.device.profile = own_profile

    def _check_usable(self) -> None:
        if self._scratch is None:
            raise DeviceError("renderer: it is closed: make a new Renderer")
        if self.device.process != os.getpid():
            raise DeviceError("renderer: it was made before this process was forked: make a new Renderer")

    def _drawn(self, asked: Request, scene, camera: Camera) -> Frame:
        """Return the frame of a scene that is in memory; in parts where the device does not hold it at once."""
        def draw(scene, camera, size):
            return self._frame(asked, scene, camera, size)

        try:
            return draw(scene, camera, asked.size)
        except DeviceMemoryError as error:
            failed = error
        if self._cut(scene):
            with contextlib.suppress(DeviceMemoryError):
                return draw(scene, camera, asked.size)
        # Bands and the picture they make are in memory together, with room for what draws them.
        if not scene.surfaces or 3 * picture_bytes(asked.size, asked.channels) > host_memory_bytes():
            raise failed
        self._give_back()
        return draw_in_bands(draw, scene, camera, asked.size)

    def _frame(self, asked: Request, scene, camera: Camera, picture: tuple[int, int]) -> Frame:
        """Return the frame of `picture` (width, height): the stages of a frame, in their order."""
        shading, channels, size = asked.shading, asked.sampled, asked.samples(picture)
        early, lighting = wants_lighting(scene, shading, channels), None
        if early or asked.covered or asked.mirrored:
            lighting = prepared_lighting(self.device, scene, shading, camera)
        if lighting and len(lighting.materials) > 1:
            channels = list(dict.fromkeys([*channels, "id"]))
        at_once = len(scene.placed) == 1 and isinstance(scene.placed[0][0], PatchSurface) and not early
        at_once &= all(surface not in self._pieces for surface, _ in scene.placed)
        grid = self._new_grid(asked, scene.placed, size, channels, view_clip(asked.clip, camera), early, at_once,
                              lighting)
        origin, floats = scene_origin(scene), shading_floats(shading, scene.lights, asked.back.color, camera)
        whole = view_floats(camera, size, offset=camera.eye - origin)
        lamps = None if at_once and not asked.covered else self.device.upload(floats)
        look = Look(shading, asked.lod, lamps=lamps, cost="cost" in channels, **asked.drawings)
        if at_once:
            (surface, matrix), = scene.placed
            arrays = shade_patches(self.device, self._scratch, grid, self._uploaded(surface), matrix, camera, look,
                                   whole, floats, channels)
        else:
            self._draw(grid, scene, camera, look, floats, lighting if early else None, asked.factor)
            arrays = shade(self.device, self._scratch, grid, self.device.upload(whole), lamps,
                           "phong" if early else shading.look, channels)
        if asked.covered:
            self._cover(grid, scene, camera, look, whole, floats, lighting, arrays)
        if asked.mirrored:
            self._with_room(reflect, self.device, whole_of(scene), camera, shading, around(asked.back, scene), origin,
                            floats, lighting, arrays)
        if asked.factor > 1:
            arrays = average(self.device, arrays, picture, asked.factor, asked.kept, asked.curved,
                             self._scratch.lanes)
        if "color" in asked.kept:
            lay_over(self.device, asked.back, camera, picture, arrays["color"], self._scratch.lanes)
        arrays = self.device.download_all(arrays)
        arrays |= split_differentials(arrays.pop(NAME), asked.curved) if asked.curved else {}
        return Frame({name: arrays[name] for name in asked.channels}, origin, camera)

    def _cover(self, grid: Grid, scene, camera, look: Look, whole, floats, lighting, arrays) -> None:
        """Draw the pixels at edges of a picture `arrays` again, finer."""
        edges, large = mark_edges(self.device, self._scratch, grid, self.device.upload(whole), arrays,
                                  edge_layout(grid.layout, len(lighting.materials)))
        self._draw(large, scene, camera, replace(look, lod=FACTOR * look.lod, cost=False), floats, lighting, FACTOR)
        cover_edges(self.device, large, edges, self.device.upload(floats[8:12]), arrays["color"])

    def _draw(self, grid: Grid, scene, camera, look: Look, floats, lighting, factor: int) -> None:
        """Draw all surfaces of a scene into a grid's planes; light them there where `lighting` says how.

        `factor`: samples of the grid along a side of a pixel.
        """
        for number, (surface, matrix) in enumerate(scene.placed):
            own = surface_shading(scene, look.shading, number)
            seen = look if own is look.shading else replace(look, shading=own)

            def draw(part, surface=surface, matrix=matrix, number=number, seen=seen):
                try:
                    KINDS[type(part)][1](self.device, self._scratch, grid, self._uploaded(part), matrix, camera, seen,
                                         number)
                finally:
                    if part is not surface:
                        self._uploads.pop(part, None)  # room for the next

            draw_pieces(surface, self._pieces, draw)
        if grid.layout.unlit and look.points.eye_dome is not False:
            eye_dome(self.device, self._scratch, grid, look.points, camera, factor)
        if lighting is not None:
            self._with_room(light_grid, self.device, self._scratch, grid, whole_of(scene), camera, look.shading,
                            floats, look.lamps, lighting)

    def _with_room(self, stage, *arguments) -> None:
        """Run a stage whose rays need surfaces on the device; where that lacks memory, without what drew them."""
        try:
            return stage(*arguments)
        except DeviceMemoryError:
            self._uploads.clear()
        forget(self.device)
        return stage(*arguments)

    def _cut(self, scene) -> bool:
        """Cut patches that are drawn without planes; return whether anything was."""
        for surface, _ in scene.placed:
            if len(scene.placed) == 1 and isinstance(surface, PatchSurface) and surface not in self._pieces:
                self._pieces[surface] = parts = halves(surface)
                if parts is None:
                    del self._pieces[surface]
                return parts is not None
        return False

    def _new_grid(self, asked: Request, placed, size, channels, clip, early: bool, at_once: bool, lighting) -> Grid:
        """Return bins that nothing has touched yet; `at_once`: only their places."""
        shading, patches, points = asked.shading, asked.drawings["patches"], asked.drawings["points"]
        colored = shading.model_colors and any(carries_colors(s) for s, _ in placed)
        colored |= shading.look.startswith("ball") or points.attribute is not None
        unlit = any(is_unlit(s, points, shading) for s, _ in placed)
        # Gouraud shading puts light into the planes' colours.
        lit = patches.shading == "gouraud" and shading.look == "phong" and "color" in channels
        lit &= any(isinstance(s, PatchSurface) for s, _ in placed) and (lighting is None or lighting.plain)
        layout = same_layout(color=(colored or lit or early or unlit) and "color" in channels, id="id" in channels,
                             count="count" in channels, level="level" in channels, lit=lit, traced=early,
                             clip_planes=len(clip), unlit=unlit and "color" in channels, differentials=asked.curved)
        bins, fields = -(-size[0] // BIN) * -(-size[1] // BIN), layout.constants["FIELDS"]
        pixels = size[0] * size[1]
        self.device.check_memory(planes=4 * 64 * fields * bins * (not at_once),
                                 differentials=4 * layout.differential_planes * pixels,
                                 **{name: 4 * max(CHANNELS[name][0], 1) * pixels for name in channels})
        patch_bins = self.tile_bins if self._tile_given else tile_bins_of_patches(size, self._scratch.lanes)
        if at_once:
            return Grid(size, self.tile_bins, layout, None, None, patch_bins, clip)
        touched = self._scratch.array("touched", (bins,), np.int32)
        self.device.fill(touched, -1)
        return Grid(size, self.tile_bins, layout, touched,
                    self._scratch.array("planes", (bins, fields, 64), np.float32), patch_bins, clip)

    def _uploaded(self, surface):
        upload = self._uploads.get(surface)
        if upload is None:
            upload = self._uploads[surface] = KINDS[type(surface)][0](self.device, surface)
        return upload

    def _resident(self, stored) -> Resident:
        device, uploads = self.device, self._uploads

        def prepare(surface):
            with contextlib.suppress(DeviceMemoryError):  # the frame is then drawn in bands
                uploads[surface] = upload_slim(device, surface)

        return Resident(stored, self.budget, self.wait, prepare)

    def _give_back(self) -> None:
        """Give back what is kept between frames."""
        self._scratch.clear()
        self._uploads.clear()
        self.device.trim()

    def close(self) -> None:
        """Give all device memory back; the renderer cannot be used afterwards. May be called twice."""
        if self._scratch is not None:
            self._scratch.clear()
            self._scratch = None
            self._uploads.clear()
            self._residents.clear()
            self._pieces.clear()

    def __repr__(self):
        state = "closed" if self._scratch is None else f"tiles of {BIN * self.tile_bins} pixels"
        return f"Renderer({self.device.name}, {state})"

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()


def carries_colors(surface) -> bool:
    """Return whether a surface or a scan has colours of its own."""
    if isinstance(surface, RangeScan):
        return all(image.color is not None for image in surface.images)
    return any(getattr(surface, name, None) is not None for name in OWN_COLORS)


def framing(scene, size) -> Camera:
    """Return the camera that a picture of `size` gets where none is given: one that frames the scene."""
    thing = scene if np.isfinite(scene.bounds).all() else np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    return Camera.framing(thing, aspect=size[0] / size[1])


def render(scene, camera: Camera | None = None, size: tuple[int, int] = (1024, 768),
           channels=("color", "depth", "normal"), shading: Shading | None = None, lod: float = 4.0,
           background=(1.0, 1.0, 1.0, 1.0), device=None, tile: int | None = None, supersampling: int = 1,
           patches: PatchDrawing | None = None, slim: SlimDrawing | None = None, surfels: SurfelDrawing | None = None,
           scale_map: ScaleMapDrawing | None = None, points: PointDrawing | None = None, clip=None,
           antialias: str = "none") -> Frame:
    """Draw a scene once; see `Renderer.render`. For many frames keep a `Renderer`.

    Uploads are kept while their surface lives.
    """
    return shared_renderer(device, tile).render(scene, camera, size, channels, shading, lod, background,
                                                supersampling, patches, slim, surfels, scale_map, points, clip,
                                                antialias)


_shared = threading.local()


def shared_renderer(device=None, tile: int | None = None) -> Renderer:
    """Return this thread's renderer for `device` and `tile`, made on first use."""
    opened = open_device(device)
    kept = _shared.__dict__.setdefault("renderers", {})
    key = (id(opened), tile)
    if key not in kept:
        kept[key] = Renderer(opened, tile=tile, wait=True)
    return kept[key]
