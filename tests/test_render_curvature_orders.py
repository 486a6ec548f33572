"""Channels of curvature on analytic surfaces: orders of convergence, minimal surfaces, independence of the view."""

import numpy as np
import pytest
from reference import parametric
from reference.parametric import PIECES, parameters, piece_points, principal
from reference.surfaces import fitted
from scipy.interpolate import LinearNDInterpolator

from clsurf.render.camera import Camera
from clsurf.render.renderer import Renderer

SIZE = (60, 60)
COARSE, FINE = 0.2, 0.07  # between surfels; their radius is 2.6 times that


def surfaces(piece, degree):
    return [fitted(*piece_points(piece, h / 5), h, degree) for h in (COARSE, FINE)]


def camera_of(piece, tilt=(0.3, 0.2)):
    """Looks at the piece's middle, along its normal but for `tilt`."""
    (middle,), (n,) = piece(*np.zeros((2, 1))), parametric.normal(piece, *np.zeros((2, 1)))
    (a,), (b,) = parametric.tangents(piece, *np.zeros((2, 1)))
    toward = n + tilt[0] * a / np.linalg.norm(a) + tilt[1] * b / np.linalg.norm(b)
    return Camera.orthographic(middle + 3 * toward / np.linalg.norm(toward), middle, height=0.6, up=a)


def rendered(device, surface, camera, names):
    """The channels at the pixels, and the float64 places that they are of."""
    with Renderer(device) as r:
        frame = r.render(surface, camera, SIZE, ("depth", "position", *names), lod=0)
    hit = np.isfinite(frame.depth)
    points = (frame.position[hit] + frame.origin).astype(np.float64)
    assert hit.mean() > 0.8
    return {name: frame.channels[name][hit].reshape(len(points), -1).astype(np.float64) for name in names}, points


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def order(coarse, fine):
    """The power of the surfels' size that an error falls with."""
    return np.log(coarse / fine) / np.log(COARSE / FINE)


@pytest.mark.parametrize("degree, least", ((2, 1.5), (3, 1.7)))
@pytest.mark.parametrize("name", PIECES)
def test_order_of_curvature(device, name, degree, least):
    """Errors of k1 and k2 fall as h^(degree - 1) at least: measured 1.8 to 2.2 for degree 2, 1.75 to 2.3 for 3."""
    piece, errors = PIECES[name], []
    camera = camera_of(piece)
    for surface in surfaces(piece, degree):
        got, points = rendered(device, surface, camera, ("mean", "gaussian", "k1", "k2"))
        got = {n: got[n][:, 0] for n in got}
        values, _ = principal(piece, *parameters(piece, points))
        size = rms(values)
        assert np.abs(got["mean"] - (got["k1"] + got["k2"]) / 2).max() < 1e-4 * size
        assert np.abs(got["gaussian"] - got["k1"] * got["k2"]).max() < 1e-4 * size**2
        assert (got["k1"] >= got["k2"]).all()
        errors.append(rms(np.stack([got["k1"], got["k2"]], axis=1) - values) / size)
    assert errors[1] < (0.03 if degree == 2 else 0.005) and order(*errors) > least, (errors, order(*errors))


@pytest.mark.parametrize("name", ("catenoid", "enneper"))
def test_minimal_surfaces(device, name):
    """H = 0 and K < 0: what is left of the mean is a small part of the principal curvatures."""
    piece = PIECES[name]
    got, points = rendered(device, surfaces(piece, 3)[1], camera_of(piece), ("mean", "gaussian"))
    u, v = parameters(piece, points)
    k = 1 / np.cosh(v) ** 2 if name == "catenoid" else 2 / (1 + u * u + v * v) ** 2
    assert np.abs(got["mean"]).max() < 0.02 * k.max() and rms(got["mean"]) < 0.005 * rms(k)
    assert np.abs(got["gaussian"][:, 0] + k * k).max() < 0.05 * (k * k).max()


@pytest.mark.parametrize("name", ("torus", "ellipsoid", "catenoid"))
def test_derivatives(device, name):
    """Derivatives of the principal curvatures along their directions, order 1 for cubic surfels."""
    piece, errors = PIECES[name], []
    camera = camera_of(piece)
    for surface in surfaces(piece, 3):
        got, points = rendered(device, surface, camera, ("derivative1", "derivative2", "direction1", "direction2"))
        u, v = parameters(piece, points)
        _, directions = principal(piece, u, v)
        ru, rv = parametric.tangents(piece, u, v)
        for i in range(2):
            own = directions[:, i]
            space = own[:, :1] * ru + own[:, 1:] * rv
            cosine = (space * got[f"direction{i + 1}"]).sum(axis=1)
            assert np.median(np.abs(cosine)) > 0.999
            along = (own * np.sign(cosine)[:, None]).T
            wanted = parametric.difference(lambda a, b, i=i: principal(piece, a, b)[0][:, i], u, v, *along)
            errors.append(rms(got[f"derivative{i + 1}"][:, 0] - wanted))
    coarse, fine = np.linalg.norm(np.reshape(errors, (2, 2)), axis=1)
    assert fine < 0.1 and order(coarse, fine) > 0.8, (coarse, fine)


@pytest.mark.parametrize("degree, most", ((2, 0.03), (3, 0.012)))
def test_view_dependence_is_bounded(device, degree, most):
    """The same place seen from 60 degrees apart has the same curvature, up to a part of the surfels' own error."""
    piece = PIECES["torus"]
    surface = surfaces(piece, degree)[1]
    fits = []
    for tilt in ((0.55, 0.0), (-0.55, 0.0)):
        got, points = rendered(device, surface, camera_of(piece, tilt), ("mean",))
        at = np.stack(parameters(piece, points), axis=1)
        fits.append((at, got["mean"][:, 0]))
    other = LinearNDInterpolator(*fits[1])(fits[0][0])
    both = np.isfinite(other)
    assert both.mean() > 0.5
    values, _ = principal(piece, *fits[0][0].T)
    apart = (other - fits[0][1])[both]
    assert rms(apart) < most * rms(values) and np.abs(apart).max() < 6 * most * rms(values)
