"""Every kernel of the conversion of range images against its float64 twin."""

import numpy as np
import pytest

from clsurf.build import patch_ranges, range_fields, range_fragments
from clsurf.surface.ranges import RangeImage, RangeScan
from tests.reference import patch_ranges as twin

SHAPE = (20, 27)


def wavy_image(shift=0.0, pose=None, seed=0, color=True):
    """A depth image of a wavy wall with a step of 0.5, a hole and missing samples."""
    rng = np.random.default_rng(seed)
    h, w = SHAPE
    v, u = np.mgrid[:h, :w]
    depth = 2 + 0.05 * np.sin(0.4 * u + shift) * np.cos(0.3 * v) + 0.01 * u
    depth[:, 18:] += 0.5
    depth[5:8, 6:9] = np.nan
    depth[rng.integers(0, h, 6), rng.integers(0, w, 6)] = 0
    colors = rng.integers(1, 256, (h, w, 4)).astype(np.uint8) if color else None
    return RangeImage(depth=depth, intrinsics=[[40, 0, 13], [0, 42, 9.5], [0, 0, 1]], pose=pose, color=colors)


def turned(angle, shift=(0, 0, 0)):
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = shift
    return pose


@pytest.fixture(scope="module")
def scan():
    return RangeScan([wavy_image(), wavy_image(0.1, turned(0.05, (0.03, 0.02, 0.01)), 1)])


@pytest.fixture(scope="module")
def field(scan, device):
    return range_fields.range_field(scan, device, lambda done: None)


@pytest.fixture(scope="module")
def fragments(field, device):
    return range_fragments.find_fragments(field, (9, 7), 1.2, device)


@pytest.fixture(scope="module")
def places(field, fragments):
    return patch_ranges.places_of(field, fragments, (9, 7), 1.2)


def host(field, device, image):
    """Positions (h, w, 3), weights and cells (h, w) of an image, from the device."""
    part = slice(field.first[image], field.first[image + 1])
    samples = device.download(field.samples)[part].astype(float).reshape(*SHAPE, 4)
    return samples[..., :3], samples[..., 3], field.cells[part].reshape(SHAPE) > 0


@pytest.mark.parametrize("kind", ["depth", "points"])
def test_range_samples(device, kind):
    image = wavy_image(pose=turned(0.7, (1, 2, 3)))
    matrix = image.pose[:3]
    if kind == "depth":
        matrix = matrix @ np.block([[np.linalg.inv(image.intrinsics), np.zeros((3, 1))], [0, 0, 0, 1]])
    else:
        image = RangeImage(points=image.sensor_points(), pose=image.pose)
    field = range_fields.range_field(RangeScan([image]), device, lambda done: None)
    got, _, _ = host(field, device, 0)
    expected = twin.range_samples(image.depth if kind == "depth" else image.points, matrix, kind == "depth")
    np.testing.assert_allclose(got + field.origin, expected, atol=2e-6)
    raw = device.download(range_fields.raw_samples(RangeScan([image]), field, device))[:, :3].reshape(*SHAPE, 3)
    np.testing.assert_allclose(raw, got, atol=0)


@pytest.mark.parametrize("lanes", [1, 16])
@pytest.mark.parametrize("radius", [1, 4])
def test_smooth_depth(device, lanes, radius, monkeypatch):
    monkeypatch.setattr(device, "lanes", lanes)
    rng = np.random.default_rng(2)
    disparity = 1 / wavy_image().depth + 0.004 * rng.normal(size=SHAPE).astype(np.float32)
    got = device.download(range_fields.smooth_depth(disparity, radius, 0.02, device))
    expected = twin.smooth_depth(disparity.astype(float), radius, 0.02)
    np.testing.assert_allclose(got, expected, rtol=3e-6)


