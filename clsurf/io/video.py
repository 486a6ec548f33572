"""Moving pictures: MP4, GIF, animated WebP or a folder of numbered PNG files, written frame by frame.

Frames are never held: every format is written as its frames come, so that a long video costs no more memory than a
short one. Pillow's own writers of animations hold all frames; here it encodes single pictures, whose blocks are put
into the animation's file.
"""

import contextlib
import io
import itertools
import os
import shutil
import struct
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsurf.errors import InputError

from .files import one_line, replacing, writable_place
from .images import from_srgb8, to_srgb8, write_image

ENDINGS = (".mp4", ".gif", ".webp")
NUMBERED = "{:05d}.png"  # names in a folder
MOST_FPS = {".gif": 50.0}  # a GIF counts hundredths of a second, and viewers slow down what is shown for less than two
LARGEST_SIDE = {".mp4": 16384, ".gif": 65535, ".webp": 16383}


def write_video(path, frames, fps: float = 30.0, quality: int = 90, loop: int = 0) -> int:
    """Write frames as a video; it appears whole or not at all.

    Parameters
    ----------
    path : path-like
        .mp4 (H.264; needs the extra ``video``), .gif, .webp, or without an ending a folder of PNG files 00000.png,
        00001.png, ... (an existing folder must be empty or hold such pictures only, which are replaced).
    frames : iterable of (h, w, 3 or 4) uint8 arrays
        sRGB, straight alpha, row 0 on top, all of one size; also `Frame`, and float arrays (linear, premultiplied).
        Taken one at a time. MP4 has no alpha: white is behind; and only even sizes: the last row or column is doubled.
        GIF pixels are opaque or not at all.
    fps : float
        Frames a second, up to 240 (GIF: 50).
    quality : int
        1 to 100, of MP4 and WebP; 100 is lossless for WebP.
    loop : int
        How often GIF and WebP are played; 0: for ever.

    Returns
    -------
    int
        Number of frames.

    Raises
    ------
    InputError
        No frames, frames of several sizes, an unknown ending, a place that cannot be written, or a missing encoder.
    """
    path = known_video(path)
    ending = path.suffix.lower()
    checked_fps(path, fps)
    if not isinstance(quality, int | np.integer) or not 1 <= quality <= 100:
        raise InputError(f"quality: expected 1 to 100, got {quality!r}")
    if not isinstance(loop, int | np.integer) or not 0 <= loop < 65536:
        raise InputError(f"loop: expected a number of times from 0 (for ever) to 65535, got {loop!r}")
    pictures = _checked_pictures(frames, LARGEST_SIDE.get(ending, 0), ending)
    if ending == ".mp4":
        return _write_mp4(path, pictures, fps, quality)
    if ending:
        write = _write_gif if ending == ".gif" else _write_webp
        with replacing(path) as temporary, open(temporary, "wb") as file:
            return write(file, pictures, fps, quality, loop)
    return _write_folder(path, pictures)


def known_video(path) -> Path:
    """Return `path` if a video can be written there: its ending is known, its encoder there, its place writable.

    Raises
    ------
    InputError
        Otherwise.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending == "":
        _checked_folder(path)
        return path
    if ending not in ENDINGS:
        raise InputError(f"{path}: unknown video format {ending}: expected {', '.join(ENDINGS)}, or a name without an "
                         "ending for a folder of PNG files")
    if ending == ".mp4":
        _ffmpeg(path)
    return writable_place(path)


def checked_fps(path: Path, fps: float) -> None:
    """Raise InputError unless a video at `path` can be played that fast."""
    most = MOST_FPS.get(path.suffix.lower(), 240.0)
    if not isinstance(fps, int | float | np.number) or not 0 < fps <= most:
        raise InputError(f"fps: expected frames a second from above 0 to {most:g}, got {fps!r}")


def _checked_pictures(frames, largest: int, ending: str) -> Iterator[NDArray]:
    """Yield the frames as C-contiguous (h, w, 3 or 4) uint8, all of the first one's shape."""
    try:
        frames = iter(frames)
    except TypeError:
        raise InputError(f"frames: expected an iterable of pictures, got a {type(frames).__name__}") from None
    first = None
    for number, frame in enumerate(frames):
        pixels = _pixels(frame, number)
        if first is None:
            first = pixels.shape
            if largest and max(first[:2]) > largest:
                raise InputError(f"frames: {ending} holds up to {largest} pixels a side, got {first[1]} x {first[0]}")
        if pixels.shape != first:
            raise InputError(f"frame {number}: expected the first frame's shape {first}, got {pixels.shape}")
        yield pixels
    if first is None:
        raise InputError("frames: expected at least one, got none")


