"""The study of sparsity: errors rise and leaves fall with T_MDL, higher degrees need fewer, targets are kept."""

import math

import numpy as np
import pytest

from clsurf import models
from clsurf.analysis.error import error
from clsurf.analysis.sparsity import slim_of_error, sparsity
from clsurf.errors import Cancelled, InputError
from clsurf.surface.cloud import PointCloud
from clsurf.surface.slim import FLOATS


@pytest.fixture(scope="module")
def scan():
    return models.torus(6000)


@pytest.fixture(scope="module")
def study(scan, device):
    return sparsity(scan, target=1e-4, curve=(0.005, 0.02, 0.08), device=device)


def test_study_is_monotone(study):
    for degree, curve in study.curves.items():
        assert [one.t_mdl for one in curve] == [0.005, 0.02, 0.08]
        assert all(one.degree == degree and one.floats == FLOATS[degree] * one.leaves for one in curve)
        assert np.all(np.diff([one.rms for one in curve]) > 0) and np.all(np.diff([one.leaves for one in curve]) < 0)
        assert all(one.rms < one.p99 for one in curve)
    for fine in range(3):
        assert study.curves[1][fine].rms > study.curves[2][fine].rms > study.curves[3][fine].rms


def test_targets_are_kept(study, scan, device):
    assert all(found.rms <= study.target for found in study.needed.values())
    for degree in (1, 2):  # the largest cubic balls keep it by far
        assert study.needed[degree].rms > 0.97 * study.target
    linear, quadratic, cubic = (study.needed[degree].leaves for degree in (1, 2, 3))
    assert cubic < quadratic < linear
    assert study.ratio(2, 1) == quadratic / linear < 0.5
    surface, found = slim_of_error(scan, study.target, 2, device=device)
    assert surface.leaf.sum() == found.leaves and found.leaves == pytest.approx(quadratic, rel=0.05)
    assert error(surface, scan, device=device).relative.rms == pytest.approx(found.rms)


def test_table_says_all(study):
    lines = study.table().splitlines()
    assert len(lines) == 1 + 3 * 4 + 1 and sum(line.endswith("*") for line in lines) == 3
    assert f"{study.needed[2].leaves:,}" in study.table()


def test_target_out_of_reach(device):
    noisy = models.sphere(600)
    cloud = PointCloud(noisy.points + np.random.default_rng(0).normal(scale=0.02, size=(600, 3)), normals=noisy.normals)
    found = sparsity(cloud, target=1e-6, degrees=(2,), curve=(), device=device)
    assert found.needed == {2: None} and math.isnan(found.ratio(2, 1)) and "no surface" in found.table()
    with pytest.raises(InputError, match="noise"):
        slim_of_error(cloud, 1e-6, device=device)


@pytest.mark.parametrize(("options", "says"), [({"target": 0}, "target"), ({"degrees": (4,)}, "degrees"),
                                               ({"degrees": ()}, "degrees")])
def test_sparsity_refuses(options, says, device):
    with pytest.raises(InputError, match=says):
        sparsity(models.sphere(100), device=device, **options)


def test_sparsity_stops_when_told_to(device):
    with pytest.raises(Cancelled):
        sparsity(models.sphere(100), progress=lambda stage, done: False, device=device)
