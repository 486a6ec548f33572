"""The jobs that stand for all kernels: they run every one, and give equal bytes every time."""

import os
import re
import subprocess
import sys
import weakref

import numpy as np
import pytest

import clsurf
from bench import answers, devices
from clsurf.device import context
from clsurf.device.program import Kernel
from clsurf.device.sources import SIGNATURE, kernel_folder

SIZE = answers.SIZES["tiny"]


@pytest.fixture(scope="module")
def made(device):
    return answers.surfaces(device, SIZE)


def test_the_jobs_run_every_kernel(device, made):
    """A new kernel that no job runs is not checked under Oclgrind: enter it here or in bench/answers."""
    kept, device.profile = device.profile, clsurf.Profile()
    try:
        for name in answers.JOBS:
            answers.answers(device, SIZE, made, [name])
        ran = set(device.profile.seconds)
    finally:
        device.profile = kept
    there = {match[1] for path in kernel_folder().rglob("*.cl")
             for match in SIGNATURE.finditer(re.sub(r"//[^\n]*", "", path.read_text()))}
    assert there == ran


def test_equal_bytes_every_time(device, made):
    """Builds, pictures and rays do not depend on the order in which work-items run."""
    names = ["normals", "build_slim", "build_surfels", "build_scale_map", "draw_slim", "trace", "curvature"]
    first, again = (answers.answers(device, SIZE, made, names) for _ in range(2))
    different = [key for key in first if answers.digest(first[key]) != answers.digest(again[key])]
    assert not different and len(first) > 50


def test_equal_bytes_for_every_size_of_groups(device, made, monkeypatch):
    """Where a kernel does not share local memory, the size of its work-groups is the host's free choice."""
    make, launch, free, changed = context.make_kernel, Kernel._launch, weakref.WeakSet(), set()

    def noted(opened, program, text, name):
        kernel = make(opened, program, text, name)
        if not re.search("get_local_|get_group_|barrier|reqd_work_group", re.sub(r"//[^\n]*", "", text)):
            free.add(kernel)
        return kernel

    def other(self, global_size, local_size, arguments):
        if self in free and len(global_size) == 1:
            wanted = next(size for size in ((4, 3, 2, 5, 7, 1) if local_size[0] == 1 else (16, 8, 4, 2, 1))
                          if global_size[0] % size == 0)
            changed.update([self.label] * (wanted != local_size[0]))
            local_size = (wanted,)
        launch(self, global_size, local_size, arguments)

    names = ["normals", "trace"]
    usual = answers.answers(device, SIZE, made, names)
    monkeypatch.setattr(context, "make_kernel", noted)
    monkeypatch.setattr(Kernel, "_launch", other)
    opened = context.Device(device.cl_device)
    found = answers.answers(opened, SIZE, made, names)
    assert {"start_rays", "finish_rays", "knn_nodes"} <= changed  # global sizes of others are odd here
    assert [key for key in usual if answers.digest(usual[key]) != answers.digest(found[key])] == []


THREADS = """
import sys
import clsurf
from bench import answers
device, size = clsurf.open_device("pocl"), answers.SIZES["tiny"]
made = answers.load_surfaces(sys.argv[1])
found = answers.answers(device, size, made, ["normals", "build_slim", "trace"])
print(device.units, *(f"{key}={answers.digest(found[key])}" for key in sorted(found)))
"""


def test_equal_bytes_for_every_number_of_threads(made, tmp_path):
    """PoCL with one thread and with several: which thread takes which work-item decides nothing."""
    answers.save_surfaces(tmp_path, made)
    said = []
    for threads in ("1", "2", "5"):
        done = subprocess.run([sys.executable, "-c", THREADS, str(tmp_path)], capture_output=True, text=True,
                              timeout=600, env={**os.environ, "POCL_MAX_PTHREAD_COUNT": threads,
                                                "PYTHONPATH": os.pathsep.join(["", *sys.path])})
        assert done.returncode == 0, done.stderr
        said.append(done.stdout.split())
    assert len({words[0] for words in said}) > 1  # the driver did as it was told
    assert said[0][1:] == said[1][1:] == said[2][1:] and len(said[0]) > 20


def test_differences_are_counted():
    """Shares of pixels that agree: depth within a tolerance, numbers exactly, missed pixels as equal."""
    a = {"draw_slim/depth_1": np.array([[1.0, np.nan], [2.0, 3.0]]), "trace/primitive_x": np.array([1, 2, 3, 4])}
    b = {"draw_slim/depth_1": np.array([[1.0 + 1e-6, np.nan], [2.1, 3.0]]), "trace/primitive_x": np.array([1, 2, 3, 5])}
    found = devices.differences(a, b)
    assert found["depth_share"] == 0.75 and found["number_share"] == 0.75 and found["equal_arrays"] == 0
    assert devices.differences(a, a)["equal_arrays"] == 2
