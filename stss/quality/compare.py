# SPDX-License-Identifier: MIT
"""Compare a run's output with the truth: scores of each frame, means by kind of frame."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from stss.images.read_write import read_rgb
from stss.quality.changes import Follower, OutputAndTruth, temporal_psnr
from stss.quality.flip_vmaf import NEITHER, Perceptual, vmaf_scores
from stss.quality.metrics import REGIONS, Scores, mean_scores, score, to_8bit, upsample_holes
from stss.quality.output_and_truth import DIFFERENCES, FALLBACK, KINDS, MADE_WITH, Pair, find_pairs, list_numbers, require_size
from stss.sequence.raw_frame import NonFinite
from stss.sequence.sequence import Sequence as Input
from stss_ground.errors import InputError
from stss_ground.progress import Track
from stss_ref.arrays import Image

METRICS = {
    "psnr_luma": ("PSNR\nluma", 2, REGIONS),
    "ssim": ("SSIM\nluma", 4, REGIONS),
    "psnr_rgb": ("PSNR\nRGB", 2, REGIONS),
    "flip": ("FLIP\n", 4, REGIONS),
    "vmaf": ("VMAF\n", 2, REGIONS[:1]),
    "tpsnr": ("tPSNR\nRGB", 2, REGIONS[:1]),
    "flicker": ("flicker\nerror", 2, REGIONS[:1]),
}
"""Field of ``Scores`` -> heading, digits printed, and the regions over which it is taken."""
BELOW = ("tpsnr", "flicker")
"""Metrics without a column: their means are printed below the table."""


@dataclass(frozen=True)
class FrameScores:
    """The scores of one frame.

    Attributes:
        number: the frame's number.
        kind: "SF" or "EF"; None where the output does not say.
        hole: the share of the pixels that is scored as holes; None without a mask.
        output: the file that was scored.
        truth: the file that it was compared with.
        scores: region -> scores.
    """

    number: int
    kind: str | None
    hole: float | None
    output: Path
    truth: Path
    scores: Mapping[str, Scores]


@dataclass(frozen=True)
class Mean:
    """Means over frames. A PSNR's mean is over decibels; frames whose region is empty do not count.

    Attributes:
        name: "SF", "EF", "MEAN" (the mean of these two, as the authors), or "all" where kinds are not known.
        frames: number of frames.
        scores: region -> scores.
    """

    name: str
    frames: int
    scores: Mapping[str, Scores]


@dataclass(frozen=True)
class Comparison:
    """The result of ``compare``.

    Attributes:
        rows: the frames that both folders have, in order.
        means: by kind.
        without_truth: frames of the output that the truth lacks.
        without_output: frames of the truth that the output lacks.
        notes: caveats about the numbers; one line each.
        made_with: method, weights, backend and transfer, as far as the output's files name them; several values if they differ.
        metrics: the metrics taken, of ``METRICS``.
        holes: the mean share of the pixels that are scored as holes, over the frames that have a mask; None: none has.
        static_holes: the mean share of the static surfaces that are holes, over the EFs that say it; None: none does.
    """

    rows: Sequence[FrameScores]
    means: Sequence[Mean]
    without_truth: Sequence[int]
    without_output: Sequence[int]
    notes: Sequence[str]
    made_with: Mapping[str, Sequence[str]]
    metrics: Sequence[str]
    holes: float | None
    static_holes: float | None

    def to_json(self) -> str:
        """As JSON: null where a region is empty, the text "inf" where a PSNR is infinite."""
        table = {
            "frames": [
                {"frame": r.number, "kind": r.kind, "output": r.output.name, "truth": r.truth.name, **self._plain(r.scores)}
                for r in self.rows
            ],
            "means": {m.name: {"frames": m.frames, **self._plain(m.scores)} for m in self.means},
            "without_truth": self.without_truth,
            "without_output": self.without_output,
            "holes": self.holes,
            "static_holes": self.static_holes,
            "notes": self.notes,
            "made_with": self.made_with,
        }
        return json.dumps(table, indent=2, allow_nan=False)

    def _plain(self, scores: Mapping[str, Scores]) -> dict[str, dict[str, float | str | None]]:
        return {
            region: {
                name: "inf" if value == math.inf else value
                for name, value in asdict(values).items()
                if name in self.metrics and region in METRICS[name][2]
            }
            for region, values in scores.items()
        }


class Errors(NamedTuple):
    """Mean squared differences at a step of one frame: of the output from its own truth, and across the step.

    Attributes:
        own: of the output from its truth.
        before: of the output from the truth of the frame before.
        after: of the frame before from the truth of this one.
        change: of the two truths.
    """

    own: float
    before: float
    after: float
    change: float


def compare(
    out: Path,
    truth: Path,
    *,
    frames: tuple[int, int] | None = None,
    sequence: Input | None = None,
    perceptual: Perceptual = NEITHER,
    non_finite: NonFinite = "refuse",
    holes: Path | None = None,
    track: Track = iter,
) -> Comparison:
    """Compare the frames of a folder with those of the same numbers in another.

    EXR holds the renderer's domain, PNG a screen's. Both are converted to a screen's, by the transfer
    that the output's file names (``srgb`` where it names none), and then to 8 bits.

    Source: spec 9.

    Args:
        out: written by `stss run`, or by anything that numbers its files.
        truth: images of the same size.
        frames: first and last to compare, both included; None: all.
        sequence: the input of the output; its motion gives the flicker; None: no flicker.
        perceptual: metrics to take too.
        non_finite: values that are not finite: "refuse" them, or "mask": 0.
        holes: the folder of a run, over whose warping holes outputs are scored; None: over their own.
        track: yields its numbers unchanged, and may show the progress.

    Raises:
        InputError: a folder is not there, the two have no frame in common, a file cannot be read or has a value that is not finite,
            sizes differ or do not fit the sequence, only some of the output's files name their kind, or a package is missing.
    """
    perceptual.require_packages()
    pairs, without_truth, without_output = find_pairs(out, truth, frames, non_finite, holes)
    notes = _notes(out, pairs, holes)
    rows, neighbours = _rows(pairs, track(list(pairs)), sequence, flip=perceptual.flip)
    notes += _notes_on_numbers(neighbours)
    if perceptual.vmaf:
        scores = vmaf_scores(map(to_8bit, pair.load()) for pair in pairs.values())
        rows = [_with(row, vmaf=value) for row, value in zip(rows, scores, strict=True)]
    made_with = {name: sorted({p.made_with[name] for p in pairs.values() if name in p.made_with}) for name in MADE_WITH}
    return Comparison(
        rows,
        _means(rows),
        without_truth,
        without_output,
        notes,
        {name: values for name, values in made_with.items() if values},
        [name for name in METRICS if {**vars(perceptual), "flicker": sequence is not None}.get(name, True)],
        float(np.mean(holed)) if (holed := [row.hole for row in rows if row.hole is not None]) else None,
        float(np.mean(shares)) if (shares := [p.static_holes for p in pairs.values() if p.static_holes is not None]) else None,
    )


def print_comparison(comparison: Comparison, console: Console) -> None:
    """Print a table of frames and means, then the facts about it."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column("\n\nframe", justify="right")
    table.add_column("\n\nkind")
    columns = [metric for metric in comparison.metrics if metric not in BELOW]
    for metric in columns:
        heading, _, regions = METRICS[metric]
        for region in regions:
            above = heading if region == regions[0] else "\n"
            table.add_column(f"{above}\n{region}", justify="right", no_wrap=True)
    for row in comparison.rows:
        table.add_row(str(row.number), row.kind or "", *cells(row.scores, columns))
    table.add_section()
    for mean in comparison.means:
        table.add_row(f"of {mean.frames}", mean.name, *cells(mean.scores, columns), style="bold")
    print_whole(table, console)
    for line in facts(comparison):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def print_whole(table: Table, console: Console) -> None:
    """Print a table at its full width even on a narrower console: a cut number is worse than a broken line."""
    console.width = max(console.width, Measurement.get(console, console.options.update(max_width=1000), table).maximum)
    console.print(table)


