# SPDX-License-Identifier: MIT
"""One display frame from its files to its output's files, in steps that three threads share."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from stss.frames.backends import Backend
from stss.frames.display_frame import WINDOW, DisplayFrame
from stss.frames.output import Output, compute, shot_start
from stss.frames.static_holes import static_holes
from stss.images.color import Transfer, transfer
from stss.images.headers import Value, read_header
from stss.images.read_write import encode_mask, encode_rgb
from stss.images.windows import PixelWindow
from stss.run.options import RunOptions
from stss.run.pipeline import overlap
from stss.run.window import Keys, Window
from stss.sequence.sequence import Sequence
from stss_cl.cost import Cost
from stss_ground.errors import InputError
from stss_ground.output.folder import SUMS, OutputFolder
from stss_ground.version import VERSION
from stss_ref import SPEC_VERSION
from stss_ref.schedule import FrameKind

HOLES = "holes"
"""Subfolder of the run's folder: the warping holes."""
SETTINGS = ("spec", "method", "weights", "transfer", "highlights", "depth", "profile", "background", "static")
"""The entries of a frame's metadata that all frames of one run have in common."""
STATIC_HOLES = "stss:static-holes"
"""Metadata of an EF: `stss.frames.static_holes.static_holes`."""
Outcome = Literal["done", "kept", "left out"]


@dataclass(frozen=True)
class FrameReport:
    """The outcome of one display frame.

    Attributes:
        number: the frame.
        kind: SF, EF; None if unknown.
        outcome: see ``Outcome``.
        reason: why it was left out.
        fault: it was left out because of a fault.
        cost: of its computation.
        peak: the largest value of its image.
        static_holes: the share of its static surfaces that are holes; None for an SF, or where nothing static is seen.
    """

    number: int
    kind: FrameKind | None
    outcome: Outcome
    reason: str = ""
    fault: bool = False
    cost: Cost | None = None
    peak: float = 0.0
    static_holes: float | None = None


class Sink(Protocol):
    """A receiver of files, such as ``stss_ground.output.folder.OutputFolder``."""

    @property
    def path(self) -> Path:
        """The folder, for messages and suffixes."""
        ...

    def write(self, name: str, data: bytes) -> None:
        """Take the file ``name``, its place below the folder."""
        ...


@dataclass(frozen=True)
class _Job:
    """The display frames that one output depends on, and the output's key."""

    key: str
    window: list[DisplayFrame]
    attributes: Mapping[str, Value]


@dataclass(frozen=True)
class _Result:
    """One output as the backend computed it."""

    key: str
    output: Output
    cost: Cost | None
    static_holes: float | None
    attributes: Mapping[str, Value]


