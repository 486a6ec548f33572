"""Surfaces that stay in their store under project, error, curvature and trace: what the whole surface gives."""

import contextlib
import functools
import http.server
import json
import shutil
import threading
import tracemalloc

import numpy as np
import pytest
import zarr
from test_build_streamed import ORIGIN, ground, write_las

import clsurf
from clsurf.build import streamed
from clsurf.errors import FileFormatError, InputError
from clsurf.io.stored import StoredSurface
from clsurf.io.stored_leaves import BYTES


@pytest.fixture(scope="module")
def place(device, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    write_las(folder / "hills.las", *ground(30_000))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed, "sizes_of", lambda limit: streamed.Sizes(10_000, 4_000, 3_000))
        return clsurf.build_slim(folder / "hills.las", error=0.003, out=folder / "a.clsurf", device=device).place


@pytest.fixture(scope="module")
def whole(place):
    return StoredSurface(place).load()


@pytest.fixture(params=("all of it", "a part"))
def stored(place, request, monkeypatch):
    """A stored surface, once with a budget that holds a part of it, checked at every reading."""
    plain = StoredSurface(place)
    budget = BYTES * len(plain) * 6 // 10 if request.param == "a part" else "1GB"
    out = clsurf.open_surface(place, budget=budget)
    cost = type(out.leaves()).surface

    def within(self, parts):
        assert self.cost(parts) <= self.budget
        return cost(self, parts)

    monkeypatch.setattr(type(out.leaves()), "surface", within)
    return out


def points_near(count=3000, off=0.6):
    rng = np.random.default_rng(5)
    points, _ = ground(count, seed=6)
    return np.asarray(points, np.float64)[:, :3] + rng.normal(0, off, (count, 3))


def test_project(stored, whole, device):
    points = np.concatenate([points_near(), ORIGIN + np.array([[-500.0, 100, 0], [100, 100, 4000], [1e6, 0, 0]])])
    got, want = clsurf.project(stored, points, device), clsurf.project(whole, points, device)
    np.testing.assert_allclose(got.distance[:-3], want.distance[:-3], atol=2e-4)
    assert (np.abs(got.position - want.position)[:-3].max(axis=1) < 1e-3).mean() > 0.995
    assert (np.abs(got.normal - want.normal)[:-3].max(axis=1) < 1e-2).mean() > 0.995
    assert (np.abs(got.distance[-3:]) <= np.abs(want.distance[-3:]) * (1 + 1e-3) + 0.1).all()


def test_error_and_samples(stored, whole, device):
    points = points_near()
    got, want = clsurf.error(stored, points, device=device), clsurf.error(whole, points, device=device)
    assert got.rms == pytest.approx(want.rms, rel=1e-4) and got.max == pytest.approx(want.max, rel=1e-3)
    side = clsurf.Mesh(*_flat())
    back = [clsurf.error(one, side, both=True, samples=4000, device=device).backward.rms for one in (stored, whole)]
    assert back[0] == pytest.approx(back[1], rel=0.05)


def _flat():
    x, y = np.meshgrid(np.arange(0.0, 201, 20), np.arange(0.0, 201, 20), indexing="ij")
    vertices = (np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) + ORIGIN)
    at = np.arange(121).reshape(11, 11)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], axis=-1).reshape(-1, 4)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def test_curvature(stored, whole, device):
    points = points_near(off=0.05)
    got, want = (clsurf.curvature(one, points, device=device) for one in (stored, whole))
    close = np.isclose(got.mean, want.mean, rtol=1e-2, atol=1e-4, equal_nan=True)
    assert close.mean() > 0.995
    centers = clsurf.curvature(stored, device=device)
    assert len(centers) == whole.leaf.sum() and np.isfinite(centers.mean).mean() > 0.99


def rays():
    middle = ORIGIN + np.array([100.0, 100, 0])
    camera = clsurf.Camera.look_at(middle - np.array([60.0, 80, -60]), middle, (0, 0, 1), 60)
    origins, directions = camera.rays((40, 30))
    return origins, directions * 3.0


@pytest.mark.parametrize("query", ("closest", "any", "all"))
def test_trace(stored, whole, device, query):
    got, want = (clsurf.trace(one, *rays(), query, device=device) for one in (stored, whole))
    assert (got.hit == want.hit).mean() > 0.999 and 0.3 < want.hit.mean() < 1
    if query == "any":
        return
    if query == "all":
        assert (np.diff(got.offsets) == np.diff(want.offsets)).mean() > 0.995
        same = np.diff(got.offsets) == np.diff(want.offsets)
        pick = lambda hits: hits.distance[np.repeat(same, np.diff(hits.offsets))]  # noqa: E731
        assert (np.abs(pick(got) - pick(want)) < 1e-3).mean() > 0.995
        return
    both = got.hit & want.hit
    assert (np.abs(got.distance[both] - want.distance[both]) < 1e-3).mean() > 0.995
    assert (np.abs(got.normal[both] - want.normal[both]).max(axis=-1) < 1e-2).mean() > 0.99
    assert got.primitive[got.hit].max() < len(whole) and (got.primitive[~got.hit] == -1).all()


