"""Rays against meshes, SLIM surfaces and patches: analytic shapes, brute force, the renderer, odd input."""

import numpy as np
import pytest
from reference import trace_rays as twin
from reference.ray_scenes import random_rays, slim_sphere, sphere_mesh

import clsurf
from clsurf import Camera, Mesh, PatchDrawing, Scene
from clsurf.render.renderer import Renderer
from clsurf.surface.placed import placed
from clsurf.trace import tracers
from clsurf.trace.ray_slim import neighbour_lists
from clsurf.trace.tree import node_boxes, plant


@pytest.fixture(scope="module")
def sphere(device):
    return slim_sphere(device)


@pytest.fixture(scope="module")
def torus(device):
    """A torus as mesh and as a SLIM surface of degree 3."""
    scan = clsurf.models.torus(4000)
    return scan, clsurf.build_slim(scan, degree=3, error=0.01, device=device)


# Analytic shapes -----------------------------------------------------------------------------------------------------


def test_sphere_of_triangles_is_hit_where_the_sphere_is(device, lanes):
    """Distance, position, normal of the analytic sphere within the mesh's own error."""
    origins, directions = random_rays(2000)
    hits = clsurf.trace(sphere_mesh(96, 192), origins, 7 * directions, device=device)
    d = twin.unit(directions)
    b = (origins * d).sum(axis=1)
    exact = -b - np.sqrt(b * b - (origins**2).sum(axis=1) + 1)
    assert hits.hit.all() and (hits.surface == 0).all() and (hits.primitive >= 0).all()
    assert np.abs(hits.distance - exact).max() < 5e-3
    assert np.abs(hits.position - origins - hits.distance[:, None] * d).max() < 1e-12
    assert np.einsum("ij,ij->i", hits.normal, hits.position).min() > 0.99
    assert np.abs(np.linalg.norm(hits.normal, axis=1) - 1).max() < 1e-9


def test_sphere_of_surfels_is_hit_where_the_sphere_is(device, lanes, sphere):
    """Depth and normals of the blended surfels against the analytic sphere."""
    origins, directions = random_rays(2000)
    hits = clsurf.trace(sphere, origins, directions, device=device)
    d = twin.unit(directions)
    b = (origins * d).sum(axis=1)
    exact = -b - np.sqrt(b * b - (origins**2).sum(axis=1) + 1)
    assert hits.hit.all()
    assert np.abs(hits.distance - exact).max() < 0.01 and np.median(np.abs(hits.distance - exact)) < 5e-4
    assert np.einsum("ij,ij->i", hits.normal, hits.position).min() > 0.99


def test_plane_is_hit_at_its_height(device, lanes):
    """A plane: exact distance, from both sides, along axes."""
    plane = Mesh(np.float32([[-1, -1, 0.5], [1, -1, 0.5], [1, 1, 0.5], [-1, 1, 0.5]]), [[0, 1, 2], [0, 2, 3]])
    origins = np.array([[0.1, 0.2, 3], [0.1, 0.2, -3], [0, 0, 3], [5, 0, 3], [-2, 0, 0.5], [0.3, 0.3, 0.5]])
    directions = np.array([[0, 0, -2], [0, 0, 0.5], [0, 0, -1], [0, 0, -1], [1, 0, 0], [0, 0, 1.0]])
    hits = clsurf.trace(plane, origins, directions, device=device)
    np.testing.assert_allclose(hits.distance[:3], [2.5, 3.5, 2.5], rtol=1e-6)
    np.testing.assert_allclose(hits.normal[:3], [[0, 0, 1], [0, 0, -1], [0, 0, 1]], atol=1e-7)
    assert not hits.hit[3] and not hits.hit[4] and not hits.hit[5]  # beside it, along it, on it and away
    assert hits.surface[3] == hits.primitive[3] == -1 and np.isnan(hits.position[3]).all()


# Brute force ---------------------------------------------------------------------------------------------------------


