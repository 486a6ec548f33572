"""Mirror reflection of a picture: single rays from its mirroring pixels, one bounce, lit where they hit.

The rays are those of `clsurf.trace`, so that every surface of a scene is reflected; what they hit is lit on the host
as kernels/render/shade.clh lights a pixel. Twin of that lighting: tests/reference/render.py, shade.
"""

import numpy as np
from numpy.typing import NDArray

from ..build.large_faces import longest2
from ..device import Device, DeviceArray
from ..surface.srgb import LINEAR_OF_BYTE, to_linear
from ..trace.hits import Hits, trace
from .shade import Shading

CHANNELS = ("position", "normal", "id")  # that a picture needs for it
# Where a ray starts, in node spacings of patches, texels or median radii of surfels: up the normal, and along itself.
LIFT, START = 0.05, 0.5


def wants_mirror(shading: Shading, channels) -> bool:
    """Return whether a picture shows reflections."""
    return bool(np.any(np.asarray(shading.mirror) > 0)) and shading.look == "phong" and "color" in channels


def mirror_shares(shading: Shading, count: int) -> NDArray:
    """Return the share (count,) of reflected light of each surface of a scene; those not named reflect nothing."""
    shares = np.asarray(shading.mirror, np.float64)
    return np.full(count, shares) if shares.ndim == 0 else np.resize(np.append(shares, np.zeros(count)), count)


def grain(surface, matrix) -> float:
    """Return the length (world units) within which a surface's own points are no obstacles to rays from it."""
    scale = 1.0 if matrix is None else float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if hasattr(surface, "leaf"):
        own = surface.radii[surface.leaf] if surface.leaf.any() else surface.radii
    elif hasattr(surface, "spacing"):
        own = np.array([surface.spacing])
    elif hasattr(surface, "faces"):
        own = np.sqrt(longest2(surface.vertices, surface.faces[::max(1, len(surface.faces) // 20_000)]))
    elif hasattr(surface, "scales"):
        return scale * surface.radius * 2 / surface.size
    else:
        own = np.linalg.norm(surface.axis_x, axis=1)
    return scale * float(np.median(own)) if len(own) else 0.0


def reflect(device: Device, scene, camera, shading: Shading, background: NDArray, origin: NDArray,
            arrays: dict[str, DeviceArray]) -> None:
    """Mix what mirroring pixels reflect into the colour of a picture; `background` (4,) is linear and premultiplied.

    `arrays` are the picture's channels on the device, `position` relative to `origin` (3,) float64.
    """
    number = device.download(arrays["id"])
    shares, grains = mirror_shares(shading, len(scene.placed)), [grain(*part) for part in scene.placed]
    use = number >= 0
    use[use] = shares[number[use]] > 0
    if not use.any():
        return
    number = number[use]
    points = device.download(arrays["position"])[use].astype(np.float64) + origin
    normals = device.download(arrays["normal"])[use].astype(np.float64)
    sight = points - camera.eye if camera.height is None else np.broadcast_to(-camera.rotation[2], points.shape)
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    ray = sight - 2 * (sight * normals).sum(axis=1, keepdims=True) * normals
    step = np.array(grains)[number]
    hits = trace(scene, points + LIFT * step[:, None] * normals, ray, near=START * step, device=device)
    seen = np.tile(background[:3], (len(points), 1))
    if hits.hit.any():
        seen[hits.hit] = lit(device, scene, camera, shading, hits, ray)
    color = device.download(arrays["color"])
    share = shares[number][:, None]
    color[use, :3] = (1 - share) * color[use, :3] + share * seen
    arrays["color"] = device.upload(color)


def lit(device: Device, scene, camera, shading: Shading, hits: Hits, rays: NDArray) -> NDArray:
    """Return the linear colours (h, 3) of the hits among rays with the unit directions `rays` (n, 3)."""
    hit = hits.hit
    points, normals, eye = hits.position[hit], hits.normal[hit], -rays[hit]
    surface, primitive = hits.surface[hit], hits.primitive[hit]
    base = base_colors(scene, shading, surface, primitive)
    step = np.array([grain(*part) for part in scene.placed])[surface]
    color = shading.ambient * base
    for light in scene.lights:
        to = np.broadcast_to(np.asarray(light.vector, np.float64), points.shape)
        if light.kind == "headlight":
            to = camera.eye - points if camera.height is None else np.broadcast_to(camera.rotation[2], points.shape)
        elif light.kind == "point":
            to = to - points
        away = np.linalg.norm(to, axis=1, keepdims=True)
        to = to / np.maximum(away, 1e-300)
        half = to + eye
        half = half / np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-30)
        cosine = (normals * to).sum(axis=1)
        shine = np.clip((normals * half).sum(axis=1), 0, None) ** shading.shininess * shading.specular
        seen = cosine > 0
        if shading.shadows and light.kind != "headlight":
            far = away[seen, 0] if light.kind == "point" else np.inf
            hidden = trace(scene, points[seen] + LIFT * step[seen, None] * normals[seen], to[seen], "any",
                           near=START * step[seen], far=far, device=device).hit
            seen[seen] = ~hidden
        part = shading.diffuse * base * cosine[:, None] + shine[:, None]
        color = color + np.where(seen[:, None], part * np.asarray(light.color), 0)
    return color


def base_colors(scene, shading: Shading, surface: NDArray, primitive: NDArray) -> NDArray:
    """Return the linear colours (n, 3) of what was hit: a surfel's, or the mean of a patch's."""
    out = np.tile(to_linear(shading.color), (len(surface), 1))
    for number, (own, _) in enumerate(scene.placed):
        here = surface == number
        if not shading.model_colors or not here.any():
            continue
        if getattr(own, "vertex_colors", None) is not None:
            out[here] = LINEAR_OF_BYTE[own.vertex_colors[own.triangles[primitive[here]], :3]].mean(axis=1)
        elif own.colors is not None and hasattr(own, "faces"):
            out[here] = LINEAR_OF_BYTE[own.colors[own.faces[primitive[here]], :3]].mean(axis=1)
        elif own.colors is not None and hasattr(own, "radii"):
            out[here] = LINEAR_OF_BYTE[own.colors[primitive[here], :3]]
        elif own.colors is not None:
            linear = LINEAR_OF_BYTE[own.colors[:, :3]]
            mean = np.add.reduceat(linear, own.node_offset[:-1], axis=0) / np.diff(own.node_offset)[:, None]
            out[here] = mean[primitive[here]]
        elif getattr(own, "color", None) is not None:
            out[here] = LINEAR_OF_BYTE[own.color]
    return out
