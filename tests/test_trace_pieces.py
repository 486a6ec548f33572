"""Surfaces larger than a device's largest buffer or memory: every kind is traced in parts, to the hits of the whole."""

import pickle

import numpy as np
import pytest
from conftest import scan_path
from reference.ray_scenes import torus_mesh
from reference.small_device import small
from reference.surfaces import leaves

import clsurf
from clsurf import models
from clsurf.errors import DeviceMemoryError
from clsurf.surface.placed import placed
from clsurf.trace import pieces

FORMS = (16, 1)
# What limits the largest buffer, so that a device holds a third to an eighth of each.
LIMITS = {"mesh": 200_000, "slim": 60_000, "cubic": 60_000, "patches": 300_000, "surfels": 60_000, "hybrid": 200_000,
          "scale_map": 60_000}


@pytest.fixture(scope="module")
def things(device):
    scan = torus_mesh(120, 60)
    return {
        "mesh": scan,
        "slim": clsurf.build_slim(scan, error=0.002, device=device),
        "cubic": clsurf.build_slim(scan, error=0.001, degree=3, device=device),
        "patches": models.earth(patches=64),
        "surfels": clsurf.build_surfels(scan, device=device),
        "hybrid": clsurf.build_surfels(scan, hybrid=True, device=device),
        "scale_map": clsurf.build_scale_map(models.earth(patches=32), size=48, device=device),
    }


def rays_at(thing, count=6000, seed=0):
    """Return rays from a sphere around a surface toward it."""
    random = np.random.default_rng(seed)
    middle, size = thing.bounds.mean(axis=0), np.linalg.norm(np.ptp(thing.bounds, axis=0))
    origins = random.normal(size=(count, 3))
    origins *= size / np.linalg.norm(origins, axis=1, keepdims=True)
    aims = random.uniform(*(thing.bounds - middle), (count, 3))
    return origins + middle, aims - origins


def fresh(thing):
    """Return a copy, of which the device holds nothing."""
    return pickle.loads(pickle.dumps(thing))


def parts(device, thing, blending):
    one = pieces.held(device, thing)
    count = lambda piece: 1 if piece.halves is None else sum(map(count, piece.halves))  # noqa: E731
    return count(one.pieces[blending and one.plan.radii is not None])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", LIMITS)
def test_parts_are_hit_where_the_whole_is(things, device, monkeypatch, kind, form):
    monkeypatch.setattr(device, "lanes", form)
    thing, size = things[kind], np.linalg.norm(np.ptp(things[kind].bounds, axis=0))
    rays = rays_at(thing)
    wanted = {query: clsurf.trace(thing, *rays, query, device=device) for query in ("closest", "any", "all")}
    thing = fresh(thing)
    with small(device, LIMITS[kind]):
        got = {query: clsurf.trace(thing, *rays, query, device=device) for query in wanted}
        assert parts(device, thing, True) >= 3
    want, have = wanted["closest"], got["closest"]
    np.testing.assert_array_equal(have.hit, want.hit)
    np.testing.assert_allclose(have.position, want.position, rtol=0, atol=3e-6 * size)
    np.testing.assert_allclose(have.normal, want.normal, rtol=0, atol=2e-5)
    assert (have.primitive != want.primitive).mean() < 0.01  # where discs cross, rounding tells
    if kind in ("mesh", "patches", "hybrid", "scale_map"):  # one frame, one primitive a hit: to the byte
        np.testing.assert_array_equal(have.distance, want.distance)
        np.testing.assert_array_equal(got["all"].distance, wanted["all"].distance)
    np.testing.assert_array_equal(got["any"].hit, wanted["any"].hit)
    # A ray along a sheet may meet it once or twice there.
    counts, have_counts = np.diff(wanted["all"].offsets), np.diff(got["all"].offsets)
    assert (counts != have_counts).mean() < (1e-3 if kind in ("slim", "cubic", "surfels") else 1e-9)
    apart = np.abs(got["all"].distance[np.repeat(counts == have_counts, have_counts)]
                   - wanted["all"].distance[np.repeat(counts == have_counts, counts)])
    assert (apart < 1e-5 * size).mean() > 0.9999


