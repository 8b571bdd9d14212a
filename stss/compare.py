# SPDX-License-Identifier: MIT
"""What a run wrote against the truth: per-frame scores, means by kind of frame, pictures of the difference."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from stss.color import TRANSFERS, transfer
from stss.errors import InputError
from stss.images import read_header, read_rgb, write_rgb
from stss.metrics import REGIONS, Scores, mean_scores, score, upsample_holes
from stss_ref.arrays import Image

KINDS = ("SF", "EF")
SUFFIXES = (".png", ".exr")
MADE_WITH = ("weights", "backend", "transfer")
FALLBACK = "srgb"
"""The transfer for files that name none."""
BRIGHTENED = 4
"""So many times the difference is brightened in the pictures."""
METRICS = (("psnr_luma", "PSNR\nluma", 2), ("ssim", "SSIM\nluma", 4), ("psnr_rgb", "PSNR\nRGB", 2))
"""In the order of the fields of ``Scores``: field, heading, digits printed."""


@dataclass(frozen=True)
class Row:
    """One frame.

    Attributes:
        number: of the frame.
        kind: "SF" or "EF"; None where the output does not say.
        output: the file judged.
        truth: the file it was judged by.
        scores: region to scores.
    """

    number: int
    kind: str | None
    output: Path
    truth: Path
    scores: Mapping[str, Scores]


@dataclass(frozen=True)
class Mean:
    """Means over frames: of a PSNR, the mean of the frames' decibels; frames whose region is empty do not count.

    Attributes:
        name: "SF", "EF", "MEAN" (the mean of these two, as the authors), or "all" where kinds are not known.
        frames: how many frames it is of.
        scores: region to scores.
    """

    name: str
    frames: int
    scores: Mapping[str, Scores]


@dataclass(frozen=True)
class Comparison:
    """The outcome.

    Attributes:
        rows: the frames that both folders have, in order.
        means: by kind.
        without_truth: frames of the output that the truth lacks.
        without_output: frames of the truth that the output lacks.
        notes: what the reader of the numbers must know; one line each.
        made_with: weights, backend and transfer named by the output's files; more than one value each if they differ.
    """

    rows: Sequence[Row]
    means: Sequence[Mean]
    without_truth: Sequence[int]
    without_output: Sequence[int]
    notes: Sequence[str]
    made_with: Mapping[str, Sequence[str]]

    def to_json(self) -> str:
        """As JSON: null where a region is empty, the text "inf" where a PSNR is infinite."""
        found = {
            "frames": [
                {"frame": r.number, "kind": r.kind, "output": r.output.name, "truth": r.truth.name, **_plain(r.scores)}
                for r in self.rows
            ],
            "means": {m.name: {"frames": m.frames, **_plain(m.scores)} for m in self.means},
            "without_truth": self.without_truth,
            "without_output": self.without_output,
            "notes": self.notes,
            "made_with": self.made_with,
        }
        return json.dumps(found, indent=2, allow_nan=False)


@dataclass(frozen=True)
class _Pair:
    """An output, its truth, and what the output's file says of itself.

    Attributes:
        output: the file to judge.
        truth: the file to judge it by.
        kind: "SF" or "EF"; None where the file does not say.
        transfer: how its renderer's domain is displayed; None where the file does not say.
        holes: the file of its warping holes; None where there is none.
        made_with: weights, backend and transfer, as far as the file names them.
    """

    output: Path
    truth: Path
    kind: str | None
    transfer: str | None
    holes: Path | None
    made_with: Mapping[str, str]


def compare(out: Path, truth: Path, *, frames: tuple[int, int] | None = None, pictures: Path | None = None) -> Comparison:
    """Judge the frames of a folder by those of another with the same numbers.

    EXR holds the renderer's domain, PNG what a screen shows. Both are brought to what a screen shows, by the transfer
    that the output's file names (``srgb`` where it names none), and then to 8 bits.

    Source: spec 9.

    Args:
        out: written by `stss run`, or by anything that numbers its files.
        truth: images of the size of the output's.
        frames: first and last to judge, both included; None: all.
        pictures: folder for pictures output | truth | 4 x difference, made if need be; None: none.

    Raises:
        InputError: a folder is not there, the two have no frame in common, a file cannot be read, sizes differ, only
            some of the output's files name their kind, or ``pictures`` is one of the folders read.
    """
    if pictures is not None and pictures.resolve() in [p.resolve() for p in (out, out / "holes", truth)]:
        raise InputError(f"{pictures}: holds the images to compare; expected another folder for the pictures")
    outputs, truths = _numbered(out, frames), _numbered(truth, frames)
    pairs = {n: _pair(outputs[n], truths[n]) for n in sorted(outputs.keys() & truths.keys())}
    if not pairs:
        found = f"found {listed(truths)}" + (f" within {frames[0]} to {frames[1]}" if frames else "")
        raise InputError(f"{truth}: expected a frame that {out} has, one of {listed(outputs)}; {found}")
    notes = _notes(out, pairs)
    rows = [_judge(number, pair, pictures) for number, pair in pairs.items()]
    return Comparison(
        rows,
        _means(rows),
        sorted(outputs.keys() - truths.keys()),
        sorted(truths.keys() - outputs.keys()),
        notes,
        {name: sorted({p.made_with[name] for p in pairs.values() if name in p.made_with}) for name in MADE_WITH},
    )


def print_comparison(comparison: Comparison, console: Console) -> None:
    """Print a table of frames and means, then what to know about them."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column("\n\nframe", justify="right")
    table.add_column("\n\nkind")
    for _, heading, _ in METRICS:
        for region in REGIONS:
            above = heading if region == REGIONS[0] else "\n"
            table.add_column(f"{above}\n{region}", justify="right", no_wrap=True)
    for row in comparison.rows:
        table.add_row(str(row.number), row.kind or "", *_cells(row.scores))
    table.add_section()
    for mean in comparison.means:
        table.add_row(f"of {mean.frames}", mean.name, *_cells(mean.scores), style="bold")
    console.print(table)
    lines = [
        *comparison.notes,
        *(f"{name}: {', '.join(found)}" for name, found in comparison.made_with.items() if found),
    ]
    if comparison.without_truth:
        lines.append(f"not compared, no truth: {listed(comparison.without_truth)}")
    if comparison.without_output:
        lines.append(f"not compared, no output: {listed(comparison.without_output)}")
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def listed(numbers: Iterable[int]) -> str:
    """Numbers in words: "frames 1 to 5, 7", "frame 7", "no frames"."""
    runs: list[list[int]] = []
    for n in sorted(numbers):
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    if not runs:
        return "no frames"
    several = len(runs) > 1 or runs[0][0] < runs[0][1]
    return ("frames " if several else "frame ") + ", ".join(f"{a} to {b}" if a < b else str(a) for a, b in runs)


