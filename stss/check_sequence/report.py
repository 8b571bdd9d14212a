# SPDX-License-Identifier: MIT
"""Check a sequence against its profile, before hours are spent on it."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Any, cast

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from stss.check_sequence.alignment import alignment_lines
from stss.check_sequence.camera import camera_lines
from stss.check_sequence.motion_convention import judge_motion
from stss.check_sequence.static_positions import judge_static_geometry
from stss.check_sequence.value_statistics import Level, Line, Values, motion_lines
from stss.images.headers import read_header
from stss.sequence.antialiasing import judge_sampling
from stss.sequence.background import CameraError
from stss.sequence.channels import MissingBuffersError
from stss.sequence.choose_weights import weights_for
from stss.sequence.find_profile import frames_of, settle_profile
from stss.sequence.profiles import BUFFERS
from stss.sequence.raw_frame import NonFinite
from stss.sequence.reader import SequenceOptions
from stss.sequence.sequence import Sequence
from stss_ground.errors import InputError
from stss_ground.machine import available_threads
from stss_ground.progress import show_steps, track
from stss_ground.terminal import printable

PAIRS = 3
"""Number of pairs of neighbouring frames that are read."""
LOOKS = 5
"""Steps of looking at pixels, each of which reads the pairs."""
KEPT_BYTES = 1 << 30
"""Frames in memory: each of the looks takes much the same ones, and reading is most of the time."""
MOST_LISTED = 8
"""Most frame numbers that a line lists."""
BYTES_PER_PIXEL = 20
"""Of an input pixel: four pixels of three halves, compressed by zip."""
START = 3.0
"""Seconds until a process computes its first frame, with kernels that are compiled: imports, weights, the device."""
SECONDS_PER_PIXEL = 1.3e-6
"""Of one core, from files to files: 0.7 s for 984 x 552 (docs/benchmarks.md)."""


@dataclass(frozen=True)
class CheckFinding:
    """One line of the report."""

    level: Level
    text: str


@dataclass(frozen=True)
class CheckReport:
    """The findings of a check.

    Attributes:
        findings: the most serious first; among equals, the likeliest cause first.
        tables: the same as numbers, ready for JSON.
    """

    findings: tuple[CheckFinding, ...]
    tables: Mapping[str, object]

    @property
    def status(self) -> int:
        """0: fine; 1: warnings; 2: it cannot run."""
        levels = {finding.level for finding in self.findings}
        return 2 if "error" in levels else 1 if "warning" in levels else 0

    def to_json(self) -> str:
        """Status, findings and tables as JSON, which has no infinity: such a number is the text "inf", one that is none "nan"."""
        findings = [dataclasses.asdict(finding) for finding in self.findings]
        return json.dumps(_plain({"status": self.status, "findings": findings, **self.tables}), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    """A table's entries with numbers that are not finite as text."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def check(
    sequence_path: str | Path,
    reading: SequenceOptions,
    *,
    frames: tuple[int, int] | None = None,
    all_values: bool = False,
    console: Console | None = None,
) -> CheckReport:
    """Check a sequence's frames, buffers, conventions and values.

    Args:
        sequence_path: folder or pattern, see `stss.sequence.reader.open_sequence`.
        reading: how to read it; ``non_finite`` "refuse" makes values that are not finite an error, "mask" a warning.
        frames: first and last display frame to check; None: all.
        all_values: look at the values of all these frames; False: only of those that are read for motion and positions, at most six.
        console: shows the progress; None: no progress.

    Raises:
        InputError: the profile cannot be read, or ``frames`` names none of the sequence. Any other fault is a finding.
    """
    console = console or Console(quiet=True)
    table = settle_profile(Path(sequence_path), reading.profile)
    findings: list[CheckFinding] = []
    if reading.profile is None:
        findings.append(CheckFinding("note", f"profile: {table.name}, by the channels' names; --profile takes another"))
    tables: dict[str, object] = {"profile": table.name}
    try:
        all_numbers = sorted(frames_of(Path(sequence_path), table))
        findings += missing_frames(all_numbers)
        bar = partial(track, console=console, text="reading headers")
        sequence = replace(reading, profile=table, non_finite="mask").open(sequence_path, bar, keep_going=True)
        sequence.keeps = KEPT_BYTES
        numbers = [n for n in sequence.numbers if frames is None or frames[0] <= n <= frames[1]]
        if not numbers:
            first, last = frames or (0, 0)
            raise InputError(
                f"--frames {first}:{last}: expected frames of {sequence_path}, {all_numbers[0]} to {all_numbers[-1]}"
            )
        findings += broken_frames(sequence, numbers)
        numbers = [n for n in numbers if sequence.frames[n].fault is None]
        if not numbers:
            raise InputError(f"{sequence_path}: none of these frames can be read")
        findings += missing_buffers(sequence, numbers)
        findings += [CheckFinding("warning", text) for text in sequence.notes]
        findings += data_windows(sequence, numbers)
        tables |= {"size": list(sequence.size), "frames": _frame_table(sequence, numbers)}
        tables["summary"] = summary(numbers, sequence.size)
        findings += _storage(sequence, numbers, tables)
        with show_steps(console, LOOKS) as begin:
            findings += _pixels(sequence, numbers, reading.non_finite, tables, begin, all_values=all_values)
            begin("sampling")
            sampling = judge_sampling(sequence)
        tables["sampling"] = dataclasses.asdict(sampling)
        how = "antialiased" if sampling.antialiased else "aliased, one sample a pixel"
        findings.append(
            CheckFinding("note", f"sampling: {how} ({sampling.reason}); stss run takes the weights {weights_for(sampling)}")
        )
    except MissingBuffersError as error:
        findings += [CheckFinding("error", text) for text in error.each]
        findings.append(CheckFinding("note", f"channels: {error.channels}"))
    except InputError as error:
        findings.append(CheckFinding("error", str(error)))
    order: dict[Level, int] = {"error": 0, "warning": 1, "note": 2}
    return CheckReport(tuple(sorted(findings, key=lambda finding: order[finding.level])), tables)