def test_ray_triangles(device, lanes):
    """All hits of random triangles equal those of brute force."""
    rng = np.random.default_rng(3)
    centers = rng.uniform(-1, 1, (300, 1, 3))
    mesh = Mesh((centers + rng.normal(0, 0.2, (300, 3, 3))).reshape(-1, 3).astype(np.float32),
                np.arange(900).reshape(-1, 3))
    origins, directions = random_rays(200, 4)
    found = clsurf.trace(mesh, origins, directions, "all", device=device)
    closest = clsurf.trace(mesh, origins, directions, device=device)
    some = clsurf.trace(mesh, origins, directions, "any", device=device)
    for i in range(len(origins)):
        distance, face = twin.ray_triangles(mesh.vertices, mesh.faces, origins[i], directions[i])
        mine = slice(*found.offsets[i:i + 2])
        np.testing.assert_allclose(found.distance[mine], distance, rtol=2e-6)
        assert (found.primitive[mine] == face).all()
        first = found.distance[mine][0] if len(distance) else np.inf
        np.testing.assert_allclose(closest.distance[i], first, rtol=1e-12)
        assert some.hit[i] == (len(distance) > 0) and (not some.hit[i] or some.primitive[i] in face)
    assert (np.diff(found.offsets) > 1).any() and found.hit.sum() == closest.hit.sum()


@pytest.mark.parametrize("oriented", [True, False])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_ray_slim(device, lanes, degree, oriented):
    """Rays against surfels, support test and back faces included, equal brute force."""
    points = twin.unit(np.random.default_rng(5).normal(size=(1500, 3)))
    points = points[points[:, 2] > -0.6] * [1, 0.7, 0.5]
    surface = clsurf.build_slim(clsurf.PointCloud(points), degree=degree, error=0.02, device=device)
    surface = clsurf.SlimSurface(**{**{k: getattr(surface, k) for k in surface.__dataclass_fields__},
                                    "oriented": oriented})
    origins, directions = random_rays(150, 6, inside=1.0)
    hits = clsurf.trace(surface, origins, directions, device=device)
    leaves, same = twin.Leaves(surface), 0
    for i in range(len(origins)):
        distance, normal, surfel, _ = twin.ray_slim(leaves, origins[i], directions[i])
        if not (hits.hit[i] and np.isfinite(distance)):
            same += np.isfinite(distance) == hits.hit[i]
            continue
        close = abs(distance - hits.distance[i]) < 1e-5 and hits.primitive[i] == surfel
        same += close and hits.normal[i] @ (normal if normal @ directions[i] < 0 else -normal) > 0.9999
    assert same >= len(origins) - 2  # a hit on a ball's rim is decided by rounding
    assert 100 < hits.hit.sum() < 150


def test_neighbour_lists(device):
    """Every bottom node lists those whose balls reach into its pieces, once each; empty and small trees too."""
    rng = np.random.default_rng(13)
    for count in (1, 16, 17, 700):
        center, half = rng.uniform(-1, 1, (count, 3)), rng.uniform(0, 0.1, (count, 1))
        tree = plant(device, center - half, center + half)
        boxes, balls = (node_boxes(tree, center - f * half, center + f * half) for f in (1, 2))
        first, near_boxes, near_nodes = neighbour_lists(tree, boxes, balls)
        pieces, whole = boxes[tree.first_bottom:], balls[tree.first_bottom:]
        low, high = pieces[:, :3].min(axis=2), pieces[:, 3:].max(axis=2)
        least, most = whole[:, :3].min(axis=2), whole[:, 3:].max(axis=2)
        for i in range(len(pieces)):
            wanted = np.flatnonzero((least <= high[i]).all(axis=1) & (most >= low[i]).all(axis=1))
            used = near_boxes[first[i]:first[i + 1], 0] < 1e29
            np.testing.assert_array_equal(np.sort(near_nodes[first[i]:first[i + 1]][used]), wanted)


