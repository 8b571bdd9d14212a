# SPDX-License-Identifier: MIT
"""`stss methods`: run every method on one sequence and compare them with the network, in one table."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from stss.frames.backends import NETWORK, Backend
from stss.quality.compare import Comparison, compare, print_whole
from stss.quality.flip_vmaf import NEITHER, Perceptual
from stss.quality.output_and_truth import find_pairs, list_numbers
from stss.run.job import require_near, run
from stss.run.options import RunOptions
from stss.sequence.sequence import Sequence as Frames
from stss.weights.file import BILINEAR
from stss_ground.errors import InputError
from stss_lab.baselines.registry import METHODS
from stss_lab.baselines.without_part import CHANGES

COLUMNS: Mapping[str, tuple[tuple[str, str, str], ...]] = {
    "PSNR\nRGB": (("SF", "all", "psnr_rgb"), ("EF", "all", "psnr_rgb")),
    "PSNR\nedges": (("SF", "edges", "psnr_rgb"), ("EF", "edges", "psnr_rgb")),
    "PSNR\nholes": (("EF", "holes", "psnr_rgb"),),
    "SSIM\n": (("SF", "all", "ssim"), ("EF", "all", "ssim")),
    "FLIP\n": (("SF", "all", "flip"), ("EF", "all", "flip")),
    "VMAF\n": (("SF", "all", "vmaf"), ("EF", "all", "vmaf")),
    "tPSNR\n": (("SF", "all", "tpsnr"), ("EF", "all", "tpsnr")),
    "flicker\nerror": (("SF", "all", "flicker"), ("EF", "all", "flicker")),
}
"""Heading -> kind of frame, region and field of ``Scores`` of the column."""
DIGITS = {"psnr_rgb": 2, "ssim": 4, "flip": 4, "vmaf": 1, "tpsnr": 2, "flicker": 2}

Engines = Mapping[str, Callable[[], tuple[Backend, str]]]
"""Method -> opens its backend; returns it and the label of its weights."""


@dataclass(frozen=True)
class MethodResult:
    """The result of one method: its name, the folder of its frames and its scores."""

    method: str
    folder: Path
    comparison: Comparison


def choose_methods(names: Sequence[str], weights: str) -> tuple[str, ...]:
    """Choose the methods of these names; without names ``METHODS``, and the network unless ``weights`` is ``bilinear``.

    Raises:
        InputError: there is no such method, or one is named twice.
    """
    choices = (*METHODS, NETWORK, *CHANGES)
    for name in names:
        if name not in choices or names.count(name) > 1:
            raise InputError(f"methods: expected some of {', '.join(choices)}, each once; got {','.join(names)}")
    return tuple(names) or (*METHODS, *((NETWORK,) if weights != BILINEAR else ()))


def run_methods(
    sequence: Frames,
    truth: Path,
    out: Path,
    engines: Engines,
    options: RunOptions,
    *,
    perceptual: Perceptual = NEITHER,
    on_frame: Callable[[str], None] = lambda method: None,
    reads: Sequence[Path] = (),
    others: Sequence[Path] = (),
) -> list[MethodResult]:
    """Run each method into ``out/METHOD`` and compare its frames with the truth.

    Args:
        sequence: the input.
        truth: folder of the frames that outputs should equal.
        out: folder; made if need be.
        engines: method, see `choose_methods` -> opens its backend.
        options: as for ``stss run``.
        perceptual: metrics to take too.
        on_frame: called with the method when it has made or compared a frame.
        reads: files that must not be written to, besides those of the sequence.
        others: folders of frames that another program made of the same sequence, each a method of the folder's name.

    Raises:
        InputError: as ``stss run`` and ``stss compare``.
    """
    perceptual.require_packages()
    require_near(sequence, *(options.frames or (sequence.numbers[0], sequence.numbers[-1])))
    for folder in others:
        require_same_frames(folder, truth, sequence, options.frames)
    for method, engine in engines.items():
        backend, label = engine()
        run(sequence, out / method, backend, label, options, lambda _, method=method: on_frame(method), reads)
    results: list[MethodResult] = []
    for folder in (*(out / method for method in engines), *others):
        method, run_with_holes = name_of(folder), out / holes_of([*engines])
        bar = partial(_count, method, on_frame)
        scores = compare(
            folder, truth, frames=options.frames, sequence=sequence, perceptual=perceptual, holes=run_with_holes, track=bar
        )
        results.append(MethodResult(method, folder, scores))
    return results


def name_of(folder: Path) -> str:
    """The name of a method by the folder of its frames."""
    return folder.resolve().name


def require_names(names: Sequence[str], others: Sequence[Path]) -> None:
    """Raise InputError if a folder of frames from elsewhere has the name of a method, or of another such folder."""
    for i, folder in enumerate(others):
        if name_of(folder) in (*METHODS, NETWORK, *CHANGES, *names, *(name_of(other) for other in others[:i])):
            raise InputError(f"{folder}: expected a folder with another name, since its row gets it; {name_of(folder)} is taken")


def require_same_frames(folder: Path, truth: Path, sequence: Frames, frames: tuple[int, int] | None) -> None:
    """Raise InputError if a folder lacks frames of the methods: the means would be over different frames."""
    *_, lacks = find_pairs(folder, truth, frames)
    if missing := {*lacks} & {*sequence.numbers}:
        raise InputError(f"{folder}: expected the frames of the other methods; {list_numbers(missing)} not there")


def holes_of(methods: Sequence[str]) -> str:
    """The method over whose warping holes all methods are scored: weights choose the hole test, so masks may differ."""
    return NETWORK if NETWORK in methods else methods[0]


def _count(method: str, on_frame: Callable[[str], None], numbers: Sequence[int]) -> Iterator[int]:
    for number in numbers:
        yield number
        on_frame(method)


def to_json(results: Sequence[MethodResult]) -> str:
    """As JSON: method -> the object of `Comparison.to_json`."""
    return json.dumps({r.method: json.loads(r.comparison.to_json()) for r in results}, indent=2, allow_nan=False)


def print_results(results: Sequence[MethodResult], console: Console) -> None:
    """Print one row for each method: means over the frames."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    headings, rows = cells(results)
    table.add_column(f"\n\n{headings[0][1]}")
    for i, (above, kind) in enumerate(headings[1:], start=1):
        heading = "\n" if above == headings[i - 1][0] else above
        table.add_column(f"{heading}\n{kind}", justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    print_whole(table, console)
    console.print(caption(results), highlight=False)


def cells(results: Sequence[MethodResult]) -> tuple[list[tuple[str, str]], list[list[str]]]:
    """The table as text: (heading, kind of frame) of each column, and a row of cells for each method."""
    metrics = results[0].comparison.metrics
    columns = {heading: below for heading, below in COLUMNS.items() if below[0][2] in metrics}
    headings = [("", "method"), *((heading, kind) for heading, below in columns.items() for kind, _, _ in below)]
    rows: list[list[str]] = []
    for result in results:
        means = {mean.name: mean.scores for mean in result.comparison.means}
        scores = [_score(means, *cell) for below in columns.values() for cell in below]
        rows.append([result.method, *scores])
    return headings, rows


def caption(results: Sequence[MethodResult]) -> str:
    """A line about the frames over which the table's numbers are means."""
    counts = {mean.name: mean.frames for mean in results[0].comparison.means}
    share = results[0].comparison.holes
    holes = "" if share is None else f"; holes are those of {holes_of([r.method for r in results])}, {share:.1%} of the pixels"
    return f"means of {counts.get('SF', 0)} SF and {counts.get('EF', 0)} EF; PSNR over RGB, flicker in 8-bit levels{holes}"


def _score(means: Mapping[str, Mapping[str, object]], kind: str, region: str, name: str) -> str:
    value = getattr(means[kind][region], name) if kind in means else None
    return "-" if value is None else f"{value:.{DIGITS[name]}f}"
