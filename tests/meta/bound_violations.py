# SPDX-License-Identifier: MIT
# ruff: noqa: T201
"""``make misses``: how often ``--skip bounded`` breaks its promise, over many random sequences; the table of docs/skipping.md."""

import argparse
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from stss.frames.display_frame import window_at
from stss.frames.supersample import plan
from stss.sequence.scenes import display_frames
from stss.weights.file import load
from stss_cl.skip.stream import Stream
from training.scenes import random_film

PAGE = Path(__file__).parents[2] / "docs" / "skipping.md"
FIRST, LAST = "<!-- written by make misses -->", "<!-- end -->"


@dataclass
class Tally:
    """What became of the frames at one largest error: sequences and frames of which a part was left out, and their departures."""

    sequences: set[int] = field(default_factory=set)
    departures: list[float] = field(default_factory=list)

    def row(self, error):
        ratios = np.array(self.departures) / error
        missed, count = int((ratios > 1).sum()), len(ratios)
        if not count:
            return f"| {error * 255:g}/255 | 0 | 0 | 0 | | |"
        share = binomtest(missed, count).proportion_ci(0.90, "exact").high  # the upper end of two sides of 5 % each
        return f"| {error * 255:g}/255 | {len(self.sequences)} | {count} | {missed} | {share:.2%} | {ratios.max():.2f} |"


def measure(seed, weights, errors, size, count, tallies):
    """One random film: every frame against the one of ``--skip off``."""
    frames = list(display_frames(random_film(seed).scene, size, count))
    full = Stream(weights, skip="off")
    streams = {error: Stream(weights, full.device, skip="bounded", max_error=error) for error in errors}
    for number in range(count):
        window = window_at(frames, number)
        steps = plan(window).steps
        image = full(window, steps)[0]
        for error, stream in streams.items():
            departure = float(np.abs(stream(window, steps)[0] - image).max())
            if departure or stream.report.network == "changed":
                tallies[error].sequences.add(seed)
                tallies[error].departures.append(departure)


def positive(text):
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected at least 1, got {text}")
    return number


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sequences", type=positive, default=100)
    parser.add_argument("--first", type=int, default=10**6, help="number of the first film; training has those from 0 on")
    parser.add_argument("--frames", type=positive, default=32)
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--weights", default="realtime")
    parser.add_argument("--levels", default="1,2,4", help="largest errors, in steps of 8 bits")
    parser.add_argument("--write", action="store_true", help="put the table into docs/skipping.md")
    given = parser.parse_args()
    width, height = map(int, given.size.split("x"))
    errors = [float(level) / 255 for level in given.levels.split(",")]
    tallies, weights = defaultdict(Tally), load(given.weights).weights
    for seed in range(given.first, given.first + given.sequences):
        measure(seed, weights, errors, (height, width), given.frames, tallies)
    head = [
        "| `--max-error` | films | frames in part | beyond it | share at most (95 %) | worst / allowed |",
        "|---|---|---|---|---|---|",
    ]
    table = "\n".join([*head, *(tallies[error].row(error) for error in errors)])
    print(table)
    if given.write:
        before, rest = PAGE.read_text(encoding="utf-8").split(FIRST)
        PAGE.write_text(f"{before}{FIRST}\n\n{table}\n\n{LAST}{rest.split(LAST, 1)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
