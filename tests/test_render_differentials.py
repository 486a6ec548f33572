"""Channels of curvature: exact reproduction, analytic surfaces, twins, independence."""

import numpy as np
import pytest
from reference import differentials as twin
from reference import render
from reference.render_patch_modes import average
from reference.surfaces import fitted, leaves, sphere, sphere_points, torus_points
from test_render_project import cameras, staged

from clsurf.errors import InputError
from clsurf.io import images
from clsurf.render.camera import Camera
from clsurf.render.differentials import DIFFERENTIALS
from clsurf.render.renderer import Renderer
from clsurf.render.slim_drawing import SlimDrawing
from clsurf.surface.patch import PatchSurface

SMALL = (44, 35)  # for the twins, which ask every surfel at every pixel
SIZE = (90, 70)
SECOND = tuple(name for name, (_, order) in DIFFERENTIALS.items() if order == 2)
ALL = tuple(DIFFERENTIALS)


def names_of(degree):
    return ALL if degree == 3 else SECOND


@pytest.fixture(scope="module", params=(2, 3))
def torus(request):
    return fitted(*torus_points(3000), 0.2, request.param)


# Exact reproduction ---------------------------------------------------------------------------------------------------

K = np.array([0.02, 0.1, -0.15, 0.35, 0.2, -0.3, 0.2, -0.15, 0.1, 0.12])  # w = h(u, v) of the lonely surfel
STEP = 1e-5


def graph(u, v):
    """h and its derivatives hu, hv, huu, huv, hvv."""
    a, b, c, d, e, f, g, h, i, j = K
    return (a + b * u + c * v + d * u * u + e * u * v + f * v * v + g * u**3 + h * u * u * v + i * u * v * v + j * v**3,
            b + 2 * d * u + e * v + 3 * g * u * u + 2 * h * u * v + i * v * v,
            c + e * u + 2 * f * v + h * u * u + 2 * i * u * v + 3 * j * v * v,
            2 * d + 6 * g * u + 2 * h * v, e + 2 * h * u + 2 * i * v, 2 * f + 2 * i * u + 6 * j * v)


def fundamental(u, v):
    """First and second fundamental forms (..., 2, 2) in (u, v), and the unit normal; positive where it bends down."""
    _, hu, hv, huu, huv, hvv = graph(u, v)
    root = np.sqrt(1 + hu * hu + hv * hv)
    first = np.stack([np.stack([1 + hu * hu, hu * hv], -1), np.stack([hu * hv, 1 + hv * hv], -1)], -2)
    second = -np.stack([np.stack([huu, huv], -1), np.stack([huv, hvv], -1)], -2) / root[..., None, None]
    return first, second, np.stack([-hu, -hv, np.ones_like(hu)], -1) / root[..., None]


def principal(u, v):
    """k1 >= k2 and their directions (..., 2) in (u, v), of unit length on the surface."""
    first, second, _ = fundamental(u, v)
    values, vectors = np.linalg.eig(np.linalg.solve(first, second))
    order = np.argsort(-values, axis=-1)
    values = np.take_along_axis(values, order, -1)
    vectors = np.take_along_axis(vectors, order[..., None, :], -1)
    length = np.sqrt(np.einsum("...ai,...ab,...bi->...i", vectors, first, vectors))
    return values, np.moveaxis(vectors / length[..., None, :], -1, -2)


def radial(u, v, eye):
    """Radial curvature and the radial direction in (u, v); `eye` (position or None, direction)."""
    first, second, n = fundamental(u, v)
    h, hu, hv = graph(u, v)[:3]
    toward = eye[1] if eye[0] is None else eye[0] - np.stack([u, v, h], -1)
    toward = np.broadcast_to(toward, n.shape)
    dot = np.stack([toward[..., 0] + hu * toward[..., 2], toward[..., 1] + hv * toward[..., 2]], -1)
    w = np.linalg.solve(first, dot[..., None])[..., 0]
    w /= np.sqrt(np.einsum("...a,...ab,...b->...", w, first, w))[..., None]
    return np.einsum("...a,...ab,...b->...", w, second, w), w


