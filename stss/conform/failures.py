# SPDX-License-Identifier: MIT
"""``stss conform``: a port is loaded, judged, and what it gets wrong is left as folders to run again."""

from __future__ import annotations

import importlib
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected, largest
from conformance.judge import DepartureError, Finding, Judge
from conformance.protocol.job_folder import (
    MOST_WEIGHTS_BYTES,
    WEIGHTS,
    case_names,
    read_array,
    read_inputs,
    read_stage,
    read_weights,
    write_job,
)
from conformance.protocol.job_tree import Folder, JobError, open_folder
from conformance.protocol.port import Case, Port, PortError
from conformance.protocol.program_port import FolderPort
from conformance.protocol.stages import STAGES
from stss.errors import InputError
from stss.images.contact_sheet import contact_sheet
from stss.images.read_write import write_rgb
from stss.output.write_whole import make_folder, told, write_whole
from stss_ref.arrays import ArrayError

CASE = "0000"
PICTURE_SIDE = 240
"""Pixels on the screen that the longer side of a picture's panel takes, about."""


def load_port(spec: str | None, program: str | None, timeout: float, dtype: str | None, winograd: bool) -> Port:
    """The port to be judged.

    Args:
        spec: ``package.module:factory``, a callable without arguments; the current folder is searched first.
        program: a command line; the job folder is added to it.
        timeout: seconds for one start of a program.
        dtype: its arithmetic; None: what it says of itself, float32 for a program.
        winograd: whether it uses Winograd convolutions, over what it says of itself.

    Raises:
        InputError: neither or both are given, or there is no such port.
    """
    if (spec is None) == (program is None):
        raise InputError("expected either --port package.module:factory or --exec PROGRAM")
    try:
        port: Any = _imported(spec) if spec is not None else FolderPort(_command(program or ""), timeout)
        lacking = [name for name in ("name", "dtype", "stages", "run") if not hasattr(port, name)]
        if lacking:
            raise InputError(f"{spec}: expected a port, got a {type(port).__name__} without {', '.join(lacking)}")
        if dtype is not None:
            port.dtype = dtype
        if port.dtype not in ("float32", "float16"):
            raise InputError(f"{spec or program}: dtype: expected float32 or float16, got {port.dtype!r}")
        if winograd:
            port.winograd = True
        unknown = set(port.stages()) - set(STAGES)
    except PortError as error:
        raise InputError(str(error)) from error
    if unknown:
        raise InputError(f"{spec or program}: stages: not in the table: {', '.join(sorted(unknown))}")
    return port


def _imported(spec: str) -> Any:
    module, _, name = spec.partition(":")
    if not module or not name:
        raise InputError(f"--port: expected package.module:factory, got {spec!r}")
    if "" not in sys.path:
        sys.path.insert(0, "")
    try:
        factory: Callable[[], Any] = getattr(importlib.import_module(module), name)
    except ImportError as error:
        raise InputError(f"--port {spec}: {error}") from error
    except AttributeError as error:
        raise InputError(f"--port {spec}: module {module} has no {name}") from error
    return factory()


def _command(program: str) -> list[str]:
    try:
        words = shlex.split(program)
    except ValueError as error:
        raise InputError(f"--exec: {error}: {program!r}") from error
    if not words:
        raise InputError("--exec: expected a command, got nothing")
    return words


def keep_failure(folder: Path, name: str, finding: Finding, replay: str) -> Path:
    """Leave a failure as ``folder/name``: a job of one case, with what is right, a picture, and how to run it again.

    Args:
        folder: for failures; made if need be.
        name: ``stage.test``; what lies there of an earlier run is replaced.
        finding: the failure.
        replay: the command that runs it again, without the folder.
    """
    kept = folder / name
    make_folder(folder)
    with told(folder):
        made = Path(tempfile.mkdtemp(prefix=".", dir=folder))
    try:
        with told(kept):
            _write_failure(made, finding, f"{replay} --replay {kept}")
            made.chmod(0o755)
            if kept.is_symlink():
                kept.unlink()
            shutil.rmtree(kept, ignore_errors=True)
            made.rename(kept)
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise
    return kept


def _write_failure(folder: Path, finding: Finding, again: str) -> None:
    write_job(folder, [finding.case])
    if finding.expected is not None and finding.got is not None:
        _write_right(folder / CASE, finding.output, finding.got, finding.expected)
        if picture := _picture(finding.got, finding.expected):
            write_rgb(folder / "picture.png", picture[0])
    write_whole(folder / "README.txt", f"{finding.message}\n\nRun it again:\n  {again}\n".encode())


