"""SLIM surfaces on their way to the tiles: level of detail, projection, bounds, lists."""

import sys

import numpy as np
import pytest
from reference import render as twin
from reference.surfaces import fitted, leaves, sphere, torus_points, two_level_sphere

from clsurf.errors import InputError
from clsurf.render.camera import Camera
from clsurf.render.slim import height_bounds, place_slim, project_slim, select_slim, upload_slim
from clsurf.render.tiles import Scratch

LANES = (16, 8, 4, 1)


def staged(device, surface, camera, size, lod=4.0, lanes=16, balls=False):
    """Run select and project; return the upload, view, visited, records and footprints."""
    scratch, upload = Scratch(device, lanes), upload_slim(device, surface)
    view, visited_end = place_slim(upload, None, camera, size, lod)
    on_device = device.upload(view)
    visited = select_slim(device, scratch, upload, on_device, visited_end)
    records, footprints = project_slim(device, scratch, upload, on_device, upload.flags, visited, visited_end, balls)
    seen = device.download(visited).astype(bool) | (np.arange(upload.count) < visited_end)
    seen[surface.roots] = True
    return scratch, upload, view, seen, records, footprints


def cameras():
    return [Camera.look_at((0.4, 1.0, 3.2), (0, 0, 0)), Camera.orthographic((1, -2, 3), (0, 0, 0), height=3.0),
            Camera.look_at((1.0, 0.05, 0.1), (0.9, 0.6, 0.0))]  # the last one inside the tube


@pytest.fixture(scope="module", params=(1, 2, 3))
def torus(request):
    return fitted(*torus_points(3000), 0.2, request.param)


# Level of detail ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("lod", [0.0, 8.0, 20.0, 1000.0])
def test_select_slim(device, lanes, lod):
    surface = two_level_sphere()
    camera = Camera.look_at((0, 0, 4), (0, 0, 0))
    _, _, view, seen, _, footprints = staged(device, surface, camera, (200, 200), lod, lanes)
    wanted = twin.select_slim(view, surface)
    # Levels that are expanded as a whole may be marked without a search; the cut is what counts.
    cut = seen & (surface.leaf | twin.is_small(view, surface))
    assert (cut == twin.drawn(view, surface)).all()
    assert seen[wanted].all()
    full = device.download(footprints.full)
    assert ((full[:, 0] <= full[:, 2]) <= cut).all()


def test_the_cut_covers_and_is_coarser_far_away(device):
    surface = two_level_sphere()
    counts = []
    for distance in (4, 35, 37, 38, 60):
        camera = Camera.look_at((0, 0, distance), (0, 0, 0))
        full = device.download(staged(device, surface, camera, (200, 200), 8.0)[5].full)
        counts.append(int((full[:, 0] <= full[:, 2]).sum()))
    assert counts[0] == 600  # leaves alone
    assert counts[1] >= counts[2] >= counts[3] >= counts[4] and counts[4] <= 60


def test_inaccurate_surfels_count_as_large(device):
    """At 100 px every internal surfel is small enough; an error of 1/64 of that, in pixels, still refines them."""
    camera, size = Camera.look_at((0, 0, 30), (0, 0, 0)), (200, 200)
    pixel = 29 / camera.projection(size).fy  # world units, at the sphere's front
    for error, leaves_alone in ((0.0, False), (1.4 * pixel, False), (1.9 * pixel, True)):
        surface = two_level_sphere(error=error)
        _, _, view, _, _, footprints = staged(device, surface, camera, size, 100.0)
        full = device.download(footprints.full)
        shown = full[:, 0] <= full[:, 2]
        assert (shown <= twin.drawn(view, surface)).all()  # a thin piece may lie between the pixels
        assert shown[surface.leaf].any() == leaves_alone and shown[~surface.leaf].any() != leaves_alone


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("balls", (False, True))
def test_balls_have_their_own_size(device, lanes, balls):
    """Pictures of the balls show internal surfels at their own radius, others at the larger one that closes gaps."""
    surface = two_level_sphere()
    camera = Camera.look_at((0, 0, 30), (0, 0, 0))
    _, _, _, _, records, footprints = staged(device, surface, camera, (200, 200), 100.0, lanes, balls)
    full = device.download(footprints.full)
    shown = full[:, 0] <= full[:, 2]
    assert shown[~surface.leaf].any()
    scale = np.where(surface.leaf | balls, 1, twin.INTERNAL_SCALE)
    got = device.download(records)[shown, twin.RADIUS]
    np.testing.assert_allclose(got, (surface.radii * scale)[shown], rtol=1e-6)