def _pixels(frame, number: int) -> NDArray:
    pixels = np.asarray(getattr(frame, "color", frame))  # a Frame has the channel color
    if pixels.dtype.kind == "f" and pixels.ndim == 3 and pixels.shape[2] in (3, 4):
        pixels = to_srgb8(pixels)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or 0 in pixels.shape:
        raise InputError(f"frame {number}: expected (h, w, 3 or 4) uint8, got {pixels.shape} {pixels.dtype}")
    return np.ascontiguousarray(pixels)


def _durations(fps: float, units: int) -> Iterator[int]:
    """Yield how long each frame is shown, in 1/units s; rounding never adds up."""
    number = 0
    while True:
        yield round((number + 1) * units / fps) - round(number * units / fps)
        number += 1


# MP4 ------------------------------------------------------------------------------------------------------------------


def _ffmpeg(path: Path) -> str:
    """Return the encoder's program."""
    try:
        import imageio_ffmpeg
        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        lacks = "imageio-ffmpeg is not installed" if isinstance(error, ImportError) else one_line(error)
        raise InputError(f"{path}: {lacks}: pip install 'clsurf[video]', or write .gif, .webp or a folder of "
                         "pictures") from None


def _write_mp4(path: Path, pictures: Iterator[NDArray], fps: float, quality: int) -> int:
    first = next(pictures)
    height, width = first.shape[:2]
    count = 0
    # sRGB's primaries and transfer, and the matrix that players of any size of picture then use.
    options = ["-c:v", "libx264", "-preset", "medium", "-crf", f"{round(48 - 0.34 * quality)}", "-pix_fmt", "yuv420p",
               "-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709", "-color_primaries", "bt709",
               "-color_trc", "iec61966-2-1", "-color_range", "tv", "-movflags", "+faststart"]
    with replacing(path) as temporary, tempfile.TemporaryFile() as said:
        command = [_ffmpeg(path), "-y", "-v", "error", "-nostdin", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s",
                   f"{width + width % 2}x{height + height % 2}", "-r", f"{fps:.9g}", "-i", "-", "-an", *options,
                   f"file:{temporary}"]
        # Its own session: Ctrl-C on a terminal stops this program, which then ends the encoder.
        encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said,
                                   start_new_session=True)
        try:
            with contextlib.suppress(BrokenPipeError):  # it has ended: its own words tell why
                for picture in itertools.chain([first], pictures):
                    encoder.stdin.write(memoryview(_opaque_even(picture)).cast("B"))
                    count += 1
            with contextlib.suppress(BrokenPipeError):
                encoder.stdin.close()
            code = encoder.wait()
        finally:
            if encoder.poll() is None:
                encoder.kill()
                encoder.wait()
        if code:
            said.seek(0)
            words = said.read().decode(errors="replace").replace(f"file:{temporary}", str(path))
            raise InputError(f"{path}: cannot be written: {one_line(ValueError(words))}")
    return count


def _opaque_even(picture: NDArray) -> NDArray:
    """Return (h, w, 3) of even size, over white."""
    if picture.shape[2] == 4:
        clear = (picture[..., 3] < 255).any()
        picture = to_srgb8(from_srgb8(picture), (1.0, 1.0, 1.0))[..., :3] if clear else picture[..., :3]
    height, width = picture.shape[:2]
    return np.ascontiguousarray(np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))


# GIF: https://www.w3.org/Graphics/GIF/spec-gif89a.txt ---------------------------------------------------------------


def _write_gif(file, pictures: Iterator[NDArray], fps: float, quality: int, loop: int) -> int:
    count = 0
    for picture, hundredths in zip(pictures, _durations(fps, 100), strict=False):
        if count == 0:
            height, width = picture.shape[:2]
            file.write(b"GIF89a" + struct.pack("<HH3B", width, height, 0x70, 0, 0))
            file.write(b"\x21\xff\x0bNETSCAPE2.0\x03\x01" + struct.pack("<H", loop) + b"\x00" if loop != 1 else b"")
        file.write(_gif_blocks(picture, hundredths))
        count += 1
    file.write(b"\x3b")
    return count


