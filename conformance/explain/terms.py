# SPDX-License-Identifier: MIT
"""The terms of a wrong pixel of an image stage: the values in the formula of docs/stages.md, as the reference computes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import largest
from conformance.judging.findings import Finding
from conformance.protocol.stages import hole_test, reference
from stss_ref.accumulate import box, slowness
from stss_ref.constants import EARLIER_SHARES, HoleLimits
from stss_ref.holes import squared_footprint
from stss_ref.motion_chain import chain_steps, gather_longest, truncated
from stss_ref.occlusion_warp import FARTHEST, splat
from stss_ref.reshade import four_samples, shows_surface
from stss_ref.sample import Place, between, bilinear, follow, leads_inside, taps

Float64 = NDArray[np.float64]
Inputs = dict[str, NDArray[Any]]
Term = tuple[str, str]
"""A name, and its value there."""
LIMITS = HoleLimits()


def terms_at_worst(finding: Finding) -> tuple[str, ...]:
    """Lines about the worst pixel: inputs, both answers, and the terms of the formula; none where a stage has no pixels to show."""
    case, got, expected = finding.case, finding.got, finding.expected
    if case.stage not in TERMS or got is None or expected is None or got.shape != expected.want.shape:
        return ()
    inputs = {name: a.astype(np.float64) if a.dtype.kind == "f" else a for name, a in case.inputs.items()}
    if got.shape[:2] != _size(inputs):
        return ()
    place = tuple(int(i) for i in np.unravel_index(int(expected.ratios(got).argmax()), got.shape))
    y, x = place[:2]
    with np.errstate(all="ignore"):
        terms = [*TERMS[case.stage](inputs, y, x)]
        truth = reference(case.stage, inputs).get(finding.output)
    terms += [("the port gives", _format(got[y, x])), ("the test expects", _format(expected.want[y, x]))]
    if truth is not None and largest(replace(expected, want=truth, allowed=2 * np.asarray(expected.allowed)), expected.want) > 1:
        terms.append(("of this case is right", f"{_format(truth[y, x])}; the test compares two answers of the port"))
    width = max(len(name) for name, _ in terms)
    head = f"at row {y}, column {x} of {' x '.join(map(str, got.shape[:2]))}, as the reference has it in float64:"
    return (head, *(f"  {name:{width}}  {text}" for name, text in terms))


def _size(inputs: Inputs) -> tuple[int, int]:
    """(H, W) of an image stage's outputs."""
    plane = next(inputs[name] for name in ("valid", "image", "motions", "motion") if name in inputs)
    height, width = plane.shape if plane.ndim == 2 else plane.shape[-3:-1]
    return height, width


def _format(value: Any) -> str:
    """A number, or a vector in parentheses."""
    numbers = np.asarray(value)
    if numbers.ndim == 0:
        return f"{numbers[()]:.9g}"
    return f"({', '.join(f'{n:.9g}' for n in numbers.ravel())})"


def _leads_to(at: Place, y: int, x: int) -> str:
    if not at.finite[y, x]:
        return "nowhere: not finite, so off screen, and the pixel itself is read"
    return f"column {at.x[y, x]} + {at.fx[y, x]:.9g}, row {at.y[y, x]} + {at.fy[y, x]:.9g}"


def _read(image: Float64, at: Place, y: int, x: int) -> list[Term]:
    """The four pixels around the place, clamped into the frame, and the value between them."""
    four = taps(at)
    y0, x0, y1, x1 = (int(a[y, x]) for a in (four.y0, four.x0, four.y1, four.x1))
    return [
        (f"row {y0}, columns {x0} and {x1}", f"{_format(image[y0, x0])} and {_format(image[y0, x1])}"),
        (f"row {y1}, columns {x0} and {x1}", f"{_format(image[y1, x0])} and {_format(image[y1, x1])}"),
        ("fractions across, down", _format([four.fx[y, x], four.fy[y, x]])),
        ("read between them", _format(bilinear(image, four)[y, x])),
    ]


