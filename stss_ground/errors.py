# SPDX-License-Identifier: MIT
"""The user's mistakes, which the command line prints in one line, with status 2."""


class UserError(Exception):
    """The user's mistake, in one line."""


class InputError(UserError):
    """A file, channel, option or sequence is wrong.

    The message names it, and says what was expected and what was found.
    """


class DeviceError(UserError):
    """There is no such device, or a device cannot do its task.

    Attributes:
        log: the compiler's log where a kernel did not build, else empty.
    """

    def __init__(self, message: str, log: str = ""):
        super().__init__(message)
        self.log = log
        if log and hasattr(self, "add_note"):  # Python 3.11: shown in a traceback, not part of the message
            self.add_note(log)


class PipeClosedError(Exception):
    """A `BrokenPipeError` that click lets pass: it ends one with status 1, which is that of a finding."""