def _gif_blocks(picture: NDArray, hundredths: int) -> bytes:
    """Return a graphic control block and an image of 255 colours of its own, cut from a GIF of one picture."""
    from PIL import Image
    colors = Image.fromarray(np.ascontiguousarray(picture[..., :3])).quantize(255, method=Image.Quantize.MEDIANCUT)
    alpha = picture.shape[2] == 4
    indices = np.where(picture[..., 3] < 128, 255, np.asarray(colors)).astype(np.uint8) if alpha else np.asarray(colors)
    table = np.zeros(768, np.uint8)
    own = colors.getpalette()[:765]
    table[:len(own)] = own
    paletted = Image.frombytes("P", colors.size, indices.tobytes())
    paletted.putpalette(table.tobytes())
    whole = io.BytesIO()
    paletted.save(whole, "GIF", optimize=False)
    data = whole.getvalue()
    at = 13 + (3 << (data[10] & 7) + 1 if data[10] & 0x80 else 0)
    while data[at] == 0x21:  # blocks other than the picture
        at += 2
        while data[at]:
            at += data[at] + 1
        at += 1
    place, flags, at = data[at:at + 9], data[at + 9], at + 10
    if flags & 0x80:
        at += 3 << (flags & 7) + 1
    # Shown, then cleared to the background (2), so that a transparent pixel shows no earlier frame.
    control = struct.pack("<4BHBB", 0x21, 0xF9, 4, 2 << 2 | alpha, hundredths, 255, 0)
    return control + place + bytes([flags & 0x40 | 0x87]) + table.tobytes() + data[at:-1]


# WebP: https://developers.google.com/speed/webp/docs/riff_container -------------------------------------------------


def _write_webp(file, pictures: Iterator[NDArray], fps: float, quality: int, loop: int) -> int:
    count = 0
    for picture, milliseconds in zip(pictures, _durations(fps, 1000), strict=False):
        if count == 0:
            height, width, planes = picture.shape
            flags = 0x02 | (0x10 if planes == 4 else 0)
            file.write(b"RIFF\0\0\0\0WEBPVP8X" + struct.pack("<II", 10, flags) + _three(width - 1) + _three(height - 1))
            file.write(b"ANIM" + struct.pack("<IIH", 6, 0xFFFFFFFF, loop))
        # Not blended over the frame before.
        head = bytes(6) + _three(width - 1) + _three(height - 1) + _three(milliseconds) + b"\x02"
        data = head + _webp_chunks(picture, quality)
        file.write(b"ANMF" + struct.pack("<I", len(data)) + data + bytes(len(data) % 2))
        count += 1
    size = file.tell() - 8
    if size >= 1 << 32:
        raise InputError(f"frames: .webp holds up to 4 GB, got {size / 2**30:.1f}: write .mp4")
    file.seek(4)
    file.write(struct.pack("<I", size))
    return count


def _webp_chunks(picture: NDArray, quality: int) -> bytes:
    """Return the chunks of pixels of a WebP file of one picture."""
    from PIL import Image, features
    if not features.check("webp"):
        raise InputError("video: this Pillow writes no WebP: pip install --force-reinstall pillow, or write .gif")
    whole = io.BytesIO()
    Image.fromarray(picture).save(whole, "WEBP", quality=quality, lossless=quality == 100, method=3)
    data, at, out = whole.getvalue(), 12, b""
    while at + 8 <= len(data):
        size = struct.unpack("<I", data[at + 4:at + 8])[0]
        end = at + 8 + size + size % 2
        if data[at:at + 4] in (b"VP8 ", b"VP8L", b"ALPH"):
            out += data[at:end]
        at = end
    return out


def _three(value: int) -> bytes:
    return struct.pack("<I", value)[:3]


# A folder -------------------------------------------------------------------------------------------------------------


def _checked_folder(path: Path) -> None:
    """Raise InputError unless `path` is free, or a folder of nothing but numbered pictures."""
    try:
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: expected a folder for numbered pictures, got a file: choose another name, or "
                             f"one that ends in {', '.join(ENDINGS)}")
        other = next((p.name for p in path.iterdir() if not _numbered(p.name)), None) if path.exists() else None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {(error.strerror or one_line(error)).lower()}") from None
    if other is not None:
        raise InputError(f"{path}: expected an empty folder or one of numbered pictures, it holds {other!r}: choose "
                         "another")
    if not path.name:
        raise InputError(f"{path}: expected the name of a new folder")
    writable_place(path.parent / f"{path.name}.png")


def _numbered(name: str) -> bool:
    stem, _, ending = name.partition(".")
    return ending == "png" and stem.isdecimal() and len(stem) >= 5


def _write_folder(path: Path, pictures: Iterator[NDArray]) -> int:
    temporary = path.parent / f".{path.name[:40]}.{uuid.uuid4().hex[:12]}"
    old = path.parent / f"{temporary.name}.old"
    count = 0
    try:
        temporary.mkdir()
        for picture in pictures:
            write_image(temporary / NUMBERED.format(count), picture)
            count += 1
        if path.exists():
            _checked_folder(path)
            os.replace(path, old)
        os.replace(temporary, path)
    except OSError as error:
        if old.exists() and not path.exists():
            os.replace(old, path)
        raise InputError(f"{path}: cannot be written: {(error.strerror or one_line(error)).lower()}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
    return count

