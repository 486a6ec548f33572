"""The triangle stage: exact, no pinholes, no double hits, right at the near plane, independent of forms and order."""

from dataclasses import replace

import numpy as np
import pytest
from reference import render_triangles as twin

from clsurf.render.camera import Camera
from clsurf.render.mesh import upload_mesh
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.renderer import Renderer
from clsurf.render.shade import Look, Shading
from clsurf.render.slim_drawing import SlimDrawing
from clsurf.render.tiles import Grid, Layout, Scratch
from clsurf.render.triangles import RUN, draw_triangles, place_triangles, project_triangles
from clsurf.surface.mesh import Mesh

SIZE = (90, 70)
ALL = ("color", "depth", "normal", "position", "id", "count", "level", "cost")
CAMERAS = {"perspective": Camera.look_at((0.5, 0.3, 3), (0, 0, 0)),
           "inside": Camera.look_at((0.1, 0.05, 0.2), (1, 0.2, 0), fov=75),
           "near": Camera.look_at((0.5, 0.3, 3), (0, 0, 0), near=3.0),
           "orthographic": Camera.orthographic((1, 2, 3), (0, 0, 0), height=3),
           "orthographic near": Camera.orthographic((1, 2, 3), (0, 0, 0), height=3, near=3.7)}


def soup(n=300, seed=0, size=0.4, spread=1.0):
    """Random triangles, some large."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-spread, spread, (n, 1, 3))
    corners = middle + rng.normal(size=(n, 3, 3)) * size * rng.uniform(0.05, 1, (n, 1, 1)) ** 2
    return Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(3 * n).reshape(-1, 3))


def globe(rows=24, columns=40, radius=1.0):
    """A closed sphere whose faces point outwards, with exact normals."""
    a, t = np.arange(columns) * 2 * np.pi / columns, np.arange(1, rows) * np.pi / rows
    ring = np.stack([np.sin(t)[:, None] * np.cos(a), np.sin(t)[:, None] * np.sin(a), np.cos(t)[:, None] + 0 * a], -1)
    points = np.concatenate([[[0, 0, 1]], ring.reshape(-1, 3), [[0, 0, -1]]])
    faces, last = [], len(points) - 1
    for c in range(columns):
        d = (c + 1) % columns
        faces += [(0, 1 + c, 1 + d), (last, last - columns + d, last - columns + c)]
        for r in range(rows - 2):
            p, q = 1 + r * columns, 1 + (r + 1) * columns
            faces += [(p + c, q + c, q + d), (p + c, q + d, p + d)]
    return Mesh((radius * points).astype(np.float32), faces, normals=points)


def pixel_centres(size=SIZE):
    y, x = np.mgrid[:size[1], :size[0]] + 0.5
    return np.stack([x.ravel(), y.ravel()], axis=1)


def view_of(mesh, camera, size=SIZE):
    return place_triangles(camera, size, None, mesh.origin, np.zeros(3), 3.0, (1, 1, 1))


def same(a, b, tolerance=0.0):
    """Whether two frames show the same."""
    for name in a.channels:
        p, q = a.channels[name], b.channels[name]
        assert np.array_equal(np.isnan(p), np.isnan(q)), name
        assert np.nanmax(np.abs(p - q), initial=0) <= tolerance, name


@pytest.mark.parametrize("name", CAMERAS)
def test_project_vertices(device, name):
    mesh, view = soup(), view_of(soup(), CAMERAS[name])
    positions = np.pad(mesh.vertices, ((0, 0), (0, 1)))
    positions[7] = np.nan
    positions[8, 1] = np.inf
    want = twin.project_vertices(view, positions[:, :3])
    for run in (1, 100):
        points = device.empty(positions.shape, np.float32)
        device.kernel("render/project_vertices.cl")((len(positions),), None, device.upload(view),
                                                    device.upload(positions), len(positions), run, points)
        got = device.download(points)
        assert (got[7:9] == (0, 0, 0, -np.inf)).all()
        ok = np.isfinite(want[:, 3])
        assert np.abs(got[ok, 3] - want[ok, 3]).max() < 2e-6
        scale = 1 + np.abs(want[ok]) + SIZE[0] / np.abs(want[ok, 3:]) if view[17] else 1 + np.abs(want[ok])
        assert (np.abs(got[ok] - want[ok]) / scale).max() < 2e-5


@pytest.mark.parametrize("name", CAMERAS)
def test_project_triangles(device, name):
    """Every pixel of a face lies in the tiles of its run, whose least depth bounds it."""
    mesh, camera = soup(900, size=0.2), CAMERAS[name]
    upload, view = upload_mesh(device, mesh), view_of(mesh, camera)
    scratch = Scratch(device, 16)
    grid = Grid(SIZE, 1, Layout(), None, None, patch_bins=2)
    _, pairs = project_triangles(device, scratch, grid, upload.triangles, device.upload(view))
    offsets, pairs = device.download(pairs.offsets), device.download(pairs.pairs)[:pairs.total]
    faces = device.download(upload.triangles.faces)
    pixels = pixel_centres()
    depth = twin.hits(view, mesh.vertices, faces, pixels)
    tile = (pixels[:, 1] // 16 * -(-SIZE[0] // 16) + pixels[:, 0] // 16).astype(int)
    at, face = np.nonzero(np.isfinite(depth))
    keys = pairs[:, 1] & np.uint32(0xffffff00)
    near = np.where(keys & 0x80000000, keys ^ np.uint32(0x80000000), ~keys).view(np.float32)
    least = {(t, pairs[e, 0] & 0x3fffffff): near[e] for t in range(len(offsets) - 1)
             for e in range(offsets[t], offsets[t + 1])}
    assert len(at) > 500
    for p, f in zip(at, face, strict=True):
        assert least[tile[p], f // RUN] <= depth[p, f] * (1 + 1e-5) + 1e-6
    if name == "perspective":  # and no tile without a reason
        assert len(least) < 1.5 * len({(t, f // RUN) for t, f in zip(tile[at], face, strict=True)}) + 30


@pytest.mark.parametrize("lanes", (16, 8, 4, 1))
@pytest.mark.parametrize("name", CAMERAS)
def test_tile_triangles(device, name, lanes):
    """Depths of a soup of small and large triangles, some of which cross the near plane."""
    mesh, camera = soup(), CAMERAS[name]
    with Renderer(device, lanes=lanes) as renderer:
        frame = renderer.render(mesh, camera, size=SIZE, channels=("depth",))
    want, _ = twin.tile_triangles(view_of(mesh, camera), mesh.vertices, mesh.faces, pixel_centres())
    got = frame.depth.ravel().astype(np.float64)
    shown = np.isfinite(want)
    assert shown.mean() > 0.2
    # A pixel whose centre an edge all but passes through may go either way.
    assert (np.isfinite(got) != shown).mean() < 5e-4
    both = shown & np.isfinite(got)
    off = np.abs(got[both] - want[both])
    assert np.median(off) < 1e-6
    assert (off > 2e-5 * (1 + want[both])).mean() < 1e-3


@pytest.mark.parametrize("lanes", (16, 4, 1))
@pytest.mark.parametrize("step", (0.5, 0.75, 3.0, 9.5, 40.0))
def test_every_pixel_is_hit_once(device, step, lanes):
    """A flat triangulation, many of whose edges and corners pass through pixels' centres: 64 samples in every bin."""
    size = (64, 48)
    n, m = (int(np.ceil(s / step)) + 3 for s in size)
    rng = np.random.default_rng(int(step * 4))
    x, y = (g.astype(float) for g in np.meshgrid(np.arange(n), np.arange(m)))
    x, y = (x - 1) * step, (y - 1) * step
    jitter = np.trunc(rng.uniform(-0.2, 0.2, (2, m, n)) * step * 2) / 2  # half pixels: exact in float32
    x, y = x + jitter[0], y + jitter[1]
    corner = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).ravel()
    flip = rng.uniform(size=len(corner)) < 0.5
    a, b, c, d = corner, corner + 1, corner + n, corner + n + 1
    faces = np.where(flip[:, None, None], np.stack([a, b, d, a, d, c], 1).reshape(-1, 2, 3),
                     np.stack([a, b, c, d, c, b], 1).reshape(-1, 2, 3)).reshape(-1, 3)
    faces[::3] = faces[::3, ::-1]  # whichever way they run
    points = np.stack([x.ravel() - size[0] / 2, size[1] / 2 - y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    camera = Camera.orthographic((0, 0, 1), (0, 0, 0), height=size[1])
    with Renderer(device, lanes=lanes) as renderer:
        frame = renderer.render(Mesh(points, faces), camera, size=size, channels=("cost", "depth"))
    assert (frame.depth == 1).all()
    assert (frame.cost == 64).all()


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("zoom", (1, 4, 40))
def test_closed_meshes_have_no_pinholes(device, zoom, lanes):
    """Inside of the outline of a sphere every pixel is hit, whether faces are smaller or larger than a pixel."""
    mesh = globe(60, 90)
    camera = Camera.look_at((2, 1, 5.0 * (8 if zoom == 1 else 1)), (0, 0, 0.0), fov=40 / (zoom if zoom > 1 else 1))
    size = (120, 90)
    with Renderer(device, lanes=lanes) as renderer:
        frame = renderer.render(mesh, camera, size=size, channels=("depth",))
    origins, directions = camera.rays(size)
    closest = np.linalg.norm(origins - (origins * directions).sum(1, keepdims=True) * directions, axis=1)
    hit = np.isfinite(frame.depth).ravel()
    assert hit[closest < 0.99].all()
    assert not hit[closest > 1].any()


@pytest.mark.parametrize("lanes", (16, 1))
def test_eye_inside_sees_everything(device, lanes):
    """From inside a closed mesh every pixel is hit, at the depth of the sphere, also looking past the eye's plane."""
    mesh = globe(30, 50)
    for eye, fov in (((0.2, 0.1, 0.3), 60), ((0.0, 0.0, 0.0), 150), ((0.97, 0, 0), 120)):
        camera = Camera.look_at(eye, np.add(eye, (0.3, 0.2, 1)), fov=fov)
        with Renderer(device, lanes=lanes) as renderer:
            frame = renderer.render(mesh, camera, size=SIZE, channels=("depth", "normal"))
        assert np.isfinite(frame.depth).all()
        origins, directions = camera.rays(SIZE)
        place = origins + (frame.depth.ravel() / -(directions @ camera.rotation[2]))[:, None] * directions
        radius = np.linalg.norm(place, axis=1)
        assert radius.max() < 1 + 1e-5 and radius.min() > 0.985  # facets lie inside of the sphere
        assert ((frame.normal.reshape(-1, 3) * directions).sum(1) < 0).all()


def test_attributes_are_exact_in_perspective(device):
    """Colours and depths of two large triangles seen at a grazing angle; the plane's normal."""
    points = np.array([[-4, 0, -30], [4, 0, -30], [4, 0, 2], [-4, 0, 2]], np.float32)
    colors = np.full((4, 4), 255, np.uint8)
    colors[:, 0], colors[:, 1] = [0, 255, 255, 0], [0, 0, 255, 255]
    camera = Camera.look_at((0.5, 1, 0), (0.3, 0.2, -3), fov=60)
    origins, directions = camera.rays(SIZE)
    t = -origins[:, 1] / directions[:, 1]
    place = origins + t[:, None] * directions
    seen = (t > 0) & (np.abs(place[:, 0]) < 3.99) & (place[:, 2] > -29.9) & (place[:, 2] < 1.99)
    for lanes in (16, 1):
        with Renderer(device, lanes=lanes) as renderer:
            frame = renderer.render(Mesh(points, [[0, 1, 2], [2, 0, 3]], colors=colors), camera, size=SIZE,
                                    channels=ALL, shading=Shading(look="flat"))
        color = frame.color.reshape(-1, 4)[seen]
        assert np.abs(color[:, 0] - (place[seen, 0] + 4) / 8).max() < 1e-4
        assert np.abs(color[:, 1] - (place[seen, 2] + 30) / 32).max() < 1e-4
        depth = t[seen] * -(directions[seen] @ camera.rotation[2])
        assert np.abs(frame.depth.ravel()[seen] / depth - 1).max() < 1e-5
        assert np.abs(frame.normal.reshape(-1, 3)[seen] - (0, 1, 0)).max() < 1e-6
        assert (frame.id.ravel()[seen] == 0).all() and (frame.count.ravel()[seen] == 1).all()


def test_normals(device):
    """Vertex normals are interpolated, faces' own are exact, all face the eye whichever way they are stored."""
    mesh = globe(40, 60)
    camera = CAMERAS["perspective"]
    with Renderer(device) as renderer:
        smooth = renderer.render(mesh, camera, size=SIZE, channels=("normal", "position"))
        hit = np.isfinite(smooth.position[..., 0])
        exact = smooth.position / np.linalg.norm(smooth.position, axis=-1, keepdims=True)
        inner = hit & ((exact * (camera.eye - smooth.position)).sum(-1) > 0.2)
        angle = np.degrees(np.arccos(np.clip((smooth.normal * exact).sum(-1), -1, 1)))
        assert angle[inner].max() < 0.5
        for other in (Mesh(mesh.vertices, mesh.faces[:, ::-1], normals=mesh.normals),
                      Mesh(mesh.vertices, mesh.faces, normals=-mesh.normals)):
            frame = renderer.render(other, camera, size=SIZE, channels=("normal",))
            assert np.nanmax(np.abs(frame.normal - smooth.normal)[hit]) < 1e-5
        facets = renderer.render(Mesh(mesh.vertices, mesh.faces), camera, size=SIZE, channels=("normal", "position"))
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        cosine = (facets.normal.reshape(-1, 1, 3)[hit.ravel()] * own[None]).sum(-1).max(axis=1)
        assert cosine.min() > 1 - 1e-6
        eye = camera.eye - facets.position
        assert ((facets.normal * eye).sum(-1)[hit] > 0).all()


def test_frames_do_not_depend_on_tiles_forms_or_order(device):
    mesh = soup(600)
    rng = np.random.default_rng(3)
    colors = rng.integers(0, 256, (len(mesh.vertices), 4)).astype(np.uint8)
    mesh = Mesh(mesh.vertices, mesh.faces, colors=colors)
    order = rng.permutation(len(mesh.faces))
    shuffled = Mesh(mesh.vertices, mesh.faces[order], colors=colors)
    channels = [name for name in ALL if name != "cost"]
    for name in ("perspective", "inside", "orthographic"):
        frames = []
        for options in ({}, {"tile": 8}, {"tile": 64}, {"lanes": 1}, {"lanes": 4}):
            with Renderer(device, **options) as renderer:
                frames += [renderer.render(m, CAMERAS[name], size=SIZE, channels=channels) for m in (mesh, shuffled)]
        for frame in frames[1:6]:
            same(frames[0], frame)
        for frame in frames[6:]:  # the compiler may round interpolation differently in another form
            same(frames[0], frame, 2e-4)


def test_nothing_and_what_cannot_be_drawn(device):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [np.nan, 0, 0], [np.inf, 1, 1]], np.float32)
    camera = CAMERAS["perspective"]
    for lanes in (16, 1):
        with Renderer(device, lanes=lanes) as renderer:
            for faces in (None, [[0, 0, 1]], [[0, 1, 1], [2, 2, 2]], [[0, 1, 3]], [[4, 3, 2]]):
                frame = renderer.render(Mesh(points, faces), camera, size=SIZE, channels=ALL)
                assert np.isnan(frame.depth).all() and (frame.id == -1).all()
            whole = renderer.render(Mesh(points[:3], [[0, 1, 2]]), camera, size=SIZE)
            same(whole, renderer.render(Mesh(points, [[0, 1, 3], [0, 1, 2], [0, 0, 0]]), camera, size=SIZE))


