# SPDX-License-Identifier: MIT
"""The user's mistakes."""


class InputError(Exception):
    """A file, channel, option or sequence is not what it must be.

    The message is one line: what it is about, what was expected, what was found. The command line prints it and ends with
    status 2.
    """