def slope_along(function, u, v, direction):
    """Central difference of function(u, v) along `direction` (..., 2)."""
    du, dv = STEP * direction[..., 0], STEP * direction[..., 1]
    return (function(u + du, v + dv) - function(u - du, v - dv)) / (2 * STEP)


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("which", range(2))
@pytest.mark.parametrize("side", (1, -1))
def test_lonely_surfel(device, lanes, which, side):
    """One surfel whose polynomial is known: curvature of its graph, and derivatives by differences of that."""
    surface = leaves([[0, 0, 0]], [1.0], [[0, 0, 1.0]], K[None], 3)
    eye = np.array([0.9, 0.6, 3.0 * side])
    camera = (Camera.look_at(eye, (0, 0, 0), fov=30), Camera.orthographic(eye, (0, 0, 0), height=2))[which]
    with Renderer(device, lanes=lanes) as r:
        frame = r.render(surface, camera, SIZE, ("depth", "position", *ALL))
    hit = np.isfinite(frame.depth)
    assert hit.sum() > 500
    point = (frame.position[hit] + frame.origin).astype(np.float64)
    u, v = point[:, 0], point[:, 1]
    assert np.abs(graph(u, v)[0] - point[:, 2]).max() < 1e-5
    got = {name: frame.channels[name][hit].astype(np.float64) for name in ALL}
    values, directions = principal(u, v)
    apart = values[:, 0] - values[:, 1] > 0.1
    toward = (camera.eye, None) if which == 0 else (None, eye / np.linalg.norm(eye))
    kr, w = radial(u, v, toward)
    wanted = {"k1": values[:, 0], "k2": values[:, 1], "mean": values.mean(axis=1), "gaussian": values.prod(axis=1),
              "radial": kr, "radial_derivative": slope_along(lambda a, b: radial(a, b, toward)[0], u, v, w)}
    for name, value in wanted.items():
        # Seen along the normal, the radial direction turns ever faster: 0.0019 off on PoCL, 0.0026 on llvmpipe.
        assert np.abs(got[name] - value).max() < (3e-3 if name == "radial_derivative" else 2e-4), name
    for i in range(2):
        own = directions[:, i]
        _, hu, hv = graph(u, v)[:3]
        space = np.stack([own[:, 0], own[:, 1], hu * own[:, 0] + hv * own[:, 1]], axis=1)
        cosine = (space * got[f"direction{i + 1}"]).sum(axis=1)
        assert np.abs(np.abs(cosine[apart]) - 1).max() < 1e-4
        change = slope_along(lambda a, b, i=i: principal(a, b)[0][:, i], u, v, own * np.sign(cosine)[:, None])
        assert np.abs(got[f"derivative{i + 1}"] - change)[apart].max() < 1e-3


# Twins ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("oriented", (True, False))
@pytest.mark.parametrize("which", range(3))
def test_differentials(device, torus, which, oriented):
    degree, camera = torus.degree, cameras()[which]
    surface = leaves(torus.centers, torus.radii, torus.normals, torus.coefficients, degree, oriented=oriented)
    _, _, view, _, records, footprints = staged(device, surface, camera, SMALL)
    full = device.download(footprints.full)
    shown = np.flatnonzero(full[:, 0] <= full[:, 2])
    records, pixels = device.download(records)[shown].astype(np.float64), render.pixel_centres(SMALL)
    found = render.tile_slim(degree, view, records, pixels, oriented)
    tensors = twin.blended_tensors(degree, view, records, surface.normals[shown], pixels, found.hit, found.side,
                                   oriented)
    wanted = twin.channels(view, *tensors, pixels, found.side if oriented else None)
    with Renderer(device) as r:
        frame = r.render(surface, camera, SMALL, ("depth", *names_of(degree)))
    hit = np.isfinite(frame.depth).ravel()
    both = hit & np.isfinite(found.depth)
    assert both.sum() > 100
    for name in names_of(degree):
        got, value = frame.channels[name].reshape(len(hit), -1), wanted[name].reshape(len(hit), -1)
        assert np.isnan(got[~hit]).all()
        if name.startswith("d"):  # directions have no sign, and their derivatives that of the direction
            own = f"direction{name[-1]}"
            dot = (frame.channels[own].reshape(-1, 3) * (wanted[own] @ camera.rotation)).sum(axis=1)
            value = np.sign(dot)[:, None] * value
        if name.startswith("direction"):
            close = np.abs(dot)[both] > 1 - 1e-4
        else:
            close = np.abs(got - value)[both] < 2e-3 * np.nanmedian(np.abs(value)) + 1e-3 * np.abs(value[both])
        assert close.mean() > 0.99, (name, close.mean())


