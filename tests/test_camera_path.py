"""Cameras that move, turntables, and cameras of files: conventions, round trips, malformed files."""

import json
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import clsurf
from clsurf import Camera, CameraPath
from clsurf.errors import FileFormatError, InputError
from clsurf.io import cameras as files

POINT = np.array([0.3, -0.2, 0.1])


def pixel(camera, size, point=POINT):
    """Where a world point falls in the picture, x, y."""
    p = camera.projection(size)
    x, y, z = (np.asarray(point) - camera.eye) @ camera.rotation.T
    return np.array([p.cx + p.fx * x / -z, p.cy - p.fy * y / -z] if p.perspective
                    else [p.cx + p.fx * x, p.cy - p.fy * y])


def around(count, radius=5.0):
    angle = 2 * np.pi * np.arange(count) / count
    return [Camera.look_at((radius * np.sin(a), 1.0, radius * np.cos(a)), (0, 0, 0)) for a in angle]


# Paths ----------------------------------------------------------------------------------------------------------------


def test_a_path_passes_through_its_keys():
    keys = [Camera.look_at((5, 1, 0), (0, 0, 0), fov=30), Camera.look_at((1, 4, 3), (0, 1, 0), fov=50),
            Camera.look_at((-3, 0, 3), (0, 0, 1), fov=20)]
    path = CameraPath(keys, [0, 1, 3.5])
    assert path.at(1.0) is keys[1] and path.at(-1).eye.tolist() == keys[0].eye.tolist()
    for time, key in zip((0, 1, 3.5), keys, strict=True):
        for near in (path.at(time - 1e-7), path.at(time + 1e-7)):
            np.testing.assert_allclose(near.eye, key.eye, atol=1e-5)
            np.testing.assert_allclose(near.rotation, key.rotation, atol=1e-5)
            assert near.fov == pytest.approx(key.fov, abs=1e-4)
    assert [c.eye.tolist() for c in path.frames(2)] == [keys[0].eye.tolist(), keys[2].eye.tolist()]
    assert all(20 <= c.fov <= 50 for c in path.frames(60))


@pytest.mark.parametrize("closed", [False, True])
def test_a_path_is_smooth(closed):
    """Speeds of eye and rotation do not jump: halving the step halves the change from step to step."""
    path = CameraPath(around(5)[:5 if closed else 4], closed=closed)

    def roughest(count):
        cameras = path.frames(count)
        if closed:
            cameras = cameras + cameras[:2]
        eyes = np.array([c.eye for c in cameras])
        turns = np.array([c.rotation for c in cameras]).reshape(len(cameras), 9)
        return [np.abs(np.diff(v, 2, axis=0)).max() * count for v in (eyes, turns)]
    for coarse, fine in zip(roughest(100), roughest(400), strict=True):
        assert fine < coarse / 3.5


def test_a_closed_path_of_a_circle_stays_near_it():
    cameras = CameraPath(around(8), closed=True).frames(64)
    eyes = np.array([c.eye for c in cameras])
    np.testing.assert_allclose(np.hypot(eyes[:, 0], eyes[:, 2]), 5, rtol=2e-3)
    assert all(np.linalg.norm(pixel(c, (100, 100), (0, 0, 0)) - 50) < 0.3 for c in cameras)
    steps = np.linalg.norm(np.diff(np.concatenate([eyes, eyes[:1]]), axis=0), axis=1)
    assert steps.max() < 1.02 * steps.min()  # around once, and the first is not repeated


@pytest.mark.parametrize("kind", ["orthographic", "intrinsics", "one", "far"])
def test_every_kind_of_camera_moves(kind):
    matrix = np.array([[500.0, 0, 310], [0, 510, 250], [0, 0, 1]])
    if kind == "orthographic":
        keys = [Camera.orthographic((0, 0, 5), (0, 0, 0), height=h) for h in (1, 4)]
        assert CameraPath(keys).at(0.5).height == pytest.approx(2)
    elif kind == "intrinsics":
        keys = [Camera.from_intrinsics(matrix, np.eye(4), (640, 480)),
                Camera.from_intrinsics(matrix * [[2], [2], [1]], np.eye(4), (1280, 960))]
        np.testing.assert_allclose(CameraPath(keys).at(0.5).intrinsics, matrix)
    elif kind == "one":
        assert len({id(c) for c in CameraPath(around(1)).frames(3)}) == 1
    else:
        keys = [Camera.look_at((7_691_239.553 + x, 5e6, 3), (7_691_239.553, 5e6, 0)) for x in (0, 1, 2)]
        np.testing.assert_allclose(CameraPath(keys).at(0.5).eye, (7_691_240.053, 5e6, 3), atol=1e-8)


