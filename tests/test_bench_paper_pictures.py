"""The paper's figures as pictures: every method draws on a small model, and the strip fits its limit."""

import numpy as np
import pytest

from bench import paper_pictures, scenes
from clsurf.render.camera import Camera


@pytest.fixture
def small(monkeypatch, device):
    """Pictures of 96 pixels of a small generated mesh in place of both scans."""
    model = scenes.Scene("generated", scenes.wavy_torus(80, 36))
    monkeypatch.setattr(scenes, "scene", lambda name: model)
    pictures = paper_pictures.Pictures(device)
    monkeypatch.setattr(pictures, "camera", lambda *a, **k: Camera.framing(model.scan, (0.3, 0.8, 1), fov=30))
    draw = pictures.draw

    def reduced(surface, camera, *args, **options):
        return draw(surface, camera, *args, **options | {"size": (96, 96), "supersampling": 1})

    monkeypatch.setattr(pictures, "draw", reduced)
    return pictures


def test_every_figure_is_drawn(small):
    made = {}
    for figure in paper_pictures.FIGURES:
        found = {name: paper_pictures.pixels(frame) for name, frame in getattr(small, figure)().items()}
        assert found and all(picture.dtype == np.uint8 and picture.shape[2] == 3 for picture in found.values())
        assert all((picture < 250).any() for picture in found.values()), figure
        made |= found
    strip = paper_pictures.strip(made, height=60)
    assert strip.shape[0] == 76 and strip.shape[1] > 6 * 40 and strip.dtype == np.uint8
