"""Materials and lights: closed forms first (furnace, albedo, cones, look-ups), then the float64 twin."""

import numpy as np
import pytest
from reference import light as twin
from reference import render as reference
from reference.surfaces import leaves, sphere

from clsurf.errors import InputError
from clsurf.io import images
from clsurf.render.camera import Camera
from clsurf.render.highlights import highlight_parts, highlight_table
from clsurf.render.light import Light, light_floats
from clsurf.render.lighting import prepared_lighting
from clsurf.render.matcaps import MATCAPS
from clsurf.render.material import LOOKS, Material
from clsurf.render.renderer import Renderer
from clsurf.render.scene import Scene
from clsurf.render.shade import Shading, shading_floats
from clsurf.render.tiles import view_floats
from clsurf.surface.srgb import to_linear

FORMS = (16, 1)
SIZE = (48, 40)
CAMERA = Camera.look_at((0.3, 0.9, 3.4), (0, 0, 0), fov=35)
WHITE = (1.0, 1.0, 1.0)
FURNACE = Light("image", picture=np.ones((32, 64, 3), np.float32))


def floor(half=4.0, n=40):
    at = np.linspace(-half, half, n)
    x, y = (a.ravel() for a in np.meshgrid(at, at))
    points = np.stack([x, y, np.zeros_like(x)], axis=1)
    return leaves(points, np.full(n * n, 3.0 * half / n), np.tile([0.0, 0, 1], (n * n, 1)), np.zeros((n * n, 6)), 2)


def drawn(device, scene, camera=CAMERA, size=SIZE, lanes=16, shading=None, channels=("color", "normal", "depth"),
          **more):
    with Renderer(device, lanes=lanes) as r:
        return r.render(scene, camera, size, channels, shading, **more)


# Energy ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lanes", FORMS)
def test_white_furnace(device, lanes):
    """White surfaces of any roughness, metal or not, are lost in light that is the same from all sides."""
    place = [np.eye(4) for _ in range(5)]
    for i, matrix in enumerate(place):
        matrix[0, 3] = 2.2 * i
    ball, looks = sphere(300), [(0.0, 0.0), (0.0, 1.0), (1.0, 0.1), (1.0, 0.5), (1.0, 1.0)]
    materials = [Material("physical", WHITE, metallic=m, roughness=r) for m, r in looks]
    scene = Scene([ball.moved(m) for m in place], [FURNACE], materials)
    camera = Camera.look_at((4.4, 2, 16), (4.4, 0, 0), fov=30)
    frame = drawn(device, scene, camera, (120, 40), lanes, background="sky")
    assert np.isfinite(frame.depth).sum() > 300
    assert np.abs(frame.color - 1).max() < 2e-4


@pytest.mark.parametrize("metallic", (0.0, 1.0))
@pytest.mark.parametrize("roughness", (0.5, 1.0))
def test_furnace_of_many_lamps(device, metallic, roughness):
    """The same from 2000 directional lamps: the highlights' table and the highlights themselves agree."""
    i = np.arange(2000)
    z, angle = 1 - (2 * i + 1) / 2000, np.pi * (3 - np.sqrt(5)) * i
    flat = np.sqrt(1 - z * z)
    d = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    lights = [Light("directional", way, (4 / 2000,) * 3) for way in d]
    scene = Scene([sphere(100)], lights, Material("physical", WHITE, metallic=metallic, roughness=roughness))
    frame = drawn(device, scene, size=(16, 12), shading=Shading(ambient=0))
    inside = np.isfinite(frame.depth)
    eye = CAMERA.eye / np.linalg.norm(CAMERA.eye)
    inside &= np.nan_to_num(frame.normal @ eye) > 0.3
    assert inside.sum() > 30 and np.abs(frame.color[..., :3][inside] - 1).max() < 0.02


@pytest.mark.parametrize("look", ("phong", "physical"))
def test_matte_surfaces_show_their_albedo(device, look):
    color = np.array([0.7, 0.4, 0.2])
    frame = drawn(device, Scene([sphere(200)], [FURNACE], Material(look, color, diffuse=1, specular=0, roughness=1)))
    hit = np.isfinite(frame.depth)
    wanted = to_linear(color)
    if look == "phong":
        assert np.abs(frame.color[..., :3][hit] - wanted).max() < 1e-6
    else:  # what dielectric highlights add is white, and at most their share
        extra = (frame.color[..., :3][hit] - wanted) / (1 - wanted)
        assert (extra > 0).all() and extra.max() < 0.25 and np.ptp(extra, axis=1).max() < 0.01


