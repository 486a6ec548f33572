"""Range images to patches: on surfaces known by formula, nodes lie on them and nowhere else."""

import numpy as np
import pytest

import clsurf
from bench.patch_coverage import coverage, opaque_cells
from clsurf.errors import Cancelled, InputError
from clsurf.surface.ranges import RangeImage, RangeScan
from tests.conftest import scan_path

RADIUS, DISTANCE = 1.0, 4.0


def intrinsics(width):
    return np.array([[1.2 * width, 0, (width - 1) / 2], [0, 1.2 * width, (width - 1) / 2], [0, 0, 1]])


def rays(width):
    v, u = np.mgrid[:width, :width]
    return np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics(width)).T


def sphere_image(width, pose=None, radius=RADIUS, color=None):
    """Depth of a sphere about (0, 0, DISTANCE) in the camera's space."""
    ray = rays(width)
    a, b, c = (ray ** 2).sum(axis=-1), -DISTANCE, DISTANCE ** 2 - radius ** 2
    with np.errstate(invalid="ignore"):
        depth = (-b - np.sqrt(b * b - a * c)) / a
    return RangeImage(depth=depth, intrinsics=intrinsics(width), pose=pose, color=color)


def looking_at_zero(angle):
    """A camera DISTANCE away from the world's zero, turned about y."""
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = -DISTANCE * pose[:3, 2]
    return pose


def plane_depth(width, normal=(0.3, 0.2, -1.0), offset=-2.0):
    return offset / (rays(width) @ np.array(normal))


def nodes_of(surface):
    nodes = surface.positions()
    return nodes[np.isfinite(nodes[:, 0])]


def test_plane_is_exact(device):
    """Every node lies on the plane; the patches cover the picture up to its rim."""
    image = RangeImage(depth=plane_depth(64), intrinsics=intrinsics(64))
    surface = clsurf.build_patches(RangeScan([image]), device=device, precise=True)
    nodes = nodes_of(surface)
    assert np.abs(nodes @ (0.3, 0.2, -1.0) + 2.0).max() < 2e-6
    pixels = nodes @ intrinsics(64).T
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert pixels.min() > -0.01 and pixels.max() < 63.01
    found = coverage(surface, image.sensor_points().reshape(-1, 3).astype(float))
    assert found.points_covered == 1 and found.nodes_supported == 1
    assert surface.bound < 2e-5 and surface.bound_share > 0.9 and surface.oriented


def test_sphere_converges(device):
    """The error of nodes falls with the square of the samples' spacing: cells are flat."""
    errors = []
    for width in (64, 128, 256):
        scan = RangeScan([sphere_image(width, looking_at_zero(0.0))])
        nodes = nodes_of(clsurf.build_patches(scan, device=device, precise=True))
        facing = -nodes[:, 2] / np.linalg.norm(nodes, axis=1) > 0.5
        errors.append(np.sqrt(np.mean((np.linalg.norm(nodes[facing], axis=1) - RADIUS) ** 2)))
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (order > 1.9).all() and errors[-1] < 6e-5, (errors, order)


def test_axes_point_to_the_scanner(device):
    surface = clsurf.build_patches(RangeScan([sphere_image(64, looking_at_zero(1.0))]), device=device)
    middle = surface.boxes().mean(axis=1)
    assert (np.einsum("pi,pi->p", surface.axis_z, middle) > 0).all(), "outwards"


def test_nothing_across_a_step(device):
    """Two walls 0.2 apart: every cell lies on one of them, and both show up to a sample or so beside the step."""
    width = 64
    depth = np.full((width, width), 2.0)
    depth[:, 30:] = 2.2
    surface = clsurf.build_patches(RangeScan([RangeImage(depth=depth, intrinsics=intrinsics(width))]), device=device,
                                   precise=True)
    nodes = surface.positions()
    heights = nodes[np.isfinite(nodes[:, 0]), 2]
    assert (np.minimum(np.abs(heights - 2), np.abs(heights - 2.2)) < 1e-6).all()
    corners = nodes[opaque_cells(surface)]
    assert (np.ptp(corners[..., 2], axis=1) < 1e-6).all()
    front, back = corners[corners[:, 0, 2] < 2.1], corners[corners[:, 0, 2] > 2.1]
    column = lambda c: c[..., 0] / c[..., 2] * 1.2 * width + (width - 1) / 2  # noqa: E731
    assert 27.5 < column(front).max() < 29.01 and 29.99 < column(back).min() < 31.5


def test_holes_stay_holes(device):
    """No cell reaches into a hole, and none goes beyond the samples."""
    width = 64
    depth = plane_depth(width)
    depth[20:31, 25:40] = np.nan
    depth[50, 10] = 0
    surface = clsurf.build_patches(RangeScan([RangeImage(depth=depth, intrinsics=intrinsics(width))]), device=device)
    cells = surface.positions()[opaque_cells(surface)]
    s = np.linspace(0, 1, 5)
    inside = np.einsum("sa,tb,cabi->csti", np.stack([1 - s, s], 1), np.stack([1 - s, s], 1), cells.reshape(-1, 2, 2, 3))
    pixels = inside.reshape(-1, 3) @ intrinsics(width).T
    u, v = (pixels[:, :2] / pixels[:, 2:]).T
    slack = 0.3  # a node's cell may cut the corner of a hole between its nodes
    assert not ((u > 24 + slack) & (u < 40 - slack) & (v > 19 + slack) & (v < 31 - slack)).any()
    assert not (np.hypot(u - 10, v - 50) < 0.5).any()


