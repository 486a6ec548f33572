"""Spatial patches from triangle meshes."""

import numpy as np

from ..surface.mesh import Mesh
from . import segments
from .quantize import quantized
from .resample import Frames, area_lists, resample_faces

ANGLES = 12


def frames_of_areas(vertices, graph, owner, count, size, reach, angles=ANGLES, square=True):
    """Rectangles around areas."""
    normal = np.stack([np.bincount(owner, graph.area * graph.normal[:, k], count) for k in range(3)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    # axes
    s = np.where(normal[:, 2] < 0, -1.0, 1.0)
    a = -1 / (s + normal[:, 2]); b = normal[:, 0] * normal[:, 1] * a
    u = np.stack([1 + s * normal[:, 0] ** 2 * a, s * b, -s * normal[:, 0]], 1)
    v = np.stack([b, s + normal[:, 1] ** 2 * a, -normal[:, 1]], 1)
    key = np.unique((owner[:, None] * np.int64(len(vertices)) + graph.corners).ravel())
    area, vertex = np.divmod(key, len(vertices))
    starts = np.searchsorted(area, np.arange(count))
    p = vertices[vertex]
    x, y = np.einsum("ij,ij->i", p, u[area]), np.einsum("ij,ij->i", p, v[area])
    best = np.full(count, np.inf)
    out = np.zeros((count, 5))
    n = np.asarray(size) - 1 - 2 * (reach - 1)
    for angle in np.arange(angles) * np.pi / 2 / angles * (1 if square else 1):
        c, si = np.cos(angle), np.sin(angle)
        xx, yy = c * x + si * y, c * y - si * x
        x0, x1 = np.minimum.reduceat(xx, starts), np.maximum.reduceat(xx, starts)
        y0, y1 = np.minimum.reduceat(yy, starts), np.maximum.reduceat(yy, starts)
        if square:
            cost = np.maximum((x1 - x0) / n[0], (y1 - y0) / n[1])
        else:
            cost = (x1 - x0) * (y1 - y0)
        better = cost < best
        best[better] = cost[better]
        out[better] = np.stack([np.full(count, angle), x0, x1, y0, y1], 1)[better]
    angle, x0, x1, y0, y1 = out.T
    c, si = np.cos(angle)[:, None], np.sin(angle)[:, None]
    ax, ay = c * u + si * v, c * v - si * u
    sx, sy = (x1 - x0) / n[0], (y1 - y0) / n[1]
    if square:
        sx = sy = np.maximum(sx, sy)
    low = lambda lo, hi, s, k: (lo + hi) / 2 - s * (size[k] - 1) / 2
    ox, oy = low(x0, x1, sx, 0), low(y0, y1, sy, 1)
    height = np.einsum("ij,ij->i", normal, np.stack([np.bincount(owner, graph.area * graph.middle[:, k], count) for k in range(3)], 1) / np.maximum(np.bincount(owner, graph.area, count), 1e-300)[:, None])
    origin = ox[:, None] * ax + oy[:, None] * ay + height[:, None] * normal
    return Frames(origin, ax * sx[:, None], ay * sy[:, None], np.broadcast_to(np.asarray(size, np.int32), (count, 2)))


def convert(mesh: Mesh, request, device, progress, reach=1.25, square=True, angles=12, first=None, bw=2.0, floor=1e-3, lloyd=0, cone=60):
    vertices = mesh.vertices.astype(np.float64)
    graph = segments.face_graph(vertices, mesh.faces.astype(np.int64))
    K = request.patches or 1526
    areas = segments.Areas(graph, floor=floor)
    areas.merge(int(K * (first or 1)), np.cos(np.radians(cone)))
    w = segments.edge_weights(graph, bw)
    owner, count = areas.owner, areas.count
    for _ in range(lloyd + 1):
        owner = segments.regrown(graph, segments.central_faces(graph, owner, count), w)
    if first:
        areas = segments.Areas(graph, owner, count, floor=floor)
        areas.merge(K, np.cos(np.radians(cone)))
        owner, count = areas.owner, areas.count
    frames = frames_of_areas(vertices, graph, owner, count, request.nodes, reach, angles, square)
    lists = area_lists(owner, count, graph.corners)
    heights, colors, source = resample_faces(device, mesh, frames, lists, request.precise, reach)
    diagonal = float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
    return quantized(frames.origins, frames.axis_x, frames.axis_y, heights, frames.size, colors, request.precise,
                     origin=mesh.origin, diagonal=diagonal)
