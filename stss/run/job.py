# SPDX-License-Identifier: MIT
"""The main job: a sequence of files in, a folder of files out, one display frame after the other.

While one frame is computed the files of the next are read and the one before is written, each in a thread of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from stss.color import Transfer, transfer
from stss.errors import InputError
from stss.frames.backends import NETWORK, Backend, Cost
from stss.frames.display_frame import DisplayFrame
from stss.frames.supersample import Output, choose_rendered, compute, decoded
from stss.images.read_write import encode_mask, encode_rgb, read_header
from stss.output.apart import require_apart
from stss.output.folder import OutputFolder
from stss.output.write_whole import told
from stss.run.pipeline import overlap
from stss.run.skip_report import picture
from stss.run.window import Keys, Window
from stss.sequence.profiles import Profile
from stss.sequence.reader import Sequence
from stss.version import VERSION
from stss_ref import SPEC_VERSION
from stss_ref.arrays import Array, Image
from stss_ref.depth import DepthMode
from stss_ref.schedule import FrameKind, schedule

MAX_GAP = 1000
"""Display frames that may be missing in a row."""
HOLES, SKIPPED = "holes", "skipped"
"""Below the run's folder: the warping holes; pictures of what was computed."""
_REFUSAL = "holds frames of an earlier run; --resume keeps what is still right, --overwrite replaces all"
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
        overwrite: replace the files of an earlier run one by one; remove the rest of them once all are written.
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
    weights: str,
    options: RunOptions,
    on_frame: Callable[[FrameReport], None] = lambda report: None,
    reads: Iterable[Path] = (),
) -> Summary:
    """Write ``out/frame.NNNN.exr`` (or ``.png``) for every display frame, and ``out/holes/frame.NNNN.png`` for every EF.

    A file is complete or not there: see ``stss.output``.

    Args:
        sequence: what to read.
        out: the folder to write to; made if need be.
        backend: what computes.
        weights: their label, for the metadata.
        options: the user's choices.
        on_frame: called after every frame.
        reads: files that must not be written to, besides those of the sequence.

    Raises:
        InputError: a frame cannot be read (unless ``keep_going``), the options do not fit the sequence, a file that is read would be
            written to, another process writes to ``out``, it holds frames of others, or those of an earlier run and neither
            ``resume`` nor ``overwrite`` is set.
    """
    if options.resume and options.overwrite:
        raise InputError("--resume, --overwrite: expected one of them: keep what an earlier run finished, or replace it")
    rendered = choose_rendered(sequence.numbers, sequence.rendered, options.rendered)
    numbers = _numbers(sequence, options.frames)
    require_near(sequence, sequence.numbers[0] if backend.accumulates else numbers[0], numbers[-1])
    if backend.accumulates and options.resume:
        what = "--skip bounded" if backend.method == NETWORK else backend.method
        raise InputError(f"--resume: {what} makes each output of all before it; run it anew, with --overwrite")
    curve = transfer(options.transfer)
    metadata = {
        "stss:version": VERSION,
        "stss:spec": SPEC_VERSION,
        "stss:method": backend.method,
        "stss:weights": weights,
        "stss:backend": backend.name,
        "stss:transfer": options.transfer,
        "stss:depth": options.depth,
        "stss:profile": sequence.profile.name,
    }
    keys = Keys(sequence, rendered, {**metadata, "format": options.format, "read": sequence.settings})
    folder = OutputFolder(out, ("", HOLES, SKIPPED), r"frame\.\d+\.(exr|png)")
    job = _Job(Window(sequence, rendered, curve, options.depth), keys, backend, curve, folder, options, metadata, rendered)
    if options.show_skipped and backend.cost is None:
        raise InputError(f"--show-skipped: expected the network on the backend cl, got {backend.method} on {backend.name}")
    with told(out):
        require_apart(folder.present(), [*sequence.reads, *reads])
    with folder.opened(refusal=None if options.resume or options.overwrite else _REFUSAL):
        if backend.accumulates:
            for number in range(sequence.numbers[0], numbers[0]):
                job.compute(job.read(number))
        summary = job.run(numbers, sequence.size, on_frame)
        folder.finish(remove_others=options.overwrite)
    return summary


