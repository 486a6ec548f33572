"""Shadows and ambient occlusion in pictures: closed forms, the twins, and what users may ask for."""

from copy import copy

import numpy as np
import pytest
from reference import render as reference
from reference import trace as twin
from reference.surfaces import fitted, leaves, plane_points, sphere, torus_points

from clsurf.errors import InputError
from clsurf.render import casters
from clsurf.render.camera import Camera
from clsurf.render.casters import occluder_view
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Light, Shading, shading_floats
from clsurf.render.tiles import view_floats
from clsurf.render.traced_light import sphere_lamps
from clsurf.surface.mesh import Mesh
from clsurf.surface.patch import PatchSurface
from clsurf.trace.kinds import Traced
from clsurf.trace.packets import trace_lights
from clsurf.trace.pieces import held
from clsurf.trace.slim import upload_traced

FORMS = (16, 1)
SIZE = (120, 90)
HEIGHT, RADIUS = 1.4, 1.0  # of the sphere over the plane
MATTE = Shading(ambient=0, diffuse=1, specular=0, shadows=True, color=(1, 1, 1))


def ground(half=4.0, n=40):
    points, normals = plane_points(n, half)
    return leaves(points, np.full(n * n, 3.0 * half / n), normals, np.zeros((n * n, 6)), 2)


def ball():
    up = np.eye(4)
    up[2, 3] = HEIGHT
    return sphere(900, RADIUS).moved(up)


def camera():
    return Camera.look_at((1.5, -5.0, 4.0), (0, 0, 0.5), up=(0, 0, 1))


def picture(device, lights, shading=MATTE, lanes=16, size=SIZE, surfaces=None):
    with Renderer(device, lanes=lanes) as r:
        return r.render(Scene([ground(), ball()] if surfaces is None else surfaces, lights=lights), camera(), size,
                        ("color", "position", "normal", "id"), shading=shading, lod=0)


@pytest.mark.parametrize("lanes", FORMS)
@pytest.mark.parametrize("light", [Light("directional", (0.6, 0.2, 1.0)), Light("point", (2.0, 1.0, 5.0)),
                                   Light("point", (0.5, -0.3, 60.0))])
def test_shadow_of_a_sphere_on_a_plane(device, light, lanes):
    frame = picture(device, [light], lanes=lanes)
    on_plane = frame.id == 0
    points = frame.position[on_plane].astype(float) + frame.origin
    to = np.array(light.vector) - points if light.kind == "point" else np.tile(light.vector, (len(points), 1))
    to = to / np.linalg.norm(to, axis=1, keepdims=True)
    middle = [0, 0, HEIGHT] - points
    passing = np.sqrt(np.maximum((middle**2).sum(axis=1) - (middle * to).sum(axis=1) ** 2, 0))
    dark = frame.color[on_plane][:, 0] == 0
    assert dark.sum() > 300
    clear = np.abs(passing - RADIUS) > 0.03  # the sphere's own error, and that of its outline
    assert np.array_equal(dark[clear], (passing < RADIUS)[clear])


@pytest.mark.parametrize("oriented", (True, False))
@pytest.mark.parametrize("lanes", FORMS)
def test_a_sphere_does_not_shadow_itself(device, lanes, oriented):
    """A convex surface is lit wherever it faces the lamp, also where the signs of its normals are random."""
    light, surface = Light("directional", (1.0, -0.6, 0.5)), sphere(900)
    if not oriented:
        flip = np.where(np.random.default_rng(0).uniform(size=(900, 1)) < 0.5, -1.0, 1.0)
        surface = leaves(surface.centers, surface.radii, surface.normals * flip, surface.coefficients * flip, 2,
                         oriented=False)
    frame = picture(device, [light], lanes=lanes, surfaces=[surface])
    hit = frame.id == 0
    cosine = frame.normal[hit].astype(float) @ np.array(light.vector) / np.linalg.norm(light.vector)
    lit = frame.color[hit][:, 0]
    assert (cosine > 0.1).sum() > 500
    assert np.allclose(lit[cosine > 0.02], cosine[cosine > 0.02], atol=1e-4)
    assert (lit[cosine < 0] == 0).all()


