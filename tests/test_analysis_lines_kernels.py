"""The kernels of feature lines equal their twins, in both forms, in perspective and orthographic."""

import numpy as np
import pytest
from reference import lines as twin
from reference.implicit import Torus, Waves, implicit_channels

from clsurf.analysis.line_draw import draw_lines
from clsurf.analysis.line_planes import MARGIN_X, MARGIN_Y, Field, LinePlanes, edge_numbers, gaussian_weights
from clsurf.analysis.line_strokes import Lines
from clsurf.render.camera import Camera
from clsurf.render.frame import Frame

SIZE = (75, 61)
CAMERAS = {"perspective": Camera.look_at((0.8, -3.4, 1.8), (0, 0, 0), up=(0, 0, 1), fov=35),
           "orthographic": Camera.orthographic((0.8, -3.4, 1.8), (0, 0, 0), up=(0, 0, 1), height=2.2)}
RADIAL = Field("radial", "radial_derivative", sines=True, power=2)
RIDGES = Field("derivative1", "k1", axis="direction1")
CREST = Field("derivative2", "k2", sign=-1, axis="direction2", extremum=-1, other="k1")


def frame_of(shape, camera, size=SIZE):
    return Frame(implicit_channels(shape, camera, size), np.zeros(3), camera)


def cropped(planes, array, count=1):
    """The planes on the device, (count, h, w) or (h, w), without margins."""
    whole = planes.device.download(array).reshape(-1, planes.rows, planes.stride)[:count]
    inner = whole[:, MARGIN_Y:MARGIN_Y + planes.height, MARGIN_X:MARGIN_X + planes.width]
    return inner[0] if count == 1 else inner


@pytest.fixture(scope="module", params=[("perspective", "torus"), ("orthographic", "torus"), ("perspective", "waves")],
                ids="-".join)
def frame(request):
    shape = Torus() if request.param[1] == "torus" else Waves(0.25, 4.0)
    return frame_of(shape, CAMERAS[request.param[0]])


@pytest.fixture(scope="module")
def geometry(frame):
    with np.errstate(invalid="ignore"):
        slopes = twin.line_slopes(frame.camera, frame.depth.astype(float), frame.normal.astype(float))
    bits = twin.line_links(frame.camera, frame.depth.astype(float), *slopes[:2])
    return *slopes, bits


@pytest.mark.parametrize("lanes", (16, 8, 1))
def test_line_slopes_and_line_links(device, frame, geometry, lanes):
    planes = LinePlanes(device, frame, lanes)
    hit = np.isfinite(frame.depth)
    assert 500 < hit.sum() < hit.size
    assert np.array_equal(cropped(planes, planes.depths), frame.depth, equal_nan=True)
    for name, wanted in zip(("slope_x", "slope_y", "sine2"), geometry, strict=False):
        got = cropped(planes, planes._array(name))
        assert np.abs(got - wanted)[hit].max() < 2e-3 * np.abs(wanted[hit]).max()
    links = cropped(planes, planes.links)
    assert (links != geometry[3]).mean() < 2e-3  # rounding at the limit
    inside = np.zeros((planes.rows, planes.stride), bool)
    inside[MARGIN_Y:-MARGIN_Y, MARGIN_X:MARGIN_X + SIZE[0]] = True
    assert not device.download(planes.links).reshape(inside.shape)[~inside].any()


