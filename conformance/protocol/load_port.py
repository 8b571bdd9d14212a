# SPDX-License-Identifier: MIT
"""Load the port that is judged: a Python object, or a program."""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from conformance.options import PortChoice
from conformance.protocol.port import Abilities, Port, PortError, abilities_of, foreign_code
from conformance.protocol.program_port import FolderPort
from conformance.protocol.stages import STAGES
from conformance.protocol.weights_format import ONE_OF_VERSIONS, VERSIONS
from stss_ground.errors import InputError, UserError
from stss_ground.shell import split_words

ARITHMETICS = ("float32", "float16", "bfloat16")


def load_port(choice: PortChoice, stages: Iterable[str] = STAGES) -> tuple[Port, Abilities]:
    """Load the port to be judged; a program is asked only for ``stages``.

    Returns:
        The port, and its abilities by its own statement or by the user's.

    Raises:
        InputError: not exactly one of ``choice.spec`` and ``choice.program`` is given, or there is no such port.
    """
    spec, program = choice.spec, choice.program
    if (spec is None) == (program is None):
        raise InputError("expected either --port package.module:factory or --exec PROGRAM")
    origin = spec or program
    try:
        words = split_command(program or "") if spec is None else []
        port: Any = import_port(spec) if spec is not None else FolderPort(words, choice.timeout, stages=stages, keep=False)
        lacking = [name for name in ("name", "dtype", "stages", "run") if not hasattr(port, name)]
        if lacking:
            raise InputError(f"{spec}: expected a port, got a {type(port).__name__} without {', '.join(lacking)}")
        statements: dict[str, Any] = {
            "dtype": choice.dtype, "winograd": choice.winograd or None, "weights_version": choice.weights_version,
        }  # fmt: skip
        with foreign_code():
            own, stages_there = abilities_of(port), set[str](port.stages())
        abilities = replace(own, **{name: value for name, value in statements.items() if value is not None})
        arithmetic: Any = abilities.dtype
        # NumPy's own dtype equals its name, and is no key of the tables of bounds.
        if not isinstance(arithmetic, str) or arithmetic not in ARITHMETICS:
            raise InputError(f"{origin}: dtype: expected the text float32, float16 or bfloat16, got {arithmetic!r}")
        version: Any = abilities.weights_version
        if not isinstance(version, int) or version not in VERSIONS:
            raise InputError(f"{origin}: weights_version: expected {ONE_OF_VERSIONS}, got {version!r}")
        unknown = stages_there - set(STAGES)
    except PortError as error:
        raise InputError(str(error) if spec is None else f"{spec}: {error}") from error
    if unknown:
        raise InputError(f"{origin}: stages: not in the table: {', '.join(sorted(unknown))}")
    return port, abilities


def loaded_files() -> list[Path]:
    """The files of all modules that this process has imported, so also those of a port and of its imports: they count as read."""
    files = (getattr(module, "__file__", None) for module in [*sys.modules.values()])
    return [Path(name) for name in files if isinstance(name, str)]


def import_port(spec: str) -> Any:
    """Call ``package.module:factory``; the current folder is searched first.

    Raises:
        InputError: there is none, or it fails; with the line of the port at which it does.
    """
    module, _, name = spec.partition(":")
    if not module or not name:
        raise InputError(f"--port: expected package.module:factory, got {spec!r}")
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        with foreign_code():
            factory: Callable[[], Any] | None = getattr(importlib.import_module(module), name, None)
        if factory is None:
            raise InputError(f"--port {spec}: module {module} has no {name}")
        if not callable(factory):
            raise InputError(f"--port {spec}: expected a class or a function that makes the port, found {type(factory).__name__}")
        with foreign_code():
            return factory()
    except PortError as error:
        if isinstance(error.__cause__, UserError):
            raise error.__cause__ from None
        raise InputError(f"--port {spec}: {error}{_place(error.__cause__)}") from error


def _place(error: BaseException | None) -> str:
    """The file and line at which foreign code failed, in words; empty where that is in Python's own import."""
    own: list[traceback.FrameSummary] = []
    for frame in [] if error is None else traceback.extract_tb(error.__traceback__):
        if frame.filename == __file__:
            own.clear()  # the calls before it are ours
        elif not frame.filename.startswith("<") and frame.filename != importlib.__file__:
            own.append(frame)
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""


def split_command(program: str) -> list[str]:
    """The words of ``--exec``; InputError if there are none."""
    try:
        words = split_words(program)
    except ValueError as error:
        raise InputError(f"--exec: {error}: {program!r}") from error
    if not words:
        raise InputError("--exec: expected a command, got nothing")
    return words
