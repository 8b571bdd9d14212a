# SPDX-License-Identifier: MIT
"""The error of devices; apart from pyopencl, so that catching it needs no import of it."""


class DeviceError(RuntimeError):
    """There is no such device, or a device cannot do its task; the message is one line.

    Attributes:
        log: the compiler's log where a kernel did not build, else empty.
    """

    def __init__(self, message: str, log: str = ""):
        super().__init__(message)
        self.log = log
        if log and hasattr(self, "add_note"):  # Python 3.11: shown in a traceback, not part of the message
            self.add_note(log)  # pyright: ignore[reportAttributeAccessIssue]
