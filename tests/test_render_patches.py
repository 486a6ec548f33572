"""Drawing spatial patches: exact on analytic surfaces, whole, independent of tiles, lanes and the order of patches."""

import numpy as np
import pytest
from reference import render_patches as twin
from test_render_patch_modes import joined, rough
from test_render_patch_modes import sheet as sheet_and_places

from clsurf.build.quantize import quantized
from clsurf.build.slim import build_slim
from clsurf.models import perfect_sphere
from clsurf.models.basic import torus
from clsurf.render.camera import Camera
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.patches import patch_constants, place_patches, prepare_patches, upload_patches
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Shading
from clsurf.surface.patch import PatchSurface

PLAIN = PatchDrawing(direct=False, mip=False)
SIZE = (96, 72)


@pytest.fixture(scope="module")
def renderers(device):
    """Renderers by (lanes, tile)."""
    kept = {}

    def get(lanes=None, tile=None):
        if (lanes, tile) not in kept:
            kept[lanes, tile] = Renderer(device, lanes=lanes, tile=tile)
        return kept[lanes, tile]

    yield get
    for renderer in kept.values():
        renderer.close()


def sheet(*arguments, **options):
    """One patch over the xy plane."""
    return sheet_and_places(*arguments, **options)[0]


def globe(count=80, nodes=9, radius=2.0, cover=1.5, origin=(0, 0, 0), precise=False):
    """Patches over a sphere; their borders overlap."""
    k = np.arange(count) + 0.5
    z, a = 1 - 2 * k / count, np.pi * (1 + 5 ** 0.5) * k
    n = np.stack([np.sqrt(1 - z * z) * np.cos(a), np.sqrt(1 - z * z) * np.sin(a), z], axis=1)
    x = np.cross(np.where(np.abs(n[:, 2:]) < 0.9, [[0, 0, 1.0]], [[1.0, 0, 0]]), n)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(n, x)
    step = cover * np.sqrt(4 * np.pi / count) * radius / (nodes - 1)
    u = (np.arange(nodes) - (nodes - 1) / 2) * step
    height = np.sqrt(radius ** 2 - u[None] ** 2 - u[:, None] ** 2) - radius
    colors = np.repeat(np.random.default_rng(1).integers(40, 255, (count, 3)), nodes * nodes, axis=0).astype(np.uint8)
    return quantized(radius * n + u[0] * (x + y), x * step, y * step, np.tile(height.ravel(), count), (nodes, nodes),
                     colors, precise, origin=origin)


def pixel_centres(size):
    y, x = np.mgrid[:size[1], :size[0]] + 0.5
    return np.stack([x.ravel(), y.ravel()], axis=1)


CAMERAS = {"perspective": Camera.look_at((3, 4, 9), (0, 0, 0), fov=40),
           "orthographic": Camera.orthographic((3, 4, 9), (0, 0, 0), height=6)}


@pytest.mark.parametrize("precise", [False, True])
def test_prepare_patches(device, precise):
    surface = joined(rough(4, holes=0.05), rough(3, (5, 12), seed=5, holes=0.05))
    if precise:
        d = np.where(surface.opaque, surface.displacements.astype(np.int32) * 1000, np.iinfo(np.int32).min)
        surface = PatchSurface(surface.origins, surface.axis_x, surface.axis_y, surface.axis_z_length / 1000,
                               surface.size, d)
    upload = upload_patches(device, surface)
    cells, borders, slopes = twin.prepare_patches(surface)
    shown = surface.opaque
    got = [device.download(a) for a in prepare_patches(
        device, patch_constants(upload), upload.frames, upload.sizes, upload.offsets, upload.count, upload.colors,
        upload.heights)]
    assert np.array_equal(got[0] > 0, cells)
    np.testing.assert_allclose(got[1], borders, atol=1e-5)
    np.testing.assert_allclose(got[2][shown], slopes[shown], rtol=1e-5)


@pytest.mark.parametrize("lanes", [16, 1])
@pytest.mark.parametrize("camera", CAMERAS)
def test_tile_patches(renderers, device, lanes, camera):
    surface = globe(24, 5)
    view = place_patches(upload_patches(device, surface), None, CAMERAS[camera], SIZE, Shading())
    depth, _ = twin.tile_patches(view, surface, pixel_centres(SIZE))
    got = renderers(lanes).render(surface, CAMERAS[camera], SIZE, ("depth",), patches=PLAIN).depth.ravel()
    assert np.array_equal(np.isfinite(got), np.isfinite(depth))
    hit = np.isfinite(depth)
    # The kernel takes a sample's layer from a plane through its cell: beside the edge of a layer another patch may win.
    assert np.mean(np.abs(got[hit] - depth[hit]) > 1e-5) < 0.05
    assert np.abs(got[hit] - depth[hit]).max() < 0.4  # such coarse patches differ by as much at the silhouette


