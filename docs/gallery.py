"""Make the gallery: `python docs/gallery.py`, or `python docs/gallery.py --quick OUT` for pictures of 64 pixels.

Every function below is one picture: its docstring is the caption, its text the code that docs/gallery.md shows.
"""

import argparse
import inspect
import textwrap
from pathlib import Path

import numpy as np

import clsurf

SIZE, QUICK = (288, 216), (64, 48)  # at 320x240 some pictures are over 60 KB

HEAD = """# Gallery

Every picture is made by `python docs/gallery.py` from models that clsurf generates; the code beside it is the code that
ran, after

```python
import clsurf
import numpy as np
size = (288, 216)
```
"""


def amphora(size):
    """SLIM surface: a scan of 60,000 coloured points as overlapping balls of degree 2."""
    scan = clsurf.models.demo_scan(60_000)
    slim = clsurf.build_slim(scan, error=0.003)
    camera = clsurf.Camera.framing(slim, direction=(1, 0.7, 2.2), aspect=4 / 3)
    frame = clsurf.render(slim, camera, size=size, antialias="coverage")
    return frame


def points(size):
    """The scan itself: a cloud without normals, discs that close its gaps, eye-dome lighting."""
    scan = clsurf.models.demo_scan(60_000)
    bare = clsurf.PointCloud(scan.points, colors=scan.colors)
    camera = clsurf.Camera.framing(bare, direction=(1, 0.7, 2.2), aspect=4 / 3)
    frame = clsurf.render(bare, camera, size=size, supersampling=2)
    return frame


def cut(size):
    """A clip plane takes the front half away; what is seen are the inner sides of the back."""
    slim = clsurf.build_slim(clsurf.models.demo_scan(60_000), error=0.003)
    camera = clsurf.Camera.framing(slim, direction=(0.3, 0.9, 2), aspect=4 / 3)
    frame = clsurf.render(slim, camera, size=size, clip=(0, 0, -1, 0), antialias="coverage")
    return frame


def balls(size):
    """What a SLIM surface is made of: the balls of its leaves, coloured by size; large where the shape is plain."""
    slim = clsurf.build_slim(clsurf.models.demo_scan(60_000), error=0.02)
    camera = clsurf.Camera.framing(slim, direction=(1, 0.7, 2.2), aspect=4 / 3)
    frame = clsurf.render(slim, camera, size=size, shading="ball_size", supersampling=2)
    return frame


def curvature(size):
    """Gaussian curvature at every pixel of a torus, with its scale: positive outside, negative in the hole."""
    slim = clsurf.build_slim(clsurf.models.torus(20_000), degree=3, error=0.003)
    camera = clsurf.Camera.framing(slim, direction=(0.5, -1, 1.2), up=(0, 0, 1), aspect=4 / 3, margin=1.4)
    frame = clsurf.render(slim, camera, size=size, channels=("color", "normal", "gaussian"))
    frame = clsurf.color_map(frame, "gaussian", legend=size[0] > 200)
    return frame


def reflection(size):
    """Reflection lines: breaks in them are breaks of the normal."""
    slim = clsurf.build_slim(clsurf.models.torus(20_000), degree=3, error=0.003)
    camera = clsurf.Camera.framing(slim, direction=(0.5, -1, 1.2), up=(0, 0, 1), aspect=4 / 3)
    frame = clsurf.render(slim, camera, size=size, shading="reflection", supersampling=3)
    return frame


def lines(size):
    """Contours, suggestive contours and ridges of a rock, found at every pixel and drawn as strokes."""
    slim = clsurf.line_surface(clsurf.models.meteoroid(seed=4, faces=40_000))
    camera = clsurf.Camera.framing(slim, direction=(1, 0.5, 2), aspect=4 / 3)
    kinds = ("contours", "suggestive_contours", "ridges")
    frame = clsurf.render(slim, camera, size=size, channels=("color", *clsurf.line_channels(kinds)))
    frame = clsurf.lines(frame, kinds).draw(frame)
    return frame


def earth(size):
    """Spatial patches: a made-up Earth of 383 patches of 17 x 17 nodes, 4 bytes a node."""
    patches = clsurf.models.earth(383)
    camera = clsurf.Camera.framing(patches, direction=(-1, 0.5, 1), aspect=4 / 3)
    sun = clsurf.Light("directional", (-1.2, 0.8, 0.4), (1.6, 1.55, 1.5))
    frame = clsurf.render(clsurf.Scene([patches], lights=[sun]), camera, size=size, antialias="coverage")
    return frame


