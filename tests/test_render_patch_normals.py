"""The table of normals of patches, on the host and on the device."""


import numpy as np
import pytest
from reference import render_patch_modes as twin
from reference.patch_scenes import SIZE, joined, rough, sheet, wavy

from clsurf.errors import InputError
from clsurf.render.camera import Camera
from clsurf.render.normal_table import half_steps, normal_statistics, ratio_groups
from clsurf.render.patch_drawing import PatchDrawing
from clsurf.render.patch_nodes import table_normals
from clsurf.render.patches import patch_constants, place_patches, project_patches, upload_patches
from clsurf.render.shade import Shading
from clsurf.render.tiles import Scratch


def test_half_steps():
    surface = rough()
    for part in (surface, joined(surface, rough(2, (5, 12)))):
        got = np.stack(half_steps(part), axis=1)
        for k in range(len(part)):
            (m, n), (a, b) = part.size[k], part.node_offset[k:k + 2]
            opaque = part.opaque[a:b].reshape(n, m)
            wanted = 2 * twin.slopes(part.displacements[a:b].reshape(n, m), opaque)
            assert (got[a:b].reshape(n, m, 2)[opaque] == wanted[opaque]).all()


@pytest.mark.parametrize("ratios", [(1.0,), (1.0, 0.5), (1.0, 0.5, 0.25)])
def test_normal_statistics_count_what_a_table_would(ratios):
    surface = rough(6, ratios=ratios)
    got = normal_statistics(surface)
    wanted = twin.table_counts(surface)
    assert (got.normals, got.buffered, got.ordered) == wanted
    assert got.groups == len(ratios) and got.ordered <= got.buffered <= got.normals
    assert got.precomputed < got.ordered if len(ratios) == 1 else got.precomputed == got.ordered
    assert normal_statistics(surface, np.zeros(6, bool)).normals == 0
    one = np.arange(6) == 2
    assert normal_statistics(surface, one).buffered == normal_statistics(surface, one).ordered


def test_equal_patches_share_all_their_normals():
    one = rough(1)
    many = joined(*[one] * 5)
    five, alone = normal_statistics(many), normal_statistics(one)
    assert five.buffered - five.precomputed == alone.buffered - alone.precomputed < alone.normals
    assert five.normals == 5 * alone.normals and five.precomputed == 5 * alone.precomputed


def test_ratio_groups():
    surface = rough(6, ratios=(1.0, 0.5, 0.25))
    group, ratios = ratio_groups(surface)
    assert len(ratios) == 3 and (np.bincount(group) == 2).all()
    own = surface.axis_z_length / np.linalg.norm(surface.axis_x, axis=1)
    assert np.abs(ratios[group, 0] / own - 1).max() < 4e-4


@pytest.mark.parametrize("mode", [True, "ordered", "precomputed"])
@pytest.mark.parametrize("colors", [False, True])
def test_table_normals(device, mode, colors):
    """The table gives the normals that it saves computing, and computes as many as the statistics say."""
    ratios = (1.0,) if mode == "precomputed" else (1.0, 0.5, 0.25)
    surface = rough(9, ratios=ratios, colors=colors)
    upload, scratch = upload_patches(device, surface), Scratch(device, 16)
    view = device.upload(place_patches(upload, None, Camera.framing(surface, margin=1.3), (200, 200), Shading()))
    rectangles = project_patches(device, upload, view, PatchDrawing()).rectangles
    seen = device.download(rectangles)[:, 0] <= device.download(rectangles)[:, 2]
    got, counts = table_normals(device, scratch, upload, patch_constants(upload), rectangles, mode, parts=1)
    statistics = normal_statistics(surface, seen)
    name = {True: "buffered"}.get(mode, mode)
    assert device.download(counts).tolist() == [[statistics.normals, getattr(statistics, name)]]
    packed = device.download(got)[:, 3].astype(np.int64)
    got = np.stack([(packed << 16).astype(np.int32) >> 16, packed.astype(np.int32) >> 16], axis=1) / 2
    for k in np.flatnonzero(seen):
        (m, n), (a, b) = surface.size[k], surface.node_offset[k:k + 2]
        opaque = surface.opaque[a:b].reshape(n, m)
        rx, ry = (surface.axis_z_length[k] / np.linalg.norm(axis[k]) for axis in (surface.axis_x, surface.axis_y))
        wanted = twin.table_normals(surface.displacements[a:b].reshape(n, m), opaque, rx, ry)[opaque]
        normal = np.concatenate([-got[a:b] * [rx, ry], np.ones((b - a, 1))], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        assert np.abs(normal[opaque.ravel()] - wanted).max() < 3e-4  # 16 bits, and groups of ratios within 0.034 %


def test_pictures_with_a_table_are_the_same(renderers):
    surface = rough(30, holes=0.05, ratios=(1.0, 0.5))
    camera = Camera.framing(surface)
    for cells in ("quads", "bilinear"):
        plain = renderers[0].render(surface, camera, SIZE, patches=PatchDrawing(cells=cells))
        for mode in (True, "ordered"):
            for r in renderers[:2]:
                frame = r.render(surface, camera, SIZE, patches=PatchDrawing(cells=cells, normal_table=mode))
                assert np.array_equal(frame.depth, plain.depth, equal_nan=True)
                assert np.nanmax(np.abs(frame.normal - plain.normal)) < 2e-3


def test_the_table_wants_what_it_can_hold(renderers):
    with pytest.raises(InputError, match="ordered"):
        renderers[0].render(rough(4), None, SIZE, patches=PatchDrawing(normal_table="precomputed"))
    with pytest.raises(InputError, match="8-bit"):
        renderers[0].render(sheet(wavy)[0], None, SIZE, patches=PatchDrawing(normal_table=True))