@dataclass(frozen=True)
class _Read:
    """What one output is made of, and its key."""

    key: str
    window: list[DisplayFrame]


@dataclass(frozen=True)
class _Computed:
    """What the backend made of it, display-referred."""

    key: str
    output: Output
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
    folder: OutputFolder
    options: RunOptions
    metadata: dict[str, str]
    rendered: frozenset[int]

    def run(self, numbers: range, size: tuple[int, int], on_frame: Callable[[FrameReport], None]) -> Summary:
        """Take all frames through all steps; ``size`` is (H, W) of the inputs."""
        summary = Summary([])

        def done(report: FrameReport) -> None:
            summary.frames.append(report)
            on_frame(report)

        def meanwhile() -> None:
            if not self.options.resume:  # then perhaps nothing is left to compute
                self.backend.expect(size)

        overlap(numbers, self.read, self.compute, self.write, done, meanwhile)
        return summary

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
        output = compute(read.window, self.backend)
        if output is None:
            number = read.window[-1].number
            # At the start of a sequence this is how it must be; later on it is the work of a frame that could not be read.
            reason = f"frame {number}: no rendered frame just before it to extrapolate from"
            return FrameReport(number, FrameKind.EF, "left out", reason, fault=schedule(number, self.rendered) is not None)
        activity = self.backend.activity if self.options.show_skipped else None
        return _Computed(read.key, output, self.backend.cost, activity)

    def write(self, made: _Computed | FrameReport) -> FrameReport:
        """Take it back through the transfer and write its files."""
        if isinstance(made, FrameReport):
            return made
        output = decoded(made.output, self.curve)
        if made.activity is not None:
            self._write_rgb(frame_name(output.number, "png", SKIPPED), picture(made.output.image, made.activity), {})
        if output.kind is FrameKind.EF:
            name = frame_name(output.number, "png", HOLES)
            self.folder.write(name, encode_mask(self.folder.path / name, ~output.valid))
        # The image last: it is what says that the frame is done.
        image = self.curve.display(output.image) if self.options.format == "png" else output.image
        metadata = {"stss:key": made.key, "stss:frame": str(output.number), "stss:kind": output.kind.value}
        self._write_rgb(frame_name(output.number, self.options.format), image, {**self.metadata, **metadata})
        return FrameReport(output.number, output.kind, "done", cost=made.cost)

    def _write_rgb(self, name: str, image: Image, metadata: dict[str, str]) -> None:
        self.folder.write(name, encode_rgb(self.folder.path / name, image, metadata=metadata))

    def _kept(self, number: int, key: str) -> FrameKind | None:
        """The kind of the frame that an earlier run wrote, if all its files are what this run would write, to the last byte."""
        name = frame_name(number, self.options.format)
        if not self.folder.holds(name):
            return None
        found = read_header(self.folder.path / name).attributes
        if found.get("stss:key") != key:
            return None
        kind = FrameKind(found["stss:kind"])
        beside = ([HOLES] if kind is FrameKind.EF else []) + ([SKIPPED] if self.options.show_skipped else [])
        return kind if all(self.folder.holds(frame_name(number, "png", where)) for where in beside) else None


def frame_name(number: int, suffix: str, subfolder: str = "") -> str:
    """Where a frame's file lies below the run's folder."""
    return f"{subfolder}/frame.{number:04d}.{suffix}".lstrip("/")


def _numbers(sequence: Sequence, frames: tuple[int, int] | None) -> range:
    first, last = sequence.numbers[0], sequence.numbers[-1]
    if frames is None:
        return range(first, last + 1)
    if not first <= frames[0] <= frames[1] <= last:
        raise InputError(
            f"--frames {frames[0]}:{frames[1]}: expected to lie within {first}:{last}, the frames of {sequence.path}"
        )
    return range(frames[0], frames[1] + 1)


def require_near(sequence: Sequence, first: int, last: int) -> None:
    """Raise InputError where frames lie so far apart that they belong to no one sequence: each between would be reported."""
    for a, b in pairwise(sequence.numbers):
        if b - a - 1 > MAX_GAP and a < last and b > first:
            raise InputError(f"{sequence.path}: no frame between {a} and {b}; expected gaps of at most {MAX_GAP}")
