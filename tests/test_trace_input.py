"""What callers of trace may give it: shapes, limits, odd rays and surfaces, mistakes."""

import numpy as np
import pytest
from reference.ray_scenes import slim_sphere, sphere_mesh

import clsurf
from clsurf import Mesh
from clsurf.errors import Cancelled, InputError
from clsurf.trace.kinds import ANY, CLOSEST
from clsurf.trace.pieces import traced


@pytest.fixture(scope="module")
def sphere(device):
    return slim_sphere(device)


def test_shapes(device):
    """Rays come in any shape, single ones too; origins and directions broadcast."""
    mesh = sphere_mesh()
    one = clsurf.trace(mesh, (0, 0, 3), (0, 0.1, -1), device=device)
    assert one.distance.shape == () and one.position.shape == (3,) and one.hit.shape == ()
    grid = clsurf.trace(mesh, np.zeros((4, 1, 3)), np.ones((5, 3)), device=device)
    assert grid.distance.shape == (4, 5) and grid.normal.shape == (4, 5, 3) and "20 of 20" in repr(grid)
    none = clsurf.trace(mesh, np.zeros((0, 3)), (1, 0, 0), device=device)
    assert none.distance.shape == (0,) and none.position.shape == (0, 3)
    every = clsurf.trace(mesh, np.zeros((0, 3)), (1, 0, 0), "all", device=device)
    assert every.offsets.tolist() == [0] and every.position.shape == (0, 3) and "0 of 0" in repr(every)


# Odd input -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("query", ["closest", "any", "all"])
def test_odd_rays_miss(device, lanes, sphere, query):
    """Zero, tiny, huge and undefined directions and origins."""
    directions = np.array([[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 1], [1e-300, 0, 0], [-1e300, 1e290, 0], [0, -1, 0]])
    for thing in (sphere, sphere_mesh()):
        hits = clsurf.trace(thing, (0.1, 0.2, 0.05), directions, query, device=device)
        assert hits.hit.tolist() == [False, False, False, True, True, True]
        origins = np.array([[np.nan, 0, 0], [0, np.inf, 0], [1e9, 0, 0], [1e7, 0.1, 0.2], [3, 0.1, 0.2]])
        hits = clsurf.trace(thing, origins, (-1, 0, 0), query, device=device)
        assert hits.hit.tolist() == [False, False, True, True, True]


@pytest.mark.parametrize("limit", [np.inf, np.nan, 3.4e38])
def test_rays_without_a_farthest_limit_end(device, lanes, sphere, limit):
    """Kernels given rays that nothing limits, which `trace` itself clips to the box: one hits, one misses."""
    ball = clsurf.build_scale_map(sphere_mesh(), size=8, device=device)
    surfels = clsurf.build_surfels(clsurf.models.torus(500), map_size=4, device=device)
    lines = np.float32([[0.02, 0.03, -9, 0, 0, 0, 1, limit], [0.02, 9, -9, 0, 0, 0, 1, limit]])
    for thing, bottom in ((sphere, -1), (sphere_mesh(), -1), (ball, -1), (surfels, None)):
        held = traced(device, thing)
        rays, hits = device.upload(lines), device.empty((2, 8), np.float32)
        for mode in (CLOSEST, ANY):
            held.launch(mode, 2, rays, hits)
            z = (device.download(hits)[:, 0] - 9) * held.unit + held.center[2]
            assert np.isinf(z[1]) and (bottom is None or abs(z[0] - bottom) < 3e-2 or mode == ANY)


def test_odd_meshes(device, lanes):
    """One triangle, none, no area, vertices that are not finite; huge, tiny and far coordinates."""
    corners = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    origin, direction = (0.2, 0.3, 5), (0, 0, -3)
    one = clsurf.trace(Mesh(corners, [[0, 1, 2]]), origin, direction, device=device)
    assert abs(one.distance - 5) < 1e-6
    for vertices, faces in ((corners, np.zeros((0, 3), int)), (np.zeros((0, 3), np.float32), None),
                            (corners, [[0, 0, 0], [0, 1, 1]]), (np.float32([[0.2, 0.3, 0]] * 3), [[0, 1, 2]]),
                            (np.float32([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]]), [[0, 1, 2]])):
        for query in ("closest", "all"):
            assert not clsurf.trace(Mesh(vertices, faces), origin, direction, query, device=device).hit.any()
    for scale in (1e-20, 1e20):
        hits = clsurf.trace(Mesh(corners * np.float32(scale), [[0, 1, 2]]), np.multiply(origin, scale), direction,
                            device=device)
        np.testing.assert_allclose(hits.distance, 5 * scale, rtol=1e-5)
    survey = np.array([7691239.553, 512345.125, 250.25])
    hits = clsurf.trace(Mesh(survey + corners, [[0, 1, 2]]), survey + origin, direction, device=device)
    np.testing.assert_allclose(hits.distance, 5, rtol=1e-6)
    np.testing.assert_allclose(hits.position, np.add(survey, (0.2, 0.3, 0)), atol=1e-6)


