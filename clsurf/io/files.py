"""What every reader and writer of files shares: checks of a path, and output that appears whole or not at all."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

from clsurf.errors import FileFormatError, InputError


def existing_file(path) -> Path:
    """Return `path` as a Path to a non-empty regular file that may be read.

    Raises
    ------
    InputError
        No such file, a folder, something that is not a plain file, or no permission.
    FileFormatError
        An empty file.
    """
    path = _as_path(path)
    try:
        if path.is_dir():
            raise InputError(f"{path}: expected a file, got a folder")
        if not path.exists():
            raise InputError(f"{path}: no such file")
        if not path.is_file():  # a pipe or a device would block for ever
            raise InputError(f"{path}: expected a plain file, got a pipe or a device")
        if path.stat().st_size == 0:
            raise FileFormatError(f"{path}: the file is empty")
        with open(path, "rb"):
            pass
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read: {_reason(error)}") from None
    return path


def writable_place(path) -> Path:
    """Return `path` as a Path in an existing folder that may be written.

    Raises
    ------
    InputError
        The folder is missing or not writable, or `path` is a folder.
    """
    path = _as_path(path)
    try:
        if path.is_dir():
            raise InputError(f"{path}: expected a file name, got a folder")
        if not path.parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} does not exist: make it first")
        if not os.access(path.parent, os.W_OK):
            raise InputError(f"{path}: the folder {path.parent} cannot be written: choose another")
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be written: {_reason(error)}") from None
    return path


@contextlib.contextmanager
def replacing(path) -> Iterator[Path]:
    """Give a temporary path beside `path` with the same ending; move it over `path` once the block has succeeded.

    On any error the temporary file is removed and `path` stays as it was.

    Raises
    ------
    InputError
        The folder is missing or not writable, the disk is full, or `path` is a folder.
    """
    path = writable_place(path)
    temporary = path.with_name(f".{path.stem[:40]}.{uuid.uuid4().hex[:12]}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {_reason(error)}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _as_path(path) -> Path:
    try:
        return Path(os.fspath(path)).expanduser()
    except (TypeError, RuntimeError):
        raise InputError(f"path: expected a file name, got {type(path).__name__}") from None


def write_array(file, rows) -> None:
    """Write a NumPy array to an open file; unlike `tofile`, a full disk is told as such."""
    file.write(memoryview(rows).cast("B") if rows.size else b"")


def one_line(error: BaseException | str) -> str:
    """Return the message of `error`, or a text, on one line, shortened to 200 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else text[:197] + "..."


def _reason(error: BaseException) -> str:
    return (error.strerror if isinstance(error, OSError) and error.strerror else one_line(error)).lower()
