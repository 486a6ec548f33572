"""The job `stream`: scans larger than memory, each built in a process of its own whose peak is measured."""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from clsurf.build.project import project
from clsurf.io.chunks import open_source
from clsurf.io.stored import StoredSurface

from . import scenes
from .build import WrongAnswer
from .table import print_table

# Of autzen, whose unit is the foot (its file does not say so): a quarter of the point spacing, and 0.3 m.
TOLERANCES = {"autzen": 0.3, "autzen, 0.3 m": 0.3 / 0.3048}
SAMPLE = 50  # every so many of the points is measured
GENERATED = (10_000_000, 50_000_000)
QUICK = (200_000, 1_000_000)
CHILD = """
import json, sys, time
from clsurf.build.slim import build_slim
path, out, selector, tolerance = sys.argv[1:]
build_slim(path, out=out, memory_limit="1GB", device=selector, tolerance=float(tolerance) or None)
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))  # of this process alone
print(json.dumps({"peak_bytes": 1024 * int(peak), "cpu_seconds": time.process_time()}))
"""


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return the figures of streamed builds; `device` is an opened one.

    Returns
    -------
    dict
        Per scan: points, seconds, cpu_seconds (of all cores together), peak_bytes (of the whole process), surfels, and
        for autzen the share of the points within TOLERANCE; ``linear``, ``linear_cpu``: seconds a point of the largest
        generated scan over those of the smallest.
    """
    selector = "intel" if "intel" in device.platform_name.lower() else "pocl" if device.kind == "cpu" else device.name
    figures = {}
    with tempfile.TemporaryDirectory(prefix="clsurf-bench-") as folder:
        autzen = scenes.data_folder() / "clouds" / "autzen.laz"
        if not quick and autzen.exists():
            for name, tolerance in TOLERANCES.items():
                one = figures[name] = _built(autzen, Path(folder), selector, tolerance)
                one["tolerance"] = tolerance
                one["within"] = _within(autzen, Path(folder) / "surface.clsurf", tolerance, device)
                if not one["within"] > 0.99:
                    raise WrongAnswer(f"bench stream: expected 99 % of autzen's points within {tolerance:.3g}, got "
                                      f"{one['within']:.2%}")
        elif not quick:
            print("scan missing: autzen (CLSURF_DATA names the folder)")
        for count in QUICK if quick else GENERATED:
            path = Path(folder) / "generated.ply"
            write_hills(path, count)
            figures[f"hills {count:,}"] = _built(path, Path(folder), selector, None)
    first, last = ([figures[f"hills {count:,}"] for count in (QUICK if quick else GENERATED)][k] for k in (0, -1))
    for name, seconds in (("linear", "seconds"), ("linear_cpu", "cpu_seconds")):
        figures[name] = (last[seconds] / last["points"]) / (first[seconds] / first["points"])
    show(figures)
    return figures


def _error(one: dict) -> str:
    if "within" in one:
        return f"{one['within']:.2%} within {one['tolerance']:.3g}"
    return f"{one['bound']:.3g} bound"


def show(figures: dict) -> None:
    """Print the figures."""
    rows = [(name, f"{one['points']:,}", f"{one['seconds']:.1f}", f"{one['cpu_seconds']:.1f}",
             f"{one['peak_bytes'] / 1e6:.0f}",
             f"{one['surfels']:,}", _error(one))
            for name, one in figures.items() if isinstance(one, dict)]
    print_table(("scan", "points", "s", "CPU s", "peak MB", "surfels", "error"), rows)
    print(f"time a point, largest over smallest: {figures['linear']:.2f}, of all cores {figures['linear_cpu']:.2f}")


def write_hills(path: Path, count: int) -> None:
    """Write `count` points of hills, 3 a square metre, in the order of flight lines, as binary PLY with colours."""
    rng, side, lines = np.random.default_rng(1), np.sqrt(count / 3.0), 64
    dtype = np.dtype([("p", "<f4", 3), ("c", "u1", 3)])
    with open(path, "wb") as file:
        file.write((f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\nproperty float x\n"
                    "property float y\nproperty float z\nproperty uchar red\nproperty uchar green\n"
                    "property uchar blue\nend_header\n").encode())
        for line in range(lines):
            n = count * (line + 1) // lines - count * line // lines
            rows = np.empty(n, dtype)
            x, y = np.sort(rng.random(n)) * side, (line + rng.random(n)) * side / lines
            z = 20 * np.sin(x / 130) * np.cos(y / 170) + 2 * np.sin(x / 9) * np.sin(y / 11) + rng.normal(0, 0.03, n)
            rows["p"] = np.stack([x, y, z], axis=1)
            rows["c"] = np.stack([128 + 3 * z, 255 * x / side, 255 * y / side], axis=1).clip(0, 255)
            file.write(memoryview(rows).cast("B"))


def _built(path: Path, folder: Path, selector: str, tolerance) -> dict:
    """Build the surface of a file in a process of its own."""
    out = folder / "surface.clsurf"
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", CHILD, str(path), str(out), selector, str(tolerance or 0)],
                          capture_output=True, text=True)
    if done.returncode:
        raise WrongAnswer(f"bench stream: the build of {path.name} failed: {done.stderr[-500:]}")
    seconds = time.perf_counter() - start
    stored = StoredSurface(out)
    return {"points": open_source(path).count, "seconds": seconds, "surfels": len(stored), "bound": stored.bound,
            "parts": len(stored.surfels), **json.loads(done.stdout.splitlines()[-1])}


def _within(path: Path, place: Path, tolerance: float, device) -> float:
    """Return the share of every SAMPLE-th point of a scan that the surface comes within `tolerance` of."""
    surface, source = StoredSurface(place).load(), open_source(path)
    near = [np.abs(project(surface, source.read(k).points[::SAMPLE], device).distance) <= tolerance
            for k in range(source.chunks)]
    return float(np.concatenate(near).mean())