@pytest.fixture(scope="module", params=(1, 2, 3))
def fine_torus(request):
    """Surfels so flat that each one whose ball holds a point of the surface may show at that point's pixel."""
    return fitted(*torus_points(8000), 0.07, request.param, 2.0)


@pytest.mark.parametrize("which, oriented, lanes", [(0, True, 16), (1, False, 1), (2, True, 16), (2, False, 16)])
def test_blend_function(device, fine_torus, which, oriented, lanes):
    """Derivatives of the blended function, against differences of that function at the pixels' places."""
    camera, t = cameras()[which], fine_torus
    surface = leaves(t.centers, t.radii, t.normals, t.coefficients, t.degree, oriented=oriented)
    with Renderer(device, lanes=lanes) as r:
        frame, other = (r.render(surface, camera, SMALL, ("depth", "normal", "position", *more),
                                 slim=SlimDrawing(kind))
                        for kind, more in (("function", ("mean", "gaussian")), ("separate", ())))
    assert np.array_equal(frame.depth, other.depth, equal_nan=True)
    hit = np.isfinite(frame.depth)
    got = {name: frame.channels[name][hit][::9] for name in ("normal", "position", "mean", "gaussian")}
    points = (got["position"] + frame.origin).astype(np.float64)
    facing = np.full(len(points), -1.0 if which == 2 else 1.0)
    gradient, hessian = twin.function_tensors(surface.degree, surface, camera, points, facing)
    length = np.linalg.norm(gradient, axis=1)
    n = gradient / length[:, None]
    project = np.eye(3) - n[:, :, None] * n[:, None]
    shape = project @ hessian @ project / length[:, None, None]
    mean, square = np.trace(shape, axis1=1, axis2=2) / 2, np.einsum("pab,pba->p", shape, shape)
    # At contours a surfel may turn its front or its back to the eye: there the twin and the kernel may differ.
    ray = points - camera.eye if camera.height is None else np.broadcast_to(camera.rotation[2], points.shape)
    plain = np.abs((n * ray).sum(axis=1)) > 0.3 * np.linalg.norm(ray, axis=1)
    assert plain.mean() > 0.7
    assert (np.abs((n * got["normal"]).sum(axis=1)) > 1 - 1e-5)[plain].mean() > 0.97
    for name, value in {"mean": mean, "gaussian": 2 * mean**2 - square / 2}.items():
        close = np.abs(got[name] - value) < 0.02 * np.abs(value) + 0.02 * np.median(np.abs(value))
        # Planes pass by points in their balls farther off, and need not show there.
        assert close[plain].mean() > (0.94 if surface.degree == 1 else 0.97), (name, close[plain].mean())


def test_lonely_surfel_is_its_own_blend(device):
    """With one surfel both sides of equation 8 are the same."""
    surface, camera = leaves([[0, 0, 0]], [1.0], [[0, 0, 1.0]], K[None], 3), Camera.look_at((1, 1, 3), (0, 0, 0))
    with Renderer(device) as r:
        one, two = (r.render(surface, camera, SIZE, ("normal", *SECOND), slim=SlimDrawing(kind))
                    for kind in ("separate", "function"))
        with pytest.raises(InputError, match=r"radial_derivative.*separate"):
            r.render(surface, camera, SIZE, ("radial_derivative",), slim=SlimDrawing("function"))
        with pytest.raises(InputError, match="SlimDrawing"):
            r.render(surface, camera, SIZE, slim="function")
    with pytest.raises(InputError, match="separate, function"):
        SlimDrawing("right")
    for name in ("normal", "mean", "gaussian", "k1", "k2", "radial"):
        assert np.nanmax(np.abs(one.channels[name] - two.channels[name])) < 2e-4, name


