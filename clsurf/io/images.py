"""Pictures: PNG and JPEG for the eye, EXR with named float channels for everything else, through OpenImageIO."""

import io
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from clsurf.errors import FileFormatError, InputError
from clsurf.surface.srgb import LINEAR_OF_BYTE, to_srgb

from .files import existing_file, one_line, replacing
from .tone import checked_tone, tone_mapped

EIGHT_BIT = (".png", ".jpg", ".jpeg")
ENDINGS = (*EIGHT_BIT, ".exr")

# Channel names of a frame's arrays in an EXR file; others are called by the name of their array.
EXR_NAMES = {"color": ("R", "G", "B", "A"), "depth": ("Z",), "normal": ("N.X", "N.Y", "N.Z"),
             "position": ("P.X", "P.Y", "P.Z")}
_LARGEST_JPEG = 65500
_MOST_COMPRESSED = 4000  # pixel bytes per file byte; deflate reaches 1032, so a larger claim is a damaged header


def to_srgb8(color, background=None) -> NDArray:
    """Convert linear premultiplied colour to 8-bit sRGB with straight alpha; see `to_srgb_bytes`."""
    return to_srgb_bytes(color, background)


def to_srgb_bytes(color, background=None, tone: str = "none", exposure: float = 0.0, bits: int = 8,
                  dither: bool = False) -> NDArray:
    """Convert linear premultiplied colour to sRGB with straight alpha, of 8 or 16 bits.

    Parameters
    ----------
    color : (h, w, 4) float
        Linear, premultiplied by alpha. (h, w, 3): opaque.
    background : (3,) float, optional
        Linear colour to lay `color` over; the result is then opaque. None keeps alpha.
    tone, exposure
        See `clsurf.io.tone.tone_mapped`.
    bits : int
        8 or 16.
    dither : bool
        Round up and down by an ordered pattern of 8 x 8, so that slow gradients show no steps; alpha is left alone.

    Returns
    -------
    (h, w, 4) uint8 or uint16
        sRGB, straight alpha; a transparent pixel is black.
    """
    color = np.asarray(color, np.float32)
    if color.ndim != 3 or color.shape[2] not in (3, 4):
        raise InputError(f"color: expected shape (h, w, 4) or (h, w, 3), got {color.shape}")
    rgb = color[..., :3]
    alpha = color[..., 3:] if color.shape[2] == 4 else np.ones_like(color[..., :1])
    if background is not None:
        rgb = rgb + (1 - alpha) * np.asarray(background, np.float32)
        alpha = np.ones_like(alpha)
    elif (alpha < 1).any():
        rgb = np.divide(rgb, alpha, out=np.zeros_like(rgb), where=alpha > 0)
    if bits not in (8, 16):
        raise InputError(f"bits: expected 8 or 16 bits a channel, got {bits!r}")
    shift = ordered_pattern(*color.shape[:2])[..., None] if dither else 0.0
    out = np.empty((*color.shape[:2], 4), np.uint8 if bits == 8 else np.uint16)
    out[..., :3] = _whole(to_srgb(tone_mapped(rgb, tone, exposure)), bits, shift)
    out[..., 3:] = _whole(alpha, bits)
    return out


def ordered_pattern(height: int, width: int) -> NDArray:
    """Return offsets (h, w) float32 over -1/2 to 1/2, the middles of 64 equal parts, in Bayer's order."""
    order = np.zeros((1, 1))
    for _ in range(3):
        order = np.block([[4 * order, 4 * order + 2], [4 * order + 3, 4 * order + 1]])
    tile = ((order + 0.5) / 64 - 0.5).astype(np.float32)
    return np.tile(tile, (-(-height // 8), -(-width // 8)))[:height, :width]


def from_srgb8(pixels) -> NDArray:
    """Convert (..., 3 or 4) uint8 sRGB with straight alpha to (..., 4) float32 linear premultiplied colour."""
    pixels = np.asarray(pixels, np.uint8)
    table = LINEAR_OF_BYTE.astype(np.float32)
    out = np.ones((*pixels.shape[:-1], 4), np.float32)
    out[..., :3] = table[pixels[..., :3]]
    if pixels.shape[-1] == 4:
        out[..., 3] = pixels[..., 3] / np.float32(255)
        out[..., :3] *= out[..., 3:]
    return out


def png_bytes(pixels) -> bytes:
    """Return `pixels` as a PNG file in memory, for notebooks.

    Parameters
    ----------
    pixels : (h, w, 4) float or (h, w[, 1 | 3 | 4]) uint8
        As for `write_image`.
    """
    from PIL import Image  # OpenImageIO's Python binding writes to files only

    pixels = _as_pixels(pixels, None)
    buffer = io.BytesIO()
    Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels).save(buffer, "PNG", compress_level=3)
    return buffer.getvalue()


def write_image(path, pixels, background=None, tone: str = "none", exposure: float = 0.0, bits: int = 8,
                dither: bool = False) -> None:
    """Write one picture as .png, .jpg or .exr; the file appears whole or not at all.

    Parameters
    ----------
    path : path-like
    pixels : (h, w, 3 or 4) float, or (h, w[, 1 | 3 | 4]) uint8 or uint16
        Float is linear and premultiplied: PNG gets sRGB with straight alpha, EXR the values as they are. Integers are
        taken as sRGB and written as they are.
    background : (3,) float, optional
        Linear colour behind transparent float pixels. JPEG has no alpha: white if not given.
    tone, exposure, bits, dither
        Of float pixels that are not written as .exr, which stays linear; see `to_srgb_bytes`. 16 bits: .png only.

    Raises
    ------
    InputError
        An unknown ending, a wrong shape, or a place that cannot be written.
    """
    path = checked_output(path, tone, exposure, bits)
    if path.suffix.lower() == ".exr":
        pixels = np.asarray(pixels, np.float32)
        if pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
            raise InputError(f"pixels: expected shape (h, w, 3) or (h, w, 4) for .exr, got {pixels.shape}")
        _write_exr(path, {name: pixels[..., i] for i, name in enumerate("RGBA"[:pixels.shape[2]])})
        return
    jpeg = path.suffix.lower() != ".png"
    pixels = _as_pixels(pixels, (1.0, 1.0, 1.0) if jpeg and background is None else background, tone, exposure, bits,
                        dither)
    if jpeg:
        if pixels.dtype != np.uint8:
            raise InputError("pixels: .jpg holds 8 bits a channel, got uint16: write .png instead")
        pixels = pixels[..., :3]
    if jpeg:
        _write_jpeg(path, pixels)
        return
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], pixels.dtype.name)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("png:compressionLevel", 4)
    _write(path, spec, np.ascontiguousarray(pixels))


