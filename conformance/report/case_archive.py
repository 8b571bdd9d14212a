# SPDX-License-Identifier: MIT
"""``stss conform --write-cases``: cases with their right answers and bounds, in files that any language reads."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic
from conformance.judging.judge import Tier
from conformance.protocol.job_folder import WEIGHTS, link, write_job
from conformance.report.stored_cases import StoredCase, StoredTest, stored_tests
from conformance.report.versions import versions_of_cases
from stss_ground.errors import InputError
from stss_ground.output.write_whole import tell_errors, whole_folder

FORMAT = 1
"""Version of the archive; raised when a field of the index, or a file, changes its meaning."""
INDEX, SUMS = "index.json", "SHA256SUMS"


def write_cases(
    folder: Path,
    stages: Sequence[str],
    tier: Tier,
    seed: int = 0,
    dtype: str = "float32",
    *,
    winograd: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Write an archive, whole or not at all.

    Args:
        folder: the archive; a new folder.
        stages: the tests of these stages are stored.
        tier: decides the number of cases.
        seed: of the cases.
        dtype, winograd: the arithmetic of the ports that the archive is for.
        tell: called with a line for each test.

    Returns:
        The index, as in ``index.json``.

    Raises:
        InputError: the folder exists already, or cannot be written.
    """
    if folder.exists() or folder.is_symlink():
        raise InputError(f"--write-cases {folder}: expected a folder that does not exist yet")
    if not folder.absolute().parent.is_dir():
        raise InputError(f"--write-cases {folder}: expected a folder in a folder that exists")
    with whole_folder(folder) as new, tell_errors(folder):
        archive = _Archive(new)
        for test in stored_tests(stages, Arithmetic(dtype, winograd), tier, seed):
            archive.add(test)
            tell(f"{test.id}: {f'{len(test.cases)} cases' if test.cases is not None else 'a property, not stored'}")
        return archive.finish({"stages": [*stages], "tier": tier.name, "seed": seed, "dtype": dtype, "winograd": winograd})


class _Archive:
    """An archive that is filled test by test: a job folder for a program, with the right answers beside each case's ``in``."""

    def __init__(self, folder: Path):
        self._folder = folder
        self._tests: list[dict[str, Any]] = []
        self._cases: list[dict[str, Any]] = []
        self._sums: list[str] = []  # lines of SHA256SUMS
        self._digest = hashlib.sha256()
        self._weights: dict[str, Path] = {}

    def add(self, test: StoredTest) -> None:
        """Add a test and its cases."""
        before = len(self._cases)
        for case in test.cases or ():
            self._add(test.id, case)
        self._tests.append({
            "id": test.id, "property": test.property, "stored": test.cases is not None, "cases": len(self._cases) - before,
            "undecided": test.undecided,
        })  # fmt: skip

    def finish(self, request: dict[str, Any]) -> dict[str, Any]:
        """Write the index and the checksums."""
        index = {
            "format": FORMAT, "versions": versions_of_cases(), **request, "inputs_sha256": self._digest.hexdigest(),
            "tests": self._tests, "cases": self._cases,
        }  # fmt: skip
        (self._folder / INDEX).write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
        self._note(self._folder / INDEX)
        (self._folder / SUMS).write_text("".join(self._sums), encoding="utf-8")
        return index

    def _add(self, test: str, row: StoredCase) -> None:
        name, case = f"{len(self._cases):04d}", row.case
        write_job(self._folder, [case], len(self._cases))
        inputs = self._folder / name / "in"
        for file in (self._folder / name / "stage", *(inputs / f"{input_}.npy" for input_ in case.inputs)):
            self._digest.update(self._note(file).encode())
        if case.weights is not None:
            line = self._note(inputs / WEIGHTS)
            self._digest.update(line.encode())
            first = self._weights.setdefault(line[:64], inputs / WEIGHTS)
            if first != inputs / WEIGHTS:  # the same weights are one file under many names
                (inputs / WEIGHTS).unlink()
                link(first, inputs / WEIGHTS)
        self._cases.append({
            "case": name, "test": test, "stage": case.stage,
            "inputs": {input_: f"{name}/in/{input_}.npy" for input_ in case.inputs},
            "weights": None if case.weights is None else f"{name}/in/{WEIGHTS}",
            "outputs": {output: self._write_right(name, output, right) for output, right in row.expected.items()},
        })  # fmt: skip

    def _write_right(self, name: str, output: str, right: Expected) -> dict[str, Any]:
        want = np.asarray(right.want, np.float64)
        files = {f"{name}/expected/{output}.{i}.npy": each for i, each in enumerate((want, *right.others))}
        allowed = {f"{name}/allowed/{output}.npy": np.asarray(right.allowed)}
        for file, numbers in {**files, **allowed}.items():
            path = self._folder / file
            path.parent.mkdir(exist_ok=True)
            np.save(path, numbers.astype("<f8", order="C"))
            self._note(path)
        return {"expected": [*files], "allowed": next(iter(allowed)), "vectors": right.vectors}

    def _note(self, path: Path) -> str:
        line = f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(self._folder).as_posix()}\n"
        self._sums.append(line)
        return line
