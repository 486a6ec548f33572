"""An analytic sphere in all four representations at once: depths agree within the bounds that the surfaces state."""

import itertools

import numpy as np
import pytest
from test_render_triangles import globe

import clsurf
from clsurf.models.basic import sphere
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.renderer import Renderer

SIZE = (160, 120)
DIAGONAL = 2 * np.sqrt(3)  # of the unit sphere's box
CAMERA = clsurf.Camera.look_at((2.5, 1.1, 1.7), (0, 0, 0), fov=42)
# No node drawn as a pixel, which puts it up to half a pixel aside.
EXACT = PatchDrawing(direct=False, mip=False)
FINE = 320  # facets around the scale map's mesh, the one scan that is not on the sphere itself
SAG = 1 - np.cos(np.pi / FINE) ** 2
BEYOND = 1.5  # times their bounds that all pixels keep, where the bound is of a share of the scan's points


@pytest.fixture(scope="module")
def spheres(device):
    """(surface, its stated bound and what its scan is off the sphere) by kind."""
    cloud = sphere(20_000)
    made = {"slim": clsurf.build_slim(cloud, error=0.0003, device=device),
            "patches": clsurf.build_patches(cloud, device=device),
            "surfels": clsurf.build_surfels(cloud, device=device),
            "scale map": clsurf.build_scale_map(globe(FINE // 2, FINE), bits=16, device=device)}
    return {name: (surface, surface.bound + SAG * (name == "scale map")) for name, surface in made.items()}


def entry(radius):
    """Depth (h, w) at which the rays of the picture enter spheres of this radius, or where they come nearest."""
    origins, directions = CAMERA.rays(SIZE)
    middle = -(origins * directions).sum(axis=1)
    closest2 = ((origins + middle[:, None] * directions) ** 2).sum(axis=1)
    t = middle - np.sqrt(np.maximum(radius**2 - closest2, 0))
    return (t * -(directions @ CAMERA.rotation[2])).reshape(SIZE[::-1])


def rim(radius):
    """Whether the rays (h, w) pass the centre within this radius."""
    origins, directions = CAMERA.rays(SIZE)
    away = origins - (origins * directions).sum(axis=1, keepdims=True) * directions
    return (np.linalg.norm(away, axis=1) < radius).reshape(SIZE[::-1])


@pytest.mark.parametrize("lanes", (16, 1))
def test_depths_agree_within_the_sum_of_stated_bounds(device, spheres, lanes):
    with Renderer(device, lanes=lanes) as renderer:
        frames = {name: renderer.render(surface, CAMERA, SIZE, ("depth",), lod=0, patches=EXACT).depth
                  for name, (surface, _) in spheres.items()}
        together = renderer.render(clsurf.Scene([surface for surface, _ in spheres.values()]), CAMERA, SIZE,
                                   ("depth", "id"), lod=0, patches=EXACT)
    for name, (surface, bound) in spheres.items():
        assert 0 < surface.bound < bound + 1e-12 < 1e-3 * DIAGONAL, name
        shown = np.isfinite(frames[name])
        assert shown[rim(1 - bound)].all() and not shown[~rim(1 + BEYOND * bound + 1e-6)].any(), name
    for a, b in itertools.combinations(spheres, 2):
        (one, first), (other, second) = spheres[a], spheres[b]
        both = np.isfinite(frames[a]) & np.isfinite(frames[b])
        off = np.abs(frames[a] - frames[b])[both]
        for factor, share in ((1.0, min(one.bound_share, other.bound_share)), (BEYOND, 1.0)):
            # A surface within its bound of the sphere is met between the spheres that much larger and smaller.
            reach = np.maximum(entry(1 - factor * first) - entry(1 + factor * second),
                               entry(1 - factor * second) - entry(1 + factor * first))[both]
            assert (off <= reach + 2e-6).mean() >= share, (a, b, factor, (off / reach).max())
    nearest = np.fmin.reduce([frames[name] for name in spheres])
    np.testing.assert_allclose(together.depth, nearest, atol=2e-6)
    hit = np.isfinite(nearest)
    shown = np.choose(np.maximum(together.id, 0), [frames[name] for name in spheres])
    assert (together.id[~hit] == -1).all() and len(np.unique(together.id)) >= 3
    assert np.abs(shown - nearest)[hit].max() < 2e-6
