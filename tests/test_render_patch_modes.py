"""The further modes of the patch renderer: subdivision, light at the nodes, alpha."""

import itertools

import numpy as np
import pytest
from reference import render_patch_modes as twin
from reference.patch_scenes import CAMERAS, FRONT, SIZE, disc, joined, rough, sheet, wavy
from reference.surfaces import sphere
from scipy import ndimage

from clsurf.models import perfect_sphere
from clsurf.render.camera import Camera
from clsurf.render.patch_alpha import extended
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.patch_nodes import LIT_RANGE, light_nodes
from clsurf.render.patches import patch_constants, place_patches, project_patches, upload_patches
from clsurf.render.scene import Scene
from clsurf.render.shade import Light, Shading, shading_floats
from clsurf.render.tiles import Scratch
from clsurf.surface.srgb import to_linear


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
    # Where a ray meets no drawn cell of its winner's patch, that cell is carried on by up to half a cell.
    assert inside.sum() > 700 and np.median(error) < 2e-6 and np.quantile(error, 0.95) < 1e-4 and error.max() < 5e-3
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


@pytest.mark.parametrize("cells, most", [("bilinear", 9e-5), ("smooth", 2e-6)])
def test_depth_at_the_contour_of_a_dome(renderers, cells, most):
    """Where a pixel spans many cells in depth, depth is that of the cell that the pixel's ray meets."""
    radius = 1.6
    surface, _, _ = sheet(lambda x, y: np.sqrt(radius**2 - x * x - y * y) - radius + 0.3, (129, 129), 2 / 128)
    camera = Camera.look_at((6, 0.3, 0.6), (0, 0, 0.1), up=(0, 0, 1), fov=25)
    size, middle = (400, 250), np.array([0, 0, 0.3 - radius])
    origins, directions = camera.rays(size)
    along = -np.einsum("na,na->n", origins - middle, directions)
    root2 = along**2 - (((origins - middle) ** 2).sum(axis=1) - radius**2)
    far = along - np.sqrt(np.maximum(root2, 0))
    place, cosine = origins + far[:, None] * directions, np.sqrt(np.maximum(root2, 0)) / radius
    for renderer in renderers[:2]:
        frame = renderer.render(surface, camera, size, ("depth",), patches=PatchDrawing(cells=cells))
        seen = np.isfinite(frame.depth.ravel()) & (root2 > 0) & (np.abs(place[:, :2]) < 0.97).all(axis=1)
        seen &= cosine > np.sqrt(2 * most / radius)  # nearer to the contour a ray may miss what is drawn
        error = cosine * np.abs(frame.depth.ravel() + far * (directions @ camera.rotation[2]))
        assert (seen & (cosine < 0.1)).sum() > 100 and (seen & (cosine < 0.03)).sum() > 10
        assert error[seen].max() < most


@pytest.mark.parametrize("cells", ["bilinear", "smooth"])
def test_nothing_shows_further_off_a_sphere_than_half_a_pixel(renderers, cells):
    """Along the outline a pixel's ray may miss the sphere whose point it shows: by half a diagonal at most."""
    surface, size = perfect_sphere(), (480, 270)
    camera = Camera.framing(surface, aspect=size[0] / size[1])
    _, directions = camera.rays(size)
    turn = np.linalg.norm(directions.reshape(270, 480, 3)[135, 241] - directions.reshape(270, 480, 3)[135, 240])
    for renderer in renderers[:2]:
        frame = renderer.render(surface, camera, size, ("depth", "position"), patches=PatchDrawing(cells=cells))
        away = np.abs(np.linalg.norm(frame.position, axis=2) - 128)[np.isfinite(frame.depth)]
        assert len(away) > 30_000 and away.max() < np.sqrt(0.5) * turn * np.linalg.norm(camera.eye)


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
    rectangles = project_patches(device, upload, view, PatchDrawing()).rectangles
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


# Alpha ----------------------------------------------------------------------------------------------------------------


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