def test_far_origins_and_placements(device):
    mesh = globe()
    far = Mesh(mesh.vertices, mesh.faces, normals=mesh.normals, origin=(7691239.553, 851210.25, -4321.5))
    camera = Camera.look_at(far.origin + np.array((0.5, 0.3, 3)), far.origin)
    turn = np.eye(4)
    turn[:3, :3] = 2 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turn[:3, 3] = 1, 2, 3
    with Renderer(device) as renderer:
        at_home = renderer.render(mesh, CAMERAS["perspective"], size=SIZE)
        same(at_home, renderer.render(far, camera, size=SIZE), 1e-5)
        moved = Camera.look_at(turn[:3, :3] @ (0.5, 0.3, 3) + turn[:3, 3], turn[:3, 3], up=turn[:3, :3] @ (0, 1, 0))
        frame = renderer.render(mesh.moved(turn), moved, size=SIZE)
        assert np.nanmax(np.abs(frame.depth - 2 * at_home.depth)) < 1e-5
        assert np.array_equal(np.isnan(frame.depth), np.isnan(at_home.depth))


def test_positions_may_come_from_a_kernel(device):
    """Triangles are device arrays: other positions draw what they say, whatever was drawn before."""
    mesh, camera = globe(), CAMERAS["perspective"]
    bigger = Mesh(1.2 * mesh.vertices, mesh.faces)
    upload = upload_mesh(device, mesh)
    moved = replace(upload.triangles, positions=device.upload(np.pad(bigger.vertices, ((0, 0), (0, 1)))), normals=None)
    bins = -(-SIZE[0] // 8), -(-SIZE[1] // 8)
    touched, planes = device.empty(bins[0] * bins[1], np.int32), device.empty((bins[0] * bins[1], 4, 64), np.float32)
    device.fill(touched, -1)
    grid, look = Grid(SIZE, 4, Layout(), touched, planes), Look(Shading(), 4.0, PatchDrawing(), SlimDrawing())
    for triangles in (upload.triangles, moved):
        draw_triangles(device, Scratch(device, 16), grid, triangles, view_of(mesh, camera), look, 0)
    depth = device.download(planes)[:, 0].reshape(bins[1], bins[0], 8, 8).transpose(0, 2, 1, 3)
    depth = np.where(np.repeat(np.repeat(device.download(touched).reshape(bins[::-1]) >= 0, 8, 0), 8, 1),
                     depth.reshape(8 * bins[1], -1), np.inf)[:SIZE[1], :SIZE[0]]
    with Renderer(device) as renderer:
        want = renderer.render(bigger, camera, size=SIZE, channels=("depth",)).depth
    assert np.array_equal(np.isinf(depth), np.isnan(want))
    assert np.abs(depth - want)[np.isfinite(want)].max() < 1e-5