@dataclass(frozen=True)
class FrameJob:
    """The steps of one frame, in three threads, and the constants of one run.

    If a frame is already kept or left out, the later steps only pass on its report.
    """

    window: Window
    keys: Keys
    backend: Backend
    curve: Transfer
    sink: Sink
    options: RunOptions
    metadata: dict[str, str]
    rendered: frozenset[int]
    windows: tuple[PixelWindow, PixelWindow]
    """The frames' canvas and display window, see `Sequence`."""
    already_written: Callable[[int, str], FrameKind | None]
    """Takes a frame's number and key; returns its kind where an earlier run finished it, else None."""

    @classmethod
    def of(
        cls,
        sequence: Sequence,
        rendered: frozenset[int],
        options: RunOptions,
        backend: Backend,
        weights: str,
        sink: Sink,
        already_written: Callable[[int, str], FrameKind | None],
    ) -> FrameJob:
        """Make the job and the parts that follow from its arguments; ``weights`` is the label of the weights."""
        curve = transfer(options.transfer)
        metadata = describe(sequence, options, backend.method, backend.name, weights)
        window = backend.window or WINDOW
        keys = keys_of(sequence, rendered, options, metadata, window)
        return cls(
            Window(sequence, rendered, curve, options, window),
            keys,
            backend,
            curve,
            sink,
            options,
            metadata,
            rendered,
            (sequence.canvas, sequence.display),
            already_written,
        )

    def run(self, numbers: deque[int], size: tuple[int, int]) -> Generator[FrameReport, None, None]:
        """Take frames through all steps, and yield the report of each in turn; see ``stss.run.pipeline.overlap``.

        Args:
            numbers: display frames; more may be added meanwhile.
            size: (H, W) of the inputs.
        """

        def meanwhile() -> None:
            if not self.options.resume:  # with it, perhaps no frame is left to compute
                self.backend.expect(size)

        return overlap(numbers, self.read, self.compute, self.write, meanwhile)

    def read(self, number: int) -> _Job | FrameReport:
        """Read the frames that display frame ``number`` depends on, unless it is kept; only this step uses ``window`` and ``keys``."""
        try:
            key = self.keys.of(number)
            if (kind := self.already_written(number, key)) is not None:
                return FrameReport(number, kind, "kept")
            window = self.window.up_to(number, keep_going=self.options.keep_going)
            return _Job(key, window, self.window.attributes(window))
        except InputError as error:
            if not self.options.keep_going:
                raise
            return FrameReport(number, None, "left out", str(error), fault=True)

    def compute(self, job: _Job | FrameReport) -> _Result | FrameReport:
        """Compute it, or report the reason why not; only this step uses ``backend``."""
        if isinstance(job, FrameReport):
            return job
        output = compute(job.window, self.backend, self.curve)
        if output is None:
            number = job.window[-1].number
            reason = f"frame {number}: no rendered frame just before it to extrapolate from"
            if number == shot_start(number, number - WINDOW, self.options.cuts):
                reason = f"frame {number}: the first of a shot, and not rendered: nothing to make it from"
            # Before the first rendered frame of a shot this is expected; later on the film has a hole.
            start = shot_start(number, min(self.rendered), self.options.cuts)
            fault = any(n in self.rendered for n in range(start, number))
            return FrameReport(number, FrameKind.EF, "left out", reason, fault=fault)
        newest = job.window[-1]
        share = static_holes(newest.stencil, newest.gbuffer[..., :3], output.valid) if output.kind is FrameKind.EF else None
        return _Result(job.key, output, self.backend.cost, share, job.attributes)

    def write(self, job: _Result | FrameReport) -> FrameReport:
        """Write its files."""
        if isinstance(job, FrameReport):
            return job
        output = job.output
        if output.kind is FrameKind.EF:
            name = frame_name(output.number, "png", HOLES)
            canvas, display = self.windows
            self.sink.write(name, encode_mask(self.sink.path / name, ~output.valid[display.within(canvas)]))
        # The image last: its presence means that the frame is done.
        canvas, display = (window.doubled for window in self.windows)
        image = output.image
        if self.options.format == "png":  # which has no windows
            image = self.curve.display(image[display.within(canvas)])
        metadata: dict[str, Value] = {"stss:key": job.key, "stss:frame": str(output.number), "stss:kind": output.kind.value}
        more = {name: plane[..., 0] for name, plane in output.carried.items()} if self.options.format == "exr" else {}
        metadata |= {**self.metadata, **job.attributes}
        if job.static_holes is not None:
            metadata[STATIC_HOLES] = f"{job.static_holes:.4f}"
        name = frame_name(output.number, self.options.format)
        self.sink.write(name, encode_rgb(self.sink.path / name, image, metadata=metadata, more=more, windows=(canvas, display)))
        peak = float(output.image.max())
        return FrameReport(output.number, output.kind, "done", cost=job.cost, peak=peak, static_holes=job.static_holes)


def describe(sequence: Sequence, options: RunOptions, method: str, backend: str, weights: str) -> dict[str, str]:
    """The metadata that every file of a run carries."""
    return {
        "stss:version": VERSION,
        "stss:spec": SPEC_VERSION,
        "stss:method": method,
        "stss:weights": weights,
        "stss:backend": backend,
        "stss:transfer": options.transfer,
        "stss:highlights": "carried past the network" if transfer(options.transfer).clips else "as the transfer has them",
        "stss:depth": options.depth,
        "stss:profile": sequence.profile.name,
        **{
            f"stss:{name}": "motion from the camera"
            for name, source in (("background", sequence.background), ("static", sequence.static))
            if source == "camera"
        },
    }