@pytest.mark.parametrize("lanes", FORMS)
def test_ambient_occlusion_of_a_sphere_over_a_plane(device, lanes):
    """A point of the plane at the distance D from the centre loses R^2 cos / D^2 of the ambient light."""
    shading = Shading(ambient=1, diffuse=0, specular=0, occlusion=256, occlusion_reach=100.0, color=(1, 1, 1))
    frame = picture(device, [], shading, lanes, (60, 45))
    on_plane = frame.id == 0
    points = frame.position[on_plane].astype(float) + frame.origin
    away = np.linalg.norm(points - [0, 0, HEIGHT], axis=1)
    wanted = 1 - RADIUS**2 * HEIGHT / away**3
    got = frame.color[on_plane][:, 0]
    assert wanted.min() < 0.6
    assert np.abs(got - wanted).max() < 0.04 and np.abs(got - wanted).mean() < 0.008
    near = Shading(ambient=1, diffuse=0, specular=0, occlusion=64, occlusion_reach=0.3, color=(1, 1, 1))
    assert picture(device, [], near, lanes, (60, 45)).color[on_plane][:, 0].min() > 0.999


def test_open_surfaces_throw_shadows_from_both_sides(device):
    for turned in (1, -1):
        up = np.diag([turned, 1.0, turned, 1.0])
        up[2, 3] = 2.0
        roof = ground(1.0, 12).moved(up)
        frame = picture(device, [Light("directional", (0, 0, 1))], surfaces=[ground(), roof])
        points = (frame.position.astype(float) + frame.origin)[frame.id == 0]
        dark = frame.color[frame.id == 0][:, 0] == 0
        reach = np.abs(points[:, :2]).max(axis=1)
        assert dark[reach < 0.95].all() and not dark[reach > 1.3].any()


def test_shadows_of_many_lamps_add_up(device):
    lights = [Light("directional", (np.cos(a), np.sin(a), 1.5), (0.02 * i, 0.1, 0.05)) for i, a in
              enumerate(np.linspace(0, 6, 32))]
    together = picture(device, lights).color[..., :3]
    apart = sum(picture(device, [light]).color[..., :3] * (picture(device, [light]).id >= 0)[..., None]
                for light in lights[::8])
    some = picture(device, lights[::8])
    assert np.allclose(some.color[..., :3][some.id >= 0], apart[some.id >= 0], atol=1e-5, rtol=1e-5)
    assert together[some.id >= 0].max() > apart[some.id >= 0].max()
    with pytest.raises(InputError, match="at most 32 lights"):
        picture(device, [*lights, lights[0]])


def test_a_headlight_throws_no_shadow(device):
    plain = Shading(ambient=0, diffuse=1, specular=0, color=(1, 1, 1))
    one, two = (picture(device, [Light()], shading) for shading in (MATTE, plain))
    assert np.allclose(one.color, two.color, atol=1e-5, rtol=1e-5)


# Twins ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lanes", FORMS)
@pytest.mark.parametrize("degree", (1, 2, 3))
def test_trace_lights(device, degree, lanes):
    surface = fitted(*torus_points(3000), 0.2, degree)
    look, size, random = Camera.look_at((0.4, 1.0, 3.2), (0, 0, 0)), (16, 16), np.random.default_rng(degree)
    lamps = np.zeros((5, 8), np.float32)
    lamps[:, 0] = 1, 1, 1, 2, 2
    directions = random.normal(size=(3, 3))
    lamps[:3, 1:4] = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    lamps[3:, 1:4] = [[2.0, 1.5, -1.0], [-0.3, 0.2, -1.5]]
    view = occluder_view(surface.origin, None, look, size)
    with Renderer(device) as r:
        frame = r.render(surface, look, size, lod=0)
    depth, normals = frame.depth.astype(np.float64), frame.normal.astype(np.float64) @ look.rotation.T
    hit = np.isfinite(depth).ravel()
    planes = np.stack([np.nan_to_num(depth, nan=np.inf), *np.nan_to_num(normals).transpose(2, 0, 1)])
    planes = planes.reshape(4, 2, 8, 2, 8).transpose(1, 3, 0, 2, 4).reshape(4, 4, 64)
    mask, touched = device.zeros((4, 64), np.uint32), device.upload(np.zeros(4, np.int32))
    trace_lights(device, lanes, upload_traced(device, surface), device.upload(view), {"FIELDS": 4},
                 device.upload(lamps), 5, np.inf, True, 2, 2, touched, device.upload(planes.astype(np.float32)), mask)
    got = device.download(mask).reshape(2, 2, 8, 8).transpose(0, 2, 1, 3).reshape(-1)[hit]
    pixels = reference.pixel_centres(size)[hit]
    v = reference.opened(view)
    rays = np.stack([(pixels[:, 0] - v.cx) / v.fx, (v.cy - pixels[:, 1]) / v.fy, -np.ones(len(pixels))], axis=1)
    points = rays * depth.ravel()[hit, None]
    eye = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    wanted = twin.trace_lights(surface, view, lamps, np.inf, points, normals.reshape(-1, 3)[hit], eye)
    for bit in range(5):
        assert ((got >> bit & 1) == (wanted >> bit & 1)).mean() > 0.97, bit
    assert 0 < (wanted != 0).sum() < len(wanted)


