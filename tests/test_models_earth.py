"""The Earth of patches: where the maps say, without seam at the date line or the poles, and of the paper's sizes."""

import gzip

import numpy as np
import pytest

from clsurf import models
from clsurf.errors import FileFormatError, InputError
from clsurf.io.images import write_image
from clsurf.models.continents import continents
from clsurf.models.earth import heights_by_color
from clsurf.models.sphere_map import SphereMap
from tests.reference.patch_cover import directions, margin


def empty(rows):
    return SphereMap(np.zeros((rows, 2 * rows, 1), np.float32))


def hills(at):
    """Return smooth heights (...) in 0...1 at unit vectors, steep nowhere, different everywhere."""
    return 0.5 + 0.2 * np.sin(3 * at[..., 0] + 1) + 0.2 * np.cos(2 * at[..., 1] - at[..., 2]) + 0.1 * at[..., 2]


def tints(at):
    """Return smooth sRGB colours (..., 3) in 0...255."""
    return 128 + 70 * np.stack([at[..., 0], np.sin(2 * at[..., 1]), np.cos(2 * at[..., 2])], axis=-1)


@pytest.fixture(scope="module")
def hilly():
    grid = empty(180).directions()
    return models.earth(383, color=np.rint(tints(grid)).astype(np.uint8), elevation=1000 * hills(grid), relief=0.05)


@pytest.mark.parametrize("patches, nodes, nbytes", [(383, 110_687, 458_068), (1128, 325_992, 1_349_088),
                                                    (2712, 783_768, 3_243_552)])
def test_sizes_are_the_papers(patches, nodes, nbytes):
    earth = models.earth(patches, color=np.full((8, 16, 3), (20, 40, 120), np.uint8))
    assert len(earth) == patches and (earth.size == 17).all() and earth.opaque.all()
    assert earth.node_count == nodes and earth.nbytes == nbytes
    assert earth.displacements.dtype == np.int8 and earth.colors.shape == (nodes, 3)


def test_sea_is_a_sphere():
    earth = models.earth(100, color=np.full((8, 16, 3), (20, 40, 120), np.uint8), radius=7.0)
    reach = np.linalg.norm(earth.positions(), axis=1)
    assert np.abs(reach - 7).max() <= earth.axis_z_length.max() / 2 * 1.001
    assert np.abs(earth.colors.astype(int) - (20, 40, 120)).max() <= 1


def test_nodes_lie_where_the_elevations_say(hilly):
    p = hilly.positions()
    reach = np.linalg.norm(p, axis=1)
    grid = hills(empty(180).directions())
    wanted = 128 * (1 + 0.05 * hills(p / reach[:, None]) / grid.max())
    patch = hilly.node_patches()[0]
    # Half a displacement step, and what smoothing over 0.8 spacings changes of the 6.4 units' relief.
    assert (np.abs(reach - wanted) - hilly.axis_z_length[patch] / 2).max() < 0.008
    assert hilly.bound < 0.15
    cells = p.reshape(-1, 17, 17, 3)
    middles = (cells[:, 1:, 1:] + cells[:, :-1, :-1] + cells[:, 1:, :-1] + cells[:, :-1, 1:]) / 4
    reach = np.linalg.norm(middles, axis=-1)
    off = np.abs(reach - 128 * (1 + 0.05 * hills(middles / reach[..., None]) / grid.max()))
    assert off.max() < hilly.bound + hilly.axis_z_length.max()


def test_colors_have_no_seam(hilly):
    p = hilly.positions()
    at = p / np.linalg.norm(p, axis=1, keepdims=True)
    off = np.abs(hilly.colors - tints(at)).max(axis=1)
    assert off.max() < 2.5
    line = (np.abs(at[:, 0]) < 0.02) & (at[:, 2] < 0)  # the date line
    poles = np.abs(at[:, 1]) > 0.99
    assert line.sum() > 200 and poles.sum() > 500 and off[line].max() < 2.5 and off[poles].max() < 2.5


def test_no_gap_on_displaced_land(hilly):
    at = directions(100_000)
    reach = 128 * (1 + 0.05 * hills(at) / hills(empty(180).directions()).max())
    assert margin(hilly, at * reach[:, None]).min() > 0.4


def test_axes_and_map_agree():
    picture = np.full((90, 180, 3), (20, 40, 120), np.uint8)
    picture[40:50, 130:140] = (200, 20, 20)  # latitude 0, longitude 90 east
    picture[:4] = (250, 250, 250)  # north
    earth = models.earth(383, color=picture)
    p = earth.positions()
    white = p[(earth.colors > 200).all(axis=1)]
    assert len(white) and white[:, 1].min() > 120
    red = p[(earth.colors[:, 0] > 150) & (earth.colors[:, 1] < 100)]
    assert len(red) and (red[:, 0] > 110).all() and np.linalg.norm(red, axis=1).max() > 129


