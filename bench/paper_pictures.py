"""The SLIM paper's figures as pictures of bunny and dragon, to be looked at: `python -m bench.paper_pictures FOLDER`.

Also `--only NAME ...` for some of them, `--strip FILE` for README's strip of small ones.

| name | figure of paper 003 |
|---|---|
| balls | 1, 7: balls by size, the hierarchy level by level |
| reflection | 2, 17: reflection lines on linear, quadratic and cubic surfels of one T |
| splats | 22: linear splats beside quadratic surfels of as many floats |
| curvature | 12, 16: curvature by degree |
| sides | 14-16: both sides of equation 8 |
| suggestive, crest | 11, 13: suggestive contours; crest lines, ridges and valleys |
| shadows | 18: two lights with shadows, mirror reflection; ambient occlusion |
| smoothing | 19, 20: before and after |
"""

import argparse
import functools
import time
from pathlib import Path

import numpy as np

import clsurf
from clsurf.io.images import to_srgb8, write_image
from clsurf.render.shade import Light

from . import scenes, views
from .sparsity import linear_of_floats

SIZE = (1024, 1024)
FINE = 0.005  # T_MDL of what is shown
DIRECTIONS = {"bunny": views.direction(20, 15), "dragon": views.direction(20, 15)}
STRIP_HEIGHT = 260  # pixels


