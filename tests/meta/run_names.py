# SPDX-License-Identifier: MIT
"""``python -m tests.meta.run_names [STAGE ...]``: what the diagnosis says of each planted fault, and of each as if no list had it.

A wrong name is worse than none: a fault that is in no list has to look like none, or like one whose numbers are the same.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor

from conformance.explain import diagnosis
from conformance.explain.diagnosis import diagnose, suspects
from conformance.explain.first_layer import first_departure
from conformance.judging.findings import MOST_WRONG, DepartureError
from conformance.judging.judge import Judge, agreement
from conformance.mistakes import MISTAKES, find
from conformance.suite.run_suite import SUITE
from tests.meta.samples import samples


def named(mistake, listed=True):
    """The diagnosis of the samples that a fault gets wrong, and words on the first layer that departs.

    Args:
        mistake: the planted fault.
        listed: whether the diagnosis knows it.
    """
    judge, findings = Judge(mistake.port()), []
    for case in samples(mistake.stage):
        try:
            judge.check(agreement, case)
        except DepartureError as error:
            findings.append(error.finding)
            if len(findings) == MOST_WRONG:
                break
    if not findings:
        return "", ""
    diagnosis.suspects = lambda stage: tuple(each for each in suspects(stage) if listed or each is not mistake)
    try:
        return diagnose(judge, findings), first_departure(judge, findings[0])
    finally:
        diagnosis.suspects = suspects


def of(name):
    """What is said with the fault in the list, and without it."""
    return named(find(name)), named(find(name), listed=False)


def main():
    os.environ["OMP_NUM_THREADS"] = "1"
    if unknown := set(sys.argv[1:]) - set(SUITE):
        sys.exit(f"{', '.join(sorted(unknown))}: expected some of {', '.join(SUITE)}")
    stages = sys.argv[1:] or SUITE
    names = [mistake.id for mistake in MISTAKES if mistake.stage in stages and not mistake.large]
    unnamed = strange = 0
    with ProcessPoolExecutor() as pool:
        for name, ((said, layer), (unlisted, _)) in zip(names, pool.map(of, names), strict=True):
            unnamed += find(name).what not in said
            strange += "looks like: " in unlisted
            print(f"{name}: {said or 'no sample shows it'}")
            print(f"    in no list: {unlisted}")
            if layer:
                print(f"    {layer}", flush=True)
    print(f"{len(names)} faults: {unnamed} without their name; {strange} with another's if no list had them")


if __name__ == "__main__":
    main()
