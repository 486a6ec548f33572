"""Mirror reflection of a picture: single rays from its mirroring pixels, one bounce, lit where they hit.

The rays are those of `clsurf.trace`, so that every surface of a scene is reflected; what they hit is lit as pixels are.
Kernel: kernels/render/light_points.cl.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..surface.arrays import lengths_of
from ..surface.srgb import to_linear
from ..trace.hits import trace
from ..trace.kinds import traceable
from ..trace.pieces import held
from ..trace.rays import Hits
from .backdrop import Backdrop
from .light import KINDS, LIGHT_FLOATS
from .lighting import Lighting, surface_shading
from .material import LIT_LOOKS
from .shade import HEAD_FLOATS, Shading
from .tiles import view_floats

CHANNELS = ("position", "normal", "id")  # that a picture needs for it
# Where a ray starts, in node spacings of patches or median radii of surfels: up the normal, and along itself.
LIFT, START = 0.05, 0.5
POINT_GRAIN = 0.002  # of the extent of a cloud
POINT_FLOATS, SPAN = 16, 64  # kernels/render/light_points.cl


def wants_mirror(scene, shading: Shading, channels) -> bool:
    """Return whether a picture shows reflections."""
    none = scene.materials is None and isinstance(shading.mirror, int | float) and not shading.mirror
    if none or "color" not in channels:
        return False
    return bool((mirror_shares(scene, shading) > 0).any())


def mirror_shares(scene, shading: Shading) -> NDArray:
    """Return the share (surfaces,) of reflected light of each surface of a scene; those not named reflect nothing."""
    shares, count = np.asarray(shading.mirror, np.float64), len(scene.surfaces)
    shares = np.full(count, shares) if shares.ndim == 0 else np.resize(np.append(shares, np.zeros(count)), count)
    if shading.look not in LIT_LOOKS:
        shares = np.zeros(count)
    if scene.materials is None or shading.look.startswith("ball"):
        return shares
    return np.array([own if m is None else m.mirror * (m.look in LIT_LOOKS)
                     for own, m in zip(shares, scene.surface_materials, strict=True)])


def grain(device: Device, surface, matrix) -> float:
    """Return the length (world units) within which a surface's own points are no obstacles to rays from it."""
    scale = 1.0 if matrix is None else float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not traceable(surface):  # points, whose extent is their picture's
        return scale * POINT_GRAIN * float(np.nan_to_num(np.linalg.norm(np.ptp(surface.bounds, axis=0))))
    return scale * held(device, surface).grain


def met(scene, origins, directions, query: str = "closest", device=None, **limits) -> Hits:
    """Return what `trace` does for the surfaces of a scene that rays can meet; numbers are the scene's."""
    numbers = [number for number, (surface, _) in enumerate(scene.placed) if traceable(surface)]
    hits = trace([scene.surfaces[number] for number in numbers], origins, directions, query, device=device, **limits)
    return replace(hits, surface=np.append(numbers, -1).astype(np.int32)[hits.surface])


def reflect(device: Device, scene, camera, shading: Shading, backdrop: Backdrop, origin: NDArray, floats: NDArray,
            lighting: Lighting, arrays: dict[str, DeviceArray]) -> None:
    """Mix what mirroring pixels reflect into the colour of a picture.

    `arrays` are the picture's channels on the device, `position` relative to `origin` (3,) float64; `floats` is the
    shading buffer.
    """
    number = device.download(arrays["id"])
    shares, grains = mirror_shares(scene, shading), [grain(device, *part) for part in scene.placed]
    use = number >= 0
    use[use] = shares[number[use]] > 0
    if not use.any():
        return
    number = number[use]
    points = device.download(arrays["position"])[use].astype(np.float64) + origin
    normals = device.download(arrays["normal"])[use].astype(np.float64)
    sight = points - camera.eye if camera.height is None else np.broadcast_to(-camera.rotation[2], points.shape)
    sight = sight / lengths_of(sight, keepdims=True)
    ray = sight - 2 * (sight * normals).sum(axis=1, keepdims=True) * normals
    step = np.array(grains)[number]
    hits = met(scene, points + LIFT * step[:, None] * normals, ray, near=START * step, device=device)
    seen = backdrop.seen(ray, camera)
    if hits.hit.any():
        seen[hits.hit] = lit(device, scene, camera, shading, hits, ray, floats, lighting)
    color = device.download(arrays["color"])
    share = shares[number][:, None]
    color[use, :3] = (1 - share) * color[use, :3] + share * seen
    arrays["color"] = device.upload(color)


