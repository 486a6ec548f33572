"""The .clsurf store: round trips, normals in two floats, versions, damaged and hostile files."""

import json
import pickle
import shutil
import zipfile

import numpy as np
import pytest
import zarr
from conftest import scan_path
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_io_slim2t import random_surface

from clsurf.errors import FileFormatError, InputError
from clsurf.io import load, save
from clsurf.io.layout import pack_normals, to_arrays, unpack_normals
from clsurf.surface.cloud import PointCloud
from clsurf.surface.mesh import Mesh


def assert_same(a, b):
    (kind, arrays, values), (kind2, arrays2, values2) = to_arrays(a), to_arrays(b)
    assert kind == kind2 and values == values2 and arrays.keys() == arrays2.keys()
    for name, array in arrays.items():
        assert arrays2[name].dtype == array.dtype
        np.testing.assert_array_equal(arrays2[name], array, err_msg=name)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_slim_round_trip(tmp_path, degree):
    rng = np.random.default_rng(1)
    surface = random_surface(degree, origin=(637291.003, 851210.001, 500), bound=0.25, bound_share=0.99,
                             diagonal=3.5, oriented=False, footprint=rng.integers(0, 256, (60, 8)),
                             colors=rng.integers(0, 256, (60, 4)))
    save(surface, tmp_path / "a.clsurf")
    again = load(tmp_path / "a.clsurf")
    np.testing.assert_allclose(again.normals, surface.normals, atol=1.3e-7)
    for name in ("centers", "radii", "coefficients", "level", "leaf", "children", "child_offset", "fit_error", "origin",
                 "footprint", "colors"):
        np.testing.assert_array_equal(getattr(again, name), getattr(surface, name))
    for name in ("degree", "error", "bound", "bound_share", "diagonal", "oriented"):
        assert getattr(again, name) == getattr(surface, name)
    save(again, tmp_path / "b.clsurf")
    assert_same(again, load(tmp_path / "b.clsurf"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.clsurf", "b.clsurf"]


@pytest.mark.parametrize("degree, floats", [(1, 7), (2, 12), (3, 16)])
def test_floats_of_a_surfel(degree, floats):
    _, arrays, _ = to_arrays(random_surface(degree))
    stored = [arrays[name] for name in ("centers", "radii", "normals", "coefficients")]
    assert all(a.dtype == np.float32 for a in stored) and sum(a.size for a in stored) == floats * 60


def test_undefined_numbers(tmp_path):
    save(random_surface(2, bound=np.nan), tmp_path / "a.clsurf")
    assert np.isnan(load(tmp_path / "a.clsurf").bound)


def test_empty_and_large(tmp_path):
    save(random_surface(2, 0), tmp_path / "a.clsurf")
    assert len(load(tmp_path / "a.clsurf")) == 0
    big = random_surface(1, 400_000)
    save(big, tmp_path / "b.clsurf")
    np.testing.assert_array_equal(load(tmp_path / "b.clsurf").centers, big.centers)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-1, 1, width=32)] * 3).filter(lambda v: np.hypot(np.hypot(*v[:2]), v[2]) > 1e-3),
                min_size=1, max_size=20))
def test_normals_in_two_floats(vectors):
    normals = np.array(vectors, np.float64)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    components, codes = pack_normals(normals)
    again = unpack_normals(components, codes)
    assert np.abs(again - normals).max() <= 2.4e-7
    twice = pack_normals(again)
    assert (twice[0] == components).all() and (twice[1] == codes).all()
    assert (unpack_normals(*twice) == again).all()


def test_normals_at_a_tie():
    half = np.float32(0.5)
    near = [half, np.nextafter(half, np.float32(1)), np.nextafter(half, np.float32(0))]
    normals = np.array([(a, b, np.sqrt(1 - float(a)**2 - float(b)**2)) for a in near for b in near]
                       + [(a, np.sqrt(1 - float(a)**2 - float(b)**2), b) for a in near for b in near], np.float32)
    components, codes = pack_normals(normals)
    again = unpack_normals(components, codes)
    assert (unpack_normals(*pack_normals(again)) == again).all() and np.abs(again - normals).max() < 2e-7


def test_scans_round_trip(tmp_path):
    rng = np.random.default_rng(2)
    cloud = PointCloud(rng.normal(size=(50, 3)) + 1e6, rng.normal(size=(50, 3)), rng.integers(0, 256, (50, 4)),
                       rng.normal(size=(50, 3)), attributes={"intensity": rng.random(50), "class": np.arange(50)})
    mesh = Mesh(rng.normal(size=(50, 3)), rng.integers(0, 50, (80, 3)), uv=rng.random((50, 2)),
                texture=rng.integers(0, 256, (5, 7, 4)))
    for name, scan in (("a", cloud), ("b", mesh)):
        save(scan, tmp_path / f"{name}.clsurf")
        assert_same(load(tmp_path / f"{name}.clsurf"), scan)


def test_folder_is_read(tmp_path):
    surface = random_surface(2)
    save(surface, tmp_path / "a.clsurf")
    with zipfile.ZipFile(tmp_path / "a.clsurf") as archive:
        archive.extractall(tmp_path / "folder.clsurf")
    assert_same(load(tmp_path / "folder.clsurf"), load(tmp_path / "a.clsurf"))
    (tmp_path / "folder.clsurf" / "radii" / "c" / "0").unlink()
    with pytest.raises(FileFormatError, match="radii"):
        load(tmp_path / "folder.clsurf")
    (tmp_path / "empty.clsurf").mkdir()
    with pytest.raises(FileFormatError, match="folder"):
        load(tmp_path / "empty.clsurf")