def _numbered(folder: Path, frames: tuple[int, int] | None) -> dict[int, Path]:
    """Images by frame number: the last digits of the name without its suffix."""
    if not folder.is_dir():
        raise InputError(f"{folder}: " + ("not a folder" if folder.exists() else "no such folder"))
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir(), key=lambda p: (p.suffix.lower() != ".png", p.name)):
        digits = re.findall(r"\d+", path.stem)
        if path.suffix.lower() not in SUFFIXES or path.name.startswith(".") or not digits:
            continue
        number = int(digits[-1])
        if number in found and found[number].stem != path.stem:
            raise InputError(f"{folder}: frame {number} is there twice: {found[number].name}, {path.name}")
        if frames is None or frames[0] <= number <= frames[1]:
            found[number] = path  # EXR comes last and stands
    return found


def _pair(output: Path, truth: Path) -> _Pair:
    attributes = read_header(output).attributes
    made_with = {name: str(attributes[f"stss:{name}"]) for name in MADE_WITH if f"stss:{name}" in attributes}
    kind, domain = attributes.get("stss:kind"), made_with.get("transfer")
    if kind not in (*KINDS, None):
        raise InputError(f"{output}: stss:kind: expected {' or '.join(KINDS)}, found {kind!r}")
    if domain not in (*TRANSFERS, None):
        raise InputError(f"{output}: stss:transfer: expected one of {', '.join(TRANSFERS)}, found {domain!r}")
    holes = output.parent / "holes" / f"{output.stem}.png"
    return _Pair(output, truth, None if kind is None else str(kind), domain, holes if holes.exists() else None, made_with)


