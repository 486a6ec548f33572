"""The further modes of the patch renderer: table of normals, mip levels, subdivision, light at the nodes, alpha."""

import itertools

import numpy as np
import pytest
from reference import render_patch_modes as twin
from reference.surfaces import sphere
from scipy import ndimage
from test_surface_patch import bowls

from clsurf.build.quantize import quantized
from clsurf.errors import InputError
from clsurf.render.camera import Camera
from clsurf.render.normal_table import half_steps, normal_statistics, ratio_groups
from clsurf.render.patch_alpha import extended
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.patch_forms import cull_patches
from clsurf.render.patch_mips import halved, mip_levels, tent
from clsurf.render.patch_nodes import LIT_RANGE, light_nodes, table_normals
from clsurf.render.patches import patch_constants, place_patches, project_patches, upload_patches
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Light, Shading, shading_floats
from clsurf.surface.srgb import to_linear
from clsurf.render.tiles import Scratch, view_floats
from clsurf.surface.patch import PatchSurface

# Patches to draw ------------------------------------------------------------------------------------------------------


def joined(*surfaces):
    """One surface of the patches of several."""
    names = ("origins", "axis_x", "axis_y", "axis_z_length", "size", "displacements")
    arrays = [np.concatenate([getattr(s, name) for s in surfaces]) for name in names]
    colors = None if surfaces[0].colors is None else np.concatenate([s.colors for s in surfaces])
    return PatchSurface(*arrays, colors, origin=surfaces[0].origin)


def rough(count=6, size=(9, 7), seed=3, ratios=(1.0, 0.5), holes=0.1, colors=False):
    """Patches of random heights over random frames, with transparent nodes; their |a_z| / |a_x| varies."""
    rng = np.random.default_rng(seed)
    frames = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    frames[:, 2] *= np.sign(np.linalg.det(frames))[:, None]
    d = rng.integers(-100, 128, count * size[0] * size[1]).astype(np.int8)
    hole = rng.random(len(d)) < holes
    rgb = rng.integers(1, 255, (len(d), 3)).astype(np.uint8) if colors else None
    if colors:
        rgb[hole] = 0
    else:
        d[hole] = -128
    step = 0.01 * np.asarray(ratios)[np.arange(count) % len(ratios)]
    return PatchSurface(rng.normal(size=(count, 3)), frames[:, 0], frames[:, 1] * 0.5, step, size, d, rgb)


# The table of normals -------------------------------------------------------------------------------------------------


def test_half_steps():
    surface = rough()
    for part in (surface, joined(surface, rough(2, (5, 12)))):
        got = np.stack(half_steps(part), axis=1)
        for k in range(len(part)):
            (m, n), (a, b) = part.size[k], part.node_offset[k:k + 2]
            opaque = part.opaque[a:b].reshape(n, m)
            wanted = 2 * twin.slopes(part.displacements[a:b].reshape(n, m), opaque)
            assert (got[a:b].reshape(n, m, 2)[opaque] == wanted[opaque]).all()


@pytest.mark.parametrize("ratios", [(1.0,), (1.0, 0.5), (1.0, 0.5, 0.25)])
def test_normal_statistics_count_what_a_table_would(ratios):
    surface = rough(6, ratios=ratios)
    got = normal_statistics(surface)
    wanted = twin.table_counts(surface)
    assert (got.normals, got.buffered, got.ordered) == wanted
    assert got.groups == len(ratios) and got.ordered <= got.buffered <= got.normals
    assert got.precomputed < got.ordered if len(ratios) == 1 else got.precomputed == got.ordered
    assert normal_statistics(surface, np.zeros(6, bool)).normals == 0
    one = np.arange(6) == 2
    assert normal_statistics(surface, one).buffered == normal_statistics(surface, one).ordered


def test_equal_patches_share_all_their_normals():
    one = rough(1)
    many = joined(*[one] * 5)
    five, alone = normal_statistics(many), normal_statistics(one)
    assert five.buffered - five.precomputed == alone.buffered - alone.precomputed < alone.normals
    assert five.normals == 5 * alone.normals and five.precomputed == 5 * alone.precomputed