def test_any_zarr_library_reads_it(tmp_path):
    surface = random_surface(2)
    save(surface, tmp_path / "a.clsurf")
    store = zarr.storage.ZipStore(tmp_path / "a.clsurf", mode="r")
    group = zarr.open_group(store, mode="r")
    assert group.attrs["version"] == 1 and (group["centers"][:] == surface.centers).all()
    store.close()


def edited(path, edits):
    """Rewrite a store with `edits`, {member: new bytes, or a function of the old ones, or None to leave it out}."""
    with zipfile.ZipFile(path) as archive:
        members = {item.filename: archive.read(item) for item in archive.infolist()}
    for name, edit in edits.items():
        old = members.pop(name)
        new = edit(old) if callable(edit) else edit
        if new is not None:
            members[name] = new
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def json_edit(change):
    def edit(data):
        tree = json.loads(data)
        change(tree)
        return json.dumps(tree).encode()
    return edit


@pytest.mark.parametrize("edits, message", [
    ({"zarr.json": json_edit(lambda t: t["attributes"].update(version=2))}, "version 2"),
    ({"zarr.json": json_edit(lambda t: t["attributes"].update(version="x"))}, "version"),
    ({"zarr.json": json_edit(lambda t: t["attributes"].update(kind="voxels"))}, "voxels"),
    ({"zarr.json": json_edit(lambda t: t["attributes"].update(format="other"))}, "other"),
    ({"zarr.json": json_edit(lambda t: t["attributes"]["values"].update(degree=9))}, None),
    ({"zarr.json": json_edit(lambda t: t["attributes"].pop("values"))}, None),
    ({"zarr.json": b"{"}, None), ({"zarr.json": None}, "not a .clsurf"),
    ({"radii/zarr.json": json_edit(lambda t: t.update(shape=[10**15]))}, "chunks"),
    ({"radii/zarr.json": json_edit(lambda t: (t.update(shape=[10**12]), t["chunk_grid"]["configuration"].update(
        chunk_shape=[10**12])))}, "damaged"),
    ({"radii/zarr.json": json_edit(lambda t: t.update(shape=[61]))}, None),
    ({"radii/zarr.json": json_edit(lambda t: t.update(data_type="string"))}, None),
    ({"radii/c/0": None}, "chunks"), ({"radii/c/0": b""}, "chunk"), ({"radii/c/0": b"\0" * 100}, "chunk"),
    ({"radii/c/0": lambda d: d[:-5]}, "chunk"),
    ({"radii/c/0": lambda d: d[:4] + (2**31 - 17).to_bytes(4, "little") + d[8:]}, "chunk"),
    ({"radii/zarr.json": None}, None),
])
def test_damaged_stores(tmp_path, edits, message):
    path = tmp_path / "a.clsurf"
    save(random_surface(2), path)
    edited(path, edits)
    with pytest.raises(FileFormatError, match=message) as caught:
        load(path)
    assert "\n" not in str(caught.value)


def test_foreign_files(tmp_path):
    path = tmp_path / "a.clsurf"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(FileFormatError, match=r"not a \.clsurf"):
        load(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zarr.json", b" " * 50_000_000)
    with pytest.raises(FileFormatError, match="claimed"):
        load(path)
    path.write_bytes(b"")
    with pytest.raises(FileFormatError, match="empty"):
        load(path)
    with pytest.raises(InputError, match="no such file"):
        load(tmp_path / "b.clsurf")
    with pytest.raises(InputError, match=r"cannot be written|expected a surface"):
        save(object(), path)
    with pytest.raises(InputError, match=r"\.clsurf"):
        save(random_surface(2), tmp_path / "a.ply")


@settings(max_examples=120, deadline=20000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_bytes_cut_and_flipped(tmp_path, data):
    path = tmp_path / "whole.clsurf"
    if not path.exists():
        save(random_surface(2), path)
    whole = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        del whole[data.draw(st.integers(1, len(whole) - 1)):]
    for _ in range(data.draw(st.integers(0, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    other = tmp_path / "x.clsurf"
    other.write_bytes(whole)
    try:
        load(other)
    except FileFormatError as error:
        assert "\n" not in str(error)


def test_failed_write_leaves_nothing(tmp_path, monkeypatch):
    path = tmp_path / "a.clsurf"
    monkeypatch.setattr("clsurf.io.store.create_array", lambda *a: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(InputError, match="no space"):
        save(random_surface(2), path)
    assert not list(tmp_path.iterdir())


def test_pai_in_the_store(tmp_path):
    surface = load(scan_path("slim/pai.slim2t"))
    save(surface, tmp_path / "a.clsurf")
    again = load(tmp_path / "a.clsurf")
    assert (again.centers == surface.centers).all() and not again.oriented and np.isnan(again.error)
    assert (tmp_path / "a.clsurf").stat().st_size < 0.8 * surface.nbytes
    shutil.copy(tmp_path / "a.clsurf", tmp_path / "b.clsurf")
    assert_same(pickle.loads(pickle.dumps(again)), again)


def test_a_place_that_cannot_be_written_is_one_line(tmp_path, monkeypatch):
    """Not the traceback of closing a store that was never opened."""
    import pathlib

    def refuse(path, *rest, **more):
        raise PermissionError(13, "Permission denied", str(path))
    monkeypatch.setattr(pathlib.Path, "touch", refuse)
    with pytest.raises(InputError, match=r"a\.clsurf: cannot be written: permission denied"):
        save(random_surface(2, 5), tmp_path / "a.clsurf")
