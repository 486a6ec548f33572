"""Models larger than a device's largest buffer: every kind is drawn in parts, to the picture that it has as a whole."""

import contextlib

import numpy as np
import pytest
from reference.scale_map import smooth_map
from reference.small_device import small

import clsurf
from clsurf import models
from clsurf.errors import DeviceMemoryError
from clsurf.render import pieces

SIZE = (96, 80)
CHANNELS = ("color", "depth", "normal", "id")
# Of the diagonal: which of overlapping samples is seen, and what blends, may change at a cut; other runs of points are
# thinned otherwise. A pixel is 0.01.
OFF = {"mesh": 1e-6, "cloud": 1e-2, "patches": 1e-3, "surfels": 1e-2, "hybrid": 1e-2}


def colored(points, count):
    return np.concatenate([(255 * np.abs(points[:, :3]) / np.abs(points).max()).astype(np.uint8),
                           np.full((count, 1), 255, np.uint8)], axis=1)


def mesh():
    u, v = np.meshgrid(np.arange(240) * 2 * np.pi / 240, np.arange(120) * 2 * np.pi / 120, indexing="ij")
    points = np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v)], axis=-1).reshape(-1, 3)
    at = np.arange(240 * 120).reshape(240, 120)
    right, down = np.roll(at, -1, axis=0), np.roll(at, -1, axis=1)
    both = np.roll(right, -1, axis=1)
    faces = np.concatenate([np.stack([at, right, both], -1).reshape(-1, 3),
                            np.stack([at, both, down], -1).reshape(-1, 3)])
    return clsurf.Mesh(points, faces.astype(np.int32), colors=colored(points, len(points)))


def cloud():
    points = mesh().vertices
    return clsurf.PointCloud(points, colors=colored(points, len(points)), attributes={"height": points[:, 2]})


