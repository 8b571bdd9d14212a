# SPDX-License-Identifier: MIT
"""A linker for PoCL on machines without a C compiler, like most containers.

PoCL contains a compiler, but calls the system's ``ld`` with the C compiler's own libraries, which no kernel needs. If either is
missing, PoCL ends the process at the first kernel. In that case a small program of ours is put into ``$PATH`` under the name ``ld``.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import sys
from pathlib import Path

from stss_cl.device.caches import private, read, store
from stss_ground.errors import DeviceError

CHOICES = ("own", "system")
COMPILERS = ("/usr/lib*/gcc*/*/*",)
"""The folders in which PoCL looks for the libraries of the system's C compiler; patterns."""
LIBRARIES = ("/lib/*-linux-gnu", "/usr/lib/*-linux-gnu", "/lib64", "/usr/lib64", "/lib", "/usr/lib")
MOST_BYTES = 1 << 16
PROGRAM = Path(__file__).with_name("own_linker.py")


def provide() -> None:
    """Put our linker before all others, if it is needed: PoCL looks for it in ``$PATH`` at a moment of its choice.

    Raises:
        DeviceError: ``$STSS_LINKER`` is neither ``own`` nor ``system``, or there is no place for the program.
    """
    if not is_needed():
        return
    text = f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -I -S {shlex.quote(str(PROGRAM))} "$@"\n'.encode()
    folder = private("linker", hashlib.sha256(text).hexdigest()[:16])
    path = folder / "ld"
    if read(path, MOST_BYTES) != text:
        store(path, text, executable=True)
    places = os.environ.get("PATH", os.defpath)
    if str(folder) not in places.split(os.pathsep):
        os.environ["PATH"] = f"{folder}{os.pathsep}{places}"


def is_needed() -> bool:
    """Whether PoCL could not link: ``ld``, or a file that it needs, is not there; ``$STSS_LINKER`` decides otherwise."""
    choice = os.environ.get("STSS_LINKER")
    if choice not in (None, *CHOICES):
        raise DeviceError(f"STSS_LINKER: expected one of {', '.join(CHOICES)}, got {choice!r}")
    if choice is not None:
        return choice == "own"
    # Where PATH is not set, as in some cron jobs, Python looks in the system's folders, but PoCL nowhere.
    linker = shutil.which("ld", path=os.environ.get("PATH", ""))
    return possible() and (linker is None or not _there(COMPILERS, "libgcc.a") or not _there(LIBRARIES, "libc.so", "libc.a"))


def possible() -> bool:
    """Whether ours can link for this system, and a program can be made of it."""
    return sys.platform == "linux" and platform.machine() == "x86_64" and bool(sys.executable)


def _there(folders: tuple[str, ...], *names: str) -> bool:
    root = Path("/")
    return any(next(root.glob(f"{folder[1:]}/{name}"), None) is not None for folder in folders for name in names)
