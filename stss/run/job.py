# SPDX-License-Identifier: MIT
"""The main job: a sequence of files in, a folder of files out, one display frame after the other.

While one frame is computed the files of the next are read and the one before is written, each in a thread of its own.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from stss.color import Transfer, transfer
from stss.errors import InputError
from stss.frames.backends import NETWORK, Backend, Cost
from stss.frames.display_frame import DisplayFrame
from stss.frames.supersample import Output, choose_rendered, plan
from stss.images.read_write import read_header, write_mask, write_rgb
from stss.run.pipeline import overlap
from stss.run.skip_report import picture
from stss.run.window import Keys, Window
from stss.sequence.profiles import Profile
from stss.sequence.reader import Sequence
from stss.version import VERSION
from stss_ref import SPEC_VERSION
from stss_ref.arrays import Array, Image, Mask
from stss_ref.depth import DepthMode
from stss_ref.schedule import FrameKind, schedule

MAX_GAP = 1000
"""Display frames that may be missing in a row."""
SKIPPED = "skipped"
"""Below the run's folder: pictures of what was computed."""
Outcome = Literal["done", "kept", "left out"]


@dataclass(frozen=True)
class RunOptions:
    """What the user chose.

    Attributes:
        transfer: ``none``, ``srgb``, ``hdr``.
        depth: ``clip``, ``scale``.
        rendered: ``even``, ``odd``, ``all``; None = see ``supersample.choose_rendered``.
        frames: first and last display frame to write, both included; None = all. Frames before the first still serve as history.
        format: ``exr``, ``png``.
        keep_going: leave out a frame that cannot be read, rather than stop.
        resume: keep the files of an earlier run that are what this run would write.
        overwrite: replace the files of an earlier run.
        show_skipped: write ``skipped/frame.NNNN.png`` as well: where the frame was computed, and where kept.
    """

    transfer: str = "srgb"
    depth: DepthMode = "scale"
    rendered: str | None = None
    frames: tuple[int, int] | None = None
    format: str = "exr"
    keep_going: bool = False
    resume: bool = False
    overwrite: bool = False
    show_skipped: bool = False

    @classmethod
    def of(cls, profile: Profile, *, transfer: str | None, depth: DepthMode | None, **chosen: Any) -> RunOptions:
        """What the user chose, and where nothing was chosen what suits the renderer's files."""
        usual = "srgb" if profile.color_domain == "linear" else "none"
        return cls(transfer=transfer or usual, depth=depth or profile.depth_normalisation, **chosen)


@dataclass(frozen=True)
class FrameReport:
    """What became of one display frame; ``reason`` says why it was left out, ``cost`` what computing it took."""

    number: int
    kind: FrameKind | None
    outcome: Outcome
    reason: str = ""
    fault: bool = False
    cost: Cost | None = None


@dataclass
class Summary:
    """What became of all of them, in order."""

    frames: list[FrameReport]

    def count(self, outcome: Outcome, kind: FrameKind | None = None) -> int:
        """How many frames ended so; of one kind if given."""
        return sum(f.outcome == outcome and kind in (None, f.kind) for f in self.frames)


def run(
    sequence: Sequence,
    out: Path,
    backend: Backend,
    weights_id: str,
    options: RunOptions,
    on_frame: Callable[[FrameReport], None] = lambda report: None,
) -> Summary:
    """Write ``out/frame.NNNN.exr`` (or ``.png``) for every display frame, and ``out/holes/frame.NNNN.png`` for every EF.

    A file is complete or not there: it is written beside and renamed.

    Args:
        sequence: what to read.
        out: the folder to write to; made if need be.
        backend: what computes.
        weights_id: identity of the weights, for the metadata.
        options: the user's choices.
        on_frame: called after every frame.

    Raises:
        InputError: a frame cannot be read (unless ``keep_going``), the options do not fit the sequence, or ``out`` holds frames of an
            earlier run and neither ``resume`` nor ``overwrite`` is set.
    """
    rendered = choose_rendered(sequence.numbers, sequence.rendered, options.rendered)
    numbers = _numbers(sequence, options.frames)
    _require_near(sequence, sequence.numbers[0] if backend.accumulates else numbers[0], numbers[-1])
    if backend.accumulates and options.resume:
        what = "--skip bounded" if backend.method == NETWORK else backend.method
        raise InputError(f"--resume: {what} makes each output of all before it; run it anew, with --overwrite")
    curve = transfer(options.transfer)
    metadata = {
        "stss:version": VERSION,
        "stss:spec": SPEC_VERSION,
        "stss:method": backend.method,
        "stss:weights": weights_id,
        "stss:backend": backend.name,
        "stss:transfer": options.transfer,
        "stss:depth": options.depth,
        "stss:profile": sequence.profile.name,
    }
    keys = Keys(sequence, rendered, {**metadata, "format": options.format, "read": sequence.settings})
    job = _Job(Window(sequence, rendered, curve, options.depth), keys, backend, curve, out, options, metadata, rendered)
    if options.show_skipped and backend.cost is None:
        raise InputError(f"--show-skipped: expected the network on the backend cl, got {backend.method} on {backend.name}")
    _claim(out, options)
    if backend.accumulates:
        for number in range(sequence.numbers[0], numbers[0]):
            job.compute(job.read(number))

    summary = Summary([])

    def done(report: FrameReport) -> None:
        summary.frames.append(report)
        on_frame(report)

    def meanwhile() -> None:
        if not options.resume:  # then perhaps nothing is left to compute
            backend.expect(sequence.size)

    overlap(numbers, job.read, job.compute, job.write, done, meanwhile)
    return summary