@pytest.mark.parametrize("lanes", [16, 1])
def test_every_covered_pixel_is_hit(renderers, device, lanes):
    surface = rough(3, (8, 9), holes=0.0)
    camera = Camera.framing(surface, direction=(1, 2, 1))
    view = place_patches(upload_patches(device, surface), None, camera, SIZE, Shading())
    depth, _ = twin.tile_patches(view, surface, pixel_centres(SIZE))
    got = renderers(lanes).render(surface, camera, SIZE, ("depth",), patches=PLAIN).depth.ravel()
    assert np.sum(np.isfinite(depth) != np.isfinite(got)) <= 1  # an outline through a pixel's centre
    assert np.isfinite(got).mean() > 0.1


def test_a_plane_is_exact(renderers):
    surface = sheet(lambda x, y: 0.25 * x, precise=True)
    for camera in (Camera.look_at((0.3, 0.2, 2), (0, 0, 0), fov=40),
                   Camera.look_at((1.2, 0.1, 0.6), (0, 0, 0.2), fov=60)):
        frame = renderers().render(surface, camera, SIZE, ("depth", "normal", "position"), patches=PLAIN)
        hit = np.isfinite(frame.depth)
        p = frame.position[hit] + frame.origin
        assert hit.mean() > 0.2
        assert np.abs(p[:, 2] - 0.25 * p[:, 0]).max() < 3e-6
        assert np.abs(frame.normal[hit] - np.array([-0.25, 0, 1]) / np.hypot(1, 0.25)).max() < 1e-4


@pytest.mark.parametrize("lanes", [16, 1])
def test_patches_through_the_near_plane(renderers, lanes):
    """The eye stands on a wide floor: all pixels below the horizon show it."""
    floor = sheet(lambda x, y: 0 * x, nodes=(9, 9), spacing=20.0, precise=True)
    camera = Camera.look_at((0.3, 0.2, 1.0), (0.3, 5, 0.9), up=(0, 0, 1), fov=60)
    frame = renderers(lanes).render(floor, camera, SIZE, ("depth", "normal"), patches=PLAIN)
    origins, directions = camera.rays(SIZE)
    reach = -origins[:, 2] / np.where(directions[:, 2] < 0, directions[:, 2], np.nan)
    place = origins + reach[:, None] * directions
    inside = (np.abs(place[:, :2]) < 79.9).all(axis=1) & (reach > 0)
    depth = (place - camera.eye) @ -camera.rotation[2]
    got = frame.depth.ravel()
    assert np.array_equal(np.isfinite(got)[inside], inside[inside])
    np.testing.assert_allclose(got[inside], depth[inside], rtol=1e-3)
    assert np.median(np.abs(got[inside] / depth[inside] - 1)) < 1e-5
    np.testing.assert_allclose(frame.normal.reshape(-1, 3)[inside], np.tile([0, 0, 1.0], (inside.sum(), 1)), atol=1e-4)


@pytest.mark.parametrize("lanes,tile", [(16, 8), (16, 40), (8, None), (4, 32), (1, None), (1, 8)])
def test_pictures_do_not_depend_on_tiles_and_lanes(renderers, lanes, tile):
    surface, camera = joined(globe(), globe(20, 5, 1.0)), CAMERAS["perspective"]
    want = renderers().render(surface, camera, SIZE, patches=PLAIN)
    got = renderers(lanes, tile).render(surface, camera, SIZE, patches=PLAIN)
    np.testing.assert_allclose(got.depth, want.depth, atol=1e-4 if lanes != 16 else 0)
    assert np.mean(np.abs(got.color - want.color) > 1e-4) < (2e-3 if lanes != 16 else 1e-9)


def test_the_order_of_patches_does_not_matter(renderers):
    surface = globe()
    order = np.random.default_rng(0).permutation(len(surface))
    nodes = np.concatenate([np.arange(*surface.node_offset[k:k + 2]) for k in order])
    other = PatchSurface(surface.origins[order], surface.axis_x[order], surface.axis_y[order],
                         surface.axis_z_length[order], surface.size[order], surface.displacements[nodes],
                         surface.colors[nodes])
    a, b = (renderers().render(s, CAMERAS["perspective"], SIZE, patches=PLAIN) for s in (surface, other))
    assert np.array_equal(a.depth, b.depth, equal_nan=True) and np.array_equal(a.color, b.color)


