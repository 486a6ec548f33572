"""The surfel paper's figure 8 and its neighbours as pictures: `python -m bench.surfel_pictures FOLDER`.

| name | what it shows |
|---|---|
| map_sizes | figure 8: the meteoroid, surfels of up to 16 pixels radius, maps of 1 to 32 texels; none; finest level |
| equal_cost | discs with one normal as in QSplat, and SLIM surfels, that take as long as discs with maps |
| models | bunny, dragon and a coloured scan where there are any |
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import clsurf
from clsurf.io.images import to_srgb8, write_image
from clsurf.render.renderer import Renderer

from . import scenes, views

SIZE = (640, 640)
MAP_SIZES = (1, 2, 4, 8, 16, 32)
RADIUS_PX = 16.0  # of figure 8's surfels, which nothing but their size divides
FIGURES = ("map_sizes", "equal_cost", "models")
LIGHTS = (clsurf.Light("directional", (2.0, 1.5, 0.6), (0.9, 0.9, 0.9)), clsurf.Light("headlight", color=(0.15,) * 3))


class Pictures:
    """The meteoroid and its surfaces, made once."""

    def __init__(self, device, size=SIZE, faces: int = 320_000):
        self.device, self.size = device, size
        self.rock = clsurf.models.meteoroid(1, faces)
        self.camera = clsurf.Camera.framing(self.rock, (1, 0.4, 1), fov=30)
        self.renderer = Renderer(device)

    def draw(self, surface, camera=None, **options):
        """Return a frame; on average over the last 4 of 6 it took `self.seconds`."""
        scene, times = clsurf.Scene([surface], lights=LIGHTS), []
        for _ in range(6):
            start = time.perf_counter()
            frame = self.renderer.render(scene, camera or self.camera, self.size, **options)
            times.append(time.perf_counter() - start)
        self.seconds = float(np.median(times[2:]))
        return frame

    def map_sizes(self) -> dict:
        """Figure 8: what the size of the normal maps keeps of the relief."""
        found = {}
        as_paper = clsurf.SurfelDrawing(2 * RADIUS_PX, relief=np.inf)
        for size in MAP_SIZES:
            surface = clsurf.build_surfels(self.rock, map_size=size, device=self.device)
            found[f"map_sizes_{size:02d}"] = self.draw(surface, surfels=as_paper)
        found["map_sizes_none"] = self.draw(surface, surfels=replace(as_paper, maps=False))
        found["map_sizes_finest"] = self.draw(surface, lod=0.0)
        return found

    def equal_cost(self) -> dict:
        """Discs without maps as small, and SLIM surfels as fine, as take no longer than discs with maps."""
        surface = clsurf.build_surfels(self.rock, device=self.device)
        found = {"equal_cost_maps": self.draw(surface)}
        limit = self.seconds
        for interior in (4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0):
            frame = self.draw(surface, surfels=clsurf.SurfelDrawing(interior, False), lod=min(4.0, interior))
            if self.seconds <= limit or interior == 16.0:
                found[f"equal_cost_discs_{interior:g}px"] = frame
                break
        for error in (0.002, 0.004, 0.008, 0.016, 0.032):
            frame = self.draw(clsurf.build_slim(self.rock, error=error, device=self.device))
            if self.seconds <= limit or error == 0.032:
                found[f"equal_cost_slim_{error:g}"] = frame
                break
        return found

    def models(self) -> dict:
        """Real scans, as far as they are there."""
        found = {}
        for name in ("bunny", "dragon"):
            if scenes.available(name):
                scene = scenes.scene(name)
                camera = clsurf.Camera.framing(scene.box, views.direction(20, 15), fov=30)
                for label, options in (("pure", {}), ("hybrid", {"hybrid": True})):
                    surface = clsurf.build_surfels(scene.scan, device=self.device, **options)
                    found[f"models_{name}_{label}"] = self.draw(surface, camera)
        lion = scenes.data_folder() / "coloured" / "lion_takanawa.copc.laz"
        if lion.exists():
            surface = clsurf.build_surfels(lion, device=self.device)
            camera = clsurf.Camera.framing(surface, (1, -1, 0.4), 30, (0, 0, 1))
            found["models_lion"] = self.draw(surface, camera)
        return found


def main(arguments=None) -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", choices=FIGURES, default=FIGURES)
    parser.add_argument("--device")
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    pictures = Pictures(clsurf.open_device(options.device))
    for figure in options.only:
        start = time.perf_counter()
        for name, frame in getattr(pictures, figure)().items():
            write_image(options.folder / f"{name}.png", to_srgb8(frame.color, (1.0, 1.0, 1.0))[..., :3])
        print(f"{figure:<12} {time.perf_counter() - start:6.1f} s", flush=True)


if __name__ == "__main__":
    main()
