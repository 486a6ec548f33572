"""The job `instances` on a small model: ten placements share what one takes, and copies of the model are found out."""

import numpy as np
import pytest

from bench import instances as job
from bench.build import WrongAnswer
from clsurf.device import open_device
from clsurf.io.dispatch import save
from clsurf.models.basic import sphere
from clsurf.render.scene import Scene


@pytest.fixture
def one_kind(monkeypatch):
    """A cloud alone, drawn in this process."""
    monkeypatch.setattr(job, "KINDS", {"cloud": lambda scene, device: sphere(200_000)})
    monkeypatch.setattr(job, "_child", lambda path, count, selector: _drawn(path, count, selector))
    monkeypatch.setattr(job, "SIZE", (96, 72))


def _drawn(path, count, selector):
    device = open_device(selector)
    try:
        return job.drawn(path, count, selector)
    finally:
        for name in ("empty", "upload"):
            device.__dict__.pop(name, None)


def test_quick_job(device, one_kind, capsys):
    found, = job.measure(device, quick=True).values()
    assert found["1"]["device_bytes"] > 200_000 * 28 and found["device_times"] <= 1.15
    assert "times" in capsys.readouterr().out


def test_copies_that_share_nothing_stop_it(device, one_kind, monkeypatch, tmp_path):
    save(sphere(10), tmp_path / "cloud.ply")

    class Copies(Scene):
        def __init__(self, surfaces):
            super().__init__([s if not hasattr(s, "surface") else sphere(20_000).moved(s.matrix) for s in surfaces])
    monkeypatch.setattr("clsurf.render.scene.Scene", Copies)
    with pytest.raises(WrongAnswer, match=r"at most 1\.15 times"):
        job.measure(device, quick=True)


def test_places_are_side_by_side():
    box = np.array([[0, 0, 0], [1, 2, 3.0]])
    at = np.array([m[:3, 3] for m in job.places(box, 10)])
    assert len(np.unique(at, axis=0)) == 10 and np.ptp(at[:, 0]) == pytest.approx(4.4) and (at[:, 1] == 0).all()
