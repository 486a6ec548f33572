"""Streamed builds on a Dask cluster: equal to the build of one process, also when a worker is killed."""

import os
import signal
import warnings

import distributed
import numpy as np
import pytest
from reference.surfaces import sphere
from test_build_streamed import ground, tree_bytes, write_las

import clsurf
from clsurf.build import streamed
from clsurf.cli import main
from clsurf.errors import InputError


@pytest.fixture(scope="module")
def cluster():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as made:
            yield made


def test_killed_worker_costs_its_tasks_only(device, cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(streamed, "sizes_of", lambda limit: streamed.Sizes(8_000, 6_000, 3_000))
    path = tmp_path / "hills.las"
    write_las(path, *ground(30_000))
    whole, again = tmp_path / "whole.clsurf", tmp_path / "again.clsurf"
    clsurf.build_slim(path, error=0.003, out=whole, device=device)
    name = "intel" if "intel" in device.platform_name.lower() else "pocl"
    killed = []

    def progress(stage, done):
        if stage == "cells" and not killed:
            worker = next(iter(cluster.workers.values()))
            killed.append(worker.process.process._process.pid)
            os.kill(killed[0], signal.SIGKILL)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.Client(cluster) as client:
            surface = clsurf.build_slim(path, error=0.003, out=again, device=name, scheduler=client, progress=progress)
    assert killed and len(surface.surfels) > 4
    assert tree_bytes(whole) == tree_bytes(again)


def test_frames_of_a_path(device, cluster, tmp_path):
    name = "intel" if "intel" in device.platform_name.lower() else "pocl"
    points, _ = ground(5_000)
    surface = clsurf.build_slim(clsurf.estimate_normals(clsurf.PointCloud(points), device=device), device=device)
    clsurf.save(surface, tmp_path / "a.clsurf")
    cameras = clsurf.turntable(surface, 3, aspect=4 / 3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with distributed.Client(cluster) as client:
            frames = list(clsurf.render_frames(tmp_path / "a.clsurf", cameras, (64, 48), device=name,
                                               scheduler=client))
    expected = list(clsurf.render_frames(clsurf.load(tmp_path / "a.clsurf"), cameras, (64, 48), device=device))
    assert len(frames) == 3
    for got, wanted in zip(frames, expected, strict=True):
        assert np.array_equal(got.depth, wanted.depth, equal_nan=True) and np.array_equal(got.color, wanted.color)


def test_a_turntable_by_command(device, cluster, tmp_path, monkeypatch):
    """The workers' pictures, with lights, material and tone, are those that one process writes."""
    monkeypatch.setenv("CLSURF_DEVICE", "intel" if "intel" in device.platform_name.lower() else "pocl")
    clsurf.save(sphere(300), tmp_path / "ball.clsurf")
    looks = ["--size", "48x36", "--turntable", "3", "--sky", "studio", "--material", "gold", "--tone", "agx", "-q"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, more in (("here", []), ("there", ["--scheduler", cluster.scheduler_address,
                                                   "--device", os.environ["CLSURF_DEVICE"]])):
            assert main(["render", str(tmp_path / "ball.clsurf"), str(tmp_path / name), *looks, *more]) == 0
    here, there = (sorted((tmp_path / name).iterdir()) for name in ("here", "there"))
    assert len(here) == 3 and [path.read_bytes() for path in here] == [path.read_bytes() for path in there]


@pytest.mark.parametrize(("source", "options", "says"), [
    ("few.las", ["--turntable", "2"], "expected a surface"), ("few.las", [], "--turntable or --path"),
    ("few.las", ["--turntable", "2", "--profile"], "--profile"),
    ("ball.clsurf", ["--turntable", "2", "--scheduler", "nonsense://"], "nonsense")])
def test_mistakes_are_one_line(hills_path, tmp_path, source, options, says, capsys):
    clsurf.save(sphere(50), tmp_path / "ball.clsurf")
    assert main(["render", str(tmp_path / source), str(tmp_path / "out"), "--scheduler", "local", "-q", *options]) == 2
    said = capsys.readouterr().err.strip()
    assert says in said and "\n" not in said


def test_no_scheduler(hills_path, tmp_path):
    with pytest.raises(InputError, match="scheduler"):
        clsurf.build_slim(hills_path, out=tmp_path / "a.clsurf", scheduler="nonsense://")


@pytest.fixture
def hills_path(tmp_path):
    write_las(tmp_path / "few.las", *ground(2_000))
    return tmp_path / "few.las"
