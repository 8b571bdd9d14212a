# SPDX-License-Identifier: MIT
"""Pictures of the tables of `stss stress`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from stss_ground.optional import require
from stss_ground.output.write_whole import make_folder, write_figure
from stss_lab.stress.measure import Results
from stss_lab.stress.table import StressTable

COLORS = {"ref": "black", "cl": "tab:blue", "cl direct": "tab:cyan", "cl half": "tab:orange"}
"""The colour of each engine."""
LEGEND = {"cl half": "cl half (units of 2^-11)"}
"""Names in the legend that differ from the engine's."""
UNITS = "error, units of rounding"
Panel = Callable[[Results, Any], None]


def plot(results: Results, folder: Path) -> tuple[Path, ...]:
    """Draw ``stability_growth.png`` and ``stability_cases.png``, each if all its tables were measured.

    Raises:
        InputError: matplotlib is not installed, or a file can't be written.
    """
    require("matplotlib").use("Agg")
    plt = require("matplotlib.pyplot")
    drawn: list[Path] = []
    for name, panels in PICTURES.items():
        if all(results.table(key) for key in panels):
            figure, axes = plt.subplots(-(-len(panels) // 2), 2, figsize=(9, 2.9 * -(-len(panels) // 2)), layout="constrained")
            try:
                for panel, ax in zip(panels.values(), axes.flat, strict=True):
                    panel(results, ax)
                make_folder(folder)
                write_figure(folder / name, figure, 110)
            finally:
                plt.close(figure)
            drawn.append(folder / name)
    return tuple(drawn)


def _table(results: Results, key: str) -> StressTable:
    table = results.table(key)
    assert table is not None
    return table


def _sweep(key: str, title: str, label: str, base: int = 10) -> Panel:
    """Stage ``network`` over the axis of a sweep, a line for each engine."""

    def draw(results: Results, ax: Any) -> None:
        table = _table(results, key)
        for name, color in COLORS.items():
            if values := table.series("network", name):
                ax.plot(table.axis, values, "o-", ms=3, color=color, label=LEGEND.get(name, name))
        _finish(ax, f"network, {title}", label, UNITS)
        ax.set_xscale("log", base=base)
        ax.legend(fontsize=7)

    return draw


def _layers(results: Results, ax: Any) -> None:
    table = _table(results, "layers")
    names = [str(row[0]) for row in table.rows]
    ax.bar(range(len(names)), table.column("error of its input"), color="black")
    ax.set_xticks(range(len(names)), [name.replace(".conv.double_conv", "") for name in names], rotation=90, fontsize=5)
    ax.set_title("what each convolution reads, ref", loc="left", fontsize=9)
    ax.set_ylabel(UNITS, fontsize=8)


def _columns(key: str, title: str, label: str, unit: str, lines: dict[str, str], base: int = 10) -> Panel:
    """Columns of a table over its first one; ``lines``: column -> its name in the picture."""

    def draw(results: Results, ax: Any) -> None:
        table = _table(results, key)
        places = [_place(str(row[0])) for row in table.rows]
        for column, name in lines.items():
            if column in table.columns:
                values = [value if value > 0 else float("nan") for value in table.column(column)]
                ax.plot(places, values, "o-", ms=3, label=LEGEND.get(name, name), color=COLORS.get(column))
        ax.set_xscale("log", base=base)
        _finish(ax, title, label, unit)
        ax.legend(fontsize=7)

    return draw


def _place(text: str) -> float:
    base, _, power = text.partition("^")
    return float(base) ** float(power) if power else float(text)


def _huge(results: Results, ax: Any) -> None:
    table = _table(results, "huge")
    for name, color in COLORS.items():
        rows = [row for row in table.rows if row[1] == name]
        if rows:
            ax.plot(
                [float(str(row[0])) for row in rows],
                [row[2] for row in rows],
                "o-",
                ms=3,
                color=color,
                label=LEGEND.get(name, name),
            )
    ax.set_xscale("log")
    _finish(ax, "one huge pixel, 3 to 10 pixels away", "its value", UNITS)
    ax.legend(fontsize=7)


def _finish(ax: Any, title: str, label: str, unit: str) -> None:
    ax.set_yscale("log")
    ax.set_title(title, loc="left", fontsize=9)
    ax.set_xlabel(label, fontsize=8)
    ax.set_ylabel(unit, fontsize=8)
    ax.tick_params(labelsize=7)
    ax.grid(alpha=0.3)


PICTURES: dict[str, dict[str, Panel]] = {
    "stability_growth.png": {
        "magnitude": _sweep("magnitude", "larger and smaller inputs", "inputs times"),
        "weights": _sweep("weights", "larger and smaller weights", "weights times", base=2),
        "size": _sweep("size", "larger frames", "side of the frame", base=2),
        "layers": _layers,
    },
    "stability_cases.png": {
        "positions": _columns(
            "positions",
            "hole test, distances within 10 % of the limit",
            "cm from the origin",
            "wrong verdicts, %",
            {
                "float32": "float32",
                "metres, float32": "metres",
                "origin taken off by the renderer": "near origin",
                "half": "half",
            },
        ),
        "motion": _columns(
            "motion",
            "warp of noise",
            "width of the frame",
            "largest error",
            {"colour, p + m": "p + m", "colour, apart": "apart"},
            base=2,
        ),
        "attention": _columns(
            "attention",
            "attention, centre masked",
            "sum of weights",
            "error / largest light",
            {"light, float32": "float32", "half storage": "half", "half, but keys float32": "half, keys float32"},
        ),
        "tone": _columns(
            "tone",
            "transfer hdr",
            "light",
            "relative error",
            {
                "encoded - 1e-6": "encoded - 1e-6",
                "encoded - 1e-3": "encoded - 1e-3",
                "log curve, encoded - 1e-3": "log curve, - 1e-3",
            },
        ),
        "keys": _columns("keys", "erm, keys scaled", "keys times", UNITS, {name: name for name in COLORS}),
        "huge": _huge,
    },
}
"""Picture -> the tables it needs, each with its panel."""
