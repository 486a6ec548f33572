"""The job `channels`: its errors are those of curvature changed by hand; it runs on a small model."""

import numpy as np
import pytest

from bench import channels as job
from clsurf.render.frame import Frame


def exact_frame(mean=1.0, gaussian=1.0):
    """Places around the tube of the torus with their curvature, times the factors given."""
    angle = np.linspace(-3, 3, 60, dtype=np.float32).reshape(6, 10)
    ring = job.MAJOR + job.MINOR * np.cos(angle)
    place = np.stack([ring, np.zeros_like(ring), job.MINOR * np.sin(angle)], axis=-1)
    k2 = np.cos(angle) / ring
    return Frame({"position": place, "mean": mean * (2.5 + k2) / 2, "gaussian": gaussian * 2.5 * k2})


def test_errors_are_relative():
    assert max(job.torus_errors(exact_frame()).values()) < 1e-5
    found = job.torus_errors(exact_frame(1.01, 0.9))
    assert found["mean"] == pytest.approx(0.01, rel=1e-3) and found["gaussian"] == pytest.approx(0.1, rel=1e-3)


def test_quick_job(device, capsys):
    figures = job.measure(device, quick=True)
    told = capsys.readouterr().out
    assert "aim 1.20" in told and "order of mean" in told
    assert all(row["separate_mean"] < 0.1 for row in figures["torus"]) and len(figures["torus"]) == 2
    for found in figures["frames"].values():
        assert found["plain"]["times_plain"] == 1 and found["mean, gaussian"]["runs"] == 8
    assert "all" in figures["frames"]["generated 500 cubic"] and "all" not in figures["frames"]["generated 500"]
