"""Moving pictures: what each format gives back, sizes, durations, and files that appear whole or not at all."""

import io
import os
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from PIL import Image, ImageSequence

from clsurf.errors import InputError
from clsurf.io import video
from clsurf.io.images import read_image
from clsurf.render.frame import Frame


def gradient(number, width=22, height=14, planes=3):
    """A smooth picture (h, w, planes) uint8 whose blue says which frame it is."""
    out = np.full((height, width, planes), 255, np.uint8)
    out[..., 0] = np.linspace(20, 230, width)
    out[..., 1] = np.linspace(30, 200, height)[:, None]
    out[..., 2] = 20 * number
    return out


def read_mp4(path):
    import imageio_ffmpeg
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return meta, [np.frombuffer(data, np.uint8).reshape(height, width, 3) for data in reader]


def read_animation(path):
    with Image.open(path) as file:
        frames = [(np.asarray(frame.convert("RGBA")), frame.info["duration"]) for frame in ImageSequence.Iterator(file)]
        return [f for f, _ in frames], [d for _, d in frames], file.info.get("loop")


@pytest.mark.parametrize("size", [(22, 14), (21, 13), (1, 1), (64, 40)])
def test_mp4_gives_the_frames_back(tmp_path, size):
    """Even sizes as they are, odd ones with their last row or column doubled; colours within the codec's loss."""
    frames = [gradient(i, *size) for i in range(8)]
    assert video.write_video(tmp_path / "a.mp4", frames, fps=12.5, quality=100) == 8
    meta, got = read_mp4(tmp_path / "a.mp4")
    assert len(got) == 8 and meta["fps"] == 12.5 and meta["codec"] == "h264"
    width, height = size
    assert got[0].shape == (height + height % 2, width + width % 2, 3)
    for wanted, one in zip(frames, got, strict=True):
        assert np.abs(one[:height, :width].astype(int) - wanted).mean() < 6
        assert abs(one[..., 2].mean() - wanted[..., 2].mean()) < 10  # which frame it is
    assert os.listdir(tmp_path) == ["a.mp4"]


@pytest.mark.parametrize("ending", [".gif", ".webp"])
@pytest.mark.parametrize("size", [(22, 14), (21, 13), (1, 1)])
def test_animations_give_the_frames_back(tmp_path, ending, size):
    frames = [gradient(i, *size) for i in range(7)]
    video.write_video(tmp_path / f"a{ending}", (f for f in frames), fps=30, quality=100, loop=3)
    got, durations, loop = read_animation(tmp_path / f"a{ending}")
    assert len(got) == 7 and loop == 3
    assert abs(sum(durations) - 7000 / 30) <= 5 and max(durations) - min(durations) <= 10  # rounding never adds up
    for wanted, one in zip(frames, got, strict=True):
        assert one.shape[:2] == wanted.shape[:2] and (one[..., 3] == 255).all()
        error = np.abs(one[..., :3].astype(int) - wanted)
        assert (error == 0).all() if ending == ".webp" else error.mean() < 8


@pytest.mark.parametrize("ending", [".gif", ".webp"])
def test_transparent_pixels_show_no_earlier_frame(tmp_path, ending):
    frames = [gradient(i, planes=4) for i in range(4)]
    for i, frame in enumerate(frames):
        frame[:, :5 * i, 3] = 0
    frames = [frames[0], frames[3], frames[1]]
    video.write_video(tmp_path / f"a{ending}", frames, quality=100)
    got, _, loop = read_animation(tmp_path / f"a{ending}")
    assert loop == 0
    for wanted, one in zip(frames, got, strict=True):
        assert (one[..., 3] == wanted[..., 3]).all()


def test_webp_quality_is_a_size(tmp_path):
    frames = [gradient(i, 200, 150) + np.random.default_rng(i).integers(0, 9, (150, 200, 3), np.uint8)
              for i in range(2)]
    for ending in (".webp", ".mp4"):
        for quality in (10, 90):
            video.write_video(tmp_path / f"{quality}{ending}", frames, quality=quality)
        assert 1.5 * os.path.getsize(tmp_path / f"10{ending}") < os.path.getsize(tmp_path / f"90{ending}")


def test_mp4_lies_over_white_in_linear_light(tmp_path):
    frame = np.zeros((16, 16, 4), np.uint8)
    frame[..., 3] = 128  # half black: linear 0.498 is sRGB 188
    video.write_video(tmp_path / "a.mp4", [frame], quality=100)
    assert np.abs(read_mp4(tmp_path / "a.mp4")[1][0].astype(int) - 188).max() <= 2


def test_a_folder_of_pictures(tmp_path):
    frames = [gradient(i, planes=4) for i in range(3)]
    video.write_video(tmp_path / "out", frames)
    assert sorted(os.listdir(tmp_path / "out")) == ["00000.png", "00001.png", "00002.png"]
    assert all((read_image(tmp_path / "out" / f"{i:05d}.png") == f).all() for i, f in enumerate(frames))
    video.write_video(tmp_path / "out", frames[:1])  # a second time: nothing of the first stays
    assert os.listdir(tmp_path / "out") == ["00000.png"] and os.listdir(tmp_path) == ["out"]
    (tmp_path / "out" / "thesis.txt").write_text("x")
    with pytest.raises(InputError, match=r"thesis\.txt"):
        video.write_video(tmp_path / "out", frames)


