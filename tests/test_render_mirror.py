"""Mirror reflection and the shadows of spatial patches: closed forms of spheres and planes."""

import numpy as np
import pytest
from reference.surfaces import leaves, sphere
from test_render_traced_light import HEIGHT, MATTE, RADIUS, ball, camera, ground

from clsurf.errors import InputError
from clsurf.render.camera import Camera
from clsurf.render.material import Material
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Light, Shading
from clsurf.surface.cloud import PointCloud
from clsurf.surface.patch import PatchSurface

SIZE = (60, 45)
SUN = np.array([0.6, 0.2, 1.0]) / np.linalg.norm([0.6, 0.2, 1.0])
SUNNY = (Light("directional", tuple(SUN)),)


def picture(device, surfaces, shading, lights=SUNNY, look=None, **more):
    with Renderer(device) as r:
        return r.render(Scene(surfaces, lights=lights), look or camera(), SIZE, ("color", "position", "normal", "id"),
                        shading=shading, lod=0, **more)


def reflected(frame, look):
    """Where the mirrored rays of the plane z = 0 meet the sphere (NaN: they miss), the points and the rays."""
    points = frame.position[frame.id == 0].astype(float) + frame.origin
    ray = points - look.eye
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True) * [1, 1, -1]
    middle = points - [0, 0, HEIGHT]
    b = (middle * ray).sum(axis=1)
    disc = b * b - (middle**2).sum(axis=1) + RADIUS**2
    with np.errstate(invalid="ignore"):
        return points + (-b - np.sqrt(disc))[:, None] * ray, disc


def test_a_plane_mirrors_a_sphere(device):
    shading = Shading(ambient=0.2, diffuse=0.8, specular=0, color=(1, 1, 1), mirror=(1, 0))
    frame = picture(device, [ground(), ball()], shading, background=(0, 0, 0))
    at, disc = reflected(frame, camera())
    wanted = 0.2 + 0.8 * np.clip((at - [0, 0, HEIGHT]) @ SUN / RADIUS, 0, None)
    wanted = np.where(disc > 0, wanted, 0)
    got = frame.color[frame.id == 0][:, 0]
    clear = np.abs(disc) > 0.05
    assert (disc[clear] > 0).sum() > 200
    assert np.abs(got - wanted)[clear].max() < 0.03
    assert (picture(device, [ground(), ball()], shading).color[frame.id < 0] == 1).all()


def test_shares_mix_and_a_shadow_is_reflected(device):
    base = {"ambient": 0.2, "diffuse": 0.8, "specular": 0, "color": (1, 1, 1), "shadows": True}
    none, half, all_ = (picture(device, [ground(), ball()], Shading(**base, mirror=m)) for m in (0, 0.5, 1.0))
    assert np.allclose(half.color[..., :3], (none.color + all_.color)[..., :3] / 2, atol=1e-5)
    # The sphere's underside mirrors the plane: dark where its shadow falls, bright beside it.
    under = Camera.look_at((0.5, -5.0, 0.3), (0, 0, HEIGHT), up=(0, 0, 1))
    frame = picture(device, [ground(20.0, 80), ball()], Shading(**base, mirror=(0, 1)), look=under)
    normals, points = (getattr(frame, n)[frame.id == 1].astype(float) for n in ("normal", "position"))
    ray = points + frame.origin - under.eye
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    ray -= 2 * (ray * normals).sum(axis=1, keepdims=True) * normals
    down = ray[:, 2] < -0.05
    at = points[down] + frame.origin - (points[down] + frame.origin)[:, 2:] / ray[down, 2:] * ray[down]
    middle = [0, 0, HEIGHT] - at
    passing = np.sqrt(np.maximum((middle**2).sum(axis=1) - (middle @ SUN) ** 2, 0))
    got = frame.color[frame.id == 1][down, 0]
    inside = np.abs(at).max(axis=1) < 19
    dark, bright = inside & (passing < RADIUS - 0.1), inside & (passing > RADIUS + 0.1)
    assert dark.sum() > 20 and bright.sum() > 20
    assert np.abs(got[dark] - 0.2).max() < 1e-3 and np.abs(got[bright] - 0.2 - 0.8 * SUN[2]).max() < 1e-3


def test_orthographic_and_supersampled_mirrors(device):
    shading = Shading(ambient=0.2, diffuse=0.8, specular=0, color=(1, 1, 1), mirror=(1, 0))
    look = Camera.orthographic((3, -4, 4), (0, 0, 0.5), up=(0, 0, 1), height=6)
    one = picture(device, [ground(), ball()], shading, look=look)
    two = picture(device, [ground(), ball()], shading, look=look, supersampling=2)
    assert np.abs(one.color - two.color).mean() < 0.02 and set(two.channels) == {"color", "position", "normal", "id"}


