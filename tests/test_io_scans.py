"""Scans: round trips of every format, what is kept, cleaning, damaged files, and the real scans."""

import logging
import struct

import numpy as np
import pytest
from conftest import scan_path

from clsurf import models
from clsurf.errors import FileFormatError, InputError
from clsurf.io import load, save
from clsurf.io.scans import WRITES, load_scan
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh

SURVEY = np.array([637291.0, 7691239.553, 511.25])


def make_mesh(seed=0, origin=None, **more):
    """An icosahedron with noise: 12 vertices, 20 faces, all used."""
    import trimesh
    shape = trimesh.creation.icosahedron()
    rng = np.random.default_rng(seed)
    points = shape.vertices + rng.uniform(-0.05, 0.05, shape.vertices.shape)
    if origin is None:
        points = points.astype(np.float32)
    return Mesh(points, shape.faces, origin=origin, **more)


def make_cloud(count=200, seed=0, origin=None, normals=True, colors=True, **more):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)).astype(np.float32)
    n = rng.normal(size=(count, 3))
    n = (n / np.linalg.norm(n, axis=1, keepdims=True)).astype(np.float32)
    c = rng.integers(0, 256, (count, 4), dtype=np.uint8)
    c[:, 3] = 255
    return PointCloud(points, n if normals else None, c if colors else None, origin=origin, **more)


def world(scan):
    return scan.points.astype(np.float64) + scan.origin


HOLDS_NORMALS = {".ply", ".xyz", ".txt", ".asc", ".csv", ".npy", ".npz", ".las", ".laz"}
CLOUD_FORMATS = [e for e in WRITES if e not in (".stl",)]
MESH_FORMATS = [".ply", ".obj", ".stl", ".off", ".glb", ".npz"]


@pytest.mark.parametrize("ending", CLOUD_FORMATS)
@pytest.mark.parametrize("origin", [None, SURVEY])
def test_cloud_round_trip(tmp_path, ending, origin):
    cloud = make_cloud(origin=origin)
    save(cloud, tmp_path / f"a{ending}")
    again = load(tmp_path / f"a{ending}")
    assert isinstance(again, PointCloud)
    assert np.abs(world(again) - world(cloud)).max() < 1e-6  # the survey coordinate keeps its micrometres
    if ending in HOLDS_NORMALS:
        np.testing.assert_allclose(again.normals, cloud.normals, atol=1e-6)
    else:
        assert again.normals is None
    if ending not in (".obj",):
        np.testing.assert_array_equal(again.colors, cloud.colors)
    assert [p.name for p in tmp_path.iterdir()] == [f"a{ending}"]


@pytest.mark.parametrize("ending", [".ply", ".xyz", ".csv", ".pts", ".npz", ".las", ".laz"])
def test_attributes_are_carried(tmp_path, ending):
    intensity = np.arange(200, dtype=np.uint16) * 300
    attributes = {"intensity": intensity, "classification": (np.arange(200) % 7).astype(np.uint8)}
    save(make_cloud(attributes=attributes, normals=ending != ".pts"), tmp_path / f"a{ending}")
    again = load(tmp_path / f"a{ending}")
    np.testing.assert_array_equal(again.attributes["intensity"], intensity)
    if ending != ".pts":
        np.testing.assert_array_equal(again.attributes["classification"], attributes["classification"])


@pytest.mark.parametrize("ending", MESH_FORMATS)
@pytest.mark.parametrize("origin", [None, SURVEY])
def test_mesh_round_trip(tmp_path, ending, origin):
    mesh = make_mesh(origin=origin)
    save(mesh, tmp_path / f"a{ending}")
    again = load(tmp_path / f"a{ending}")
    tolerance = 0.6 if ending == ".stl" and origin is not None else 1e-6  # STL is float32
    assert isinstance(again, Mesh) and len(again.faces) == 20
    corners, wanted = world(again)[again.faces], world(mesh)[mesh.faces]
    assert np.abs(corners - wanted).max() < tolerance
    if ending != ".stl":
        np.testing.assert_array_equal(again.faces, mesh.faces)


