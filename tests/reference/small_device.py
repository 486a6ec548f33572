"""A device that holds little: every allocation is held against its largest buffer and its memory."""

import contextlib
import weakref

import numpy as np

from clsurf.device.context import Device
from clsurf.errors import DeviceMemoryError


@contextlib.contextmanager
def small(device, largest: int, memory: float = np.inf):
    """Let every device have buffers of at most `largest` bytes, all of them together at most `memory` bytes.

    Gives a dict whose "most" is the largest number of bytes in use at a time.
    """
    empty, upload, before = Device.empty, Device.upload, device.largest_buffer_bytes
    used = {"now": 0, "most": 0}

    def take(array):
        nbytes = array.nbytes
        used["now"] += nbytes
        used["most"] = max(used["most"], used["now"])
        weakref.finalize(array, lambda: used.update(now=used["now"] - nbytes))
        return array

    def check(nbytes):
        if nbytes > largest or used["now"] + nbytes > memory:
            raise DeviceMemoryError(f"{nbytes} bytes, {used['now']} in use")

    def small_empty(self, shape, dtype):
        check(int(np.prod(shape)) * np.dtype(dtype).itemsize)
        return take(empty(self, shape, dtype))

    def small_upload(self, array, dtype=None):
        array = np.ascontiguousarray(array, dtype)
        check(array.nbytes)
        return take(upload(self, array))

    Device.empty, Device.upload, device.largest_buffer_bytes = small_empty, small_upload, largest
    try:
        yield used
    finally:
        Device.empty, Device.upload, device.largest_buffer_bytes = empty, upload, before