def test_frames_of_the_renderer(tmp_path):
    color = np.zeros((6, 8, 4), np.float32)
    color[..., 0], color[..., 3] = 0.5, 1
    video.write_video(tmp_path / "out", [Frame({"color": color}), color])
    for number in range(2):
        assert (read_image(tmp_path / "out" / f"0000{number}.png") == (188, 0, 0, 255)).all()


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.webp", "folder"])
def test_whole_or_not_at_all(tmp_path, name):
    """Frames that fail, at the first or later, leave what was there and nothing beside it."""
    video.write_video(tmp_path / name, [gradient(0)] * 2)
    def content():
        return {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    before = content()

    def failing(after):
        yield from [gradient(1)] * after
        raise RuntimeError("no more")
    for after in (0, 3):
        with pytest.raises(RuntimeError, match="no more"):
            video.write_video(tmp_path / name, failing(after))
    for frames, says in (([], "at least one"), ([gradient(0), gradient(0, 10)], "frame 1: .*first frame's shape"),
                         ([np.zeros((4, 4), np.uint8)], "frame 0: expected"), (3, "iterable"),
                         ([np.zeros((0, 4, 3), np.uint8)], "frame 0")):
        with pytest.raises(InputError, match=says):
            video.write_video(tmp_path / name, frames)
    assert content() == before and os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.webp", "folder"])
def test_frames_are_not_held(tmp_path, name):
    """The most memory of 40 frames is that of a few."""
    def frames(count):
        for i in range(count):
            yield gradient(i % 12, 400, 300)
    frame_bytes, most = 400 * 300 * 3, []
    video.write_video(tmp_path / name, frames(2))  # imports
    for count in (4, 40):
        tracemalloc.start()
        video.write_video(tmp_path / name, frames(count))
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert most[1] < most[0] + 2 * frame_bytes


@pytest.mark.parametrize(("name", "options", "says"), [
    ("a.avi", {}, "video format .avi"), ("a.gif", {"fps": 60}, "fps.*50"), ("a.mp4", {"fps": 0}, "fps"),
    ("a.mp4", {"fps": np.nan}, "fps"), ("a.webp", {"quality": 0}, "quality"), ("a.gif", {"loop": -1}, "loop"),
    ("no/a.gif", {}, "folder"), ("no/folder", {}, "folder"), ("file", {}, "got a file")])
def test_wrong_arguments(tmp_path, name, options, says):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=says) as caught:
        video.write_video(tmp_path / name, [gradient(0)], **options)
    assert "\n" not in str(caught.value) and os.listdir(tmp_path) == ["file"]


def test_too_wide_for_webp(tmp_path):
    with pytest.raises(InputError, match="16383"):
        video.write_video(tmp_path / "a.webp", [np.zeros((1, 16384, 3), np.uint8)])


def test_a_missing_encoder_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"clsurf\[video\]"):
        video.write_video(tmp_path / "a.mp4", [gradient(0)])
    video.write_video(tmp_path / "a.gif", [gradient(0)])


@pytest.mark.parametrize("dies", ["exit 3", "head -c 100 >/dev/null; echo 'Error: broken' >&2; exit 1"])
def test_an_encoder_that_fails_is_one_line(tmp_path, monkeypatch, dies):
    program = tmp_path / "ffmpeg.sh"
    program.write_text(f"#!/bin/sh\n{dies}\n")
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    with pytest.raises(InputError, match="cannot be written") as caught:
        video.write_video(tmp_path / "a.mp4", [gradient(0, 400, 400)] * 3)
    assert "\n" not in str(caught.value) and os.listdir(tmp_path) == ["ffmpeg.sh"]


def test_a_gif_is_valid_to_another_reader(tmp_path):
    """The encoder's own decoder reads every frame of it without a complaint."""
    import imageio_ffmpeg
    frames = [gradient(i, 31, 17) for i in range(5)]
    video.write_video(tmp_path / "a.gif", frames, fps=10)
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(tmp_path / "a.gif"), "-f",
                           "rawvideo", "-pix_fmt", "rgb24", "-"], capture_output=True)
    assert done.returncode == 0 and done.stderr == b""
    got = np.frombuffer(done.stdout, np.uint8).reshape(-1, 17, 31, 3)
    assert len(got) == 5 and np.abs(got.astype(int) - np.array(frames)).mean() < 8


def test_a_single_picture_is_a_video(tmp_path):
    for name in ("a.mp4", "a.gif", "a.webp", "a"):
        assert video.write_video(tmp_path / name, [gradient(0)]) == 1
    assert Image.open(io.BytesIO((tmp_path / "a.webp").read_bytes())).size == (22, 14)