def test_highlight_table():
    """Against quadrature over directions instead of half vectors, on and between the table's corners."""
    table = highlight_table().reshape(33, 33, 4)[..., :2]
    for cosine in (0.15, 0.5, 0.93, 1.0):
        for rough in (0.3, 0.45, 0.71, 1.0):
            wanted = [twin.highlight(cosine, rough, f0) for f0 in (0.0, 1.0)]
            exact = highlight_parts(np.array([cosine]), rough)[0]
            assert abs(exact[1] - wanted[0]) < 2e-3 and abs(exact.sum() - wanted[1]) < 4e-3
            kept = twin.bilinear(table.astype(float), np.array([32 * np.sqrt(cosine)]), np.array([32 * rough]))[0]
            assert np.abs(kept - exact).max() < 3e-3


# Lights ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("look", ("phong", "physical"))
@pytest.mark.parametrize("lanes", FORMS)
def test_cone_and_range_of_a_spot(device, lanes, look):
    """A spot over a plane: rings of full light, falloff and none, and its end at its range."""
    spot = Light("spot", (0, 0, 2), direction=(0, 0, -1), cone=(20, 35), intensity=2.0)
    camera = Camera.orthographic((0, 0, 9), (0, 0, 0), up=(0, 1, 0), height=5)
    material = Material(look, WHITE, diffuse=1, specular=0, metallic=0, roughness=1)
    lit = {}
    for name, light in (("plain", Light("point", (0, 0, 2), intensity=2.0)), ("spot", spot),
                        ("ranged", Light("point", (0, 0, 2), intensity=2.0, range=2.5))):
        frame = drawn(device, Scene([floor()], [light], material), camera, (61, 61), lanes, Shading(ambient=0),
                      ("color", "position"))
        lit[name] = frame.color[..., 0]
    place = frame.position.astype(float) + frame.origin
    away = np.hypot(place[..., 0], place[..., 1])
    angle = np.degrees(np.arctan2(away, 2))
    low, high = np.cos(np.radians((35, 20)))
    part = np.clip((np.cos(np.radians(angle)) - low) / (high - low), 0, 1) ** 2
    assert np.allclose(lit["spot"], part * lit["plain"], atol=2e-5)
    assert (lit["spot"][angle > 35.2] == 0).all() and (lit["spot"][angle < 34] > 0).all()
    square = away**2 + 4
    assert np.allclose(lit["ranged"], np.clip(1 - square / 6.25, 0, None) ** 2 * lit["plain"], atol=2e-5)
    if look == "phong":
        assert np.allclose(lit["plain"], 2 * 2 / np.sqrt(square), atol=1e-4)


def test_spots_on_the_usual_path(device):
    """Without materials the last stage lights a spot itself, as it does beside materials."""
    lights = [Light("spot", (1, 1.5, 2), direction=(-1, -1.5, -2), cone=(5, 25)), Light("point", (-2, 1, 1), range=4.0)]
    plain = drawn(device, Scene([sphere(200)], lights))
    same = drawn(device, Scene([sphere(200)], lights, [None]))
    assert np.abs(plain.color - same.color).max() < 2e-5 and plain.color[..., 0].max() > 0.5


def test_shadow_of_a_spot(device):
    """A ball between a spot and a plane darkens what it hides, physical materials too."""
    up = np.eye(4)
    up[2, 3] = 1.4
    lights = [FURNACE, Light("spot", (0.3, 0.2, 6), direction=(-0.3, -0.2, -6), cone=(40, 50))]
    camera = Camera.look_at((1.5, -5.0, 4.0), (0, 0, 0.5), up=(0, 0, 1))
    scene = Scene([floor(), sphere(900).moved(up)], lights, Material("physical", roughness=0.7))
    frames = [drawn(device, scene, camera, (60, 45), shading=Shading(shadows=s), channels=("color", "position", "id"),
                    lod=0) for s in (True, False)]
    plane = frames[0].id == 0
    points = frames[0].position[plane].astype(float) + frames[0].origin
    to = np.array([0.3, 0.2, 6]) - points
    to /= np.linalg.norm(to, axis=1, keepdims=True)
    middle = [0, 0, 1.4] - points
    passing = np.sqrt(np.maximum((middle**2).sum(axis=1) - (middle * to).sum(axis=1) ** 2, 0))
    lost = (frames[1].color - frames[0].color)[plane][:, 0]
    clear = np.abs(passing - 1) > 0.05
    assert np.array_equal((lost > 1e-3)[clear], (passing < 1)[clear]) and (passing < 1).sum() > 20