def _write_right(case: Path, output: str, got: NDArray[Any], expected: Expected) -> None:
    for what in ("got", "expected", "allowed"):
        (case / what).mkdir()
    np.save(case / "got" / f"{output}.npy", got)
    for i, right in enumerate((expected.want, *expected.others)):
        np.save(case / "expected" / f"{output}.{i}.npy", np.asarray(right, np.float64))
    np.save(case / "allowed" / f"{output}.npy", np.broadcast_to(np.asarray(expected.allowed, np.float64), expected.want.shape))


def _picture(got: NDArray[Any], expected: Expected) -> tuple[NDArray[Any]] | None:
    """What the port gave, what is right, and error / bound from black (0) over red (1) to white (8 and more)."""
    want = np.asarray(expected.want, np.float64)
    if got.shape != want.shape or want.ndim not in (2, 3) or not want.size:
        return None
    ratio = expected.ratios(got)
    planes = [a if a.ndim == 3 else a[..., None] for a in (got.astype(np.float64), want)]
    wrong = (ratio if ratio.ndim == 3 else ratio[..., None]).max(axis=-1)
    shown = int(np.argmax(ratio.max(axis=(0, 1)) if ratio.ndim == 3 else np.zeros(1))) if planes[0].shape[-1] != 3 else None
    chosen = [np.nan_to_num(p if shown is None else np.repeat(p[..., shown : shown + 1], 3, axis=-1)) for p in planes]
    low, high = chosen[1].min(), chosen[1].max()
    scaled = [np.clip((p - low) / (high - low if high > low else 1), 0, 1) for p in chosen]
    heat = np.stack([np.clip(wrong, 0, 1), np.clip((wrong - 1) / 7, 0, 1), np.clip((wrong - 1) / 7, 0, 1)], axis=-1)
    zoom = max(1, PICTURE_SIDE // max(want.shape[:2]))
    sheet = contact_sheet([("", [*scaled, heat])], ("port", "expected", "error / bound"), zoom=zoom)
    return (sheet.astype(np.float32),)


def replay(port: Port, folder: Path) -> list[tuple[str, float]]:
    """Run a kept failure again: ``error / bound`` of each output that is judged.

    A failure that was no answer says nothing of what is right, so an answer to it is held against the reference.

    Raises:
        InputError: the folder is none, or the port fails.
    """
    try:
        with open_folder(folder) as kept:
            name, *more = case_names(kept)
            if more:
                raise JobError(f"{folder}: expected the folder of one failure, got {len(more) + 1} cases")
            with kept.folder(name) as opened:
                case = _case(opened)
                if case.stage not in port.stages():
                    raise InputError(f"{port.name} has no stage {case.stage}")
                return _held_against_kept(port, opened, case) or _held_against_the_reference(port, case)
    except (JobError, PortError) as error:
        raise InputError(str(error)) from error


def _case(folder: Folder) -> Case:
    stage = read_stage(folder)
    if stage not in STAGES:
        raise JobError(f"{folder.path / 'stage'}: not a stage: {stage}")
    inputs = read_inputs(folder, stage)
    if not STAGES[stage].weights:
        return Case(stage, inputs)
    with folder.folder("in") as given:
        return Case(stage, inputs, read_weights(given.read(WEIGHTS, MOST_WEIGHTS_BYTES), given.path / WEIGHTS))


def _held_against_kept(port: Port, folder: Folder, case: Case) -> list[tuple[str, float]]:
    if folder.kind("allowed") is None:
        return []
    found: list[tuple[str, float]] = []
    judge = Judge(port)
    with folder.folder("allowed") as allowed, folder.folder("expected") as expected:
        try:
            outputs = judge.run(case.stage, case.inputs, case.weights)
        except DepartureError as error:
            raise JobError(str(error)) from error
        for name in allowed.names():
            output = name.removesuffix(".npy")
            rights = sorted(expected.names(), key=lambda right: (len(right), right))
            answers = [read_array(expected, right) for right in rights if right.startswith(f"{output}.")]
            limit = read_array(allowed, name)
            if output not in outputs or not answers or {a.shape for a in answers} != {limit.shape}:
                raise JobError(f"{folder.path}: expected the folder of one failure: {output} does not fit")
            vectors = f"{case.stage}.{output}" in ("motion_chain.motion", "occlusion_warp.occlusion_motion")
            right = Expected(answers[0], limit, tuple(answers[1:]), vectors)
            found.append((f"{case.stage}.{output}", largest(right, outputs[output])))
    return found


def _held_against_the_reference(port: Port, case: Case) -> list[tuple[str, float]]:
    judge = Judge(port)
    try:
        judge.agrees(case.stage, case.inputs, case.weights)
    except DepartureError as error:
        if error.finding.expected is None:
            raise JobError(str(error)) from error
    except ArrayError as error:
        raise JobError(f"stage {case.stage}: {error}") from error
    return list(judge.record.worst.items())
