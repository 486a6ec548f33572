"""Builds of scans in parts: against the build in memory, killed and resumed, within their memory."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import laspy
import numpy as np
import pytest
from conftest import scan_path
from scipy.ndimage import binary_erosion, binary_fill_holes
from scipy.spatial import cKDTree

import clsurf
from clsurf.build import stream_here, stream_plan, stream_runs, streamed
from clsurf.errors import Cancelled, InputError
from clsurf.io.chunks import open_source

SIZES_OF = streamed.sizes_of
ORIGIN = np.array([637_000.0, 851_000.0, 400.0])


def height(x, y):
    """A smooth hill range, metres."""
    return 3 * np.sin(x / 17) * np.cos(y / 23) + 0.002 * x


def ground(count, seed=1, side=200.0):
    """Return `count` points of the hills and their colours, world space, in the order of flight lines."""
    rng = np.random.default_rng(seed)
    x, y = rng.random((2, count)) * side
    order = np.lexsort((x, y // 20))
    x, y = x[order], y[order]
    points = np.stack([x, y, height(x, y) + rng.normal(0, 0.02, count)], axis=1) + ORIGIN
    return points, np.stack([x / side * 65535, y / side * 65535, 0 * x], axis=1).astype(np.uint16)


def write_las(path, points, colors):
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales, header.offsets = np.full(3, 0.001), ORIGIN
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red, las.green, las.blue = colors.T
    las.write(str(path))


@pytest.fixture(scope="module")
def hills(tmp_path_factory):
    path = tmp_path_factory.mktemp("hills") / "hills.laz"
    write_las(path, *ground(60_000))
    return path


@pytest.fixture(scope="module", autouse=True)
def small():
    """Chunks of 13,000 points, cells of at most 9,000."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streamed, "sizes_of", lambda limit: streamed.Sizes(13_000, 9_000, 4_000) if limit is None
                      else SIZES_OF(limit))
        yield


@pytest.fixture(scope="module")
def whole(hills, small, device, tmp_path_factory):
    """The hills' surface in parts."""
    return clsurf.build_slim(hills, error=0.002, out=tmp_path_factory.mktemp("whole") / "a.clsurf", device=device)


@pytest.fixture(scope="module")
def streamed_slim(whole):
    return whole.load()


@pytest.fixture(scope="module")
def memory_slim(hills, device):
    return clsurf.build_slim(hills, error=0.002, device=device)


def tree_bytes(folder):
    folder = Path(folder)
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def off_ground(surface, count=4000, margin=2.0):
    """Return the vertical distances of the surface from the hills at random places."""
    rng = np.random.default_rng(5)
    x, y = margin + rng.random((2, count)) * (200 - 2 * margin)
    near = clsurf.project(surface, np.stack([x, y, height(x, y)], axis=1) + ORIGIN)
    return np.abs(near.distance)


def test_equals_the_build_in_memory(whole, streamed_slim, memory_slim):
    assert len(whole.surfels) > 8 and sorted(p.name for p in Path(whole.place).parent.iterdir()) == ["a.clsurf"]
    assert streamed_slim.diagonal == pytest.approx(memory_slim.diagonal, rel=1e-3)
    assert streamed_slim.error == memory_slim.error and len(streamed_slim) == len(whole)
    a, b = off_ground(streamed_slim), off_ground(memory_slim)
    assert np.quantile(a, 0.99) < 1.3 * np.quantile(b, 0.99) and a.max() < 1.5 * b.max()
    assert streamed_slim.bound < 1.2 * memory_slim.bound and streamed_slim.bound_share == memory_slim.bound_share
    assert 0.8 < streamed_slim.leaf.sum() / memory_slim.leaf.sum() < 1.3
    assert streamed_slim.oriented


def test_every_point_is_covered(streamed_slim):
    surface = streamed_slim
    points, _ = ground(60_000)
    away = points - surface.origin
    leaf = np.flatnonzero(surface.leaf)
    covered = np.zeros(len(points), bool)
    tree = cKDTree(away)
    for center, radius in zip(surface.centers[leaf], surface.radii[leaf], strict=True):
        covered[tree.query_ball_point(center, 2 / 3 * radius)] = True
    assert covered.all()
    # A surfel's colour is that of its place.
    at = surface.centers[leaf[::10]] + (surface.origin - ORIGIN)
    assert np.abs(surface.colors[leaf[::10], :2] - at[:, :2] / 200 * 255).max() < 12