def test_trace_stops_at_limits_and_merges_with_others(stored, whole, device):
    """A floor below the hills, and a second, moved copy: each ray has what the whole surfaces give it."""
    matrix = np.eye(4)
    matrix[:3, :3] *= 0.5
    matrix[:3, 3] = 0.5 * ORIGIN + np.array([0, 0, 30])
    floor = clsurf.Mesh(*_flat()).moved(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -8.0], [0, 0, 0, 1]]))
    for limits in ({}, {"near": 130.0, "far": 180.0}):
        got = clsurf.trace([floor, stored, clsurf.Placed(stored, matrix)], *rays(), device=device, **limits)
        want = clsurf.trace([floor, whole, whole.moved(matrix)], *rays(), device=device, **limits)
        assert (got.surface == want.surface).mean() > 0.995 and len(np.unique(want.surface)) >= 3
        both = got.hit & want.hit
        assert (np.abs(got.distance[both] - want.distance[both]) < 1e-3).mean() > 0.995


def test_reads_what_lies_on_the_way_only(place, device, monkeypatch):
    stored, read = StoredSurface(place), []
    original = StoredSurface.read
    monkeypatch.setattr(StoredSurface, "read", lambda self, part, levels=None: read.append(part) or
                        original(self, part, levels))
    down = ORIGIN + np.array([[20.0, 20, 50]])
    assert clsurf.trace(stored, down, (0, 0, -1.0), device=device).hit.all()
    ground_below = clsurf.trace(stored, down, (0, 0, -1.0), device=device).position
    assert abs(clsurf.project(stored, ground_below + np.array([0, 0, 0.5]), device).distance[0]) < 0.51
    assert 0 < len(set(read)) < 0.6 * len(stored.surfels) and len(read) == len(set(read))  # and none of it twice
    before = len(read)
    assert not clsurf.trace(stored, down, (0, 0, 1.0), device=device).hit.any() and len(read) == before


@contextlib.contextmanager
def served(folder):
    """The address of a folder on the web."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_over_the_web(place, whole, device):
    with served(place) as address:
        remote, points = clsurf.open_surface(address), points_near(200)
        near, hits = clsurf.project(remote, points, device), clsurf.trace(remote, *rays(), device=device)
    np.testing.assert_allclose(near.distance, clsurf.project(whole, points, device).distance, atol=2e-4)
    assert (hits.hit == clsurf.trace(whole, *rays(), device=device).hit).mean() > 0.999


def test_a_plain_store(whole, device, tmp_path):
    clsurf.save(whole, tmp_path / "zip.clsurf")
    opened, points = clsurf.open_surface(tmp_path / "zip.clsurf"), points_near(500)
    np.testing.assert_allclose(clsurf.project(opened, points, device).distance,
                               clsurf.project(whole, points, device).distance, atol=2e-4)
    with pytest.raises(InputError, match="budget"):
        clsurf.open_surface(tmp_path / "zip.clsurf", budget=0)


ABSURD = 1 << 34  # rows; 200 GB and more


def edited(place, tmp_path, array: str, **changes):
    """A copy of a store in which `array` declares something else."""
    copy = tmp_path / "damaged.clsurf"
    shutil.copytree(place, copy)
    about = copy / array / "zarr.json"
    about.write_text(json.dumps(json.loads(about.read_text()) | changes))
    return copy


def refused(address, word):
    """What opening or reading says, which takes no memory worth mentioning."""
    tracemalloc.start()
    with pytest.raises(FileFormatError, match=word) as caught:
        opened = StoredSurface(address)
        opened.read(0)
        opened.read(1, 3)
    assert tracemalloc.get_traced_memory()[1] < 50e6 and "\n" not in str(caught.value)
    tracemalloc.stop()


@pytest.mark.parametrize("where", ("disk", "web"))
@pytest.mark.parametrize(("array", "shape"), [
    ("bounds", [ABSURD, 2, 3]), ("surfels", [ABSURD, 25]), ("parts/00000/origin", [ABSURD]),
    ("parts/00001/centers", [ABSURD, 3]), ("parts/00001/radii", [ABSURD]), ("parts/00001/children", [ABSURD]),
    ("parts/00001/coefficients", [100, ABSURD]), ("parts/00001/child_offset", [ABSURD])])
def test_absurd_shapes_are_refused_before_memory_is_taken(place, tmp_path, array, shape, where):
    copy = edited(place, tmp_path, array, shape=shape)
    with served(copy) if where == "web" else contextlib.nullcontext(copy) as address:
        refused(address, "damaged")


def test_counts_and_chunks_that_do_not_fit_are_refused(place, tmp_path):
    """An index that agrees with an absurd part, chunks that are missing, and one chunk of everything."""
    copy = edited(place, tmp_path, "parts/00001/radii", shape=[ABSURD])
    index = zarr.open_group(copy, mode="r+")
    surfels = index["surfels"][...]
    surfels[1] = 0
    surfels[1, 0] = ABSURD
    index["surfels"][...] = surfels
    refused(copy, "expected the shape")
    with served(copy) as address:
        refused(address, "damaged")
    index["surfels"][1, 0] = -5
    refused(copy, "expected counts")
    shutil.rmtree(copy)
    shutil.copytree(place, copy)
    (copy / "parts/00001/centers/c/0/0").unlink()
    refused(copy, "chunks")
    shutil.rmtree(copy)
    grid = {"name": "regular", "configuration": {"chunk_shape": [ABSURD]}}
    copy = edited(place, tmp_path, "parts/00001/radii", chunk_grid=grid)
    refused(copy, "chunks")
    with served(copy) as address:
        refused(address, "chunks")
