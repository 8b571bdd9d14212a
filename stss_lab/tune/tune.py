# SPDX-License-Identifier: MIT
"""``stss tune``: find the tile sizes that are fastest on a device, and store them for it."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from dataclasses import astuple, dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from stss.devices.selection import choose
from stss_cl.device.discovery import Device, DeviceError, Properties, matching
from stss_cl.device.tuning import OUTPUTS, Direct, Local, Tuning, Winograd, built_in, store, stored, stored_path, to_toml
from stss_lab.tune.tile_timing import SHAPES, LayerShape, Sizes, Trials, direct_candidates, local_candidates, winograd_candidates

MARGIN = 1.02
"""Factor by which other sizes must be faster than the built-in ones to replace them."""
ROUNDS, DUEL = 5, 12
"""Interleaved timings of each candidate, and then of the best one and the built-in sizes: the best of many is partly luck."""


@dataclass(frozen=True)
class Line:
    """One class of layers: the built-in sizes, the fastest others or None, the seconds of both, and the decision."""

    what: str
    built_in: Sizes | None
    best: Sizes | None
    seconds: tuple[float, float]
    decision: str


def tune(
    device: Device, size: tuple[int, int], tell: Callable[[str], None] = lambda line: None
) -> tuple[Tuning, Trials, list[Line]]:
    """Time every candidate on every shape.

    Args:
        device: to tune for.
        size: (height, width) of the frames.
        tell: called with the shape that is being timed.

    Returns:
        The built-in row with the sizes that beat it, every timing, and one line for each class of layers.
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
    found, lines = _decide(device, size, base, trials)
    return found, trials, lines


def _decide(device: Device, size: tuple[int, int], base: Tuning, trials: Trials) -> tuple[Tuning, list[Line]]:
    lines: list[Line] = []
    winograd: dict[int, Winograd] = {}
    for outputs in OUTPUTS:
        shapes = [s for s in SHAPES if s.outputs == outputs and s.fast]
        first = base.winograd[outputs] if base.winograd else None
        best, line = _better(device, size, trials, f"winograd {outputs}", first, winograd_candidates(device, outputs), shapes)
        lines.append(line)
        if isinstance(best, Winograd):
            winograd[outputs] = best
    fast = winograd if len(winograd) == len(OUTPUTS) and _worth_it(base, trials, winograd) else None

    direct: dict[int, Direct] = {}
    for outputs in OUTPUTS:
        every = [s for s in SHAPES if s.outputs == outputs]
        used = [s for s in every if not s.fast or fast is None]
        first = base.direct[outputs]
        # The precision float32-direct uses them everywhere: nothing may be lost there.
        allowed = [c for c in direct_candidates(device, outputs) if trials.total(c, every) <= trials.total(first, every)]
        best, line = _better(device, size, trials, f"direct {outputs}", first, allowed, used)
        lines.append(line)
        direct[outputs] = best if isinstance(best, Direct) else first
    local, line = _local(device, base, trials, direct)
    return Tuning(fast, direct, local), [*lines, *line]


def _local(device: Device, base: Tuning, trials: Trials, direct: dict[int, Direct]) -> tuple[Local | None, list[Line]]:
    """Rows of conv_local.cl for all layers, or none where the direct convolution is faster; what counts is decided by the margin."""
    candidates = local_candidates(device)
    if not candidates:
        return base.local, []
    seconds = {candidate: trials.total(candidate, SHAPES) for candidate in candidates}
    best = min(candidates, key=lambda candidate: seconds[candidate])
    plain = sum(trials.total(direct[shape.outputs], [shape]) for shape in SHAPES)
    before = None if base.local is None else Local(base.local.rows)
    now = plain if before is None else seconds[before]
    units = base.local is not None and base.local.matrix_units
    if before is not None and plain * MARGIN < min(now, seconds[best]):
        return None, [Line("local", before, None, (now, plain), "direct")]
    wins = seconds[best] * MARGIN < now
    taken = Local(best.rows, units) if wins else base.local
    return taken, [Line("local", before, best, (now, seconds[best]), "new" if wins else "built-in")]