def test_orthographic_is_perspective_from_afar(renderers):
    surface = globe()
    near = renderers().render(surface, Camera.orthographic((0, 0, 9), (0, 0, 0), height=6), SIZE, patches=PLAIN)
    far = renderers().render(surface, Camera.look_at((0, 0, 5000.0), (0, 0, 0),
                             fov=np.degrees(2 * np.arctan(3 / 5000))), SIZE, patches=PLAIN)
    both = np.isfinite(near.depth) & np.isfinite(far.depth)
    assert np.sum(np.isfinite(near.depth) != np.isfinite(far.depth)) < 10
    assert np.median(np.abs(far.depth[both] - 4991 - near.depth[both])) < 1e-3


def test_ways_of_projecting_nodes(renderers):
    """Homogeneous is exact; the trilinear one's error falls with the square of the patch's size over its distance."""
    errors = []
    for nodes in (17, 9):
        surface = sheet(lambda x, y: 0.3 * np.sin(2 * x) * y, nodes=(nodes, nodes), spacing=0.125, precise=True)
        camera = Camera.look_at((1.5, 1.0, 3.0), (0, 0, 0), fov=30)
        frames = {n: renderers().render(surface, camera, SIZE, ("depth",), patches=PatchDrawing(
            nodes=n, direct=False, mip=False)).depth for n in ("exact", "homogeneous", "trilinear")}
        both = np.isfinite(frames["exact"]) & np.isfinite(frames["homogeneous"])
        assert np.sum(np.isfinite(frames["exact"]) != np.isfinite(frames["homogeneous"])) <= 4
        assert np.abs(frames["exact"] - frames["homogeneous"])[both].max() < 1e-3
        both &= np.isfinite(frames["trilinear"])
        errors.append(np.sqrt(np.mean((frames["exact"] - frames["trilinear"])[both] ** 2)))
    assert 0 < errors[1] < errors[0] / 2.5


def test_triangles_agree_with_quads(renderers):
    surface = globe()
    quads, triangles = (renderers().render(surface, CAMERAS["perspective"], SIZE, patches=PatchDrawing(
        cells=c, direct=False, mip=False)) for c in ("quads", "triangles"))
    assert np.array_equal(np.isfinite(quads.depth), np.isfinite(triangles.depth))
    assert np.nanmedian(np.abs(quads.depth - triangles.depth)) < 2e-3
    assert np.nanpercentile(np.abs(quads.normal - triangles.normal), 99) < 0.05


def test_nodes_drawn_directly(renderers):
    surface, camera = globe(80, 17), Camera.look_at((3, 4, 30), (0, 0, 0), fov=16)
    got, want = (renderers().render(surface, camera, SIZE, patches=PatchDrawing(direct=direct, mip=False))
                 for direct in (True, False))
    a, b = np.isfinite(got.depth), np.isfinite(want.depth)
    assert not np.array_equal(got.depth, want.depth, equal_nan=True)
    inner = b[1:-1, 1:-1] & b[:-2, 1:-1] & b[2:, 1:-1] & b[1:-1, :-2] & b[1:-1, 2:]
    assert a[1:-1, 1:-1][inner].all()  # no holes
    assert np.nanmedian(np.abs(got.depth - want.depth)[a & b]) < 0.06  # half a pixel is 0.06
    assert np.nanmedian(np.abs(got.normal - want.normal)[a & b]) < 0.02


def test_the_sample_farther_from_its_border_wins(renderers):
    """Two flat patches in one plane, side by side with an overlap: each shows up to its middle."""
    red, blue = (sheet(lambda x, y: 0 * x, nodes=(9, 9), spacing=0.25, precise=False,
                       colors=np.tile(np.array(c, np.uint8), (81, 1)), center=(x, 0.0))
                 for c, x in (((255, 1, 1), -0.5), ((1, 1, 255), 0.5)))
    frame = renderers().render(joined(red, blue), Camera.orthographic((0, 0, 5), (0, 0, 0), height=3), (96, 96),
                               shading="flat", patches=PLAIN)
    middle = frame.color[48, :, 0] > frame.color[48, :, 2]
    x = (np.arange(96) + 0.5) / 32 - 1.5
    assert middle[(x > -1.4) & (x < -0.05)].all() and not middle[(x > 0.05) & (x < 1.4)].any()


def test_surfaces_of_two_kinds_share_the_z_buffer(renderers):
    mesh = torus(24)
    slim, patches = build_slim(mesh), globe(40, 9, 1.0)
    camera = Camera.look_at((2, 3, 9), (0, 0, 0), fov=30)
    one, other, both = (renderers().render(s, camera, SIZE, ("depth", "id")) for s in (
        slim, patches, Scene([slim, patches])))
    want = np.fmin(one.depth, other.depth)
    np.testing.assert_allclose(both.depth, want, atol=1e-5)
    assert set(np.unique(both.id)) == {-1, 0, 1}