def lit(device: Device, scene, camera, shading: Shading, hits: Hits, rays: NDArray, floats: NDArray,
        lighting: Lighting) -> NDArray:
    """Return the linear colours (h, 3) of the hits among rays with the unit directions `rays` (n, 3)."""
    hit = hits.hit
    points, normals = hits.position[hit], hits.normal[hit]
    surface = hits.surface[hit]
    rows = np.zeros((len(points), POINT_FLOATS), np.float32)
    for at, vectors in ((0, points - camera.eye), (3, normals), (6, -rays[hit])):
        rows[:, at:at + 3] = vectors @ camera.rotation.T
    rows[:, 9:12] = base_colors(device, scene, shading, surface, hits.primitive[hit])
    rows[:, 12] = lighting.material_of[surface]
    if shading.shadows:
        step = np.array([grain(device, *part) for part in scene.placed])[surface]
        rows[:, 13] = shadow_bits(device, scene, points, normals, step).view(np.float32)
    floats = floats.copy()
    lamps = floats[HEAD_FLOATS:].reshape(-1, LIGHT_FLOATS)
    eye = lamps[:, 0] == KINDS["headlight"]  # where the picture's eye is, not the ray's start
    lamps[eye, :4] = (KINDS["point"], 0, 0, 0) if camera.height is None else (KINDS["directional"], 0, 0, 1)
    out = device.empty((len(points), 3), np.float32)
    device.kernel("render/light_points.cl", constants=lighting.constants | {"SPAN": SPAN})(
        (-(-len(points) // SPAN),), None, device.upload(view_floats(camera, (1, 1))), device.upload(floats),
        lighting.rows, lighting.sky_floats, lighting.texels, device.upload(rows), len(points), out)
    return device.download(out)


def shadow_bits(device: Device, scene, points: NDArray, normals: NDArray, step: NDArray) -> NDArray:
    """Return the bits (n,) uint32 of the lamps that points do not see."""
    bits = np.zeros(len(points), np.uint32)
    for bit, light in enumerate(light for light in scene.lights if light.kind != "image"):
        if light.kind == "headlight":
            continue
        near = light.kind in ("point", "spot")
        to = np.broadcast_to(np.asarray(light.vector, np.float64), points.shape)
        to = to - points if near else to
        away = lengths_of(to, keepdims=True)
        to = to / np.maximum(away, 1e-300)
        seen = np.flatnonzero((normals * to).sum(axis=1) > 0)
        hidden = met(scene, points[seen] + LIFT * step[seen, None] * normals[seen], to[seen], "any",
                     near=START * step[seen], far=away[seen, 0] if near else np.inf, device=device).hit
        bits[seen[hidden]] |= np.uint32(1 << bit)
    return bits


def base_colors(device: Device, scene, shading: Shading, surface: NDArray, primitive: NDArray) -> NDArray:
    """Return the linear colours (n, 3) of what was hit: a surfel's, a face's, or the mean of a patch's."""
    out = np.zeros((len(surface), 3))
    for number, (own, _) in enumerate(scene.placed):
        here, look = surface == number, surface_shading(scene, shading, number)
        out[here] = to_linear(look.color)
        if look.model_colors and here.any() and held(device, own).colors is not None:
            out[here] = held(device, own).colors(primitive[here])
    return out
