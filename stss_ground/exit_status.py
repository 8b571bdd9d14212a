# SPDX-License-Identifier: MIT
"""Run a command line and return its status: a mistake of the user is one line, a mistake of ours a traceback."""

from __future__ import annotations

import errno
import os
import sys
from typing import Any, TextIO

import click

from stss_ground.errors import PipeClosedError, UserError
from stss_ground.terminal import accept_any_text, echo

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""Errors of a write to standard output where no more data fits."""
_NO_ARGUMENTS: Any = getattr(click.exceptions, "NoArgsIsHelpError", ())
"""Its message is the help; up to version 8.1 click prints that itself."""
_NO_MEMORY = "out of memory: the system gives this process no more"
_SHORT_OF_MEMORY = ("failed to map segment", "annot allocate memory", "can't start new thread")
"""Messages of libraries that lack memory and raise no MemoryError."""


def run_guarded(command: click.Command, *mistakes: type[Exception]) -> None:
    """Run the command and end with its status.

    A mistake of the user is one line on standard error and status 2: `UserError`, and the errors that ``mistakes`` adds.
    """
    status: Any = 0
    _hold_standard_streams()
    accept_any_text()
    try:
        _require_utf8(sys.argv[1:])
        status = command.main(standalone_mode=False)
    except click.ClickException as error:
        _fail_of_click(error)
    except (UserError, *mistakes) as error:
        _fail(str(error))
    except (KeyboardInterrupt, click.exceptions.Abort):
        status = 130
    except (BrokenPipeError, PipeClosedError):
        _discard(sys.stdout)
        status = 141
    except MemoryError:
        _fail(_NO_MEMORY)
    except (ImportError, RuntimeError) as error:
        if not any(words in str(error) for words in _SHORT_OF_MEMORY):
            raise
        _fail(_NO_MEMORY)
    except OSError as error:
        if error.filename is not None:
            _fail(f"{error.filename}: {error.strerror}")
        if error.errno == errno.ENOMEM:
            _fail(_NO_MEMORY)
        if error.errno == errno.ENOENT:  # the one name that no call is given
            _fail("the current folder was removed; change to another one")
        _discard(sys.stdout)
        _fail(f"standard output cannot be written: {error.strerror}" if error.errno in _FULL else f"{error.strerror or error}")
    sys.exit(status if isinstance(status, int) else 0)


def _hold_standard_streams() -> None:
    """Open the null device in place of a closed standard stream; otherwise the next opened file would get the output."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))


def _require_utf8(words: list[str]) -> None:
    """Raise UserError for a word that is not UTF-8: neither OpenImageIO nor JSON can take it as a name."""
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError:
            locale = sys.getfilesystemencoding()
            cure = "" if locale == "utf-8" else f"; names here are {locale}: set PYTHONUTF8=1"
            raise UserError(f"{word}: expected a name in UTF-8{cure}") from None


def _fail_of_click(error: click.ClickException) -> None:
    message = error.format_message()
    if isinstance(error, _NO_ARGUMENTS):
        for line in message.splitlines():
            echo(line, err=True)
        sys.exit(2)
    _fail(" ".join(message.split()))


def _fail(message: str) -> None:
    try:
        echo(f"stss: {message}", err=True)
    except OSError:  # a log on a full disk; the status says it all the same
        _discard(sys.stderr)
    sys.exit(2)


def _discard(stream: TextIO) -> None:
    """Send further output nowhere: the rest of the buffer would fail again when the process ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
