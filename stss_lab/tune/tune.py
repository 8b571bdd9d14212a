# SPDX-License-Identifier: MIT
"""``stss tune``: find the tile sizes that are fastest on a device, and store them for it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from stss.devices.selection import choose
from stss_cl.device.discovery import Device, Properties, matching
from stss_cl.device.tuning import OUTPUTS, Direct, Local, Tuning, Winograd, built_in, read_tuning, store
from stss_ground.errors import DeviceError
from stss_ground.progress import show_steps
from stss_lab.tune.tile_timing import SHAPES, Sizes, Trials, direct_candidates, local_candidates, winograd_candidates

MARGIN = 1.02
"""Factor by which another choice must be faster than the built-in one to replace it."""
ROUNDS = 8
"""Interleaved timings of each candidate."""

Choice = Sizes | str | None
"""Tile sizes, the name of a kernel, or None if a row has none."""


@dataclass(frozen=True)
class Line:
    """The decision on one class of layers.

    Attributes:
        what: the class.
        built_in, best: the built-in choice and the fastest other one; None: no sizes.
        seconds: of both; infinite where it was refused or not timed.
    """

    what: str
    built_in: Choice
    best: Choice
    seconds: tuple[float, float]

    @property
    def new(self) -> bool:
        """Whether the other choice wins."""
        return self.seconds[1] * MARGIN < self.seconds[0]

    @property
    def winner(self) -> Any:
        """The choice that wins."""
        return self.best if self.new else self.built_in


def decide(what: str, built_in: Choice, seconds: Mapping[Any, float]) -> Line:
    """Compare the built-in choice with the fastest other one; ``seconds``: of each choice."""
    others = {choice: s for choice, s in seconds.items() if choice != built_in}
    best = min(others, key=lambda choice: others[choice], default=None)
    return Line(what, built_in, best, (seconds.get(built_in, np.inf), others.get(best, np.inf)))


def tune(
    device: Device, size: tuple[int, int], tell: Callable[[str], None] = lambda line: None
) -> tuple[Tuning, Trials, list[Line]]:
    """Time every candidate on every shape.

    Args:
        device: to tune for.
        size: (height, width) of the frames.
        tell: called with the shape that is being timed.

    Returns:
        The built-in row with the choices that beat it, every timing, and one line for each class of layers.
    """
    base, trials = built_in(device), Trials()
    for shape in SHAPES:
        tell(f"{shape.a + shape.b} to {shape.outputs} channels{', gated' * shape.gated}, stride {shape.stride}")
        candidates: list[Sizes] = [
            base.direct[shape.outputs],
            *direct_candidates(device, shape.outputs),
            *local_candidates(device),
        ]
        if shape.fast:
            candidates += [base.winograd[shape.outputs]] if base.winograd else []
            candidates += winograd_candidates(device, shape.outputs)
        trials.time(device, shape, size, candidates, ROUNDS)

    lines: list[Line] = []
    fast = [shape for shape in SHAPES if shape.fast]
    first = base.winograd or dict.fromkeys(OUTPUTS)
    for outputs in OUTPUTS:
        these = [shape for shape in SHAPES if shape.outputs == outputs]
        lines += [
            decide(f"winograd {outputs}", first[outputs], trials.totals(Winograd, [shape for shape in these if shape.fast])),
            decide(f"direct {outputs}", base.direct[outputs], trials.totals(Direct, these)),
        ]
    winograd, direct = ({n: line.winner for n, line in zip(OUTPUTS, lines[i::2], strict=True)} for i in (0, 1))
    rows = None if base.local is None else Local(base.local.rows)
    plain = sum(trials.total(direct[shape.outputs], [shape]) for shape in SHAPES)
    local = decide("local", rows, trials.totals(Local, SHAPES) | {None: plain})
    by_tiles, by_pixels = (sum(trials.total(kind[s.outputs], [s]) for s in fast) for kind in (winograd, direct))
    by_pixels = min(by_pixels, trials.total(local.winner, fast))
    kernel = decide("kernel", "winograd" if base.winograd else "direct", {"winograd": by_tiles, "direct": by_pixels})
    units = base.local is not None and base.local.matrix_units
    row = Tuning(
        winograd if kernel.winner == "winograd" else None,
        direct,
        None if local.winner is None else Local(local.winner.rows, units),
    )
    return row, trials, [*lines, local, kernel]


def run(name: str | None, size: tuple[int, int], *, console: Console, log: Console) -> None:
    """Run the command.

    Args:
        name: part of the device's name; None: as for `stss.devices.selection.choose`.
        size: (height, width) of the frames.
        console: for the results.
        log: for everything else: progress, rows that are removed.

    Raises:
        DeviceError: there is no such device.
    """
    tell = partial(log.print, markup=False, highlight=False, soft_wrap=True)
    _drop_wrong_rows(name, tell)
    device = choose(name, tell)
    with show_steps(log, len(SHAPES)) as begin:
        row, trials, lines = tune(device, size, begin)
    print_lines(lines, console)
    for (outputs, sizes), why in trials.refused.items():
        console.print(f"refused for {outputs} outputs: {_format(sizes)}: {why}", markup=False, highlight=False, soft_wrap=True)
    new = row != built_in(device)
    path = store(device, row if new else None)
    console.print(f"stored: {path}" if new else "the built-in row stays", markup=False, highlight=False, soft_wrap=True)


def print_lines(lines: list[Line], console: Console) -> None:
    """A table: sizes, milliseconds of all the network's layers of a class, and how many times faster."""
    table = Table(box=None, pad_edge=False)
    for title in ("layers", "built-in", "ms", "best other", "ms", "ratio", "taken"):
        table.add_column(title, justify="right" if title in ("ms", "ratio") else "left")
    for line in lines:
        before, after = line.seconds
        first, second = (f"{1e3 * x:.2f}" if np.isfinite(x) else "-" for x in line.seconds)
        ratio = f"{before / after:.3f}" if after and np.isfinite([before, after]).all() else "-"
        table.add_row(
            line.what, _format(line.built_in), first, _format(line.best), second, ratio, "new" if line.new else "built-in"
        )
    console.print(table, markup=False, highlight=False)


def _format(choice: Choice) -> str:
    if choice is None or isinstance(choice, str):
        return choice or "-"
    return " ".join(str(int(number)) for number in astuple(choice))


def _drop_wrong_rows(name: str | None, tell: Callable[[str], None]) -> None:
    """Remove stored rows that cannot be read: they would fail the self-test of the device that is about to get a new row."""
    for handle in matching(os.environ.get("STSS_DEVICE") if name is None else name).values():
        device = Properties(handle)
        try:
            read_tuning(device)
        except DeviceError as error:
            tell(f"removed: {error}")
            store(device, None)