def test_ratio_groups():
    surface = rough(6, ratios=(1.0, 0.5, 0.25))
    group, ratios = ratio_groups(surface)
    assert len(ratios) == 3 and (np.bincount(group) == 2).all()
    own = surface.axis_z_length / np.linalg.norm(surface.axis_x, axis=1)
    assert np.abs(ratios[group, 0] / own - 1).max() < 4e-4


# Mip levels -----------------------------------------------------------------------------------------------------------


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


def test_levels_of_all_kinds():
    for surface in (bowls(2, colors=True)[0], bowls(2, precise=True)[0], bowls(2, colors=True, precise=True)[0],
                    joined(rough(2), rough(1, (4, 11)))):
        levels = mip_levels(surface)
        assert all(len(s) == len(surface) for s in levels) and (levels[-1].size == 2).all()
        low, high = surface.bounds
        reach = 1e-3 * np.ptp(surface.bounds, axis=0) + np.linalg.norm(surface.axis_z, axis=1).max()
        for level in levels:
            assert (level.bounds[0] >= low - reach).all() and (level.bounds[1] <= high + reach).all()
    mixed = joined(rough(2), rough(1, (4, 11)))
    assert np.array_equal(halved(mixed).displacements[:2 * 5 * 4], halved(rough(2)).displacements)


# Drawing --------------------------------------------------------------------------------------------------------------

SIZE = (61, 47)
FRONT = Camera.orthographic((0, 0, 5), (0, 0, 0), height=2.2)


def sheet(height, nodes=(9, 9), spacing=0.25, precise=True, colors=None, center=(0.0, 0.0)):
    """One patch over the xy plane, facing +z, of heights `height(x, y)`, and its nodes' x and y."""
    m, n = nodes
    x = (np.tile(np.arange(m), n) - (m - 1) / 2) * spacing + center[0]
    y = (np.repeat(np.arange(n), m) - (n - 1) / 2) * spacing + center[1]
    origin = np.array([[x[0], y[0], 0]])
    return quantized(origin, np.array([[spacing, 0, 0]]), np.array([[0, spacing, 0]]), height(x, y), nodes, colors,
                     precise), x, y


def wavy(x, y):
    return 0.12 * np.sin(5 * x) * np.cos(4 * y) + 0.1 * x


def steps(surface, places):
    """Places (q, 2) in nodes to the surface's own x and y."""
    return surface.origins[0, :2] + places * [surface.axis_x[0, 0], surface.axis_y[0, 1]]


@pytest.fixture(scope="module")
def renderers(device):
    with Renderer(device, lanes=16) as lanes, Renderer(device, lanes=1) as items, Renderer(device, tile=8) as small:
        yield lanes, items, small


CAMERAS = {"orthographic": Camera.orthographic((2, 3, 7), (0, 0, 0), height=2.6),
           "perspective": Camera.look_at((1.6, 3.0, 4.8), (0, 0, 0), fov=24)}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("cells", ["bilinear", "smooth"])
