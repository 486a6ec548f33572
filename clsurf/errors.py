"""The errors that clsurf raises for a user's mistake or a machine's limit: what, expected, got, what to do."""


class Error(Exception):
    """Base of every error that clsurf raises on purpose; the command line prints it in one line."""


class InputError(Error, ValueError):
    """A scan, camera or option that cannot be used."""


class FileFormatError(InputError):
    """A file that is damaged, truncated or of another kind."""


class DeviceError(Error, RuntimeError):
    """No such device, or a device or driver that fails."""


class KernelBuildError(DeviceError):
    """A kernel that a driver does not compile; the message holds the compiler's log."""


class DeviceMemoryError(DeviceError, MemoryError):
    """More memory asked for than the device has."""


class Cancelled(Error):
    """Work stopped by the caller's progress callback."""
