"""Range images in files and as data: hand-written tiny files, poses, colours, damage, the store."""

import json
import pickle

import numpy as np
import pytest

import clsurf
from clsurf.errors import FileFormatError, InputError
from clsurf.io import ranges
from clsurf.io.images import write_frame, write_image
from clsurf.surface.ranges import RangeImage, RangeScan
from tests.conftest import scan_path

GRID = """ply
format ascii 1.0
obj_info num_cols 3
obj_info num_rows 2
element vertex 5
property float x
property float y
property float z
element range_grid 6
property list uchar int vertex_indices
end_header
0 0 1
1 0 1.5
2 0 1
0 1 1
2 1 1
1 0
1 1
1 2
1 3
0
1 4
"""
K = np.array([[50.0, 0, 2.0], [0, 60.0, 1.0], [0, 0, 1]])


@pytest.fixture
def conf(tmp_path):
    (tmp_path / "a.ply").write_text(GRID)
    (tmp_path / "b.ply").write_text(GRID.replace("1.5", "1.25"))
    half = np.sqrt(0.5)
    (tmp_path / "ab.conf").write_text(f"camera 0 0 0 0 0 0 1\nbmesh a.ply 0 0 0 0 0 0 1\n"
                                      f"bmesh b.ply 1 2 3 0 0 {half} {half}\n\nbmesh gone.ply 0 0 0 0 0 0 1\n")
    return tmp_path / "ab.conf"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "depth").mkdir()
    (tmp_path / "color").mkdir()
    for k in range(2):
        depth = np.full((3, 5), 1500 + k, np.uint16)
        depth[0, 0] = 0
        write_image(tmp_path / f"depth/{k}.png", depth)
        write_image(tmp_path / f"color/{k}.png", np.full((6, 10, 3), 40 * k + 10, np.uint8))
    (tmp_path / "camera.json").write_text(json.dumps({"width": 5, "intrinsic_matrix": K.T.ravel().tolist()}))
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, :3, 3] = 1, 2, 3
    (tmp_path / "trajectory.log").write_text("".join(
        f"{k} {k} {k + 1}\n" + "\n".join(" ".join(map(str, row)) for row in pose) + "\n"
        for k, pose in enumerate(poses)))
    return tmp_path


def test_conf(conf, caplog):
    """Poses with the conjugated quaternion: this one turns by -90 degrees about z; the missing file is named."""
    scan = clsurf.load(conf)
    assert len(scan) == 2 and scan.images[1].name == "b.ply" and scan.sample_count == 10
    np.testing.assert_allclose(scan.images[1].pose @ (1, 0, 0, 1), (1, 1, 3, 1), atol=1e-12)
    assert "1 of 3" in caplog.text and "gone.ply" in caplog.text
    grid = scan.images[0].points
    assert grid.shape == (2, 3, 3) and np.isnan(grid[1, 1]).all() and (grid[1, 2] == (2, 1, 1)).all()
    np.testing.assert_allclose(scan.bounds, [[0, 0, 1], [2, 2, 4.25]])
    assert isinstance(clsurf.load(conf.parent / "a.ply"), clsurf.PointCloud), "a lone range grid is a cloud"


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_grid(tmp_path, order):
    name = "little" if order == "<" else "big"
    head, body = GRID.replace("ascii", f"binary_{name}_endian").split("end_header\n")
    rows = body.split("\n")
    data = np.array([row.split() for row in rows[:5]], order + "f4").tobytes()
    for row in rows[5:11]:
        data += bytes([int(row.split()[0])]) + np.array(row.split()[1:], order + "i4").tobytes()
    (tmp_path / "b.ply").write_bytes((head + "end_header\n").encode() + data)
    (tmp_path / "a.ply").write_text(GRID)
    np.testing.assert_array_equal(ranges.read_range_grid(tmp_path / "b.ply"),
                                  ranges.read_range_grid(tmp_path / "a.ply"))


@pytest.mark.parametrize(("old", "new", "message"), [
    ("num_cols 3", "num_cols 4", "4 x 2 samples"), ("1 4\n", "1 9\n", "outside the 5"), ("1 4\n", "1 -2\n", "outside"),
    ("1 3\n0\n1 4\n", "", "truncated"), ("1 4\n", "1\n", "truncated"), ("1 4\n", "-1 4\n", "damaged"),
    ("1 0 1.5", "1 zero 1.5", "other text"), ("range_grid", "face", "expected a range image"),
    ("obj_info num_rows 2\n", "", "expected a range image"), ("property float z", "property float w", "x, y, z"),
    ("element vertex 5", "element vertex 4000", "do not fit")])