def _judge(number: int, pair: _Pair, pictures: Path | None) -> Row:
    curve = transfer(pair.transfer or FALLBACK)
    image, truth = (
        curve.display(read_rgb(path)) if path.suffix.lower() == ".exr" else read_rgb(path) for path in (pair.output, pair.truth)
    )
    _require_size(pair.truth, truth, pair.output, image.shape[:2])
    hole = None
    if pair.holes is not None:
        small = read_rgb(pair.holes)
        _require_size(pair.holes, small, pair.output, (image.shape[0] // 2, image.shape[1] // 2))
        hole = upsample_holes(small[..., 0] > 0.5)
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        difference = np.clip(BRIGHTENED * np.abs(image - truth), 0, 1)
        write_rgb(pictures / f"{pair.output.stem}.png", np.concatenate([image, truth, difference], axis=1))
    return Row(number, pair.kind, pair.output, pair.truth, score(image, truth, hole))


def _require_size(path: Path, image: Image, other: Path, size: tuple[int, ...]) -> None:
    if image.shape[:2] != size:
        expected, found = (f"{width} x {height}" for height, width in (size, image.shape[:2]))
        raise InputError(f"{path}: expected {expected} pixels to go with {other}, found {found}")


def _notes(out: Path, pairs: Mapping[int, _Pair]) -> list[str]:
    notes: list[str] = []
    unknown = [n for n, pair in pairs.items() if pair.kind is None]
    if unknown and len(unknown) < len(pairs):
        raise InputError(f"{out}: {listed(unknown)} without stss:kind, the others with it; expected files of one origin")
    if unknown:
        notes.append(f"{out}: kinds of frame are not known (no stss:kind); means are over all frames")
    if any(p.transfer is None and ".exr" in (p.output.suffix.lower(), p.truth.suffix.lower()) for p in pairs.values()):
        notes.append(f"{out}: no transfer named (no stss:transfer); EXR is taken as scene-linear and shown as {FALLBACK}")
    lacking = [n for n, pair in pairs.items() if pair.holes is None and pair.kind != "SF"]
    if lacking:
        notes.append(f"{out / 'holes'}: no holes of {listed(lacking)}; not scored there")
    return notes


def _means(rows: Sequence[Row]) -> list[Mean]:
    by_kind = [(kind, [row for row in rows if row.kind == kind]) for kind in (*KINDS, None)]
    means = [Mean(kind or "all", len(of), mean_scores([row.scores for row in of])) for kind, of in by_kind if of]
    if len(means) == len(KINDS):
        means.append(Mean("MEAN", len(rows), mean_scores([mean.scores for mean in means], complete=True)))
    return means


def _cells(scores: Mapping[str, Scores]) -> list[str]:
    values = [(getattr(scores[region], metric), digits) for metric, _, digits in METRICS for region in REGIONS]
    return ["-" if value is None else f"{value:.{digits}f}" for value, digits in values]


def _plain(scores: Mapping[str, Scores]) -> dict[str, dict[str, float | str | None]]:
    return {
        region: {name: "inf" if value == math.inf else value for name, value in asdict(found).items()}
        for region, found in scores.items()
    }
