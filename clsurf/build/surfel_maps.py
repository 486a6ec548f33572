"""Normal maps of a surfel hierarchy, on the device: Holst and Schumann, section 4.

Kernels: kernels/build/normal_maps.cl (Algorithm 1), triangle_maps.cl (Algorithm 2).
"""

import numpy as np
from numpy.typing import NDArray

from ..device import Device
from ..surface.srgb import premultiplied, to_srgb
from ..surface.surfel import COVERED, encoded_normals

LARGEST_MAP = 64  # texels along a side: what a work-item keeps in private memory
LIGHT_STEPS = 8192  # kernels/build/surfel_maps.clh
SUMS = 9  # floats a texel, in surfel_maps.clh
NODE_TURNS = 3  # of loops for each surfel or triangle that a work-item looks at
MET = 6  # surfels that the sphere of one may meet, over those below it
LAUNCHES = 8  # of the maps: between them progress is told and the build may stop


def draw_maps(device: Device, parts: dict, inner: int, size: int, report) -> tuple[NDArray, NDArray | None, NDArray,
                                                                                 NDArray]:
    """Return the atlas of normals, that of colours or None, and offset and size (n,) of every surfel's map.

    Parameters
    ----------
    parts : dict
        Fields of the `SurfelHierarchy` without its maps; colours, where there are any, in "lights" (n, 4) and, in the
        hybrid form, "vertex_lights" (v, 4): premultiplied linear light.
    inner : int
        Surfels 0 to `inner` - 1 have maps of `size` texels along a side, the others of one.
    report : callable
        report(done), from 0 to 1.
    """
    n, texels = len(parts["positions"]), size * size
    hybrid, lights = parts.get("triangles") is not None, parts.get("lights")
    device.check_memory(nodes=32 * n, lights=0 if lights is None else 16 * n, **({
        "vertices": 12 * len(parts["vertices"]), "vertex_normals": 12 * len(parts["vertices"]),
        "triangles": 12 * len(parts["triangles"])} if hybrid else {}))
    unused = device.zeros((4,), np.float32)
    constants, arguments = _tree_arguments(device, parts, size, unused)
    path = "build/triangle_maps.cl" if hybrid else "build/normal_maps.cl"
    drawn = [np.empty((inner, texels, 4), np.uint8) for _ in range(1 if lights is None else 2)]
    heavy, roots = 0, []
    if device.loop_turns is not None:
        heavy, roots = roots_of(parts, device.loop_turns // NODE_TURNS)
    done = 0
    for begin, end, walks in ((0, min(heavy, inner), roots), (heavy, inner, [0])):
        resumed, count = len(walks) > 1, max(end - begin, 0)
        # Every launch has its share of the coarse surfels, whose maps see the most base surfels.
        row = 4 * (SUMS if resumed else 1)
        step = min(max(LAUNCHES, -(-row * count * texels // device.largest_buffer_bytes)), count)
        rows = max(-(-count // max(step, 1)) * texels, 1)
        device.check_memory(normal_maps=row * rows, color_maps=0 if lights is None else 4 * rows)
        out = [device.empty((rows, 4), np.uint8), unused if lights is None else device.empty((rows, 4), np.uint8)]
        sums = device.empty((rows, SUMS), np.float32) if resumed else unused
        kernel = device.kernel(path, constants={**constants, "RESUMED": resumed})
        for part in range(begin, begin + step):
            own = [atlas[part:end:step] for atlas in drawn]
            if resumed:
                device.fill(sums, 0)
            for root in walks:
                kernel((len(own[0]) * (texels if device.lanes == 1 else 1),), (64,) if device.lanes == 1 else (1,),
                       part, step, end, root, int(root == walks[-1]), sums, *arguments, *out)
            for target, found in zip(own, out, strict=False):
                target[...] = device.download(found, copy=False)[:len(target) * texels].reshape(target.shape)
            done += len(own[0])
            report(done / inner)
    own = np.full((n - inner, 4), COVERED, np.uint8)
    own[:, :3] = encoded_normals(parts["normals"][inner:])
    atlas = np.concatenate([drawn[0].reshape(-1, 4), own])
    color_atlas = None
    if lights is not None:
        color_atlas = np.concatenate([drawn[1].reshape(-1, 4), parts["colors"][inner:]])
    sizes = np.where(np.arange(n) < inner, size, 1).astype(np.int32)
    area = sizes.astype(np.int64) ** 2
    return atlas, color_atlas, (np.cumsum(area) - area).astype(np.int32), sizes


def _tree_arguments(device: Device, parts: dict, size: int, unused) -> tuple[dict, list]:
    """Return the constants and the arguments of the maps' kernels that are the same in every launch."""
    lights = parts.get("lights")
    nodes = np.concatenate([parts["positions"], parts["spheres"][:, None], parts["normals"], parts["radii"][:, None]],
                           axis=1).astype(np.float32)
    offset = parts["child_offset"].astype(np.int64)
    child = np.append(parts["children"], 0)
    below = np.stack([child[np.minimum(offset[:-1], len(child) - 1)], np.diff(offset)], axis=1).astype(np.int32)
    most, levels = int(np.diff(offset).max(initial=1)), int(parts["level"].max(initial=1))
    constants = {"VW": device.lanes, "MAP_SIZE": size, "HAS_COLOR": lights is not None, "STACK": most * levels + 1}
    up = lambda array, dtype=np.float32: unused if array is None else device.upload(  # noqa: E731
        np.ascontiguousarray(array, dtype))
    codes = np.rint(255 * to_srgb(np.arange(LIGHT_STEPS) / (LIGHT_STEPS - 1))).astype(np.uint8)
    arguments = [device.upload(nodes), device.upload(below)]
    if parts.get("triangles") is not None:
        first = parts["triangle_offset"].astype(np.int64)
        arguments += [device.upload(np.stack([first[:-1], np.diff(first)], axis=1).astype(np.int32)),
                      up(parts["vertices"]), up(parts["vertex_normals"]), up(parts["triangles"], np.int32),
                      up(parts.get("vertex_lights"))]
    arguments += [up(lights), device.upload(codes)]
    return constants, arguments


def roots_of(parts: dict, most: int) -> tuple[int, list[int]]:
    """Return how many surfels, the first ones, have maps that look at many others, and the surfels to walk down from.

    A driver that ends long loops walks down from each of the latter in a launch of its own. They hold all leaves
    together, with at most `most` surfels and triangles below each, where the hierarchy has such.
    """
    offset, children, level = parts["child_offset"], parts["children"], parts["level"]
    below = np.ones(len(level), np.int64)
    if parts.get("triangles") is not None:
        below += np.diff(parts["triangle_offset"])
    parent = np.zeros(len(level), np.int64)
    parent[children] = np.repeat(np.arange(len(level)), np.diff(offset))
    for deep in range(int(level.max()), 1, -1):
        own = np.flatnonzero(level == deep)
        np.add.at(below, parent[own], below[own])
    roots, waiting = [], [0]
    while waiting:
        root = waiting.pop()
        own = children[offset[root]:offset[root + 1]]
        if below[root] > most and len(own) and (below[own] > 1).all():
            waiting.extend(own.tolist())
        else:
            roots.append(root)
    heavy = np.flatnonzero(MET * below > most)
    return (0, []) if len(roots) < 2 else (int(heavy[-1]) + 1, roots)


def light_of(colors: NDArray | None) -> NDArray | None:
    """Return premultiplied linear light (n, 4) float32 of sRGB colours (n, 4) uint8; None stays None."""
    return None if colors is None else premultiplied(colors).astype(np.float32)