def patch_normals(size):
    """A rock's mesh as 300 patches, coloured by normal."""
    patches = clsurf.build_patches(clsurf.models.meteoroid(seed=4, faces=40_000), patches=300)
    camera = clsurf.Camera.framing(patches, direction=(1, 0.5, 2), aspect=4 / 3)
    frame = clsurf.render(patches, camera, size=size, shading="normal", antialias="coverage")
    return frame


def surfels(size):
    """Surfels with normal maps: discs up to 16 pixels wide, their relief kept in maps of 16 x 16 texels."""
    hierarchy = clsurf.build_surfels(clsurf.models.meteoroid(seed=4, faces=80_000))
    camera = clsurf.Camera.framing(hierarchy, direction=(1, 0.5, 2), aspect=4 / 3)
    frame = clsurf.render(hierarchy, camera, size=size, surfels=clsurf.SurfelDrawing(interior=16),
                          antialias="coverage")
    return frame


def scale_map(size):
    """A spherical scale map: the same rock as six squares of 96 x 96 distances from its centre."""
    rock = clsurf.models.meteoroid(seed=4, faces=80_000)
    mapped = clsurf.build_scale_map(rock, size=96, bits=16)
    camera = clsurf.Camera.framing(mapped, direction=(1, 0.5, 2), aspect=4 / 3)
    frame = clsurf.render(mapped, camera, size=size, antialias="coverage")
    return frame


def morph(size):
    """From an ellipsoid to a rock: scale maps blended direction by direction."""
    rock = clsurf.models.meteoroid(seed=4, faces=40_000)
    ellipsoid = clsurf.build_slim(clsurf.models.ellipsoid(10_000, (1.3, 0.7, 0.9)))
    place = np.eye(4)
    shapes = []
    for t in (0.0, 0.35, 0.7, 1.0):
        place[0, 3] = 7 * t
        shapes.append(clsurf.morph(ellipsoid, rock, t).moved(place.copy()))
    camera = clsurf.Camera.framing(clsurf.Scene(shapes), direction=(0, 0.4, 2), aspect=4 / 3)
    frame = clsurf.render(shapes, camera, size=size, antialias="coverage")
    return frame


def kinds(size):
    """Four kinds of surfaces in one z-buffer: SLIM, patches, surfels and a scale map cut through each other."""
    ball = clsurf.models.sphere(10_000)
    four = [clsurf.build_slim(ball), clsurf.models.perfect_sphere(200, radius=1.0), clsurf.build_surfels(ball),
            clsurf.build_scale_map(clsurf.build_slim(ball), size=64, bits=16)]
    colors = [(0.85, 0.45, 0.35), (0.45, 0.65, 0.85), (0.55, 0.75, 0.45), (0.85, 0.75, 0.40)]
    places = np.tile(np.eye(4), (4, 1, 1))
    places[:, :3, 3] = (-1.2, 0.6, 0), (0.0, -0.6, 0.4), (1.2, 0.6, 0), (0.0, 0.9, -0.6)
    scene = clsurf.Scene([surface.moved(place) for surface, place in zip(four, places, strict=True)],
                         materials=[clsurf.Material(color=color) for color in colors])
    camera = clsurf.Camera.framing(scene, direction=(0.2, 0.3, 2), aspect=4 / 3)
    frame = clsurf.render(scene, camera, size=size, antialias="coverage")
    return frame


def shadows(size):
    """Hard shadows and ambient occlusion by the tracer, on a mesh of two triangles."""
    slim = clsurf.build_slim(clsurf.models.demo_scan(60_000), error=0.003)
    corners = np.array([[-40, 0, -40], [-40, 0, 40], [40, 0, 40], [40, 0, -40]], np.float32)
    ground = clsurf.Mesh(corners, [[0, 1, 2], [0, 2, 3]])
    lights = [clsurf.Light("directional", (1.5, 2, 1)), clsurf.Light("headlight", intensity=0.2)]
    camera = clsurf.Camera.framing(slim, direction=(1, 1.2, 2.2), aspect=4 / 3, margin=1.2)
    frame = clsurf.render(clsurf.Scene([slim, ground], lights=lights), camera, size=size, antialias="coverage",
                          shading=clsurf.Shading(shadows=True, occlusion=64, occlusion_reach=0.3, ambient=0.4))
    return frame