def test_range_cells(device, scan, field):
    for k, image in enumerate(scan.images):
        points, _, cells = host(field, device, k)
        expected = twin.range_cells(points, field.eyes[k], range_fields.JUMP,
                                    range_fields.NOISE_STEPS * field.noise[k], 0, True)
        assert (cells == expected).all() and 300 < cells.sum() < 480, image
        assert not cells[:, 17].any(), "the step at column 18 is cut"


@pytest.mark.parametrize("squared", [False, True])
def test_range_cells_of_a_noisy_sensor(device, scan, field, squared):
    """Noise of half the step, as it is and over the squared distance: only then the step is no jump."""
    noise = 0.13 if squared else 0.3
    cells = device.zeros(field.cells.shape, np.uint8)
    device.kernel("build/range_cells.cl")((SHAPE[1], SHAPE[0]), (16, 1), *SHAPE, 0, *field.eyes[0], 5.0, noise, 0.0,
                                          int(squared), field.samples, cells)
    points, _, _ = host(field, device, 0)
    expected = twin.range_cells(points, field.eyes[0], 5.0, noise, 0, squared)
    assert (device.download(cells)[:expected.size].reshape(SHAPE) == expected).all()
    assert expected[:, 17].any() == squared


def test_range_cells_of_points(device):
    image = wavy_image()
    points = image.sensor_points()[..., [0, 1, 2]] * np.float32([1, 1, -1])
    field = range_fields.range_field(RangeScan([RangeImage(points=points)]), device, lambda done: None)
    got, _, cells = host(field, device, 0)
    pitch = float(field.pitch[0].prod() ** 0.5)
    noise = range_fields.NOISE_STEPS * field.noise[0]
    assert (cells == twin.range_cells(got, field.eyes[0], range_fields.JUMP, noise, pitch, False)).all()


def test_range_weights(device, field):
    for k in range(2):
        points, weights, cells = host(field, device, k)
        border = range_fields._border(field.cells, field.shapes, field.first)[field.first[k]:field.first[k + 1]]
        unit = float(np.median(field.pitch))
        expected = twin.range_weights(points, cells, border.reshape(SHAPE), field.eyes[k], unit, range_fields.RAMP)
        np.testing.assert_allclose(weights, expected, rtol=1e-4, atol=1e-6)


def test_fit_fragments(device, field, fragments):
    assert len(fragments) > 8
    for number, (rect, figures) in enumerate(zip(fragments.rects, fragments.figures, strict=True)):
        points, weights, _ = host(field, device, rect[0])
        mask = (fragments.labels == number)[field.first[rect[0]]:field.first[rect[0] + 1]].reshape(SHAPE)
        expected = twin.fit_fragments(points, weights, mask, field.signs[rect[0]], range_fragments.LEAST_FACING)
        np.testing.assert_allclose(figures, expected, rtol=2e-4, atol=2e-5)


def parts_of(field, device, fragments, number, rects):
    """What the twin of resample_ranges takes."""
    own = fragments.rects[number, 0]
    parts = []
    for image in [own, own, *(k for k in range(len(field.shapes)) if k != own)]:
        points, weights, cells = host(field, device, image)
        part = slice(field.first[image], field.first[image + 1])
        labels, colors = fragments.labels[part].reshape(SHAPE), field.colors[part].reshape(*SHAPE, 4)[..., :3]
        if image != own:
            mask = np.isin(labels, rects[rects[:, 1] == image, 6])
        elif not parts:
            mask = labels == number
        else:
            mask = np.zeros(SHAPE, bool)
            r = rects[0]
            mask[r[2]:r[2] + r[4], r[3]:r[3] + r[5]] = True
            mask &= cells & (labels != number)
        parts.append((points, weights, colors.astype(float), mask, field.signs[image]))
    return parts


def rects_of(field, fragments, places):
    """Return the rects of every patch: its surroundings in its own image, then fragments of others."""
    pairs = patch_ranges.fragment_pairs(fragments, places, (9, 7))
    others = pairs[pairs[:, 1] != fragments.rects[pairs[:, 0], 0]]
    rects = np.concatenate([patch_ranges.own_rects(field, fragments, np.arange(len(fragments))), others])
    return rects[np.argsort(rects[:, 0], kind="stable")]


