# SPDX-License-Identifier: MIT
"""Build kernels with their -D options; show errors with the source line that they refer to."""

from __future__ import annotations

import hashlib
import json
import os
import re
import warnings
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary, ref

import pyopencl as cl
from pyopencl.characterize import has_src_build_cache

from stss_cl.device import signatures
from stss_cl.device.caches import private, read, store
from stss_cl.device.discovery import Device
from stss_ground.errors import DeviceError

_PACKAGE = Path(__file__).parents[1]
KERNELS = _PACKAGE / "kernels" if (_PACKAGE / "kernels").is_dir() else _PACKAGE.parent / "kernels"
"""The folder of the sources: inside the wheel, or beside the package in a checkout."""

MOST_BINARY = 64 << 20
"""Most bytes of a compiled program that is stored; ours have some 100 KiB."""

DIGEST = hashlib.sha256().digest_size
"""Bytes of the digest at the beginning of a stored binary."""

FLUSH = "-cl-denorms-are-zero"
"""Kernels treat subnormal numbers as 0, so that their time does not depend on the data: processors of Intel take a hundred cycles for each
operation that has one. PoCL sets its threads so for each launch."""

_building = Lock()
"""One thread builds at a time: two would undo each other's filters of warnings."""


class Program:
    """A program, which is built when its first kernel is needed, and its kernels' arguments, which are known before.

    Attributes:
        structs: struct -> members with their types, in order, of those that have only numbers.
    """

    def __init__(self, device: Device, file: str, options: str):
        self._device, self._file, self._options, self._text = ref(device), file, options, source(file)
        self.structs = signatures.structs(self._text)
        self._defined = set(re.findall(r"-D (\w+)", options))
        self._arguments: dict[str, list[tuple[str, str]]] = {}
        self._handle: cl.Program | None = None

    @property
    def handle(self) -> cl.Program:
        """OpenCL's, built now if need be.

        Raises:
            DeviceError: it does not build; the message has the source line that the compiler's log names, ``log`` has the whole log.
        """
        with _building:
            if self._handle is None:
                device = self._device()
                assert device is not None, "the device is held by those who use its programs"
                self._handle = _build(device, self._file, self._text, self._options)
            return self._handle

    def arguments(self, kernel: str) -> list[tuple[str, str]]:
        """Name and type of each argument of a kernel, in order."""
        if kernel not in self._arguments:  # read once, since it takes milliseconds, and a frame of another size has fifty kernels
            self._arguments[kernel] = signatures.arguments(self._text, kernel, self._defined)
        return self._arguments[kernel]


_programs: WeakKeyDictionary[Device, dict[tuple[str, str], Program]] = WeakKeyDictionary()
"""Kept by device, not by context: programs hold their context, and would keep themselves alive."""


def program_for(device: Device, file: str, options: Mapping[str, object] | None = None, flags: str = "") -> Program:
    """The program of ``kernels/file`` for ``device``; the same file with the same options is built once, when it is needed.

    Args:
        device: to build for.
        file: name in ``kernels/``.
        options: ``-D NAME=value``; a value of True stands for ``-D NAME``, False and None for none.
        flags: further compiler options.
    """
    defines = [f"-D {k}" if v is True else f"-D {k}={v}" for k, v in (options or {}).items() if v is not None and v is not False]
    together = ["-cl-std=CL1.2", *defines, device.compiler_options, flags, FLUSH]
    key = (file, " ".join(option for option in together if option))
    device.require_same_process()
    with _building:
        programs = _programs.setdefault(device, {})
        if key not in programs:
            programs[key] = Program(device, file, key[1])
        return programs[key]


def marking(device: Device, marks: bool) -> Mapping[str, object]:
    """The option by which a kernel marks changes; on processors, also as GPUs, an argument decides (change_map.clh)."""
    return {} if device.kind == "CPU" else {"MARK": int(marks)}


def programs_of(device: Device) -> Mapping[tuple[str, str], Program]:
    """The programs built for this device so far, by file and options, in order."""
    return dict(_programs.get(device, {}))


def source(file: str) -> str:
    """The text of ``kernels/file`` with its ``#include "..."`` lines replaced by the files' texts, once each.

    Caches of binaries do not check included files, so a program must be a single text.
    """
    names: set[str] = set()

    def expand(name: str) -> str:
        if name in names:
            return ""
        names.add(name)
        text = (KERNELS / name).read_text(encoding="utf-8")
        return re.sub(r'^#include "([\w.]+)"$', lambda match: expand(match[1]), text, flags=re.MULTILINE)

    return expand(file)


def _build(device: Device, file: str, text: str, options: str) -> cl.Program:
    try:
        with warnings.catch_warnings(), _our_options_alone():
            if "PYOPENCL_COMPILER_OUTPUT" in os.environ:
                return _load_or_build(device, text, options)
            # Not only faults: Intel's compiler reports every kernel that it has vectorised.
            warnings.simplefilter("ignore", cl.CompilerWarning)
            # -w: PoCL's compiler writes "1 warning generated." straight to the terminal of stss run.
            return _load_or_build(device, text, f"{options} -w")
    except cl.Error as error:
        log = str(error)
        raise DeviceError(f"kernels/{file} ({options}) does not build on {device.name}: {_fault(log, text)}", log) from None


@contextmanager
def _our_options_alone() -> Generator[None]:
    """Hide ``$PYOPENCL_BUILD_OPTIONS``, which PyOpenCL adds to every program: no self-test has tested our programs with it."""
    theirs = os.environ.pop("PYOPENCL_BUILD_OPTIONS", None)
    try:
        yield
    finally:
        if theirs is not None:
            os.environ["PYOPENCL_BUILD_OPTIONS"] = theirs


def _load_or_build(device: Device, text: str, options: str) -> cl.Program:
    """Build a program; on platforms without a cache, from the binary that an earlier process stored."""
    if has_src_build_cache(device.handle):
        with suppress(cl.Error):
            return cl.Program(device.context, text).build(options)
        # Some versions of PoCL fail if another process makes the same cache folder at the same moment. By now it exists.
        return cl.Program(device.context, text).build(options)
    what = json.dumps([device.name, device.driver, device.platform_version, options, text])
    path = private("binaries") / hashlib.sha256(what.encode()).hexdigest()
    data = read(path, MOST_BINARY) or b""
    binary = data[DIGEST:]
    if binary and hashlib.sha256(binary).digest() == data[:DIGEST]:  # a driver may end the process where its binary is damaged
        with suppress(cl.Error):  # a driver may refuse its own binary; then the program is built anew
            return cl.Program(device.context, [device.handle], [binary]).build(options)
    program = cl.Program(device.context, text).build(options)
    binaries: Any = program.get_info(cl.program_info.BINARIES)
    store(path, hashlib.sha256(binaries[0]).digest() + binaries[0])
    return program


def _fault(log: str, text: str) -> str:
    """The first error of the log in one line, with the source line that it refers to."""
    # Clang writes file:line:column: error: what, PoCL 3.0 error: file:line:column: what
    at = re.search(r":(\d+):\d+: error: (.*)|error: .*?:(\d+):\d+: (.*)", log)
    if not at:
        messages = [line.strip() for line in log.splitlines() if line.strip() and not line.startswith(("Build on", "(options"))]
        return messages[1] if len(messages) > 1 else messages[0]  # the first says only that the build failed
    line, what = int(at[1] or at[3]), at[2] or at[4]
    lines = text.splitlines()
    return f"{what}: {lines[line - 1].strip()}" if 0 < line <= len(lines) else what
