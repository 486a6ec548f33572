"""The light of a picture where more than plain lamps decides: materials, an image light, what rays find.

The tile stages of all kinds of surfaces leave depth, normals and base colours in the bins' planes; the stage
`light_bins` puts the light into the colour planes. Kernels: kernels/render/light_bins.cl, materials.clh.
"""

import collections
import threading
import weakref
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..errors import InputError
from .highlights import CELLS, highlight_table
from .light import Light
from .matcaps import MATCAPS
from .material import LIT_LOOKS, LOOKS, Material, shading_material
from .shade import Shading
from .skies import SKIES, linear_picture, picture_key
from .sky import Sky, prepared_sky
from .tiles import Grid, Scratch, view_floats

MATERIAL_FLOATS, SKY_FLOATS = 16, 48  # kernels/render/materials.clh
OWN_COLORS = ("colors", "color", "vertex_colors", "texture")  # where surfaces have colours of their own
KEPT = 8  # prepared pictures and sets of texels of each kind that a device keeps


@dataclass(frozen=True, eq=False)
class Lighting:
    """Materials and image light of one picture; arrays on the device."""

    materials: tuple[Material, ...]
    material_of: NDArray  # (surfaces,) int: the material of each surface
    light: Light | None
    sky: Sky | None
    rows: DeviceArray  # (materials, 16) float32
    numbers: DeviceArray  # (surfaces,) float32
    sky_floats: DeviceArray
    texels: DeviceArray  # (n, 4) float32

    @property
    def lit(self) -> bool:
        """Whether lamps, shadows and occlusion change anything."""
        return any(material.look in LIT_LOOKS for material in self.materials)

    @property
    def plain(self) -> bool:
        """Whether lamps alone light one material for all: patches may then be lit at their nodes."""
        return self.sky is None and [material.look for material in self.materials] == ["phong"]

    @property
    def constants(self) -> dict[str, int]:
        """The constants of kernels/render/light_bins.cl."""
        looks = {material.look for material in self.materials}
        return {"SKY": self.sky is not None, "PHYSICAL": "physical" in looks, "MATCAP": "matcap" in looks,
                "MATERIALS": len(self.materials)}


def image_light(lights) -> Light | None:
    """Return the image light among `lights`, or raise InputError where there are several."""
    images = [light for light in lights if light.kind == "image"]
    if len(images) > 1:
        raise InputError(f"lights: expected one image light, got {len(images)}: add their pictures up")
    return images[0] if images else None


def wants_lighting(scene, shading: Shading, channels) -> bool:
    """Return whether the stage `light_bins` lights a picture; the last stage lights all others."""
    if "color" not in channels or shading.look.startswith("ball"):
        return False
    if scene.materials is not None or shading.look in ("physical", "matcap", "normal"):
        return True
    lit = shading.look == "phong"
    return lit and bool(shading.shadows or shading.occlusion or image_light(scene.lights))


def surface_materials(scene, shading: Shading) -> tuple[tuple[Material, ...], NDArray]:
    """Return the materials of a scene, each once, and the number (surfaces,) of each surface's."""
    default, kept, numbers = None, {}, []
    balls = shading.look.startswith("ball")  # whatever the surfaces' materials
    for material in scene.surface_materials or (None,):
        material = None if balls else material
        if material is None:
            default = material = default or shading_material(shading)
        numbers.append(kept.setdefault(id(material), (len(kept), material))[0])
    return tuple(material for _, material in kept.values()), np.array(numbers[:len(scene.surfaces)])


def surface_shading(scene, shading: Shading, number: int) -> Shading:
    """Return the shading by which a surface's own colours go into the planes."""
    material = scene.surface_materials[number]
    surface = scene.placed[number][0]
    own = shading.model_colors and any(getattr(surface, name, None) is not None for name in OWN_COLORS)
    if material is not None and material.color is not None and not shading.look.startswith("ball"):
        return replace(shading, color=material.color, model_colors=False)
    look = shading.look if material is None else material.look
    if look == "matcap" and not own:
        return replace(shading, color=(1.0, 1.0, 1.0))
    return shading


