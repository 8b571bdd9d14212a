# SPDX-License-Identifier: MIT
"""``make alarms``: right ports with other arithmetic pass the full tier; the table of docs/conformance.md.

``python -m tests.meta.run_false_alarms [PORT or STAGE ...]`` tries some; with ``--found FILE`` it goes on where the last run with this
file stopped, and writes the table when all ports and stages are in it.
"""

import argparse
import json
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import update_wrapper
from itertools import product
from pathlib import Path
from time import perf_counter

from conformance.judging.judge import TIERS, Judge
from conformance.protocol.reference_copy import Copy, Variant
from conformance.protocol.stages import STAGES
from conformance.suite.run_suite import SEQUENCE, SUITE, run_suite
from tests.meta.right_ports import HOW, PLANTS, PORTS, port_in_windows
from tests.meta.samples import samples
from tests.meta.tables import write_between

PAGE = Path(__file__).parents[2] / "docs" / "conformance.md"


def judged(name, tier=TIERS["full"], stages=SUITE):
    """The tests a right port fails, its largest error / bound by stage, and the number of cases, undecided numbers and cases not judged."""
    results = run_suite(Judge(port_in_windows(name), tier), stages)
    worst = dict.fromkeys(STAGES, 0.0)
    for result in results:
        for output, ratio in result.record.worst.items():
            stage = output.split(".")[0]
            worst[stage] = max(ratio, worst[stage])
    counts = [sum(getattr(result.record, what) for result in results) for what in ("cases", "undecided", "unjudged")]
    return [f"{r.id}: {r.message}" for r in results if r.outcome not in ("passed", "skipped")], worst, counts


def judged_pair(pair):
    """What `judged` gives for a port and one stage of the suite."""
    return judged(pair[0], stages=[pair[1]])


class Called(Copy):
    """A copy that says whether any function was called that a plant put into it."""

    called = False

    def put(self, name, value):
        def noted(*arguments, **keywords):
            self.called = True
            return value(*arguments, **keywords)

        super().put(name, update_wrapper(noted, value))


def stands_for(name, stage):
    """The port that is judged in the place of ``name``: ``as_is`` at a stage that calls nothing of the other's own."""
    if "entry" in HOW.get(name, {}):
        return name
    copy = Called()
    for plant in PLANTS[name]:
        plant(copy)
    run = Variant(name, copy).run
    for case in samples("frame" if stage == SEQUENCE else stage):
        run(case.stage, case.inputs, case.weights)
        if copy.called:
            return name
    return "as_is"


def table(found):
    """Markdown: a row for each port; ``found`` is what `judged` gave, by "PORT STAGE"."""
    stages = [stage for stage in STAGES if stage != "rrm"]
    rows = ["| port | " + " | ".join(stages) + " |", "|---|" + "---|" * len(stages)]
    for name in PORTS:
        worsts = [found[f"{name} {stage}"][1] for stage in SUITE]
        rows.append(f"| `{name}` | " + " | ".join(f"{max(worst[stage] for worst in worsts):.2g}" for stage in stages) + " |")
    return "\n".join(rows)


def main():
    os.environ["OMP_NUM_THREADS"] = "1"
    parser = argparse.ArgumentParser()
    parser.add_argument("some", nargs="*", metavar="PORT or STAGE", help="none: all")
    parser.add_argument("--found", type=Path, help="JSON file of what was found so far")
    options = parser.parse_args()
    if unknown := [name for name in options.some if name not in (*PORTS, *SUITE)]:
        parser.error(f"{', '.join(unknown)}: expected some of {', '.join((*PORTS, *SUITE))}")
    found = json.loads(options.found.read_text()) if options.found is not None and options.found.exists() else {}
    names, stages = ([name for name in some if name in options.some] or some for some in (PORTS, SUITE))
    pairs = {(name, stage): (stands_for(name, stage), stage) for stage, name in product(stages, names)}
    missing = [pair for pair in dict.fromkeys(pairs.values()) if " ".join(pair) not in found]
    start = perf_counter()
    with ProcessPoolExecutor() as pool:
        for (name, stage), (alarms, worst, counts) in zip(missing, pool.map(judged_pair, missing), strict=True):
            found[f"{name} {stage}"] = alarms, worst, counts
            cases, undecided, unjudged = counts
            largest = max(worst.values())
            print(f"{name} {stage}: {largest:.2g}; {cases} cases, {undecided} numbers decided by rounding, {unjudged} not judged")
            for alarm in alarms:
                print("    FALSE ALARM", alarm)
            sys.stdout.flush()  # minutes pass before the next one
            if options.found is not None:
                options.found.write_text(json.dumps(found, indent=0))
    print(f"{perf_counter() - start:.0f} s")
    found |= {" ".join(pair): found[" ".join(other)] for pair, other in pairs.items()}
    if len(found) == len(PORTS) * len(SUITE):
        write_between(PAGE, "make alarms", table(found))
    sys.exit(1 if any(found[" ".join(pair)][0] for pair in pairs) else 0)


if __name__ == "__main__":
    main()