def test_hits_without_support_are_looked_behind(device, lanes):
    """The rim of a lone surfel lets rays through to a supported one; where that fails too, the last hit stays."""
    surface = clsurf.SlimSurface(
        2, 0.01, centers=[[0, 0, 1], [0.7, 0, 0]], radii=[1, 0.5], normals=[[0, 0, 1]] * 2,
        coefficients=np.zeros((2, 6)), level=[1, 1], leaf=[True, True], child_offset=[0, 0, 0],
        children=np.zeros(0, np.int32), fit_error=[0, 0])
    places = np.array([[0.2, 0, 5], [0.7, 0, 5], [0.75, 0.35, 5]])  # support 0.88; 0.13, then 1; none, then 0.125
    hits = clsurf.trace(surface, places, (0, 0, -1), device=device)
    np.testing.assert_allclose(hits.distance, [4, 5, 5], atol=1e-5)
    assert hits.primitive.tolist() == [0, 1, 1]
    for place, distance in zip(places, hits.distance, strict=True):
        assert abs(twin.ray_slim(twin.Leaves(surface), place, (0, 0, -1))[0] - distance) < 1e-5


# Leaks ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [0, 1000.0])
def test_no_ray_leaks_at_edges_and_vertices(device, shift):
    """Rays aimed at points of edges and at vertices hit a closed mesh, an even number of times."""
    mesh = sphere_mesh()
    mesh = Mesh(mesh.vertices + np.float32(shift), mesh.faces)
    rng = np.random.default_rng(7)
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    which, side, t = rng.integers(0, len(corners), 60_000), rng.integers(0, 3, 60_000), rng.uniform(0, 1, (60_000, 1))
    t[:20_000] = 0  # vertices
    t[20_000:25_000] = 0.5
    targets = corners[which, side] * (1 - t) + corners[which, (side + 1) % 3] * t
    origins = shift + np.round(2 * twin.unit(rng.normal(size=targets.shape)), 2)
    origins[::3] = targets[::3] + np.array([0, 0, 3.0])  # along an axis: products are exactly equal
    targets = np.where(rng.uniform(size=(60_000, 1)) < 0.5, targets, np.float32(targets))
    inner = np.einsum("ij,ij->i", twin.unit(targets - origins), targets - shift) < -0.1  # not the outline
    hits = clsurf.trace(mesh, origins[inner], (targets - origins)[inner], "all", device=device)
    counts = np.diff(hits.offsets)
    assert inner.sum() > 14_000 and (counts > 0).all() and (counts % 2 == 0).all()


def test_grid_of_exact_hits(device, lanes):
    """Rays along an axis through every vertex, edge middle and face middle of a flat grid hit it exactly once."""
    n = 9
    y, x = np.mgrid[:n, :n].astype(np.float32)
    cell = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([cell, cell + 1, cell + n + 1], 1), np.stack([cell, cell + n + 1, cell + n], 1)])
    mesh = Mesh(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), faces)
    v, u = (np.mgrid[1:2 * (n - 1), 1:2 * (n - 1)] / 2).reshape(2, -1)
    for up in (1, -1):
        hits = clsurf.trace(mesh, np.stack([u, v, 0 * u + up], 1), (0, 0, -up), "all", device=device)
        assert (np.diff(hits.offsets) == 1).all() and np.abs(hits.distance - 1).max() < 1e-6


# The renderer --------------------------------------------------------------------------------------------------------


def test_traced_depth_is_the_rendered_depth_of_slim(device, lanes, torus):
    """The same pixels are hit, at the same depth and normal; perspective and orthographic."""
    _, surface = torus
    for camera in (Camera.framing(surface), Camera.orthographic((3, 2, 4), (0, 0, 0), height=2.5)):
        origins, directions = camera.rays((90, 70))
        hits = clsurf.trace(surface, origins, directions, device=device)
        with Renderer(device) as renderer:
            frame = renderer.render(surface, camera, (90, 70), lod=0)
        depth = -((hits.position - camera.eye) @ camera.rotation[2]).reshape(70, 90)
        both = np.isfinite(depth) & np.isfinite(frame.depth)
        assert both.sum() > 1000 and (np.isfinite(depth) != np.isfinite(frame.depth)).sum() <= 3
        assert np.percentile(np.abs(depth - frame.depth)[both], 99.5) < 1e-5 * surface.diagonal
        cosine = (hits.normal.reshape(70, 90, 3) * frame.normal).sum(axis=2)[both]
        assert np.percentile(cosine, 1) > 1 - 1e-5