def summary(numbers: list[int], size: tuple[int, int]) -> str:
    """Frames, sizes, and an estimate of the run's space and time."""
    height, width = size
    pixels = len(numbers) * height * width
    space, seconds = pixels * BYTES_PER_PIXEL / 2**20, START + pixels * SECONDS_PER_PIXEL / available_threads()
    return (
        f"frames {numbers[0]} to {numbers[-1]}, {width} x {height} in, {2 * width} x {2 * height} out; "
        f"about {max(1, round(space))} MiB of files, and {timedelta(seconds=round(seconds))} on this processor"
    )


def missing_frames(numbers: list[int]) -> list[CheckFinding]:
    """Display frames that have no file at all: the likeliest reason why a sequence cannot be run."""
    count = numbers[-1] - numbers[0] + 1 - len(numbers)
    if not count:
        return []
    steps = {b - a for a, b in pairwise(numbers)}
    if len(steps) == 1:
        first = ", ".join(str(n) for n in numbers[:3])
        text = (
            f"frames step by {steps.pop()} ({first}, ...): the display frames between are not there. Only the colour "
            "may come at half rate: render G-buffer and motion of every display frame, motion to the one just before"
        )
        return [CheckFinding("error", text)]
    missing = chain.from_iterable(range(a + 1, b) for a, b in pairwise(numbers))  # lazily: numbers may lie far apart
    verb = "is" if count == 1 else "are"
    text = f"display {_frames(islice(missing, MOST_LISTED), count)} {verb} not there: every one needs its G-buffer and motion"
    return [CheckFinding("error", text)]


def broken_frames(sequence: Sequence, numbers: list[int]) -> list[CheckFinding]:
    """Frames whose files cannot be read, or do not fit the others."""
    faults = [fault for n in numbers if (fault := sequence.frames[n].fault)]
    findings = [CheckFinding("error", str(fault)) for fault in faults[:MOST_LISTED]]
    if (more := len(faults) - MOST_LISTED) > 0:
        findings.append(CheckFinding("error", f"{more} more frames cannot be read, or do not fit the others"))
    return findings


def missing_buffers(sequence: Sequence, numbers: list[int]) -> list[CheckFinding]:
    """Buffers that some frames have and others lack; and which frames have a colour."""
    findings: list[CheckFinding] = []
    lacking: dict[tuple[int, ...], list[str]] = {}
    for buffer in BUFFERS:
        missing = tuple(n for n in numbers if not sequence.has(n, buffer))
        if missing and buffer != "color":
            lacking.setdefault(missing, []).append(buffer)
    for missing, buffers in lacking.items():
        text = f"{', '.join(buffers)}: not there in {_frames(missing, len(missing))}; every display frame needs its own, rendered or not"
        findings.append(CheckFinding("error", text))
    rendered = sorted(sequence.rendered.intersection(numbers))
    if rendered == numbers:
        findings.append(_every_color(sequence, numbers))
    elif rendered and rendered == [n for n in numbers if (n - rendered[0]) % 2 == 0 and n >= rendered[0]]:
        findings.append(CheckFinding("note", f"colour: every second frame from {rendered[0]} on"))
    else:
        listing = _frames(rendered, len(rendered)) if rendered else "none"
        text = f"colour: expected every frame or every second one; found {listing}"
        # A recorder counts the frames that it writes.
        if len(rendered) > 1 and rendered[-1] - rendered[0] == len(rendered) - 1 and abs(2 * len(rendered) - len(numbers)) <= 1:
            own = ", ".join(str(n) for n in numbers[:5:2])
            text += f"; if they are numbered one by one at half rate, give each the number of its display frame: {own}, ..."
        findings.append(CheckFinding("warning", text))
    return findings


