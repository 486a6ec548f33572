"""What every command shares: options, their checks, and how work is reported."""

import contextlib
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from ..errors import InputError

PICTURES = (".png", ".jpg", ".jpeg", ".exr")

DeviceOption = Annotated[str, typer.Option("--device", "-d", help="gpu, cpu, pocl, intel, nvidia, amd, gpu:1 or part "
                                           "of a name; default: CLSURF_DEVICE, else a GPU, else the fastest CPU "
                                           "runtime.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
ProfileOption = Annotated[bool, typer.Option(help="Print the time of every kernel.")]
SizeOption = Annotated[str, typer.Option(help="Picture size, such as 1024x768.")]


class Steps:
    """Reports steps of work: a progress bar on a terminal, a plain line per finished step elsewhere."""

    def __init__(self, quiet: bool):
        self.quiet, self.times = quiet, {}
        self.bar = None
        if not quiet and sys.stderr.isatty():
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
            self.bar = Progress(TextColumn("{task.description:34}"), BarColumn(), TimeElapsedColumn(), transient=True)

    @contextlib.contextmanager
    def step(self, name: str):
        """Time one step; inside it, `progress` moves its bar."""
        start = time.perf_counter()
        if self.bar is not None:
            self.bar.start()
            self.task = self.bar.add_task(name, total=1.0)
        try:
            yield
        finally:
            if self.bar is not None:
                self.bar.remove_task(self.task)
                self.bar.stop()
        self.times[name] = time.perf_counter() - start
        self.say(f"{name:<34} {self.times[name]:8.3f} s")

    def progress(self, stage: str, done: float) -> None:
        """Move the bar of the running step; the callback that builders take."""
        if self.bar is not None:
            self.bar.update(self.task, completed=done, description=stage)

    def say(self, text: str) -> None:
        """Print a line unless quiet."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)


def is_surface(thing) -> bool:
    """Return whether `thing` is a surface, and not a scan that one is built from."""
    import clsurf
    return isinstance(thing, clsurf.SlimSurface | clsurf.PatchSurface | clsurf.SurfelHierarchy | clsurf.ScaleMap |
                      clsurf.StoredSurface)


def checked_out(path: Path, endings=()) -> Path:
    """Return `path` if it can be written and ends in one of `endings`: told before the work, not after it."""
    if endings and path.suffix.lower() not in endings:
        raise InputError(f"output {path}: expected a name that ends in {', '.join(endings[:-1])} or {endings[-1]}")
    from ..io.files import writable_place
    return writable_place(path)


def parsed_size(text: str) -> tuple[int, int]:
    """Return (width, height) of a text such as 1024x768."""
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise InputError(f"size: expected WIDTHxHEIGHT such as 1024x768, got {text!r}")
    return int(width), int(height)


def parsed_vector(name: str, text: str) -> tuple[float, float, float]:
    """Return three numbers of a text such as 1,0.5,2."""
    try:
        x, y, z = (float(part) for part in text.split(","))
        if not 0 < x * x + y * y + z * z < float("inf"):
            raise ValueError
    except ValueError:
        raise InputError(f"{name}: expected three numbers such as 1,0.5,2, not all 0, got {text!r}") from None
    return x, y, z