def test_resample_ranges(device, field, fragments, places):
    numbers, rects = np.arange(len(fragments)), rects_of(field, fragments, places)
    heights, colors = patch_ranges.resampled(field, fragments, places, numbers, rects, (9, 7), device)
    packed, blended, flips = places.packed().astype(float), 0, 0
    for number in numbers:
        mine = rects[rects[:, 0] == number]
        parts = parts_of(field, device, fragments, number, mine)
        expected, light = twin.resample_ranges(packed[number], (9, 7), parts)
        blended += len(mine) > 1
        flips += int((np.isfinite(expected) != np.isfinite(heights[number])).sum())
        both = np.isfinite(expected) & np.isfinite(heights[number])
        np.testing.assert_allclose(heights[number][both], expected[both], atol=2e-5)
        assert np.abs(colors[number][both, :3] - light[both]).max(initial=0) <= 0.55
        assert (colors[number][..., 3] == 255 * np.isfinite(heights[number])).all()
    assert blended > 5 and flips <= 2  # nodes on the very rim of a cell


def test_resampled_rect_by_rect(device, monkeypatch, field, fragments, places):
    """Launches of one pass and a few rects each give what one launch gives."""
    numbers, rects = np.arange(len(fragments)), rects_of(field, fragments, places)
    wanted = patch_ranges.resampled(field, fragments, places, numbers, rects, (9, 7), device)
    most = int(np.bincount(rects[:, 0]).max())
    for step in (1, 2):
        monkeypatch.setattr(patch_ranges, "_launches", lambda *_, step=step: [
            (only, begin, min(begin + step, most), int(begin + step >= most))
            for only in (0, 1) for begin in range(0, most, step)])
        got = patch_ranges.resampled(field, fragments, places, numbers, rects, (9, 7), device)
        np.testing.assert_array_equal(got[0], wanted[0])
        np.testing.assert_array_equal(got[1], wanted[1])
    assert most > 2 and np.isfinite(wanted[0]).sum() > 100


def test_range_distances(device, field, fragments, places):
    size, reach = (9, 7), patch_ranges.INSIDE
    numbers = np.arange(len(fragments))
    heights, _ = patch_ranges.resampled(field, fragments, places, numbers,
                                        patch_ranges.own_rects(field, fragments, numbers), size, device)
    pairs = patch_ranges.fragment_pairs(fragments, places, size)
    codes, counts = patch_ranges.distances(field, fragments, places, pairs, heights, size, field.samples, device)
    pair, sample = patch_ranges._samples_at(field, pairs, counts, np.arange(len(codes)))
    packed, flips, found = places.packed().astype(float), 0, 0
    for k in range(0, len(pairs), 2):
        patch, image, number = pairs[k, 0], pairs[k, 1], pairs[k, 6]
        points, _, _ = host(field, device, image)
        mask = (fragments.labels == number)[field.first[image]:field.first[image + 1]].reshape(SHAPE)
        parity = np.add.outer(*map(np.arange, SHAPE)) % 2 == 0
        expected, wider, narrower = (twin.range_distances(
            packed[patch], size, heights[patch].astype(float), points, mask, parity, reach + more)
            for more in (0, 1e-5, -1e-5))
        clear = (wider == narrower).ravel()  # elsewhere rounding decides whether the patch goes on so far
        got = np.full(mask.size, 127, np.uint8)
        got[sample[pair == k] - field.first[image]] = codes[pair == k]
        flips += int((np.abs((got & 127).astype(int) - (expected.ravel() & 127)) > 1).sum())
        flips += int((((got & 128) != (expected.ravel() & 128)) & clear).sum())
        found += int((expected != 127).sum())
    assert found > 100 and flips <= 2
