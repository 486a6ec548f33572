"""Point clouds: discs against their twin, closed surfaces, near planes, thinning, eye-dome lighting, range images."""

import numpy as np
import pytest
from reference import render_points as twin

from clsurf.errors import InputError
from clsurf.models.basic import sphere, torus
from clsurf.render.camera import Camera
from clsurf.render.eye_dome import NEIGHBOURS, STRENGTH
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.point_drawing import PointDrawing
from clsurf.render.points import RUN, place_points, project_points, space_order, spread_places, upload_cloud
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Light, Look, Shading
from clsurf.render.slim_drawing import SlimDrawing
from clsurf.render.tiles import Grid, Layout, Scratch
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh
from clsurf.surface.ranges import RangeImage, RangeScan
from clsurf.surface.srgb import LINEAR_OF_BYTE

SIZE = (90, 70)
ALL = ("color", "depth", "normal", "position", "id", "count", "level", "cost")
CAMERAS = {"perspective": Camera.look_at((0.5, 0.3, 3), (0, 0, 0)),
           "inside": Camera.look_at((0.1, 0.05, 0.2), (1, 0.2, 0), fov=75),
           "near": Camera.look_at((0.5, 0.3, 3), (0, 0, 0), near=2.6),
           "orthographic": Camera.orthographic((1, 2, 3), (0, 0, 0), height=3),
           "orthographic near": Camera.orthographic((1, 2, 3), (0, 0, 0), height=3, near=3.7)}


def scattered(n=400, normals=True, seed=0):
    """Points at random in a box, with normals at random."""
    rng = np.random.default_rng(seed)
    n1 = rng.normal(size=(n, 3))
    n1 /= np.linalg.norm(n1, axis=1, keepdims=True)
    return PointCloud(rng.uniform(-1, 1, (n, 3)).astype(np.float32), normals=n1 if normals else None,
                      colors=rng.integers(0, 256, (n, 4)).astype(np.uint8))


def pixel_centres(size=SIZE):
    y, x = np.mgrid[:size[1], :size[0]] + 0.5
    return np.stack([x.ravel(), y.ravel()], axis=1)


def look(points=None, lod=0.0):
    return Look(Shading(), lod, PatchDrawing(), SlimDrawing(), points=points or PointDrawing())


def uploaded_points(device, upload):
    """Positions, radii and normals (or None) on the device, without the padding."""
    planes = device.download(upload.planes).astype(np.float64)
    there = upload.order >= 0
    return planes[:3, there].T, planes[3, there], planes[4:7, there].T if upload.has_normals else None


def same(a, b, tolerance=0.0):
    for name in a.channels:
        p, q = a.channels[name], b.channels[name]
        assert np.array_equal(np.isnan(p), np.isnan(q)), name
        assert np.nanmax(np.abs(p - q), initial=0) <= tolerance, name


# Upload ---------------------------------------------------------------------------------------------------------------


