"""Pictures: round trips of PNG, JPEG and EXR, colour conversion, errors."""

import io

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from clsurf.errors import FileFormatError, InputError
from clsurf.io import images


def random_color(rng, size=(9, 13)):
    color = rng.random((*size, 4)).astype(np.float32)
    color[..., :3] *= color[..., 3:]
    return color


def test_to_srgb8_known_values():
    color = np.array([[[0, 0, 0, 1], [1, 1, 1, 1], [0.5, 0.5, 0.5, 1], [0.25, 0, 0, 0.5], [0, 0, 0, 0]]], np.float32)
    wanted = [[0, 0, 0, 255], [255, 255, 255, 255], [188, 188, 188, 255], [188, 0, 0, 128], [0, 0, 0, 0]]
    assert images.to_srgb8(color)[0].tolist() == wanted
    assert images.to_srgb8(color, background=(1, 1, 1))[0, 4].tolist() == [255, 255, 255, 255]
    assert images.to_srgb8(color, background=(0, 0, 1))[0, 3].tolist() == [137, 0, 188, 255]


def test_srgb8_inverts():
    pixels = np.arange(256, dtype=np.uint8)[None, :, None].repeat(4, axis=2)
    pixels[..., 3] = 255
    assert (images.to_srgb8(images.from_srgb8(pixels)) == pixels).all()


def test_to_srgb8_survives_nan_and_overflow():
    color = np.array([[[np.nan, np.inf, -1, 1]]], np.float32)
    assert images.to_srgb8(color)[0, 0].tolist() == [0, 255, 0, 255]


@pytest.mark.parametrize("ending", [".png", ".PNG"])
def test_png_keeps_straight_alpha(tmp_path, ending):
    color = random_color(np.random.default_rng(1))
    path = tmp_path / f"a{ending}"
    images.write_image(path, color)
    assert (images.read_image(path) == images.to_srgb8(color)).all()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("shape, dtype", [((5, 7), np.uint8), ((5, 7, 3), np.uint8), ((5, 7, 4), np.uint8),
                                          ((5, 7), np.uint16)])
def test_png_integers_as_they_are(tmp_path, shape, dtype):
    pixels = np.random.default_rng(2).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    images.write_image(tmp_path / "a.png", pixels)
    read = images.read_image(tmp_path / "a.png")
    assert read.dtype == dtype and (read == pixels.reshape(*shape[:2], -1)).all()


def test_jpeg_lies_over_white(tmp_path):
    color = np.zeros((16, 16, 4), np.float32)
    color[4:12, 4:12] = (1, 0, 0, 1)
    images.write_image(tmp_path / "a.jpg", color)
    read = images.read_image(tmp_path / "a.jpg").astype(int)
    assert read.shape == (16, 16, 3)
    assert abs(read[0, 0] - 255).max() <= 5 and abs(read[8, 8] - (255, 0, 0)).max() <= 6
    images.write_image(tmp_path / "b.jpg", color, background=(0, 0, 0))
    assert images.read_image(tmp_path / "b.jpg")[0, 0].max() <= 5


def test_png_bytes_is_the_same_picture(tmp_path):
    from PIL import Image
    color = random_color(np.random.default_rng(3))
    data = images.png_bytes(color)
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert (np.asarray(Image.open(io.BytesIO(data))) == images.to_srgb8(color)).all()
    grey = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert (np.asarray(Image.open(io.BytesIO(images.png_bytes(grey)))) == grey).all()


def test_exr_names_and_values(tmp_path):
    rng = np.random.default_rng(4)
    channels = {"color": random_color(rng), "depth": rng.random((9, 13)), "normal": rng.normal(size=(9, 13, 3)),
                "position": rng.normal(size=(9, 13, 3)), "level": rng.integers(-1, 20, (9, 13)),
                "moments": rng.random((9, 13, 2))}
    channels["depth"][2, 3] = np.nan
    channels["normal"][2, 3] = np.nan
    images.write_frame(tmp_path / "a.exr", channels)
    read = images.read_channels(tmp_path / "a.exr")
    assert set(read) == {"R", "G", "B", "A", "Z", "N.X", "N.Y", "N.Z", "P.X", "P.Y", "P.Z", "level", "moments.0",
                         "moments.1"}
    for name, array in (("R", channels["color"][..., 0]), ("A", channels["color"][..., 3]), ("Z", channels["depth"]),
                        ("N.Y", channels["normal"][..., 1]), ("P.Z", channels["position"][..., 2]),
                        ("level", channels["level"]), ("moments.1", channels["moments"][..., 1])):
        np.testing.assert_array_equal(read[name], array.astype(np.float32))
    assert np.isnan(read["Z"][2, 3])