def _motion_chain(inputs: Inputs, y: int, x: int) -> list[Term]:
    motions = inputs["motions"]
    chained = list(chain_steps(motions))
    terms = [("motion of the newest frame", _format(motions[0, y, x]))]
    for j, earlier in enumerate(motions[1:], start=1):
        at = follow(chained[j - 1])
        row, column = int(truncated(at.y, at.fy)[y, x]), int(truncated(at.x, at.fx)[y, x])
        terms.append((f"step {j}: leads to", _leads_to(at, y, x)))
        if at.finite[y, x]:
            four = [_or_zero(earlier, row + i, column + k) for i in (0, 1) for k in (0, 1)]
            terms.append((f"step {j}: motions at rows {row}, {row + 1}", " ".join(map(_format, four))))
            terms.append((f"step {j}: longest, 0 if one is 0", _format(gather_longest(earlier, at)[y, x])))
        terms.append((f"step {j}: chained", _format(chained[j][y, x])))
    return terms


def _or_zero(motion: Float64, row: int, column: int) -> Float64:
    height, width, _ = motion.shape
    return motion[row, column] if 0 <= row < height and 0 <= column < width else np.zeros(2)


def _warp(inputs: Inputs, y: int, x: int) -> list[Term]:
    at = follow(inputs["motion"])
    return [
        ("motion", _format(inputs["motion"][y, x])),
        ("leads to", _leads_to(at, y, x)),
        ("inside", _format(leads_inside(at)[y, x].astype(int))),
        *_read(inputs["color"], at, y, x),
    ]


def _holes(inputs: Inputs, y: int, x: int) -> list[Term]:
    at = follow(inputs["motion"])
    four = taps(at)
    s = bilinear(inputs["stencil_previous"][..., None], four)[y, x, 0]
    n, now = bilinear(inputs["normal_previous"], four)[y, x], inputs["normal"][y, x]
    rows, columns = (four.y0, four.y1), (four.x0, four.x1)
    here, previous = inputs["position"][y, x], inputs["position_previous"]
    static = [
        (
            "static, since its stencil is 0: positions read",
            " ".join(_format(previous[j[y, x], i[y, x]]) for j in rows for i in columns),
        ),
        ("position now", _format(here)),
    ]
    if hole_test(inputs["paper"]) == "paper":
        distances = [float(np.sqrt(((previous[j[y, x], i[y, x]] - here) ** 2).sum())) for j in rows for i in columns]
        facing, depth = abs(inputs["nov"][y, x]), inputs["depth"][y, x]
        bias = LIMITS.facing * facing + LIMITS.grazing * (1 - facing) + LIMITS.depth * depth
        static += [
            ("|NoV|, depth", _format([facing, depth])),
            ("distances to the four", _format(distances)),
            ("bias, a hole unless all <=", _format(bias)),
        ]
    else:
        offset = between([previous[j, i] - inputs["position"] for j in rows for i in columns], four)[y, x]
        footprint = np.sqrt(squared_footprint(inputs["position"])[y, x])
        static += [
            ("offset read between them", _format(offset)),
            ("its length", _format(np.sqrt((offset * offset).sum()))),
            (f"{LIMITS.footprints:g} footprints, a hole unless <=", _format(LIMITS.footprints * footprint)),
            *_turn(now, n, LIMITS.static_cosine),
        ]
    moving = _turn(now, n, LIMITS.cosine)
    return [
        ("motion", _format(inputs["motion"][y, x])),
        ("leads to", _leads_to(at, y, x)),
        ("inside, else a hole", _format(leads_inside(at)[y, x].astype(int))),
        ("fractions across, down", _format([four.fx[y, x], four.fy[y, x]])),
        ("stencil read there, and now", f"{_format(s)} and {_format(inputs['stencil'][y, x])}"),
        (f"3 |difference|, a hole if > {LIMITS.mesh:g}", _format(3 * abs(s - inputs["stencil"][y, x]))),
        *(static if s == 0 else moving),
    ]


def _turn(now: NDArray[Any], n: NDArray[Any], least: float) -> list[Term]:
    length = np.sqrt((n * n).sum())
    return [
        ("normal read there, and now", f"{_format(n)} and {_format(now)}"),
        (f"cosine, a hole if < {least:g}", _format((now * n).sum() / (length + 1e-5))),
    ]