def test_odd_surfaces(device, lanes, sphere):
    """No surfel, one surfel, surfels that are not finite, no patch."""
    def cut(keep, **changed):
        fields = {name: getattr(sphere, name) for name in sphere.__dataclass_fields__}
        for name in ("centers", "radii", "normals", "coefficients", "level", "leaf", "fit_error", "footprint"):
            fields[name] = None if fields[name] is None else fields[name][keep]
        links = {"child_offset": np.zeros(len(fields["radii"]) + 1, np.int32), "children": np.zeros(0, np.int32)}
        return clsurf.SlimSurface(**{**fields, **links, **changed})
    none, leaf = cut([]), np.flatnonzero(sphere.leaf)[:1]
    assert not clsurf.trace(none, (0, 0, 5), (0, 0, -1), device=device).hit
    one = cut(leaf)
    at = one.centers[0].astype(float) + one.origin
    assert clsurf.trace(one, at * 3, -at, device=device).hit and not clsurf.trace(one, at * 3, at, device=device).hit
    assert clsurf.trace(one, at * 3, -at, "any", device=device).hit
    broken = cut(leaf, radii=[np.nan])
    assert not clsurf.trace(broken, at * 3, -at, device=device).hit
    empty = clsurf.PatchSurface(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), [], (17, 17),
                                np.zeros(0, np.int8))
    assert not clsurf.trace(empty, (0, 0, 5), (0, 0, -1), device=device).hit
    assert not clsurf.trace([], (0, 0, 5), (0, 0, -1), device=device).hit


def test_rays_from_inside_and_from_the_surface(device, sphere):
    """From inside, the back is hit with its normal toward the ray; `near` steps over the surface a ray starts on."""
    inside = clsurf.trace(sphere, (0.1, 0, 0), (0, 0, 1), device=device)
    assert abs(inside.distance - np.sqrt(0.99)) < 0.01 and inside.normal[2] < -0.9
    start = clsurf.trace(sphere, (0.1, 0.1, 3), (0, 0, -1), device=device).position
    onward = clsurf.trace(sphere, start, (0, 0, -1), near=0.02, device=device)
    assert abs(onward.distance - 2 * start[2]) < 0.02


def test_mistakes_are_told(device):
    """Every mistake gives one line that says what was expected."""
    mesh = sphere_mesh()
    for wrong, words in (
            (lambda: clsurf.trace(mesh, (0, 0, 0), (0, 0, 1), "nearest", device=device), "query: expected one of"),
            (lambda: clsurf.trace(mesh, (0, 0), (0, 0, 1), device=device), "origins: expected an array of shape"),
            (lambda: clsurf.trace(mesh, np.zeros((3, 3)), np.ones((2, 3)), device=device), "broadcast"),
            (lambda: clsurf.trace(mesh, "here", (0, 0, 1), device=device), "arrays of numbers"),
            (lambda: clsurf.trace(mesh, (0, 0, 0), (0, 0, 1), near=np.nan, device=device), "got NaN"),
            (lambda: clsurf.trace(clsurf.PointCloud([[0, 0, 0.0]]), (0, 0, 0), (0, 0, 1), device=device),
             "got PointCloud: build a surface")):
        with pytest.raises(InputError, match=words) as caught:
            wrong()
        assert "\n" not in str(caught.value)
    with pytest.raises(Cancelled):
        clsurf.trace(mesh, (0, 0, 0), (0, 0, 1), device=device, progress=lambda *_: False)


def test_uploads_live_as_long_as_their_surface(device):
    """A second trace of the same surface puts nothing on the device; nothing is kept of one that is gone."""
    from clsurf.trace import pieces
    mesh = sphere_mesh(4, 6)
    clsurf.trace(mesh, (0, 0, 3), (0, 0.1, -1), device=device)
    kept = pieces._kept.__dict__[id(device)]
    first = kept[mesh]
    clsurf.trace(mesh, (0, 0, 3), (0, 0.1, -1), device=device)
    assert kept[mesh] is first
    count = len(kept)
    del mesh, first
    assert len(kept) == count - 1
