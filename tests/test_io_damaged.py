"""Files that are missing, damaged, truncated or of another kind: one clear error, no hang, no memory taken."""

import struct
import time

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_io_scans import MESH_FORMATS, make_cloud, make_mesh

from clsurf.errors import FileFormatError, InputError
from clsurf.io import load, save
from clsurf.io.las import opened
from clsurf.io.scans import READS, load_scan, save_scan


@pytest.mark.parametrize("ending", sorted(set(READS) | {".clsurf", ".slim2t"}))
def test_files_that_cannot_be(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    with pytest.raises(InputError, match="no such file"):
        load(path)
    path.write_bytes(b"")
    with pytest.raises(FileFormatError, match="empty"):
        load(path)
    path.write_bytes(b"\x00\xff garbage \x80" * 40)
    with pytest.raises(FileFormatError) as caught:
        load(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 500
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match="folder"):
        load(path)


def test_unknown_endings_and_types(tmp_path):
    (tmp_path / "a.doc").write_text("x")
    with pytest.raises(InputError, match=r"\.doc.*\.ply.*\.clsurf"):
        load(tmp_path / "a.doc")
    with pytest.raises(InputError, match=r"\.obj"):
        save(make_mesh(), tmp_path / "a.doc")
    with pytest.raises(InputError, match="triangles"):
        save(make_cloud(), tmp_path / "a.stl")
    with pytest.raises(InputError, match="Mesh or PointCloud"):
        save_scan("scan", tmp_path / "a.ply")
    with pytest.raises(InputError, match="file name"):
        load(None)
    assert [p.name for p in tmp_path.iterdir()] == ["a.doc"]


def test_a_pipe_does_not_hang(tmp_path):
    import os
    if not hasattr(os, "mkfifo"):
        return
    os.mkfifo(tmp_path / "a.ply")
    with pytest.raises(InputError, match="pipe"):
        load(tmp_path / "a.ply")


@pytest.mark.parametrize("ending", [".ply", ".obj", ".glb", ".off", ".stl", ".npz", ".laz", ".xyz", ".npy", ".pts"])
@settings(max_examples=25, deadline=20000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_cut_and_flipped(tmp_path, ending, data):
    """A file that was cut or changed gives a scan or a clear error, in no time."""
    whole_path = tmp_path / f"whole{ending}"
    if not whole_path.exists():
        save(make_mesh() if ending in MESH_FORMATS else make_cloud(30), whole_path)
    whole = bytearray(whole_path.read_bytes())
    if data.draw(st.booleans()):
        del whole[data.draw(st.integers(1, len(whole) - 1)):]
    for _ in range(data.draw(st.integers(0, 5))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / f"x{ending}"
    path.write_bytes(whole)
    read_or_refused(path)


def read_or_refused(path):
    try:
        scan = load(path)
    except FileFormatError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(scan.points).all()


@pytest.mark.parametrize("ending", [".ply", ".obj", ".off", ".stl", ".glb", ".gltf", ".npy", ".npz", ".las", ".laz"])
@settings(max_examples=25, deadline=20000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(body=st.binary(min_size=1, max_size=300))
def test_any_bytes(tmp_path, ending, body):
    start = {".ply": b"ply\n", ".glb": b"glTF\x02\0\0\0", ".npy": b"\x93NUMPY\x01\0", ".laz": b"LASF", ".las": b"LASF",
             ".off": b"OFF\n"}
    path = tmp_path / f"x{ending}"
    path.write_bytes(start.get(ending, b"") + body)
    read_or_refused(path)


@settings(max_examples=150, deadline=20000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.text(alphabet="0123456789.,;-+eE naxyzXYZ#/\t\n\"", min_size=1, max_size=120),
       ending=st.sampled_from([".xyz", ".csv", ".pts", ".off", ".obj"]))
def test_any_text(tmp_path, text, ending):
    path = tmp_path / f"x{ending}"
    path.write_text({".off": "OFF\n3 1 0\n", ".obj": "v 0 0 0\n"}.get(ending, "") + text)
    read_or_refused(path)


@pytest.mark.parametrize("header", [
    "ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\nproperty float y\n"
    "property float z\nend_header\n",
    "ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nproperty float y\nproperty float z\n"
    "end_header\n0 0 0\n",
    "ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uint int vertex_indices\nend_header\n\xff\xff\xff\xff",
    "OFF\n1000000000 1000000000 0\n0 0 0\n"])
def test_absurd_counts_take_no_memory(tmp_path, header):
    import tracemalloc
    path = tmp_path / ("a.off" if header.startswith("OFF") else "a.ply")
    path.write_bytes(header.encode("latin-1"))
    load_scan_fails(path)
    tracemalloc.start()
    start = time.perf_counter()
    load_scan_fails(path)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    assert time.perf_counter() - start < 20  # only a hang takes that long
    tracemalloc.stop()


def load_scan_fails(path):
    with pytest.raises(FileFormatError):
        load_scan(path)


@pytest.mark.parametrize("at, value", [
    (100, 2**32 - 1),  # records: laspy would read on for hours
    (247, 2**40),  # points
    ("table", 2**31),  # chunks: the decoder would end the process
    ("layer", 2**32 - 1),  # bytes of the first layer of the first chunk
])
def test_las_counts_are_checked_first(tmp_path, at, value):
    path = tmp_path / "a.laz"
    save(make_cloud(), path)
    data = bytearray(path.read_bytes())
    points = struct.unpack("<I", data[96:100])[0]
    if at == "table":
        at = struct.unpack("<q", data[points:points + 8])[0] + 4
    elif at == "layer":
        at = points + 8 + struct.unpack("<H", data[105:107])[0] + 4
    data[at:at + 4 + 4 * (at == 247)] = value.to_bytes(4 + 4 * (at == 247), "little")
    path.write_bytes(data)
    start = time.perf_counter()
    load_scan_fails(path)
    assert time.perf_counter() - start < 20  # only a hang takes that long


@pytest.mark.parametrize("points", (50_000, 2**32 - 70_000))
def test_laz_chunks_may_say_more_points_than_the_file_has(tmp_path, points):
    """The decoder that takes memory for whole chunks ended the process."""
    path, cloud = tmp_path / "a.laz", make_cloud()
    save(cloud, path)
    data = bytearray(path.read_bytes())
    at = data.index(struct.pack("<I", 50_000), data.index(b"laszip encoded"))
    data[at:at + 4] = points.to_bytes(4, "little")
    path.write_bytes(data)
    save(cloud, tmp_path / "b.laz")
    assert (load_scan(path).points == load_scan(tmp_path / "b.laz").points).all()
    with opened(path) as reader:
        reader.seek(len(cloud.points) // 2)
        assert len(reader.read_points(3)) == 3