def _occlusion_warp(inputs: Inputs, y: int, x: int) -> list[Term]:
    motion, depth = inputs["motion"], inputs["depth"]
    at = follow(motion)
    look = taps(at)
    row, column = int(look.y0[y, x]), int(look.x0[y, x])
    instead = splat(motion, depth)[look.y0, look.x0]
    terms = [
        ("motion", _format(motion[y, x])),
        ("leads to", _leads_to(at, y, x)),
        ("looks up what was splatted at", f"row {row}, column {column}"),
        *_writers(at, motion, depth, row, column),
        ("occlusion motion", _format(instead[y, x])),
        ("valid", _format(inputs["valid"][y, x])),
    ]
    if inputs["valid"][y, x]:
        return [*terms, ("warped, taken as it is valid", _format(inputs["warped"][y, x]))]
    again = follow(instead)
    return [*terms, ("from this pixel that leads to", _leads_to(again, y, x)), *_read(inputs["color"], again, y, x)]


MOST_WRITERS = 4


def _writers(at: Place, motion: Float64, depth: Float64, row: int, column: int) -> list[Term]:
    """The pixels that write to a pixel of the splat; the one that stays is first."""
    there = at.finite & (depth < FARTHEST) & (np.abs(row - at.y - 0.5) < 1) & (np.abs(column - at.x - 0.5) < 1)
    places = sorted(((float(depth[j, i]), int(j), int(i)) for j, i in np.argwhere(there)))
    if not places:
        return [("written there by", "no pixel: 0")]
    words = [f"row {j}, column {i}, depth {d:.9g}, motion {_format(motion[j, i])}" for d, j, i in places[:MOST_WRITERS]]
    others = len(places) - len(words)
    names = ["written there by, and stays", *["written there by"] * (len(words) - 1)]
    return [*zip(names, words, strict=True), *([("", f"and {others} more")] if others else [])]


def _reshade(inputs: Inputs, y: int, x: int) -> list[Term]:
    terms = [("valid", _format(inputs["valid"][y, x])), ("warped", _format(inputs["warped"][y, x]))]
    if inputs["valid"][y, x]:
        return terms
    before, now = ([inputs[f"{name}{when}"] for name in ("stencil", "normal", "position")] for when in ("_previous", ""))
    pixel = np.array([y]), np.array([x])
    for there, row, column in four_samples(inputs["motion"], *pixel):
        if not there[0]:
            continue
        own = shows_surface((before[0], before[1], before[2]), (now[0], now[1], now[2]), (row, column), pixel)[0]
        what = "its own surface" if own else "another surface"
        terms.append((f"row {row[0]}, column {column[0]}: {what}", _format(inputs["color"][row[0], column[0]])))
    return [*terms, ("motion", _format(inputs["motion"][y, x])), ("base colour", _format(inputs["base_color"][y, x]))]


def _rrm(inputs: Inputs, y: int, x: int) -> list[Term]:
    top, left, height, width = (int(n) for n in inputs["rectangle"])
    within = top <= y < top + height and left <= x < left + width
    return [
        ("valid before", _format(inputs["valid"][y, x])),
        ("rectangle", f"rows {top} to {top + height - 1}, columns {left} to {left + width - 1}"),
        ("holds the pixel", "yes: 0" if within else "no: as before"),
    ]


def _accumulate(inputs: Inputs, y: int, x: int) -> list[Term]:
    image = inputs["image"]
    low, high = box(image)
    terms = [("image", _format(image[y, x])), ("box, least", _format(low[y, x])), ("box, largest", _format(high[y, x]))]
    for back, (earlier, motion, share) in enumerate(
        zip(inputs["earlier"], inputs["motions"], EARLIER_SHARES, strict=False), start=1
    ):
        moved = (2 * motion).repeat(2, axis=0).repeat(2, axis=1)
        at = follow(moved)
        history = bilinear(earlier, taps(at))
        more = [
            ("motion, twice that of the low-resolution pixel", _format(moved[y, x])),
            ("leads to", _leads_to(at, y, x)),
            ("inside, else the image", _format(leads_inside(at)[y, x].astype(int))),
            *_read(earlier, at, y, x),
            ("clamped into the box", _format(np.clip(history, low, high)[y, x])),
            (f"its share, {share:g} or less by motion", _format(share * slowness(motion)[y // 2, x // 2])),
        ]
        terms += [(f"{back} back: {name}", value) for name, value in more]
    return terms


TERMS: dict[str, Callable[[Inputs, int, int], Sequence[Term]]] = {
    "motion_chain": _motion_chain,
    "warp": _warp,
    "holes": _holes,
    "occlusion_warp": _occlusion_warp,
    "reshade": _reshade,
    "rrm": _rrm,
    "accumulate": _accumulate,
}
"""By stage; the row and the column come last."""
