"""Make every OpenCL driver visible that is on the machine, without environment variables of the user's.

The loader looks in one vendors folder only. pip's Intel runtime names a path of another install there, and containers
often carry `libnvidia-opencl.so.1` without its `.icd` file. So a folder of our own in the user's cache holds copies of
the system's `.icd` files and the missing ones, and `OCL_ICD_VENDORS` points to it before pyopencl asks for platforms.
A user's own `OCL_ICD_VENDORS` is respected. PoCL from pip is added by pyopencl itself.
"""

import ctypes
import hashlib
import importlib.metadata
import logging
import os
import sys
import tempfile
from pathlib import Path

log = logging.getLogger("clsurf")

SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")
# libintelocl.so needs these from its own folder; preloading them spares the user LD_LIBRARY_PATH.
INTEL_NEEDS = ("libintlc.so.5", "libimf.so", "libsvml.so", "libirng.so", "libtbb.so.12")

_prepared = False


def cache_folder() -> Path:
    """Return a writable folder for clsurf's own cache, made if missing."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "clsurf"
    try:
        base.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=base):
            pass
    except OSError:
        base = Path(tempfile.gettempdir()) / f"clsurf-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
    return base


def can_be_made(folder: Path) -> bool:
    """Whether `folder` is there and can be written, or can be made."""
    folder = folder.absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)


def intel_library() -> Path | None:
    """Return the path of pip's Intel CPU runtime, or None."""
    candidates = [Path(sys.prefix) / "lib" / "libintelocl.so"]
    try:
        files = importlib.metadata.files("intel-opencl-rt") or []
        candidates += [Path(f.locate()).resolve() for f in files if f.name == "libintelocl.so"]
    except importlib.metadata.PackageNotFoundError:
        pass
    return next((path for path in candidates if path.exists()), None)


def nvidia_library() -> str | None:
    """Return the name of NVIDIA's OpenCL library where the loader finds it, or None."""
    try:
        ctypes.CDLL("libnvidia-opencl.so.1")
    except OSError:
        return None
    return "libnvidia-opencl.so.1"


def wanted_entries() -> dict[str, str]:
    """Return the `.icd` files that the vendors folder should hold: name to content."""
    entries = {}
    if SYSTEM_VENDORS.is_dir():
        for path in sorted(SYSTEM_VENDORS.glob("*.icd")):
            try:
                entries[path.name] = path.read_text().strip()
            except OSError as error:
                log.debug("%s: %s", path, error)
    text = " ".join(entries.values())
    intel = intel_library()
    if intel is not None and "libintelocl" not in text:
        entries["clsurf-intel-cpu.icd"] = str(intel)
    if "libnvidia-opencl" not in text and nvidia_library():
        entries["clsurf-nvidia.icd"] = nvidia_library()
    return entries


def prepare() -> None:
    """Point the loader at a folder with every driver; does nothing the second time, or where the user chose one."""
    global _prepared
    if _prepared or not sys.platform.startswith("linux"):
        return
    _prepared = True
    # PoCL has no device where it cannot make its cache, and pyopencl fails where it cannot make its own: a home that
    # cannot be written (containers, services).
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path(os.environ.get("HOME") or "/tmp") / ".cache")
    if not os.environ.get("POCL_CACHE_DIR") and not can_be_made(base / "pocl" / "kcache"):
        os.environ["POCL_CACHE_DIR"] = str(cache_folder() / "pocl")
    if not can_be_made(base / "pyopencl") or not can_be_made(base / "pytools"):
        os.environ["XDG_CACHE_HOME"] = str(cache_folder())
    if os.environ.get("OCL_ICD_VENDORS"):
        return
    entries = wanted_entries()
    if not entries:
        return
    if "clsurf-intel-cpu.icd" in entries:
        folder = Path(entries["clsurf-intel-cpu.icd"]).parent
        for name in INTEL_NEEDS:
            try:
                ctypes.CDLL(str(folder / name), mode=ctypes.RTLD_GLOBAL)
            except OSError as error:
                log.debug("Intel's CPU runtime: %s", error)
    # One folder per content: two environments with different drivers never overwrite each other's.
    key = hashlib.sha256(repr(sorted(entries.items())).encode()).hexdigest()[:12]
    vendors = cache_folder() / f"vendors-{key}"
    try:
        vendors.mkdir(parents=True, exist_ok=True)
        for name, content in entries.items():
            target = vendors / name
            if not target.exists() or target.read_text().strip() != content:
                partial = target.with_suffix(f".{os.getpid()}.part")
                partial.write_text(content + "\n")
                partial.replace(target)
    except OSError as error:
        log.warning("OpenCL drivers: cannot write %s (%s); only the system's drivers are seen", vendors, error)
        return
    os.environ["OCL_ICD_VENDORS"] = str(vendors)
