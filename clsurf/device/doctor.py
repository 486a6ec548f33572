"""What a machine offers clsurf and what it lacks, with the one command that mends each lack."""

import importlib.metadata
import os
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DeviceError, Error
from . import icd
from .context import Device, all_devices, choose_device, open_device
from .sources import kernel_folder


@dataclass(frozen=True)
class Finding:
    """One line of the doctor's report; `mend` is the command that helps, empty where all is well."""

    name: str
    good: bool
    detail: str
    mend: str = ""


def examine() -> list[Finding]:
    """Look at Python, drivers, devices, caches and optional packages; run a small kernel on every device."""
    findings = [_python(), _kernels(), _cache(), *_drivers()]
    devices = all_devices()
    if not devices:
        findings.append(_no_device(writable_cache=findings[2].good))
    findings += [_device(d) for d in devices]
    findings += _choice() if devices else []
    findings += [_package("laspy", "LAS and LAZ point clouds"), _package("lazrs", "compressed LAZ"),
                 _package("trimesh", "mesh formats"), _package("OpenImageIO", "pictures")]
    return findings


def _pip(what: str) -> str:
    """Return the command that installs `what` where clsurf runs: a bare pip may be another Python's."""
    return f"{shlex.quote(sys.executable)} -m pip install {what}"


def _python() -> Finding:
    version = ".".join(map(str, sys.version_info[:3]))
    good = sys.version_info >= (3, 11)
    return Finding("python", good, version, "" if good else "install Python 3.11 or newer")


def _kernels() -> Finding:
    try:
        folder = kernel_folder()
    except Error as error:
        return Finding("kernels", False, str(error), _pip("--force-reinstall clsurf"))
    return Finding("kernels", True, f"{len(list(folder.rglob('*.cl')))} files in {folder}")


def _cache() -> Finding:
    folder = icd.cache_folder()
    named = os.environ.get("POCL_CACHE_DIR")
    if named and not icd.can_be_made(Path(named)):
        return Finding("cache", False, f"POCL_CACHE_DIR={named} cannot be written, without it PoCL has no device",
                       "unset POCL_CACHE_DIR")
    return Finding("cache", True, str(folder))


def _drivers() -> list[Finding]:
    findings = []
    vendors = os.environ.get("OCL_ICD_VENDORS", "")
    findings.append(Finding("drivers", True, f"vendors folder {vendors or icd.SYSTEM_VENDORS}"))
    intel = icd.intel_library()
    linux = sys.platform.startswith("linux")
    if linux and intel is None:
        findings.append(Finding("Intel CPU runtime", True, "not installed (optional: a second CPU driver)",
                                _pip("'clsurf[intel]'")))
    elif intel is not None:
        missing = [name for name in icd.INTEL_NEEDS if not (intel.parent / name).exists()]
        lack = f", lacks {missing}" if missing else ""
        findings.append(Finding("Intel CPU runtime", not missing, f"{intel}{lack}",
                                _pip("intel-cmplr-lib-rt") if missing else ""))
    if icd.nvidia_library():
        findings.append(Finding("NVIDIA driver", True, icd.nvidia_library()))
    return findings


def _no_device(writable_cache: bool) -> Finding:
    name = "pocl-binary-distribution"
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return Finding("device", False, "no OpenCL device found", _pip(name))
    detail = f"no OpenCL device found, though {name} {version} is installed"
    if not writable_cache:
        return Finding("device", False, f"{detail}: PoCL cannot write its cache", "unset POCL_CACHE_DIR")
    return Finding("device", False, detail, _pip(f"--force-reinstall {name}"))


def _choice() -> list[Finding]:
    named = os.environ.get("CLSURF_DEVICE")
    if not named:
        return []
    try:
        return [Finding("CLSURF_DEVICE", True, f"{named}: {choose_device(named).name.strip()}")]
    except Error:
        return [Finding("CLSURF_DEVICE", False, f"{named} names none of the devices", "unset CLSURF_DEVICE")]


def _device(cl_device) -> Finding:
    label = f"{cl_device.name.strip()} ({cl_device.platform.name.strip()})"
    try:
        device = open_device(cl_device)
        check(device)
    except Error as error:
        lines = [line for line in str(error).splitlines() if line.strip()]
        mend = _pip("'clsurf[intel]'") if "Portable" in cl_device.platform.name else "update its driver"
        return Finding(label, False, " ".join(lines)[:300], mend)
    return Finding(label, True, f"{device.kind}, {device.units} units, {device.memory_bytes / 1e9:.1f} GB, "
                   f"{device.version}, driver {device.driver}: compiles and computes")


def check(device: Device) -> None:
    """Compile and run one kernel on `device` and compare its answer.

    Raises
    ------
    DeviceError
        A wrong answer, or a kernel that does not compile.
    """
    values = np.linspace(0, 100, 64, dtype=np.float32)
    source, target = device.upload(values), device.empty(64, np.float32)
    kernel = device.kernel("common/self_test.cl", constants={"VW": device.lanes})
    kernel((64 // device.lanes,), (1,), source, target, np.float32(3.0))
    error = np.abs(device.download(target) - (3 * np.sqrt(values) + 1)).max()
    if not error < 1e-4:
        raise DeviceError(f"device {device.name}: a test kernel answers wrongly (off by {error:g})")


def _package(name: str, use: str) -> Finding:
    try:
        return Finding(name, True, f"{importlib.metadata.version(name)} ({use})")
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, False, f"not installed ({use})", _pip(name))
