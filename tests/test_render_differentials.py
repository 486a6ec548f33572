"""Channels of curvature: exact reproduction, analytic surfaces, twins, independence."""

import numpy as np
import pytest
from reference import differentials as twin
from reference import render
from reference.surfaces import fitted, leaves, sphere, torus_points
from test_render_project import cameras, staged

from clsurf.errors import InputError
from clsurf.render.camera import Camera
from clsurf.render.differentials import DIFFERENTIALS
from clsurf.render.renderer import Renderer
from clsurf.render.slim_drawing import SlimDrawing

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
        # Seen along the normal, the radial direction turns ever faster.
        assert np.abs(got[name] - value).max() < (2e-3 if name == "radial_derivative" else 2e-4), name
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
    wanted = twin.channels(view, *tensors, pixels)
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