def test_order_of_points():
    points = torus(5000).points
    order = space_order(points)
    assert np.array_equal(np.sort(order), np.arange(5000))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1)
    assert np.median(steps) < 0.1 * np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))
    places = spread_places()
    assert np.array_equal(np.sort(places), np.arange(RUN))
    for k in (16, 32, 64, 128):
        assert (np.diff(np.sort(places[:k])) == RUN // k).all()


@pytest.mark.parametrize("lanes", (16, 8, 4, 1))
def test_point_spacing(device, lanes):
    points = np.random.default_rng(0).uniform(size=(700, 3)).astype(np.float32)
    points[5] = points[4]
    planes = np.full((4, 768), np.nan, np.float32)
    planes[:3, :700] = points.T
    out = device.empty((3, 16), np.float32)
    device.kernel("render/point_spacing.cl", constants={"VW": lanes})((3 * 16 // lanes,), None, device.upload(planes),
                                                                       768, 3, out)
    want = twin.point_spacing(planes[:3].T.astype(np.float64), 3)
    assert np.abs(np.sqrt(device.download(out)) - want).max() < 1e-6


def test_radii_follow_the_local_spacing(device):
    """Two halves of a plane, one sampled four times as densely."""
    def grid(step, x0):
        x, y = np.meshgrid(x0 + np.arange(0, 1, step), np.arange(0, 1, step))
        return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    points = np.concatenate([grid(0.02, 0), grid(0.005, 1.0)])
    upload = upload_cloud(device, PointCloud(points.astype(np.float32)))
    where, radius, _ = uploaded_points(device, upload)
    coarse, fine = radius[where[:, 0] < 0.8], radius[where[:, 0] > 1.2]
    assert 0.71 < np.median(coarse) / 0.02 < 1.6 and 0.71 < np.median(fine) / 0.005 < 1.6
    for few in (points[:1], points[:3], np.tile(points[:1], (50, 1))):  # nothing to measure
        radius = uploaded_points(device, upload_cloud(device, PointCloud(few.astype(np.float32))))[1]
        assert np.isfinite(radius).all() and (radius > 0).all()


# Drawing --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("normals", (True, False))
def test_project_points(device, name, normals):
    """Every pixel of a disc lies in the tiles of its run, whose least depth bounds it."""
    cloud, camera = scattered(1500, normals), CAMERAS[name]
    upload, scratch = upload_cloud(device, cloud), Scratch(device, 16)
    view = place_points(upload, None, camera, SIZE, look())
    grid = Grid(SIZE, 1, Layout(), None, None, patch_bins=2)
    drawn, _, pairs = project_points(device, scratch, grid, upload, device.upload(view), 0.0)
    assert (device.download(drawn) == RUN).all()
    offsets, pairs = device.download(pairs.offsets), device.download(pairs.pairs)[:pairs.total]
    run = np.flatnonzero(upload.order >= 0) // RUN
    pixels = pixel_centres()
    _, depth = twin.disc_samples(view, *uploaded_points(device, upload), pixels)
    tile = (pixels[:, 1] // 16 * -(-SIZE[0] // 16) + pixels[:, 0] // 16).astype(int)
    keys = pairs[:, 1] & np.uint32(0xffffff00)
    near = np.where(keys & 0x80000000, keys ^ np.uint32(0x80000000), ~keys).view(np.float32)
    least = {(t, pairs[e, 0] & 0x3fffffff): near[e] for t in range(len(offsets) - 1)
             for e in range(offsets[t], offsets[t + 1])}
    at, disc = np.nonzero(np.isfinite(depth))
    assert len(at) > 500
    for p, d in zip(at, disc, strict=True):
        assert least[tile[p], run[d]] <= depth[p, d] * (1 + 1e-5) + 1e-6


@pytest.mark.parametrize("lanes", (16, 8, 4, 1))
@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("normals", (True, False))
def test_tile_points(device, normals, name, lanes):
    """Depths and colours of scattered discs, some large, some at the near plane."""
    cloud, camera = scattered(normals=normals), CAMERAS[name]
    with Renderer(device, lanes=lanes) as renderer:
        frame = renderer.render(cloud, camera, size=SIZE, channels=("depth", "color", "normal"), lod=0,
                                shading=Shading(look="flat"))
    upload = upload_cloud(device, cloud)
    view = place_points(upload, None, camera, SIZE, look())
    centers, radii, directions = uploaded_points(device, upload)
    want, disc = twin.tile_points(view, centers, radii, directions, pixel_centres())
    got, shown = frame.depth.ravel().astype(np.float64), np.isfinite(want)
    assert shown.mean() > 0.2
    assert (np.isfinite(got) != shown).mean() < 2e-3  # rims that all but pass through a pixel's centre
    both = shown & np.isfinite(got)
    off = np.abs(got[both] - want[both])
    assert np.median(off) < 1e-6 and (off > 1e-4).mean() < 4e-3
    colors = LINEAR_OF_BYTE[cloud.colors[upload.order[upload.order >= 0], :3]][disc[both]]
    assert (np.abs(frame.color.reshape(-1, 4)[both, :3] - colors).max(axis=1) > 1e-6).mean() < 4e-3
    toward = -(pixel_rays(camera))[both]
    assert ((frame.normal.reshape(-1, 3)[both] * toward).sum(1) > -1e-6).all()


def pixel_rays(camera):
    return camera.rays(SIZE)[1]


@pytest.mark.parametrize("lanes", (16, 1))
def test_discs_close_a_sphere(device, lanes):
    """No hole inside of the outline, near and far, thinned or not; depth and normals are those of the sphere."""
    cloud = sphere(20_000)
    for distance, lod in ((3, 0), (3, 4), (12, 4), (60, 8)):
        camera = Camera.look_at((distance, 0.3 * distance, 0.4 * distance), (0, 0, 0), fov=130 / distance)
        with Renderer(device, lanes=lanes) as renderer:
            frame = renderer.render(cloud, camera, size=SIZE, channels=("depth", "normal", "position"), lod=lod)
        origins, directions = camera.rays(SIZE)
        closest = origins - (origins * directions).sum(1, keepdims=True) * directions
        off = np.linalg.norm(closest, axis=1)
        depth = frame.depth.ravel()
        assert np.isfinite(depth[off < 0.98]).all()
        assert np.isnan(depth[off > 1.15]).all()
        inner = off < 0.9
        place = frame.position.reshape(-1, 3)[inner]
        assert np.abs(np.linalg.norm(place, axis=1) - 1).max() < (2e-3 if lod == 0 else 0.03)
        if lod == 0:
            cosine = (frame.normal.reshape(-1, 3)[inner] * place).sum(1)
            assert np.degrees(np.arccos(np.clip(cosine.min(), -1, 1))) < 4


def test_thinning_draws_fewer_points(device):
    cloud = sphere(200_000)
    upload, scratch = upload_cloud(device, cloud), Scratch(device, 16)
    grid = Grid(SIZE, 4, Layout(), None, None)
    counts = []
    for distance in (1.5, 6, 40):
        camera = Camera.look_at((distance, 0, 0), (0, 0, 0))
        view = device.upload(place_points(upload, None, camera, SIZE, look()))
        counts.append(device.download(project_points(device, scratch, grid, upload, view, 4.0)[0]).mean())
    assert counts[0] > 2 * counts[1] and counts[2] == 16


def test_sizes(device):
    """World and pixel sizes of a lone point."""
    cloud, camera = PointCloud(np.zeros((1, 3), np.float32)), Camera.look_at((0, 0, 5), (0, 0, 0), fov=40)
    focal = 70 / (2 * np.tan(np.radians(20)))
    with Renderer(device) as renderer:
        def count(surface, **options):
            frame = renderer.render(surface, camera, size=SIZE, channels=("depth",), points=PointDrawing(**options))
            return np.isfinite(frame.depth).sum()
        assert abs(count(cloud, size=20, unit="pixels") / (np.pi * 100) - 1) < 0.05
        assert abs(count(cloud, size=0.6) / (np.pi * (0.3 * focal / 5) ** 2) - 1) < 0.1
        grown = np.diag([2.0, 2, 2, 1])
        assert abs(count(cloud.moved(grown), size=0.6) / (np.pi * (0.3 * focal / 5) ** 2) - 1) < 0.1
        assert count(cloud, size=1e-9) == 1 and count(cloud, size=0.01, unit="pixels") == 1


def test_frames_do_not_depend_on_tiles_forms_or_order(device):
    rng = np.random.default_rng(2)
    for normals in (True, False):
        cloud = scattered(900, normals)
        order = rng.permutation(900)
        shuffled = PointCloud(cloud.points[order], normals=None if not normals else cloud.normals[order],
                              colors=cloud.colors[order])
        for name in ("perspective", "inside", "orthographic"):
            frames = []
            for options in ({}, {"tile": 8}, {"tile": 64}, {"lanes": 1}):
                with Renderer(device, **options) as renderer:
                    frames += [renderer.render(c, CAMERAS[name], size=SIZE, channels=ALL[:-1], lod=0,
                                               points=PointDrawing(size=0.1)) for c in (cloud, shuffled)]
            for frame in frames[1:6]:
                same(frames[0], frame)
            for frame in frames[6:]:  # the compiler may round differently in another form
                depth = np.nan_to_num(frame.depth, nan=-1), np.nan_to_num(frames[0].depth, nan=-1)
                assert (np.abs(depth[0] - depth[1]) > 1e-5).mean() < 1e-3


# Eye-dome lighting ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lanes", (16, 8, 1))
@pytest.mark.parametrize("name", ("perspective", "orthographic"))
def test_eye_dome(device, name, lanes):
    cloud, camera = scattered(normals=False), CAMERAS[name]
    reach = 2.3
    with Renderer(device, lanes=lanes) as renderer:
        plain = renderer.render(cloud, camera, size=SIZE, points=PointDrawing(eye_dome=False))
        frame = renderer.render(cloud, camera, size=SIZE, points=PointDrawing(strength=0.7, reach=reach))
    angles = 2 * np.pi * np.arange(NEIGHBOURS) / NEIGHBOURS
    steps = np.rint(reach * np.stack([np.cos(angles), np.sin(angles)], axis=1)).astype(int)
    hit = np.isfinite(plain.depth)
    reference = 0 if name == "perspective" else 3 / (2 * np.tan(np.radians(20)))
    kept = twin.eye_dome(np.where(hit, plain.depth, np.inf).astype(np.float64), steps,
                         0.7 * STRENGTH / np.log(2), reference)
    assert np.abs(frame.color[hit, :3] - plain.color[hit, :3] * kept[hit][:, None]).max() < 1e-3
    assert (frame.color[~hit] == 1).all()
    assert 0.01 < (kept[hit] < 0.5).mean() < 0.99


def test_clouds_take_light_by_their_normals(device):
    """With normals clouds are lit; without, or when asked to, they show their own colours under eye-dome lighting."""
    cloud = sphere(20_000)
    bare = PointCloud(cloud.points)
    away = Scene([cloud], lights=[Light("directional", (0, 0, -1))])
    camera = Camera.look_at((0, 0, 3), (0, 0, 0))
    with Renderer(device) as renderer:
        middle = (SIZE[1] // 2, SIZE[0] // 2)
        base = renderer.render(bare, camera, size=SIZE, points=PointDrawing(eye_dome=False)).color[middle]
        flat = renderer.render(bare, camera, size=SIZE, shading=Shading(look="flat")).color[middle]
        assert np.abs(base - flat).max() < 1e-6
        assert renderer.render(away, camera, size=SIZE).color[middle][0] < 0.2 * base[0]
        asked = renderer.render(away, camera, size=SIZE, points=PointDrawing(eye_dome=True)).color[middle]
        assert asked[0] > 0.9 * base[0]
        # A mesh in the same picture is lit as ever.
        mesh = Mesh(np.array([[-9, -9, -2], [9, -9, -2], [0, 9, -2]], np.float32), [[0, 1, 2]])
        alone, both = (renderer.render(Scene(s), camera, size=SIZE, channels=("color", "id"))
                       for s in ([mesh], [mesh, bare]))
        assert np.array_equal(alone.color[both.id == 0], both.color[both.id == 0])
        assert {0, 1} <= set(both.id.ravel())


# Options and input ----------------------------------------------------------------------------------------------------


def test_attributes_color_points(device):
    n = 3000
    cloud = sphere(n)
    height = cloud.points[:, 1].astype(np.float64)
    cloud = PointCloud(cloud.points, attributes={"height": height, "pair": np.zeros((n, 2))})
    with Renderer(device) as renderer:
        frame = renderer.render(cloud, Camera.look_at((0, 0, 3), (0, 0, 0)), size=SIZE,
                                points=PointDrawing(attribute="height", eye_dome=False))
        top, bottom = frame.color[18, 45], frame.color[52, 45]
        assert top[0] > top[2] and bottom[2] > bottom[0]
        for name in ("nothing", "pair"):
            with pytest.raises(InputError, match="height"):
                renderer.render(cloud, size=SIZE, points=PointDrawing(attribute=name))


@pytest.mark.parametrize("wrong", ({"size": 0}, {"size": np.nan}, {"size": "big"}, {"unit": "mm"}, {"strength": -1},
                                   {"reach": 0}, {"reach": 17}, {"eye_dome": "yes"}, {"attribute": 3}))
def test_bad_options(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        PointDrawing(**wrong)


def test_nothing_and_what_is_not_finite(device):
    camera = CAMERAS["perspective"]
    with Renderer(device) as renderer:
        for points in (np.zeros((0, 3)), np.full((5, 3), np.nan), np.array([[np.inf, 0, 0]])):
            frame = renderer.render(PointCloud(points.astype(np.float32)), camera, size=SIZE, channels=ALL)
            assert np.isnan(frame.depth).all() and (frame.id == -1).all()
        cloud = scattered(300, normals=False)
        holed = PointCloud(np.concatenate([cloud.points, np.full((4, 3), np.nan, np.float32)]),
                           colors=np.concatenate([cloud.colors, np.zeros((4, 4), np.uint8)]))
        same(renderer.render(cloud, camera, size=SIZE), renderer.render(holed, camera, size=SIZE))
        with pytest.raises(InputError, match="points"):
            renderer.render(cloud, camera, points="big")
        zeros = PointCloud(cloud.points, normals=np.zeros((300, 3), np.float32))
        assert np.isfinite(renderer.render(zeros, camera, size=SIZE).depth).any()


def test_far_origins_and_placements(device):
    cloud = scattered()
    far = PointCloud(cloud.points, normals=cloud.normals, colors=cloud.colors, origin=(7691239.553, 851210.25, -4321.5))
    camera = Camera.look_at(far.origin + np.array((0.5, 0.3, 3)), far.origin)
    turn = np.eye(4)
    turn[:3, :3] = 2 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turn[:3, 3] = 1, 2, 3
    with Renderer(device) as renderer:
        home = renderer.render(cloud, CAMERAS["perspective"], size=SIZE).depth
        there = renderer.render(far, camera, size=SIZE).depth
        moved = Camera.look_at(turn[:3, :3] @ (0.5, 0.3, 3) + turn[:3, 3], turn[:3, 3], up=turn[:3, :3] @ (0, 1, 0))
        placed = renderer.render(cloud.moved(turn), moved, size=SIZE).depth / 2
        for depth in (there, placed):
            assert (np.isnan(depth) != np.isnan(home)).mean() < 1e-3
            assert (np.nan_to_num(np.abs(depth - home)) > 1e-4).mean() < 2e-3


def test_range_scans_are_their_points(device):
    y, x = np.mgrid[:40, :50]
    depth = (3 + 0.3 * np.sin(x / 6) * np.cos(y / 5)).astype(np.float32)
    depth[10:14, 20:25] = 0
    color = np.random.default_rng(0).integers(0, 256, (40, 50, 4)).astype(np.uint8)
    k = np.array([[60.0, 0, 25], [0, 60, 20], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, 3] = 100, 200, 300
    scan = RangeScan([RangeImage(depth=depth, intrinsics=k, color=color, pose=pose)])
    camera = Camera.from_intrinsics(k + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), pose, (50, 40))
    with Renderer(device) as renderer:
        frame = renderer.render(scan, camera, size=(50, 40), channels=("color", "depth", "position"))
        same(frame, renderer.render(scan.to_points(), camera, size=(50, 40), channels=("color", "depth", "position")))
        assert np.allclose(scan.moved(np.eye(4)).bounds, scan.bounds)
    seen = np.isfinite(frame.depth) & (depth > 0)
    assert seen.sum() == (depth > 0).sum()
    assert np.abs(frame.depth - depth)[seen].max() < 0.06
