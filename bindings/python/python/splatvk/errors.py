"""Errors by how a program may react to them. Every message is one line."""


class Error(Exception):
    """Any error of splatvk."""


class InputError(Error, ValueError):
    """An argument, a file or a setting cannot be used; the message names it."""


class FileError(Error, OSError):
    """A file cannot be read."""


class UnwritableError(Error, OSError):
    """A file cannot be written: the disk is full, or the folder does not allow it."""


class MissingError(Error):
    """The inference library, a program or another part is missing."""


class MissingModelError(Error):
    """A model, or one of its files, is missing or corrupt."""


class NoDeviceError(Error):
    """There is no Vulkan loader, driver or device that can be used."""


class DeviceLostError(Error):
    """The driver was reset. The same call with resume=True continues."""


class OutOfDeviceMemoryError(Error, MemoryError):
    """The device has no memory left."""


class GpuError(Error):
    """The driver refused an operation."""


class WorkError(Error):
    """Something failed on valid input."""


class ForkError(Error):
    """A forked child used the Vulkan device of its parent."""


class Cancelled(Error):
    """The work was stopped."""
