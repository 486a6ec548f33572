"""Twins of clsurf.report: the counts of a view of patches, node by node and cell by cell in plain loops."""

import math

import numpy as np


def patch_counts(surface, camera, size, matrix=None) -> dict:
    """Return the counts of `clsurf.report.statistics.patch_statistics` by field name."""
    matrix = np.eye(4) if matrix is None else matrix
    width, height = size
    p = camera.projection(size)

    def seen(point):
        world = matrix[:3, :3] @ point + matrix[:3, 3]
        x, y, z = camera.rotation @ (world - camera.eye)
        over = 1 / -z if p.perspective else 1.0
        return p.cx + p.fx * x * over, p.cy - p.fy * y * over, -z

    out = dict.fromkeys(("opaque_nodes", "projected_nodes", "cells", "cells_touched", "interpolated_nodes", "parts",
                         "visible_patches", "plain_patches", "lines"), 0)
    opaque = surface.opaque
    for k in range(len(surface)):
        m, n = (int(v) for v in surface.size[k])
        start = int(surface.node_offset[k])
        node = {}
        for j in range(n):
            for i in range(m):
                if not opaque[start + j * m + i]:
                    continue
                d = int(surface.displacements[start + j * m + i])
                at, x, y, z = (a[k].astype(float) for a in (surface.origins, surface.axis_x, surface.axis_y,
                                                            surface.axis_z))
                node[i, j] = seen(surface.origin + at + i * x + j * y + d * z)
        visible = bool(node) and meets_frustum([seen_homogeneous(c, camera, p, matrix) for c in surface.boxes()[k]],
                                               width, height, camera.near, p.perspective)
        out["opaque_nodes"] += len(node)
        out["visible_patches"] += visible
        out["projected_nodes"] += len(node) * visible
        created_here = 0
        for j in range(n - 1):
            for i in range(m - 1):
                corners = [node.get(place) for place in ((i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1))]
                if None in corners:
                    continue
                out["cells"] += 1
                if not visible or any(c[2] < max(camera.near, 1e-300 if p.perspective else -np.inf) for c in corners):
                    continue
                xs, ys = [c[0] for c in corners], [c[1] for c in corners]
                if max(xs) < 0 or min(xs) > width or max(ys) < 0 or min(ys) > height:
                    continue
                out["cells_touched"] += 1
                halved = [halvings(corners, pairs, max(size)) for pairs in (((0, 1), (2, 3)), ((0, 2), (1, 3)))]
                parts_x, parts_y = 2 ** halved[0], 2 ** halved[1]
                created_here += (parts_x + 1) * (parts_y + 1) - 4
                out["parts"] += sum(2 ** min(level, halved[0]) * 2 ** min(level, halved[1])
                                    for level in range(max(halved) + 1))
                for triangle in ((0, 1, 3), (0, 3, 2)):
                    heights = [ys[c] for c in triangle]
                    out["lines"] += sum(min(heights) <= row + 0.5 < max(heights) for row in range(height))
        out["interpolated_nodes"] += created_here
        out["plain_patches"] += visible and created_here == 0
    return out


def halvings(corners, pairs, longest) -> int:
    """Return how often a side is halved until its parts are at most a pixel long."""
    length = min(max(math.dist(corners[a][:2], corners[b][:2]) for a, b in pairs), longest)
    k = 0
    while length > 1 + 1e-6:
        length, k = length / 2, k + 1
    return k


def seen_homogeneous(point, camera, p, matrix):
    """Return (x w, y w, w, depth) of a world point, w the depth or 1."""
    x, y, z = camera.rotation @ (matrix[:3, :3] @ point + matrix[:3, 3] - camera.eye)
    w = -z if p.perspective else 1.0
    return p.cx * w + p.fx * x, p.cy * w - p.fy * y, w, -z


def meets_frustum(corners, width, height, near, perspective) -> bool:
    """Return whether no plane of the frustum has all corners outside."""
    near = max(near, 1e-300) if perspective else near
    planes = (lambda c: c[0] >= 0, lambda c: c[0] <= width * c[2], lambda c: c[1] >= 0,
              lambda c: c[1] <= height * c[2], lambda c: c[3] >= near)
    return all(any(plane(c) for c in corners) for plane in planes)
