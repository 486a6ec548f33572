"""Choosing and opening devices."""

import errno
import functools
import logging
import os
import threading

import numpy as np

from . import icd

icd.prepare()  # before pyopencl asks the loader for platforms; makes no context
import pyopencl as cl  # noqa: E402

from ..errors import DeviceError, DeviceMemoryError  # noqa: E402
from . import pocl_fork, pocl_target  # noqa: E402
from .arrays import KEPT_BYTES, DeviceArray, HostPool, give_back, is_aligned, new_array  # noqa: E402
from .program import Kernel, Profile, build_program, make_kernel  # noqa: E402
from .sources import number_of  # noqa: E402

log = logging.getLogger("clsurf")

KINDS = {cl.device_type.GPU: "gpu", cl.device_type.CPU: "cpu", cl.device_type.ACCELERATOR: "accelerator"}
_TOO_LARGE = (cl.status_code.INVALID_BUFFER_SIZE, cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE,
              cl.status_code.OUT_OF_RESOURCES, cl.status_code.OUT_OF_HOST_MEMORY)
# Fastest first: a dragon frame took 9.4 ms on Intel's runtime and 10.3 on PoCL 3.0, its build 0.21 and 0.25 s.
CPU_ORDER = ("intel", "pocl", "portable", "llvmpipe", "oclgrind")
TRANSLATED = ("rusticl", "Oclgrind")  # platforms that take clang's output on, in which some builtins have no name
# Processors whose driver wants single items. llvmpipe makes a loop of every scalar that is read or written, 16 loops of
# a vector of 16 lanes, and compiling takes the square of their number: knn_covariance 1 s in place of over 100,
# fit_surfels 3 s in place of 334. It runs 8 items as lanes by itself.
SINGLE = ("llvmpipe",)
WORDS = {"pocl": ("portable", "pocl"), "intel": ("intel",), "nvidia": ("nvidia",), "amd": ("amd", "advanced micro")}


def _told(method):
    """Make a driver's errors in a method of `Device` clsurf's own."""
    @functools.wraps(method)
    def call(self, *arguments, **options):
        try:
            return method(self, *arguments, **options)
        except cl.Error as error:
            raise self.failure(error) from None
    return call