def materials(size):
    """Physical materials under a picture of a studio: gold, red plastic, brushed steel."""
    torus = clsurf.build_slim(clsurf.models.torus(20_000), degree=3, error=0.003)
    place = np.eye(4)
    three = []
    for x in (-2.9, 0.0, 2.9):
        place[0, 3] = x
        three.append(torus.moved(place.copy()))
    looks = [clsurf.Material("physical", (1.0, 0.84, 0.45), metallic=1.0, roughness=0.2),
             clsurf.Material("physical", (0.75, 0.08, 0.06), roughness=0.3),
             clsurf.Material("physical", (0.78, 0.79, 0.80), metallic=1.0, roughness=0.5)]
    scene = clsurf.Scene(three, lights=clsurf.Light("image", picture="studio"), materials=looks)
    camera = clsurf.Camera.framing(scene, direction=(0.4, 0.9, 2), aspect=4 / 3)
    frame = clsurf.render(scene, camera, size=size, background=((0.25, 0.27, 0.30), (0.70, 0.72, 0.75)),
                          antialias="coverage")
    return frame


def matcap(size):
    """A matcap: each direction of the normal looks as on a picture of a lit sphere, here jade."""
    rock = clsurf.build_slim(clsurf.models.meteoroid(seed=4, faces=80_000), error=0.005)
    camera = clsurf.Camera.framing(rock, direction=(1, 0.5, 2), aspect=4 / 3)
    jade = clsurf.Material("matcap", matcap="jade")
    frame = clsurf.render(clsurf.Scene([rock], materials=jade), camera, size=size, antialias="coverage")
    return frame


def smooth(size):
    """A torus with noise of 1 % of its radius, and the same after `clsurf.smooth`."""
    u, v = np.meshgrid(np.arange(160), np.arange(80), indexing="ij")
    ring = 1 + 0.4 * np.cos(2 * np.pi * v / 80)
    torus = np.stack([ring * np.cos(2 * np.pi * u / 160), ring * np.sin(2 * np.pi * u / 160),
                      0.4 * np.sin(2 * np.pi * v / 80)], axis=-1).reshape(-1, 3)
    near, far = u * 80 + v, (u + 1) % 160 * 80 + v
    next_near, next_far = u * 80 + (v + 1) % 80, (u + 1) % 160 * 80 + (v + 1) % 80
    faces = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3)
                            for corners in ((near, far, next_far), (near, next_far, next_near))])
    noisy = clsurf.Mesh(torus + np.random.default_rng(0).normal(0, 0.01, torus.shape), faces)
    clean = clsurf.smooth(noisy)
    right = np.eye(4)
    right[0, 3] = 3.0
    both = [noisy, clean.moved(right)]
    camera = clsurf.Camera.framing(clsurf.Scene(both), direction=(0, -1, 1.5), up=(0, 0, 1), aspect=4 / 3)
    frame = clsurf.render(both, camera, size=size, supersampling=2)
    return frame


PICTURES = (amphora, points, cut, balls, curvature, reflection, lines, earth, patch_normals, surfels, scale_map, morph,
            kinds, shadows, materials, matcap, smooth)


def page() -> str:
    """Return gallery.md."""
    parts = [HEAD]
    for picture in PICTURES:
        title = picture.__name__.replace("_", " ").capitalize()
        lines = inspect.getsource(picture).splitlines()
        body = textwrap.dedent("\n".join(lines[2:])).replace("return frame", f'frame.save("{picture.__name__}.png")')
        parts.append(f"## {title}\n\n![{title}](gallery/{picture.__name__}.png)\n\n{picture.__doc__}\n\n"
                     f"```python\n{body}\n```\n")
    return "\n".join(parts)


def main() -> None:
    """Write the pictures, and, unless quick, the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", metavar="OUT", type=Path, help="pictures of 64 pixels, into the folder OUT")
    parser.add_argument("names", nargs="*", help="only these")
    options = parser.parse_args()
    docs = Path(__file__).parent
    folder, size = (options.quick, QUICK) if options.quick else (docs / "gallery", SIZE)
    folder.mkdir(parents=True, exist_ok=True)
    for picture in PICTURES:
        if not options.names or picture.__name__ in options.names:
            picture(size).save(folder / f"{picture.__name__}.png")
    if not options.quick:
        (docs / "gallery.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