def test_tile_lattice(renderers, cells, camera):
    """Depth and normal of every pixel inside a patch are those of the twin's surface along the pixel's ray."""
    surface, _, _ = sheet(wavy, (12, 9), 0.2)
    channels = ("depth", "normal", "position")
    frame = renderers[0].render(surface, camera, SIZE, channels, patches=PatchDrawing(cells=cells))
    d, opaque = (a.reshape(9, 12) for a in (surface.displacements, surface.opaque))
    origins, directions = camera.rays(SIZE)
    hit = np.isfinite(frame.depth).ravel()
    start = (frame.position.reshape(-1, 3)[hit][:, :2] - surface.origins[0, :2]) / 0.2
    inside = ((start > 0.3) & (start < [10.7, 7.7])).all(axis=1)
    height = (lambda x, y: twin.smooth_height(d, opaque, x, y)) if cells == "smooth" else \
        (lambda x, y: twin.bilinear_height(d, x, y))
    places, far = twin.seen_places(surface, 0, height, origins[hit][inside], directions[hit][inside], start[inside])
    depth = -far * (directions[hit][inside] @ camera.rotation[2])
    error = np.abs(depth - frame.depth.ravel()[hit][inside])
    # Where the pixel's centre lies beside the cell whose point won, the cell is carried on by up to half a cell.
    assert inside.sum() > 700 and np.median(error) < 2e-5 and np.quantile(error, 0.95) < 2e-3 and error.max() < 0.03
    if cells == "smooth":
        g = np.array([twin.smooth_height(d, opaque, *p)[1:] for p in places])
        g *= (surface.axis_z_length / 0.2)[:, None]
        normal = np.concatenate([-g, np.ones((len(g), 1))], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        got = frame.normal.reshape(-1, 3)[hit][inside]
        assert np.quantile(np.abs(got - normal).max(axis=1), 0.9) < 3e-3


@pytest.mark.parametrize("cells", ["bilinear", "smooth"])
@pytest.mark.parametrize("distance", [1.1, 2.5, 9.0, 40.0])
def test_subdivision_leaves_no_holes(renderers, cells, distance):
    """Every pixel that quads cover is covered, from a cell of half the picture to cells of a tenth of a pixel."""
    surface, _, _ = sheet(wavy, (17, 17), 0.125, precise=False)
    for direction in ((0.2, 0.3, 1), (1, 0.4, 0.5), (-0.7, 1, 0.2)):
        eye = distance * np.array(direction) / np.linalg.norm(direction)
        camera = Camera.look_at(eye, (0, 0, 0), fov=40)
        quads = renderers[0].render(surface, camera, (97, 83), ("depth",), patches=PatchDrawing(direct=False))
        points = renderers[0].render(surface, camera, (97, 83), ("depth",), patches=PatchDrawing(cells=cells))
        missing = np.isfinite(quads.depth) & ~np.isfinite(points.depth)
        # A smooth outline is another one, by the difference of the surfaces; inside nothing may be missing.
        inner = ndimage.binary_erosion(np.isfinite(quads.depth), iterations=1 if cells == "bilinear" else 3)
        assert not (missing & inner).any() and missing.sum() <= (0 if cells == "bilinear" else 40)
        grown = ndimage.binary_dilation(np.isfinite(quads.depth), np.ones((3, 3)), 2 if cells == "bilinear" else 4)
        assert not (np.isfinite(points.depth) & ~grown).any()


def test_subdivision_through_the_near_plane(renderers):
    """A floor that passes under the eye is drawn up to the picture's lower edge."""
    surface, _, _ = sheet(lambda x, y: 0 * x, (17, 17), 1.0)
    camera = Camera.look_at((0, 0, 0.5), (3, 0, 0.2), up=(0, 0, 1), fov=60)
    quads = renderers[0].render(surface, camera, (48, 40), ("depth",))
    for cells in ("bilinear", "smooth"):
        for r in renderers[:2]:
            frame = r.render(surface, camera, (48, 40), ("depth",), patches=PatchDrawing(cells=cells))
            assert not (np.isfinite(quads.depth) & ~np.isfinite(frame.depth)).any()
            both = np.isfinite(quads.depth) & np.isfinite(frame.depth)
            assert both.sum() > 500 and np.abs(frame.depth / quads.depth - 1)[both].max() < 1e-3


@pytest.mark.parametrize("cells", ["bilinear", "smooth"])
def test_subdivision_does_not_depend_on_tiles_and_lanes(renderers, cells):
    surface = rough(40, (9, 7), holes=0.05, colors=True)
    camera = Camera.framing(surface)
    frames = [r.render(surface, camera, SIZE, ("color", "depth", "normal", "id"), patches=PatchDrawing(cells=cells))
              for r in renderers]
    for frame in frames[1:]:
        for name, array in frame.channels.items():
            assert np.array_equal(array, frames[0].channels[name], equal_nan=array.dtype == np.float32)


def test_bilinear_points_agree_with_quads(renderers):
    surface, _, _ = sheet(wavy, (17, 17), 0.125)
    quads = renderers[0].render(surface, CAMERAS["perspective"], (160, 120), ("depth", "normal"))
    points = renderers[0].render(surface, CAMERAS["perspective"], (160, 120), ("depth", "normal"),
                                 patches=PatchDrawing(cells="bilinear"))
    both = ndimage.binary_erosion(np.isfinite(quads.depth) & np.isfinite(points.depth))
    error = np.abs(quads.depth - points.depth)[both]
    assert both.sum() > 5000 and np.median(error) < 1e-5 and np.quantile(error, 0.99) < 2e-3
    assert np.quantile(np.abs(quads.normal - points.normal)[both], 0.99) < 0.01


def test_smooth_cells_have_continuous_normals(renderers):
    """Across cells the normal changes no faster than within them; that of facets jumps."""
    surface, _, _ = sheet(lambda x, y: 0.3 * np.sin(4 * x), (9, 9), 0.25)
    camera = Camera.orthographic((0, 0, 5), (0, 0, 0), height=1.4)
    frame = renderers[0].render(surface, camera, (256, 256), ("normal", "position"),
                                patches=PatchDrawing(cells="smooth"))
    slope = frame.normal[..., 0] / frame.normal[..., 2]
    change = np.abs(np.diff(slope[100]))
    assert change.max() < 4 * np.median(change) + 0.02 and np.ptp(slope[100]) > 1
    z = frame.position[100, :, 2]
    assert np.abs(np.diff(z) / (1.4 / 256) + (slope[100, 1:] + slope[100, :-1]) / 2).max() < 0.02


def test_smooth_cells_pass_through_the_nodes_and_follow_the_surface_closer(renderers):
    """Third order where bilinear cells are of the second: eight times less error a halving, here at least 6 and 3.4."""
    def hills(x, y):
        return 0.2 * np.sin(3 * x + 0.5) * np.cos(2 * y)

    camera = Camera.orthographic((0, 0, 5), (0, 0, 0), height=0.9)
    error = {"bilinear": [], "smooth": []}
    for cells, list_ in error.items():
        for nodes in (9, 17, 33):
            surface, _, _ = sheet(hills, (nodes, nodes), 2 / (nodes - 1))
            frame = renderers[0].render(surface, camera, (64, 64), ("position",), patches=PatchDrawing(cells=cells))
            x, y, z = np.moveaxis(frame.position, 2, 0)
            list_.append(np.sqrt(np.mean((z - hills(x, y)) ** 2)))
    assert min(a / b for a, b in itertools.pairwise(error["bilinear"])) > 3.4
    assert min(a / b for a, b in itertools.pairwise(error["smooth"])) > 6
    assert error["smooth"][0] < 0.3 * error["bilinear"][0]


LIGHTS = (Light(), Light("directional", (1, 2, 0.5), (0.5, 0.4, 0.3)), Light("point", (1, 1, 2), (0.2, 0.3, 0.6)))


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("lanes", [16, 1])
def test_light_nodes(device, camera, lanes):
    """The lit colours of all nodes are the twin's, worked out in view space."""
    surface = rough(4, (5, 4), holes=0, colors=True, ratios=(1, 0.3))
    upload, scratch = upload_patches(device, surface), Scratch(device, lanes)
    matrix = np.diag([1.5, 1.5, 1.5, 1.0])
    matrix[:3, 3] = 0.1, 0.2, -0.3
    shading = Shading(ambient=0.1, specular=0.4, shininess=13)
    floats = place_patches(upload, matrix, camera, (500, 400), shading)
    lamps = shading_floats(shading, LIGHTS, (1, 1, 1), camera)
    view = device.upload(floats)
    rectangles = project_patches(device, scratch, upload, view, PatchDrawing()).rectangles
    got = device.download(light_nodes(device, scratch, upload, patch_constants(upload), view, device.upload(lamps),
                                      rectangles))
    got = np.stack([got[:, 1] & 0xFFFF, got[:, 1] >> 16, got[:, 2] & 0xFFFF], axis=1) * LIT_RANGE / 65535
    seen = device.download(rectangles)[:, 0] <= device.download(rectangles)[:, 2]
    assert seen.sum() >= 3
    for k in np.flatnonzero(seen):
        linear = to_linear(surface.colors[20 * k:20 * k + 20] / 255)
        wanted = twin.light_nodes(floats, lamps, surface, k, linear)
        assert np.abs(got[20 * k:20 * k + 20] - wanted).max() < 2e-4


@pytest.mark.parametrize("cells", ["quads", "triangles", "bilinear", "smooth"])
def test_gouraud_is_phong_where_light_is_linear(renderers, cells):
    """On a plane in directional light without gloss both are one colour; on a wavy one they differ, but not by much."""
    shading, lights = Shading(specular=0, color=(0.7, 0.5, 0.3)), (Light("directional", (1, 2, 3)),)
    for height, most in ((lambda x, y: 0.3 * x, 4e-5), (wavy, 0.06)):
        scene = Scene([sheet(height)[0]], lights)
        phong, gouraud = (renderers[0].render(scene, FRONT, SIZE, ("color",), shading, patches=PatchDrawing(
            cells=cells, shading=s)).color for s in ("pixel", "gouraud"))
        assert np.abs(phong - gouraud).max() < most
    assert np.abs(phong - gouraud).max() > 1e-4


def test_gouraud_beside_other_surfaces(renderers):
    """Other surfaces of the scene keep their light per pixel; black light stays black; unlit looks are left alone."""
    flat, ball = sheet(lambda x, y: 0 * x - 0.8)[0], sphere(200)
    scene = Scene([flat, ball])
    plain, mixed = (renderers[0].render(scene, FRONT, SIZE, ("color", "id"), patches=PatchDrawing(shading=s))
                    for s in ("pixel", "gouraud"))
    assert (plain.id == 1).sum() > 300 and np.array_equal(plain.id, mixed.id)
    assert np.allclose(plain.color[plain.id == 1], mixed.color[mixed.id == 1], atol=1e-6)
    dark = renderers[0].render(Scene([flat], ()), FRONT, SIZE, ("color",), Shading(ambient=0),
                               patches=PatchDrawing(shading="gouraud"))
    assert (dark.color[20:26, 28:32, :3] == 0).all()
    unlit = [renderers[0].render(flat, FRONT, SIZE, ("color",), "flat", patches=PatchDrawing(shading=s)).color
             for s in ("pixel", "gouraud")]
    assert np.array_equal(*unlit)


# The table on a device ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [True, "ordered", "precomputed"])
@pytest.mark.parametrize("colors", [False, True])
def test_table_normals(device, mode, colors):
    """The table gives the normals that it saves computing, and computes as many as the statistics say."""
    ratios = (1.0,) if mode == "precomputed" else (1.0, 0.5, 0.25)
    surface = rough(9, ratios=ratios, colors=colors)
    upload, scratch = upload_patches(device, surface), Scratch(device, 16)
    view = device.upload(place_patches(upload, None, Camera.framing(surface, margin=1.3), (200, 200), Shading()))
    rectangles = project_patches(device, scratch, upload, view, PatchDrawing()).rectangles
    seen = device.download(rectangles)[:, 0] <= device.download(rectangles)[:, 2]
    got, counts = table_normals(device, scratch, upload, patch_constants(upload), rectangles, mode, parts=1)
    statistics = normal_statistics(surface, seen)
    name = {True: "buffered"}.get(mode, mode)
    assert device.download(counts).tolist() == [[statistics.normals, getattr(statistics, name)]]
    packed = device.download(got)[:, 3].astype(np.int64)
    got = np.stack([(packed << 16).astype(np.int32) >> 16, packed.astype(np.int32) >> 16], axis=1) / 2
    for k in np.flatnonzero(seen):
        (m, n), (a, b) = surface.size[k], surface.node_offset[k:k + 2]
        opaque = surface.opaque[a:b].reshape(n, m)
        rx, ry = (surface.axis_z_length[k] / np.linalg.norm(axis[k]) for axis in (surface.axis_x, surface.axis_y))
        wanted = twin.table_normals(surface.displacements[a:b].reshape(n, m), opaque, rx, ry)[opaque]
        normal = np.concatenate([-got[a:b] * [rx, ry], np.ones((b - a, 1))], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        assert np.abs(normal[opaque.ravel()] - wanted).max() < 3e-4  # 16 bits, and groups of ratios within 0.034 %


def test_pictures_with_a_table_are_the_same(renderers):
    surface = rough(30, holes=0.05, ratios=(1.0, 0.5))
    camera = Camera.framing(surface)
    for cells in ("quads", "bilinear"):
        plain = renderers[0].render(surface, camera, SIZE, patches=PatchDrawing(cells=cells))
        for mode in (True, "ordered"):
            for r in renderers[:2]:
                frame = r.render(surface, camera, SIZE, patches=PatchDrawing(cells=cells, normal_table=mode))
                assert np.array_equal(frame.depth, plain.depth, equal_nan=True)
                assert np.nanmax(np.abs(frame.normal - plain.normal)) < 2e-3


def test_the_table_wants_what_it_can_hold(renderers):
    with pytest.raises(InputError, match="ordered"):
        renderers[0].render(rough(4), None, SIZE, patches=PatchDrawing(normal_table="precomputed"))
    with pytest.raises(InputError, match="8-bit"):
        renderers[0].render(sheet(wavy)[0], None, SIZE, patches=PatchDrawing(normal_table=True))


# Alpha ----------------------------------------------------------------------------------------------------------------


def disc(nodes, radius=0.9, colors=None, tilt=0.2):
    """A tilted disc in one patch of side 2.2; nodes outside are transparent."""
    spacing = 2.2 / (nodes - 1)
    return sheet(lambda x, y: np.where(np.hypot(x, y) <= radius, tilt * x, np.nan), (nodes, nodes), spacing,
                 colors=colors)[0]


def test_carried_on_nodes_continue_a_plane():
    for colors in (None, np.full((81, 3), 90), np.full((81, 4), 90)):
        surface = disc(9, colors=colors)
        around, alphas = extended(surface)
        p = around.positions()
        new = around.opaque & ~surface.opaque
        assert new.sum() > 15 and np.abs(p[new, 2] - 0.2 * p[new, 0]).max() < 3e-6
        assert (around.opaque[surface.opaque]).all() and (alphas[~surface.opaque] == 0).all()
        assert (alphas[surface.opaque] == (90 if np.ndim(colors) and colors.shape[1] == 4 else 255)).all()
    assert not extended(rough(2, holes=1.0))[0].opaque.any()
    mixed = joined(rough(2), rough(1, (4, 11)))
    assert np.array_equal(extended(mixed)[0].displacements[:126], extended(rough(2))[0].displacements)


@pytest.mark.parametrize("cells", ["quads", "triangles", "bilinear", "smooth"])
def test_alpha_makes_rims_rounder(renderers, cells):
    """A disc's area is off by a fifth of what skipping half-transparent cells costs; the same in both forms."""
    camera = Camera.orthographic((0, 0, 5), (0, 0, 0), height=2.2)
    error = {}
    for alpha in (False, True):
        drawing = PatchDrawing(cells=cells, alpha=alpha, direct=False)
        frames = [[r.render(disc(nodes), camera, (220, 220), ("depth",), patches=drawing) for r in renderers[:2]]
                  for nodes in (17, 33, 65)]
        assert all(np.array_equal(a.depth, b.depth, equal_nan=True) for a, b in frames)
        error[alpha] = [abs(np.isfinite(a.depth).mean() * 2.2 ** 2 / (np.pi * 0.81) - 1) for a, _ in frames]
    assert sum(error[True]) < 0.2 * sum(error[False]) and error[True][-1] < 0.015


def test_alpha_of_nodes_gives_the_circle(renderers):
    """Nodes that carry the coverage of a circle put the edge where it is: of second order, and round."""
    camera, error = Camera.orthographic((0, 0, 5), (0, 0, 0), height=2.2), []
    for nodes in (17, 33):
        spacing = 2.2 / (nodes - 1)
        at = (np.arange(nodes) * spacing) - 1.1
        inside = np.clip(0.5 + (0.9 - np.hypot(at[None], at[:, None])) / (2 * spacing), 0, 1)
        colors = np.full((nodes ** 2, 4), 200)
        colors[:, 3] = np.rint(255 * inside.ravel())
        surface = sheet(lambda x, y: 0 * x, (nodes, nodes), spacing, colors=colors)[0]
        frame = renderers[0].render(surface, camera, (220, 220), ("depth", "position"),
                                    patches=PatchDrawing(alpha=True))
        shown = np.isfinite(frame.depth)
        rim = shown & ~ndimage.binary_erosion(shown)
        radius = np.hypot(frame.position[rim, 0], frame.position[rim, 1])
        error.append(np.abs(radius - 0.9 + 0.005).max())
    assert error[0] < 0.03 and error[1] < 0.015


def test_alpha_with_supersampling_gives_smooth_edges(renderers):
    frame = renderers[0].render(disc(33), Camera.orthographic((0, 0, 5), (0, 0, 0), height=2.2), (60, 60), ("color",),
                                background=(0, 0, 0, 0), supersampling=4, patches=PatchDrawing(alpha=True))
    cover = frame.color[..., 3]
    assert ((cover > 0.1) & (cover < 0.9)).sum() > 60
    assert abs(cover.mean() * 2.2 ** 2 / (np.pi * 0.81) - 1) < 0.02


# Minification and back faces ------------------------------------------------------------------------------------------


def globe(count=60, bump=0.0, checks=0):
    """A bumpy unit sphere of 17 x 17 patches, with a fine chequer of colours."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + 5 ** 0.5) * k
    normal = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    x = np.cross(np.where(np.abs(normal[:, 2:]) < 0.9, [[0, 0, 1.0]], [[1.0, 0, 0]]), normal)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y, step = np.cross(normal, x), 1.6 * np.sqrt(4 * np.pi / count) / 16
    u, v = (np.tile(np.arange(17), 17) - 8) * step, (np.repeat(np.arange(17), 17) - 8) * step
    height = np.sqrt(1 - u * u - v * v) - 1 + 0 * k[:, None]
    p = normal[:, None] * (1 + height[..., None]) + u[:, None] * x[:, None] + v[:, None] * y[:, None]
    height = height + bump * np.sin(9 * p[..., 0]) * np.sin(8 * p[..., 1])
    check = np.floor(p * checks).sum(axis=2) % 2 if checks else np.zeros(p.shape[:2])
    colors = np.repeat((255 - 250 * check).reshape(-1, 1), 3, axis=1)
    return quantized(normal - 8 * step * (x + y), x * step, y * step, height.ravel(), (17, 17), colors)


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
    upload, scratch = upload_patches(device, surface), Scratch(device, 16)
    view = device.upload(place_patches(upload, None, camera, SIZE, Shading()))
    projected = project_patches(device, scratch, upload, view, PatchDrawing())
    before = device.download(projected.rectangles)
    cull_patches(device, upload, upload, 1, None, view, projected)
    after = device.download(projected.rectangles)
    removed = (before[:, 0] <= before[:, 2]) & (after[:, 0] > after[:, 2])
    if camera.fov is not None:
        behind = twin.seen_from_behind(surface, camera.eye)
        assert behind[removed].all() and removed.sum() > 0.3 * (behind & (before[:, 0] <= before[:, 2])).sum()
    assert removed.sum() > 5
