"""Rays against scale maps: analytic spheres, the twin that samples, all hits, leaks, holes, the renderer."""

import numpy as np
import pytest
from reference import scale_map as twin
from reference.trace_rays import unit
from test_trace_rays import random_rays

import clsurf
from clsurf import Camera, Scene
from clsurf.surface.scale_map import ScaleMap


def wavy(d):
    return 1 + 0.25 * np.sin(4 * d[..., 0] + 1) * np.cos(3 * d[..., 1] - d[..., 2])


@pytest.mark.parametrize("size", (1, 2, 9))
def test_a_sphere_is_hit_exactly_whatever_the_texels(device, lanes, size):
    """Distance, position and normal of the analytic sphere; none leaks, far from zero too."""
    surface = twin.smooth_map(size).moved([[2, 0, 0, 1e6], [0, 2, 0, 7], [0, 0, 2, -1e6], [0, 0, 0, 1]])
    origins, directions = random_rays(3000, size)
    center = np.array([1e6, 7, -1e6])
    hits = clsurf.trace(surface, center + 2 * origins, 5 * directions, device=device)
    d = unit(directions)
    b = (origins * d).sum(axis=1)
    exact = 2 * (-b - np.sqrt(b * b - (origins**2).sum(axis=1) + 1))
    assert hits.hit.all() and (hits.surface == 0).all()
    assert np.abs(hits.distance - exact).max() < 2e-4
    normal = unit(hits.position - center)
    assert (hits.normal * normal).sum(axis=1).min() > 0.999
    assert hits.primitive.min() >= 0 and hits.primitive.max() < 6 * size**2


def test_ray_scale_map(device, lanes):
    """Rays through and past a wavy map: every hit of the twin, in order, for all three queries."""
    surface = twin.smooth_map(12, f=wavy)
    rng = np.random.default_rng(2)
    origins = 2 * unit(rng.normal(size=(150, 3)))
    targets = unit(rng.normal(size=(150, 3))) * rng.uniform(0, 1.1, (150, 1))
    targets[:20] *= 0  # through the centre
    every = clsurf.trace(surface, origins, targets - origins, "all", device=device)
    near = clsurf.trace(surface, origins, targets - origins, device=device)
    some = clsurf.trace(surface, origins, targets - origins, "any", device=device)
    wrong = 0
    for i, (o, d) in enumerate(zip(origins, targets - origins, strict=True)):
        wanted = twin.ray_scale_map(surface, o, d)
        got = every.distance[every.offsets[i]:every.offsets[i + 1]]
        if len(got) != len(wanted):
            wrong += 1
            continue
        assert np.abs(got - wanted).max(initial=0) < 2e-4
        assert near.distance[i] == pytest.approx(wanted[0] if len(wanted) else np.inf, abs=2e-4)
        assert not len(wanted) or np.abs(some.distance[i] - wanted).min() < 2e-4
    assert wrong <= 3  # rays that graze


def test_no_ray_slips_between_cells(device):
    """Rays along cube edges, texel lines and through corners of a closed map hit it an even number of times."""
    surface = twin.smooth_map(8, f=lambda d: 1 + 0.1 * d[..., 0])
    rng = np.random.default_rng(0)
    a = np.concatenate([rng.integers(-8, 9, 6000) / 8, np.ones(2000)])
    b = np.concatenate([rng.uniform(-1, 1, 6000), rng.integers(-8, 9, 2000) / 8])
    aim = np.stack([np.ones(8000), a, b], axis=1)[:, rng.permutation(3)] * rng.choice([-1, 1], (8000, 1))
    origins = 3 * unit(aim)
    hits = clsurf.trace(surface, origins, -origins, "all", device=device)
    assert (np.diff(hits.offsets) == 2).all()
    inside = clsurf.trace(surface, np.zeros(3), origins, "all", device=device)
    assert (np.diff(inside.offsets) == 1).all()


def test_holes_layers_and_limits(device, lanes):
    base = twin.smooth_map(8)
    scales = np.concatenate([base.scales, base.scales * np.float32(0.5)])
    valid = np.ones(scales.shape, bool)
    valid[0, 4] = False  # +Z of the outer layer
    surface = ScaleMap(base.center, base.radius, scales, valid)
    origins = np.array([[0, 0, 3.0], [3, 0.01, 0.02], [0, 0, -3]])
    hits = clsurf.trace(surface, origins, -origins, "all", device=device)
    found = [hits.distance[a:b].round(3).tolist() for a, b in zip(hits.offsets, hits.offsets[1:], strict=False)]
    assert found == [[2.5, 3.5, 4.0], [2, 2.5, 3.5, 4], [2, 2.5, 3.5]]
    limited = clsurf.trace(surface, origins, -origins, near=2.6, far=3.6, device=device)
    assert np.allclose(limited.distance, 3.5, atol=1e-3)
    assert (hits.primitive[hits.offsets[1]:hits.offsets[2]] // (6 * 64) == [0, 1, 1, 0]).all()
    nothing = ScaleMap(base.center, 1.0, base.scales, np.zeros_like(base.valid))
    assert not clsurf.trace(nothing, origins, -origins, device=device).hit.any()


def test_rays_meet_what_is_drawn(device):
    """Depth of a picture against its own rays, for a wavy map beside a mesh in one scene."""
    surface = twin.smooth_map(32, f=wavy)
    camera, size = Camera.look_at((1, 2, 3.0), (0, 0, 0), (0, 1, 0), fov=45), (80, 60)
    frame = clsurf.render(surface, camera, size, device=device)
    hits = clsurf.trace(surface, *camera.rays(size), device=device)
    depth = (hits.distance * (camera.rays(size)[1] @ -camera.rotation[2])).reshape(60, 80)
    assert (np.isfinite(depth) == np.isfinite(frame.depth)).mean() > 0.998
    assert np.nanquantile(np.abs(depth - frame.depth), 0.995) < 1e-3
    other = surface.moved([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]])
    both = clsurf.trace(Scene([surface, other]), (0, 0, 9.0), (0, 0, -1), device=device)
    assert both.surface == 1


def test_shadows_fall_from_and_on_scale_maps(device):
    """A ball between a lamp and a larger ball: its shadow lies where it must, no speckle elsewhere."""
    ball = twin.smooth_map(24)
    small = ball.moved([[0.3, 0, 0, 0], [0, 0.3, 0, 0], [0, 0, 0.3, 2.5], [0, 0, 0, 1]])
    lamp = clsurf.Light("directional", (0, 0, 1))
    camera = Camera.look_at((2.5, 0, 3.5), (0, 0, 0.8), (0, 1, 0), fov=50)
    shading = clsurf.Shading(shadows=True, ambient=0, specular=0, diffuse=1)
    scene = Scene([ball, small], lights=[lamp])
    channels = ("color", "id", "position", "normal")
    frame = clsurf.render(scene, camera, (120, 90), channels, shading=shading, device=device)
    unshaded = clsurf.Shading(ambient=0, specular=0, diffuse=1)
    plain = clsurf.render(scene, camera, (120, 90), shading=unshaded, device=device)
    on_ball = frame.id == 0
    radius = np.hypot(*np.moveaxis(frame.position[..., :2], 2, 0))
    lit = plain.color[..., 0] > 0.1
    dark = on_ball & lit & (frame.color[..., 0] < 0.5 * plain.color[..., 0])
    assert (on_ball & lit & (radius < 0.25)).sum() > 30 and dark[on_ball & lit & (radius < 0.25)].all()
    assert not dark[on_ball & lit & (radius > 0.37) & (frame.normal[..., 2] > 0.2)].any()
