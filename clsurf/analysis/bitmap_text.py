"""Small text in pictures, with no font on the machine: letters of 5 x 7 dots."""

import numpy as np
from numpy.typing import NDArray

# Five columns a letter, two hex digits each, the lowest bit on top.
DOTS = {
    "0": "3e5149453e", "1": "00427f4000", "2": "4261514946", "3": "2141454b31", "4": "1814127f10", "5": "2745454539",
    "6": "3c4a494930", "7": "0171090503", "8": "3649494936", "9": "064949291e", ".": "0060600000", "-": "0808080808",
    "+": "08083e0808", "_": "4040404040", "/": "2010080402", "a": "2054545478", "b": "7f48444438", "c": "3844444420",
    "d": "384444487f", "e": "3854545418", "f": "087e090102", "g": "0c5252523e", "h": "7f08040478", "i": "00447d4000",
    "j": "2040443d00", "k": "7f10284400", "l": "00417f4000", "m": "7c04180478", "n": "7c08040478", "o": "3844444438",
    "p": "7c14141408", "q": "081414187c", "r": "7c08040408", "s": "4854545420", "t": "043f444020", "u": "3c4040207c",
    "v": "1c2040201c", "w": "3c4030403c", "x": "4428102844", "y": "0c5050503c", "z": "4464544c44",
}
WIDE, TALL = 6, 8  # dots from letter to letter and from line to line


def text_size(text: str, size: int) -> tuple[int, int]:
    """Return width and height in pixels of `text` with dots of `size` pixels."""
    return WIDE * size * len(text), TALL * size


def draw_text(colors: NDArray, text: str, left: int, top: int, size: int, ink: float) -> None:
    """Draw `text` into a picture (h, w, 4), linear, opaque grey `ink`, cut at its borders; unknown letters are gaps."""
    dots = np.zeros((TALL, WIDE * len(text)), bool)
    for i, letter in enumerate(text.lower()):
        columns = np.frombuffer(bytes.fromhex(DOTS.get(letter, "")), np.uint8)
        dots[:, WIDE * i:WIDE * i + len(columns)] = np.unpackbits(columns[:, None], axis=1, bitorder="little").T
    y, x = np.nonzero(dots.repeat(size, axis=0).repeat(size, axis=1))
    y, x = y + top, x + left
    inside = (y >= 0) & (x >= 0) & (y < colors.shape[0]) & (x < colors.shape[1])
    colors[y[inside], x[inside]] = (ink, ink, ink, 1)
