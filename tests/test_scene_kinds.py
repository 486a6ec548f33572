"""All kinds of surfaces and scans in one picture: one z-buffer, one sphere, shared uploads."""

import weakref

import numpy as np
import pytest
from test_render_clip import CAMERAS, PLANES, check, sphere_depth
from test_render_clip import SIZE as CLIP_SIZE
from test_render_triangles import globe

from clsurf.build.scale_map import build_scale_map
from clsurf.build.slim import build_slim
from clsurf.build.surfels import build_surfels
from clsurf.models import perfect_sphere
from clsurf.models.basic import sphere
from clsurf.render.camera import Camera
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.surface.mesh import Mesh

SIZE = (96, 72)
DIAGONAL = 2 * np.sqrt(3)  # of the unit sphere's box

# No node drawn as it is, and none of a coarser level: what a bound says something about.
EXACT = PatchDrawing(direct=False, mip=False)

SAG = 1 - np.cos(np.pi / 160) ** 2  # of the mesh's facets, two edges wide

# A unit sphere about the origin in every kind, and how far the drawn surface is from it at most, as its makers state:
# facets sag, a cloud's discs by half their radius squared, patches are a hundredth of a node off by their steps, a
# scale map adds the sag of its texels to its mesh's, SLIM surfaces and surfels say it themselves.
SPHERES = {
    "slim": lambda device: with_bound(build_slim(sphere(20_000), error=0.0003, device=device)),
    "patches": lambda _: (perfect_sphere(radius=1.0), 1e-4),
    "mesh": lambda _: (globe(80, 160), SAG),
    "cloud": lambda _: (sphere(20_000), 0.5 * 0.034 ** 2 + 1e-4),
    "surfels": lambda device: with_bound(build_surfels(sphere(20_000), device=device)),
    "scale map": lambda device: (build_scale_map(globe(80, 160), bits=16, device=device), 2 * SAG),
}


def with_bound(surface):
    return surface, surface.bound


@pytest.fixture(scope="module")
def spheres(device):
    """(surface, bound) by kind."""
    return {name: make(device) for name, make in SPHERES.items()}


@pytest.mark.parametrize("lanes", (16, 1))
def test_one_sphere_in_every_kind(device, spheres, lanes):
    """Each lies within its bound of the sphere at every pixel it covers, so depths agree within two bounds' sum."""
    camera = Camera.look_at((2.5, 1.1, 1.7), (0, 0, 0), fov=42)
    origins, directions = camera.rays(SIZE)
    middle = -(origins * directions).sum(1)
    closest = np.linalg.norm(origins + middle[:, None] * directions, axis=1)
    depths = {}
    with Renderer(device, lanes=lanes) as renderer:
        for name, (surface, bound) in spheres.items():
            assert bound < 1e-3 * DIAGONAL, name
            frame = renderer.render(surface, camera, size=SIZE, channels=("depth",), lod=0, patches=EXACT)
            depths[name] = depth = frame.depth.ravel().astype(np.float64)
            hit = np.isfinite(depth)
            assert hit[closest < 1 - 2 * bound].all(), name
            along = depth / -(directions @ camera.rotation[2])
            radius = np.linalg.norm(origins + along[:, None] * directions, axis=1)[hit]
            # Discs and patches reach over the outline by their own size.
            inside = closest[hit] < 1 - bound
            assert np.abs(radius - 1)[inside].max() < bound + 2e-6, name
        for a, (_, one) in spheres.items():
            for b, (_, other) in spheres.items():
                # A shell of bound b is crossed by a ray at angle t within b / cos t, more where it bends away.
                both = np.isfinite(depths[a]) & np.isfinite(depths[b]) & (closest < 0.97)
                cosine = np.sqrt(1 - closest[both] ** 2)
                off = np.abs(depths[a] - depths[b])[both] * cosine
                assert off.max() < 1.15 * (one + other) + 2e-6, (a, b)