def keys_of(sequence: Sequence, rendered: frozenset[int], options: RunOptions, metadata: dict[str, str], window: int) -> Keys:
    """The keys of a run whose files have this metadata, and whose outputs depend on ``window`` display frames."""
    settings: dict[str, object] = {**metadata, "format": options.format, "also": options.also, "read": sequence.settings}
    return Keys(sequence, rendered, options.cuts, settings, window)


def already_written(folder: OutputFolder, options: RunOptions, number: int, key: str) -> FrameKind | None:
    """The kind of a frame whose files an earlier run wrote, byte for byte as this run would write them.

    None if there are no such files, or if this run does not resume.
    """
    name = frame_name(number, options.format)
    if not options.resume or not folder.holds(name):
        return None
    try:
        attributes = read_header(folder.path / name).attributes
        kind = FrameKind(attributes.get("stss:kind"))
    except (InputError, ValueError):  # somebody edited both the file and the list
        return None
    if attributes.get("stss:key") != key:
        return None
    return kind if kind is FrameKind.SF or folder.holds(frame_name(number, "png", HOLES)) else None


def settings_of(metadata: Mapping[str, Value], suffix: str, names: tuple[str, ...] = SETTINGS) -> dict[str, str]:
    """The entries that all frames of one run have in common, by the metadata of a frame and its file's suffix, without a dot."""
    return {name: str(metadata.get(f"stss:{name}", "none")) for name in names} | {"format": suffix}


def keep_outside(folder: OutputFolder, options: RunOptions) -> None:
    """Let ``--overwrite`` of some frames leave those of an earlier run that lie outside of them; ``folder`` is open."""
    for name in folder.sums():
        if options.frames is not None and not options.frames[0] <= number_of(name) <= options.frames[1]:
            folder.keep(name)


def require_one_run(folder: OutputFolder, options: RunOptions, metadata: Mapping[str, Value]) -> None:
    """Refuse ``--overwrite`` of some frames where those outside of them were made with other settings.

    Args:
        folder: the run's; nothing is written.
        options: the user's choices.
        metadata: of the frames to write, see `describe`; empty entries are not compared.

    Raises:
        InputError: one has other settings: the film would change its look within a shot.
    """
    if options.frames is None or not options.overwrite:
        return
    first, last = options.frames
    for path, other in _other_settings(folder, options, metadata, SETTINGS):
        if not first <= number_of(path.name) <= last:
            raise InputError(
                f"{path}: {other}: --overwrite --frames {first}:{last} would mix two runs; expected the settings of the earlier one, "
                "another folder, or --overwrite without --frames, which replaces all"
            )


def reason_to_replace(folder: OutputFolder, options: RunOptions, metadata: Mapping[str, Value]) -> str:
    """Why ``--resume`` makes frames again: the first one with another setting, and which; empty where there is none.

    Takes what `require_one_run` takes.
    """
    first, last = options.frames or (-math.inf, math.inf)
    others = _other_settings(folder, options, metadata, (*SETTINGS, "backend", "version")) if options.resume else ()
    return next((f"{path}: {other}" for path, other in others if first <= number_of(path.name) <= last), "")


def _other_settings(
    folder: OutputFolder, options: RunOptions, metadata: Mapping[str, Value], names: tuple[str, ...]
) -> Iterator[tuple[Path, str]]:
    """The frames of the folder that were made with other settings of these ``names`` than ``metadata``, each with the first of them."""
    own = settings_of(metadata, options.format, names)
    for path in folder.present():
        if path.parent != folder.path or path.name == SUMS:
            continue
        try:
            attributes = read_header(path).attributes
        except InputError:
            attributes = {}
        if "stss:key" not in attributes:  # somebody else's, which the folder tells
            continue
        theirs = settings_of(attributes, path.suffix[1:], names)
        if other := [f"{key} {theirs[key]}, not {value}" for key, value in own.items() if value not in ("", theirs[key])]:
            yield path, other[0]


def number_of(name: str) -> int:
    """The display frame of a file below the run's folder; see `frame_name`."""
    return int(name.split(".")[-2])


def frame_name(number: int, suffix: str, subfolder: str = "") -> str:
    """The path of a frame's file below the run's folder."""
    return f"{subfolder}/frame.{number:04d}.{suffix}".lstrip("/")