def _worth_it(base: Tuning, trials: Trials, winograd: dict[int, Winograd]) -> bool:
    """Whether to use Winograd: it beats the direct convolution, or it is built in and the direct one does not beat it."""
    shapes = [s for s in SHAPES if s.fast]
    fast = sum(trials.total(winograd[s.outputs], [s]) for s in shapes)
    plain = 0.0
    for outputs in OUTPUTS:
        these = [s for s in shapes if s.outputs == outputs]
        tried = {sizes for s in these for sizes in trials.times[s] if isinstance(sizes, Direct)}
        plain += min((trials.total(sizes, these) for sizes in tried), default=np.inf)
    plain = min(plain, *(trials.total(sizes, shapes) for sizes in (Local(1), Local(2))))
    return fast * MARGIN < plain if base.winograd is None else fast < plain * MARGIN


def _better(
    device: Device,
    size: tuple[int, int],
    trials: Trials,
    what: str,
    first: Sizes | None,
    candidates: Collection[Sizes],
    shapes: list[LayerShape],
) -> tuple[Sizes | None, Line]:
    """The fastest candidate if it still beats the built-in sizes by the margin in a second round, else the built-in sizes."""
    others = [c for c in candidates if c != first and np.isfinite(trials.total(c, shapes))]
    if not shapes or not others:
        return first, Line(what, first, None, (trials.total(first, shapes), np.inf), "not used" if not shapes else "built-in")
    best = min(others, key=lambda c: trials.total(c, shapes))
    seconds = trials.total(first, shapes), trials.total(best, shapes)
    if first is not None and seconds[0] > MARGIN * seconds[1] and np.isfinite(seconds[0]):
        again = Trials()
        for shape in shapes:
            again.time(device, shape, size, (first, best), DUEL)
        seconds = again.total(first, shapes), again.total(best, shapes)
    wins = first is None or seconds[0] > MARGIN * seconds[1]
    return best if wins else first, Line(what, first, best, seconds, "new" if wins else "built-in")


def run(name: str | None, size: tuple[int, int], *, show: bool, console: Console, tell: Callable[[str], None]) -> None:
    """Run the command.

    Args:
        name: part of the device's name; None: as for `stss.devices.selection.choose`.
        size: (height, width) of the frames.
        show: print the row in use and time nothing.
        console: for the results.
        tell: called with a line for every step.

    Raises:
        DeviceError: there is no such device, or with ``show`` its stored row is wrong.
    """
    if not show:
        _drop_wrong_rows(name, tell)
    device = choose(name, tell)
    if show:
        row = stored(device)
        source = f"stored in {stored_path(device)}" if row else "built-in"
        console.print(
            f"# {device.name}, {device.driver}: {source}",
            to_toml(row or built_in(device)),
            sep="\n",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
        return
    found, trials, lines = tune(device, size, tell)
    print_lines(lines, console)
    for (outputs, sizes), why in trials.refused.items():
        console.print(f"refused for {outputs} outputs: {_shown(sizes)}: {why}", markup=False, highlight=False, soft_wrap=True)
    new = found != built_in(device)
    path = store(device, found if new else None)
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
        table.add_row(line.what, _shown(line.built_in), first, _shown(line.best), second, ratio, line.decision)
    console.print(table, markup=False, highlight=False)


def _shown(sizes: Sizes | None) -> str:
    return "-" if sizes is None else " ".join(str(int(number)) for number in astuple(sizes))


def _drop_wrong_rows(name: str | None, tell: Callable[[str], None]) -> None:
    """Remove stored rows that cannot be read: they would fail the self-test of the device that is about to get a new row."""
    for handle in matching(os.environ.get("STSS_DEVICE") if name is None else name).values():
        device = Properties(handle)
        try:
            stored(device)
        except DeviceError as error:
            tell(f"removed: {error}")
            store(device, None)