def test_pose_moves_the_surface(device):
    pose = looking_at_zero(0.8)
    pose[:3, 3] += (7_691_239.5, -300, 20)
    here = clsurf.build_patches(RangeScan([sphere_image(48)]), device=device, precise=True)
    there = clsurf.build_patches(RangeScan([sphere_image(48, pose)]), device=device, precise=True)
    assert len(here) == len(there)
    middle = lambda surface: surface.boxes().mean(axis=1)  # noqa: E731
    back = (middle(there) - pose[:3, 3]) @ pose[:3, :3]
    assert np.abs(back - middle(here)).max() < 0.01  # a node on the very rim of a cell may be there or not
    assert np.abs(np.linalg.norm((nodes_of(there) - pose[:3, 3]) @ pose[:3, :3] - (0, 0, DISTANCE), axis=1)
                  - RADIUS).max() < 0.02


def test_scaled_pose(device):
    """Millimetres in the sensor, metres in the world."""
    pose = looking_at_zero(0.3) @ np.diag([0.001, 0.001, 0.001, 1])
    image = sphere_image(48)
    image = RangeImage(depth=image.depth * 1000, intrinsics=image.intrinsics, pose=pose)
    nodes = nodes_of(clsurf.build_patches(RangeScan([image]), device=device))
    assert np.abs(np.linalg.norm(nodes, axis=1) - RADIUS).max() < 0.02


def test_two_views_make_one_surface(device):
    """What both see is there once; a picture of it is the sphere, without speckle."""
    views = [sphere_image(80, looking_at_zero(angle)) for angle in (0.0, 0.5)]
    alone = [len(clsurf.build_patches(RangeScan([view]), device=device)) for view in views]
    surface = clsurf.build_patches(RangeScan(views), device=device)
    assert len(surface) < 0.8 * sum(alone)
    error = np.linalg.norm(nodes_of(surface), axis=1) - RADIUS
    assert np.sqrt(np.mean(error ** 2)) < 1e-3 and np.abs(error).max() < 0.01  # at grazing views cells are wide
    points = RangeScan(views).to_points()
    found = coverage(surface, points.points + points.origin, spacing=0.04)
    assert found.points_covered > 0.98 and found.nodes_supported == 1  # the last samples before the limb are torn off
    camera = clsurf.Camera.look_at((-0.95, 0, -3.8), (0, 0, 0), (0, 1, 0), fov=20)  # the middle of both sees only it
    frame = clsurf.render(surface, camera, size=(120, 120), channels=("depth", "normal"), device=device)
    origins, directions = camera.rays((120, 120))
    place = origins + directions * (frame.depth.reshape(-1, 1) / -(directions @ camera.rotation[2]).reshape(-1, 1))
    assert np.isfinite(frame.depth).all() and np.abs(np.linalg.norm(place, axis=1) - RADIUS).max() < 2e-3
    across = np.einsum("ni,ni->n", frame.normal.reshape(-1, 3), place / np.linalg.norm(place, axis=1, keepdims=True))
    assert across.min() > np.cos(np.radians(6))


def test_disagreeing_scans_blend(device):
    """Two views of a wall a third of a node spacing apart: nodes lie between, and patches of both agree."""
    width = 64
    near, far = (RangeImage(depth=np.full((width, width), z), intrinsics=intrinsics(width)) for z in (2.0, 2.01))
    surface = clsurf.build_patches(RangeScan([near, far]), device=device, precise=True)
    nodes = nodes_of(surface)
    assert nodes[:, 2].min() > 1.9999 and nodes[:, 2].max() < 2.0101
    middle = np.abs(nodes[:, :2]).max(axis=1) < 0.5
    assert np.ptp(nodes[middle, 2]) < 2e-3
    alone = len(clsurf.build_patches(RangeScan([near]), device=device))
    assert len(surface) <= 1.2 * alone


def test_colors(device):
    """A gradient comes through the resampling; a colour image of other size is looked up at the same place."""
    width = 64
    red, green = np.meshgrid(np.arange(2 * width), np.arange(2 * width))
    color = np.stack([red, green, np.zeros_like(red), np.full_like(red, 255)], axis=-1).astype(np.uint8)
    image = RangeImage(depth=plane_depth(width), intrinsics=intrinsics(width), color=color)
    surface = clsurf.build_patches(RangeScan([image]), device=device)
    nodes, opaque = surface.positions(), surface.opaque
    pixels = nodes[opaque] @ intrinsics(width).T
    expected = 2 * pixels[:, :2] / pixels[:, 2:] + 0.5
    rim = (np.abs(expected - width) < width - 3).all(axis=1)
    assert np.abs(surface.colors[opaque][rim, :2] - expected[rim]).max() < 1.2
    black = RangeImage(depth=image.depth, intrinsics=image.intrinsics, color=np.zeros_like(color))
    assert set(map(tuple, clsurf.build_patches(RangeScan([black]), device=device).colors)) == {(0, 0, 0), (1, 1, 1)}