@pytest.mark.parametrize("lanes", (16, 1))
@pytest.mark.parametrize("field", (RADIAL, RIDGES, CREST), ids=("radial", "ridges", "crest"))
@pytest.mark.parametrize("sigma", (1.3, 0.0))
def test_line_values_smooth_lines_line_edges_line_points(device, frame, geometry, lanes, field, sigma):
    planes = LinePlanes(device, frame, lanes)
    bits = cropped(planes, planes.links)
    found = planes.field_crossings(field, sigma, 0.05)()
    values = twin.line_values(bits, geometry[2], frame.channels[field.field], frame.channels[field.strength],
                              field.sign, frame.channels[field.other] if field.other else None,
                              frame.channels[field.axis] if field.axis else None, field.sines)
    count = len(values)
    got = cropped(planes, planes._array("values", count), count)
    assert np.abs(got - values).max() <= 1e-5 * np.abs(values).max()
    smooth, strength = twin.smooth_lines(bits, values, gaussian_weights(sigma).astype(float))
    got, got_strength = cropped(planes, planes._array("field")), cropped(planes, planes._array("strength"))
    assert np.array_equal(np.isnan(got), np.isnan(smooth)) and np.isfinite(smooth).sum() > 300
    good, hit = np.isfinite(smooth), bits & 1 > 0
    assert np.abs(got - smooth)[good].max() <= 2e-5 * np.abs(smooth[good]).max()
    assert np.abs(got_strength - strength)[hit].max() <= 2e-5 * np.abs(strength[hit]).max()
    # From here on with the device's own planes, so that rounding does not decide.
    axis = np.moveaxis(values[4:], 0, -1) if field.axis else None
    codes = twin.line_edges(frame.camera, frame.depth.astype(float), got.astype(float), got_strength.astype(float),
                            0.05, axis, field.extremum)
    mine = np.zeros((planes.height, planes.columns), np.uint8)
    np.bitwise_or.at(mine.reshape(-1), found.edges >> 1, (1 + (found.edges & 1)).astype(np.uint8))
    assert (mine[:, :planes.width] != codes).sum() <= 2 and not mine[:, planes.width:].any()
    wanted = twin.line_points(found.edges, planes.columns, bits, frame.depth.astype(float), geometry[2],
                              got.astype(float), got_strength.astype(float), axis)
    if len(wanted):
        assert np.abs(found.points - wanted).max() < 1e-3


@pytest.mark.parametrize("lanes", (16, 8, 1))
def test_contour_edges_and_line_points(device, frame, geometry, lanes):
    planes = LinePlanes(device, frame, lanes)
    found = planes.contour_crossings()()
    bits = cropped(planes, planes.links)
    codes = np.zeros((planes.height, planes.columns), np.uint8)
    codes[:, :planes.width] = twin.contour_edges(bits, frame.depth)
    assert np.array_equal(edge_numbers(codes), found.edges) and len(found.edges) > 50
    wanted = twin.line_points(found.edges, planes.columns, bits, frame.depth.astype(float), geometry[2])
    assert np.abs(found.points - wanted)[:, 2:].max() < 1e-5
    # The extrapolation is ill-conditioned where the cosine hardly falls.
    assert np.median(np.abs(found.points - wanted)[:, :2]) < 1e-4 and np.abs(found.points - wanted).max() <= 1


@pytest.mark.parametrize("lanes", (16, 1))
def test_draw_strokes_and_blend_strokes(device, lanes, monkeypatch):
    monkeypatch.setattr(device, "lanes", lanes)
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-5, 70, (40, 2)), np.full((1, 2), 30.5)]).astype(np.float32)
    strength = rng.uniform(0, 1, len(points)).astype(np.float32)
    offset = np.array([0, 12, 30, 40, 41])
    kind, closed = np.array([0, 1, 0, 1], np.int32), np.array([False, True, False, False])
    found = Lines((64, 48), ("ridges", "valleys"), points, np.zeros((41, 3)), strength, offset, kind, closed, device)
    palette = np.array([[1, 1, 1, 1], [0, 0, 0.5, 1], [0.5, 0, 0, 1]], np.float32)
    width, ink = (0.5, 4.0), (0.2, 0.9)
    strokes = np.stack([*points.T, (0.5 + 3.5 * strength) / 2, 0.2 + 0.7 * strength], axis=1)
    line = np.repeat(kind, np.diff(offset))
    assert len(found.segments) == 11 + 18 + 9
    wanted, color = twin.draw_strokes(strokes, found.segments, 1 + line[found.segments[:, 0]], (64, 48))
    for picture in (None, rng.uniform(0, 1, (48, 64, 4)).astype(np.float32)):
        got, inked = draw_lines(found, (64, 48), picture, width, ink, palette)
        assert np.abs(inked - wanted).max() < 1e-4 and 0.1 < inked.mean() < 0.9
        under = palette[0] if picture is None else picture
        assert np.median(np.abs(got - twin.blend_strokes(under, wanted, color, palette))) < 1e-5
        assert np.array_equal(got[inked == 0], np.broadcast_to(under, got.shape)[inked == 0])
