"""The job `trace` runs on a small generated scene, and refuses wrong answers."""

import numpy as np
import pytest

import bench
from bench import scenes, trace
from bench.build import WrongAnswer


def test_the_job_runs(device, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(scenes, "wavy_torus", lambda: torus)
    torus = small_torus()
    scenes.scene.cache_clear()
    try:
        found = bench.run("trace", device, tmp_path / "figures.json", quick=True, profile=True)["figures"]["generated"]
    finally:
        scenes.scene.cache_clear()
    assert found["primary"]["pixels_that_differ"] < 1e-3
    for what in ("primary", "shadows", "occlusion", "single", "bounced"):
        assert found[what]["mrays_s"] > 0 and found[what]["rays"] > 1000
    assert found["frame"]["ms"] > 0 and found["single"]["hits"] > 0.97 and found["single"]["kernel"]["mrays_s"] > 0
    said = capsys.readouterr().out
    assert "generated, shadows" in said and "ray_slim" in said


def small_torus():
    """The generated scene with fewer vertices."""
    return wavy(120, 45)


wavy = scenes.wavy_torus


def test_rays_meet_their_targets():
    scene = scenes.Scene("small", small_torus())
    origins, directions, targets = trace.arbitrary_rays(scene, 100)
    assert np.linalg.norm(np.cross(targets - origins, directions), axis=1).max() < 1e-9
    assert (np.linalg.norm(origins - scene.box.mean(axis=0), axis=1) > 0.59 * scene.diagonal).all()


def test_bounced_rays_leave_the_surface(device):
    import clsurf
    surface = clsurf.build_slim(small_torus(), device=device)
    origins, directions = trace.bounced_rays(surface, device, (40, 30))
    near = clsurf.project(surface, origins, device=device)
    assert np.median(near.distance) == pytest.approx(max(1e-3 * surface.diagonal, 2 * surface.bound), rel=0.02)
    assert ((near.normal * directions).sum(axis=1) > 0).mean() > 0.97 and len(origins) > 200


def test_hits_beside_the_scan_are_a_wrong_answer(device):
    import clsurf
    scene = scenes.Scene("small", small_torus())
    shifted = np.eye(4)
    shifted[0, 3] = 0.05 * scene.diagonal
    surface = clsurf.build_slim(scene.scan, device=device).moved(shifted)
    with pytest.raises(WrongAnswer, match="where the scan is"):
        trace.single(scene, surface, device, 500, 1, with_peer=False)