class Pictures:
    """Scans, surfaces and cameras by name, made once."""

    def __init__(self, device):
        self.device = device
        self.surface = functools.lru_cache(maxsize=None)(self._surface)
        self.line_surface = functools.lru_cache(maxsize=None)(
            lambda name: clsurf.line_surface(scenes.scene(name).scan, device=device))

    def _surface(self, name: str, degree: int = 2, t_mdl: float = FINE):
        return clsurf.build_slim(scenes.scene(name).scan, degree=degree, error=t_mdl, device=self.device)

    def camera(self, name: str, near: float = 1.0, target=(0.5, 0.5, 0.5)):
        """Return the camera of a scan; `near` below 1 shows that share of it around `target`, over its box."""
        box = np.asarray(scenes.scene(name).box)
        middle, half = box[0] + np.asarray(target) * (box[1] - box[0]), 0.5 * near * (box[1] - box[0])
        return clsurf.Camera.framing(np.stack([middle - half, middle + half]), DIRECTIONS[name], fov=30)

    def draw(self, surface, camera, channels=("color",), **options):
        """Return the frame of a surface."""
        return clsurf.render(surface, camera, options.pop("size", SIZE), channels=channels, device=self.device,
                             **options)

    # One method a figure: arrays (h, w, 3) uint8 by file name -------------------------------------------------------

    def balls(self) -> dict:
        """Figures 1 and 7."""
        found = {}
        for name in ("bunny", "dragon"):
            surface, camera = self.surface(name, 3, 0.01), self.camera(name)
            shading = clsurf.Shading(look="ball_size")
            found[f"balls_{name}"] = self.draw(surface, camera, shading=shading, supersampling=2)
            for level in (2, 3, 4, 5, 6):
                shading = clsurf.Shading(look="ball_level", level=level)
                found[f"balls_{name}_level{level}"] = self.draw(surface, camera, shading=shading, size=(640, 640))
        return found

    def reflection(self) -> dict:
        """Figures 2 and 17: lines across degrees, at one T."""
        shading = clsurf.Shading(look="reflection")
        found = {f"reflection_{name}_degree{degree}": self.draw(self.surface(name, degree, 0.02), self.camera(name),
                                                                shading=shading, supersampling=3)
                 for name in ("bunny", "dragon") for degree in (1, 2, 3)}
        ball = clsurf.models.sphere(20_000)
        for degree, t_mdl in ((1, 0.3), (1, 0.15), (2, 0.3)):
            surface = clsurf.build_slim(ball, degree=degree, error=t_mdl, device=self.device)
            camera = clsurf.Camera.framing(ball, (0, 0.3, 1), fov=30)
            label = f"reflection_sphere_degree{degree}_{int(surface.leaf.sum())}"
            found[label] = self.draw(surface, camera, shading=shading, supersampling=3, size=(640, 640))
        return found

    def splats(self) -> dict:
        """Figure 22: a close view of quadratic surfels, and of linear splats with as many floats and with more."""
        found = {}
        for name, near, target in (("bunny", 0.4, (0.28, 0.62, 0.6)), ("dragon", 0.3, (0.2, 0.75, 0.6))):
            quadratic, camera = self.surface(name, 2, 0.01), self.camera(name, near, target)
            equal = linear_of_floats(scenes.scene(name).scan, 12 * int(quadratic.leaf.sum()), self.device)
            for label, surface in (("quadratic", quadratic), ("linear_equal", equal),
                                   ("linear_finer", self.surface(name, 1, 0.002))):
                found[f"splats_{name}_{label}"] = self.draw(surface, camera, supersampling=2)
        return found

    def curvature(self) -> dict:
        """Figures 12 and 16: mean and largest curvature on quadratic and cubic surfels."""
        found = {}
        for name in ("bunny", "dragon"):
            detail = 25 if name == "bunny" else 80  # over the diagonal: the same scale for both degrees
            limits = {"mean": detail / scenes.scene(name).diagonal, "k1": 1.6 * detail / scenes.scene(name).diagonal}
            for degree in (2, 3):
                frame = self.draw(self.surface(name, degree, 0.01), self.camera(name), size=(2048, 2048),
                                  channels=("color", "normal", "mean", "k1"))
                for channel, most in limits.items():
                    found[f"curvature_{name}_{channel}_degree{degree}"] = clsurf.color_map(
                        frame, channel, limit=most, legend=degree == 2, reduce=2)
        return found

    def sides(self) -> dict:
        """Figures 14 to 16: derivatives of the surfels blended, and those of the blended function."""
        found = {}
        for derivatives in ("separate", "function"):
            frame = self.draw(self.surface("bunny", 2, 0.02), self.camera("bunny"), size=(2048, 2048),
                              channels=("color", "normal", "mean"), slim=clsurf.SlimDrawing(derivatives=derivatives))
            found[f"sides_shaded_{derivatives}"] = frame
            found[f"sides_mean_{derivatives}"] = clsurf.color_map(frame, "mean", reduce=2,
                                                                  limit=25 / scenes.scene("bunny").diagonal)
        return found

    def _lined(self, name, kinds, on=None):
        camera = self.camera(name)
        coarse = self.draw(self.line_surface(name), camera, channels=clsurf.line_channels(kinds), lod=0)
        fine = self.draw(self.surface(name, 2, FINE), camera, channels=("color", "depth", "normal"),
                         **({} if on is None else {"shading": on}))
        found = clsurf.lines(coarse, ("contours", *kinds), silhouette=fine, device=self.device)
        return found.draw(on=fine if on is not None else None)

    def suggestive(self) -> dict:
        """Figures 11 and 13: contours and suggestive contours on white, and over the shaded surface."""
        pale = clsurf.Shading(color=(0.95, 0.94, 0.92), ambient=0.45, diffuse=0.55, specular=0.0)
        return {f"suggestive_{name}_{what}": self._lined(name, ("suggestive_contours",), on)
                for name in ("bunny", "dragon") for what, on in (("white", None), ("shaded", pale))}

    def crest(self) -> dict:
        """Figures 12 and 13: crest lines on white; ridges blue and valleys red over the shaded surface."""
        pale = clsurf.Shading(color=(0.95, 0.94, 0.92), ambient=0.45, diffuse=0.55, specular=0.0)
        return {f"{'crest' if on is None else 'ridges'}_{name}": self._lined(name, kinds, on)
                for name in ("bunny", "dragon") for kinds, on in ((("crest",), None), (("ridges", "valleys"), pale))}

    def shadows(self) -> dict:
        """Figure 18: two lights with hard shadows, with and without a mirrored share; ambient occlusion."""
        lights = [Light("directional", (-0.8, 1.2, 0.9), (0.75, 0.72, 0.66)),
                  Light("directional", (1.4, 0.7, 0.5), (0.35, 0.40, 0.48))]
        found = {}
        for name in ("bunny", "dragon"):
            scene = clsurf.Scene([self.surface(name, 3, 0.01)], lights=lights)
            found[f"shadows_{name}"] = self.draw(scene, self.camera(name), supersampling=2,
                                                 shading=clsurf.Shading(shadows=True))
            found[f"mirror_{name}"] = self.draw(scene, self.camera(name), supersampling=2,
                                                shading=clsurf.Shading(shadows=True, mirror=0.4))
            found[f"occlusion_{name}"] = self.draw(scene, self.camera(name), supersampling=2,
                                                   shading=clsurf.Shading(occlusion=128, ambient=0.8, diffuse=0.1))
        return found

    def smoothing(self) -> dict:
        """Figures 19 and 20: a mesh with noise, smoothed, both drawn as fine quadratic surfels."""
        found = {}
        for name in ("bunny", "dragon"):
            scan = scenes.scene(name).scan
            noise = np.random.default_rng(0).normal(scale=0.002 if name == "bunny" else 0.0005,
                                                    size=(len(scan.vertices), 1)) * scenes.scene(name).diagonal
            noisy = clsurf.Mesh(scan.vertices + (noise * scan.normals).astype(np.float32), scan.faces,
                                origin=scan.origin)
            for label, mesh in (("noisy", noisy), ("smoothed", clsurf.smooth(noisy, device=self.device))):
                surface = clsurf.build_slim(clsurf.Mesh(mesh.vertices, mesh.faces, origin=mesh.origin), error=0.003,
                                            device=self.device)
                found[f"smoothing_{name}_{label}"] = self.draw(surface, self.camera(name), supersampling=2)
        return found


