"""The lists of the bins: every kernel against its twin, and all of them together."""

import numpy as np
import pytest
from reference import render as twin
from reference.surfaces import fitted, torus_points
from test_render_project import cameras, staged

from clsurf.render.tiles import DEPTH_BUCKETS, Footprints, Grid, Layout, Scratch, bin_pairs, order_depths, scan

BINS = (9, 7)  # columns and rows


@pytest.fixture(scope="module")
def made():
    """500 random primitives: ranges of blocks of pass 2, of pass 1 within them or empty, keys and depth buckets."""
    rng, n = np.random.default_rng(7), 500
    low = rng.integers(0, (2 * BINS[0], 2 * BINS[1]), (n, 2))
    high = np.minimum(low + rng.integers(0, 6, (n, 2)), (2 * BINS[0] - 1, 2 * BINS[1] - 1))
    full = np.concatenate([low, high], axis=1).astype(np.int16)
    core = full + rng.integers(0, 2, (n, 4)).astype(np.int16) * np.array([1, 1, -1, -1], np.int16)
    core[core[:, 1] > core[:, 3]] = 1, 1, 0, 0
    full[rng.uniform(size=n) < 0.3] = 1, 1, 0, 0
    keys = rng.integers(0, 2**32, n, dtype=np.uint32) & np.uint32(0xFFFFFF03)
    buckets = rng.choice([0, 5, 6, 900, DEPTH_BUCKETS - 1], n).astype(np.uint16)
    return full, core, keys, buckets


def ordered(device, made):
    """The twin's order and the depth buckets' offsets, here and on the device."""
    full, _, _, buckets = made
    order = twin.order_depths(full, buckets)
    offsets = twin.scan_totals(twin.count_depths(full, buckets, 1, len(full))[0])
    return order, device.upload(order.astype(np.uint32)), device.upload(offsets.astype(np.uint32))