def test_exr_of_one_channel(tmp_path):
    images.write_frame(tmp_path / "a.exr", {"depth": np.full((2, 3), np.nan)})
    read = images.read_channels(tmp_path / "a.exr")
    assert list(read) == ["Z"] and np.isnan(read["Z"]).all()


def test_frame_as_png_needs_colour(tmp_path):
    with pytest.raises(InputError, match="color"):
        images.write_frame(tmp_path / "a.png", {"depth": np.zeros((2, 2))})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.gif", "a", "a.png.txt"])
def test_unknown_ending(tmp_path, name):
    with pytest.raises(InputError, match=r"\.png"):
        images.write_image(tmp_path / name, np.zeros((2, 2, 4)))


@pytest.mark.parametrize("pixels", [np.zeros((2, 2, 5)), np.zeros(3), np.zeros((2, 2, 3), np.int64),
                                    np.zeros((0, 2, 4)), np.zeros((2, 2))])
def test_wrong_shapes(tmp_path, pixels):
    for name in ("a.png", "a.exr", "a.jpg"):
        if name == "a.exr" and pixels.shape == (2, 2, 3):
            continue
        with pytest.raises(InputError):
            images.write_image(tmp_path / name, pixels)
    assert not list(tmp_path.iterdir())


def test_channels_of_different_sizes(tmp_path):
    with pytest.raises(InputError, match="one size"):
        images.write_frame(tmp_path / "a.exr", {"depth": np.zeros((2, 2)), "level": np.zeros((2, 3))})


def test_missing_folder_and_folder(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        images.write_image(tmp_path / "no" / "a.png", np.zeros((2, 2, 4)))
    (tmp_path / "b.png").mkdir()
    with pytest.raises(InputError, match="folder"):
        images.write_image(tmp_path / "b.png", np.zeros((2, 2, 4)))
    with pytest.raises(InputError, match="no such file"):
        images.read_image(tmp_path / "c.png")


def test_failed_write_keeps_the_old_picture(tmp_path):
    path = tmp_path / "a.png"
    images.write_image(path, np.ones((2, 2, 4)))
    before = path.read_bytes()
    with pytest.raises(InputError):
        images.write_image(path, np.ones((2, 2, 5)))
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


@settings(max_examples=60, deadline=20000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(min_size=1, max_size=300), ending=st.sampled_from([".png", ".jpg", ".exr"]), cut=st.booleans(),
       share=st.floats(0, 0.99))
def test_garbage_is_a_clear_error(tmp_path, data, ending, cut, share):
    path = tmp_path / f"x{ending}"
    if cut:
        images.write_image(path, random_color(np.random.default_rng(5), (40, 30)))
        whole = path.read_bytes()
        data = whole[:max(1, int(share * len(whole)))]
    path.write_bytes(data)
    try:
        images.read_image(path)
    except FileFormatError as error:
        assert "\n" not in str(error)


def test_a_cut_png_is_an_error_and_leaves_nothing(tmp_path, monkeypatch):
    """A full disk: OpenImageIO reports success for PNG."""
    class Cut:  # a writer that cuts the file when it closes it
        def __init__(self, sink, name):
            self.sink, self.name = sink, name

        def __getattr__(self, name):
            return getattr(self.sink, name)

        def close(self):
            done = self.sink.close()
            with open(self.name, "r+b") as file:
                file.truncate(100)
            return done

    create = images.oiio.ImageOutput.create
    monkeypatch.setattr(images.oiio, "ImageOutput", type("Sinks", (), {"create": lambda name: Cut(create(name), name)}))
    with pytest.raises(InputError, match="disk full"):
        images.write_image(tmp_path / "a.png", np.random.default_rng(0).random((40, 40, 3), np.float32))
    assert not list(tmp_path.iterdir())


def test_jpeg_goes_through_memory(tmp_path):
    """OpenImageIO's JPEG writer ends the process on a full disk, so it is not used."""
    images.write_image(tmp_path / "a.jpg", np.full((5, 7, 3), 200, np.uint8))
    assert images.read_image(tmp_path / "a.jpg").shape == (5, 7, 3)
    with pytest.raises(InputError, match="65500"):
        images.write_image(tmp_path / "b.jpg", np.zeros((1, 65501, 3), np.uint8))


def test_a_damaged_name_is_told_in_text(tmp_path):
    """OpenImageIO's message quotes the bytes of the name, which are no text."""
    path = tmp_path / "a.exr"
    images.write_frame(path, {"color": np.full((4, 4, 4), 0.5, np.float32)})
    path.write_bytes(path.read_bytes().replace(b"chlist", b"chli\xd6t"))
    for read in (images.read_image, images.read_channels):
        with pytest.raises(FileFormatError, match="no text"):
            read(path)
