# SPDX-License-Identifier: MIT
# ruff: noqa: T201
"""``make misses``: how often ``--skip bounded`` breaks its promise, over many random sequences; the table of docs/skipping.md."""

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from stss.cluster.client import connected, crew
from stss.errors import InputError
from stss.frames.display_frame import window_at
from stss.frames.supersample import plan
from stss.sequence.scenes import display_frames
from stss.weights.file import load
from stss_cl.device.discovery import open_device
from stss_cl.skip.stream import Stream
from training.scenes import random_film

PAGE = Path(__file__).parents[2] / "docs" / "skipping.md"
FIRST, LAST = "<!-- written by make misses -->", "<!-- end -->"


@dataclass
class Tally:
    """The frames at one largest error: how many sequences and frames had a part left out, and their departures."""

    sequences: set[int] = field(default_factory=set)
    departures: list[float] = field(default_factory=list)

    def row(self, error):
        ratios = np.array(self.departures) / error
        missed, count = int((ratios > 1).sum()), len(ratios)
        if not count:
            return f"| {error * 255:g}/255 | 0 | 0 | 0 | | |"
        share = binomtest(missed, count).proportion_ci(0.90, "exact").high  # the upper end of two sides of 5 % each
        return f"| {error * 255:g}/255 | {len(self.sequences)} | {count} | {missed} | {share:.2%} | {ratios.max():.2f} |"


class Films:
    """What is measured of every film, by this process or by a worker; ``weights`` and the like are sent to each worker once."""

    def __init__(self, weights, errors, size, count):
        self.weights, self.errors, self.size, self.count = weights, errors, size, count

    def introduce(self):
        """The device, with its driver."""
        device = open_device()
        return f"{device.name}, {device.driver}"

    def measure(self, seed):
        """One random film, every frame against the one of ``--skip off``: by largest error, departures of the frames in part."""
        frames = list(display_frames(random_film(seed).scene, self.size, self.count))
        full = Stream(self.weights, skip="off")
        streams = {error: Stream(self.weights, full.device, skip="bounded", max_error=error) for error in self.errors}
        found = {error: [] for error in self.errors}
        for number in range(self.count):
            window = window_at(frames, number)
            steps = plan(window).steps
            image = full(window, steps)[0]
            for error, stream in streams.items():
                departure = float(np.abs(stream(window, steps)[0] - image).max())
                if departure or stream.report.network == "changed":
                    found[error].append(departure)
        return found


def departures(films, seeds, cluster):
    """Each film's, in the order of ``seeds``."""
    if cluster is None:
        yield from map(films.measure, seeds)
        return
    with connected(cluster) as client, crew(client, lambda: films) as workers:
        if len(kinds := sorted(set(workers.introductions().values()))) > 1:
            raise InputError(f"--cluster: workers' devices differ, and so would their bits: {'; '.join(kinds)}")
        # A film whose worker dies is measured again by another worker or by its successor.
        for future in [workers.submit("measure", seed) for seed in seeds]:
            yield future.result()


def tallied(films, seeds, cluster):
    """What became of the films, by largest error."""
    tallies = {error: Tally() for error in films.errors}
    for seed, found in zip(seeds, departures(films, seeds, cluster), strict=True):
        for error, some in found.items():
            tallies[error].sequences |= {seed} if some else set()
            tallies[error].departures += some
    return tallies


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
    parser.add_argument("--cluster", help="measure on local:N processes, or on the workers of a scheduler: tcp://host:8786")
    parser.add_argument("--write", action="store_true", help="put the table into docs/skipping.md")
    given = parser.parse_args()
    width, height = map(int, given.size.split("x"))
    errors = [float(level) / 255 for level in given.levels.split(",")]
    films = Films(load(given.weights).weights, errors, (height, width), given.frames)
    try:
        tallies = tallied(films, range(given.first, given.first + given.sequences), given.cluster)
    except InputError as error:
        parser.error(str(error))
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
