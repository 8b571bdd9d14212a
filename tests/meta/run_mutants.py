# SPDX-License-Identifier: MIT
"""``make mutants``: which test of the quick tier finds out each planted fault.

``python -m tests.meta.run_mutants SEED`` tries other cases than a user's default ones.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from time import perf_counter

from conformance.judging.judge import TIERS, Judge
from conformance.mistakes import MISTAKES, find
from conformance.suite.run_suite import run_suite


def failed(name, seed=0):
    """The results of its stage's quick tier that a mutant fails; the first one only, unshrunken."""
    mutant = find(name)
    judge = Judge(mutant.port(), TIERS["quick"], seed, shrink=False)
    # Nothing before the large frames can find what no small frame shows.
    results = run_suite(judge, [mutant.stage], first_only=True, only="large_frames" if mutant.large else "")
    return [result for result in results if result.outcome == "failed"]  # an error is the judge's own, and finds nothing


def killers(name, seed=0):
    """The tests that find a mutant out, and the seconds that took."""
    start = perf_counter()
    return [result.id for result in failed(name, seed)], perf_counter() - start


def main():
    os.environ["OMP_NUM_THREADS"] = "1"
    names, seed = [mutant.id for mutant in MISTAKES], int(sys.argv[1]) if sys.argv[1:] else 0
    start = perf_counter()
    with ProcessPoolExecutor() as pool:
        found = dict(zip(names, pool.map(killers, names, repeat(seed), chunksize=2), strict=True))
    survivors = [name for name, (by, _) in found.items() if not by]
    for name, (by, seconds) in found.items():
        print(f"{name:42s} {seconds:5.1f} s  {', '.join(by) or 'SURVIVES'}")
    print(f"{len(names) - len(survivors)} of {len(names)} found out, {perf_counter() - start:.0f} s")
    sys.exit(1 if survivors else 0)


if __name__ == "__main__":
    main()