def test_occlusion_darkens_the_sky(device):
    """Half of the sky is bright: a ball that hides that half takes its light, one that hides the dark half does not."""
    sky = np.zeros((64, 128, 3), np.float32)
    sky[:, 64:] = 1  # x > 0
    up = np.eye(4)
    up[2, 3] = 1.4
    scene = Scene([floor(), sphere(900).moved(up)], [Light("image", picture=sky, up=(0, 0, 1))],
                  Material(color=WHITE, diffuse=1, specular=0))
    camera = Camera.orthographic((0, 0.01, 9), (0, 0, 0), up=(0, 1, 0), height=6)
    frame = drawn(device, scene, camera, (48, 48), shading=Shading(occlusion=128, occlusion_reach=50.0),
                  channels=("color", "position", "id"), lod=0)
    bare = drawn(device, Scene([floor()], scene.lights, scene.materials), camera, (48, 48), lod=0).color[..., 0]
    x = frame.position[..., 0] + frame.origin[0]
    near = (frame.id == 0) & (np.abs(frame.position[..., 1] + frame.origin[1]) < 0.5)
    left, right = (frame.color[..., 0][near & side].mean() for side in ((x > -2) & (x < -1.1), (x > 1.1) & (x < 2)))
    # A point of the plane at the distance D from the ball's centre loses R^2 cos / D^2 of what comes from all sides.
    loss = np.mean([1.4 / (1.4**2 + d**2) ** 1.5 for d in np.linspace(1.1, 2, 50)])
    assert np.abs(bare - 0.5).max() < 0.01
    assert right == pytest.approx(0.5, abs=0.02) and left == pytest.approx(0.5 - loss, abs=0.03)


# Looks ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lanes", FORMS)
def test_matcap_is_a_look_up(device, lanes):
    """Seen along an axis, the sphere is the picture itself."""
    picture = np.random.default_rng(5).uniform(size=(9, 13, 3)).astype(np.float32)
    camera = Camera.orthographic((0, 0, 5), (0, 0, 0), height=2.2)
    frame = drawn(device, Scene([sphere(600)], materials=Material("matcap", matcap=picture)), camera, (44, 44), lanes)
    hit = np.isfinite(frame.depth)
    n = frame.normal[hit].astype(float)
    x, y = np.clip((n[:, 0] + 1) * 6.5 - 0.5, 0, 12), np.clip((1 - n[:, 1]) * 4.5 - 0.5, 0, 8)
    assert np.abs(frame.color[..., :3][hit] - twin.bilinear(picture, x, y)).max() < 1e-4
    tinted = drawn(device, Scene([sphere(600)], materials=Material("matcap", (0.0, 1.0, 0.0), matcap=picture)), camera,
                   (44, 44), lanes)
    assert np.allclose(tinted.color[..., :3][hit], frame.color[..., :3][hit] * [0, 1, 0], atol=1e-5)


def test_matcaps_that_are_built_in(device):
    for name, make in MATCAPS.items():
        picture = make()
        assert picture.shape == (256, 256, 3) and np.isfinite(picture).all() and picture.min() >= 0, name
        frame = drawn(device, sphere(100), shading=Shading(look="matcap", matcap=name), size=(20, 16))
        assert 0.02 < frame.color[8, 10, :3].mean() < 1.2, name


@pytest.mark.parametrize("lanes", FORMS)
def test_normals_as_colors(device, lanes):
    """The bytes of the PNG are the world normal scaled to 0 to 255 (paper on scale maps, figure 5)."""
    frame = drawn(device, sphere(200), lanes=lanes, shading="normal")
    hit = np.isfinite(frame.depth)
    wanted = (frame.normal[hit] * 0.5 + 0.5) * 255
    assert np.abs(images.to_srgb8(frame.color)[hit][:, :3] - wanted).max() < 0.6


