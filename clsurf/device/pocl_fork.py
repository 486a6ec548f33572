"""PoCL in a forked child: a copy of the library with threads of its own.

PoCL starts its worker threads when its devices are first listed; `fork` does not copy them, so that a child waits for
ever for its first launch. A second copy of the library (the dynamic linker shares one that it knows by its inode) has a
state of its own. It is made once, in clsurf's cache, beside a link to the files that PoCL looks for relative to itself.
"""

import ctypes
import os
import shutil
from pathlib import Path

import pyopencl as cl

from ..errors import DeviceError
from .icd import cache_folder

_listed_in: int | None = None  # the process in which PoCL's devices were listed first
_generation = 0  # how many processes above this one did so before they forked
_fresh: dict[int, cl.Platform] = {}  # by process


def is_pocl(platform) -> bool:
    """Whether a platform is PoCL."""
    return "portable computing language" in platform.name.lower()


def usable(platform):
    """Return `platform`, or where this process was forked from one that used PoCL, a PoCL that works here.

    Raises
    ------
    DeviceError
        The library could not be copied.
    """
    global _listed_in, _generation
    if not is_pocl(platform):
        return platform
    process = os.getpid()
    if process in _fresh:
        return _fresh[process]
    if _listed_in is None:
        _listed_in = process
    if _listed_in == process:
        return platform
    _listed_in, _generation = process, _generation + 1
    _fresh[process] = _copied_platform(_generation)
    return _fresh[process]


def _copied_platform(generation: int) -> cl.Platform:
    source = _library()
    if source is None:
        raise DeviceError("PoCL: a forked process cannot use it after its parent did: start processes with "
                          "multiprocessing.get_context('spawn')")
    stat = source.stat()
    name = f"pocl-{stat.st_ino:x}-{stat.st_size:x}-{int(stat.st_mtime):x}-{generation}"
    folder = cache_folder() / name
    copy = folder / source.parent.parent.name / source.parent.name / source.name
    try:
        copy.parent.mkdir(parents=True, exist_ok=True)
        if not copy.exists():
            for beside in source.parent.parent.parent.glob("pocl_binary_distribution*"):
                if not (folder / beside.name).is_symlink():
                    (folder / beside.name).symlink_to(beside)
            part = copy.with_suffix(f".{os.getpid()}.part")
            shutil.copyfile(source, part)
            part.replace(copy)
        library = ctypes.CDLL(str(copy))
    except OSError as error:
        raise DeviceError(f"PoCL: a forked process needs a copy of its library in {folder}: {error}: start processes "
                          "with multiprocessing.get_context('spawn')") from None
    address = library.clGetExtensionFunctionAddress
    address.restype, address.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    list_platforms = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(
        address(b"clIcdGetPlatformIDsKHR"))
    found = (ctypes.c_void_p * 1)()
    if list_platforms(1, found, None) or not found[0]:
        raise DeviceError("PoCL: the copy of its library for a forked process has no platform: start processes with "
                          "multiprocessing.get_context('spawn')")
    return cl.Platform.from_int_ptr(found[0])


def _library() -> Path | None:
    """Return the file of the PoCL library that this process has loaded."""
    try:
        with open("/proc/self/maps") as maps:
            names = {line.split(maxsplit=5)[-1].strip() for line in maps if "/libpocl" in line}
    except OSError:
        return None
    known = sorted(name for name in names if "/clsurf/pocl-" not in name and Path(name).is_file())
    return Path(known[0]) if known else None