def data_windows(sequence: Sequence, numbers: list[int]) -> list[CheckFinding]:
    """Frames whose data window differs from the display window."""
    findings: list[CheckFinding] = []
    canvas, display = sequence.canvas, sequence.display
    cropped = [n for n in numbers if any(not window.mask(canvas).all() for window in set(sequence.frames[n].data.values()))]
    if canvas != display:
        around = (display.x - canvas.x, display.y - canvas.y)
        around += canvas.width - display.width - around[0], canvas.height - display.height - around[1]
        left, top, right, bottom = around
        text = f"overscan: {left} pixels left, {right} right, {top} above, {bottom} below; it is read and computed, too"
        findings.append(CheckFinding("note", text))
    if cropped:
        text = f"data windows: cropped in {_frames(cropped, len(cropped))}; nothing was hit outside"
        findings.append(CheckFinding("note", text))
    return findings


def _every_color(sequence: Sequence, numbers: list[int]) -> CheckFinding:
    """Whether every second frame has a colour of fewer samples: it was rendered only for its G-buffer, and a run must not show it."""
    own, others = ({_samples(sequence, n) for n in numbers[start::2]} for start in (0, 1))
    if own == others or 0 in own | others or not others:
        return CheckFinding("note", "colour: in every frame; a half-rate run uses every second one")
    if max(others) < min(own):
        few, many = max(others), min(own)
        text = f"colour: every second frame from {numbers[0]} on; the others are G-buffer frames, of {few} samples in place of {many}"
        return CheckFinding("note", text)
    if max(own) < min(others):
        text = f"colour: half of the frames are G-buffer frames, of {max(own)} samples in place of {min(others)}, {numbers[0]} among them"
        return CheckFinding("warning", f"{text}; say --rendered {'odd' if numbers[0] % 2 == 0 else 'even'}")
    counts = ", ".join(map(str, sorted(own | others)))
    return CheckFinding("warning", f"colour: frames of different numbers of samples ({counts}), not every second one")


def _samples(sequence: Sequence, number: int) -> int:
    """Samples a pixel by the metadata of Cycles; 0 where there is none."""
    attributes = read_header(sequence.frames[number].sources["color"].path).attributes
    counts = [str(value) for name, value in attributes.items() if re.fullmatch(r"cycles\..*\.samples", name)]
    return int(counts[0]) if counts and counts[0].isdecimal() and len(counts[0]) < 10 else 0


def _frames(numbers: Iterable[int], count: int) -> str:
    """The first of ``count`` frames, as text."""
    more = f", ... ({count} in all)" if count > MOST_LISTED else ""
    return f"frame{'' if count == 1 else 's'} {', '.join(str(n) for n in islice(numbers, MOST_LISTED))}{more}"


def _frame_table(sequence: Sequence, numbers: list[int]) -> dict[str, object]:
    rendered = sequence.rendered  # all frames are looked at to find it
    return {
        str(n): {
            "files": [path.name for path in sequence.files(n)],
            "color": n in rendered,
            "missing": [buffer for buffer in BUFFERS if buffer != "color" and not sequence.has(n, buffer)],
        }
        for n in numbers
    }


def _storage(sequence: Sequence, numbers: list[int], tables: dict[str, object]) -> list[CheckFinding]:
    """Channels, formats and compression of the first frame that has each buffer."""
    findings: list[CheckFinding] = []
    channels: dict[str, object] = {}
    lossy: dict[str, list[str]] = {}
    for buffer in BUFFERS:
        number = next((n for n in numbers if buffer in sequence.frames[n].sources), None)
        if number is None:
            channels[buffer] = {"channels": [], "formats": [], "compression": ""}
            continue
        source = sequence.frames[number].sources[buffer]
        header = read_header(source.path)
        formats = [header.formats[name] for name in source.names]
        compression = ", ".join(dict.fromkeys(header.compression[name].partition(":")[0] for name in source.names))
        channels[buffer] = {"channels": list(source.names), "formats": formats, "compression": compression}
        if buffer != "color" and any(map(header.lossy, source.names)):
            lossy.setdefault(compression, []).append(buffer)
    tables["channels"] = channels
    for compression, buffers in lossy.items():
        findings.append(CheckFinding("warning", f"{compression} compression changes {', '.join(buffers)}; expected zip, or none"))
    return findings