def test_three_levels_with_shared_children(device):
    # 0 and 1 are roots with the common child 3; 2 is a small internal root; 3 has the leaf 4; 5 is a lonely leaf.
    k = np.zeros((6, 6))
    surface = leaves(np.zeros((6, 3)), [1, 1, 0.01, 0.5, 0.1, 0.2], np.tile([0, 0, 1.0], (6, 1)), k, 2,
                     level=[1, 1, 2, 2, 3, 3], leaf=[0, 0, 0, 0, 1, 1], child_offset=[0, 1, 3, 4, 5, 5, 5],
                     children=[3, 3, 2, 4, 4])
    camera = Camera.look_at((0, 0, 10), (0, 0, 0))
    for lod in (0.5, 2.0, 5.0, 15.0, 40.0):
        view, seen = staged(device, surface, camera, (100, 100), lod)[2:4]
        cut = seen & (surface.leaf | twin.is_small(view, surface))
        assert (cut == twin.drawn(view, surface)).all(), lod


# Projection -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("which", range(3))
def test_project_slim(device, torus, which, lanes):
    camera, size = cameras()[which], (90, 70)
    _, _, view, _, records, footprints = staged(device, torus, camera, size, lanes=lanes)
    full = device.download(footprints.full)
    shown = full[:, 0] <= full[:, 2]
    got, wanted = device.download(records)[shown].astype(np.float64), twin.project_slim(view, torus)[shown]
    fields = [f for f in range(32) if f not in (twin.FOOT_LO, twin.FOOT_HI)]
    scale = np.abs(wanted[:, fields]).max(axis=0) + 1e-3
    assert shown.sum() > 20
    assert (np.abs(got[:, fields] - wanted[:, fields]) / scale).max() < 2e-5
    buckets = device.download(footprints.buckets)[shown]
    keys = device.download(footprints.keys)[shown] & 0xFFFFFF00
    near = np.where(keys & 0x80000000, keys ^ 0x80000000, ~keys).astype(np.uint32).view(np.float32)
    assert np.abs(buckets.astype(int) - twin.bucket_of(view, near.astype(np.float64))).max() <= 1


def assert_blocks_hold_every_hit(device, surface, camera, size):
    """Brute force: no hit of any surfel, of either side, lies outside its blocks, its sides, or before its key."""
    _, _, view, _, _, footprints = staged(device, surface, camera, size)
    pixels = twin.pixel_centres(size)
    exact = twin.project_slim(view, surface)
    at, d = twin.local(exact, pixels)
    poly = twin.ray_poly(surface.degree, exact, at, d)
    arrays = footprints.full, footprints.core, footprints.keys
    full, core, keys = (device.download(a).astype(np.int64) for a in arrays)
    shown = full[:, 0] <= full[:, 2]
    near = keys & 0xFFFFFF00
    near = np.where(near & 0x80000000, near ^ 0x80000000, ~near & 0xFFFFFFFF).astype(np.uint32).view(np.float32)
    bx, by = pixels[:, 0].astype(int) // 4, pixels[:, 1].astype(int) // 4
    total = 0
    for bit, side in ((1, 1.0), (2, -1.0)):
        s, _, good = twin.ray_root(surface.degree, poly, side)
        with np.errstate(invalid="ignore"):
            t, r2 = exact[:, twin.T_REF] + s, ((at + s[..., None] * d) ** 2).sum(axis=-1)
        for blocks, radius in ((full, 1.0), (core, twin.ALPHA)):
            hit = good & (r2 < radius**2 - 1e-4) & (t > twin.opened(view).near + 1e-4)
            p, n = np.nonzero(hit)
            assert shown[n].all() and (keys[n] & bit).all()
            assert ((bx[p] >= blocks[n, 0]) & (bx[p] <= blocks[n, 2])).all()
            assert ((by[p] >= blocks[n, 1]) & (by[p] <= blocks[n, 3])).all()
            assert (t[p, n] > near[n] - 1e-4).all()
            total += len(p)
    assert total > 1000


@pytest.mark.parametrize("which", range(3))
def test_blocks_hold_every_hit(device, torus, which):
    assert_blocks_hold_every_hit(device, torus, cameras()[which], (90, 70))


