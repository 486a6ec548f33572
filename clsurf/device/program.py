"""Programs and kernels: built once per context and text, launched with a label, profiled on request."""

import hashlib
import os
import re
import time
import warnings
from collections import defaultdict
from pathlib import Path

import numpy as np
import pyopencl as cl

from ..errors import KernelBuildError
from .arrays import DeviceArray
from .sources import ENDED, argument_dtypes, kernel_text, watched

# -w: PoCL prints its compiler's warnings straight to the terminal.
BUILD_OPTIONS = ["-cl-std=CL1.2", "-cl-mad-enable", "-w"]
# What a kernel says whose answer may depend on how its items are grouped.
GROUPED = re.compile(r"\bget_(?:local|group|num_groups|global_size)|\bbarrier\b|reqd_work_group|\b(?:__)?local\b")


class Kernel:
    """One kernel of one thread; calling it enqueues a launch.

    ``kernel(global_size, local_size, *arguments)``: sizes are tuples of int; arguments are `DeviceArray`, pyopencl
    buffers, `pyopencl.LocalMemory`, or numbers, which are cast to the kernel's own types.
    """

    def __init__(self, device, kernel, label, dtypes, free=False, ended=False):
        self.device, self.kernel, self.label, self.free = device, kernel, label, free
        kernel.set_scalar_arg_dtypes(dtypes)
        self.watched = ended
        self.count = len(dtypes) - 2 * ended

    def __call__(self, global_size, local_size, *arguments):
        """Enqueue a launch; with a profile, wait for it and record its time."""
        if len(arguments) != self.count:
            raise TypeError(f"kernel {self.label}: expected {self.count} arguments, got {len(arguments)}")
        if 0 in global_size:
            return
        # PoCL crashes with local_size=None on kernels with large private arrays.
        local_size = local_size or (1,) * len(global_size)
        global_size = tuple(-(-g // s) * s for g, s in zip(global_size, local_size, strict=True))
        told = (global_size[0], self.device.ended.buffer) if self.watched else ()
        self.kernel.set_args(*(a.buffer if isinstance(a, DeviceArray) else a for a in arguments), *told)
        try:
            self._launch(global_size, local_size, arguments)
        except cl.Error as error:
            raise self.device.failure(error) from None

    def _launch(self, global_size, local_size, arguments) -> None:
        profile = self.device.profile
        if profile is None:
            self._enqueue(global_size, local_size)
            self.device.in_flight.append(arguments)
            return
        self.device.queue.finish()
        start = time.perf_counter()
        self._enqueue(global_size, local_size)
        self.device.queue.finish()
        profile.add(self.label, time.perf_counter() - start)

    def _enqueue(self, global_size, local_size) -> None:
        """Launch; items that are asked for one by one go in groups where the device runs those side by side."""
        queue, items = self.device.queue, self.device.group_items
        if self.watched and self.free and set(local_size) == {1}:
            size = -(-global_size[0] // items) * items, *global_size[1:]
            cl.enqueue_nd_range_kernel(queue, self.kernel, size, (items, *local_size[1:]))
            return
        if not (self.free and items > 1 and local_size == (1,) and global_size[0] >= items):
            cl.enqueue_nd_range_kernel(queue, self.kernel, global_size, local_size)
            return
        whole = global_size[0] // items * items
        cl.enqueue_nd_range_kernel(queue, self.kernel, (whole,), (items,))
        if whole < global_size[0]:  # no more items than asked for: not every kernel looks at its number
            cl.enqueue_nd_range_kernel(queue, self.kernel, (global_size[0] - whole,), (1,), (whole,))


class Profile:
    """Seconds of every labelled launch and stage."""

    def __init__(self):
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def add(self, label: str, seconds: float) -> None:
        """Record one run of `label`."""
        self.seconds[label].append(seconds)

    def rows(self) -> list[tuple[str, int, float, float, float]]:
        """Return (label, calls, min ms, median ms, share of the total), the largest share first."""
        total = sum(map(sum, self.seconds.values())) or 1.0
        rows = [(label, len(s), 1e3 * min(s), 1e3 * float(np.median(s)), sum(s) / total)
                for label, s in self.seconds.items()]
        return sorted(rows, key=lambda row: -row[4])

    def __repr__(self):
        return f"Profile({len(self.seconds)} kernels, {1e3 * sum(map(sum, self.seconds.values())):.3f} ms)"

    def __str__(self):
        lines = [f"{'kernel or stage':28} {'calls':>6} {'min ms':>9} {'median ms':>10} {'share':>7}"]
        lines += [f"{label:28} {calls:6d} {low:9.3f} {median:10.3f} {share:6.1%}"
                  for label, calls, low, median, share in self.rows()]
        return "\n".join(lines)


def build_program(device, path: str, constants: dict | None):
    """Compile the kernel file `path` for `device`; return (program, text)."""
    text = kernel_text(path, device.own_constants | (constants or {}))
    text = text if device.ended is None else watched(text)
    dump = os.environ.get("CLSURF_DUMP")
    if dump:
        key = hashlib.sha256(text.encode()).hexdigest()[:8]
        Path(dump).mkdir(parents=True, exist_ok=True)
        (Path(dump) / f"{Path(path).stem}-{key}.cl").write_text(text)
    program = cl.Program(device.context, text)
    try:
        with warnings.catch_warnings():
            # Drivers chat on success; the text matters only where the build fails.
            warnings.filterwarnings("ignore", category=cl.CompilerWarning)
            try:
                program.build(options=BUILD_OPTIONS)
            except (OSError, KeyError):  # pyopencl's own cache cannot be written, as on a full disk: then without it
                program = cl.Program(device.context, text)
                program.build(options=BUILD_OPTIONS, cache_dir=False)
    except cl.RuntimeError as error:
        raise KernelBuildError(f"kernel {path}: {device.name} does not compile it:\n{error}") from None
    return program, text


def make_kernel(device, program, text, name) -> Kernel:
    """Return a kernel object of `program` for the calling thread."""
    free = not GROUPED.search(re.sub(r"//[^\n]*", "", text))
    return Kernel(device, cl.Kernel(program, name), name, argument_dtypes(text, name), free, ENDED in text)
