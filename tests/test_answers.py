"""The jobs that stand for all kernels: they run every one, and give equal bytes every time."""

import re

import numpy as np
import pytest

import clsurf
from bench import answers, devices
from clsurf.device.sources import SIGNATURE, kernel_folder

# Kernels of tests and of what a tiny scene has no use for: coarse levels, packets of large pictures, streamed builds,
# whose own tests run them, and the viewer's.
ELSEWHERE = {"probe_frame", "probe_lanes", "probe_slim", "self_test", "select_slim", "trace_pixels", "grid_hits",
             "on_grid", "check_leaves", "cover_leaves", "pack_bytes"}
SIZE = answers.SIZES["tiny"]


@pytest.fixture(scope="module")
def made(device):
    return answers.surfaces(device, SIZE)


def test_the_jobs_run_every_kernel(device, made):
    """A new kernel that no job runs is not checked under Oclgrind: enter it here or in bench/answers."""
    kept, device.profile = device.profile, clsurf.Profile()
    try:
        answers.surfaces(device, SIZE)
        for name in answers.JOBS:
            answers.answers(device, SIZE, made, [name])
        ran = set(device.profile.seconds)
    finally:
        device.profile = kept
    there = {match[1] for path in kernel_folder().rglob("*.cl")
             for match in SIGNATURE.finditer(re.sub(r"//[^\n]*", "", path.read_text()))}
    assert there - ran == ELSEWHERE


def test_equal_bytes_every_time(device, made):
    """Builds, pictures and rays do not depend on the order in which work-items run."""
    names = ["normals", "build_slim", "build_surfels", "build_scale_map", "draw_slim", "trace", "curvature"]
    first, again = (answers.answers(device, SIZE, made, names) for _ in range(2))
    different = [key for key in first if answers.digest(first[key]) != answers.digest(again[key])]
    assert not different and len(first) > 50


def test_differences_are_counted():
    """Shares of pixels that agree: depth within a tolerance, numbers exactly, missed pixels as equal."""
    a = {"draw_slim/depth_1": np.array([[1.0, np.nan], [2.0, 3.0]]), "trace/primitive_x": np.array([1, 2, 3, 4])}
    b = {"draw_slim/depth_1": np.array([[1.0 + 1e-6, np.nan], [2.1, 3.0]]), "trace/primitive_x": np.array([1, 2, 3, 5])}
    found = devices.differences(a, b)
    assert found["depth_share"] == 0.75 and found["number_share"] == 0.75 and found["equal_arrays"] == 0
    assert devices.differences(a, a)["equal_arrays"] == 2