@pytest.mark.parametrize(("arguments", "says"), [
    (([],), "at least one"), (([1],), "Camera"), ((around(2), [1, 1]), "times"), ((around(2), [1]), "times"),
    (([around(1)[0], Camera.orthographic((0, 0, 1), (0, 0, 0))],), "one kind")])
def test_bad_paths(arguments, says):
    with pytest.raises(InputError, match=says):
        CameraPath(*arguments)


# Turntables -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [(1, 0.5, 2), (0, 0, 1), (0, 1, 0), (0.2, -1, 0.3)])
@pytest.mark.parametrize("aspect", [0.5, 1.6])
@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, -2)])
def test_a_turntable_shows_the_whole_thing_from_everywhere(direction, aspect, up):
    """All corners are inside every picture, and the tightest touches the border."""
    box = np.array([[-1.0, -2, -0.5], [3, 1, 0.5]])
    size = (int(1000 * aspect), 1000)
    cameras = clsurf.turntable(box, 40, direction, 50, up, aspect, margin=1.0)
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    where = np.array([[pixel(c, size, corner) for corner in corners] for c in cameras])
    border = np.minimum(where, np.array(size) - where).min()
    assert -2 < border < 25  # 120 places around stand for the circle
    distances = [np.linalg.norm(np.cross(c.eye - box.mean(axis=0), up)) for c in cameras]
    np.testing.assert_allclose(distances, distances[0], rtol=1e-9)
    wanted = np.asarray(direction) / np.linalg.norm(direction)
    np.testing.assert_allclose(cameras[0].rotation[2], wanted, atol=1e-9)
    np.testing.assert_allclose(cameras[20].rotation[2], Rotation.from_rotvec(
        np.pi * np.asarray(up) / np.linalg.norm(up)).apply(wanted), atol=1e-9)


def test_turntables_of_scans_and_single_points():
    ball = clsurf.models.sphere(500)
    cameras = clsurf.turntable(ball, 4)
    assert all(np.linalg.norm(c.eye) == pytest.approx(np.linalg.norm(cameras[0].eye), rel=1e-3) for c in cameras)
    assert len(clsurf.turntable(clsurf.PointCloud(np.zeros((1, 3))), 3)) == 3
    for arguments, says in (((ball, 0), "frame"), ((np.full((2, 3), np.nan),), "empty"),
                            ((ball, 3, (0, 0, 0)), "camera")):
        with pytest.raises(InputError, match=says):
            clsurf.turntable(*arguments)


def test_frames_along_a_turn(device, tmp_path):
    """Frames are drawn as they are asked for, one by one, and go straight into a video."""
    ball = clsurf.build_slim(clsurf.models.sphere(500), device=device)
    frames = clsurf.render_frames(ball, clsurf.turntable(ball, 3), (40, 30), device=device, channels=("color",))
    assert next(frames).size == (40, 30)
    assert clsurf.write_video(tmp_path / "a.gif", frames) == 2


# Files ----------------------------------------------------------------------------------------------------------------

POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("xyz", (10, -20, 30), degrees=True).as_matrix()
POSE[:3, 3] = -POSE[:3, :3] @ (0.1, 0.2, 4.0) + (0.2, 0, 0)
MATRIX = np.array([[500.0, 0, 310.5], [0, 510, 250.25], [0, 0, 1]])


def pinhole_pixel(point=POINT):
    """By the book, in computer vision's axes: x = K (R^T (p - t)) / z."""
    x, y, z = MATRIX @ (POSE[:3, :3].T @ (point - POSE[:3, 3]))
    return np.array([x / z, y / z])


def write_colmap(folder, ending, model="PINHOLE", parameters=(500, 510, 310.5, 250.25), points=3):
    """A model of two images, as COLMAP writes it: the second is image b.png."""
    turn, place = POSE[:3, :3].T, -POSE[:3, :3].T @ POSE[:3, 3]  # world to camera
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    images = [(7, (w, x, y, z), place, "z last.png"), (2, (1, 0, 0, 0), (0, 0, 5), "b.png")]
    number = next(n for n, (name, _, _) in files.MODELS.items() if name == model)
    folder.mkdir(exist_ok=True)
    if ending == ".txt":
        (folder / "cameras.txt").write_text("# Camera list\n# ...\n"
                                            f"4 {model} 640 480 {' '.join(repr(float(v)) for v in parameters)}\n")
        rows = [f"{i} {' '.join(repr(float(v)) for v in (*q, *t))} 4 {name}\n" + "1.0 2.0 -1 " * points
                for i, q, t, name in images]
        (folder / "images.txt").write_text("# Image list\n" + "\n".join(rows) + "\n")
        return
    data = struct.pack("<QiiQQ", 1, 4, number, 640, 480) + struct.pack(f"<{len(parameters)}d", *parameters)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for i, q, t, name in images:
        data += struct.pack("<i7di", i, *q, *t, 4) + name.encode() + b"\0" + struct.pack("<Q", points)
        data += struct.pack("<ddq", 1, 2, -1) * points
    (folder / "images.bin").write_bytes(data)


