"""An analytic sphere in all four representations at once: at every pixel depths agree within the bounds they state."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from test_render_triangles import globe

import clsurf
from clsurf.models.basic import sphere
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.renderer import Renderer

SIZE = (160, 120)
DIAGONAL = 2 * np.sqrt(3)  # of the unit sphere's box
CAMERAS = (clsurf.Camera.look_at((2.5, 1.1, 1.7), (0, 0, 0), fov=42),
           clsurf.Camera.look_at((-0.3, -2.9, 0.4), (0, 0, 0), fov=46),  # along the poles of the scale map's mesh
           clsurf.Camera.look_at((-1.2, 0.2, 0.9), (0.4, -0.3, 0.5), fov=50),  # close up, most of it outside
           clsurf.Camera.orthographic((0.4, 5.0, -2.0), (0, 0, 0), height=2.2))
# No node drawn as a pixel, which puts it up to half a pixel aside.
EXACT = PatchDrawing(direct=False, mip=False)
FINE = 320  # facets around the scale map's mesh, the one scan that is not on the sphere itself
TIE = 2e-5  # discs that begin behind another surface are not blended with those that begin before it
SAG = 1 - np.cos(np.pi / FINE) ** 2


@pytest.fixture(scope="module")
def spheres(device):
    """(surface, the bound that it states for all of its scan and what the scan is off the sphere) by kind."""
    cloud = sphere(20_000)
    made = {"slim": clsurf.build_slim(cloud, error=0.0003, device=device),
            "patches": clsurf.build_patches(cloud, device=device),
            "surfels": clsurf.build_surfels(cloud, device=device),
            "scale map": clsurf.build_scale_map(globe(FINE // 2, FINE), bits=16, device=device)}
    return {name: (surface, surface.bound_all + SAG * (name == "scale map")) for name, surface in made.items()}


def between(camera, bound):
    """Least and largest depth (h, w) at which rays can meet a surface that is nowhere farther than this off the sphere.

    From the entry into the larger sphere to that into the smaller one, or to the exit of the larger one.
    """
    origins, directions = camera.rays(SIZE)
    middle = -(origins * directions).sum(axis=1)
    closest2 = ((origins + middle[:, None] * directions) ** 2).sum(axis=1)
    large, small = ((1 + way * bound) ** 2 - closest2 for way in (1, -1))
    half = np.sqrt(np.maximum(large, 0))
    first, last = middle - half, np.where(small > 0, middle - np.sqrt(np.maximum(small, 0)), middle + half)
    forward = -camera.rotation[2]
    return [((origins + t[:, None] * directions - camera.eye) @ forward).reshape(SIZE[::-1]) for t in (first, last)]


def rim(camera, radius):
    """Whether the rays (h, w) pass the centre within this radius."""
    origins, directions = camera.rays(SIZE)
    away = origins - (origins * directions).sum(axis=1, keepdims=True) * directions
    return (np.linalg.norm(away, axis=1) < radius).reshape(SIZE[::-1])


@pytest.mark.parametrize("lanes", (16, 1))
def test_depths_agree_within_the_sum_of_stated_bounds(device, spheres, lanes):
    with Renderer(device, lanes=lanes) as renderer:
        for camera in CAMERAS:
            frames = {name: renderer.render(surface, camera, SIZE, ("depth",), lod=0, patches=EXACT).depth
                      for name, (surface, _) in spheres.items()}
            together = renderer.render(clsurf.Scene([surface for surface, _ in spheres.values()]), camera, SIZE,
                                       ("depth", "id"), lod=0, patches=EXACT)
            _check_alone(camera, spheres, frames)
            _check_pairs(camera, spheres, frames)
            _check_together(frames, together)


def _check_alone(camera, spheres, frames):
    for name, (_, bound) in spheres.items():
        shown = np.isfinite(frames[name])
        assert shown[rim(camera, 1 - bound)].all() and not shown[~rim(camera, 1 + bound + 1e-6)].any(), name
        first, last = between(camera, bound)
        assert ((frames[name] >= first - 2e-6) & (frames[name] <= last + 2e-6))[shown].all(), name


def _check_pairs(camera, spheres, frames):
    for a, b in itertools.combinations(spheres, 2):
        (first, last), (other_first, other_last) = (between(camera, spheres[name][1]) for name in (a, b))
        both = np.isfinite(frames[a]) & np.isfinite(frames[b])
        reach = np.maximum(last - other_first, other_last - first)
        assert (np.abs(frames[a] - frames[b]) <= reach + 2e-6)[both].all(), (a, b)


def _check_together(frames, together):
    nearest = np.fmin.reduce(list(frames.values()))
    np.testing.assert_allclose(together.depth, nearest, rtol=0, atol=TIE)
    hit = np.isfinite(nearest)
    shown = np.choose(np.maximum(together.id, 0), list(frames.values()))
    assert (together.id[~hit] == -1).all() and len(np.unique(together.id)) >= 3
    assert np.abs(shown - nearest)[hit].max() < TIE


def test_bounds_are_small_and_hold_for_a_share_and_for_all(spheres):
    for name, (surface, bound) in spheres.items():
        assert 0 < surface.bound <= surface.bound_all <= bound < 1e-3 * DIAGONAL, name
        assert 0.9 < surface.bound_share < 1, name


def test_a_stray_is_in_the_bound_of_all(device):
    cloud = sphere(20_000)
    points = np.concatenate([cloud.points, [[0, 0, 1.05]]]).astype(np.float32)
    normals = np.concatenate([cloud.normals, [[0, 0, 1]]]).astype(np.float32)
    surface = clsurf.build_slim(replace(cloud, points=points, normals=normals), error=0.0003, device=device)
    assert surface.bound < 1e-3 and 0.01 < surface.bound_all < 0.06
