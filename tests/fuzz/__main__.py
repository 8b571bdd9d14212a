"""``python -m tests.fuzz --seed S --minutes M [NAMES]``: every fuzzer, or those named, each for its share of the minutes.

A fuzzer is a module of this folder with ``run(seed, seconds) -> cases``. Each runs in a process of its own: a crash of a
native library is a finding, not the end.
"""

import argparse
import importlib
import subprocess
import sys
import time
from pathlib import Path

HELPERS = {"__init__", "__main__", "harness", "test_slices"}
NAMES = sorted({path.stem for path in Path(__file__).parent.glob("*.py")} - HELPERS)
GRACE = 300
"""Seconds that a fuzzer may take beyond its share before it is ended."""


def main():
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=time.time_ns() % 2**32, help="default: another one each time")
    parser.add_argument("--minutes", type=float, default=4, help="all together (default: 4)")
    parser.add_argument("--here", action="store_true", help="in this process; one name")
    parser.add_argument("names", nargs="*", choices=[[], *NAMES], metavar="NAME", help=f"of {', '.join(NAMES)}")
    given = parser.parse_args()
    names = given.names or NAMES
    seconds = 60 * given.minutes / len(names)
    if given.here:
        print(f"{names[0]}: {importlib.import_module(f'tests.fuzz.{names[0]}').run(given.seed, seconds)} cases", flush=True)
        return
    failed = [name for name in names if not _passes(name, given.seed, seconds)]
    print(f"seed {given.seed}: {'failed: ' + ', '.join(failed) if failed else 'all right'}")
    sys.exit(1 if failed else 0)


def _passes(name, seed, seconds):
    command = [sys.executable, "-m", "tests.fuzz", "--here", "--seed", str(seed), "--minutes", str(seconds / 60), name]
    try:
        status = subprocess.run(command, timeout=seconds + GRACE, check=False).returncode
    except subprocess.TimeoutExpired:
        status = "no end"
    if status:
        print(f"{name}: status {status}; again: {' '.join(command[1:])}", flush=True)
    return status == 0


if __name__ == "__main__":
    main()
