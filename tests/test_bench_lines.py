"""The job `lines`: its distances are those of lines moved by hand; it runs on a small model."""

import numpy as np
import pytest

from bench import lines as job
from clsurf.render.camera import Camera

SIZE = (300, 300)


def test_distances_from_the_analytic_curves():
    """Seen along the axis, K = 0 is the circle of the major radius: 100 pixels."""
    angle = np.linspace(0, 6, 50)
    far = Camera.look_at((0, 0, 4000), (0, 0, 0), fov=2 * np.degrees(np.arctan(1.5 / 4000)))
    for radius in (100.0, 100.7, 97.0):
        points = 150 + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        away = job.torus_distances(points, far, SIZE, 2, "parabolic")
        assert away == pytest.approx(abs(radius - 100), abs=0.02)


def test_radial_curvature_is_that_of_a_ray_in_the_meridian_plane():
    """There the normal section is the tube's circle: 1 / minor."""
    camera = Camera.look_at((4, 0, 0), (0, 0, 0), up=(0, 0, 1), fov=40)
    points = np.array([[150.0, 150.0 + d] for d in (-20, 5, 20)])
    assert job.torus_curvature(points, camera, SIZE, 2, "suggestive_contours") == pytest.approx(2.5)


def test_quick_job(device, capsys):
    figures = job.measure(device, quick=True)
    told = capsys.readouterr().out
    assert "aim 15" in told and "floor" in told
    for kind in job.FLOORS:
        assert all(0 < of_error[kind]["mean_px"] < 1 for of_error in figures["torus"].values())
    assert figures["frames"]["line_count"] > 0 and figures["frames"]["whole"]["runs"] == 4
