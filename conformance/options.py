# SPDX-License-Identifier: MIT
"""The options of ``stss conform``, in groups. NumPy is not imported here: a command sets its threads before the first import."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from stss_ground.errors import InputError
from stss_ground.output.places import require_places
from stss_ground.shell import join_words

MOST_SIDE = 2**17


@dataclass(frozen=True)
class PortChoice:
    """A port, and the user's statements about it.

    Attributes:
        spec: ``package.module:factory``, a callable without arguments; the current folder is searched first. For a network of the
            user's own also an engine, ``onnxruntime[:PROVIDER]``, ``openvino[:PRECISION]`` or ``pytorch:MODULE:FACTORY``.
        program: in place of ``spec``: a command line; the job folder is appended to it.
        timeout: most seconds that one run of a program may take.
        dtype: the port's arithmetic; None: as its own ``dtype`` says, float32 for a program.
        winograd: it uses Winograd convolutions, even if its own ``winograd`` does not say so.
        weights_version: the latest version of weights that it knows; None: as its own ``weights_version`` says, else the latest.
    """

    spec: str | None = None
    program: str | None = None
    timeout: float = 120
    dtype: str | None = None
    winograd: bool = False
    weights_version: int | None = None

    def command(self, onnx: Path | None = None) -> str:
        """The command that judges this port, of the network ``onnx`` if it is given, without ``--replay``."""
        words = [
            "stss",
            "conform",
            *(("--onnx", str(onnx)) if onnx is not None else ()),
            *(("--port", self.spec) if self.spec is not None else ("--exec", self.program or "")),
        ]
        words += ["--dtype", self.dtype] if self.dtype is not None else []
        if self.weights_version is not None and onnx is None:
            words += ["--weights-version", str(self.weights_version)]
        return join_words([*words, *(["--winograd"] if self.winograd else [])])


@dataclass(frozen=True)
class NetworkChoice:
    """A network in place of ours.

    Attributes:
        onnx: the model; None: ours.
        shapes: sizes of open axes, each ``NAME=N``.
        files: inputs in place of drawn ones, each ``NAME=FILE.npy``.
    """

    onnx: Path | None
    shapes: tuple[str, ...]
    files: tuple[str, ...]

    def sizes(self) -> dict[str, int]:
        """The sizes of open axes; InputError for a word that names none."""
        sizes: dict[str, int] = {}
        for each in self.shapes:
            name, _, number = each.rpartition("=")
            if not name or not number.isdecimal() or not 0 < int(number) <= MOST_SIDE:
                raise InputError(f"--shape: expected NAME=N with N from 1 to {MOST_SIDE}, got {each!r}")
            sizes[name] = int(number)
        return sizes


@dataclass(frozen=True)
class CaseChoice:
    """The cases to judge; the attributes are the options of these names."""

    stages: tuple[str, ...] | None
    tier: str
    seed: int
    size: tuple[int, int] | None
    largest_side: int | None
    repeat: int
    replay: Path | None
    write_cases: Path | None


@dataclass(frozen=True)
class VerdictChoice:
    """The conditions on which a port passes; the attributes are the options of these names."""

    require: tuple[str, ...] | None
    known_failures: Path | None
    fail_fast: bool


@dataclass(frozen=True)
class ReportFiles:
    """The files to write; None: this one is not wanted.

    Attributes:
        failures: folder for the cases that fail.
        json_file: every result.
        junit: JUnit XML.
        page: an HTML page.
    """

    failures: Path
    json_file: Path | None = None
    junit: Path | None = None
    page: Path | None = None

    def require_folder(self) -> None:
        """Raise InputError if ``failures`` cannot be a folder; called before minutes of work."""
        if self.failures.exists() and not self.failures.is_dir():
            raise InputError(f"{self.failures}: expected a folder, found a file")

    def require_apart(self, reads: Iterable[Path]) -> None:
        """Raise InputError if a file would be written over one of ``reads``, such as the modules that a port has imported."""
        require_places({"--json": self.json_file, "--junit": self.junit, "--report": self.page}, reads)