def test_placed_far_away_and_precise(renderers):
    far = np.array([7_691_239.5, 1e6, -3e5])
    plain = globe()
    want = renderers().render(plain, CAMERAS["perspective"], SIZE, ("depth", "normal"), patches=PLAIN)
    camera = Camera.look_at(far + np.array([3, 4, 9]), far, fov=40)
    moved = np.eye(4)
    moved[:3, 3] = far
    for surface in (globe(origin=far), plain.moved(moved), globe(origin=far, precise=True)):
        got = renderers().render(surface, camera, SIZE, ("depth", "normal"), patches=PLAIN)
        assert np.sum(np.isfinite(got.depth) != np.isfinite(want.depth)) < 8
        assert np.nanmedian(np.abs(got.depth - want.depth)) < 2e-3


def test_channels_and_constant_colour(renderers):
    k = globe(40)
    surface = PatchSurface(k.origins, k.axis_x, k.axis_y, k.axis_z_length, k.size, k.displacements, color=(200, 30, 30))
    channels = ("color", "depth", "normal", "position", "id", "count", "level", "cost")
    frame = renderers().render(surface, CAMERAS["perspective"], SIZE, channels, shading="flat")
    hit = np.isfinite(frame.depth)
    assert (frame.id == np.where(hit, 0, -1)).all() and (frame.count == np.where(hit, 1, -1)).all()
    assert (frame.cost[hit] > 0).all()
    assert np.abs(frame.color[hit][:, :3] - frame.color[hit][0, :3]).max() < 1e-6
    planes = renderers().render([surface, k.moved(np.diag([1e-3, 1e-3, 1e-3, 1]))], CAMERAS["perspective"], SIZE,
                                channels, shading="flat")
    np.testing.assert_allclose(planes.depth, frame.depth, atol=1e-5)
    np.testing.assert_allclose(planes.normal, frame.normal, atol=1e-5)


def test_a_surface_without_patches(renderers):
    none = np.zeros((0, 3), np.float32)
    surface = PatchSurface(none, none, none, np.zeros(0, np.float32), (17, 17), np.zeros(0, np.int8))
    frame = renderers().render(surface, CAMERAS["perspective"], SIZE)
    assert np.isnan(frame.depth).all() and (frame.color == 1).all()


def test_culling_leaves_out_what_is_seen_from_behind_only(renderers):
    surface, inside = globe(), Camera.look_at((0, 0, 0), (1, 0, 0), fov=60)
    want, got = (renderers().render(surface, CAMERAS["perspective"], SIZE, patches=PatchDrawing(
        direct=False, mip=False, cull=cull)) for cull in (False, True))
    np.testing.assert_allclose(got.depth, want.depth, atol=1e-5)
    empty = renderers().render(surface, inside, SIZE, patches=PatchDrawing(direct=False, mip=False, cull=True))
    assert np.isnan(empty.depth).all()


@pytest.mark.parametrize("lanes", [1, 16])
@pytest.mark.parametrize("inside", [False, True])
def test_normals_at_contours_stay_beside_those_of_the_sphere(renderers, lanes, inside):
    # From inside of half a sphere its back shows: there normals are turned over.
    surface = globe(200, 9)
    camera = Camera.look_at((0.3, 0.2, 0.5), (0, 0, 0), fov=100) if inside else CAMERAS["perspective"]
    for direct in (False, True):
        frame = renderers(lanes).render(surface, camera, (160, 120), ("normal", "depth", "position"),
                                        patches=PatchDrawing(direct=direct, mip=False))
        shown = np.isfinite(frame.depth)
        exact = frame.position[shown] + frame.origin
        exact *= (-1 if inside else 1) / np.linalg.norm(exact, axis=1, keepdims=True)
        assert shown.sum() > 2000
        assert np.degrees(np.arccos(np.clip((frame.normal[shown] * exact).sum(axis=1), -1, 1))).max() < 8


@pytest.mark.parametrize("nodes", ["exact", "trilinear"])
def test_contours_have_no_specks(renderers, nodes):
    frame = renderers().render(perfect_sphere(), None, (150, 150), ("normal", "depth", "position"),
                               patches=PatchDrawing(nodes=nodes))
    shown = np.isfinite(frame.depth)
    exact = frame.position[shown] + frame.origin
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    assert (frame.normal[shown] * exact).sum(axis=1).min() > np.cos(np.radians(20))