@pytest.fixture(scope="module")
def things(device):
    scan = mesh()
    return {
        "mesh": (scan, 16 * len(scan.vertices) // 6),
        "cloud": (cloud(), 16 * len(scan.vertices) // 6),
        "patches": (models.earth(patches=512), 8 * 512 * 289),
        "surfels": (clsurf.build_surfels(scan, device=device), None),
        "hybrid": (clsurf.build_surfels(scan, hybrid=True, device=device), None),
    }


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("kind", ("mesh", "cloud", "patches", "surfels", "hybrid"))
def test_parts_are_the_picture(things, device, monkeypatch, kind, lanes):
    thing, limit = things[kind]
    limit = 128 * len(thing) // 5 if limit is None else limit
    others = clsurf.Mesh(np.array([[-9.0, -9, -4], [9, -9, -4], [0, 9, -4]]), np.array([[0, 1, 2]]))
    camera = clsurf.Camera.framing(thing, direction=(0.4, -0.6, 1))
    scenes = [thing, [others, thing]]
    with clsurf.Renderer(device, lanes=lanes) as renderer:
        wanted = [renderer.render(scene, camera, SIZE, CHANNELS) for scene in scenes]
    smallest = 4 * 64 * 8 * 12 * 10  # the picture's own planes
    monkeypatch.setattr(device, "largest_buffer_bytes", max(limit, smallest))
    with clsurf.Renderer(device, lanes=lanes) as renderer:
        for scene, want in zip(scenes, wanted, strict=True):
            for _ in range(2):  # and again, with the parts known
                got = renderer.render(scene, camera, SIZE, CHANNELS)
                assert (got.id == want.id).mean() > 0.999
                both = got.id == want.id
                off = np.nan_to_num(np.abs(got.depth - want.depth))[both] / np.linalg.norm(np.ptp(thing.bounds, axis=0))
                assert (off <= OFF[kind]).mean() > 0.99
                assert (np.abs(got.color - want.color).max(axis=-1) < 0.02).mean() > (0.95 if kind == "cloud" else 0.99)
        assert len(renderer._pieces) >= 1


def test_attributes_keep_their_colours(device, monkeypatch):
    thing = cloud()
    camera = clsurf.Camera.framing(thing, direction=(0.4, -0.6, 1))
    drawing = clsurf.PointDrawing(attribute="height", eye_dome=False)
    with clsurf.Renderer(device) as renderer:
        wanted = renderer.render(thing, camera, SIZE, ("color",), points=drawing).color
    monkeypatch.setattr(device, "largest_buffer_bytes", 16 * len(thing.points) // 3)
    with clsurf.Renderer(device) as renderer:
        got = renderer.render(thing, camera, SIZE, ("color",), points=drawing).color
        assert len(renderer._pieces) >= 1
    assert (np.abs(got - wanted).max(axis=-1) < 0.05).mean() > 0.95


def test_halves_hold_everything():
    for thing in (mesh(), cloud(), models.earth(patches=32)):
        left, right = pieces.halves(thing)
        count = lambda one: len(one.faces) if hasattr(one, "faces") else len(getattr(one, "cloud", one).points) \
            if not hasattr(one, "displacements") else len(one)  # noqa: E731
        assert count(left) + count(right) == count(thing) and abs(count(left) - count(right)) <= 1
    lone = clsurf.Mesh(np.eye(3), np.array([[0, 1, 2]]))
    assert pieces.halves(lone) is None


def test_what_cannot_be_cut_is_told(device, monkeypatch):
    monkeypatch.setattr(device, "largest_buffer_bytes", 5000)
    with clsurf.Renderer(device) as renderer, pytest.raises(DeviceMemoryError):
        renderer.render(mesh(), size=(32, 32))


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("drawing", (clsurf.ScaleMapDrawing(), clsurf.ScaleMapDrawing("geosphere", 5)))
def test_maps_larger_than_a_device_are_drawn_in_parts(device, lanes, drawing):
    """Blocks, and layers, one after the other, to the picture of the whole."""
    base = smooth_map(48, f=bumpy)
    scales = np.concatenate([base.scales, base.scales * np.float32(0.7)])
    surface = clsurf.ScaleMap(base.center, base.radius, scales, np.concatenate([base.valid] * 2))
    camera = clsurf.Camera.framing(surface, direction=(0.4, -0.6, 1))
    channels = ("color", "depth", "normal", "id", "level")
    with clsurf.Renderer(device, lanes=lanes) as renderer:
        wanted = renderer.render(surface, camera, SIZE, channels, scale_map=drawing)
    again = clsurf.ScaleMap(base.center, base.radius, scales, surface.valid)
    with small(device, 400_000) as used, clsurf.Renderer(device, lanes=lanes) as renderer:
        for _ in range(2):
            got = renderer.render(again, camera, SIZE, channels, scale_map=drawing)
            for name in channels:
                # Where a ray meets the edge of a block, the first one drawn is seen.
                np.testing.assert_allclose(got.channels[name], wanted.channels[name], atol=1e-3, err_msg=name)
                assert (got.channels[name] != wanted.channels[name])[wanted.id >= 0].mean() < 0.01
    assert used["most"] > 400_000


@pytest.mark.parametrize("drawing", (clsurf.ScaleMapDrawing(), clsurf.ScaleMapDrawing("geosphere", 5)))
def test_layers_keep_their_numbers_in_parts(device, lanes, drawing):
    base = smooth_map(48)
    valid = np.concatenate([base.valid] * 2)
    valid[0, :, 16:32, 16:32] = False  # the second layer shows through
    scales = np.concatenate([base.scales, base.scales * np.float32(0.7)])
    surface = clsurf.ScaleMap(base.center, base.radius, scales, valid)
    camera = clsurf.Camera.framing(surface, direction=(0.4, -0.6, 1))
    levels = []
    for limit in (None, 400_000):
        with small(device, limit) if limit else contextlib.nullcontext(), clsurf.Renderer(device, lanes=lanes) as one:
            again = clsurf.ScaleMap(base.center, base.radius, scales, valid)
            levels.append(one.render(again, camera, SIZE, ("level",), scale_map=drawing).level)
    assert min((levels[0] == number).sum() for number in (0, 1)) > 100
    np.testing.assert_array_equal(*levels)


def bumpy(directions):
    return 1 + 0.1 * np.sin(7 * directions[..., 0]) * np.cos(5 * directions[..., 1])