# Independence ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", range(3))
def test_kernel_forms_and_tiles_agree(device, torus, which):
    frames = []
    for lanes, tile in ((16, None), (16, 8), (8, None), (4, 24), (1, None)):
        with Renderer(device, lanes=lanes, tile=tile) as r:
            frames.append(r.render(torus, cameras()[which], SIZE, ("depth", *names_of(torus.degree))))
    for frame in frames[1:]:
        for name in names_of(torus.degree):
            one, two = frames[0].channels[name], frame.channels[name]
            assert np.isclose(one, two, rtol=1e-3, atol=2e-3, equal_nan=True).mean() > 0.995, name


@pytest.mark.parametrize("factor", (1e-6, 1.0, 1e5))
def test_placed_surfaces_have_world_curvature(device, torus, factor):
    """Turned, moved and scaled: curvature goes with 1 / scale, its derivatives with the square, directions turn."""
    turn = Camera.look_at((1, 2, 3), (0, 0, 0)).rotation
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = factor * turn, factor * np.array([3.0, -2.0, 1.0])
    camera, names = cameras()[0], names_of(torus.degree)
    middle = matrix[:3, :3] @ camera.eye + matrix[:3, 3]
    other = Camera(eye=middle, rotation=camera.rotation @ turn.T, fov=camera.fov)
    with Renderer(device) as r:
        one = r.render(torus, camera, SIZE, ("depth", *names))
        two = r.render(torus.moved(matrix), other, SIZE, ("depth", *names))
    both = np.isfinite(one.depth) & np.isfinite(two.depth)
    assert (np.isfinite(one.depth) == np.isfinite(two.depth)).mean() > 0.998
    for name in names:
        power = 2 if name == "gaussian" or DIFFERENTIALS[name][1] == 3 else 1
        a, b = one.channels[name][both], two.channels[name][both]
        if name.startswith("direction"):
            close = np.abs((a @ turn.T * b).sum(axis=1)) > 1 - 1e-3
        else:
            b = b * factor**power
            if name.startswith("derivative"):
                a, b = np.abs(a), np.abs(b)
            close = np.isclose(a, b, rtol=0.01, atol=0.01 * np.median(np.abs(a)))
        assert close.mean() > 0.98, (name, close.mean())


def test_sides(device):
    """The sign follows the stored normals; from inside too; without orientation it is that of the side that is seen."""
    ball = sphere(400, 2.0, reach=1.3)
    turned = leaves(ball.centers, ball.radii, -ball.normals, -ball.coefficients, 2)
    loose = leaves(ball.centers, ball.radii, ball.normals, ball.coefficients, 2, oriented=False)
    outside, inside = Camera.look_at((0, 1, 6), (0, 0, 0)), Camera.look_at((0, 0, 0), (1, 0.3, 0.2), fov=70)
    with Renderer(device) as r:
        for surface, camera, sign in ((ball, outside, 1), (ball, inside, 1), (turned, outside, -1),
                                      (turned, inside, -1), (loose, outside, 1), (loose, inside, -1)):
            frame = r.render(surface, camera, SIZE, ("mean", "gaussian", "k1", "k2", "radial"))
            hit = np.isfinite(frame.mean)
            assert hit.sum() > 1000
            for name in ("mean", "k1", "k2", "radial"):
                assert np.quantile(np.abs(frame.channels[name][hit] - sign / 2), 0.98) < 0.06, name
            assert np.abs(np.median(frame.gaussian[hit]) - 0.25) < 0.02


