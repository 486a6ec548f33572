"""Make README's picture: `python docs/demo_picture.py`."""

from pathlib import Path

import clsurf

surface = clsurf.build_slim(clsurf.models.demo_scan(), error=0.003)
camera = clsurf.Camera.framing(surface, direction=(1, 0.7, 2.2), fov=30, aspect=4 / 3)
clsurf.render(surface, camera, size=(1024, 768)).save(Path(__file__).with_name("demo.png"))
