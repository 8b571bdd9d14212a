# SPDX-License-Identifier: MIT
"""The main job: a sequence of files in, a folder of files out, one display frame after the other.

While one frame is computed the files of the next are read and the one before is written, each in a thread of its own.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

from stss.frames.backends import Backend
from stss.frames.output import choose_rendered
from stss.run.frame_job import HOLES, FrameJob, FrameReport, Outcome, already_written, keep_outside, require_one_run
from stss.run.options import RunOptions
from stss.sequence.sequence import Sequence
from stss_ground.errors import InputError
from stss_ground.output.folder import OutputFolder
from stss_ground.output.places import require_places
from stss_ref.schedule import FrameKind

MAX_GAP = 1000
"""Display frames that may be missing in a row."""
REFUSAL = "holds frames of an earlier run; --resume keeps what is still right, --overwrite replaces all"


@dataclass
class Summary:
    """The reports of all frames of a run, in order."""

    frames: list[FrameReport]

    def count(self, outcome: Outcome, kind: FrameKind | None = None) -> int:
        """The number of frames with this outcome; of one kind if given."""
        return sum(f.outcome == outcome and kind in (None, f.kind) for f in self.frames)


@dataclass(frozen=True)
class RunPlan:
    """The frames and the folder of a run, settled before anything is computed.

    Attributes:
        rendered: the display frames that count as rendered.
        numbers: the display frames to write.
        folder: the folder to write to.
    """

    rendered: frozenset[int]
    numbers: range
    folder: OutputFolder


def run(
    sequence: Sequence,
    out: Path,
    backend: Backend,
    weights: str,
    options: RunOptions,
    on_frame: Callable[[FrameReport], None] = lambda report: None,
    reads: Iterable[Path] = (),
) -> Summary:
    """Write ``out/frame.NNNN.exr`` (or ``.png``) for every display frame, and ``out/holes/frame.NNNN.png`` for every EF.

    A file is complete or not there: see ``stss_ground.output``.

    Args:
        sequence: the input.
        out: the folder to write to; made if need be.
        backend: computes the frames.
        weights: their label, for the metadata.
        options: the user's choices.
        on_frame: called after every frame.
        reads: files that must not be written to, besides those of the sequence.

    Raises:
        InputError: a frame cannot be read (unless ``keep_going``), the options do not fit the sequence, a file that is read would be
            written to, ``out`` is the sequence's folder, another process writes there, it holds frames of others, or those of an
            earlier run and neither ``resume`` nor ``overwrite`` is set.
    """
    run_plan = plan_run(sequence, out, options, reads, whole=backend.window is None)
    folder = run_plan.folder
    job = FrameJob.of(sequence, run_plan.rendered, options, backend, weights, folder, partial(already_written, folder, options))
    summary = Summary([])
    require_one_run(folder, options, job.metadata)

    with folder.open(refusal=None if options.resume or options.overwrite else REFUSAL):
        keep_outside(folder, options)
        if backend.window is None:
            for number in range(sequence.numbers[0], run_plan.numbers[0]):
                job.compute(job.read(number))
        with closing(job.run(deque(run_plan.numbers), sequence.size)) as reports:
            for report in reports:
                summary.frames.append(report)
                on_frame(report)
        folder.finish(remove_others=options.overwrite)
    return summary


def plan_run(sequence: Sequence, out: Path, options: RunOptions, reads: Iterable[Path] = (), *, whole: bool = False) -> RunPlan:
    """Plan a run; no pixel is read, and nothing is written.

    Args:
        sequence, out, options, reads: as for `run`.
        whole: whether an output depends on all earlier ones, so that all of them must be computed.

    Raises:
        InputError: the options do not fit each other or the sequence, or the run would write to a file that it reads, or among the frames
            that it reads.
    """
    if options.resume and options.overwrite:
        raise InputError("--resume, --overwrite: expected one of them: keep what an earlier run finished, or replace it")
    if whole and options.resume:
        raise InputError("--resume: each output depends on all before it, so none can be kept; expected --overwrite")
    _require_cuts(sequence, options.cuts)
    rendered = choose_rendered(sequence.numbers, sequence.rendered, options.rendered, options.cuts)
    numbers = _numbers(sequence, options.frames)
    require_near(sequence, sequence.numbers[0] if whole else numbers[0], numbers[-1])
    if not options.keep_going:  # now, not after hours of other frames
        sequence.require(numbers)
        sequence.carries(options.also)
    folder = folder_of(out)
    require_places(reads=[*sequence.tables, *reads], folders=[folder], inputs=sequence.images)
    return RunPlan(rendered, numbers, folder)


def folder_of(out: Path) -> OutputFolder:
    """The folder of a run's files."""
    return OutputFolder(out, ("", HOLES), r"frame\.-?\d+\.(exr|png)")


def _numbers(sequence: Sequence, frames: tuple[int, int] | None) -> range:
    first, last = sequence.numbers[0], sequence.numbers[-1]
    if frames is None:
        return range(first, last + 1)
    if not first <= frames[0] <= frames[1] <= last:
        raise InputError(
            f"--frames {frames[0]}:{frames[1]}: expected to lie within {first}:{last}, the frames of {sequence.path}"
        )
    return range(frames[0], frames[1] + 1)


def _require_cuts(sequence: Sequence, cuts: tuple[int, ...]) -> None:
    for cut in cuts:
        if cut not in sequence.frames:
            raise InputError(f"--cuts {cut}: expected frames of {sequence.path}, {sequence.numbers[0]} to {sequence.numbers[-1]}")


def require_near(sequence: Sequence, first: int, last: int) -> None:
    """Raise InputError where neighbouring frames lie more than `MAX_GAP` apart: every number between would be reported."""
    for a, b in pairwise(sequence.numbers):
        if b - a - 1 > MAX_GAP and a < last and b > first:
            raise InputError(f"{sequence.path}: no frame between {a} and {b}; expected gaps of at most {MAX_GAP}")
