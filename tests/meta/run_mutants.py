# SPDX-License-Identifier: MIT
"""``make mutants``: what in the quick tier finds each planted fault first, and whether anything else does; writes docs/conformance.md.

``python -m tests.meta.run_mutants warp rrm`` tries those of two stages, and writes no table.
"""

import argparse
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


def failed(name, seed=0, but=None):
    """The first result of its stage's quick tier that a mutant fails, unshrunken, of any generator but one; at most one."""
    mutant = find(name)
    judge = Judge(mutant.port(), TIERS["quick"], seed, shrink=False)
    others = [test for word, names in GENERATORS.items() if word != but for test in names]
    # Nothing before the large frames can find what no small frame shows. In Python, 720 x 1280 takes half a minute.
    only = "large_frames" if mutant.large else "not users_size"
    if but is not None:
        only += f" and ({' or '.join(others)})" if but == PROPERTIES else f" and not ({' or '.join(GENERATORS[but])})"
    results = run_suite(judge, [mutant.stage], first_only=True, only=only)
    return [result for result in results if result.outcome == "failed"]  # an error is the judge's own, and finds nothing


def killers(name, seed=0):
    """The first test that finds a mutant out, the first one of another generator, and the seconds that took."""
    start = perf_counter()
    first = failed(name, seed)
    others = failed(name, seed, generator(first[0].id)) if first and not find(name).large else []
    return [result.id for result in (*first, *others)], perf_counter() - start


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
    """Markdown: a row for each generator. ``tests_of``: what `killers` gives, by mutant."""
    by = {name: [generator(test) for test in tests] for name, tests in tests_of.items()}
    rows = ["| cases | find first | find alone | alone, for example | seconds |", "|---|---|---|---|---|"]
    for word in ORDER:
        finds = [name for name, words in by.items() if words[0] == word]
        alone = [name for name in finds if len(by[name]) == 1]
        seconds = f"{seconds_of[word]:.1f}" if seconds_of[word] else ""
        rows.append(f"| {word} | {len(finds)} | {len(alone)} | {f'`{alone[0]}`' if alone else ''} | {seconds} |")
    return "\n".join(rows)


def main():
    os.environ["OMP_NUM_THREADS"] = "1"
    parser = argparse.ArgumentParser()
    parser.add_argument("stages", nargs="*", help="stages whose mistakes are tried; none: all")
    parser.add_argument("--seed", type=int, default=0, help="other cases than a user's default ones")
    options = parser.parse_args()
    names = [mutant.id for mutant in MISTAKES if not options.stages or mutant.stage in options.stages]
    tests_of, start = {}, perf_counter()
    with ProcessPoolExecutor() as pool:
        for name, (by, seconds) in zip(names, pool.map(killers, names, repeat(options.seed)), strict=True):
            tests_of[name] = by
            print(f"{name:42s} {seconds:5.1f} s  {', '.join(by) or 'SURVIVES'}", flush=True)
    survivors = [name for name in names if not tests_of[name]]
    print(f"{len(names) - len(survivors)} of {len(names)} found out, {perf_counter() - start:.0f} s")
    if not options.seed and not survivors and len(names) == len(MISTAKES):
        write_between(PAGE, MARK, table(tests_of, seconds_by_generator()))
    sys.exit(1 if survivors or not names else 0)


if __name__ == "__main__":
    main()
