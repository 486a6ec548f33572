"""Clip planes: the inside of analytic spheres, in both kernel forms, for every kind of surface."""

import numpy as np
import pytest
from reference.scale_map import icosphere, smooth_map
from reference.surfaces import leaves, sphere
from test_render_patches import globe

import clsurf
from clsurf.errors import InputError
from clsurf.render.camera import Camera
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.shade import Shading

SIZE = (90, 70)
EYE = Camera.look_at((1.5, 1.0, 4.0), (0, 0, 0), fov=36)
CAMERAS = {"perspective": EYE, "orthographic": Camera.orthographic((1.5, 1.0, 4.0), (0, 0, 0), height=2.6),
           "near": Camera.look_at((1.5, 1.0, 4.0), (0, 0, 0), fov=36, near=4.1)}
PLANES = {"oblique": [(-1, 0.3, -0.4, 0.1)], "across": [(1, 0, 0, 0)], "facing": [(-3, -2, -8, 3)],
          "behind": [(3, 2, 8, 3)], "along": [(*EYE.rotation[1], 0.2)],
          "two": [(-1, 0, 0, 0.4), (0, 0, -1, 0.3)], "all": [(0, 1, 0, -9)]}


_kept = {}  # surfaces made once


def sphere_depth(camera, planes, radius=1.0):
    """By hand: the first of the two hits of each pixel's ray that all planes keep, and how safe that choice is.

    Returns depth (h, w), NaN for none, and the least of |plane's value| and of half the chord at both hits.
    """
    origins, directions = camera.rays(SIZE)
    b, c = (origins * directions).sum(axis=1), (origins * origins).sum(axis=1) - radius**2
    root = np.sqrt(np.maximum(b * b - c, 0))
    depth, safe = np.full(len(b), np.nan), np.where(b * b > c, root, np.sqrt(np.maximum(c - b * b, 0)))
    for t in (-b + root, -b - root):  # the front one last
        points = origins + t[:, None] * directions
        values = points @ np.array(planes)[:, :3].T + np.array(planes)[:, 3]
        z = -(points - camera.eye) @ camera.rotation[2]
        kept = (b * b > c) & (values >= 0).all(axis=1) & (z > camera.near)
        safe = np.minimum(safe, np.abs(np.column_stack([values, z - camera.near])).min(axis=1))
        depth[kept] = z[kept]
    return depth.reshape(SIZE[::-1]), safe.reshape(SIZE[::-1])


def check(renderer, surface, camera, planes, tolerance, margin, **options):
    frame = renderer.render(surface, camera, SIZE, ("color", "depth", "normal"), lod=0, clip=planes, **options)
    wanted, safe = sphere_depth(camera, planes)
    sure = safe > margin
    assert sure.mean() > 0.5
    np.testing.assert_array_equal(np.isfinite(frame.depth[sure]), np.isfinite(wanted[sure]))
    hit = sure & np.isfinite(wanted)
    if hit.any():
        assert np.abs(frame.depth - wanted)[hit].max() < tolerance
        directions = camera.rays(SIZE)[1]
        facing = (frame.normal.reshape(-1, 3) * directions).sum(axis=1).reshape(hit.shape)
        assert (facing[hit] < 0).all()  # normals face the eye, also on the inside
    return frame


@pytest.mark.parametrize("form", [0, 1], ids=["lanes", "items"])
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("planes", PLANES)
def test_slim_shows_its_inside(form, camera, planes, renderers):
    check(renderers[form], ball(), CAMERAS[camera], PLANES[planes], 2e-3, 0.12)


def ball():
    if "ball" not in _kept:
        _kept["ball"] = sphere(1200)
    return _kept["ball"]


def patches():
    if "globe" not in _kept:
        _kept["globe"] = globe(radius=1.0, nodes=17)
    return _kept["globe"]