def test_traced_depth_is_the_rendered_depth_of_patches(device, lanes):
    """A patch drawn as two triangles a cell has the traced depth; of several, overlaps are drawn from the interior."""
    y, x = np.mgrid[:17, :17]
    heights = (15 * np.sin(x * 0.7) * np.cos(y * 0.5)).astype(np.int8).ravel()
    patch = clsurf.PatchSurface([[-1, -1, 0]], [[0.125, 0, 0]], [[0, 0.125, 0]], [0.01], [17, 17], heights)
    sphere = clsurf.models.perfect_sphere()
    for surface, tight, wide in ((patch, 1e-6, 1e-5), (sphere, 1e-3, 0.05)):
        camera = Camera.framing(surface)
        origins, directions = camera.rays((90, 70))
        hits = clsurf.trace(surface, origins, directions, device=device)
        with Renderer(device) as renderer:
            frame = renderer.render(surface, camera, (90, 70),
                                    patches=PatchDrawing(cells="triangles", mip=False, direct=False))
        depth = -((hits.position - camera.eye) @ camera.rotation[2]).reshape(70, 90)
        both = np.isfinite(depth) & np.isfinite(frame.depth)
        apart = np.abs(depth - frame.depth)[both]
        assert both.sum() > 1000 and (np.isfinite(depth) != np.isfinite(frame.depth)).sum() <= 3
        assert np.median(apart) < tight and np.percentile(apart, 99.5) < wide
        assert (hits.primitive[hits.hit] < len(surface)).all()


def test_transparent_cells_are_missed(device):
    """A patch with a transparent node has a hole of its four cells."""
    colors = np.full((25, 3), 200, np.uint8)
    colors[12] = 0
    patch = clsurf.PatchSurface([[0, 0, 0]], [[1, 0, 0]], [[0, 1, 0]], [1.0], [5, 5], np.zeros(25, np.int8), colors)
    y, x = np.mgrid[:8, :8].reshape(2, -1) / 2 + 0.25
    hits = clsurf.trace(patch, np.stack([x, y, 0 * x + 5], 1), (0, 0, -1), device=device)
    hole = (np.abs(x - 2) < 1) & (np.abs(y - 2) < 1)
    assert (hits.hit == ~hole).all() and (hits.primitive[~hole] == 0).all()


# Scenes --------------------------------------------------------------------------------------------------------------


def similarity(scale, shift, seed):
    """A random rotation, times a scale, and a shift."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = scale * q * np.sign(np.linalg.det(q))
    matrix[:3, 3] = shift
    return matrix


def test_moved_and_scaled_copies(device, lanes, sphere):
    """A placed surface is hit as the surface by the rays moved back; a scene's nearest surface wins."""
    origins, directions = random_rays(500, 8)
    plain = clsurf.trace(sphere, origins, directions, device=device)
    matrix = similarity(250.0, (1e6, -2e6, 3e5), 9)
    far = clsurf.trace(sphere.moved(matrix), origins @ matrix[:3, :3].T + matrix[:3, 3],
                       directions @ matrix[:3, :3].T, device=device)
    np.testing.assert_allclose(far.distance, 250 * plain.distance, rtol=1e-5)
    np.testing.assert_allclose(far.normal, plain.normal @ matrix[:3, :3].T / 250, atol=1e-4)
    shift = np.eye(4)
    shift[0, 3] = 5
    scene = Scene([sphere.moved(shift), sphere])
    from_left = clsurf.trace(scene, (-5, 0, 0), (1, 0.01, 0.01), device=device)
    from_right = clsurf.trace(scene, (15, 0, 0), [[-1, 0.01, 0.01], [0, 1, 0]], device=device)
    assert from_left.surface == 1 and abs(from_left.distance - 4) < 0.02
    assert from_right.surface.tolist() == [0, -1] and abs(from_right.distance[0] - 9) < 0.02
    through = clsurf.trace(scene, (-5, 0, 0), (1, 0.01, 0.01), "all", device=device)
    assert through.surface.tolist() == [1, 1, 0, 0] and (np.diff(through.distance) > 0).all()
    np.testing.assert_allclose(through.distance, [4, 6, 9, 11], atol=0.05)
    mixed = clsurf.trace([placed(sphere_mesh(), shift), sphere], (15, 0, 0), (-1, 0, 0), device=device)
    assert mixed.surface == 0