@pytest.mark.parametrize("ending", [".txt", ".bin"])
@pytest.mark.parametrize("points", [0, 3])
@pytest.mark.parametrize("named", ["", "images", "cameras", "sparse"])
def test_colmap_sees_a_point_at_its_pixel(tmp_path, ending, points, named):
    folder = tmp_path / "sparse"
    write_colmap(folder, ending, points=points)
    path = folder / f"{named}{ending}" if named in ("images", "cameras") else tmp_path if named else folder
    cameras = clsurf.load_cameras(path)
    assert list(cameras) == ["b.png", "z last.png"]
    np.testing.assert_allclose(pixel(cameras["z last.png"], (640, 480)), pinhole_pixel(), atol=1e-9)
    np.testing.assert_allclose(pixel(cameras["z last.png"], (320, 240)), pinhole_pixel() / 2, atol=1e-9)
    # World to camera is (0, 0, 5): the eye is at z = -5, looks along +z, and y points down.
    np.testing.assert_allclose(cameras["b.png"].eye, (0, 0, -5))
    np.testing.assert_allclose(cameras["b.png"].rotation, np.diag([1, -1, -1]))


@pytest.mark.parametrize(("model", "parameters", "focal"), [
    ("SIMPLE_PINHOLE", (500, 310, 250), 500), ("SIMPLE_RADIAL", (500, 310, 250, 0), 500),
    ("RADIAL", (500, 310, 250, 0, 0), 500), ("OPENCV", (500, 510, 310, 250, 0, 0, 0, 0), 510),
    ("FULL_OPENCV", (500, 510, 310, 250, *[0] * 8), 510)])
@pytest.mark.parametrize("ending", [".txt", ".bin"])
def test_colmap_models(tmp_path, model, parameters, focal, ending):
    write_colmap(tmp_path, ending, model, parameters)
    np.testing.assert_array_equal(clsurf.load_cameras(tmp_path)["b.png"].intrinsics,
                                  [[500, 0, 310], [0, focal, 250], [0, 0, 1]])


def test_distortion_is_refused_or_ignored_with_a_word(tmp_path, caplog):
    write_colmap(tmp_path, ".txt", "SIMPLE_RADIAL", (500, 320, 240, 0.1))
    with pytest.raises(InputError, match=r"camera 4: .*25\.6 pixels .*--ignore-distortion"):  # 400 px off, r^2 = 0.64
        clsurf.load_cameras(tmp_path)
    assert clsurf.load_cameras(tmp_path, "ignore")["b.png"].intrinsics[0, 0] == 500
    assert "25.6 pixels" in caplog.text
    with pytest.raises(InputError, match="distortion: expected"):
        clsurf.load_cameras(tmp_path, "maybe")
    write_colmap(tmp_path, ".txt", "OPENCV_FISHEYE", (500, 500, 320, 240, 0, 0, 0, 0))
    with pytest.raises(InputError, match="OPENCV_FISHEYE is no pinhole"):
        clsurf.load_cameras(tmp_path, "ignore")


@pytest.mark.parametrize("ending", [".txt", ".bin"])
def test_damaged_colmap_files_are_one_line(tmp_path, ending):
    """Cut anywhere, or with bytes changed: an error of ours on one line, or cameras."""
    write_colmap(tmp_path, ending)
    for name in (f"cameras{ending}", f"images{ending}"):
        whole, rng = (tmp_path / name).read_bytes(), np.random.default_rng(3)
        broken = [whole[:n] for n in range(0, len(whole), 7)]
        for _ in range(40):
            data = bytearray(whole)
            data[rng.integers(len(data))] = rng.integers(256)
            broken.append(bytes(data))
        broken.append(whole.replace(b"b.png\0", b"\n.png\0\xff\xff\xff\xff"))  # two lines, too many points
        failed = 0
        for data in broken:
            (tmp_path / name).write_bytes(data)
            try:
                assert clsurf.load_cameras(tmp_path)
            except InputError as error:
                failed += 1
                assert "\n" not in str(error) and str(tmp_path) in str(error)
        assert failed > len(broken) / 4
        (tmp_path / name).write_bytes(whole)