@pytest.mark.parametrize("ending", [".ply", ".obj", ".off", ".glb", ".npz"])
def test_mesh_colours_and_normals(tmp_path, ending):
    rng = np.random.default_rng(1)
    mesh = make_mesh()
    normals = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    colors = rng.integers(0, 256, (12, 4), dtype=np.uint8)
    if ending == ".obj":
        colors[:, 3] = 255
    mesh = Mesh(mesh.vertices, mesh.faces, normals, colors)
    save(mesh, tmp_path / f"a{ending}")
    again = load(tmp_path / f"a{ending}")
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_array_equal(again.colors, colors)
    if ending != ".off":
        np.testing.assert_allclose(again.normals, normals, atol=1e-6)


@pytest.mark.parametrize("ending", [".obj", ".glb", ".npz"])
def test_seams_and_texture_are_kept(tmp_path, ending):
    """Two triangles share an edge whose vertices have different texture coordinates on either side."""
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], np.float32)
    uv = np.array([(0, 0), (0.5, 0), (0, 0.5), (0.7, 0), (1, 1), (0, 0.9)], np.float32)
    texture = np.random.default_rng(0).integers(0, 256, (8, 4, 4), dtype=np.uint8)
    texture[..., 3] = 255
    mesh = Mesh(vertices, [(0, 1, 2), (3, 4, 5)], uv=uv, texture=texture)
    save(mesh, tmp_path / f"a{ending}")
    again = load(tmp_path / f"a{ending}")
    np.testing.assert_allclose(again.uv[again.faces], uv[mesh.faces], atol=1e-6)
    np.testing.assert_allclose(again.vertices[again.faces] + again.origin, vertices[mesh.faces], atol=1e-6)
    np.testing.assert_array_equal(again.texture, texture)
    assert len(again.vertices) == 6


def test_obj_texture_files_are_named_after_it(tmp_path):
    mesh = make_mesh(uv=np.random.default_rng(0).random((12, 2)), texture=np.full((3, 3, 4), 255))
    save(mesh, tmp_path / "my head.obj")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["my head.mtl", "my head.obj", "my head.png"]
    assert load(tmp_path / "my head.obj").texture.shape == (3, 3, 4)


PLY_HEADER = """ply
format {form} 1.0
comment made by a test
element vertex 5
property {real} x
property {real} y
property {real} z
property uchar red
property uchar green
property uchar blue
property float confidence
element face 3
property uchar flags
property list uchar int vertex_indices
element edge 1
property int a
property int b
end_header
"""
PLY_POINTS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1.25)]
PLY_FACES = [(0, 1, 2, 3), (0, 1, 4), (1, 2, 4)]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("real", ["float", "double", "float64"])
def test_ply_of_all_forms(tmp_path, form, real):
    """Mixed quadrilaterals and triangles, a property before the list, an element after it."""
    data = PLY_HEADER.format(form=form, real=real).encode()
    order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    for k, point in enumerate(PLY_POINTS):
        row = (*point, 10 * k, 20, 30, 0.5)
        data += (" ".join(map(str, row)) + "\n").encode() if order is None else struct.pack(
            order + ("3f" if real == "float" else "3d") + "3Bf", *row)
    for face in PLY_FACES:
        row = (7, len(face), *face)
        data += (" ".join(map(str, row)) + "\n").encode() if order is None else struct.pack(
            f"{order}BB{len(face)}i", *row)
    data += b"0 1\n" if order is None else struct.pack(order + "2i", 0, 1)
    path = tmp_path / "a.ply"
    path.write_bytes(data)
    mesh = load(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4], [1, 2, 4]]
    np.testing.assert_allclose(world(mesh), PLY_POINTS, atol=1e-7)
    assert mesh.colors[:, 0].tolist() == [0, 10, 20, 30, 40] and (mesh.attributes["confidence"] == 0.5).all()
    for cut in range(30, len(data) - 9, 7):
        path.write_bytes(data[:cut])
        with pytest.raises(FileFormatError):
            load(path)


