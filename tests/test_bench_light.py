"""The job `light` runs on a small model, and refuses wrong answers."""

import pytest

from bench import light as job
from bench.build import WrongAnswer
from clsurf.render import renderer


def test_quick_job(device, capsys):
    figures = job.measure(device, quick=True)
    told = capsys.readouterr().out
    assert "white spheres" in told and "coverage" in told
    assert max(figures["furnace"].values()) < 1e-3
    found = figures["edges"]["generated 500"]
    assert found["edge_pixels"] > 100 and found["coverage_rms"] < 0.25 * found["plain_rms"]
    assert set(figures["frames"]["generated 500"]) == set(job.LOOKS)
    assert figures["frames"]["generated 500"]["plain"]["times_plain"] == 1


def test_a_wrong_answer_stops_it(device, monkeypatch):
    monkeypatch.setattr(renderer, "cover_edges", lambda *_: None)
    case = job.QUICK_CASES[0]
    surface = job.built(job.scenes.scene(case.scene), 2, device)
    with pytest.raises(WrongAnswer, match="edges"):
        job.edges(device, surface, case.cameras(1)[0], (100, 100))
