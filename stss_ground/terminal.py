# SPDX-License-Identifier: MIT
r"""Text on its way to the user. All of it goes through here: names come from files that strangers made.

A control character would move the cursor, hide a message or set the window's title; a line break would make one message
two; half of a name that is not UTF-8 cannot be encoded at all. Each is shown as Python writes it: ``\x1b``.
"""

from __future__ import annotations

import logging
import os
import shutil
import sys
from io import TextIOWrapper
from typing import Any

from rich.console import Console
from rich.text import Text

WIDE = 200
"""Columns without a terminal: in a file, a number that is cut to fit 80 columns would be lost."""
MAX_LENGTH = 2000
"""Most characters of a message; text from a file may be longer and is cut."""


def printable(text: str) -> str:
    """One line that any terminal can show, of `MAX_LENGTH` characters at most; printable text as it is."""
    if len(text) > MAX_LENGTH:
        text = f"{text[: MAX_LENGTH // 2]} ... {text[-MAX_LENGTH // 2 :]}"
    return text if text.isprintable() else "".join(map(_escape, text))


def echo(line: str, *, err: bool = False) -> None:
    """Print a line made `printable`."""
    stream = sys.stderr if err else sys.stdout  # click.echo would take ASCII for a mistake, and write UTF-8
    stream.write(printable(line) + "\n")
    stream.flush()


def log(line: str) -> None:
    """Give a line made `printable` to the logger ``stss`` as a warning: without a handler of the program's it goes to standard error."""
    logging.getLogger("stss").warning("%s", printable(line))


class Terminal(Console):
    """Rich's console, where every text, in tables too, is made printable; line breaks stay."""

    def __init__(self, **how: Any):
        super().__init__(**how)
        is_screen = self.file.isatty()  # FORCE_COLOR makes a terminal of a log, too
        self.is_interactive &= is_screen
        if not is_screen and "COLUMNS" not in os.environ:
            self.width = WIDE
        elif self.width < 1:  # COLUMNS=0, as shells without a terminal set it; rich would print nothing
            self.width = shutil.get_terminal_size((WIDE, 1)).columns

    def on_broken_pipe(self) -> None:
        """Leave it to the command, as any other error of writing; rich would end with status 1, which is that of a finding."""
        raise BrokenPipeError

    def render_str(self, text: str, **how: Any) -> Text:
        """See ``rich.console.Console``; all arguments but markup are text."""
        return super().render_str("".join(c if c == "\n" else _escape(c) for c in text), **how)


def accept_any_text() -> None:
    """Let standard output and standard error escape characters that their encoding lacks, rather than raise."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _escape(character: str) -> str:
    return character if character.isprintable() else repr(character)[1:-1]