def test_memory_is_kept_to(things, device):
    """Scenes whose surfaces fit alone, but not together with each other and the rays."""
    scene = [things["mesh"], placed(things["slim"], shift(2.0)), things["surfels"], things["scale_map"]]
    rays = rays_at(things["mesh"])
    wanted = clsurf.trace(scene, *rays, device=device)
    everything = clsurf.trace(scene, *rays, "all", device=device)
    again = [fresh(thing) for thing in scene]
    with small(device, 2_000_000, 2_500_000) as used:
        got = clsurf.trace(again, *rays, device=device)
        both = clsurf.trace(again, *rays, "all", device=device)
    assert used["most"] <= 2_500_000
    np.testing.assert_array_equal(got.surface, wanted.surface)
    np.testing.assert_allclose(got.distance[got.hit], wanted.distance[got.hit], rtol=1e-5)
    np.testing.assert_array_equal(both.offsets, everything.offsets)


def test_many_rays_go_in_batches(things, device):
    """More rays than the largest buffer holds, with their limits, on a surface that fits."""
    origins, directions = rays_at(things["scale_map"], 30_000)
    far = np.random.default_rng(1).uniform(0, 2, 30_000) * np.linalg.norm(np.ptp(things["scale_map"].bounds, axis=0))
    wanted = clsurf.trace(things["scale_map"], origins, directions, far=far, device=device)
    with small(device, 300_000):
        got = clsurf.trace(things["scale_map"], origins, directions, far=far, device=device)
    np.testing.assert_array_equal(got.distance, wanted.distance)
    assert 0.2 < got.hit.mean() < 0.8


@pytest.mark.parametrize("form", FORMS)
def test_hits_without_support_are_looked_behind_across_parts(device, monkeypatch, form):
    """The rims of lone surfels are hit only where the wall in another part is not."""
    monkeypatch.setattr(device, "lanes", form)
    wall, lone = grid(41, 0.05, 0.0), grid(6, 0.5, 2.0)
    others = grid(41, 0.05, 6.0)[:len(wall) - len(lone)]  # so that the first cut is halfway before the wall
    centers = np.concatenate([wall, lone, others])
    radii = np.repeat([0.1, 0.2, 0.1], [len(wall), len(lone), len(others)])
    thing = leaves(centers, radii, np.tile([1.0, 0, 0], (len(centers), 1)), np.zeros((len(centers), 1)), 1)
    random = np.random.default_rng(3)
    origins = np.concatenate([np.full((8000, 1), 4.0), random.uniform(-1.6, 1.6, (8000, 2))], axis=1)
    wanted = {query: clsurf.trace(thing, origins, (-1.0, 0, 0), query, device=device) for query in ("closest", "all")}
    on_lone = wanted["closest"].position[:, 0] > 1
    behind = on_lone & (np.abs(origins[:, 1:]).max(axis=1) > 1.2)  # where there is no wall, rims and all
    assert behind.sum() > 100 and behind.sum() < on_lone.sum() < wanted["closest"].hit.sum() - 1000
    with small(device, 100_000):
        thing = fresh(thing)
        got = {query: clsurf.trace(thing, origins, (-1.0, 0, 0), query, device=device) for query in wanted}
        assert parts(device, thing, True) >= 2
    np.testing.assert_allclose(got["closest"].distance, wanted["closest"].distance, atol=1e-5)
    np.testing.assert_array_equal(got["all"].offsets, wanted["all"].offsets)
    np.testing.assert_allclose(got["all"].distance, wanted["all"].distance, atol=1e-5)


def test_gaps_between_discs_are_closed_across_parts(device):
    """A rim counts where what is behind it is seen from behind, whichever part that is in: 44 rays of the bunny."""
    thing = clsurf.build_surfels(clsurf.load(scan_path("bunny/bunny.obj")), device=device)
    rays, size = rays_at(thing, 200_000), np.linalg.norm(np.ptp(thing.bounds, axis=0))
    wanted = clsurf.trace(thing, *rays, device=device)
    with small(device, 400_000):
        thing = fresh(thing)
        got = clsurf.trace(thing, *rays, device=device)
        assert parts(device, thing, True) >= 3
    np.testing.assert_array_equal(got.hit, wanted.hit)
    assert (np.abs(got.distance[got.hit] - wanted.distance[got.hit]) > 1e-5 * size).sum() <= 2


def test_what_cannot_be_cut_is_told(things, device):
    for kind in ("mesh", "slim", "surfels", "scale_map"):
        with small(device, 500), pytest.raises(DeviceMemoryError):
            clsurf.trace(fresh(things[kind]), *rays_at(things[kind], 10), device=device)


def shift(x):
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def grid(side, step, x):
    y, z = np.meshgrid(*[(np.arange(side) - (side - 1) / 2) * step] * 2)
    return np.stack([np.full(side * side, x), y.ravel(), z.ravel()], axis=1)