def prepared_lighting(device: Device, scene, shading: Shading, camera) -> Lighting:
    """Return the materials and the image light of a scene on the device."""
    materials, material_of = surface_materials(scene, shading)
    light = image_light(scene.lights)
    lit = any(material.look in LIT_LOOKS for material in materials)
    sky = kept_sky(device, light) if light is not None and lit else None
    pictures = {picture_key(m.matcap): m.matcap for m in materials if m.look == "matcap"}
    texels, places = _kept_texels(device, light if sky else None, sky, pictures)
    rows = np.zeros((len(materials), MATERIAL_FLOATS), np.float32)
    for row, m in zip(rows, materials, strict=True):
        row[3:8] = 0, m.diffuse, m.specular, m.shininess, m.stripes
        row[8:11] = LOOKS[m.look], m.metallic, m.roughness
        if m.look == "matcap":
            row[11:14] = places[picture_key(m.matcap)]
        row[14] = (2 / (m.shininess + 2)) ** 0.25  # of a GGX lobe as wide as the highlight: alpha^2 = 2 / (n + 2)
    floats = np.zeros(SKY_FLOATS, np.float32)
    floats[15:17] = places["table"], CELLS
    if sky is not None:
        start = places["sky"]
        floats[:9] = (light.axes() @ camera.rotation.T).ravel()
        floats[9:12] = light.radiance
        floats[12:15] = len(sky.mirror), start + sky.matte[0], sky.matte[1]
        for i, (first, cells) in enumerate(sky.mirror):
            floats[17 + 2 * i:19 + 2 * i] = start + first, cells
    return Lighting(materials, material_of, light if sky else None, sky, device.upload(rows),
                    device.upload(material_of.astype(np.float32)) if len(material_of) else texels,
                    device.upload(floats), texels)


def light_bins(device: Device, scratch: Scratch, grid: Grid, camera, lamps: DeviceArray, lighting: Lighting,
               shadows: DeviceArray, shadowed: bool, directions: DeviceArray, hidden: DeviceArray, count: int) -> None:
    """Light the planes of a picture.

    Parameters
    ----------
    lamps : DeviceArray
        The shading buffer.
    shadows : DeviceArray
        (bins, 64) uint32: bits of the lamps that every pixel does not see, where `shadowed`.
    directions, hidden : DeviceArray
        (count, 8) float32 and (bins, count / 32, 64) uint32: those of ambient occlusion, and bits of the hidden ones.
    """
    bins = grid.bin_count
    constants = grid.layout.constants | lighting.constants | {
        "VW": scratch.lanes, "OCCLUSION": count, "SHADOWS": int(shadowed)}
    items, group = ((64 * bins,), (64,)) if scratch.lanes == 1 else ((bins,), (16,))
    device.kernel("render/light_bins.cl", constants=constants)(
        items, group, device.upload(view_floats(camera, grid.size)), lamps, shadows, directions, hidden,
        lighting.rows, lighting.numbers, lighting.sky_floats, lighting.texels, grid.bins_x, bins, grid.touched,
        grid.planes)


# What devices keep ----------------------------------------------------------------------------------------------------

_kept: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()
_lock = threading.Lock()


def kept_sky(device: Device, light: Light) -> Sky:
    """Return the maps of an image light, made once per picture and device."""
    def make():
        return prepared_sky(device, linear_picture("light picture", light.picture, SKIES)), light.picture
    return kept_by(device, "skies", picture_key(light.picture), make)[0]


def _kept_texels(device: Device, light: Light | None, sky: Sky | None, matcaps: dict):
    """Return the texels that materials and the sky refer to, and where each of them starts."""
    key = (None if light is None else picture_key(light.picture), *sorted(matcaps, key=str))

    def make():
        parts, places, at = [highlight_table()], {"table": 0}, len(highlight_table())
        if sky is not None:
            places["sky"] = at
            parts.append(sky.texels)
            at += len(sky.texels)
        for name, picture in matcaps.items():
            pixels = linear_picture("matcap", picture, MATCAPS)
            pixels = np.repeat(np.repeat(pixels, 1 + (len(pixels) < 2), 0), 1 + (pixels.shape[1] < 2), 1)
            places[name] = at, pixels.shape[1], pixels.shape[0]
            parts.append(np.pad(pixels.reshape(-1, 3), ((0, 0), (0, 1))))
            at += len(parts[-1])
        if at >= 1 << 24:  # places are floats
            raise InputError(f"matcaps: expected pictures of at most 16 million pixels together, got {at / 1e6:.0f}")
        return device.upload(np.concatenate(parts).astype(np.float32)), places, list(matcaps.values())
    return kept_by(device, "texels", key, make)[:2]


def kept_by(device: Device, kind: str, key, make):
    """Return what `make` gives, made once per `kind`, `key` and device; the last `KEPT` of each kind stay."""
    with _lock:
        shelf = _kept.setdefault(device, {}).setdefault(kind, collections.OrderedDict())
        if key not in shelf:
            shelf[key] = make()
            while len(shelf) > KEPT:
                shelf.popitem(last=False)
        shelf.move_to_end(key)
        return shelf[key]