@dataclass(frozen=True)
class _Read:
    """What one output is made of, and its key."""

    key: str
    window: list[DisplayFrame]


@dataclass(frozen=True)
class _Computed:
    """What the backend made of it: ``image`` (2H, 2W, 3) display-referred, ``valid`` (H, W)."""

    number: int
    key: str
    kind: FrameKind
    image: Image
    valid: Mask
    cost: Cost | None
    activity: Array | None


@dataclass(frozen=True)
class _Job:
    """The steps of one frame, in three threads, and what stays the same from frame to frame of one ``run``.

    A step whose frame is settled already, kept or left out, hands on the report.
    """

    window: Window
    keys: Keys
    backend: Backend
    curve: Transfer
    out: Path
    options: RunOptions
    metadata: dict[str, str]
    rendered: frozenset[int]

    def read(self, number: int) -> _Read | FrameReport:
        """Read what display frame ``number`` is made of, unless it is kept; nothing else touches ``window`` and ``keys``."""
        try:
            key = self.keys.of(number)
            if self.options.resume and (kind := self._kept(number, key)):
                return FrameReport(number, kind, "kept")
            return _Read(key, self.window.up_to(number, keep_going=self.options.keep_going))
        except InputError as error:
            if not self.options.keep_going:
                raise
            return FrameReport(number, None, "left out", str(error), fault=True)

    def compute(self, read: _Read | FrameReport) -> _Computed | FrameReport:
        """Compute it, or say why not; nothing else touches ``backend``."""
        if isinstance(read, FrameReport):
            return read
        number, planned = read.window[-1].number, plan(read.window)
        if planned is None:
            # At the start of a sequence this is how it must be; later on it is the work of a frame that could not be read.
            reason = f"frame {number}: no rendered frame just before it to extrapolate from"
            return FrameReport(number, FrameKind.EF, "left out", reason, fault=schedule(number, self.rendered) is not None)
        image, valid = self.backend.compute(read.window, planned.steps)
        activity = self.backend.activity if self.options.show_skipped else None
        return _Computed(number, read.key, planned.kind, image, valid, self.backend.cost, activity)

    def write(self, made: _Computed | FrameReport) -> FrameReport:
        """Take it back through the transfer and write its files."""
        if isinstance(made, FrameReport):
            return made
        output = Output(made.number, made.kind, self.curve.decode(made.image), made.valid)
        if made.activity is not None:
            write_rgb(frame_path(self.out / SKIPPED, made.number, "png"), picture(made.image, made.activity))
        write_output(output, self.out, self.options.format, self.curve, {**self.metadata, "stss:key": made.key})
        return FrameReport(made.number, made.kind, "done", cost=made.cost)

    def _kept(self, number: int, key: str) -> FrameKind | None:
        """The kind of the frame that an earlier run wrote, if it is what this run would write."""
        try:
            found = read_header(frame_path(self.out, number, self.options.format)).attributes
        except InputError:
            return None
        if found.get("stss:key") != key:
            return None
        kind = FrameKind(found["stss:kind"])
        return kind if kind is FrameKind.SF or frame_path(self.out / "holes", number, "png").exists() else None


def write_output(output: Output, out: Path, suffix: str, curve: Transfer, metadata: dict[str, str]) -> None:
    """Write one output and, for an EF, its holes; the image last, for it is what says that the frame is done."""
    if output.kind is FrameKind.EF:
        write_mask(frame_path(out / "holes", output.number, "png"), ~output.valid)
    image = curve.display(output.image) if suffix == "png" else output.image
    metadata = {**metadata, "stss:frame": str(output.number), "stss:kind": output.kind.value}
    write_rgb(frame_path(out, output.number, suffix), image, metadata=metadata)


def frame_path(folder: Path, number: int, suffix: str) -> Path:
    """Where a frame's file goes."""
    return folder / f"frame.{number:04d}.{suffix}"


def _numbers(sequence: Sequence, frames: tuple[int, int] | None) -> range:
    first, last = sequence.numbers[0], sequence.numbers[-1]
    if frames is None:
        return range(first, last + 1)
    if not first <= frames[0] <= frames[1] <= last:
        raise InputError(
            f"--frames {frames[0]}:{frames[1]}: expected to lie within {first}:{last}, the frames of {sequence.path}"
        )
    return range(frames[0], frames[1] + 1)


def _require_near(sequence: Sequence, first: int, last: int) -> None:
    """Raise InputError where frames lie so far apart that they belong to no one sequence: each between would be reported."""
    for a, b in pairwise(sequence.numbers):
        if b - a - 1 > MAX_GAP and a < last and b > first:
            raise InputError(f"{sequence.path}: no frame between {a} and {b}; expected gaps of at most {MAX_GAP}")


def _claim(out: Path, options: RunOptions) -> None:
    """Make the folder; refuse to mix with what an earlier run finished, remove what it left half-written."""
    folders = (out, out / "holes", out / SKIPPED)
    try:
        for folder in folders[: 2 + options.show_skipped]:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made a folder: {error.strerror}") from None
    finished = _matching(r"frame\.\d+\.(exr|png)", *folders)
    if finished and not (options.resume or options.overwrite):
        raise InputError(f"{out}: holds frames of an earlier run; --resume keeps what is still right, --overwrite replaces all")
    unfinished = _matching(r"\.frame\.\d+\.[0-9a-f]{12}\.(exr|png)", *folders)
    for path in unfinished + (finished if options.overwrite else []):
        path.unlink()


def _matching(pattern: str, *folders: Path) -> list[Path]:
    return [path for folder in folders if folder.is_dir() for path in folder.iterdir() if re.fullmatch(pattern, path.name)]
