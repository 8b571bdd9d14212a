# SPDX-License-Identifier: MIT
"""``make alarms``: right ports with other arithmetic pass the full tier; the table of docs/conformance.md.

``python -m tests.meta.run_false_alarms [PORT or STAGE ...]`` tries some, and writes no table.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from time import perf_counter

from conformance.judging.judge import TIERS, Judge
from conformance.protocol.stages import STAGES
from conformance.suite.run_suite import SUITE, run_suite
from tests.meta.right_ports import PORTS, port
from tests.meta.tables import write_between

PAGE = Path(__file__).parents[2] / "docs" / "conformance.md"


def judged(name, tier=TIERS["full"], stages=SUITE):
    """The tests a right port fails, its largest error / bound by stage, and the number of cases, undecided numbers and cases not judged."""
    results = run_suite(Judge(port(name), tier), stages)
    worst = dict.fromkeys(STAGES, 0.0)
    for result in results:
        for output, ratio in result.record.worst.items():
            stage = output.split(".")[0]
            worst[stage] = max(ratio, worst[stage])
    counts = [sum(getattr(result.record, what) for result in results) for what in ("cases", "undecided", "unjudged")]
    return [f"{r.id}: {r.message}" for r in results if r.outcome not in ("passed", "skipped")], worst, counts


def table(found):
    """Markdown: a row for each port."""
    stages = [stage for stage in STAGES if stage != "rrm"]
    rows = ["| port | " + " | ".join(stages) + " |", "|---|" + "---|" * len(stages)]
    for name, (_, worst, _) in found.items():
        rows.append(f"| `{name}` | " + " | ".join(f"{worst[stage]:.2g}" for stage in stages) + " |")
    return "\n".join(rows)


def main():
    os.environ["OMP_NUM_THREADS"] = "1"
    start = perf_counter()
    if unknown := [name for name in sys.argv[1:] if name not in (*PORTS, *SUITE)]:
        sys.exit(f"{', '.join(unknown)}: expected some of {', '.join((*PORTS, *SUITE))}")
    names, stages = ([name for name in sys.argv[1:] if name in some] or list(some) for some in (PORTS, SUITE))
    ratios = {}
    with ProcessPoolExecutor() as pool:
        for name, (alarms, worst, counts) in zip(names, pool.map(partial(judged, stages=stages), names), strict=True):
            ratios[name] = alarms, worst, counts
            print(f"{name}: {counts[0]} cases, {counts[1]} numbers decided by rounding, {counts[2]} cases not judged")
            print("   ", ", ".join(f"{stage} {ratio:.2g}" for stage, ratio in worst.items()))
            for alarm in alarms:
                print("    FALSE ALARM", alarm)
            sys.stdout.flush()  # minutes pass before the next port
    print(f"{perf_counter() - start:.0f} s")
    if not sys.argv[1:]:
        write_between(PAGE, "make alarms", table(ratios))
    sys.exit(1 if any(alarms for alarms, _, _ in ratios.values()) else 0)


if __name__ == "__main__":
    main()