def test_pictures_have_no_seam(streamed_slim, memory_slim, device):
    middle = ORIGIN + np.array([100, 100, 0])
    camera = clsurf.Camera.look_at(middle + np.array([0, -60, 120]), middle, (0, 0, 1), 60)
    frames = [clsurf.render(one, camera, (320, 240), device=device) for one in (streamed_slim, memory_slim)]
    both = np.isfinite(frames[0].depth) & np.isfinite(frames[1].depth)
    # Random points leave gaps, in both surfaces; seams would add to them. The rim of a scan is frayed.
    inside = binary_erosion(binary_fill_holes(np.isfinite(frames[1].depth)), iterations=6)
    holes = [(inside & ~np.isfinite(frame.depth)).sum() for frame in frames]
    assert inside.mean() > 0.3 and holes[0] < 1.2 * holes[1] + 10
    assert np.quantile(np.abs(frames[0].depth - frames[1].depth)[both], 0.99) < 0.08
    turn = np.einsum("ijk,ijk->ij", frames[0].normal, frames[1].normal)[both]
    assert np.quantile(np.degrees(np.arccos(np.clip(turn, -1, 1))), 0.99) < 8


def test_links_lead_everywhere(streamed_slim):
    """The links go to finer levels, and lead to nearly all surfels below the first level."""
    surface = streamed_slim
    assert (np.diff(surface.level) >= 0).all()
    parent = np.repeat(np.arange(len(surface)), np.diff(surface.child_offset))
    assert (surface.level[parent] < surface.level[surface.children]).all()
    assert (surface.level[surface.roots] > surface.level[0]).sum() < 0.02 * len(surface)


def test_tolerance_keeps_strays(device):
    rng = np.random.default_rng(2)
    points, _ = ground(20_000)
    wood = points[:, 0] < ORIGIN[0] + 40
    points[wood, 2] += rng.uniform(0, 8, wood.sum())
    cloud = clsurf.PointCloud(points)
    cloud = clsurf.estimate_normals(cloud, orient=ORIGIN + np.array([100, 100, 1e4]), device=device)
    share = []
    for tolerance in (None, 0.3):
        surface = clsurf.build_slim(cloud, error=0.002, tolerance=tolerance, device=device)
        share.append((np.abs(clsurf.project(surface, points).distance) < 0.3).mean())
    assert share[0] < 0.9 and share[1] > 0.985


def interrupted(stage, times):
    """Return a progress callback that stops the build at the given call of `stage`."""
    seen = []

    def progress(now, done):
        seen.append(now)
        return not (now == stage and seen.count(stage) == times)
    return progress


@pytest.mark.parametrize(("stage", "times"), (("read", 3), ("cells", 3)))
def test_resumed_build_has_equal_bytes(hills, whole, device, tmp_path, stage, times):
    again = tmp_path / "again.clsurf"
    with pytest.raises(Cancelled):
        clsurf.build_slim(hills, error=0.002, out=again, device=device, progress=interrupted(stage, times))
    assert (tmp_path / "again.clsurf.part").is_dir() and not again.exists()
    stages = []
    clsurf.build_slim(hills, error=0.002, out=again, device=device, progress=lambda stage, done: stages.append(stage))
    assert stages.count("read") <= (1 if stage != "read" else 4)
    assert tree_bytes(whole.place) == tree_bytes(again)


def test_bytes_do_not_depend_on_how_many_cells_are_built_at_once(hills, whole, device, tmp_path, monkeypatch):
    assert stream_here.AT_ONCE > 1
    monkeypatch.setattr(stream_here, "AT_ONCE", 1)
    alone = clsurf.build_slim(hills, error=0.002, out=tmp_path / "a.clsurf", device=device)
    assert tree_bytes(whole.place) == tree_bytes(alone.place)


def test_a_cell_that_fails_stops_the_build_and_leaves_the_others(hills, whole, device, tmp_path, monkeypatch):
    build_cell, calls = streamed.build_cell, []

    def failing(*arguments):
        calls.append(1)
        if len(calls) == 3:
            raise InputError("third: expected to fail, did")
        return build_cell(*arguments)
    monkeypatch.setattr(streamed, "build_cell", failing)
    again = tmp_path / "again.clsurf"
    with pytest.raises(InputError, match="third"):
        clsurf.build_slim(hills, error=0.002, out=again, device=device)
    begun = len(calls)
    assert begun <= 2 + stream_here.AT_ONCE  # the rest is not begun
    made = len(list((tmp_path / "again.clsurf.part" / "parts").glob("0*"))) - 1
    assert made == begun - 1
    monkeypatch.setattr(streamed, "build_cell", build_cell)
    clsurf.build_slim(hills, error=0.002, out=again, device=device)
    assert tree_bytes(whole.place) == tree_bytes(again)


