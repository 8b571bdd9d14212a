"""``python -m tests.offline [TARGET ...]``: every program of the GPU rows compiled for GPUs that are not there, against budgets.

Registers, stack, spills and local memory, from clang, libclc, ptxas and ocloc. The drivers' compilers differ: the table shows the
expected figures, not theirs.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from stss_cl.device.program import source
from tests.offline.budgets import faults
from tests.offline.compilers import CompileError, MissingError, compiled, require
from tests.offline.programs import programs

TARGETS = ("sm_80", "sm_90", "gfx1100", "gfx90a", "dg2")
TITLES = ("kernel", "options", "registers", "stack", "spilled", "local", "over budget")


def main():
    parser = argparse.ArgumentParser(prog="python -m tests.offline", description=__doc__)
    parser.add_argument("targets", nargs="*", default=TARGETS, metavar="TARGET", help=f"default: {' '.join(TARGETS)}")
    options = parser.parse_args()
    wrong, examined = 0, []
    for target in options.targets:
        try:
            require(target)
        except MissingError as error:
            print(f"skipped: {target}: {error}", flush=True)
            continue
        wrong += examine(target)
        examined.append(target)
    print(f"{', '.join(examined) or 'nothing'}: {wrong} over budget")
    sys.exit(1 if wrong else 0)


def examine(target):
    """Print the table of one target; how many kernels exceed their budget."""
    wrong, table = 0, Table(*TITLES, title=target, box=None, pad_edge=False, title_justify="left")
    with tempfile.TemporaryDirectory() as folder:
        for program in programs(row_of(target)):
            try:
                results = compiled(source(program.file), program.options, program.kernels, target, Path(folder))
            except CompileError as error:
                wrong += 1
                table.add_row(program.file, program.label, *4 * [""], str(error))
                continue
            for kernel, code in results.items():
                over = faults(kernel, code, target)
                wrong += bool(over)
                table.add_row(kernel, program.label, *map(str, code), "; ".join(over))
    Console(width=None if sys.stdout.isatty() else 200).print(table, markup=False, highlight=False)
    return wrong


def row_of(target):
    """The row of ``tuning.toml`` that counts for a target."""
    return "nvidia" if target.startswith("sm_") else "amd" if target.startswith("gfx") else "intel"


if __name__ == "__main__":
    main()