# Queries -------------------------------------------------------------------------------------------------------------


def test_all_hits_of_a_sphere_come_in_pairs(device, lanes, sphere):
    """A closed SLIM surface is entered and left; the first hit is the closest one; any is hit where closest is."""
    origins, directions = random_rays(1000, 10)
    closest = clsurf.trace(sphere, origins, directions, device=device)
    found = clsurf.trace(sphere, origins, directions, "all", device=device)
    some = clsurf.trace(sphere, origins, directions, "any", device=device)
    assert (np.diff(found.offsets) == 2).mean() > 0.995 and (np.diff(found.distance)[::2] > 0).all()
    np.testing.assert_allclose(found.distance[found.offsets[:-1]], closest.distance, rtol=1e-12)
    assert (some.hit == closest.hit).all() and some.hit.all()


def test_limits(device, lanes):
    """Hits before `near` and behind `far` do not count; limits may differ by ray."""
    mesh = sphere_mesh()
    from_middle = clsurf.trace(mesh, (0, 0, 0), (0.1, 0.2, 1), near=[0, 1.1, 0], far=[2, 3, 0.5], device=device)
    assert from_middle.hit.tolist() == [True, False, False]
    behind = clsurf.trace(mesh, (0.01, 0.02, 3), (0, 0, -1), near=2.5, device=device)
    assert abs(behind.distance - 4) < 0.01
    every = clsurf.trace(mesh, (0.01, 0.02, 3), (0, 0, -1), "all", near=2.5, far=3.5, device=device)
    assert len(every.distance) == 0 and every.offsets.tolist() == [0, 0]


def test_results_do_not_depend_on_order_or_chunks(device, sphere, monkeypatch):
    """Shuffled rays, small chunks and slabs, and NumPy in place of float64 kernels give the same hits."""
    origins, directions = random_rays(3000, 11, inside=1.3)
    hits = clsurf.trace(sphere, origins, directions, device=device)
    order = np.random.default_rng(12).permutation(3000)
    shuffled = clsurf.trace(sphere, origins[order], directions[order], device=device)
    np.testing.assert_array_equal(shuffled.distance, hits.distance[order])
    np.testing.assert_array_equal(shuffled.normal, hits.normal[order])
    monkeypatch.setattr(tracers, "CHUNK", 256)
    monkeypatch.setattr(tracers, "SLAB", 1024)
    seen = []
    again = clsurf.trace(sphere, origins, directions, device=device, progress=lambda *step: seen.append(step))
    np.testing.assert_array_equal(again.position, hits.position)
    assert len(seen) == 12 and seen[-1] == ("trace", 1.0)
    monkeypatch.setattr(tracers, "has_doubles", lambda device: False)
    for query in ("closest", "any"):
        host = clsurf.trace([sphere_mesh(), sphere], origins, directions, query, device=device)
        monkeypatch.undo()
        both = clsurf.trace([sphere_mesh(), sphere], origins, directions, query, device=device)
        monkeypatch.setattr(tracers, "has_doubles", lambda device: False)
        assert (host.hit == both.hit).mean() > 0.999
        same = host.hit & both.hit & (host.surface == both.surface)
        np.testing.assert_allclose(host.distance[same], both.distance[same], rtol=1e-5)
        np.testing.assert_allclose(host.normal[same], both.normal[same], atol=1e-3)