@pytest.mark.parametrize("form", [0, 1], ids=["lanes", "items"])
@pytest.mark.parametrize(("cells", "planes"), [("quads", "oblique"), ("quads", "facing"), ("triangles", "oblique")])
def test_patches_show_their_inside(form, planes, cells, renderers):
    # From within, samples of neighbouring patches up to a layer apart compete: 0.022 also without planes.
    check(renderers[form], patches(), EYE, PLANES[planes], 0.03, 0.12, patches=PatchDrawing(cells=cells, mip=False))


@pytest.mark.parametrize(("form", "cells"), [(0, "slim"), (1, "slim"), (0, "quads"), (1, "quads"), (0, "bilinear"),
                                             (1, "bilinear"), (0, "smooth")])
def test_a_plane_across_the_view_is_a_near_plane(form, cells, renderers):
    """Both give the same picture, but for single pixels where they cut; points of subdivided cells are up to half a
    pixel beside the pixel that they show in."""
    surface = ball() if cells == "slim" else patches()
    options = {} if cells == "slim" else {"patches": PatchDrawing(cells=cells, mip=False)}
    camera, ahead = Camera(EYE.eye, EYE.rotation, fov=EYE.fov, near=4.25), -EYE.rotation[2]
    near = renderers[form].render(surface, camera, SIZE, lod=0, **options)
    cut = renderers[form].render(surface, EYE, SIZE, lod=0, clip=[*ahead, -(ahead @ EYE.eye) - 4.25], **options)
    assert 0.1 < np.isfinite(near.depth).mean() and np.nanmin(near.depth) > 4.15
    same = np.isclose(near.depth, cut.depth, atol=1e-5, equal_nan=True)
    # Where they cut, points of two patches, of other colours, may win a pixel and show the same place of its ray.
    same &= np.isclose(near.normal, cut.normal, atol=1e-3, equal_nan=True).all(axis=2)
    assert same.mean() > (0.95 if cells in ("bilinear", "smooth") else 0.995)
    np.testing.assert_allclose(near.color[same], cut.color[same], atol=5e-3)


def others(device):
    """Meshes of small and of large faces, a scale map cast and as a geosphere, surfels; the tolerances of depth."""
    if "others" not in _kept:
        fine, coarse = (clsurf.Mesh(*icosphere(level)) for level in (5, 3))
        _kept["others"] = {"mesh": (fine, 2e-3, {}), "large faces": (coarse, 0.03, {}),
                           "scale map": (smooth_map(32), 1e-3, {}),
                           "geosphere": (smooth_map(32), 0.02,
                                         {"scale_map": clsurf.ScaleMapDrawing("geosphere")}),
                           "surfels": (clsurf.build_surfels(clsurf.models.sphere(8000), device=device), 0.03, {})}
    return _kept["others"]


@pytest.mark.parametrize("form", [0, 1], ids=["lanes", "items"])
@pytest.mark.parametrize("kind", ["mesh", "large faces", "scale map", "geosphere", "surfels"])
@pytest.mark.parametrize(("camera", "planes"), [("perspective", "oblique"), ("perspective", "facing"),
                                                ("orthographic", "oblique"), ("near", "along")])
def test_other_kinds_show_their_inside(form, kind, camera, planes, renderers):
    surface, tolerance, options = others(renderers[0].device)[kind]
    check(renderers[form], surface, CAMERAS[camera], PLANES[planes], tolerance, 0.15, **options)


@pytest.mark.parametrize("form", [0, 1], ids=["lanes", "items"])
def test_patches_of_large_cells(form, renderers):
    """Close up: cells are many pixels large, and some cross the eye's plane."""
    camera = Camera.look_at((0.45, 0.3, 1.2), (0, 0, 0), fov=36)
    check(renderers[form], globe(radius=1.0, nodes=9), camera, PLANES["facing"], 0.01, 0.12)


