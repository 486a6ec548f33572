"""The job `devices`: whether every OpenCL device of this machine gives the same answers.

The surfaces are made once, on the first device; then each device runs the jobs of `answers` in a process of its own,
twice, and its arrays are held against those of the first: equal bytes, or how far apart. Depth must agree within 1e-5
of the scene's diagonal at 99.99 % of the pixels, numbers of surfaces and primitives at 99.9 %.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from clsurf.device import all_devices, open_device
from clsurf.errors import DeviceError

from . import answers
from .build import WrongAnswer
from .table import print_table

DIAGONAL = float(np.linalg.norm([2.8, 2.8, 0.8]))  # of the torus that all pictures show
DEPTH_TOLERANCE, DEPTH_SHARE, NUMBER_SHARE = 1e-5, 0.9999, 0.999
PICTURES = ("draw_slim", "draw_patches", "draw_others", "search_levels", "trace", "trace_grid")
# Their jobs compare what is built, measured or lit; the pictures decide over one answer everywhere.
JOB_SECONDS = 3000
RUN = ("import sys; from clsurf.cli.machine import bench_package; bench_package(); from clsurf_bench import answers; "
       "answers.main(sys.argv[1:])")


def measure(device, quick: bool = False, profile: bool = False) -> dict:
    """Return how the devices' answers differ from those of `device`.

    Raises
    ------
    WrongAnswer
        A device's depth or numbers differ at more pixels than they may.
    """
    size = "tiny" if quick else "small"
    others = [other for other in all_devices() if other != device.cl_device]
    with tempfile.TemporaryDirectory() as folder:
        made = answers.surfaces(device, answers.SIZES[size])
        answers.save_surfaces(folder, made)
        wanted = run(device, size, folder, "first")
        repeated = run(device, size, folder, "again")
        rows = [{"device": device.name, "platform": device.platform_name, "deterministic": same(wanted, repeated),
                 "hash": hash_of(wanted)}]
        for number, other in enumerate(others):
            opened = open_device(other)
            got, again = (run(opened, size, folder, f"{number}{turn}") for turn in ("a", "b"))
            rows.append({"device": opened.name, "platform": opened.platform_name, "deterministic": same(got, again),
                         "hash": hash_of(got), **differences(wanted, got)})
    figures = {"size": size, "devices": rows, "arrays": len(wanted)}
    show(figures)
    wrong = [row for row in rows if not row["deterministic"]]
    if wrong:
        raise WrongAnswer(f"bench devices: {wrong[0]['device']} gave other bytes the second time")
    # A handful of pixels says nothing about shares of a ten-thousandth.
    wrong = [row for row in rows[1:] if not quick and not (row["depth_share"] >= DEPTH_SHARE
                                                           and row["number_share"] >= NUMBER_SHARE)]
    if wrong:
        raise WrongAnswer(f"bench devices: {wrong[0]['device']} differs at more pixels than it may: depth agrees at "
                          f"{wrong[0]['depth_share']:.4%}, numbers at {wrong[0]['number_share']:.3%}")
    return figures


def run(device, size: str, folder: str, name: str) -> dict:
    """Return the arrays of all jobs on `device`, from a process of its own."""
    # The name of a device may be that of another platform's too; its number among all is not.
    selector = f"{device.platform_name.lower()}:{same_platform(device)}"
    path = Path(folder) / f"{name}.npz"
    command = [sys.executable, "-c", RUN, str(path), "--size", size, "--surfaces", folder, "--device", selector]
    done = subprocess.run(command, capture_output=True, text=True, timeout=JOB_SECONDS,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
    if done.returncode:
        raise DeviceError(f"device {device.name}: its answers ended with code {done.returncode}: "
                          f"{done.stderr.strip().splitlines()[-1] if done.stderr.strip() else 'no word'}")
    with np.load(path) as arrays:
        return {key: arrays[key] for key in arrays.files}


def same_platform(device) -> int:
    """Return the number of a device among those that its platform's name selects."""
    named = [d for d in all_devices() if d.platform.name.strip() == device.platform_name]
    return named.index(device.cl_device)


def same(a: dict, b: dict) -> bool:
    """Return whether two runs gave equal bytes."""
    return set(a) == set(b) and all(answers.digest(a[key]) == answers.digest(b[key]) for key in a)


def hash_of(arrays: dict) -> str:
    """Return one hash of all arrays of a run."""
    text = "".join(f"{key} {answers.digest(arrays[key])}\n" for key in sorted(arrays))
    return answers.digest(np.frombuffer(text.encode(), np.uint8))


def differences(wanted: dict, got: dict) -> dict:
    """Return the shares of pixels and rays where depth and numbers agree, and of arrays with equal bytes."""
    depth = number = depths = numbers = equal = 0
    worst = {}
    for key, a in wanted.items():
        b = got.get(key)
        equal += b is not None and answers.digest(a) == answers.digest(b)
        job, name = key.split("/")
        if job not in PICTURES or b is None or a.shape != b.shape:
            continue
        if name.startswith(("depth", "hit")) and a.dtype != bool and "_all" not in name:
            with np.errstate(invalid="ignore"):
                close = (np.abs(a - b) <= DEPTH_TOLERANCE * DIAGONAL) | (a == b) | (np.isnan(a) & np.isnan(b))
            depth, depths = depth + close.sum(), depths + close.size
            worst[key] = float(close.mean())
        elif name.startswith(("id", "primitive")):
            number, numbers = number + (a == b).sum(), numbers + a.size
            worst[key] = float((a == b).mean())
    least = min(worst, key=worst.get, default="")
    return {"depth_share": depth / max(depths, 1), "number_share": number / max(numbers, 1), "equal_arrays": equal,
            "worst": least, "worst_share": worst.get(least, 1.0)}


def show(figures: dict) -> None:
    """Print the table of hashes and differences."""
    head = ["device", "platform", "same twice", "hash", "equal arrays", "depth within 1e-5", "numbers", "worst array"]
    rows = [[row["device"][:28], row["platform"][:24], "yes" if row["deterministic"] else "NO", row["hash"],
             f"{row.get('equal_arrays', figures['arrays'])} of {figures['arrays']}",
             *(f"{row[name]:.3%}" if name in row else "-" for name in ("depth_share", "number_share")),
             f"{row['worst']} {row['worst_share']:.2%}" if row.get("worst") else "-"] for row in figures["devices"]]
    print(f"answers of all devices, scenes of size {figures['size']}")
    print_table(head, rows)