@pytest.mark.parametrize("lanes", (16, 8, 4, 1))
def test_light_bins(device, lanes):
    shading = Shading(shadows=True, occlusion=16, occlusion_reach=100.0, ambient=0.3)
    lights = [Light("directional", (0.6, 0.2, 1.0), (0.5, 0.4, 0.3)), Light("point", (2.0, 1.0, 5.0)), Light()]
    scene, look, size = Scene([ground(), ball()], lights=lights), camera(), (32, 24)
    with Renderer(device, lanes=lanes) as r:
        frame = r.render(scene, look, size, ("color", "depth", "normal"), shading=shading, lod=0)
        grid = {name: device.download(r._scratch.array(name, (12, 64), np.uint32)) for name in ("shadows", "hidden")}
    hit = np.isfinite(frame.depth).ravel()
    pictures = {name: a.reshape(3, 4, 8, 8).transpose(0, 2, 1, 3).reshape(-1)[hit] for name, a in grid.items()}
    directions = sphere_lamps(16, look)[:, 1:4]
    hidden = pictures["hidden"][:, None] >> np.arange(32) & 1 > 0
    view = occluder_view(ground().origin, None, look, size)
    floats = shading_floats(shading, lights, (1, 1, 1), look)
    wanted = twin.light_bins(view, floats, reference.pixel_centres(size)[hit], frame.depth.ravel()[hit].astype(float),
                             frame.normal.reshape(-1, 3)[hit].astype(float) @ look.rotation.T, floats[:3],
                             pictures["shadows"], directions, hidden)
    assert (pictures["shadows"] != 0).sum() > 20 and hidden.any()
    assert np.allclose(frame.color.reshape(-1, 4)[hit, :3], wanted, atol=2e-4)


@pytest.mark.parametrize("wrong", [{"occlusion": -1}, {"occlusion": 2000}, {"occlusion": 1.5},
                                   {"occlusion_reach": "x"}])
def test_wrong_options_say_what_is_expected(wrong):
    with pytest.raises(InputError, match="expected"):
        Shading(**wrong)


def test_empty_and_lampless_scenes(device):
    empty = leaves(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 6)), 2)
    look = Camera.look_at((0, 0, 4), (0, 0, 0))
    with Renderer(device) as r:
        assert (r.render(empty, look, (20, 20), shading=Shading(shadows=True, occlusion=8)).color == 1).all()
        dark = r.render(sphere(), look, (20, 20), shading=Shading(shadows=True), channels="color")
        assert np.isfinite(dark.color).all()
        lampless = r.render(Scene([sphere()], lights=[]), look, (20, 20), shading=MATTE, channels="color")
        assert lampless.color[10, 10, 0] == 0


def roof(side=9, half=1.0, height=2.0):
    """A flat square patch above the ground."""
    step = 2 * half / (side - 1)
    return PatchSurface(origins=[[-half, -half, height]], axis_x=[[step, 0, 0]], axis_y=[[0, step, 0]],
                        axis_z_length=[0.01], size=[[side, side]], displacements=np.zeros(side * side, np.int8))


OPEN = Shading(ambient=1, diffuse=0, specular=0, color=(1, 1, 1), occlusion=256, occlusion_reach=100.0)


def openness(surfaces, lanes=16):
    """World positions of what is seen of the ground, and how much light comes to them from all around."""
    with Renderer(lanes=lanes) as r:
        frame = r.render(Scene(surfaces, lights=[]), camera(), (60, 45), ("color", "position", "id"),
                         shading=OPEN, lod=0)
    there = frame.id == 0
    return frame.position[there].astype(float) + frame.origin, frame.color[there][:, 0]


