# SPDX-License-Identifier: MIT
"""Plot a score of each frame: lines in SVG whose points link to their frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 640, 240
LEFT, RIGHT, TOP, BOTTOM = 72, 20, 12, 36
"""Margins, in units of the drawing."""
COLOURS = 8
"""Classes ``c0`` to ``c7`` of ``viewer.css``."""
TICKS = 5


@dataclass(frozen=True)
class PlotLine:
    """The scores of some frames.

    Attributes:
        name: for the legend.
        values: frame to score; infinite ones are drawn at the upper edge.
        kind: "SF", drawn with circles and a whole line; "EF", squares and a broken line; "" where it is not known, as SF.
        colour: which of `COLOURS`.
    """

    name: str
    values: Mapping[int, float]
    kind: str
    colour: int


def plot(title: str, lines: Sequence[PlotLine], *, digits: int, frames: Sequence[int] = ()) -> str:
    """Draw a figure as markup.

    Args:
        title: the score's name and unit.
        lines: at least one, with at least one value.
        digits: digits after the decimal point of a point's value.
        frames: numbers of frames that the axis shows besides those with values, so that several plots have one axis.
    """
    numbers = sorted({*frames, *(number for line in lines for number in line.values)})
    values = [value for line in lines for value in line.values.values() if math.isfinite(value)] or [0.0]
    low, high, step = _scale(min(values), max(values))
    span = max(numbers[-1] - numbers[0], 1)

    def x(number: int) -> float:
        return LEFT + (number - numbers[0]) / span * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        return HEIGHT - BOTTOM - min((value - low) / (high - low), 1) * (HEIGHT - TOP - BOTTOM)

    decimals = max(0, -math.floor(math.log10(step)))
    ticks = [low + i * step for i in range(round((high - low) / step) + 1)]
    marks = [
        f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(t):.1f}" y2="{y(t):.1f}"/>'
        f'<text x="{LEFT - 5}" y="{y(t) + 4:.1f}" text-anchor="end">{t:.{decimals}f}</text>'
        for t in ticks
    ]
    first, *others = numbers[:: max(1, math.ceil(len(numbers) / 8))]  # as many as fit below the plot
    below = [(first, f"frame {first}"), *((n, str(n)) for n in others)]
    marks += [f'<text x="{x(n):.1f}" y="{HEIGHT - 8}" text-anchor="middle">{text}</text>' for n, text in below]
    marks.append(f'<line class="at" x1="{LEFT}" x2="{LEFT}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
    for line in lines:
        places = [(number, value, x(number), y(value)) for number, value in sorted(line.values.items())]
        path = " ".join(f"{px:.1f},{py:.1f}" for _, _, px, py in places)
        points = "".join(_point(line, number, f"{value:.{digits}f}", px, py) for number, value, px, py in places)
        marks.append(f'<g class="c{line.colour % COLOURS} {line.kind}"><polyline class="line" points="{path}"/>{points}</g>')
    legend = "".join(f'<li class="c{line.colour % COLOURS}">{_sample(line)} {escape(line.name)}</li>' for line in lines)
    label = escape(title)
    return (
        f'<figure><figcaption>{label}</figcaption><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="group" '
        f'aria-label="{label}, for each frame">{"".join(marks)}</svg><ul class="legend">{legend}</ul></figure>'
    )


def _scale(low: float, high: float) -> tuple[float, float, float]:
    """Ends and steps of the axis: 1, 2 or 5 times a power of ten, about `TICKS` of them."""
    rough = max(high - low, 1e-3 * max(abs(high), 1)) / TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough)
    first, last = math.floor(low / step), math.ceil(high / step)
    return first * step, max(last, first + 1) * step, step


def _point(line: PlotLine, number: int, value: str, x: float, y: float) -> str:
    what = escape(f"frame {number}, {line.name}: {value}")
    # No stops for the Tab key: there would be hundreds, and the keyboard has other ways to a frame.
    return (
        f'<a class="point" href="#frame-{number}" tabindex="-1" data-frame="{number}" data-x="{x:.1f}" aria-label="{what}">'
        f'<title>{what}</title><circle class="hit" cx="{x:.1f}" cy="{y:.1f}" r="9"/>{_mark(line.kind, x, y)}</a>'
    )


def _mark(kind: str, x: float, y: float) -> str:
    if kind == "EF":
        return f'<rect x="{x - 3:.1f}" y="{y - 3:.1f}" width="6" height="6"/>'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>'


def _sample(line: PlotLine) -> str:
    return "&#9632;" if line.kind == "EF" else "&#9679;"
