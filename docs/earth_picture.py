"""Make README's picture of the Earth as patches: `python docs/earth_picture.py`."""

from pathlib import Path

import clsurf
from clsurf.render.shade import Light

surface = clsurf.models.earth(2712)
camera = clsurf.Camera.framing(surface, direction=(-1, 0.5, 1), fov=30, aspect=2)
lights = [Light("directional", (-1.2, 0.8, 0.4), (1.6, 1.55, 1.5))]
frame = clsurf.render(clsurf.Scene([surface], lights=lights), camera, size=(1024, 512), supersampling=2)
frame.save(Path(__file__).with_name("earth.png"))
