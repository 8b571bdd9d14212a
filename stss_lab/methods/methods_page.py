# SPDX-License-Identifier: MIT
"""The page of ``stss methods``: the frames of every method, their scores as plots, and a table of means."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stss.quality.comparison_page import RenderedInputs, Version, write_comparison
from stss.quality.output_and_truth import find_pairs
from stss.sequence.sequence import Sequence as Frames
from stss_ground.pages.page import table
from stss_ground.progress import Track
from stss_lab.methods.methods_table import MethodResult, caption, cells, holes_of


def methods_page(
    path: Path,
    results: Sequence[MethodResult],
    truth: Path,
    sequence: Frames,
    frames: tuple[int, int] | None = None,
    track: Track = iter,
) -> None:
    """Write the page.

    Args:
        path: the file.
        results: from `stss_lab.methods.methods_table.run_methods`.
        truth: the folder of the truth.
        sequence: the input of the methods.
        frames: first and last to show, both included; None: all.
        track: may show how many frames are done.

    Raises:
        InputError: a file can't be read or the page can't be written.
    """
    run = next(r.folder for r in results if r.method == holes_of([r.method for r in results]))
    versions = [
        Version(r.method, f"Method {r.method}: docs/metrics.md.", find_pairs(r.folder, truth, frames, holes=run)[0], r.comparison)
        for r in results
    ]
    headings, rows = cells(results)
    means = table(f"Every method: {caption(results)}", [f"{above.strip()}\n{kind}" for above, kind in headings], rows)
    inputs = RenderedInputs(sequence, versions[-1].pairs)
    write_comparison(path, f"Methods compared on {sequence.path.name}", versions, inputs, [means], track=track)