def _pixels(
    sequence: Sequence,
    numbers: list[int],
    non_finite: NonFinite,
    tables: dict[str, object],
    begin: Callable[[str], None],
    *,
    all_values: bool,
) -> list[CheckFinding]:
    """Read a few pairs of neighbouring frames, and look at their values or at those of all frames."""
    usable = [n for n in numbers if all(buffer == "color" or sequence.has(n, buffer) for buffer in BUFFERS)]
    pairs = [(a, b) for a, b in pairwise(usable) if b == a + 1]
    sample = pairs[:: max(1, -(-len(pairs) // PAIRS))]
    begin("motion")
    sample_numbers = sorted({n for pair in sample for n in pair}) or usable[:1]
    sample, lost = _with_motion(sequence, sample)
    verdict = judge_motion((sequence.load(a, cut=True), sequence.load(b)) for a, b in sample)
    tables["reprojection"] = dataclasses.asdict(verdict)
    begin("positions")
    geometry = judge_static_geometry((sequence.load(a, cut=True), sequence.load(b)) for a, b in sample)
    tables |= dataclasses.asdict(geometry)
    begin("values")
    values = Values()
    for number in usable if all_values else sample_numbers:
        values.add(sequence, number)
    tables["values"] = values.table()
    lines = geometry.left_of(motion_lines(verdict, f"profile {sequence.profile.name}"))
    lines += values.lines(sequence, non_finite)
    positions, camera = geometry.lines(), camera_lines(sequence, usable[0]) if usable else []
    if any(text.startswith("position: relative") for _, text in positions):
        camera = []  # any other camera is wrong, too
    if any(level == "warning" for level, _ in camera) and "nov" not in sequence.frames[usable[0]].sources:
        lines = [line for line in lines if not line[1].startswith("nov: ")]  # which is computed by that camera
    lines += [*lost, *positions, *camera]
    rendered = [n for n in sorted(sequence.rendered) if n in usable]
    begin("colours")
    colored = rendered[1 :: max(1, len(rendered) // PAIRS)]
    lines += alignment_lines((sequence.load(n, cut=True) for n in colored), linear=sequence.profile.color_domain == "linear")
    tables["looked at"] = {"values": usable if all_values else sample_numbers, "motion and positions": sample_numbers}
    lines.append(("note", _extent(sample_numbers, len(numbers), all_values=all_values)))
    return [CheckFinding(level, text) for level, text in lines]


def _with_motion(sequence: Sequence, pairs: list[tuple[int, int]]) -> tuple[list[tuple[int, int]], list[Line]]:
    """The pairs whose motion is known, and a finding for each of the others: at a cut a run needs none."""
    with_motion: list[tuple[int, int]] = []
    lines: list[Line] = []
    for pair in pairs:
        try:
            sequence.load(pair[1])
            with_motion.append(pair)
        except CameraError as error:
            lines.append(("warning", str(error)))
    return with_motion, lines


def _extent(sample: list[int], count: int, *, all_values: bool) -> str:
    """The part of the sequence that the findings are about."""
    some = f"of {len(sample)} of {count} frames ({', '.join(map(str, sample))})"
    if all_values:
        return f"looked at: values of all frames that have every buffer; motion and positions {some}"
    rest = "" if len(sample) == count else "; a run may refuse values of the others: --all looks at them"
    return f"looked at: values, motion and positions {some}{rest}"


def print_report(report: CheckReport, console: Console) -> None:
    """Print faults, the places of buffers, notes, and the verdict."""
    _print_findings([finding for finding in report.findings if finding.level != "note"], console)
    channels = cast(dict[str, dict[str, Any]], report.tables.get("channels", {}))
    if channels:
        table = Table("buffer", "channels", "format", "compression")
        for buffer, row in channels.items():
            words = (", ".join(row["channels"]), ", ".join(dict.fromkeys(row["formats"])), row["compression"])
            table.add_row(buffer, *(escape(word) for word in words))
        console.print(table)
    _print_findings([finding for finding in report.findings if finding.level == "note"], console)
    verdict = ("fits", "can be run, but look at the warnings", "cannot be run")[report.status]
    summary = "see the errors" if report.status == 2 else report.tables["summary"]
    console.print(f"[bold]{verdict}[/]: {summary}", soft_wrap=True, highlight=False)


def _print_findings(findings: list[CheckFinding], console: Console) -> None:
    colours = {"error": "red", "warning": "yellow", "note": "cyan"}
    for finding in findings:
        console.print(f"[{colours[finding.level]}]{finding.level}[/]: {escape(printable(finding.text))}", soft_wrap=True)