@pytest.mark.parametrize("lanes", (16, 1))
def test_scenes(device, torus, lanes):
    """Patches in front have no curvature, those behind do not matter, and a second surface keeps its own."""
    camera, names = Camera.look_at((0, 0.5, 6), (0, 0, 0)), names_of(torus.degree)
    ball, shift = fitted(*sphere_points(600, 0.5), 0.15, torus.degree), np.eye(4)
    shift[0, 3] = 1.0
    plate = flat_patches()
    with Renderer(device, lanes=lanes) as r:
        for depth, order in ((1.5, 1), (1.5, -1), (-1.5, 1), (-1.5, -1)):
            place = np.eye(4)
            place[2, 3] = depth
            frame = r.render([torus, ball.moved(shift), plate.moved(place)][::order], camera, SIZE,
                             ("depth", "id", *names))
            alone = r.render([torus, ball.moved(shift)], camera, SIZE, ("depth", *names))
            patch = frame.id == (2 if order == 1 else 0)
            seen = (frame.id >= 0) & ~patch
            assert patch.sum() > 200 and (seen.sum() > 200)
            for name in names:
                got, wanted = frame.channels[name], alone.channels[name]
                assert np.isnan(got[patch | (frame.id < 0)]).all() and np.isfinite(got[seen]).all(), name
                assert np.array_equal(got[seen], wanted[seen]), name
        with pytest.raises(InputError, match="degree 2 or more"):
            r.render([torus, fitted(*torus_points(300), 0.5, 1)], camera, SIZE, ("mean",))
        with pytest.raises(InputError, match="expected a SlimSurface"):
            r.render(plate, camera, SIZE, ("mean",))


def flat_patches():
    """A square patch of 5 x 5 nodes in the plane z = 0, from (-1, -0.7) to (0.6, 0.9)."""
    return PatchSurface(origins=[[-1.0, -0.7, 0]], axis_x=[[0.4, 0, 0]], axis_y=[[0, 0.4, 0]], axis_z_length=[0.01],
                        size=[[5, 5]], displacements=np.zeros(25, np.int8), color=(0, 90, 0))


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("factor", (2, 3))
def test_supersampling(device, torus, factor, lanes):
    """Every channel comes from the sample that the depth comes from."""
    camera, names = cameras()[0], names_of(torus.degree)
    large = tuple(factor * n for n in SIZE)
    with Renderer(device, lanes=lanes) as r:
        fine = r.render(torus, camera, large, ("depth", *names))
        got = r.render(torus, camera, SIZE, (*names, "depth"), supersampling=factor)
        lonely = r.render(torus, camera, SIZE, ("direction2",), supersampling=factor)
    assert list(got.channels) == [*names, "depth"] and list(lonely.channels) == ["direction2"]
    wanted = average({name: fine.channels[name] for name in ("depth", *names)}, factor)
    for name in ("depth", *names):
        assert np.array_equal(got.channels[name], wanted[name], equal_nan=True), name
    assert np.array_equal(lonely.direction2, got.direction2, equal_nan=True)


@pytest.mark.parametrize("lanes", (16, 1))
def test_lone_channels(device, lanes):
    """Each channel alone is the one that comes with all others."""
    surface = fitted(*torus_points(1500), 0.3, 3)
    with Renderer(device, lanes=lanes) as r:
        whole = r.render(surface, cameras()[0], SIZE, ALL)
        for name in ALL:
            lone = r.render(surface, cameras()[0], SIZE, (name,))
            assert list(lone.channels) == [name] and lone.channels[name].dtype == np.float32
            assert lone.channels[name].shape == (*SIZE[::-1], 3)[:2 + (DIFFERENTIALS[name][0] > 0)]
            same = np.isclose(lone.channels[name], whole.channels[name], rtol=1e-4, atol=1e-4, equal_nan=True)
            assert same.mean() > 0.999, name


