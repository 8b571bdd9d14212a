# SPDX-License-Identifier: MIT
"""The page of ``stss compare``, ``methods`` and ``demo``: the pictures of every frame beside its scores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from stss.images.color import transfer
from stss.pages.viewer import Pane, ShownFrame, Viewer, write_viewer
from stss.quality.compare import BELOW, METRICS, Comparison, cells, facts
from stss.quality.output_and_truth import FALLBACK, Pair
from stss.sequence.sequence import Sequence as Frames
from stss_ground.output.write_whole import write_named
from stss_ground.pages.page import definitions, fold, table
from stss_ground.pages.plot import PlotLine, plot
from stss_ground.progress import Track
from stss_ground.terminal import printable
from stss_ref.arrays import Image
from stss_ref.resample import upsample_centres

INPUT, BILINEAR, TRUTH = "input", "bilinear", "truth"
MEANINGS = {
    INPUT: "The rendered frame, each pixel as four. Of an extrapolated frame (EF): the last rendered one before it.",
    BILINEAR: "The input enlarged bilinearly.",
    TRUTH: "What the frame should be.",
}
PLOTS = {
    "psnr_rgb": "PSNR over RGB, dB",
    "ssim": "SSIM of the luma",
    "flip": "FLIP, mean error",
    "vmaf": "VMAF",
    "tpsnr": "tPSNR over RGB, dB",
    "flicker": "Flicker, error in 8-bit levels",
}
"""Field of ``Scores`` -> title of its plot."""
DEFINITIONS = (
    ("SF, EF", "Supersampled frame: it was rendered small. Extrapolated frame: it was not rendered at all."),
    (
        "PSNR",
        "10 log10(255² / mean squared error) of 8-bit images, dB. Luma is that of MATLAB's rgb2ycbcr.",
    ),
    ("SSIM", "Structural similarity of the luma, Gaussian window of 11 x 11 with sigma 1.5; 1 where two images agree."),
    ("FLIP", "LDR-FLIP at 67 pixels a degree, the mean of its error map; 0 where two images agree."),
    ("VMAF", "Model vmaf_v0.6.1 on the frames as a video; about 100 where two videos agree."),
    ("tPSNR", "PSNR of the change since the previous frame, pixel by pixel."),
    (
        "flicker error",
        "Mean of |d - d*| in 8-bit levels, d and d* the change along the motion of output and truth; lower is better.",
    ),
    (
        "all, edges, holes",
        "Every pixel; Canny edges of the truth; warping holes, where something was hidden in the last rendered frame.",
    ),
    ("means", "Over frames, of decibels and not of errors. MEAN is the mean of SF's and EF's."),
)


@dataclass(frozen=True)
class Version:
    """One output: its name, a sentence that explains it, its files and their scores."""

    name: str
    meaning: str
    pairs: Mapping[int, Pair]
    comparison: Comparison


class RenderedInputs:
    """The rendered frames from which outputs were made, as a screen shows them."""

    def __init__(self, sequence: Frames, pairs: Mapping[int, Pair]):
        """Take the frames that count as rendered: those of the outputs' SF, and all others of the same parity."""
        self._sequence, self._pairs = sequence, pairs
        parities = {number % 2 for number, pair in pairs.items() if pair.kind == "SF"} or {0, 1}
        self._rendered = {number for number in sequence.rendered if number % 2 in parities}
        self._last: tuple[int, Image] | None = None

    def load(self, number: int) -> Image | None:
        """(H, W, 3) the frame itself, or the last rendered one before it; None where there is none."""
        source = max((n for n in self._rendered if n <= number), default=None)
        if source is None:
            return None
        if self._last is None or self._last[0] != source:
            color = self._sequence.crop_to_display(self._sequence.load(source)).color
            assert color is not None
            self._last = source, transfer(self._pairs[number].transfer or FALLBACK).display(color)
        return self._last[1]


