# SPDX-License-Identifier: MIT
"""Command lines as text: by POSIX's rules; on Windows a backslash is a letter of a path, and only double quotes hold words together."""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Iterable


def split_words(text: str) -> list[str]:
    """The words of a command line.

    Raises:
        ValueError: a quote is not closed.
    """
    if os.name != "nt":
        return shlex.split(text)
    words = shlex.shlex(text, posix=True)
    words.whitespace_split, words.commenters, words.escape, words.quotes = True, "", "", '"'
    return list(words)


def join_words(words: Iterable[str]) -> str:
    """The line that a user can paste, with quotes where a word needs them; `split_words` takes it apart."""
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)