@pytest.mark.parametrize("parts", (1, 3, 16))
def test_count_depths(device, made, parts):
    full, _, _, buckets = made
    length = -(-len(full) // parts)
    counts = device.empty((parts, DEPTH_BUCKETS), np.uint32)
    device.kernel("render/count_depths.cl")((parts,), None, device.upload(full), device.upload(buckets), len(full),
                                            length, DEPTH_BUCKETS, counts)
    assert (device.download(counts) == twin.count_depths(full, buckets, parts, length)).all()


@pytest.mark.parametrize("parts", (1, 3, 16))
def test_order_depths(device, made, parts):
    full, _, _, buckets = made
    length = -(-len(full) // parts)
    places, totals = twin.scan_bins(twin.count_depths(full, buckets, parts, length))
    wanted = twin.order_depths(full, buckets)
    order, counts = device.zeros(len(full), np.uint32), device.empty(places.shape, np.uint32)
    device.write(counts, places)
    device.kernel("render/order_depths.cl")(
        (parts,), None, device.upload(full), device.upload(buckets), len(full), length, DEPTH_BUCKETS, counts,
        device.upload(twin.scan_totals(totals).astype(np.uint32)), order)
    assert (device.download(order)[:len(wanted)] == wanted).all()


@pytest.mark.parametrize("parts", (1, 3, 16))
def test_count_bins(device, made, parts):
    order, on_device, depth_offsets = ordered(device, made)
    counts = device.empty((parts, BINS[0] * BINS[1]), np.uint32)
    device.kernel("render/count_bins.cl")((parts,), None, on_device, depth_offsets, device.upload(made[0]), parts,
                                          BINS[0], BINS[0] * BINS[1], counts, counts)
    assert (device.download(counts) == twin.count_bins(order, made[0], parts, BINS[0], BINS[0] * BINS[1])).all()


@pytest.mark.parametrize("parts", (1, 3, 16))
def test_fill_bins(device, made, parts):
    full, core, keys, _ = made
    order, on_device, depth_offsets = ordered(device, made)
    places, totals = twin.scan_bins(twin.count_bins(order, full, parts, BINS[0], BINS[0] * BINS[1]))
    counts, pairs = device.empty(places.shape, np.uint32), device.empty((int(totals.sum()), 2), np.uint32)
    device.write(counts, places)
    device.kernel("render/fill_bins.cl")(
        (parts,), None, on_device, depth_offsets, device.upload(full), device.upload(core), device.upload(keys), parts,
        BINS[0], BINS[0] * BINS[1], counts, counts, device.upload(twin.scan_totals(totals).astype(np.uint32)), pairs)
    assert (device.download(pairs) == twin.fill_bins(order, full, core, keys, BINS[0], BINS[0] * BINS[1])).all()


@pytest.mark.parametrize("bins", (1, 63, 64, 65, 1000))
def test_scan_bins(device, bins):
    counts = np.random.default_rng(1).integers(0, 9, (5, bins)).astype(np.uint32)
    on_device, totals = device.empty((5, bins), np.uint32), device.empty(bins, np.uint32)
    device.write(on_device, counts)
    device.kernel("render/scan_bins.cl")((bins,), (64,), on_device, 5, bins, totals)
    places, wanted = twin.scan_bins(counts)
    assert (device.download(on_device) == places).all() and (device.download(totals) == wanted).all()


@pytest.mark.parametrize("bins", (1, 63, 64, 65, 1000))
def test_scan_totals(device, bins):
    totals = np.random.default_rng(2).integers(0, 9, bins).astype(np.uint32)
    offsets = device.empty(bins + 1, np.uint32)
    device.kernel("render/scan_totals.cl", constants={"GROUP": 64})((64,), (64,), device.upload(totals), bins, offsets)
    assert (device.download(offsets) == twin.scan_totals(totals)).all()


# Together -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", (1, 500, 20000))
def test_depth_order(device, made, count):
    """Many primitives: several parts, as the host divides them."""
    full, _, _, buckets = (np.resize(array, (count, *array.shape[1:])) for array in made)
    touch = Footprints(device.upload(full), None, None, device.upload(buckets))
    order, offsets = order_depths(device, Scratch(device, 16), touch, count)
    wanted = twin.order_depths(full, buckets)
    assert device.download(offsets)[-1] == len(wanted)
    assert (device.download(order)[:len(wanted)] == wanted).all()


@pytest.mark.parametrize("size", [(1, 1), (61, 43), (256, 128)])
def test_bin_lists(device, size):
    """The lists of a real picture, from the projection on, equal brute force."""
    torus = fitted(*torus_points(3000), 0.2, 2)
    scratch, upload, _, _, _, footprints = staged(device, torus, cameras()[0], size)
    bins = (-(-size[0] // 8), -(-size[1] // 8))
    pairs = bin_pairs(device, scratch, Grid(size, 4, Layout(), None, None), footprints, upload.count)
    full, core, keys, buckets = (device.download(a) for a in (footprints.full, footprints.core, footprints.keys,
                                                              footprints.buckets))
    order = twin.order_depths(full, buckets)
    assert (device.download(pairs.pairs) == twin.fill_bins(order, full, core, keys, bins[0], bins[0] * bins[1])).all()
    counts = twin.count_bins(order, full, 1, bins[0], bins[0] * bins[1])[0]
    assert (device.download(pairs.offsets) == twin.scan_totals(counts)).all() and pairs.total == counts.sum()


@pytest.mark.parametrize("bins", (1, 65))
def test_scan(device, bins):
    """The two scans after one another, as the stages use them."""
    counts = np.random.default_rng(1).integers(0, 9, (5, bins)).astype(np.uint32)
    on_device, totals, offsets = (device.empty(shape, np.uint32) for shape in ((5, bins), bins, bins + 1))
    device.write(on_device, counts)
    scan(device, on_device, 5, bins, totals, offsets)
    assert (device.download(offsets) == twin.scan_totals(counts.sum(axis=0))).all()