class Device:
    """An OpenCL device with its context, queue, programs and memory.

    Attributes
    ----------
    name, platform_name, driver, version : str
    kind : str
        "gpu", "cpu" or "accelerator".
    units : int
        Compute units.
    memory_bytes, largest_buffer_bytes, local_bytes : int
    lanes : int
        Default kernel form: vector lanes of one work-item (16, 8 or 4), or 1 for a work-group per tile.
    loop_turns : int or None
        After so many turns of a work-item's loops, all loops together, the driver ends them (llvmpipe); None: never.
    group_items : int
        Items that run side by side: those of a launch without groups of its own are put together by so many.
    profile : Profile or None
        Set to a `Profile` to have every launch timed (each then waits for the one before).
    """

    def __init__(self, cl_device, context=None, queue=None):
        self.cl_device, self.process = cl_device, os.getpid()
        self.name = cl_device.name.strip()
        self.platform_name = cl_device.platform.name.strip()
        self.driver, self.version = cl_device.driver_version.strip(), cl_device.version.strip()
        self.kind = next((name for bit, name in KINDS.items() if cl_device.type & bit), "accelerator")
        self.units = cl_device.max_compute_units
        self.memory_bytes, self.largest_buffer_bytes = cl_device.global_mem_size, cl_device.max_mem_alloc_size
        self.local_bytes = cl_device.local_mem_size
        self.lanes = 16 if self.kind == "cpu" and not any(word in self.name.lower() for word in SINGLE) else 1
        # LP_MAX_TGSI_LOOP_ITERATIONS in Mesa: no error, the kernel goes on behind each loop.
        self.loop_turns = 65535 if "llvmpipe" in self.name.lower() else None
        # llvmpipe runs 8 as lanes (58 balls of fit_surfels: 0.15 s, 1.4 one by one); where lanes are 16, one is enough.
        self.group_items = 1 if self.lanes > 1 else 8 if self.kind == "cpu" else 64
        self.profile: Profile | None = None
        self.own_constants = {"TRANSLATED": 1} if self.platform_name in TRANSLATED else {}
        if "Portable" in self.platform_name:
            pocl_target.name_processor(cl_device)
        try:
            self.context = context or cl.Context([cl_device])
            self.queue = queue or cl.CommandQueue(self.context, cl_device)
        except cl.Error as error:
            hint = ""
            if "Portable" in self.platform_name:
                hint = ": is its cache folder writable? POCL_CACHE_DIR names another"
            raise DeviceError(f"device {self.name}: no context ({error}){hint}") from None
        self.pool = HostPool() if self.kind == "cpu" else None
        self._lock = threading.Lock()
        self._programs: dict = {}
        self._kernels = threading.local()
        self.in_flight: list = []  # arguments of launches that may still run: their host memory must outlive them
        self.ended = None if self.loop_turns is None else self.upload(np.zeros(2, np.int32))  # sources.py, watched

    def __repr__(self):
        return f"Device({self.name!r}, {self.platform_name!r}, {self.kind}, {self.units} units)"

    # Kernels ------------------------------------------------------------------------------------------------------

    def kernel(self, path: str, name: str | None = None, constants: dict | None = None) -> Kernel:
        """Return the kernel `name` (by default the file's stem) of `path`, built once per set of constants.

        Parameters
        ----------
        path : str
            Relative to the kernels' folder, such as "render/project_slim.cl".
        constants : dict, optional
            ``#define`` lines put before the text.
        """
        name = name or path.rsplit("/", 1)[-1].removesuffix(".cl")
        key = (path, tuple(sorted((constants or {}).items())))
        mine = self._kernels.__dict__
        kernel = mine.get((key, name))
        if kernel is None:
            with self._lock:
                if key not in self._programs:
                    self._programs[key] = build_program(self, path, constants)
                kernel = mine[key, name] = make_kernel(self, *self._programs[key], name)
        return kernel

    def failure(self, error: cl.Error) -> DeviceError:
        """Return what a driver's error means; a device that is lost is opened anew by the next `open_device`."""
        self.in_flight = []
        if error.code in _TOO_LARGE:
            return DeviceMemoryError(f"device {self.name}: it ran out of memory or other resources ({error}): use a "
                                     "smaller scan or picture, or another device (clsurf devices)")
        with _opened_lock:
            for key in [key for key, kept in _opened.items() if kept is self]:
                del _opened[key]
        return DeviceError(f"device {self.name}: its driver failed ({error}): try again, or another device (clsurf "
                           "devices)")

    # Memory -------------------------------------------------------------------------------------------------------

    def check_memory(self, **nbytes: int) -> None:
        """Raise DeviceMemoryError where the named buffers would not fit; call it before allocating them."""
        total, largest = sum(nbytes.values()), max(nbytes, key=nbytes.get, default=None)
        # A CPU device's memory is the host's; PoCL reports a share of it only.
        limit = self.memory_bytes if self.kind != "cpu" else max(self.memory_bytes, host_memory_bytes())
        if total > limit:
            raise DeviceMemoryError(f"device {self.name}: needs {total / 1e9:.2f} GB ({largest} alone "
                                    f"{nbytes[largest] / 1e9:.2f} GB), has {limit / 1e9:.2f} GB: use a smaller scan or "
                                    "picture, or another device (clsurf devices)")
        if largest and nbytes[largest] > self.largest_buffer_bytes:
            raise DeviceMemoryError(f"device {self.name}: {largest} needs {nbytes[largest] / 1e9:.2f} GB, one buffer "
                                    f"may have {self.largest_buffer_bytes / 1e9:.2f} GB: use a smaller scan or picture")

    def rows_at_once(self, *row_bytes: int) -> int:
        """Return how many rows of results are worth asking for at once, a multiple of 16 and at least 16.

        `row_bytes` are those of a row in each buffer: every one fits into a buffer, all together take a quarter of the
        memory, so that what they are worked out from has room beside them.
        """
        rows = min(self.largest_buffer_bytes // max(row_bytes), self.memory_bytes // 4 // sum(row_bytes))
        return max(rows // 16 * 16, 16)

    def empty(self, shape, dtype) -> DeviceArray:
        """Return an uninitialised device array."""
        shape = (shape,) if np.isscalar(shape) else tuple(shape)
        try:
            return new_array(self.context, self.pool, shape, dtype)
        except (cl.Error, OSError) as error:  # OSError: the host's own pages
            if getattr(error, "code", None) not in _TOO_LARGE and getattr(error, "errno", None) != errno.ENOMEM:
                raise
            raise DeviceMemoryError(f"device {self.name}: no room for {shape} {np.dtype(dtype)}: use a smaller scan or "
                                    "picture, or another device (clsurf devices)") from None

    def zeros(self, shape, dtype) -> DeviceArray:
        """Return a device array of zero bytes."""
        array = self.empty(shape, dtype)
        self.fill(array, 0)
        return array

    @_told
    def fill(self, array: DeviceArray, value) -> None:
        """Fill `array` with one value of its dtype."""
        if array.nbytes:
            cl.enqueue_fill_buffer(self.queue, array.buffer, array.dtype.type(value), 0, array.nbytes)
            self.in_flight.append(array)  # without it, filling an array that died meanwhile wrote to unmapped memory

    @_told
    def upload(self, array, dtype=None) -> DeviceArray:
        """Return `array` on the device; CPU devices use aligned, contiguous input in place, so do not change it."""
        array = np.ascontiguousarray(array, dtype)
        if self.pool is not None and is_aligned(array):
            flags = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR
            return DeviceArray(cl.Buffer(self.context, flags, hostbuf=array), array.shape, array.dtype, array)
        if self.pool is not None and array.nbytes:
            # Filled before the device knows of it: a copy in the queue would wait for every launch before it.
            block = self.pool.take(array.nbytes).view(array.dtype).reshape(array.shape)
            block[...] = array
            flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
            return DeviceArray(cl.Buffer(self.context, flags, hostbuf=block), array.shape, array.dtype, block)
        out = self.empty(array.shape, array.dtype)
        self.write(out, array)
        return out

    @_told
    def write(self, target: DeviceArray, array) -> None:
        """Copy host data into a device array of the same size."""
        array = np.ascontiguousarray(array, target.dtype)
        if array.nbytes != target.nbytes:
            raise ValueError(f"expected {target.nbytes} bytes, got {array.nbytes}")
        if array.nbytes:
            cl.enqueue_copy(self.queue, target.buffer, array, is_blocking=True)

    @_told
    def download(self, array: DeviceArray, copy: bool = True) -> np.ndarray:
        """Wait for the device and return the content.

        With `copy=False` a CPU device returns its own memory: valid until the array is written again, and kept alive by
        the returned ndarray.
        """
        if array.nbytes == 0:
            return np.empty(array.shape, array.dtype)
        if array.host is None:
            out = np.empty(array.shape, array.dtype)
            cl.enqueue_copy(self.queue, out, array.buffer, is_blocking=True)
            self._check_loops()
            return out
        # Mapping is what makes the host's view of the pages valid.
        done, self.in_flight = self.in_flight, []
        mapped, _ = cl.enqueue_map_buffer(self.queue, array.buffer, cl.map_flags.READ, 0, array.shape, array.dtype,
                                          is_blocking=True)
        mapped.base.release(self.queue)
        del done  # the queue is in order: every launch before the mapping has ended
        self._check_loops()
        return array.host.copy() if copy else array.host

    @_told
    def download_all(self, arrays: dict[str, DeviceArray]) -> dict[str, np.ndarray]:
        """Wait for the device once and return the contents by name; see `download` with `copy=False`.

        PoCL takes 50 us for every array that is waited for by itself.
        """
        if self.pool is None:
            return {name: self.download(array, copy=False) for name, array in arrays.items()}
        mapped = [cl.enqueue_map_buffer(self.queue, array.buffer, cl.map_flags.READ, 0, array.shape, array.dtype,
                                        is_blocking=False)[0]
                  for array in arrays.values() if array.nbytes and array.host is not None]
        self.finish()
        for array in mapped:
            array.base.release(self.queue)
        self._check_loops()
        return {name: self.download(array, copy=False) if array.host is None else array.host
                for name, array in arrays.items()}

    def _check_loops(self) -> None:
        """Raise DeviceMemoryError where the driver has ended a loop of a kernel before its time."""
        if self.ended is None:
            return
        told = np.empty(2, np.int32)
        cl.enqueue_copy(self.queue, told, self.ended.buffer, is_blocking=True)
        if told[1]:
            cl.enqueue_copy(self.queue, self.ended.buffer, np.zeros(2, np.int32), is_blocking=True)
            names = {name for _, name in self._kernels.__dict__ if number_of(name) == told[1]}
            # As where memory does not suffice: what can be done in parts then is.
            raise DeviceMemoryError(f"device {self.name}: its driver ends loops after {self.loop_turns:,} turns, too "
                                    f"few for {' '.join(names) or 'a kernel'}: use another device (clsurf devices)")

    def keep(self, nbytes: int | None) -> int | None:
        """Keep at most `nbytes` of unused memory for reuse, or the default; return the limit before."""
        if self.pool is None:
            return None
        before, self.pool.kept_limit = self.pool.kept_limit, KEPT_BYTES if nbytes is None else min(nbytes, KEPT_BYTES)
        return before

    def trim(self) -> None:
        """Give the memory kept for reuse back to the system."""
        if self.pool is not None:
            self.pool.trim()
        give_back()

    @_told
    def finish(self) -> None:
        """Wait until every launch has ended."""
        done, self.in_flight = self.in_flight, []
        self.queue.finish()
        del done


def host_memory_bytes() -> int:
    """Return the bytes of the machine's memory, 0 where they are not known."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return 0


# Choosing ---------------------------------------------------------------------------------------------------------


def all_devices() -> list:
    """Return every pyopencl device, GPUs first, then CPU runtimes, the fastest first."""
    try:
        platforms = cl.get_platforms()
    except cl.Error:
        return []
    devices = []
    for platform in platforms:
        try:
            devices += pocl_fork.usable(platform).get_devices()
        except cl.Error as error:
            log.debug("%s: %s", platform.name, error)
    return sorted(devices, key=_rank)


def _rank(device) -> tuple:
    if device.type & cl.device_type.GPU and "llvmpipe" not in device.name.lower():
        return 0, -device.max_compute_units
    text = f"{device.platform.name} {device.name}".lower()
    return 1, next((i for i, word in enumerate(CPU_ORDER) if word in text), len(CPU_ORDER))


def _matches(device, word: str) -> bool:
    kind = next((name for bit, name in KINDS.items() if device.type & bit), "accelerator")
    if word in ("gpu", "cpu", "accelerator"):
        return kind == word
    platform = device.platform.name.lower()
    # An Intel runtime runs on AMD processors too: vendor words are looked up in the platform, not in the chip's name.
    if word in WORDS:
        return any(w in platform for w in WORDS[word])
    return word in device.name.lower() or word in platform


def choose_device(selector: str):
    """Return the pyopencl device that `selector` names: "gpu", "cpu", "pocl", "intel", "gpu:1", part of a name.

    Raises
    ------
    DeviceError
        No device, or none that fits.
    """
    devices = all_devices()
    if not devices:
        raise DeviceError("no OpenCL device: install a CPU driver with `pip install clsurf[intel]` or "
                          "`pip install pocl-binary-distribution`; `clsurf doctor` tells more")
    if not selector:
        return devices[0]
    word, _, number = selector.lower().partition(":")
    found = [d for d in devices if _matches(d, word)]
    index = int(number) if number.isdigit() else 0
    if index >= len(found) or (number and not number.isdigit()):
        seen = ", ".join(f"{d.name.strip()} ({d.platform.name.strip()})" for d in devices)
        raise DeviceError(f"device {selector!r}: expected gpu, cpu, pocl, intel, nvidia, amd, gpu:1 or part of a name; "
                          f"found: {seen}")
    return found[index]


def _here(cl_device):
    """Return a device as this process may use it: see `pocl_fork`."""
    platform = pocl_fork.usable(cl_device.platform)
    if platform == cl_device.platform:
        return cl_device
    return next((d for d in platform.get_devices() if d.name == cl_device.name), cl_device)


_opened: dict = {}
_opened_lock = threading.Lock()


def open_device(device=None) -> Device:
    """Return an opened device; the same one for the same choice within a process.

    Parameters
    ----------
    device : None, str, Device, pyopencl.Device, pyopencl.Context or pyopencl.CommandQueue
        None: `CLSURF_DEVICE`, else a GPU, else the fastest CPU runtime. Strings: see `choose_device`.

    Raises
    ------
    DeviceError
        No such device, or its driver fails.
    """
    if isinstance(device, Device):
        if device.process == os.getpid():
            return device
        device = _here(device.cl_device)  # opened before this process was forked
    if device is None:
        device = os.environ.get("CLSURF_DEVICE", "")
    context = queue = None
    if isinstance(device, cl.CommandQueue):
        queue, context, device = device, device.context, device.device
    elif isinstance(device, cl.Context):
        context, device = device, device.devices[0]
    elif isinstance(device, str):
        device = choose_device(device)
    elif isinstance(device, cl.Device):
        device = _here(device)
    else:
        raise DeviceError(f"device: expected a name, a clsurf.Device, or a pyopencl Device, Context or CommandQueue, "
                          f"got {type(device).__name__}")
    # A forked child must not use its parent's context: the process number is part of the key.
    key = (os.getpid(), device.int_ptr, context.int_ptr if context else 0, queue.int_ptr if queue else 0)
    with _opened_lock:
        if key not in _opened:
            _opened[key] = Device(device, context, queue)
        return _opened[key]
