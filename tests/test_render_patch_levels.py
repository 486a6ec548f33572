"""Mip levels of patches, their choice on the device, and the culling of back faces."""


from dataclasses import replace

import numpy as np
import pytest
from reference import render_patch_modes as twin
from reference.patch_scenes import SIZE, globe, joined, rough
from scipy import ndimage
from test_surface_patch import bowls

from clsurf.build.quantize import quantized
from clsurf.models.basic import sphere
from clsurf.render.camera import Camera
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.patch_forms import cull_patches
from clsurf.render.patch_mips import halved, mip_levels, opaque_area, tent
from clsurf.render.patches import place_patches, project_patches, upload_patches
from clsurf.render.renderer import Renderer
from clsurf.render.shade import Shading
from clsurf.render.tiles import view_floats
from clsurf.surface.patch import PatchSurface
from clsurf.surface.srgb import to_linear


@pytest.mark.parametrize("nodes", (2, 3, 4, 5, 6, 7, 9, 16, 17))
def test_coarser_rows_keep_ends_and_straight_lines(nodes):
    weights = tent(nodes)
    assert weights.shape == ((nodes + 2) // 2, nodes)
    assert np.allclose(weights.sum(axis=1), 1) and weights[0, 0] == weights[-1, -1] == 1
    step = (nodes - 1) / (len(weights) - 1)
    assert np.allclose(weights @ np.arange(nodes), np.arange(len(weights)) * step)


@pytest.mark.parametrize("size", [(17, 9), (6, 8), (5, 2)])
def test_levels_keep_the_outline(size):
    """Corners stay where they are, border nodes on the border, and a plane stays that plane."""
    rng = np.random.default_rng(1)
    i, j = np.tile(np.arange(size[0]), size[1]), np.repeat(np.arange(size[1]), size[0])
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    surface = quantized(np.zeros((1, 3)), frame[:1] * 0.5, frame[1:2] * 0.25, 0.2 * i - 0.1 * j, size, precise=True)
    levels = mip_levels(surface)
    assert (levels[-1].size == 2).all()
    fine = surface.positions().reshape(size[1], size[0], 3)
    normal = np.cross(fine[0, -1] - fine[0, 0], fine[-1, 0] - fine[0, 0])
    normal /= np.linalg.norm(normal)
    for level in levels[1:]:
        nodes = level.positions().reshape(level.size[0, 1], level.size[0, 0], 3)
        for a, b in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
            assert np.abs(nodes[a, b] - fine[a, b]).max() < 2e-6
        assert np.abs((nodes - fine[0, 0]) @ normal).max() < 2e-5


def test_levels_weigh_colours_by_their_alpha():
    """One colour stays that colour whatever the alphas, which are averaged; what is nearly clear colours nothing."""
    rng = np.random.default_rng(6)
    alpha = rng.integers(1, 256, 81)
    flat = PatchSurface(np.zeros((1, 3)), [[1, 0, 0]], [[0, 1, 0]], [0.1], (9, 9), np.zeros(81, np.int8),
                        np.column_stack([np.full((81, 3), (200, 90, 30)), alpha]))
    level = halved(flat)
    assert np.abs(level.colors[:, :3].astype(int) - (200, 90, 30)).max() <= 1
    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16
    mean = (alpha.reshape(9, 9)[1:4, 1:4] * kernel).sum()
    assert abs(int(level.colors.reshape(5, 5, 4)[1, 1, 3]) - mean) <= 1
    clear = np.arange(81) % 2 == 1
    colors = np.where(clear[:, None], (0, 0, 255, 1), (255, 0, 0, 255))
    mixed = halved(replace(flat, colors=colors.astype(np.uint8)))
    assert (mixed.colors[:, 0] > 250).all() and (mixed.colors[:, 2] < 30).all()


def test_levels_average_linear_light_and_keep_most_of_what_shows():
    rng = np.random.default_rng(5)
    colors = np.where(rng.random((81, 1)) < 0.5, [[255, 255, 255]], [[1, 1, 1]])
    flat = PatchSurface(np.zeros((1, 3)), [[1, 0, 0]], [[0, 1, 0]], [0.1], (9, 9), np.zeros(81, np.int8), colors)
    level = halved(flat)
    inner = to_linear(level.colors.reshape(5, 5, 3)[1:-1, 1:-1] / 255)
    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16
    linear = to_linear(colors.reshape(9, 9, 3) / 255)
    wanted = [[(linear[j - 1:j + 2, i - 1:i + 2] * kernel[..., None]).sum(axis=(0, 1)) for i in (2, 4, 6)]
              for j in (2, 4, 6)]
    assert np.abs(inner - wanted).max() < 0.006  # 8 bits of sRGB
    surface = rough(20, (17, 17), holes=0.3)
    shares = [s.opaque.mean() for s in mip_levels(surface)[:3]]
    assert shares[1] > shares[0] and (halved(rough(3, holes=1.0)).opaque == 0).all()


def blobs(count=400, spacing=0.02):
    """A sphere of patches whose opaque part is a disc in the middle, away from all borders."""
    at = sphere(count)
    normals = at.points.astype(np.float64)
    side = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other, steps = np.cross(normals, side), np.arange(17) - 8
    i, j = np.tile(steps, 17), np.repeat(steps, 17)
    heights = np.sqrt(1 - spacing**2 * (i**2 + j**2)) - 1
    d = np.where(i**2 + j**2 <= 50, np.rint(heights / 0.001), -128).astype(np.int8)
    return PatchSurface(normals - 8 * spacing * (side + other), spacing * side, spacing * other,
                        np.full(count, 0.001), (17, 17), np.tile(d, count))


def test_patches_cover_far_away_what_they_cover_near(renderers):
    """Opaque parts that no border node shows: a far sphere of them keeps its disc, and levels their area."""
    surface = blobs()
    own = opaque_area(surface)
    assert own.min() > 0
    for level in mip_levels(surface)[1:]:
        assert (opaque_area(level) >= 0.9 * own).all() and opaque_area(level).mean() < 1.1 * own.mean()
    for distance in (10.0, 40.0, 120.0):
        camera = Camera.look_at((0, 0.6 * distance, 0.8 * distance), (0, 0, 0), fov=2 * 60 * 1.3 / distance)
        for renderer in renderers[:2]:
            near, far = (renderer.render(surface, camera, (48, 48), ("depth",),
                                         patches=PatchDrawing(mip=mip, direct=False)) for mip in (False, True))
            shown = [np.isfinite(frame.depth).sum() for frame in (near, far)]
            assert shown[0] > 300 and shown[1] == pytest.approx(shown[0], rel=0.05)


def test_levels_of_all_kinds():
    for surface in (bowls(2, colors=True)[0], bowls(2, precise=True)[0], bowls(2, colors=True, precise=True)[0],
                    joined(rough(2), rough(1, (4, 11)))):
        levels = mip_levels(surface)
        assert all(len(s) == len(surface) for s in levels)
        whole = [part.all() for part in np.split(surface.opaque, surface.node_offset[1:-1])]
        assert (levels[-1].size[whole] == 2).all() and (levels[-1].size < surface.size).any()
        low, high = surface.bounds
        reach = 1e-3 * np.ptp(surface.bounds, axis=0) + np.linalg.norm(surface.axis_z, axis=1).max()
        for level in levels:
            assert (level.bounds[0] >= low - reach).all() and (level.bounds[1] <= high + reach).all()
    mixed = joined(rough(2), rough(1, (4, 11)))
    assert np.array_equal(halved(mixed).displacements[:2 * 5 * 4], halved(rough(2)).displacements)


@pytest.mark.parametrize("distance", [4.0, 12.0, 40.0, 150.0])
def test_select_levels(renderers, distance):
    """The channel "level" says the levels that the twin chooses, and both forms draw the same."""
    surface = globe()
    camera = Camera.look_at((0, distance * 0.6, distance * 0.8), (0.3, 0, 0), fov=40)
    a, b, c = (r.render(surface, camera, SIZE, ("color", "depth", "level")) for r in renderers)
    for other in (b, c):
        assert all(np.array_equal(a.channels[n], other.channels[n], equal_nan=n != "level") for n in a.channels)
    view = view_floats(camera, SIZE, camera.rotation, camera.rotation @ (surface.origin - camera.eye))
    wanted = twin.select_levels(view, mip_levels(surface))
    shown = a.level[np.isfinite(a.depth)]
    assert set(np.unique(shown)) <= set(wanted) and len(shown) > 0
    assert abs(np.median(shown) - np.median(wanted)) <= 1
    plain = renderers[0].render(surface, camera, SIZE, ("level",), patches=PatchDrawing(mip=False))
    assert set(np.unique(plain.level)) <= {-1, 0}


def test_levels_leave_no_cracks(renderers):
    """Patches of different levels beside each other still cover the sphere, and lie on it."""
    surface = globe(120)
    for distance in (9.0, 12.0, 16.0, 24.0):
        camera = Camera.look_at((0, 0, distance), (0, 0, 0), fov=30)
        frame = renderers[0].render(surface, camera, (90, 90), ("depth", "level"))
        shown = np.isfinite(frame.depth)
        assert (ndimage.binary_fill_holes(shown) == shown).all()
    levels = set(np.unique(frame.level)) - {-1}
    assert max(levels) >= 1


def test_levels_alias_less(renderers):
    """Against a picture of 16 x 16 samples a pixel, a far chequered sphere is at least a third closer with levels."""
    surface = globe(60, checks=40)
    for distance in (20.0, 45.0):
        camera = Camera.look_at((0, 0.5 * distance, distance), (0, 0, 0), fov=20)
        fine = renderers[0].render(surface, camera, (160 * 4, 160 * 4), ("color",), "flat", supersampling=4,
                                   patches=PatchDrawing(mip=False)).color
        wanted = fine.reshape(40, 16, 40, 16, 4).mean(axis=(1, 3))
        error = [np.sqrt(np.mean((renderers[0].render(surface, camera, (40, 40), ("color",), "flat",
                                                      patches=PatchDrawing(mip=m)).color - wanted) ** 2))
                 for m in (True, False)]
        assert error[0] < 0.67 * error[1]


@pytest.mark.parametrize("camera", [Camera.look_at((0, 2, 3), (0, 0, 0)),
                                    Camera.look_at((0, 0.3, 1.4), (0, 0, 0), fov=90),
                                    Camera.look_at((0, 20, 30), (0, 0, 0), fov=8),
                                    Camera.orthographic((1, 2, 3), (0, 0, 0), height=2.3)])
@pytest.mark.parametrize("bump", [0.0, 0.05])
def test_cull_patches(device, camera, bump):
    """Only patches that show nothing but backs are left out, most of those are, and a closed surface looks the same."""
    surface = globe(60, bump)
    with Renderer(device) as r:
        frames = [r.render(surface, camera, SIZE, ("depth", "normal"), patches=PatchDrawing(cull=cull, mip=False))
                  for cull in (False, True)]
    for name, array in frames[0].channels.items():
        assert np.array_equal(array, frames[1].channels[name], equal_nan=True)
    upload = upload_patches(device, surface)
    view = device.upload(place_patches(upload, None, camera, SIZE, Shading()))
    projected = project_patches(device, upload, view, PatchDrawing())
    before = device.download(projected.rectangles)
    cull_patches(device, upload, upload, 1, None, view, projected)
    after = device.download(projected.rectangles)
    removed = (before[:, 0] <= before[:, 2]) & (after[:, 0] > after[:, 2])
    if camera.fov is not None:
        behind = twin.seen_from_behind(surface, camera.eye)
        assert behind[removed].all() and removed.sum() > 0.3 * (behind & (before[:, 0] <= before[:, 2])).sum()
    assert removed.sum() > 5
