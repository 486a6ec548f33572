"""Device arrays: a buffer with shape and dtype; on CPU devices the host reads and writes the same pages.

CPU devices take page-aligned host memory as it is (CL_MEM_USE_HOST_PTR), so uploads and downloads cost nothing. Large
blocks come from mmap with huge pages and are kept for reuse: fresh pages cost more than many kernels (32 MB of new
4 KB pages: about 8 ms here).
"""

import ctypes
import math
import mmap
import threading
import weakref

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

PAGE = 4096
HUGE = 2 << 20
KEPT_BYTES = 512 << 20  # blocks kept for reuse; beyond it they go back to the system


class HostPool:
    """Page-aligned host memory whose blocks return when the last array on them dies."""

    def __init__(self):
        # A finalizer may run inside take() (garbage collection), so the lock must be re-entrant.
        self._lock = threading.RLock()
        self._free: dict[int, list[mmap.mmap]] = {}
        self.kept_bytes, self.kept_limit = 0, KEPT_BYTES

    def take(self, nbytes: int) -> NDArray:
        """Return a (nbytes,) uint8 array, page-aligned, content undefined."""
        size = _size_class(nbytes)
        with self._lock:
            blocks = self._free.get(size)
            block = blocks.pop() if blocks else None
            if block is not None:
                self.kept_bytes -= size
        if block is None:
            block = mmap.mmap(-1, size)
            if size >= HUGE and hasattr(mmap, "MADV_HUGEPAGE"):
                block.madvise(mmap.MADV_HUGEPAGE)
        array = np.frombuffer(block, np.uint8)
        weakref.finalize(array, self._give, block, size).atexit = False
        return array[:nbytes]

    def _give(self, block, size):
        with self._lock:
            if self.kept_bytes + size <= self.kept_limit:
                self._free.setdefault(size, []).append(block)
                self.kept_bytes += size

    def trim(self) -> None:
        """Give all kept blocks back to the system."""
        with self._lock:
            self._free.clear()
            self.kept_bytes = 0


def give_back() -> None:
    """Return the heap's unused pages to the system, where the C library can: they count as this process's memory."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError, TypeError):
        return


def _size_class(nbytes: int) -> int:
    """Round up to an eighth of a power of two, so that slightly different sizes share blocks (waste under 12.5 %)."""
    nbytes = max(nbytes, PAGE)
    step = max(PAGE, 1 << max(0, (nbytes - 1).bit_length() - 4))
    return -(-nbytes // step) * step


class DeviceArray:
    """An array in a device's memory.

    Attributes
    ----------
    buffer : pyopencl.Buffer
    shape, dtype
    host : ndarray or None
        On CPU devices the same memory as the host sees it; valid between `Device.finish` and the next launch.
    """

    __slots__ = ("__weakref__", "buffer", "dtype", "host", "shape")

    def __init__(self, buffer, shape, dtype, host=None):
        self.buffer, self.shape, self.dtype, self.host = buffer, shape, np.dtype(dtype), host

    @property
    def nbytes(self) -> int:
        """Bytes of the content."""
        return math.prod(self.shape) * self.dtype.itemsize

    def __len__(self):
        return self.shape[0]

    def __repr__(self):
        return f"DeviceArray{self.shape} {self.dtype}"


def is_aligned(array: NDArray) -> bool:
    """Return whether `array` can be a CPU device's buffer as it is."""
    return array.flags.c_contiguous and array.ctypes.data % 64 == 0 and array.nbytes > 0


def new_array(context, pool: HostPool | None, shape, dtype, zero=False) -> DeviceArray:
    """Allocate a device array; `pool` is given on devices that share the host's memory."""
    dtype = np.dtype(dtype)
    nbytes = max(math.prod(shape) * dtype.itemsize, 1)
    if pool is None:
        return DeviceArray(cl.Buffer(context, cl.mem_flags.READ_WRITE, nbytes), shape, dtype)
    block = pool.take(nbytes)
    if zero:
        block.fill(0)
    buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR, hostbuf=block)
    count = math.prod(shape)
    host = block[:count * dtype.itemsize].view(dtype).reshape(shape)
    return DeviceArray(buffer, shape, dtype, host)
