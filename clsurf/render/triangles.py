"""Triangles in the renderer: one tile stage for meshes, and for all that is drawn as triangles.

Kernels: kernels/render/project_vertices.cl, project_triangles.cl, tile_triangles.cl.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..device import Device, DeviceArray
from ..surface.srgb import to_linear
from .shade import Look
from .tiles import BIN, Grid, PairLists, Scratch, bin_pairs, new_footprints, view_floats

RUN = 64  # faces that are culled and sorted together: kernels/render/triangles.clh
VERTICES_OF_ITEM = 1024
CUT, FLAT_COLOR = 24, 26  # of the view buffer: kernels/render/triangles.clh
CUT_SHARE = 1e-5  # of the largest depth: triangles that come nearer are drawn by homogeneous edges


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles on a device, ready to be drawn.

    Faces are drawn whichever way they run. Runs of 64 of them are culled and sorted together, so neighbours in the list
    should be neighbours in space. A face that names a vertex twice, or one that is not finite, is not drawn.

    Parameters
    ----------
    positions : (v, 4) float32
        Model space; the fourth number is not read. May come from a kernel of the same frame.
    faces : (f, 3) int32
        Numbers of vertices, all valid.
    normals : (v, 4) float32, optional
        Model space, of any length; None: those of the faces.
    colors : (v, 4) float32, optional
        Linear red, green, blue; the fourth number is not read.
    """

    positions: DeviceArray
    faces: DeviceArray
    normals: DeviceArray | None = None
    colors: DeviceArray | None = None


def place_triangles(camera, size, matrix: NDArray | None, origin: NDArray, center: NDArray, reach: float,
                    color) -> NDArray:
    """Return the view buffer of placed triangles (kernels/common/view.clh, kernels/render/triangles.clh).

    Parameters
    ----------
    matrix : (4, 4) float64 or None
        Model to world, a similarity.
    origin : (3,) float64
        What the positions are relative to, model space.
    center, reach : (3,) float64, float
        Every vertex lies within `reach` of `center`, which is relative to `origin`; vertices outside are drawn too, but
        not sorted.
    color : (3,) float
        sRGB, for triangles without colours.
    """
    if matrix is None:
        scale, rotation, offset = 1.0, camera.rotation, camera.rotation @ (origin - camera.eye)
    else:
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        rotation = camera.rotation @ (matrix[:3, :3] / scale)
        offset = camera.rotation @ (matrix[:3, :3] @ origin + matrix[:3, 3] - camera.eye)
    middle, far = -(scale * rotation[2] @ center + offset[2]), scale * reach
    perspective = camera.projection(size).perspective
    first = max(middle - far, 0.0) if perspective else middle - far
    view = view_floats(camera, size, rotation, offset, scale, depths=(first, middle + far))
    view[CUT] = max(camera.near, CUT_SHARE * (middle + far), 1e-30) if perspective else view[18]
    view[FLAT_COLOR:FLAT_COLOR + 3] = to_linear(color)
    return view


def project_triangles(device: Device, scratch: Scratch, grid: Grid, triangles: Triangles,
                      view: DeviceArray) -> tuple[DeviceArray, PairLists | None]:
    """Project vertices and sort runs of faces into tiles.

    Returns
    -------
    points : (v, 4) float32
        See kernels/render/triangles.clh.
    pairs : PairLists or None
        The runs that may touch each tile of ``grid.patch_bins`` bins; None where nothing touches the picture.
    """
    vertices, faces = len(triangles.positions), len(triangles.faces)
    runs = -(-faces // RUN)
    device.check_memory(points=16 * vertices)
    points = scratch.array("points", (vertices, 4), np.float32)
    run = VERTICES_OF_ITEM if scratch.lanes > 1 else 1
    device.kernel("render/project_vertices.cl")((-(-vertices // run),), None if run > 1 else (64,), view,
                                                triangles.positions, vertices, run, points)
    touch = new_footprints(device, scratch, runs)
    device.kernel("render/project_triangles.cl", constants={"TILE_BINS": grid.patch_bins})(
        (runs,), (16,), view, points, triangles.faces, faces, runs, touch.full, touch.core, touch.keys, touch.buckets)
    # In a grid whose bins are the tiles.
    tiles = [-(-n // grid.patch_bins) for n in (grid.bins_x, grid.bins_y)]
    coarse = replace(grid, size=(tiles[0] * BIN, tiles[1] * BIN))
    return points, bin_pairs(device, scratch, coarse, touch, runs)


def draw_triangles(device: Device, scratch: Scratch, grid: Grid, triangles: Triangles, floats: NDArray, look: Look,
                   number: int) -> None:
    """Draw triangles into the planes of a grid.

    Parameters
    ----------
    floats : (32,) float32
        View buffer, of `place_triangles`.
    number : int
        The surface's place in the scene, for the channel "id".
    """
    if not len(triangles.faces):
        return
    view = device.upload(floats)
    points, pairs = project_triangles(device, scratch, grid, triangles, view)
    if pairs is None:
        return
    colors = triangles.colors if grid.layout.color and look.shading.model_colors else None
    constants = grid.layout.constants | {
        "VW": scratch.lanes, "TILE_BINS": grid.patch_bins, "HAS_NORMALS": triangles.normals is not None,
        "HAS_COLOR": colors is not None, "COUNT_COST": look.cost}
    tiles_x, group = -(-grid.bins_x // grid.patch_bins), 64 if scratch.lanes == 1 else 1
    tiles = tiles_x * -(-grid.bins_y // grid.patch_bins)
    device.kernel("render/tile_triangles.cl", constants=constants)(
        (tiles * group,), (group,), view, pairs.pairs, pairs.offsets, points, triangles.faces, len(triangles.faces),
        triangles.positions, triangles.normals or view, colors or view, number, tiles_x, tiles, grid.bins_x,
        grid.bins_y, grid.touched, grid.planes)
