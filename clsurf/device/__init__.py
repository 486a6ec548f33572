"""OpenCL devices: the only package that imports pyopencl."""

from .arrays import DeviceArray as DeviceArray
from .context import Device as Device
from .context import all_devices as all_devices
from .context import choose_device as choose_device
from .context import host_memory_bytes as host_memory_bytes
from .context import open_device as open_device
from .program import Profile as Profile