def facts(comparison: Comparison) -> list[str]:
    """Facts about the table, a line each: how the output was made, how it changes, frames not compared, notes."""
    lines = [
        *comparison.notes,
        *(
            f"{METRICS[name][0].splitlines()[0]} of the steps: "
            + ", ".join(f"{mean.name} {cells(mean.scores, [name])[0]}" for mean in comparison.means)
            for name in BELOW
            if name in comparison.metrics
        ),
        *([] if comparison.holes is None else [f"holes are scored over {comparison.holes:.1%} of the pixels"]),
        *([] if comparison.static_holes is None else [f"holes: {comparison.static_holes:.1%} of the static surfaces of EFs"]),
        *(f"{name}: {', '.join(values)}" for name, values in comparison.made_with.items() if values),
    ]
    if comparison.without_truth:
        lines.append(f"not compared, no truth: {list_numbers(comparison.without_truth)}")
    if comparison.without_output:
        lines.append(f"not compared, no output: {list_numbers(comparison.without_output)}")
    return lines


def _rows(
    pairs: Mapping[int, Pair], numbers: Iterable[int], sequence: Input | None, *, flip: bool
) -> tuple[list[FrameScores], list[Errors]]:
    """The frames' rows, with the step from the previous frame where there is one, and the errors of each such step."""
    rows: list[FrameScores] = []
    neighbours: list[Errors] = []
    before: OutputAndTruth | None = None
    follower = None if sequence is None else Follower(sequence)
    for number in numbers:
        pair = pairs[number]
        images = pair.load()
        if sequence is not None:
            require_size(pair.output, images[0], sequence.path, sequence.display.doubled.size)
        row = _judge(number, pair, images, flip=flip)
        if before is not None and rows[-1].number == number - 1:
            flicker = None if follower is None else follower.flicker(number, images, before)
            row = _with(row, tpsnr=temporal_psnr(images, before), flicker=flicker)
            image, truth = images
            neighbours.append(
                Errors(_error(image, truth), _error(image, before[1]), _error(before[0], truth), _error(truth, before[1]))
            )
        rows.append(row)
        before = images
    return rows, neighbours


