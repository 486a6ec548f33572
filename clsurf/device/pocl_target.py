"""Give PoCL 3.0 a processor name that its compiler knows.

pip's PoCL 3.0 carries LLVM 14, which names processors newer than itself (AMD Zen 5 on) "generic"; its clang then
refuses every kernel with "unknown target CPU 'generic'". PoCL has no setting for the name. The device's record holds
it as a C string, so the record is searched for the pointer to it, which is replaced by the name of an older processor
with the same instruction sets. Measured on a Zen 5: 454 GFLOP/s as skylake-avx512, 78 as znver3; without it, nothing
compiles.
"""

import ctypes
import logging
import os
import platform
import struct

log = logging.getLogger("clsurf")

# Searched for the name, which stands at byte 640 of PoCL 3.0's record. Its neighbours on the heap point to the same
# string, the nearest seen 3.6 KB further and sometimes nearer: the first pointer is the record's own.
RECORD_BYTES = 2048
# By device record: named once, since a second search would find a neighbour's pointer. The strings live for ever.
_named: dict[int, ctypes.Array] = {}


def target_name(flags: set[str]) -> str:
    """Return the newest processor of LLVM 14 whose instruction sets `flags` (of /proc/cpuinfo) cover."""
    if {"avx512f", "avx512bw", "avx512dq", "avx512vl", "avx512cd"} <= flags:
        return "skylake-avx512"
    if {"avx2", "fma", "bmi1", "bmi2", "f16c"} <= flags:
        return "haswell"
    return "x86-64"


def cpu_flags() -> set[str]:
    """Return the instruction-set flags of the processor, empty where they cannot be read."""
    try:
        with open("/proc/cpuinfo") as file:
            for line in file:
                if line.startswith("flags"):
                    return set(line.partition(":")[2].split())
    except OSError:
        pass
    return set()


def name_processor(device) -> str | None:
    """Replace "generic" in the record of a PoCL 3.0 CPU device; return the new name, None where nothing was wrong."""
    if platform.machine() != "x86_64" or not os.path.exists("/proc/self/mem"):
        return None
    if "PoCL 3.0" not in device.platform.version or not device.version.rstrip().endswith("-generic"):
        return None
    if device.int_ptr in _named:
        return _named[device.int_ptr].value.decode()
    name = target_name(cpu_flags())
    fd = os.open("/proc/self/mem", os.O_RDONLY)  # pread reports an unreadable address instead of crashing
    try:
        offset = first_pointer_to_generic(fd, device.int_ptr)
    finally:
        os.close(fd)
    if offset is None:
        log.warning("PoCL: the processor's name was not found in the device's record; kernels may not compile")
        return None
    buffer = ctypes.create_string_buffer(name.encode())
    _named[device.int_ptr] = buffer
    ctypes.c_uint64.from_address(device.int_ptr + offset).value = ctypes.addressof(buffer)
    log.debug("PoCL: compiling for %s", name)
    return name


def first_pointer_to_generic(fd: int, address: int) -> int | None:
    """Return how far behind `address` the first pointer to the text "generic" stands; None where there is none."""
    return next((offset for offset in range(0, RECORD_BYTES, 8) if _points_to_generic(fd, address + offset)), None)


def _points_to_generic(fd: int, address: int) -> bool:
    try:
        pointer, = struct.unpack("Q", os.pread(fd, 8, address))
        return pointer > 4096 and os.pread(fd, 8, pointer) == b"generic\0"
    except (OSError, OverflowError, struct.error):
        return False