@pytest.mark.parametrize("lanes", (16, 1))
def test_kinds_meet_in_the_right_line(device, spheres, lanes):
    """Four spheres side by side that cut into each other and into a plane: every pixel shows what is nearest there."""
    places = {"slim": (-0.9, 0, 0), "patches": (0.1, 0.2, 0.35), "mesh": (0.9, -0.1, -0.2), "cloud": (0, -1.0, 0.1)}
    surfaces, tilt = [], 0.3
    for name, place in places.items():
        matrix = np.eye(4)
        matrix[:3, 3] = place
        surfaces.append(spheres[name][0].moved(matrix))
    corners = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], np.float64)
    corners[:, 2] = tilt * corners[:, 0] - 0.2
    surfaces.append(Mesh(corners.astype(np.float32), [[0, 1, 2], [0, 2, 3]]))
    camera = Camera.look_at((0.6, 0.4, 4), (0, -0.2, 0), fov=50)
    with Renderer(device, lanes=lanes) as renderer:
        frame = renderer.render(Scene(surfaces), camera, size=SIZE, channels=("id", "depth", "color"), lod=0)
    origins, directions = camera.rays(SIZE)
    ts = []
    for place in places.values():
        o = origins - np.array(place)
        b = (o * directions).sum(1)
        disc = b * b - (o * o).sum(1) + 1
        ts.append(np.where(disc > 0, -b - np.sqrt(np.maximum(disc, 0)), np.inf))
    normal = np.array([-tilt, 0, 1])
    t = -(origins @ normal + 0.2) / (directions @ normal)
    ts.append(np.where(t > 0, t, np.inf))
    ts = np.stack(ts)
    want = ts.argmin(axis=0).reshape(SIZE[::-1])
    sure = np.ones_like(want, bool)  # a pixel or two away from every line
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            sure &= np.roll(want, (dy, dx), (0, 1)) == want
    sure[[0, -1]] = sure[:, [0, -1]] = False
    assert sure.mean() > 0.6 and len(np.unique(want)) == 5
    assert (frame.id == want)[sure].all()
    # Between two that cut into each other the line itself is right to half a pixel: two thirds of the rest agree.
    assert (frame.id == want)[~sure].mean() > 0.66
    depth = (ts.min(axis=0) * -(directions @ camera.rotation[2])).reshape(SIZE[::-1])
    assert np.median(np.abs(frame.depth - depth)[sure]) < 1e-3


def allocated(device, draw):
    """Bytes of device arrays that `draw` makes and that are alive after it."""
    live, made = {}, []
    originals = device.empty, device.upload

    def watched(original):
        def call(*arguments, **options):
            array = original(*arguments, **options)
            key = len(made)
            made.append(key)
            live[key] = array.nbytes
            weakref.finalize(array, live.pop, key, None)
            return array
        return call
    device.empty, device.upload = (watched(original) for original in originals)
    try:
        kept = draw()
        return sum(live.values()), kept
    finally:
        device.__dict__.pop("empty", None)
        device.__dict__.pop("upload", None)


@pytest.mark.parametrize("kind", SPHERES)
def test_instances_share_uploads(device, spheres, kind):
    """Ten placements of one surface take at most 1.15 times the memory of one."""
    surface = spheres[kind][0]
    matrices = [np.eye(4) for _ in range(10)]
    for k, matrix in enumerate(matrices):
        matrix[:3, 3] = 1.5 * (k % 4), 1.5 * (k // 4), 0.1 * k
    camera = Camera.look_at((3, 2, 9), (2.5, 1.5, 0), fov=45)
    sizes = []
    for scene in ([surface.moved(matrices[0])], [surface.moved(m) for m in matrices]):
        def draw(scene=scene):
            renderer = Renderer(device)
            renderer.render(Scene(scene), camera, size=SIZE, channels=("color", "depth", "id"))
            frame = renderer.render(Scene(scene), camera, size=SIZE, channels=("color", "depth", "id"))
            return renderer, frame
        nbytes, (renderer, frame) = allocated(device, draw)
        sizes.append(nbytes)
        renderer.close()
    assert sizes[0] > surface.nbytes / 2
    assert sizes[1] <= 1.15 * sizes[0]
    assert set(np.unique(frame.id)) == set(range(-1, 10))


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("planes", ("oblique", "facing", "two", "all"))
def test_meshes_show_their_inside(device, spheres, planes, lanes):
    """Clip planes cut triangles at every pixel."""
    with Renderer(device, lanes=lanes) as renderer:
        check(renderer, spheres["mesh"][0], CAMERAS["perspective"], PLANES[planes], 0.02, 0.15)


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("planes", ("oblique", "facing", "two", "all"))
def test_clouds_show_their_inside(device, spheres, planes, lanes):
    """Clip planes cut discs; a disc reaches up to a pixel (0.04 of the radius) past an outline and a cut."""
    camera = CAMERAS["perspective"]
    with Renderer(device, lanes=lanes) as renderer:
        frame = renderer.render(spheres["cloud"][0], camera, CLIP_SIZE, lod=0, clip=PLANES[planes])
    wanted, safe = sphere_depth(camera, PLANES[planes])
    sure = safe > 0.15
    assert sure.mean() > 0.5
    shown, there = np.isfinite(frame.depth), np.isfinite(wanted)
    assert (shown != there)[sure].mean() < 0.015
    assert (planes == "all") == (not shown.any())
    hit = (safe > 0.35) & shown & there  # a grazing ray meets the plane of a disc far along
    if hit.any():
        off = np.abs(frame.depth - wanted)[hit]
        assert np.median(off) < 1e-3 and np.quantile(off, 0.98) < 0.06
        directions = camera.rays(CLIP_SIZE)[1].reshape(*hit.shape, 3)
        assert ((frame.normal * directions).sum(axis=-1)[hit] < 0).all()  # normals face the eye, also on the inside