def test_exr_holds_them(device, tmp_path):
    surface = fitted(*torus_points(1500), 0.3, 3)
    with Renderer(device) as r:
        frame = r.render(surface, cameras()[0], SIZE, ("color", *ALL))
    frame.save(tmp_path / "torus.exr")
    read = images.read_channels(tmp_path / "torus.exr")
    assert np.array_equal(read["radial_derivative"], frame.radial_derivative, equal_nan=True)
    assert np.array_equal(read["direction1.2"], frame.direction1[..., 2], equal_nan=True)
    assert {"mean", "gaussian", "k1", "k2", "derivative1", "derivative2", "radial", "direction2.0"} <= set(read)


# Odd input ------------------------------------------------------------------------------------------------------------


def test_directions_are_a_frame(device, torus):
    """Unit, tangent, at right angles; also where the sphere has no first direction."""
    with Renderer(device) as r:
        for surface in (torus, sphere(300)):
            frame = r.render(surface, cameras()[0], SIZE, ("normal", "direction1", "direction2"))
            hit = np.isfinite(frame.direction1[..., 0])
            n, a, b = (frame.channels[name][hit] for name in ("normal", "direction1", "direction2"))
            for x, y, wanted in ((a, a, 1), (b, b, 1), (a, b, 0), (a, n, 0), (b, n, 0)):
                assert np.abs((x * y).sum(axis=1) - wanted).max() < 1e-4
            assert np.abs(np.cross(n, a) - b).max() < 1e-4


@pytest.mark.parametrize("lanes", (16, 1))
def test_odd_surfaces(device, lanes):
    """Flat, seen straight on, tiny, huge and far from zero, not finite, empty: finite values or none."""
    flat = np.zeros((1, 10))
    bowl = np.zeros((1, 10))
    bowl[0, 3] = bowl[0, 5] = -0.5
    with Renderer(device, lanes=lanes) as r:
        for size in (1e-12, 1e-6, 1.0, 1e6, 1e12):
            for k, wanted in ((flat, 0.0), (bowl * size**-1.0, 1 / size)):
                surface = leaves([[0, 0, 0]], [size], [[0, 0, 1.0]], k, 3, origin=(1e9 * size, 0, 0))
                for camera in (Camera.look_at((1e9 * size, 0, 3 * size), (1e9 * size, 0, 0)),
                               Camera.orthographic((1e9 * size, 0, 3 * size), (1e9 * size, 0, 0), height=2 * size)):
                    frame = r.render(surface, camera, (33, 33), ("depth", *ALL))
                    hit = np.isfinite(frame.depth)
                    assert hit.sum() > 100
                    for name in ALL:
                        assert np.isfinite(frame.channels[name][hit]).all(), (name, size)
                    assert abs(frame.mean[16, 16] - wanted) < 1e-3 / size
                    assert np.abs(frame.k1[hit]).max() < 1.1 / size
                    assert np.abs(frame.derivative1[hit]).max() < 1 / size**2
        bad = leaves(np.zeros((2, 3)), [1.0, 1.0], [[0, 0, 1.0]] * 2, [[np.nan] * 10, [0] * 10], 3)
        frame = r.render(bad, Camera.look_at((0, 0, 3), (0, 0, 0)), (33, 33), ("depth", *ALL))
        assert np.nanmax(np.abs(frame.k1)) == 0 and np.isfinite(frame.depth).sum() > 100
        empty = leaves(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 10)), 3)
        frame = r.render(empty, Camera.look_at((0, 0, 3), (0, 0, 0)), (33, 33), ALL)
        assert all(np.isnan(frame.channels[name]).all() for name in ALL)


def test_what_has_no_curvature_is_refused(device, torus):
    with Renderer(device) as r:
        with pytest.raises(InputError, match="channel mean: expected a SlimSurface"):
            r.render([], None, SIZE, ("mean",))
        with pytest.raises(InputError, match="degree 2 or more, got degree 1"):
            r.render(fitted(*torus_points(300), 0.5, 1), None, SIZE, ("color", "k1"))
        with pytest.raises(InputError, match="channel derivative1: expected surfels of degree 3"):
            r.render(sphere(50), None, SIZE, ("mean", "derivative1"))
        with pytest.raises(InputError, match="ball_size"):
            r.render(sphere(50), None, SIZE, ("mean",), shading="ball_size")
