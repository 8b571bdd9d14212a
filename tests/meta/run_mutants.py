# SPDX-License-Identifier: MIT
"""``make mutants``: the tests of the quick tier that find each planted fault; the table of docs/conformance.md, by generator.

``python -m tests.meta.run_mutants warp rrm`` tries those of two stages; with ``--found FILE`` it goes on where the last run with this
file stopped, and writes the table when all stages are in it. ``--first`` leaves each fault at the first test that finds it, and takes
minutes.
"""

import argparse
import json
import os
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path
from time import perf_counter, process_time

from conformance.judging.judge import TIERS, Judge
from conformance.mistakes import MISTAKES, find
from conformance.reference_port import ReferencePort
from conformance.suite.run_suite import SUITE, run_suite
from tests.meta.tables import write_between

GENERATORS = {
    "large frames": ("large_frames_agree_with_the_reference", "wide_frames_lose_nothing"),
    "a user's size": ("a_users_size_agrees_in_windows",),
    "constants": ("constants_are_those_of_the_specification",),
    "engines' values": (
        "agrees_on_what_engines_send",
        "a_motion_is_never_lost_in_a_sum",
        "lost_motion_is_off_screen",
        "a_lost_position_is_a_hole",
    ),
    "thresholds": ("agrees_near_the_thresholds", "comparisons_need_all_bits"),
    "state": (
        "the_same_twice",
        "nothing_is_kept_by_a_part_of_the_inputs",
        "every_frame_is_as_if_it_were_the_only_one",
    ),
    "sums": ("what_needs_no_rounding_is_exact", "sums_round_either_way"),
    "scenes": ("agrees_on_rendered_scenes",),
    "steps and buffers": ("agrees_at_the_start_of_a_sequence", "every_buffer_of_every_frame_counts"),
    "drawn": ("agrees_with_the_reference",),
}
"""Names of tests by what makes their cases."""
PROPERTIES = "properties"
"""The name for all other tests, which need no reference."""
ORDER = ("drawn", PROPERTIES, *[name for name in GENERATORS if name != "drawn"])
PAGE = Path(__file__).parents[2] / "docs" / "conformance.md"
MARK = "make mutants"


def generator(test):
    """The generator of a test's cases, by its id."""
    name = test.partition(".")[2]
    return next((word for word, names in GENERATORS.items() if name in names), PROPERTIES)


def failed(name, seed=0, *, every=False):
    """The results of its stage's quick tier that a mutant fails, unshrunken: the first one only, or every one."""
    mutant = find(name)
    judge = Judge(mutant.port(), TIERS["quick"], seed, shrink=False)
    # Nothing before the large frames can find what no small frame shows. In Python, 720 x 1280 takes half a minute.
    only = "large_frames" if mutant.large else "" if not every else "not users_size"
    results = run_suite(judge, [mutant.stage], first_only=not every, only=only)
    return [result for result in results if result.outcome == "failed"]  # an error is the judge's own, and finds nothing


def killers(name, seed=0, every=True):
    """The tests that find a mutant out, and the seconds that took."""
    start = perf_counter()
    return [result.id for result in failed(name, seed, every=every)], perf_counter() - start


def seconds_by_generator():
    """Processor time of the quick tier on the reference, which ends the program if it fails anything."""
    seconds_of, last = Counter(), [process_time()]

    def take(result, _):
        if result.outcome != "passed":
            sys.exit(f"the reference fails {result.id}, so whatever that finds says nothing: {result.message}")
        now = process_time()
        seconds_of[generator(result.id)] += now - last[0]
        last[0] = now

    run_suite(Judge(ReferencePort(), TIERS["quick"]), SUITE, only="not users_size", on_result=take)
    return seconds_of


def table(tests_of, seconds_of):
    """Markdown: a row for each generator. ``found``: the tests by mutant."""
    by = {name: {generator(test) for test in tests} for name, tests in tests_of.items()}
    rows = ["| cases | find | find alone | alone, for example | seconds |", "|---|---|---|---|---|"]
    for word in ORDER:
        finds = [name for name, words in by.items() if word in words]
        alone = [name for name in finds if by[name] == {word}]
        seconds = f"{seconds_of[word]:.1f}" if seconds_of[word] else ""
        rows.append(f"| {word} | {len(finds)} | {len(alone)} | {f'`{alone[0]}`' if alone else ''} | {seconds} |")
    return "\n".join(rows)


def main():
    os.environ["OMP_NUM_THREADS"] = "1"
    parser = argparse.ArgumentParser()
    parser.add_argument("stages", nargs="*", help="stages whose mistakes are tried; none: all")
    parser.add_argument("--seed", type=int, default=0, help="other cases than a user's default ones")
    parser.add_argument("--found", type=Path, help="JSON file of what was found so far")
    parser.add_argument("--first", action="store_true", help="only whether each is found: no table")
    options = parser.parse_args()
    if options.first and options.found is not None:
        parser.error("--first: not with --found, which the table needs whole")
    tests_of = json.loads(options.found.read_text()) if options.found is not None and options.found.exists() else {}
    mutants = [mutant.id for mutant in MISTAKES if not options.stages or mutant.stage in options.stages]
    names = [name for name in mutants if name not in tests_of]
    start = perf_counter()
    with ProcessPoolExecutor() as pool:
        for name, (by, seconds) in zip(
            names, pool.map(killers, names, repeat(options.seed), repeat(not options.first)), strict=True
        ):
            tests_of[name] = by
            print(f"{name:42s} {seconds:5.1f} s  {', '.join(by) or 'SURVIVES'}", flush=True)
            if options.found is not None:
                options.found.write_text(json.dumps(tests_of, indent=0))
    survivors = [name for name in mutants if not tests_of[name]]
    print(f"{len(mutants) - len(survivors)} of {len(mutants)} found out, {perf_counter() - start:.0f} s")
    if not options.seed and not options.first and not survivors and len(tests_of) == len(MISTAKES):
        write_between(PAGE, MARK, table(tests_of, seconds_by_generator()))
    sys.exit(1 if survivors or not mutants else 0)


if __name__ == "__main__":
    main()