def test_a_stopped_build_begins_no_more_cells(hills, device, tmp_path, monkeypatch):
    build_cell, calls = streamed.build_cell, []
    monkeypatch.setattr(streamed, "build_cell", lambda *a: calls.append(1) or build_cell(*a))
    with pytest.raises(Cancelled) as held:  # what is raised keeps the frames that it came through
        clsurf.build_slim(hills, error=0.002, out=tmp_path / "a.clsurf", device=device,
                          progress=interrupted("cells", 1))
    begun = len(calls)
    assert 1 <= begun <= stream_here.AT_ONCE and held.value is not None
    time.sleep(0.5)
    assert len(calls) == begun


KILLED = """
import sys
from pathlib import Path
import clsurf
from clsurf.build import streamed
streamed.sizes_of = lambda limit: streamed.Sizes(13_000, 9_000, 4_000)
clsurf.build_slim(Path(sys.argv[1]), error=0.002, out=sys.argv[2], device=sys.argv[3])
"""


def test_killed_build_has_equal_bytes(hills, whole, device, tmp_path):
    again = tmp_path / "again.clsurf"
    name = "intel" if "intel" in device.platform_name.lower() else "pocl"
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(hills), str(again), name])
    part = tmp_path / "again.clsurf.part" / "parts"
    while process.poll() is None and len(list(part.glob("0000[2-9]"))) < 2:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not again.exists()
    clsurf.build_slim(hills, error=0.002, out=again, device=device)
    assert tree_bytes(whole.place) == tree_bytes(again)


def test_coordinates_of_a_survey(streamed_slim):
    points, _ = ground(60_000)
    distance, _ = cKDTree(points).query(streamed_slim.centers[streamed_slim.leaf] + streamed_slim.origin)
    assert distance.max() < 0.001  # centres are points


@pytest.mark.parametrize("ending", (".ply", ".xyz", ".csv"))
def test_formats(device, tmp_path, ending):
    points, colors = ground(20_000)
    cloud = clsurf.PointCloud(points, colors=np.concatenate([colors >> 8, np.full((len(points), 1), 255)], axis=1))
    path = tmp_path / f"scan{ending}"
    clsurf.save(cloud, path)
    source = open_source(path, 3000)
    parts = [source.read(k) for k in range(source.chunks)]
    read = np.concatenate([part.points for part in parts])
    assert np.abs(read - points).max() < 1e-3 and len(parts) > 3
    assert (np.concatenate([part.colors for part in parts])[:, :3] == colors >> 8).all()
    surface = clsurf.build_slim(path, error=0.003, out=tmp_path / "a.clsurf", device=device).load()
    assert np.quantile(off_ground(surface), 0.99) < 0.2
    up = surface.normals[surface.leaf][:, 2] > 0
    assert up.mean() > 0.99 or up.mean() < 0.01