def checked_output(path, tone: str = "none", exposure: float = 0.0, bits: int = 8) -> Path:
    """Return the path of a picture to be written, or raise InputError where it cannot be what the options say."""
    path = _known(path)
    checked_tone(tone, exposure)
    if bits not in (8, 16):
        raise InputError(f"bits: expected 8 or 16 bits a channel, got {bits!r}")
    ending = path.suffix.lower()
    if ending == ".exr" and (tone != "none" or exposure or bits != 8):
        raise InputError(f"{path}: .exr holds linear light in 32 bits, got tone {tone}, exposure {exposure}, bits "
                         f"{bits}: leave them out, or write .png")
    if bits == 16 and ending != ".png":
        raise InputError(f"{path}: {ending} holds 8 bits a channel, got bits=16: write .png instead")
    return path


def write_frame(path, channels, background=None, tone: str = "none", exposure: float = 0.0, bits: int = 8,
                dither: bool = False) -> None:
    """Write a frame: its colour as .png or .jpg, or every channel as .exr.

    Parameters
    ----------
    path : path-like
    channels : dict of str to array
        "color" (h, w, 4) float linear premultiplied; "depth" (h, w), "normal" and "position" (h, w, 3) float, NaN for
        none; others (h, w) or (h, w, k) under their own names. EXR names: R G B A, Z, N.X N.Y N.Z, P.X P.Y P.Z, else
        NAME or NAME.0, NAME.1, ...; all float32 (integers are exact up to 2^24).
    background : (3,) float, optional
        As for `write_image`; not used for .exr.
    tone, exposure, bits, dither
        As for `write_image`.

    Raises
    ------
    InputError
        An unknown ending, no colour for .png or .jpg, arrays of different sizes, or a place that cannot be written.
    """
    path = checked_output(path, tone, exposure, bits)
    if path.suffix.lower() != ".exr":
        if "color" not in channels:
            raise InputError(f"{path}: a {path.suffix} picture needs the channel color, got "
                             f"{', '.join(channels) or 'none'}: ask for it with channels=, or write .exr")
        write_image(path, channels["color"], background, tone, exposure, bits, dither)
        return
    planes = {}
    for name, array in channels.items():
        array = np.asarray(array)
        if array.ndim not in (2, 3):
            raise InputError(f"channel {name}: expected shape (h, w) or (h, w, k), got {array.shape}")
        array = array.reshape(*array.shape[:2], -1)
        names = EXR_NAMES.get(name, ())
        if array.shape[2] > max(len(names), 1) or (not names and array.shape[2] > 1):
            names = tuple(f"{name}.{i}" for i in range(array.shape[2]))
        elif not names:
            names = (name,)
        planes.update({plane: array[..., i] for i, plane in enumerate(names[:array.shape[2]])})
    _write_exr(path, planes)


def read_image(path) -> NDArray:
    """Read a picture as (h, w, channels) in the file's own type: uint8, uint16 or float32, row 0 on top.

    8-bit colour keeps its straight alpha; EXR is linear and premultiplied.

    Raises
    ------
    InputError
        No such file.
    FileFormatError
        Not a picture, or a damaged one.
    """
    return _read(path)[0]


def read_channels(path) -> dict[str, NDArray]:
    """Read a picture as a dict of channel name to (h, w) array, such as the R, G, B, A, Z, N.X ... of an EXR file.

    Raises
    ------
    InputError, FileFormatError
        As for `read_image`.
    """
    pixels, names = _read(path)
    return {name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate(names)}