def test_each_surface_its_own_material(device):
    """Pixels of a scene of several materials are those of the surfaces drawn with one each, in any order of lanes."""
    shift = np.eye(4)
    shift[0, 3] = 1.3
    surfaces = [sphere(200), sphere(200).moved(shift), floor(3.0, 20)]
    materials = [Material("physical", (0.9, 0.6, 0.3), metallic=1, roughness=0.3), None, Material("matcap")]
    lights, shading = [FURNACE, Light("directional", (1, 2, 1), intensity=0.5)], Shading(color=(0.2, 0.5, 0.7))
    frames = {lanes: drawn(device, Scene(surfaces, lights, materials), lanes=lanes, shading=shading,
                           channels=("color", "id")) for lanes in (16, 8, 1)}
    assert np.abs(frames[16].color - frames[1].color).max() < 1e-3
    assert np.abs(frames[16].color - frames[8].color).max() < 1e-3
    for number, material in enumerate(materials):
        alone = drawn(device, Scene(surfaces, lights, [material] * 3), shading=shading, channels=("color", "id"))
        here = frames[16].id == number
        assert here.sum() > 50 and np.abs(frames[16].color - alone.color)[here].max() < 1e-5


def test_mirrors_show_materials(device):
    """What a mirroring floor shows of a ball above it has the ball's own material."""
    up = np.eye(4)
    up[2, 3] = 1.2
    flat = Material("flat", (0.9, 0.1, 0.1))
    camera = Camera.look_at((0, -6, 2.5), (0, 0, 0.6), up=(0, 0, 1), fov=40)
    mirror = Material(color=(0, 0, 0), diffuse=0, specular=0, mirror=1.0)
    scene = Scene([floor(), sphere(900).moved(up)], [Light()], [mirror, flat])
    frame = drawn(device, scene, camera, (64, 48), shading=Shading(ambient=0), channels=("color", "id"),
                  background=(0, 0, 0))
    seen = frame.color[..., :3][(frame.id == 0) & (frame.color[..., 0] > 0.05)]
    wanted = to_linear(flat.color)
    assert len(seen) > 40 and np.abs(seen - wanted).max() < 5e-3