def test_quantised_depth_is_smoothed(device):
    """A wall seen by a sensor of coarse steps: nodes nearer to it than the samples, a step of the wall kept."""
    width = 96
    depth = plane_depth(width)
    depth[:, 60:] += 0.4
    steps = np.rint(1 / depth / 0.004) * 0.004
    image = RangeImage(depth=1 / steps, intrinsics=intrinsics(width))
    nodes = nodes_of(clsurf.build_patches(RangeScan([image]), device=device))
    pixels = nodes @ intrinsics(width).T
    left = pixels[:, 0] / pixels[:, 2] < 57
    wall = np.array((0.3, 0.2, -1.0)) / np.linalg.norm((0.3, 0.2, -1.0))
    got = np.sqrt(np.mean((nodes[left] @ wall + 2 / np.linalg.norm((0.3, 0.2, -1.0))) ** 2))
    points = image.sensor_points()[:, :57].reshape(-1, 3)
    raw = np.sqrt(np.mean((points @ wall + 2 / np.linalg.norm((0.3, 0.2, -1.0))) ** 2))
    assert got < 0.4 * raw


@pytest.mark.parametrize(("asked", "check"), [
    ({"patches": 20}, lambda s: abs(len(s) - 20) <= 6),
    ({"spacing": 0.1}, lambda s: 0.085 < np.median(np.linalg.norm(s.axis_x, axis=1)) < 0.115),
    ({"spacing": 0.02}, lambda s: 0.018 < np.median(np.linalg.norm(s.axis_x, axis=1)) < 0.022),
    ({"error": 0.002}, lambda s: s.bound / s.diagonal < 0.01),
    ({"nodes": (9, 17)}, lambda s: (s.size == (9, 17)).all()),
    ({"nodes": 4}, lambda s: s.opaque.mean() > 0.5)],
    ids=["patches", "spacing", "finer", "error", "size", "small"])
def test_requests(device, asked, check):
    scan = RangeScan([sphere_image(96, looking_at_zero(0.0))])
    surface = clsurf.build_patches(scan, device=device, **asked)
    assert check(surface), surface
    assert np.abs(np.linalg.norm(nodes_of(surface), axis=1) - RADIUS).max() < 0.02


def test_progress_and_cancel(device):
    scan, seen = RangeScan([sphere_image(32), sphere_image(32)]), []
    clsurf.build_patches(scan, device=device, progress=lambda stage, done: seen.append((stage, done)))
    shares = [done for _, done in seen]
    assert shares == sorted(shares) and shares[-1] == 1 and {stage for stage, _ in seen} >= {"samples", "nodes"}
    with pytest.raises(Cancelled):
        clsurf.build_patches(scan, device=device, progress=lambda stage, done: stage != "nodes")


@pytest.mark.parametrize(("depth", "asked", "message"), [
    (np.full((8, 8), np.nan), {}, "only empty"),
    (np.where(np.add.outer(np.arange(8), np.arange(8)) % 2, 2.0, np.nan), {}, "only scattered"),
    (np.full((8, 8), 2.0), {"nodes": 3}, "at least 4"),
    (np.full((1, 8), 2.0), {}, "only scattered")], ids=["empty", "scattered", "nodes", "row"])
def test_what_cannot_be_converted(device, depth, asked, message):
    scan = RangeScan([RangeImage(depth=depth, intrinsics=intrinsics(8))])
    with pytest.raises(InputError, match=message):
        clsurf.build_patches(scan, device=device, **asked)


def test_method_needs_range_images(device):
    with pytest.raises(InputError, match="expected range images"):
        clsurf.build_patches(clsurf.models.sphere(10), method="ranges", device=device)


def test_same_bytes_again(device):
    scan = RangeScan([sphere_image(48, looking_at_zero(angle)) for angle in (0.0, 0.4)])
    one, two = (clsurf.build_patches(scan, device=device) for _ in range(2))
    assert (one.displacements == two.displacements).all() and (one.origins == two.origins).all()


def test_bunny_scans(device):
    """Ten raw scans: the floor of both shares is 99.5 %, nodes at most 1.5 point spacings apart (99.997 and 99.99)."""
    scan = clsurf.load(scan_path("range_scans/bunny/bun.conf"))
    surface = clsurf.build_patches(scan, device=device)
    points = scan.to_points()
    found = coverage(surface, points.points + points.origin, spacing=0.000514)  # of a single scan, median
    assert found.points_covered > 0.999 and found.nodes_supported > 0.999, str(found)
    assert found.node_spacing < 1.5 * found.point_spacing and surface.colors is None