def test_damaged_grids(tmp_path, old, new, message):
    path = tmp_path / "a.ply"
    path.write_text(GRID.replace(old, new))
    with pytest.raises(FileFormatError, match=message) as caught:
        ranges.read_range_grid(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize(("text", "message"), [
    ("nothing here\n", "expected lines"), ("bmesh a.ply 0 0 0 0 0 0\n", "line 1"),
    ("bmesh a.ply 0 0 0 0 0 0 0\n", "line 1"),
    ("camera 1\nbmesh a.ply 0 0 x 0 0 0 1\n", "line 2"), ("bmesh gone.ply 0 0 0 0 0 0 1\n", "none of its 1")])
def test_damaged_conf(tmp_path, text, message):
    (tmp_path / "a.conf").write_text(text)
    with pytest.raises(InputError, match=message):
        clsurf.load(tmp_path / "a.conf")


def test_folder_of_frames(folder):
    scan = clsurf.load(folder)
    assert len(scan) == 2 and scan.sample_count == 28
    first, second = scan.images
    assert first.depth[1, 2] == np.float32(1.5) and np.isnan(first.depth[0, 0]) and (first.intrinsics == K).all()
    np.testing.assert_allclose(second.sensor_points()[2, 4], 1.501 * np.array([2 / 50, 1 / 60, 1]), rtol=1e-6)
    assert (second.pose[:3, 3] == (1, 2, 3)).all() and (second.sample_colors()[0, 0] == (50, 50, 50, 255)).all()
    again = clsurf.load(folder / "camera.json")
    assert (again.images[1].depth[1] == second.depth[1]).all()
    cloud = scan.to_points()
    assert len(cloud.points) == 28 and cloud.colors.shape == (28, 4)
    np.testing.assert_allclose(cloud.scanners[-1] + cloud.origin, (1, 2, 3), atol=1e-6)


def test_frames_one_by_one(folder, tmp_path):
    """Arrays, EXR in world units, a scale of its own, no pose for a single frame."""
    depth = np.full((3, 5), 2.5, np.float32)
    depth[1, 1] = np.inf
    write_frame(tmp_path / "d.exr", {"depth": depth})
    scan = clsurf.load_frames(depth=[tmp_path / "d.exr"], intrinsics=K)
    assert np.nanmax(scan.images[0].depth) == 2.5 and scan.sample_count == 14
    assert (scan.images[0].pose == np.eye(4)).all()
    steps = clsurf.load_frames(depth=np.full((3, 5), 5000, np.uint16), intrinsics=K, depth_scale=5000)
    assert (steps.images[0].depth == 1).all()
    other = clsurf.load_frames(folder, depth=[depth, depth], color=[])
    assert len(other) == 2 and other.images[0].color is None


@pytest.mark.parametrize(("change", "message"), [
    (lambda f: (f / "camera.json").unlink(), "json file of intrinsics"),
    (lambda f: (f / "camera.json").write_text("{}"), "intrinsic_matrix"),
    (lambda f: (f / "camera.json").write_text('{"intrinsic_matrix": [0, 0, 0, 0, 0, 0, 0, 0, 0]}'), "positive fx"),
    (lambda f: (f / "trajectory.log").unlink(), "poses"),
    (lambda f: (f / "trajectory.log").write_text("0 0 1 2"), "truncated"),
    (lambda f: (f / "trajectory.log").write_text("zero " * 38), "other text"),
    (lambda f: (f / "trajectory.log").write_text("1 " * 38), "rotation"),
    (lambda f: (f / "color/1.png").unlink(), "as many images"),
    (lambda f: (f / "depth/1.png").write_bytes(b"\x89PNG\r\n\x1a\n"), "1.png"),
    (lambda f: write_image(f / "depth/1.png", np.zeros((3, 5, 3), np.uint8)), "one channel"),
    (lambda f: [p.unlink() for p in (f / "depth").iterdir()], "depth/")])
def test_damaged_frames(folder, change, message):
    change(folder)
    with pytest.raises(InputError, match=message) as caught:
        clsurf.load(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("fields", "message"), [
    ({}, "depth or points"), ({"depth": np.ones((2, 2))}, "intrinsics"),
    ({"depth": np.ones((2, 2)), "points": np.ones((2, 2, 3))}, "depth or points"),
    ({"points": np.ones((2, 2))}, "points"), ({"depth": np.ones((2, 2)), "intrinsics": -K}, "intrinsics"),
    ({"points": np.ones((2, 2, 3)), "pose": np.diag([1, 1, 2, 1])}, "pose"),
    ({"points": np.ones((2, 2, 3)), "pose": np.full((4, 4), np.nan)}, "pose"),
    ({"points": np.ones((2, 2, 3)), "pose": np.diag([1, 1, -1, 1])}, "pose"),
    ({"points": np.ones((2, 2, 3)), "color": np.zeros((2, 2, 3), np.uint8)}, "color")])
def test_images_that_make_no_sense(fields, message):
    with pytest.raises(ValueError, match=message):
        RangeImage(**fields)


def test_scans_need_images():
    for images in ([], [1]):
        with pytest.raises(ValueError, match="RangeImage"):
            RangeScan(images)
    empty = RangeScan([RangeImage(points=np.full((2, 2, 3), np.nan))])
    assert np.isnan(empty.bounds).all() and len(empty.to_points().points) == 0 and "0 samples" in repr(empty)


def test_store_and_pickle(conf, folder, tmp_path):
    for scan in (clsurf.load(conf), clsurf.load(folder)):
        clsurf.save(scan, tmp_path / "s.clsurf")
        for again in (clsurf.load(tmp_path / "s.clsurf"), pickle.loads(pickle.dumps(scan))):
            assert repr(again) == repr(scan) and "\n" not in repr(scan) and again.nbytes == scan.nbytes
            for a, b in zip(scan.images, again.images, strict=True):
                assert a.name == b.name and repr(a) == repr(b)
                for name in ("depth", "points", "color", "pose", "intrinsics"):
                    np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        with pytest.raises(InputError, match=r"\.clsurf"):
            clsurf.save(scan, tmp_path / "s.ply")


def test_color_of_another_size():
    """A ramp looked up at half and double the size stays the ramp."""
    for width, height in ((8, 6), (2, 2), (4, 3), (3, 5)):
        ramp = np.add.outer(5 * (np.arange(height) + 0.5) / height, 100 * (np.arange(width) + 0.5) / width)
        color = np.repeat(np.rint(20 + ramp)[..., None], 4, axis=2).astype(np.uint8)
        image = RangeImage(points=np.zeros((3, 4, 3)), color=color)
        expected = 20 + np.add.outer(5 * (np.arange(3) + 0.5) / 3, 100 * (np.arange(4) + 0.5) / 4)
        rim = 100 / min(width, 4) / 2 if width < 4 else 100 / width
        assert np.abs(image.sample_colors()[..., 0] - expected).max() < 3 + rim


def test_builders_take_range_images(device):
    """Normals face the sensor, from points or depth: a sphere seen from +z has them outwards."""
    y, x = np.mgrid[-0.6:0.6:40j, -0.6:0.6:40j]
    points = np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=-1)
    scan = RangeScan([RangeImage(points=points)])
    cloud = clsurf.estimate_normals(scan, device=device)
    place = cloud.points + cloud.origin
    assert (np.einsum("ij,ij->i", cloud.normals, place) > 0.97).all()
    slim = clsurf.build_slim(scan, device=device)
    assert (np.einsum("ij,ij->i", slim.normals, slim.centers + slim.origin) > 0.9).all()


def test_stanford_scans():
    """Ten scans at one place: the mean distance from one to the next is a third of a millimetre, not four."""
    from scipy.spatial import cKDTree
    scan = clsurf.load(scan_path("range_scans/bunny/bun.conf"))
    assert len(scan) == 10 and scan.sample_count == 362_272
    a, b = (RangeScan([scan.images[k]]).to_points() for k in (0, 1))
    distance = cKDTree(a.points + a.origin).query((b.points + b.origin)[::10])[0]
    assert np.median(distance) < 0.0005