def test_rule_of_colors():
    colors = np.array([[[10, 20, 60], [30, 70, 130], [30, 45, 20], [110, 93, 58], [200, 169, 124], [136, 73, 38],
                        [250, 253, 255], [0, 0, 0]]], np.uint8)
    encoded = colors.astype(np.float32) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4).astype(np.float32)
    sea, shelf, forest, brown, sand, desert, ice, black = heights_by_color(SphereMap(linear)).values[0, :, 0]
    assert sea == shelf == black == 0 < forest < brown <= sand <= desert == 1 and 0 < ice < brown


def test_elevations_of_any_order_give_the_same_earth(tmp_path):
    grid = empty(60).directions()
    heights = np.rint(1000 * hills(grid))
    plain = models.earth(64, elevation=heights)
    # South first, from longitude 21 on, the first column again at the end.
    turned = np.roll(heights[::-1], -(int(21 / 3) + 60), axis=1)
    turned = np.concatenate([turned, turned[:, :1]], axis=1)
    latitudes, longitudes = np.arange(60) * 3 - 88.5, 22.5 + 3 * np.arange(121)
    other = models.earth(64, elevation=(turned, latitudes, longitudes))
    assert (plain.displacements == other.displacements).mean() > 0.999
    assert np.abs(plain.positions() - other.positions()).max() < 0.01
    for name, values in (("data", turned), ("lats", latitudes[:, None]), ("lons", longitudes[:, None])):
        with gzip.open(tmp_path / f"some{name}.gz", "wt") as file:
            np.savetxt(file, values, "%.6f")
    read = models.earth(64, elevation=tmp_path / "somedata.gz")
    assert np.abs(read.positions() - other.positions()).max() < 1e-4


def test_color_map_is_read_from_a_file(tmp_path):
    picture = np.rint(tints(empty(32).directions())).astype(np.uint8)
    write_image(tmp_path / "map.png", picture)
    a, b = models.earth(40, color=tmp_path / "map.png"), models.earth(40, color=picture)
    assert (a.colors == b.colors).all() and (a.displacements == b.displacements).all()


def test_made_up_continents_are_the_same_every_time():
    a, b = models.earth(64), models.earth(64)
    assert a.colors.tobytes() == b.colors.tobytes() and a.displacements.tobytes() == b.displacements.tobytes()
    assert models.earth(64, seed=8).colors.tobytes() != a.colors.tobytes()
    land = continents(64).values > 0
    weights = np.cos((np.arange(64) - 31.5) / 64 * np.pi)
    assert 0.2 < (land[..., 0].mean(axis=1) * weights).sum() / weights.sum() < 0.45
    blue = (a.colors[:, 2] > a.colors[:, 0]).mean()
    assert 0.4 < blue < 0.85


def test_smoothing_and_sampling_know_no_border():
    at = empty(128).directions()
    width = 0.06
    for axis in range(3):  # a Gaussian on the sphere shrinks these by exp(-width^2)
        values = SphereMap(at[..., axis:axis + 1].astype(np.float32))
        smooth = values.smoothed(width).values[..., 0]
        off = np.abs(smooth - np.exp(-width ** 2) * at[..., axis])
        assert off[np.abs(at[..., 1]) < 0.95].max() < 1.5 * width ** 2
        assert off.max() < 0.3 * width  # the rows around a pole are evened out
        spread = directions(20_000)
        assert np.abs(values.sample(spread)[:, 0] - spread[:, axis]).max() < 3e-4
    ones = SphereMap(np.ones((32, 64, 1), np.float32))
    np.testing.assert_allclose(ones.smoothed(0.3).values, 1, rtol=1e-5)
    assert ones.reduced(ones.pixel * 4.5).values.shape == (8, 16, 1)


def test_precise_nodes():
    coarse, fine = (models.earth(64, radius=1.0, precise=p) for p in (False, True))
    assert fine.displacements.dtype == np.int32 and fine.nbytes == 40 * 64 + 8 * fine.node_count
    assert np.abs(coarse.positions() - fine.positions()).max() < coarse.axis_z_length.max()


@pytest.mark.parametrize("options, word", [
    ({"patches": 12}, "patches"), ({"radius": -1.0}, "radius"), ({"relief": 0.5}, "relief"), ({"nodes": 300}, "nodes"),
    ({"color": np.zeros((4, 4))}, "color"), ({"elevation": np.full((4, 8), np.nan)}, "elevation"),
    ({"elevation": (np.zeros((4, 8)), np.zeros(3), np.zeros(8))}, "latitudes"), ({"elevation": np.zeros(4)}, "shape"),
    ({"elevation": (np.zeros((4, 8)),)}, "longitudes")])
def test_says_what_it_cannot_do(options, word):
    with pytest.raises(InputError, match=word):
        models.earth(**options)


def test_damaged_elevations(tmp_path):
    path = tmp_path / "heights.txt"
    path.write_text("1 2 3\n4 five 6\n")
    with pytest.raises(FileFormatError, match="numbers"):
        models.earth(elevation=path)
    (tmp_path / "heights.gz").write_bytes(b"no gzip")
    with pytest.raises(FileFormatError, match="numbers"):
        models.earth(elevation=tmp_path / "heights.gz")
    (tmp_path / "heights.npy").write_bytes(b"no array")
    with pytest.raises(FileFormatError, match="array of heights"):
        models.earth(elevation=tmp_path / "heights.npy")