# The twin -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lit", ("sky", "lamps"))
def test_material_light(device, lit):
    """Every look under every kind of lamp, point by point; directions at random, behind the surface too."""
    random = np.random.default_rng(8)
    camera = Camera.orthographic((0, 0, 1), (0, 0, 0), height=1)  # its axes are the world's
    lights = [Light("directional", (1, 2, 1), (0.9, 0.5, 0.4)), Light("point", (1, 1, 2), range=3.0), Light(),
              Light("spot", (0.5, 0.2, 2), direction=(-0.1, 0, -1), cone=(10, 50), intensity=1.7)]
    picture = random.uniform(size=(32, 64, 3)).astype(np.float32)
    if lit == "sky":
        lights.append(Light("image", (0, 0, 1), (0.8, 1.0, 0.6), 1.3, picture=picture, rotation=40, up=(0.2, 1, 0.4)))
    sphere_picture = random.uniform(size=(8, 6, 3)).astype(np.float32)
    materials = [Material("phong", diffuse=0.7, specular=0.5, shininess=9), Material("flat"), Material("normal"),
                 Material("matcap", matcap=sphere_picture), Material("physical", roughness=0.1),
                 Material("physical", metallic=0.6, roughness=0.55), Material("physical", metallic=1.0, roughness=0.93)]
    shading = Shading(ambient=0.2)
    scene = Scene([sphere(20)] * len(materials), lights, materials)
    made = prepared_lighting(device, scene, shading, camera)
    count = 50 * len(materials)
    rows = np.zeros((count, 16), np.float32)
    rows[:, :3] = random.uniform(-1, 1, (count, 3))
    for at in (3, 6):
        d = random.normal(size=(count, 3))
        rows[:, at:at + 3] = d / np.linalg.norm(d, axis=1, keepdims=True)
    facing = np.sign((rows[:, 3:6] * rows[:, 6:9]).sum(axis=1))
    rows[:, 6:9] *= facing[:, None]
    rows[:, 8] = np.where(np.abs(rows[:, 8]) + np.abs(rows[:, 6]) < 0.05, 0.3, rows[:, 8])
    rows[:, 6:9] /= np.linalg.norm(rows[:, 6:9], axis=1, keepdims=True)
    rows[:, 9:12] = random.uniform(size=(count, 3))
    rows[:, 12] = made.material_of[np.arange(count) % len(materials)]
    dark = random.integers(0, 16, count).astype(np.uint32)
    rows[:, 13] = dark.view(np.float32)
    out = device.empty((count, 3), np.float32)
    floats = shading_floats(shading, lights, (1, 1, 1), camera)
    device.kernel("render/light_points.cl", constants=made.constants | {"SPAN": 32})(
        (-(-count // 32),), None, device.upload(view_floats(camera, (1, 1))), device.upload(floats), made.rows,
        made.sky_floats, made.texels, device.upload(rows), count, out)
    got, wide = device.download(out), rows.astype(np.float64)
    table = highlight_table().reshape(33, 33, 4)[..., :2].astype(float)
    sky = {}
    if lit == "sky":
        light, maps = lights[-1], made.sky
        turn = light.axes() @ camera.rotation.T

        def level(place, d):
            texels = maps.texels[place[0]:place[0] + (place[1] + 1) ** 2, :3]
            return twin.octahedral(texels, d @ turn.T) * light.radiance

        def mirror(d, rough):
            at = rough * (len(maps.mirror) - 1)
            low = min(int(at), len(maps.mirror) - 2)
            return level(maps.mirror[low], d) * (1 - at + low) + level(maps.mirror[low + 1], d) * (at - low)
        sky = {"mirror": mirror, "matte": lambda d: level(maps.matte, d)}
    for i, material in enumerate(made.materials):
        own = rows[:, 12] == i
        wanted = twin.material_light(
            material, light_floats(lights, camera).astype(float), 0.2,
            lambda c, r: twin.bilinear(table, 32 * np.sqrt(c), np.full(len(c), 32 * r)), wide[own, :3], wide[own, 3:6],
            wide[own, 6:9], wide[own, 9:12], dark[own], sphere=sphere_picture, **sky)
        error = np.abs(got[own] - wanted) / (1 + np.abs(wanted))
        assert own.sum() == 50 and error.max() < 2e-3, (material.look, error.max())


def test_reflection_lines_of_a_material(device):
    frame = drawn(device, Scene([sphere(300)], materials=Material("reflection", WHITE, stripes=5)))
    hit = np.isfinite(frame.depth)
    gradient = frame.normal[hit].astype(np.float64) @ CAMERA.rotation.T
    pixels = reference.pixel_centres(SIZE)[hit.ravel()]
    wanted = reference.reflection_lines(view_floats(CAMERA, SIZE), 5, pixels, gradient)
    assert np.abs(frame.color[..., 0][hit] - wanted).max() < 2e-4


# Mistakes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrong", [
    lambda: Material("shiny"), lambda: Material(roughness=2), lambda: Material(metallic="x"),
    lambda: Material(mirror=-1), lambda: Material(color=(1, 1)), lambda: Light("spot", cone=(30, 20)),
    lambda: Light("point", range=0), lambda: Light(intensity=-1), lambda: Light("image", up=(0, 0, 0)),
    lambda: Scene([], materials=["gold"]), lambda: Scene([sphere(20)], materials=[None, None]),
    lambda: Scene([sphere(20)], materials="gold"), lambda: Scene([sphere(20)], lights=["sky"]),
    lambda: Shading(roughness=-0.1)])
def test_mistakes_say_what_is_expected(wrong):
    with pytest.raises(InputError, match="expected"):
        wrong()


def test_mistakes_that_drawing_finds(device, tmp_path):
    for scene in (Scene([sphere(20)], [FURNACE, FURNACE]), Scene([sphere(20)], [Light("image", picture=np.ones(3))]),
                  Scene([sphere(20)], [Light("image", picture=tmp_path / "none.exr")]),
                  Scene([sphere(20)], materials=Material("matcap", matcap="plastic"))):
        with pytest.raises(InputError):
            drawn(device, scene, size=(8, 8))


def test_balls_and_empty_scenes_have_no_materials(device):
    plain = drawn(device, Scene([sphere(50)]), shading="ball_size", size=(24, 16))
    with_material = drawn(device, Scene([sphere(50)], materials=Material("matcap")), shading="ball_size", size=(24, 16))
    assert np.array_equal(plain.color, with_material.color)
    assert (drawn(device, Scene([], [FURNACE], Material("physical")), size=(8, 8)).color == 1).all()
    assert set(LOOKS) == {"phong", "flat", "reflection", "normal", "matcap", "physical"}