def write_comparison(
    path: Path,
    title: str,
    versions: Sequence[Version],
    inputs: RenderedInputs | None,
    tables: Sequence[str] = (),
    save: Callable[[Path, str], None] = write_named,
    track: Track = iter,
) -> None:
    """Write the page.

    Args:
        path: the file.
        title: the page's title.
        versions: at least one, each with the same frames and truth; the last one is shown first.
        inputs: the frames that they were made from; None: not shown.
        tables: markup to put before the table of each frame's scores.
        save: see `stss.pages.viewer.write_viewer`.
        track: may show how many frames are done.

    Raises:
        InputError: a file can't be read or the page can't be written.
    """
    best = versions[-1]
    names = [version.name for version in versions]
    views = [Pane(version.name, version.meaning) for version in versions]
    if inputs is not None:
        views = [Pane(name, MEANINGS[name]) for name in (INPUT, BILINEAR) if name not in names] + views
    views.append(Pane(TRUTH, MEANINGS[TRUTH]))
    view_names = [view.name for view in views]
    pair = (BILINEAR if BILINEAR in view_names else names[0], best.name)
    several, numbers = len(versions) > 1, [row.number for row in best.comparison.rows]
    viewer = Viewer(
        title=title,
        notes=best.comparison.notes,
        views=views,
        pair=pair if pair[0] != pair[1] else (best.name, TRUTH),
        plots=[
            plot(PLOTS[metric], lines, digits=METRICS[metric][1], frames=numbers)
            for metric in PLOTS
            if metric in best.comparison.metrics and (lines := _lines(versions, metric))
        ],
        tables=[
            *tables,
            *(
                fold(f"{version.name}: every frame", scores_table(version.comparison, version.name))
                if len(versions) > 2
                else scores_table(version.comparison, f"{version.name}: every frame" if several else "Every frame")
                for version in versions
            ),
            *([f"<h3>{escape(best.name)}</h3>"] if several else []),
            *(f"<p>{escape(printable(fact))}</p>" for fact in facts(best.comparison)[len(best.comparison.notes) :]),
            definitions("What the columns mean", DEFINITIONS),
        ],
    )
    write_viewer(path, viewer, _frames(versions, inputs, track), save=save)


def scores_table(comparison: Comparison, caption: str) -> str:
    """Every frame's scores and their means, as markup."""
    metrics = [metric for metric in comparison.metrics if metric not in BELOW]
    headings = ["frame", "kind", *(f"{METRICS[m][0].strip()}\n{region}" for m in metrics for region in METRICS[m][2])]
    rows = [[str(row.number), row.kind or "", *cells(row.scores, metrics)] for row in comparison.rows]
    means = [[f"of {mean.frames}", mean.name, *cells(mean.scores, metrics)] for mean in comparison.means]
    return table(caption, headings, [*rows, *means], means=len(means), words=2)


def _lines(versions: Sequence[Version], metric: str) -> list[PlotLine]:
    """A line for each version and kind of frame."""
    lines: list[PlotLine] = []
    for i, version in enumerate(versions):
        for j, kind in enumerate(("SF", "EF", None)):
            rows = [row for row in version.comparison.rows if row.kind == kind]
            values = {row.number: value for row in rows if (value := getattr(row.scores["all"], metric)) is not None}
            if values:
                label = f"{version.name} {kind or ''}".strip() if len(versions) > 1 else kind or version.name
                lines.append(PlotLine(label, values, kind or "", i if len(versions) > 1 else j % 2))
    return lines


def _frames(versions: Sequence[Version], inputs: RenderedInputs | None, track: Track) -> Iterator[ShownFrame]:
    rows = {row.number: row for row in versions[-1].comparison.rows}
    for row in map(rows.__getitem__, track(list(rows))):
        pictures: dict[str, Image] = {}
        low = None if inputs is None else inputs.load(row.number)
        if low is not None:
            pictures |= {INPUT: low, BILINEAR: upsample_centres(low)}
        lines: list[str] = []
        for version in versions:
            # A version called bilinear takes the place of the enlarged input: it is warped to an EF's time.
            pictures[version.name], truth = version.pairs[row.number].load()
            pictures[TRUTH] = truth
            scores = next(r.scores["all"] for r in version.comparison.rows if r.number == row.number)
            prefix = f"{version.name} " if len(versions) > 1 else ""
            ssim = "-" if scores.ssim is None else f"{scores.ssim:.4f}"
            lines.append(f"{prefix}PSNR {scores.psnr_rgb:.2f} dB, SSIM {ssim}")
        pictures[TRUTH] = pictures.pop(TRUTH)
        yield ShownFrame(row.number, row.kind or "", "; ".join(lines), pictures)