def _read(path) -> tuple[NDArray, tuple]:
    path = existing_file(path)
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise FileFormatError(f"{path}: not a picture that can be read: {_oiio_error(oiio)}")
    try:
        spec = source.spec()
        if spec.image_bytes() > _MOST_COMPRESSED * path.stat().st_size + 2**20:
            raise FileFormatError(f"{path}: damaged: {spec.width} x {spec.height} pixels of {spec.nchannels} channels "
                                  f"do not fit in {path.stat().st_size:,} bytes")
        kind = spec.format.basetype
        dtype = {oiio.UINT8: "uint8", oiio.UINT16: "uint16"}.get(kind, "float")
        pixels = source.read_image(0, 0, 0, spec.nchannels, dtype)
        if pixels is None or source.has_error:
            raise FileFormatError(f"{path}: damaged picture: {_oiio_error(source)}")
        return np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels), spec.channelnames
    finally:
        source.close()


def _write_exr(path: Path, planes: dict[str, NDArray]) -> None:
    shapes = {plane.shape for plane in planes.values()}
    if len(shapes) != 1 or 0 in next(iter(shapes)):
        raise InputError(f"{path}: expected channels of one size, got {sorted(shapes) or 'none'}")
    height, width = next(iter(shapes))
    spec = oiio.ImageSpec(width, height, len(planes), "float")
    spec.channelnames = tuple(planes)
    if "A" in planes:
        spec.alpha_channel = list(planes).index("A")
    if "Z" in planes:
        spec.z_channel = list(planes).index("Z")
    spec.attribute("compression", "zip")
    spec.attribute("oiio:ColorSpace", "lin_rec709")
    _write(path, spec, np.stack([np.asarray(plane, np.float32) for plane in planes.values()], axis=-1))


def _write_jpeg(path: Path, pixels: NDArray) -> None:
    """Write (h, w, 1 or 3) uint8 through memory: on a full disk OpenImageIO's JPEG writer ends the whole process."""
    from PIL import Image
    if 0 in pixels.shape:
        raise InputError(f"{path}: expected a picture of at least one pixel, got {pixels.shape[1]} x {pixels.shape[0]}")
    if max(pixels.shape[:2]) > _LARGEST_JPEG:
        raise InputError(f"{path}: .jpg holds up to {_LARGEST_JPEG} pixels a side, got {pixels.shape[1]} x "
                         f"{pixels.shape[0]}: write .png instead")
    buffer = io.BytesIO()
    Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels).save(buffer, "JPEG", quality=95, subsampling=0)
    with replacing(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def _write(path: Path, spec, pixels: NDArray) -> None:
    if 0 in pixels.shape:
        raise InputError(f"{path}: expected a picture of at least one pixel, got {pixels.shape[1]} x {pixels.shape[0]}")
    with replacing(path) as temporary:
        sink = oiio.ImageOutput.create(str(temporary))
        if sink is None:
            raise InputError(f"{path}: cannot be written: {_oiio_error(oiio)}")
        good = sink.open(str(temporary), spec) and sink.write_image(pixels)
        message = "" if good else _oiio_error(sink)
        if not sink.close() and good:
            good, message = False, _oiio_error(sink)
        if good and path.suffix.lower() == ".png" and not _png_ends(temporary):
            good, message = False, "disk full?"  # which OpenImageIO's PNG writer does not notice
        if not good:
            raise InputError(f"{path}: cannot be written: {message.replace(str(temporary), str(path))}")


def _png_ends(path: Path) -> bool:
    """Whether the PNG file at `path` has its last chunk."""
    with open(path, "rb") as file:
        file.seek(-min(12, path.stat().st_size), 2)
        return file.read()[4:8] == b"IEND"


def _as_pixels(pixels, background, tone="none", exposure=0.0, bits=8, dither=False) -> NDArray:
    """Return (h, w, channels) uint8 or uint16 sRGB pixels of a float or integer picture."""
    pixels = np.asarray(pixels)
    if pixels.dtype.kind == "f":
        return to_srgb_bytes(pixels, background, tone, exposure, bits, dither)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4):
        raise InputError("pixels: expected (h, w, 3 or 4) float or (h, w[, 1, 3 or 4]) uint8 or uint16, "
                         f"got {pixels.shape} {pixels.dtype}")
    return pixels


def _known(path) -> Path:
    path = Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"{path}: unknown picture format {path.suffix or '(no ending)'}: expected "
                         f"{', '.join(ENDINGS)}")
    return path


def _whole(value: NDArray, bits: int, shift=0.0) -> NDArray:
    """Return values from 0 to 1 as whole numbers of `bits` bits, rounded after `shift` is added."""
    most = 2**bits - 1
    value = np.clip(np.nan_to_num(value), 0, 1) * most
    return np.clip(value + (np.float32(0.5) + shift), 0, most).astype(np.uint8 if bits == 8 else np.uint16)


def _oiio_error(source) -> str:
    try:
        return one_line(ValueError(source.geterror() or "unknown error"))
    except UnicodeDecodeError:  # it quotes the file
        return "names in it are no text"
