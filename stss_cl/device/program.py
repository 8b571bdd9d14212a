# SPDX-License-Identifier: MIT
"""Build kernels with their -D options; show the build log with the source line it means."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from weakref import WeakKeyDictionary

import pyopencl as cl

from stss_cl.device.caches import private
from stss_cl.device.discovery import Device
from stss_cl.errors import DeviceError

_PACKAGE = Path(__file__).parents[1]
KERNELS = _PACKAGE / "kernels" if (_PACKAGE / "kernels").is_dir() else _PACKAGE.parent / "kernels"
"""Where the sources are: inside the wheel, or beside the package in a checkout."""

_programs: WeakKeyDictionary[cl.Context, dict[tuple[str, str], cl.Program]] = WeakKeyDictionary()


def build(device: Device, file: str, options: Mapping[str, object] | None = None, flags: str = "") -> cl.Program:
    """Build ``kernels/file`` for ``device``; the same file with the same options is built once.

    Args:
        device: to build for.
        file: name in ``kernels/``.
        options: ``-D NAME=value``; a value of True stands for ``-D NAME``, False and None for none.
        flags: further compiler options.

    Raises:
        DeviceError: it does not build; the message has the line of source that the log names, ``log`` has the log.
    """
    given = [f"-D {k}" if v is True else f"-D {k}={v}" for k, v in (options or {}).items() if v is not None and v is not False]
    key = (file, " ".join(["-cl-std=CL1.2", *given, flags]).strip())
    built = _programs.setdefault(device.context, {})
    if key not in built:
        built[key] = _build(device, file, key[1])
    return built[key]


def source(file: str) -> str:
    """The text of ``kernels/file`` with its ``#include "..."`` lines replaced by what they name, once each.

    Caches of binaries do not look into included files; a single text has nothing to overlook.
    """
    seen: set[str] = set()

    def expand(name: str) -> str:
        if name in seen:
            return ""
        seen.add(name)
        text = (KERNELS / name).read_text(encoding="utf-8")
        return re.sub(r'^#include "([\w.]+)"$', lambda match: expand(match[1]), text, flags=re.MULTILINE)

    return expand(file)


def _build(device: Device, file: str, options: str) -> cl.Program:
    text = source(file)
    try:
        with warnings.catch_warnings():
            if "PYOPENCL_COMPILER_OUTPUT" not in os.environ:
                # Not only faults: Intel's compiler reports every kernel that it has made vectors of.
                warnings.simplefilter("ignore", cl.CompilerWarning)
            # PyOpenCL keeps binaries of platforms that do not cache them; its own place is shared with other programs.
            return cl.Program(device.context, text).build(options, cache_dir=str(private("pyopencl")))
    except cl.Error as error:
        log = str(error)
        raise DeviceError(f"kernels/{file} ({options}) does not build on {device.name}: {_fault(log, text)}", log) from None


def _fault(log: str, text: str) -> str:
    """The first error of the log in one line, with the line of source that it means."""
    # Clang writes file:line:column: error: what, PoCL 3.0 error: file:line:column: what
    at = re.search(r":(\d+):\d+: error: (.*)|error: .*?:(\d+):\d+: (.*)", log)
    if not at:
        said = [line.strip() for line in log.splitlines() if line.strip() and not line.startswith(("Build on", "(options"))]
        return said[1] if len(said) > 1 else said[0]  # the first says only that the build failed
    line, what = int(at[1] or at[3]), at[2] or at[4]
    lines = text.splitlines()
    return f"{what}: {lines[line - 1].strip()}" if 0 < line <= len(lines) else what