@pytest.mark.parametrize("form", [0, 1], ids=["lanes", "items"])
def test_patches_of_tiny_cells(form, renderers):
    """Nodes are drawn as they are, into the pixel that they fall into: half a pixel of parallax."""
    frame = renderers[form].render(globe(radius=1.0, nodes=33), EYE, SIZE, ("depth",), lod=0, clip=PLANES["facing"])
    wanted, safe = sphere_depth(EYE, PLANES["facing"])
    sure = safe > 0.35
    assert (np.isfinite(frame.depth) == np.isfinite(wanted))[sure].mean() > 0.995
    error = np.abs(frame.depth - wanted)[sure & np.isfinite(wanted) & np.isfinite(frame.depth)]
    assert np.median(error) < 1e-3 and error.max() < 0.1


@pytest.mark.parametrize("form", [0, 1], ids=["lanes", "items"])
def test_balls_are_cut_open(form, renderers):
    """One ball: behind the plane its far side is seen."""
    one = leaves(np.zeros((1, 3)), np.ones(1), np.array([[0, 0, 1.0]]), np.zeros((1, 1)), 1)
    check(renderers[form], one, EYE, PLANES["facing"], 1e-4, 0.05, shading=Shading(look="ball_size"))


def test_kinds_meet_behind_a_plane(renderers):
    """In one scene, one moved and scaled: the depth is the nearer of both, and both are cut in world space."""
    small, matrix = globe(radius=1.0), np.diag([0.5, 0.5, 0.5, 1])
    planes = PLANES["oblique"]
    scene = clsurf.Scene([ball(), small.moved(matrix)])
    frame = renderers[0].render(scene, EYE, SIZE, ("color", "depth", "id"), lod=0, clip=planes)
    outer, safe = sphere_depth(EYE, planes)
    inner, safe_inner = sphere_depth(EYE, planes, 0.5)
    sure = np.minimum(safe, safe_inner) > 0.12
    wanted = np.fmin(outer, inner)
    hit = sure & np.isfinite(wanted)
    np.testing.assert_allclose(frame.depth[hit], wanted[hit], atol=0.03)
    assert (frame.id[hit] == (inner < outer)[hit]).mean() > 0.999 and set(frame.id[hit]) == {0, 1}


def test_nothing_changes_without_planes_or_with_those_that_cut_nothing(renderers):
    for surface in (ball(), globe(radius=1.0)):
        plain, empty, far = (renderers[0].render(surface, EYE, SIZE, clip=clip)
                             for clip in (None, [], [(0, 0, 1, 50), (0, 3, 0, 50)]))
        for name in ("color", "depth", "normal"):
            np.testing.assert_array_equal(plain.channels[name], empty.channels[name])
            np.testing.assert_array_equal(np.isfinite(plain.depth), np.isfinite(far.depth))
            np.testing.assert_allclose(plain.channels[name], far.channels[name], atol=1e-4)


def test_far_from_the_origin(renderers):
    """Survey coordinates: the plane is moved along, nothing else changes."""
    shift = np.array([7_691_239.0, 5_000_017.0, 300.0])
    matrix = np.eye(4)
    matrix[:3, 3] = shift
    camera = Camera(EYE.eye + shift, EYE.rotation, fov=EYE.fov)
    plane = np.array(PLANES["oblique"][0])
    moved = [*plane[:3], plane[3] - plane[:3] @ shift]
    here = renderers[0].render(ball(), EYE, SIZE, clip=plane)
    there = renderers[0].render(ball().moved(matrix), camera, SIZE, clip=moved)
    np.testing.assert_allclose(here.depth, there.depth, atol=1e-5)


@pytest.mark.parametrize("clip", [3, (1, 2, 3), (0, 0, 0, 1), (1, 0, 0, np.nan), "x", [[1, 0, 0]], [(1, 0, 0, 0)] * 9])
def test_bad_planes_are_named(clip, renderers):
    with pytest.raises(InputError, match=r"^clip: "):
        renderers[0].render(ball(), EYE, SIZE, clip=clip)