def around_the_eye(degree, seed, count=200, spread=1.0):
    """Surfels whose balls reach the plane of an eye at the origin that looks along -z, centres up to `spread` radii to
    the sides: facing every way, half of them nearly that plane; their surfaces up to 0.9 radii off the centre."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3)) * np.where(np.arange(count) % 2, 1, 0.15)[:, None]
    normals[::2, 2] += 1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radii = rng.uniform(0.5, 1.5, count)
    centers = radii[:, None] * rng.uniform(-1, 1, (count, 3)) * [spread, spread, 1]
    order = np.array([0, 1, 1, 2, 2, 2, 3, 3, 3, 3])[:{1: 1, 2: 6, 3: 10}[degree]]
    k = rng.uniform(-0.2, 0.2, (count, len(order)))
    k[:, 0] = rng.uniform(-0.9, 0.9, count)
    return leaves(centers, radii, normals, k * radii[:, None] ** (1 - order), degree)


@pytest.mark.parametrize("fov, near", ((30, 0.0), (120, 0.0), (120, 0.3)))
@pytest.mark.parametrize("degree", (1, 2, 3))
def test_blocks_at_the_eyes_plane(device, degree, fov, near):
    """Bounds and sides of surfels that reach the eye's plane; those with their centre behind it need `crosses`."""
    for seed, spread in enumerate((1.0, 1.0, 2.0)):
        camera = Camera.look_at((0, 0, 0), (0, 0, -1), fov=fov, near=near)
        assert_blocks_hold_every_hit(device, around_the_eye(degree, seed, spread=spread), camera, (24, 18))


@pytest.mark.parametrize("lanes", LANES)
def test_surfels_beside_the_eye_are_not_listed(device, lanes):
    """A plain seen from 3 above it: the surfels along the eye's plane, right and left, touch no pixel. (Each used to
    get the whole picture, or most of it.)"""
    x, y = np.meshgrid(np.arange(-60.0, 61), np.arange(-8.0, 61), indexing="ij")
    centers = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    surface = leaves(centers, np.full(x.size, 1.2), np.tile([0, 0, 1.0], (x.size, 1)), np.zeros((x.size, 6)), 2)
    camera = Camera.look_at((0, 0, 3), (0, 10, 2), (0, 0, 1), fov=50)
    full = device.download(staged(device, surface, camera, (160, 120), lanes=lanes)[5].full).astype(int)
    blocks = np.maximum(full[:, 2] - full[:, 0] + 1, 0) * np.maximum(full[:, 3] - full[:, 1] + 1, 0)
    beside = np.abs(centers[:, 1]) < 2.5
    assert blocks[beside].sum() == 0 and blocks.sum() > 1000
    assert blocks.max() < 40 * 30  # and no other has the whole picture


def test_blocks_are_tight(device):
    """Seen edge-on, a flat surfel's blocks are a thin strip, not its ball's square."""
    surface = leaves([[0, 0.5 / 64, 0]], [1.0], [[0, 1.0, 0]], np.zeros((1, 6)), 2)
    camera = Camera.orthographic((0, 0, 5), (0, 0, 0), height=4)
    full = device.download(staged(device, surface, camera, (256, 256))[5].full)
    assert full[0, 2] - full[0, 0] + 1 in (32, 33, 34) and full[0, 3] - full[0, 1] + 1 <= 2


def test_height_bounds():
    rng = np.random.default_rng(3)
    angle, rho = rng.uniform(0, 2 * np.pi, 4000), np.sqrt(rng.uniform(0, 1, 4000))
    u, v = rho * np.cos(angle), rho * np.sin(angle)
    for degree, terms in ((1, 1), (2, 6), (3, 10)):
        k = rng.normal(0, 0.2, (50, terms))
        low, high, slope = height_bounds(degree, k)
        records = np.zeros((50, 32))
        halved = k.copy()
        if degree > 1:
            halved[:, 4] /= 2
        records[:, twin.K0:twin.K0 + min(terms, 6)] = halved[:, :6]
        records[:, twin.K6:twin.K6 + max(terms - 6, 0)] = k[:, 6:]
        h, gu, gv = twin.height(degree, records[None], u[:, None], v[:, None])
        h = np.clip(h, -1, 1)
        assert (h.min(axis=0) >= low - 1e-9).all() and (h.max(axis=0) <= high + 1e-9).all()
        assert (np.hypot(gu, gv).max(axis=0) <= slope + 1e-9).all()


def test_broken_surfels_are_not_drawn(device):
    good = sphere(200)
    radii, k, centers = good.radii.copy(), good.coefficients.copy(), good.centers.copy()
    radii[:20], k[20:40, 3], centers[40:60, 1] = 0, np.nan, np.inf
    radii[60:80] = -1
    bad = leaves(centers, radii, good.normals, k, 2)
    full = device.download(staged(device, bad, Camera.look_at((0, 0, 4), (0, 0, 0)), (100, 100))[5].full)
    shown = full[:, 0] <= full[:, 2]
    assert not shown[:80].any() and shown[80:].sum() == 120


def test_too_many_surfels(device, monkeypatch):
    monkeypatch.setattr(sys.modules["clsurf.render.slim"], "LARGEST_COUNT", 10)
    with pytest.raises(InputError, match="at most 10 surfels"):
        upload_slim(device, sphere(20))
