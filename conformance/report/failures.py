# SPDX-License-Identifier: MIT
"""Write each failure of a port into a folder, and run it again from there."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.judging.findings import Failure, Finding, Record
from conformance.judging.judge import Body, Judge, agreement
from conformance.protocol.drawn_case import CASES_FOLDER, read_drawn, write_drawn
from conformance.protocol.job_folder import (
    CASE,
    MOST_WEIGHTS_BYTES,
    WEIGHTS,
    JobError,
    case_folders,
    file_of,
    read_bytes,
    read_inputs,
    read_stage,
    read_weights,
    write_job,
)
from conformance.protocol.port import Abilities, Case, Port, PortError
from conformance.protocol.stages import STAGES
from conformance.report.picture import draw, png
from conformance.suite.properties import find_property
from stss_ground.errors import InputError
from stss_ground.output.folder import SUMS, move_aside, sums_below
from stss_ground.output.write_whole import encode, make_folder, tell_errors, whole_folder, write_whole
from stss_ground.shell import join_words

Write = Callable[[Path, Case], None]
"""Writes a case into a job's folder."""


def write_stage(job: Path, case: Case) -> None:
    """Write a case of a stage."""
    write_job(job, [case])


def keep_failure(folder: Path, name: str, failure: Failure, replay: str, write: Write = write_stage) -> Path:
    """Write a failure to ``folder/name``: a job of one case, with the right answer, a picture, and the command that runs it again.

    Args:
        folder: for failures; made if need be.
        name: ``stage.test``, or a network's file; the folder of an earlier run is replaced, and anything else of this name moved aside.
        failure: to write.
        replay: the command that runs it again, without the folder.
        write: writes its case.
    """
    place = folder / name
    make_folder(folder)
    with whole_folder(place) as new, tell_errors(place):
        _write_failure(new, failure.finding, f"{replay} --replay {join_words([str(place)])}", write)
        (new / CASES_FOLDER).mkdir()
        write_drawn(new / CASES_FOLDER, name, [*failure.before, failure.drawn_case])
        (new / SUMS).write_bytes(sums_below(new))
        if os.path.lexists(place) and not _is_ours(place):
            move_aside(place)
        shutil.rmtree(place, ignore_errors=True)
    return place


def _is_ours(place: Path) -> bool:
    """Whether a folder holds the files of an earlier run, and nothing else."""
    try:
        return not place.is_symlink() and (place / SUMS).read_bytes() == sums_below(place)
    except OSError:
        return False


def _write_failure(folder: Path, finding: Finding, again: str, write: Write) -> None:
    write(folder, finding.case)
    parts = [finding.message, "\n".join(finding.terms)]
    if finding.expected is not None and finding.got is not None:
        _write_right(folder / CASE, finding.output, finding.got, finding.expected)
        parts.append(_write_picture(folder / "picture.png", finding.got, finding.expected))
    parts.append(f"Run it again:\n  {again}\n")
    write_whole(folder / "README.txt", encode("\n\n".join(filter(None, parts))))


def _write_picture(path: Path, got: NDArray[Any], expected: Expected) -> str:
    """Words on the picture; "" if there is none to draw."""
    try:
        picture = draw(got, expected)
    except Exception as error:
        # A failure is kept with or without its picture.
        return f"drawing it failed: {type(error).__name__}: {error}"
    if picture is None:
        return ""
    write_whole(path, png(picture.pixels))
    return f"{path.name}, from left to right: {picture.words}"


def _write_right(case: Path, output: str, got: NDArray[Any], expected: Expected) -> None:
    for what in ("got", "expected", "allowed"):
        (case / what).mkdir()
    np.save(case / "got" / file_of(output), got)
    for i, right in enumerate((expected.want, *expected.others)):
        np.save(case / "expected" / file_of(f"{output}.{i}"), np.asarray(right, np.float64))
    np.save(case / "allowed" / file_of(output), np.broadcast_to(np.asarray(expected.allowed, np.float64), expected.want.shape))


def replay(port: Port, folder: Path, abilities: Abilities | None = None) -> Record:
    """Run a failure again from its folder: its property on its case, or the case alone if the folder, a job of one case, has no property.

    Returns:
        The cases and results: ``failure`` is None if all is right; ``worst`` has error / bound of each judged output.

    Raises:
        InputError: the folder is not that of one failure, or the port lacks the stage.
    """
    judge = Judge(port, abilities=abilities)
    try:
        case = _only_case(folder)
        if case.stage not in judge.stages:
            raise InputError(f"{port.name} has no stage {case.stage}")
        body, cases = _property(folder) or (agreement, [case])
        for number, error in judge.departures(body, cases):
            if number == len(cases) - 1 and error is not None:
                judge.record.failure = Failure(error.finding, cases[number], tuple(cases[:number]))
    except (JobError, PortError) as error:
        raise InputError(str(error)) from error
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        # An edited folder may hold no case of its property, and may then raise any error anywhere.
        raise InputError(f"{folder}: expected the folder of one failure: {error}") from error
    return judge.record


def _only_case(folder: Path) -> Case:
    case, *more = case_folders(folder)
    if more:
        raise JobError(f"{folder}: expected the folder of one failure, got {len(more) + 1} cases")
    stage = read_stage(case)
    if stage not in STAGES:
        raise JobError(f"{case / 'stage'}: not a stage: {stage}")
    inputs = read_inputs(case, stage)
    if not STAGES[stage].weights:
        return Case(stage, inputs)
    path = case / "in" / WEIGHTS
    return Case(stage, inputs, read_weights(read_bytes(path, MOST_WEIGHTS_BYTES), path))


def _property(folder: Path) -> tuple[Body, list[Any]] | None:
    """The property and its cases: those before the failing one, then that one; None: the folder has no property."""
    if not (folder / CASES_FOLDER).exists():
        return None
    test, cases = read_drawn(folder / CASES_FOLDER)
    return find_property(test), [*cases]