def floor():
    """The ground as triangles."""
    corners = np.array([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]], np.float32)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


@pytest.mark.parametrize("below", [ground, floor])
def test_patches_occlude(below):
    """Under a square roof the ground sees that much less of the sky: cosine-weighted solid angle of a rectangle.

    With a ground of triangles nothing of the scene casts by packets."""
    at, light = openness([below(), roof(side=65)])
    bare = openness([below()])[1]
    solid = 0.0
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):  # four rectangles from the point's own foot
        a, b = (1 + x * at[:, 0]) / 2.0, (1 + y * at[:, 1]) / 2.0
        u, v = a / np.sqrt(1 + a * a), b / np.sqrt(1 + b * b)
        solid = solid + u * np.arctan(b / np.sqrt(1 + a * a)) + v * np.arctan(a / np.sqrt(1 + b * b))
    covered = solid / (2 * np.pi)
    assert covered.max() > 0.2 and np.abs(bare - 1).max() < 1e-3
    error = np.abs((1 - light) - covered)
    assert error.mean() < 0.01 and error.max() < 0.05


@pytest.mark.parametrize("light", [Light("directional", (0.6, 0.2, 1.0)), Light("point", (2.0, 1.0, 5.0))])
def test_single_rays_cast_the_shadows_of_packets(device, monkeypatch, light):
    """Whatever is traced casts: a kind needs to tell no more than where rays hit it."""
    packets = picture(device, [light])
    monkeypatch.setattr(casters, "held", lambda device, surface: bare(held(device, surface)))
    singles = picture(device, [light])
    on_plane = packets.id == 0
    dark = packets.color[on_plane][:, 0] == 0
    assert dark.sum() > 300 and ((singles.color[on_plane][:, 0] == 0) != dark).mean() < 0.01


def bare(one):
    one = copy(one)
    one.packets, one.whole = False, Traced(one.whole.center, one.whole.unit, one.whole.box, one.whole.launch)
    one.grain = one.whole.grain
    return one


def test_lamp_rays(device):
    """Rays of two bins against their twin, and the bits of those that hit something."""
    random = np.random.default_rng(3)
    look, size = camera(), (16, 8)
    planes = random.normal(size=(2, 4, 64)).astype(np.float32)
    planes[:, 0] = random.uniform(3, 6, (2, 64))
    lamps = np.array([[1, 0.3, 0.5, 0.8, 0, 0, 0, 0], [2, 0.5, 2.0, -3.0, 0, 0, 0, 0]], np.float32)
    place = np.append(np.hstack([np.linalg.qr(random.normal(size=(3, 3)))[0] / 2, random.normal(size=(3, 1))]), 2.0)
    mask = random.integers(0, 4, (2, 64)).astype(np.uint32)
    pixels = random.permutation(128).astype(np.int32)
    view = view_floats(look, size)
    buffers = [device.upload(array) for array in (pixels, view, place.astype(np.float32), lamps)]
    on_device = device.empty((2, 64), np.uint32)
    device.write(on_device, mask)
    rays, wanted_mask = device.empty((128, 8), np.float32), mask.copy()
    for lamp, reach in ((0, np.inf), (1, 2.0), (1, 100.0)):
        device.kernel("trace/lamp_rays.cl", constants={"FIELDS": 4})(
            (128,), (64,), 128, 0, *buffers, lamp, 0.1, reach, 2, device.upload(planes), on_device, 64, 0, rays)
        got = device.download(rays)
        before = device.download(on_device)
        wanted = twin.lamp_rays(pixels, view, place, lamps[lamp], lamp, 0.1, reach, 2, planes, before)
        assert np.allclose(got, wanted, atol=1e-5, rtol=1e-5)
        hits = np.full((128, 8), np.inf, np.float32)
        hits[::3, 0] = 1
        device.kernel("trace/lamp_bits.cl")((128,), (64,), 128, 0, buffers[0], device.upload(hits), lamp, on_device,
                                            64, 0)
        wanted_mask.ravel()[pixels[::3]] |= np.uint32(1 << lamp)
        assert np.array_equal(device.download(on_device), wanted_mask)