def roof(side=9, half=1.0, height=2.0):
    """A flat square patch above the ground."""
    step = 2 * half / (side - 1)
    return PatchSurface(origins=[[-half, -half, height]], axis_x=[[step, 0, 0]], axis_y=[[0, step, 0]],
                        axis_z_length=[0.01], size=[[side, side]], displacements=np.zeros(side * side, np.int8))


@pytest.mark.parametrize("light", [Light("directional", (0, 0, 1)), Light("point", (0, 0, 1e4))])
def test_patches_throw_and_receive_shadows(device, light):
    points = picture(device, [ground(), roof()], MATTE, [light])
    at = (points.position.astype(float) + points.origin)[points.id == 0]
    reach = np.abs(at[:, :2]).max(axis=1)
    dark = points.color[points.id == 0][:, 0] == 0
    assert dark[reach < 0.95].sum() > 5 and dark[reach < 0.95].all() and not dark[reach > 1.05].any()
    assert np.allclose(points.color[points.id == 1][:, 0], 1, atol=1e-3)  # the roof does not shadow itself
    over = picture(device, [roof(height=0.0, half=4.0), ball()], MATTE, [light])
    at = (over.position.astype(float) + over.origin)[over.id == 0]
    away = np.linalg.norm(at[:, :2], axis=1)
    dark = over.color[over.id == 0][:, 0] == 0
    assert dark[away < 0.95].all() and not dark[away > 1.05].any()
    alone = picture(device, [roof(height=0.0, half=4.0)], MATTE, [light])
    assert (alone.id >= 0).sum() > 500 and np.allclose(alone.color[alone.id == 0][:, 0], 1, atol=1e-3)


def test_colours_are_reflected(device):
    colored = sphere(300)
    colors = np.tile(np.array([255, 0, 0, 255], np.uint8), (300, 1))
    up = np.eye(4)
    up[2, 3] = HEIGHT
    red = leaves(colored.centers, colored.radii, colored.normals, colored.coefficients, 2, colors=colors).moved(up)
    frame = picture(device, [ground(), red], Shading(ambient=1, diffuse=0, specular=0, mirror=(1, 0)))
    disc = reflected(frame, camera())[1]
    got = frame.color[frame.id == 0]
    assert np.allclose(got[disc > 0.1][:, :3], [1, 0, 0], atol=1e-3)


SKY = np.zeros((32, 64, 3), np.float32)
SKY[:16], SKY[16:] = (0.1, 0.2, 0.8), (0.3, 0.2, 0.1)  # above and below


def test_mirrors_see_the_image_light_and_not_the_background(device):
    """A perfect mirror under a blue sky is blue, whatever is behind the picture; without a sky it sees that."""
    shading = Shading(mirror=1.0)
    lights = (Light("image", picture=SKY, up=(0, 0, 1)),)
    for lit, wanted in ((lights, (0.1, 0.2, 0.8)), (SUNNY, (0, 1, 0))):
        frame = picture(device, [ground()], shading, lit, background=(0, 1, 0))
        assert (frame.id == 0).sum() > 500
        assert np.abs(frame.color[frame.id == 0][:, :3] - wanted).max() < 2e-3


@pytest.mark.parametrize("normals", [True, False])
@pytest.mark.parametrize("look", ["phong", "physical"])
def test_clouds_mirror(device, normals, look):
    """A cloud of a plane with normals mirrors what its plane would; without, discs face the eye and mirror what is
    behind it. Its own points are no obstacles, and surfaces are seen in it."""
    x, y = np.meshgrid(np.linspace(-4, 4, 161), np.linspace(-4, 4, 161))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    cloud = PointCloud(points, normals=np.tile((0.0, 0, 1), (len(points), 1)) if normals else None)
    scene = Scene([cloud, ball()], (Light("image", picture=SKY, up=(0, 0, 1)),),
                  [Material(look, mirror=1.0), Material("flat", (1.0, 0.0, 0.0))])
    with Renderer(device) as r:
        frame = r.render(scene, camera(), SIZE, ("color", "position", "normal", "id"))
    disc = reflected(frame, camera())[1]
    got = frame.color[frame.id == 0][:, :3]
    assert len(got) > 300 and np.isfinite(got).all()
    if normals:
        sky, hit = got[disc < -0.1], got[disc > 0.1]
        assert len(hit) > 50 and np.abs(sky - (0.1, 0.2, 0.8)).max() < 0.01
        assert np.median(np.abs(hit - (1, 0, 0)).max(axis=1)) < 0.01
    else:
        assert np.abs(got - (0.1, 0.2, 0.8)).max() < 0.01


@pytest.mark.parametrize("wrong", [-0.1, 1.5, "half", (0.5, 2.0), [[0.5]], np.nan])
def test_wrong_shares_say_what_is_expected(wrong):
    with pytest.raises(InputError, match="mirror: expected"):
        Shading(mirror=wrong)