FIGURES = ("balls", "reflection", "splats", "curvature", "sides", "suggestive", "crest", "shadows", "smoothing")
# README's strip: one picture of each kind.
STRIP = ("balls_bunny", "reflection_bunny_degree3", "curvature_dragon_mean_degree3", "suggestive_dragon_white",
         "ridges_bunny", "shadows_dragon")


def pixels(frame) -> np.ndarray:
    """Return a frame's colour (h, w, 3) uint8 on white."""
    return to_srgb8(frame.color, (1.0, 1.0, 1.0))[..., :3]


def strip(pictures: dict, height: int = STRIP_HEIGHT) -> np.ndarray:
    """Return the pictures of `STRIP` side by side, cropped to what they show and reduced to `height`."""
    from scipy import ndimage
    from skimage.transform import resize
    parts = []
    for name in STRIP:
        picture = pictures[name].copy()
        pieces, _ = ndimage.label(ndimage.binary_dilation((picture < 250).any(axis=2), iterations=3))
        largest = pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:])  # without what floats
        picture[~largest] = 255
        rows, columns = np.flatnonzero(largest.any(axis=1)), np.flatnonzero(largest.any(axis=0))
        part = picture[rows[0]:rows[-1] + 1, columns[0]:columns[-1] + 1]
        scale = min(height / part.shape[0], 1.15 * height / part.shape[1])
        part = resize(part, (round(part.shape[0] * scale), round(part.shape[1] * scale)), anti_aliasing=True,
                      preserve_range=True)
        above = height - part.shape[0]
        parts.append(np.pad(part, ((8 + above // 2, 8 + above - above // 2), (8, 8), (0, 0)), constant_values=255))
    return np.concatenate(parts, axis=1).round().astype(np.uint8)


def main(arguments=None) -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", choices=FIGURES, default=FIGURES)
    parser.add_argument("--strip", type=Path)
    parser.add_argument("--device")
    options = parser.parse_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    made, pictures = {}, Pictures(clsurf.open_device(options.device))
    for figure in options.only:
        start = time.perf_counter()
        for name, frame in getattr(pictures, figure)().items():
            made[name] = pixels(frame)
            write_image(options.folder / f"{name}.png", made[name])
        print(f"{figure:<12} {time.perf_counter() - start:6.1f} s", flush=True)
    if options.strip:
        write_image(options.strip, strip(made))


if __name__ == "__main__":
    main()