def test_json_sees_a_point_at_its_pixel(tmp_path):
    tree = {"cameras": [{"name": "a", "pose": POSE.tolist(), "size": [640, 480], "intrinsics": MATRIX.tolist()}]}
    (tmp_path / "a.json").write_text(json.dumps(tree))
    np.testing.assert_allclose(pixel(clsurf.load_cameras(tmp_path / "a.json")["a"], (640, 480)), pinhole_pixel(),
                               atol=1e-9)


def test_json_round_trip(tmp_path):
    cameras = {"fov": Camera.look_at((4, 3, 9), (0, 0, 0), fov=35, near=0.25),
               "flat": Camera.orthographic((7_691_239.553, 3, 9), (0, 0, 0), height=3),
               "k": Camera.from_intrinsics(MATRIX, POSE, (640, 480))}
    clsurf.save_cameras(cameras, tmp_path / "a.json")
    again = clsurf.load_cameras(tmp_path / "a.json")
    assert list(again) == list(cameras)
    for name, camera in cameras.items():
        other = again[name]
        assert (other.eye == camera.eye).all() and other.near == camera.near
        np.testing.assert_allclose(other.rotation, camera.rotation, atol=1e-15)
        assert (other.fov, other.height, other.intrinsics_size) == (camera.fov, camera.height, camera.intrinsics_size)
        np.testing.assert_allclose(pixel(other, (64, 48)), pixel(camera, (64, 48)), atol=1e-6)
    path = CameraPath(around(4), [0, 1, 2.5, 3], closed=True)
    clsurf.save_cameras(path, tmp_path / "b.json")
    other = clsurf.CameraPath.load(tmp_path / "b.json")
    assert other.closed and other.times.tolist() == path.times.tolist()
    np.testing.assert_allclose(other.at(1.7).rotation, path.at(1.7).rotation, atol=1e-12)


def entry(**changes):
    return {"pose": np.eye(4).tolist(), "fov": 40} | changes


@pytest.mark.parametrize(("tree", "says"), [
    ("{", "not JSON"), ("[]", "at least one"), ('{"cameras": 3}', "at least one"), ('{"cameras": [3]}', "at least one"),
    ([entry(pose=None)], "pose"), ([entry(pose=[[1]])], "pose: expected 4 x 4"), ([{"fov": 40}], "pose.*none"),
    ([entry(pose=(2 * np.eye(4)).tolist())], "pose.*rotation"),
    ([entry(pose=np.diag([1, 1, -1, 1]).tolist())], "mirror"), ([entry(fov=None)], "one of"),
    ([entry(height=2)], "one of.*fov, height"), ([entry(fov="x")], "fov: expected a single"),
    ([entry(fov=190)], "camera 0.*fov"), ([entry(fov=None, intrinsics=np.eye(3).tolist())], "size"),
    ([entry(fov=None, intrinsics=np.zeros((3, 3)).tolist(), size=[4, 4])], "intrinsics"),
    ([entry(size=[4.5, 4])], "size"), ([entry(name=3)], "name"), ([entry(name="a"), entry(name="a")], "twice"),
    ([entry(time=1), entry()], "time"), ([entry(time=1), entry(time=1)], "time"),
    ({"cameras": [entry()], "closed": 1}, "closed")])
def test_malformed_json_is_one_line(tmp_path, tree, says):
    path = tmp_path / "a.json"
    path.write_text(tree if isinstance(tree, str) else json.dumps(tree))
    with pytest.raises(InputError, match=says) as caught:
        clsurf.CameraPath.load(path)
    assert "\n" not in str(caught.value) and "a.json" in str(caught.value)


@pytest.mark.parametrize("name", ["none.json", "a.xml", "folder", "images.txt"])
def test_no_such_cameras(tmp_path, name):
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=name.split(".")[0]):
        clsurf.load_cameras(tmp_path / name)


def test_wrong_things_are_not_saved(tmp_path):
    for cameras, path, names, says in ((around(1), "a.txt", None, "json"), (around(2), "a.json", ["a"], "name"),
                                       ([3], "a.json", None, "Camera")):
        with pytest.raises(InputError, match=says):
            clsurf.save_cameras(cameras, tmp_path / path, names)
    assert not list(tmp_path.iterdir())
    assert issubclass(FileFormatError, InputError)