def _error(image: Image, truth: Image) -> float:
    """Mean squared difference, of one pixel in sixteen."""
    return float(np.mean((image[::4, ::4] - truth[::4, ::4]) ** 2))


def _notes_on_numbers(neighbours: Sequence[Errors]) -> list[str]:
    """Whether outputs are nearer to the truth of the frame before or after than to their own."""
    own, before, after, change = (sum(each) for each in zip(*neighbours, strict=True)) if neighbours else (0.0,) * 4
    return [
        f"outputs are twice as near to the truth of the frame {word}: is one of the two folders numbered from another frame?"
        for word, error in (("before", before), ("after", after))
        if 2 * error < own < 2 * change  # a wrong number costs as much as the truth changes; where nothing moves it costs nothing
    ]


def _judge(number: int, pair: Pair, images: OutputAndTruth, *, flip: bool) -> FrameScores:
    image, truth = images
    hole = None
    if pair.holes is not None:
        small = read_rgb(pair.holes)
        require_size(pair.holes, small, pair.output, (image.shape[0] // 2, image.shape[1] // 2))
        hole = upsample_holes(small[..., 0] > 0.5)
    share = None if hole is None else float(hole.mean())
    return FrameScores(number, pair.kind, share, pair.output, pair.truth, score(image, truth, hole, flip=flip))


def files_of(pairs: Mapping[int, Pair]) -> list[Path]:
    """Every file of the frames that are compared, and of the other frames in their folders."""
    files = [path for pair in pairs.values() for path in (pair.output, pair.truth, pair.holes) if path is not None]
    return [
        path for folder in {path.parent for path in files} for path in folder.iterdir() if path.suffix.lower() in (".exr", ".png")
    ]


def _with(row: FrameScores, **values: float | None) -> FrameScores:
    """A row with further scores of the whole frame."""
    return replace(row, scores={**row.scores, "all": replace(row.scores["all"], **values)})


def _notes(out: Path, pairs: Mapping[int, Pair], holes: Path | None) -> list[str]:
    notes: list[str] = []
    unknown = [n for n, pair in pairs.items() if pair.kind is None]
    if unknown and len(unknown) < len(pairs):
        raise InputError(f"{out}: {list_numbers(unknown)} without stss:kind, the others with it; expected files of one origin")
    if unknown:
        notes.append(f"{out}: kinds of frame are not known (no stss:kind); means are over all frames")
    if any(p.transfer is None and ".exr" in (p.output.suffix.lower(), p.truth.suffix.lower()) for p in pairs.values()):
        notes.append(f"{out}: no transfer named (no stss:transfer); EXR is taken as scene-linear and shown as {FALLBACK}")
    for what, compared in DIFFERENCES.items():
        if apart := [n for n, pair in pairs.items() if what in pair.differences]:
            ours, theirs = pairs[apart[0]].differences[what]
            notes.append(f"{what} of {list_numbers(apart)}: {ours} in the output, {theirs} in the truth; {compared}")
    lacking = [n for n, pair in pairs.items() if pair.holes is None and pair.kind != "SF"]
    if lacking:
        notes.append(f"{(holes or out) / 'holes'}: no holes of {list_numbers(lacking)}; not scored there")
    return notes


def _means(rows: Sequence[FrameScores]) -> list[Mean]:
    by_kind = [(kind, [row for row in rows if row.kind == kind]) for kind in (*KINDS, None)]
    means = [Mean(kind or "all", len(of), mean_scores([row.scores for row in of])) for kind, of in by_kind if of]
    if len(means) == len(KINDS):
        means.append(Mean("MEAN", len(rows), mean_scores([mean.scores for mean in means], complete=True)))
    return means


def cells(scores: Mapping[str, Scores], metrics: Sequence[str]) -> list[str]:
    """Scores as text, in the order of the table's columns: ``metrics``, and for each its regions."""
    values = [(getattr(scores[region], name), METRICS[name][1]) for name in metrics for region in METRICS[name][2]]
    return ["-" if value is None else f"{value:.{digits}f}" for value, digits in values]