@pytest.mark.parametrize("form, order", [("ascii", None), ("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_ply_triangle_strips(tmp_path, form, order):
    strip = [0, 1, 2, 3, 3, 3, 4, -1, 4, 2, 1, -1, 0]
    header = (f"ply\nformat {form} 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
              "element tristrips 1\nproperty list int int vertex_indices\nend_header\n").encode()
    if order is None:
        body = "".join(f"{x} {y} {z}\n" for x, y, z in PLY_POINTS) + f"{len(strip)} " + " ".join(map(str, strip)) + "\n"
        body = body.encode()
    else:
        body = b"".join(struct.pack(order + "3f", *p) for p in PLY_POINTS)
        body += struct.pack(f"{order}{len(strip) + 1}i", len(strip), *strip)
    (tmp_path / "a.ply").write_bytes(header + body)
    # 0 1 2, then 1 3 2 turned over; the triangles with a repeated corner are none; a new strip after -1.
    assert load(tmp_path / "a.ply").faces.tolist() == [[0, 1, 2], [1, 3, 2], [4, 2, 1]]


def test_off_with_comments_polygons_and_face_colours(tmp_path):
    (tmp_path / "a.off").write_text("OFF # a comment\n# another\n5 2 0\n\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1 # top\n"
                                    "4 0 1 2 3 255 0 0\n3 0 1 4\n")
    assert load(tmp_path / "a.off").faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4]]


def test_range_grid_is_a_cloud(tmp_path):
    text = ("ply\nformat ascii 1.0\nobj_info num_cols 2\nelement vertex 3\nproperty float x\nproperty float y\n"
            "property float z\nelement range_grid 4\nproperty list uchar int vertex_indices\nend_header\n"
            "0 0 1\n1 0 1\n0 1 2\n1 0\n0\n1 1\n1 2\n")
    (tmp_path / "a.ply").write_text(text)
    cloud = load(tmp_path / "a.ply")
    assert isinstance(cloud, PointCloud) and len(cloud.points) == 3


@pytest.mark.parametrize("text, ending, points, has", [
    ("1 2 3\n4 5 6\n", ".xyz", 2, ""),
    ("# x y z nx ny nz\n1 2 3 0 0 1\n4 5 6 0 1 0\n", ".xyz", 2, "normals"),
    ("//X Y Z R G B\n1 2 3 255 0 0\n4 5 6 0 1 0\n", ".txt", 2, "colors"),
    ("1 2 3 0 0 1\n4 5 6 0 1 0\n", ".xyz", 2, "normals"),
    ("1 2 3 200 0 1\n4 5 6 0 1 0\n", ".asc", 2, "colors"),
    ("2\n1 2 3 -200 10 20 30\n4 5 6 9 0 1 0\n", ".pts", 2, "colors intensity"),
    ("2\n1 2 3 0.5\n4 5 6 0.1\n", ".pts", 2, "intensity"),
    ("x,y,z,red,green,blue\n1,2,3,0,0,255\n4,5,6,1,2,3\n", ".csv", 2, "colors"),
    ('"X","Y","Z","Intensity"\n1,2,3,7\n4,5,6,8\n', ".csv", 2, "intensity"),
    ("name;x;y;z\na;1,5;2,5;3,5\nb;4;5;6\n", ".csv", 2, ""),
    ("x;y;z;\n1.5;2;3;\n4;5;6;\n", ".csv", 2, ""),
    ("Easting\tNorthing\tHeight\n1\t2\t3\n4\t5\t6\n", ".txt", 2, ""),
    ("x, y, z\n1, 2, 3\n\n4, 5, 6 # a comment\n", ".csv", 2, ""),
    ("x,y,z,i\n1,2,3,\n4,5,6,2\n", ".csv", 2, "intensity"),
    ("1 2 3 0 0 1 9 8 7\n4 5 6 0 1 0 200 3 4\n", ".xyz", 2, "normals colors"),
    ("\ufeff1 2 3\r\n4 5 6\r\n", ".xyz", 2, ""),
    ("1 2 3\n4 5 6", ".xyz", 2, ""),
    ("1 2 3 4 5\n4 5 6 7 8\n", ".xyz", 2, "column4 column5"),
    ("x y z nan_column\n1 2 3 nan\n4 5 6 nan\n", ".xyz", 2, ""),
    ("1e0 -2.5E+0 .3\n4 5 6\n7 nan 8\n", ".xyz", 2, ""),
])
def test_text(tmp_path, text, ending, points, has):
    (tmp_path / f"a{ending}").write_text(text, encoding="utf-8", newline="")
    cloud = load(tmp_path / f"a{ending}")
    assert len(cloud.points) == points
    held = {name for name in ("normals", "colors") if getattr(cloud, name) is not None} | set(cloud.attributes)
    assert held == set(has.split())
    np.testing.assert_allclose(world(cloud)[1], (4, 5, 6), atol=1e-6)


@pytest.mark.parametrize("text, ending", [
    ("1 2\n3 4\n", ".xyz"), ("hello world\n", ".xyz"), ("3\n1 2 3\n4 5 6\n", ".pts"), ("x,y\n1,2\n", ".csv"),
    ("1 2 3\n4 five 6\n", ".xyz"), ("1 2 3\n4 5\n", ".xyz"), ("nan nan nan\n", ".xyz"), ("\n\n\n", ".txt"),
    ("x,y,z\n", ".csv"), ("1 2 3\n" + "9" * 100_000, ".xyz")])
def test_bad_text(tmp_path, text, ending):
    (tmp_path / f"a{ending}").write_text(text)
    with pytest.raises(FileFormatError) as caught:
        load(tmp_path / f"a{ending}")
    assert "\n" not in str(caught.value)


def test_numpy_files(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "a.npy"
    np.save(path, rng.random((4, 5, 3)))
    assert len(load(path).points) == 20
    np.save(path, np.asfortranarray(rng.random((9, 6))) * 200)
    assert load(path).colors is not None
    np.save(path, np.array([{}], object), allow_pickle=True)
    with pytest.raises(FileFormatError, match="Python objects"):
        load(path)
    np.save(path, rng.random(9))
    with pytest.raises(FileFormatError):
        load(path)
    with open(path, "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    with pytest.raises(FileFormatError, match="truncated"):
        load(path)
    np.savez(tmp_path / "b.npz", vertices=rng.random((5, 3)), faces=[(0, 1, 2), (2, 3, 4)], heat=np.arange(5.0))
    mesh = load(tmp_path / "b.npz")
    assert len(mesh.faces) == 2 and mesh.attributes["heat"].tolist() == [0, 1, 2, 3, 4]
    np.savez(tmp_path / "b.npz", other=rng.random((5, 3)))
    with pytest.raises(FileFormatError, match="other"):
        load(tmp_path / "b.npz")


def test_las_with_eight_bit_colours(tmp_path):
    """Some programs put 0 to 255 into the 16-bit fields."""
    import laspy
    las = laspy.create(point_format=2, file_version="1.2")
    las.x, las.y, las.z = np.arange(4.0), np.zeros(4), np.zeros(4)
    las.red, las.green, las.blue = [0, 100, 200, 255], [1] * 4, [2] * 4
    las.write(str(tmp_path / "a.las"))
    assert load(tmp_path / "a.las").colors[:, 0].tolist() == [0, 100, 200, 255]
    las.red = [0, 100 * 256, 200 * 256, 65535]
    las.write(str(tmp_path / "a.las"))
    assert load(tmp_path / "a.las").colors[:, 0].tolist() == [0, 100, 200, 255]


def test_glb_scene_is_placed_and_put_together(tmp_path):
    import trimesh
    scene = trimesh.Scene()
    box = trimesh.creation.box()
    for k in range(2):
        scene.add_geometry(box, transform=trimesh.transformations.translation_matrix((1000 * k, 0, 0)))
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    mesh = load(tmp_path / "a.glb")
    assert len(mesh.vertices) == 16 and len(mesh.faces) == 24
    np.testing.assert_allclose(mesh.bounds, [(-0.5, -0.5, -0.5), (1000.5, 0.5, 0.5)], atol=1e-4)


def test_failed_save_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    save(make_mesh(), path)
    before = path.read_bytes()

    def broken(scan, temporary):
        temporary.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("clsurf.io.ply.write_ply", broken)
    with pytest.raises(InputError, match="no space left"):
        save(make_mesh(), path)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_what_a_format_cannot_hold_is_logged(tmp_path, caplog):
    with caplog.at_level(logging.INFO, "clsurf"):
        save(make_mesh(colors=np.full((12, 4), 9), normals=np.ones((12, 3))), tmp_path / "a.stl")
    assert "cannot hold normals, colors" in caplog.text


def test_survey_coordinates_keep_millimetres():
    offsets = np.array([(0, 0, 0), (0.001, 0.002, 0.003), (900.123, 800.456, 70.789)])
    cloud = PointCloud(SURVEY + offsets)
    assert np.abs(world(cloud) - (SURVEY + offsets)).max() < 1e-4


# Real scans

@pytest.mark.parametrize("name, vertices, faces", [
    ("dragon/dragon.ply", 435_545, 871_306), ("bunny/bunny.obj", 34_834, 69_451),
    ("maxplanck/maxplanck.ply", 49_132, 98_260),
    ("coloured/frag_115.ply", 64_365, 127_229), ("textured/spot.obj", 3_225, 5_856),
    ("range_scans/bunny/bun_zipper.ply", 34_834, 69_451)])
def test_real_meshes(name, vertices, faces):
    mesh = load(scan_path(name))
    assert isinstance(mesh, Mesh) and (len(mesh.vertices), len(mesh.faces)) == (vertices, faces)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).astype(np.int64)
    assert len(np.unique(edges[:, 0] * vertices + edges[:, 1])) == len(edges)  # consistently oriented


def test_max_planck_strips_enclose_a_volume():
    mesh = load(scan_path("maxplanck/maxplanck.ply"))
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).astype(np.int64)
    count = len(mesh.vertices)
    assert set(edges[:, 0] * count + edges[:, 1]) == set(edges[:, 1] * count + edges[:, 0])  # closed
    a, b, c = mesh.vertices[mesh.faces].astype(float).transpose(1, 0, 2)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0


def test_real_clouds():
    lion = load(scan_path("coloured/lion_takanawa.copc.laz"))
    assert len(lion.points) == 275_855 and lion.colors[:, :3].max() == 255 and "intensity" in lion.attributes
    happy = load(scan_path("range_scans/happy/happyStandRight_0.ply"))
    assert isinstance(happy, PointCloud) and len(happy.points) == 78_056
    spot = load(scan_path("textured/spot.obj"))
    assert spot.texture is None and spot.uv.shape == (3_225, 2)  # spot.png shows the model; no .mtl names it


def test_autzen_coordinates():
    """10.7 million points: the first ones agree with the file to a tenth of a millimetre."""
    import laspy
    path = scan_path("clouds/autzen.laz")
    with laspy.open(path) as reader:
        first = next(reader.chunk_iterator(1000))
        count = reader.header.point_count
    cloud = load_scan(path, clean=False)
    assert len(cloud.points) == count == 10_653_336 and cloud.colors is not None
    assert np.abs(world(cloud)[:1000] - np.stack([first.x, first.y, first.z], axis=1)).max() < 3e-4


def test_generated_scan_goes_round(tmp_path):
    scan = models.demo_scan(5000)
    save(scan, tmp_path / "a.ply")
    again = load(tmp_path / "a.ply")
    assert (again.points == scan.points).all() and (again.colors == scan.colors).all()


def test_draco_without_its_decoder(tmp_path, monkeypatch):
    """Trimesh would give a mesh of zeros."""
    import json
    import sys
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    text = json.dumps({"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_draco_mesh_compression"]}).encode()
    text += b" " * (-len(text) % 4)
    (tmp_path / "a.glb").write_bytes(struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text)
    (tmp_path / "b.gltf").write_bytes(text)
    for name in ("a.glb", "b.gltf"):
        with pytest.raises(FileFormatError, match="pip install DracoPy"):
            load(tmp_path / name)


def test_stl_says_what_it_rounds(tmp_path, caplog):
    save(make_mesh(), tmp_path / "near.stl")
    assert not caplog.records
    save(make_mesh(origin=SURVEY), tmp_path / "far.stl")
    assert "rounded by up to 0.25" in caplog.text
