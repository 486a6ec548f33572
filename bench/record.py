"""Figures and where they come from: machine, device, driver, commit, versions; JSON written whole or not at all."""

import datetime
import importlib.metadata
import json
import os
import platform
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from clsurf.errors import FileFormatError, InputError

FORMAT = "clsurf bench 1"
PACKAGES = ("clsurf", "numpy", "scipy", "pyopencl", "pocl-binary-distribution", "intel-opencl-rt", "open3d", "vtk",
            "pymeshlab")


def version_of(package: str) -> str | None:
    """Return the installed version, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def commit() -> str:
    """Return the commit of the checkout that holds the running code, ``+changes`` added; else the package's version."""
    import clsurf
    folder = Path(clsurf.__file__).resolve().parents[1]
    if (folder / ".git").exists():
        try:
            git = ["git", "-C", str(folder)]
            name = subprocess.run([*git, "rev-parse", "--short=10", "HEAD"], capture_output=True, text=True, check=True,
                                  timeout=20).stdout.strip()
            changed = subprocess.run([*git, "status", "--porcelain", "--untracked-files=no"], capture_output=True,
                                     text=True, check=True, timeout=20).stdout.strip()
            return name + ("+changes" if changed else "")
        except (OSError, subprocess.SubprocessError):
            pass
    return f"version {version_of('clsurf') or 'unknown'}"


def processor() -> str:
    """Return the processor's name, its widest vector instructions, and the number of cores this process may use."""
    name, vectors = platform.processor() or platform.machine(), ""
    try:
        for line in Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines():
            if line.startswith("model name"):
                name = line.partition(":")[2].strip()
            if line.startswith("flags"):  # names alone do not tell processors apart: "AMD EPYC" is any of five
                flags = line.split()
                vectors = next((f" with {isa}" for isa in ("avx512f", "avx2", "avx") if isa in flags), "")
    except OSError:
        pass
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{name}{vectors}, {cores} cores"


def provenance(device) -> dict:
    """Return what the figures depend on, ready for JSON; `device` is a `clsurf.Device`."""
    return {"date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"), "commit": commit(),
            "machine": platform.platform(), "cpu": processor(), "load": list(os.getloadavg())
            if hasattr(os, "getloadavg") else None, "device": device.name, "platform": device.platform_name,
            "driver": device.driver, "opencl": device.version, "lanes": device.lanes,
            "python": platform.python_version(),
            "versions": {name: version_of(name) for name in PACKAGES if version_of(name)}}


def timing(seconds) -> dict:
    """Return the figures of one thing measured several times.

    ``spread`` is half the distance between the quartiles over the median: what `compare` takes for noise.
    """
    seconds = np.asarray(seconds, np.float64)
    low, middle, high = np.percentile(seconds, (25, 50, 75))
    return {"median_s": float(middle), "min_s": float(seconds.min()), "spread": float((high - low) / 2 / middle),
            "runs": len(seconds)}


def write(path, result: dict) -> None:
    """Write `result` as JSON; the file appears whole or not at all.

    Raises
    ------
    InputError
        A folder that cannot be written.
    """
    path = Path(path)
    text = json.dumps({"format": FORMAT, **result}, indent=1, default=_plain) + "\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".part", delete=False) as file:
            file.write(text)
        os.chmod(file.name, 0o644)
        os.replace(file.name, path)
    except OSError as error:
        raise InputError(f"bench figures {path}: expected a folder that can be written, got {error.strerror}: "
                         "choose another --json") from None


def read(path) -> dict:
    """Return the figures of a JSON file that `write` made.

    Raises
    ------
    FileFormatError
        No such file, or another kind of file.
    """
    try:
        result = json.loads(Path(path).read_text())
    except (OSError, ValueError) as error:
        raise FileFormatError(f"bench figures {path}: expected a JSON file of `clsurf bench --json`, got "
                              f"{error}") from None
    if not isinstance(result, dict) or result.get("format") != FORMAT:
        raise FileFormatError(f"bench figures {path}: expected the format {FORMAT!r}: measure again with this version")
    return result


def _plain(value):
    """Return NumPy values as Python's."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no place in JSON")