def test_closed_surface_is_oriented_outward(device, tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    clsurf.save(clsurf.PointCloud(points.astype(np.float32)), tmp_path / "ball.ply")
    surface = clsurf.build_slim(tmp_path / "ball.ply", error=0.005, out=tmp_path / "a.clsurf", device=device).load()
    near = clsurf.project(surface, points[::20])
    assert np.abs(near.distance).max() < 0.01
    assert np.einsum("ij,ij->i", near.normal, points[::20]).min() > 0.97


def test_bad_input_is_told(device, tmp_path, hills):
    with pytest.raises(InputError, match="memory_limit"):
        clsurf.build_slim(hills, out=tmp_path / "a.clsurf", memory_limit="10MB", device=device)
    with pytest.raises(InputError, match="tolerance"):
        clsurf.build_slim(hills, tolerance=-1, device=device)
    (tmp_path / "b.clsurf.part").mkdir()
    (tmp_path / "b.clsurf.part" / "mine.txt").write_text("x")
    with pytest.raises(InputError, match="other files"):
        clsurf.build_slim(hills, out=tmp_path / "b.clsurf", device=device)


def test_cut_cells():
    rng = np.random.default_rng(1)
    cell = np.unique(stream_runs.morton(rng.integers(0, 64, (3000, 3), dtype=np.int32)))
    counts = rng.integers(1, 50, len(cell))
    cuts = stream_plan.cut_cells(cell, counts, 4000)
    sizes = np.add.reduceat(counts, cuts[:-1])
    assert cuts[0] == 0 and cuts[-1] == len(cell) and (sizes <= 4000).all() and (np.diff(cuts) > 0).all()
    assert len(sizes) < 2.5 * counts.sum() / 4000
    assert (stream_runs.morton(stream_runs.unmorton(cell).astype(np.int32)) == cell).all()


PEAK = """
import json, sys
from pathlib import Path
import clsurf
surface = clsurf.build_slim(Path(sys.argv[1]), out=sys.argv[2], memory_limit=sys.argv[3], device=sys.argv[4],
                            tolerance=0.3)
# Of this process alone: ru_maxrss holds that of the process that started it, too.
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(json.dumps({"peak": 1024 * int(peak), "parts": len(surface.surfels)}))
"""


def test_memory_limit_is_kept(device, tmp_path):
    path = tmp_path / "large.las"
    write_las(path, *ground(700_000, side=800.0))
    name = "intel" if "intel" in device.platform_name.lower() else "pocl"
    limit = 900_000_000 if name == "pocl" else 1_200_000_000
    done = subprocess.run([sys.executable, "-c", PEAK, str(path), str(tmp_path / "a.clsurf"), str(limit), name],
                          capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["peak"] < limit and found["parts"] > 2


def test_autzen_in_part(device, tmp_path):
    """The lattice and one cell of the real scan: coordinates within a millimetre, colours kept."""
    source = open_source(scan_path("clouds/autzen.laz"), 500_000)
    assert source.count == 10_653_336 and source.airborne
    chunk = source.read(3)
    lattice = stream_runs.lattice_of(chunk, device)
    (tmp_path / "runs").mkdir()
    stream_runs.write_run(tmp_path / "runs", 0, chunk, lattice)
    runs = stream_runs.Runs(tmp_path / "runs", lattice)
    points = runs.fetch(np.arange(len(runs.cells)), chunk.points.mean(axis=0))
    order = np.lexsort(chunk.points.T)
    found = points.position + points.origin
    assert np.abs(found[np.lexsort(np.round(found, 2).T)] - chunk.points[order]).max() < 1e-3
    assert points.colors.shape == (len(found), 4) and points.colors[:, :3].std() > 10


def test_a_small_device_builds_in_parts(device, memory_slim, hills, monkeypatch):
    scan = clsurf.load(hills)
    scan = clsurf.estimate_normals(scan, orient="up", device=device)
    monkeypatch.setattr(device, "largest_buffer_bytes", 2_000_000)
    surface = clsurf.build_slim(scan, error=0.002, device=device)
    assert np.quantile(off_ground(surface), 0.99) < 1.3 * np.quantile(off_ground(memory_slim), 0.99)
    assert surface.colors is not None and surface.bound < 1.2 * memory_slim.bound


def test_patches(hills, device, tmp_path):
    surface = clsurf.build_patches(hills, spacing=2.0, out=tmp_path / "a.clsurf", device=device)
    memory = clsurf.build_patches(hills, spacing=2.0, device=device)
    assert 0.8 < len(surface) / len(memory) < 1.8 and surface.colors is not None
    assert surface.bound < 4 * memory.bound and (surface.origin != 0).all()
    middle = ORIGIN + np.array([100, 100, 0])
    camera = clsurf.Camera.look_at(middle + np.array([0, -60, 120]), middle, (0, 0, 1), 50)
    frames = [clsurf.render(one, camera, (160, 120), device=device) for one in (surface, memory)]
    both = np.isfinite(frames[0].depth) & np.isfinite(frames[1].depth)
    assert (~np.isfinite(frames[0].depth) & np.isfinite(frames[1].depth)).mean() < 0.01
    assert np.quantile(np.abs(frames[0].depth - frames[1].depth)[both], 0.99) < 0.3
    few = clsurf.build_patches(hills, patches=200, out=tmp_path / "b.clsurf", device=device)
    assert 150 < len(few) < 300


def test_command_line(hills, device, tmp_path, capsys, monkeypatch):
    from clsurf.cli import main
    name = "intel" if "intel" in device.platform_name.lower() else "pocl"
    out = tmp_path / "a.clsurf"
    arguments = ["build", str(hills), str(out), "--memory", "1GB", "--error", "0.002", "--device", name]
    build_cell = streamed.build_cell
    monkeypatch.setattr(streamed, "build_cell", lambda *a: (_ for _ in ()).throw(KeyboardInterrupt))
    assert main(arguments) == 130
    assert "a.clsurf.part keeps what is done" in capsys.readouterr().err and not out.exists()
    monkeypatch.setattr(streamed, "build_cell", build_cell)
    assert main(arguments) == 0 and out.is_dir() and not (tmp_path / "a.clsurf.part").exists()
    assert "surfels in" in capsys.readouterr().err
    assert main(["info", str(out)]) == 0
    assert main(["build", str(hills), str(out), "--memory", "lots"]) == 2
    assert "memory_limit" in capsys.readouterr().err
