# SPDX-License-Identifier: MIT
"""Compare a wrong answer with known mistakes: find the one that gives the same numbers if it is planted in the reference."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.cases.constants import constant_cases
from conformance.cases.engine_inputs import ENGINE_STAGES, engine_inputs
from conformance.cases.every_buffer import frame_cases
from conformance.cases.large_inputs import large_inputs, network_case
from conformance.judging.findings import DepartureError, Finding
from conformance.judging.judge import Judge
from conformance.mistakes import Mistake, of_stage
from conformance.mistakes.precision import EVERYWHERE, PRECISION
from conformance.protocol.port import Case, Outputs
from conformance.protocol.reference_copy import Variant
from conformance.protocol.stages import STAGES

MOST_SECONDS = 20.0
"""Most computing time of one diagnosis, without the port's; seconds."""
MOST_NAMED = 2
RARE = frozenset((*EVERYWHERE, *PRECISION))
"""Mistakes to try if no other explains the numbers."""
TELLING_SIZE = {"network": (21, 43)}
"""(H, W) of the case by which mistakes of a stage of the network are told apart: that of ``network`` is padded to 24 x 48, the others have
5 x 7 pixels at 1/8 size."""
INSIDE = ("history", "encoder", "erm", "decoder")
CONTAINS = {"network": INSIDE, "frame": ("motion_chain", "warp", "holes", "occlusion_warp", "reshade", "network", *INSIDE)}
ALIKE = 0.99
"""Share of the wrong numbers that a mistake has to explain."""
NEARER = 0.5
"""Distance of the port's number from the mistake's, at most; as a part of its distance from the truth."""
AS_GOOD = 2.0**-10
"""Distance, likewise, of numbers that are the same but for rounding, however small the bound: that of a copy is 0."""
AS_NEAR = 2.0
"""A mistake that is farther from the numbers than the nearest one by more than this factor is not named."""


@dataclass(frozen=True)
class _Answer:
    """A case, the port's answer, the right ones, and where the port's is wrong."""

    case: Case
    got: Outputs
    right: dict[str, Expected]

    @property
    def wrong(self) -> dict[str, NDArray[np.bool_]]:
        return {name: expected.ratios(self.got[name]) > 1 for name, expected in self.right.items()}


def diagnose(judge: Judge, findings: Iterable[Finding]) -> str:
    """Name the known mistakes that a port's wrong answers look like: all of them, and its right answers, too.

    Args:
        judge: has the port, and the largest cases that it answered.
        findings: failures of one property: the first, the smallest, and others.

    Returns:
        ``looks like: ...``, the nearest first; or that no known mistake gives these numbers. "" if there is nothing to compare: the
        port gave no answer, or its answer is right by itself and only two of its answers together are wrong.
    """
    different = {id(finding.case.inputs): finding for finding in findings}.values()
    failures = [each for each in (_again(judge, finding) for finding in different) if each is not None]
    if not failures:
        return ""
    stage = failures[0].case.stage
    mistakes, end = suspects(stage), process_time() + MOST_SECONDS
    others: list[_Answer] | None = None
    matches: list[tuple[float, Mistake]] = []
    count = 0
    for mistake in mistakes:
        if process_time() > end or (mistake in RARE and any(each not in RARE for _, each in matches)):
            break
        count += 1
        distance = _distance(mistake, failures[0])
        if distance < np.inf:
            if others is None:
                began = process_time()
                others = _others(judge, stage)
                end += process_time() - began  # a port may compile for each size
            if all(_distance(mistake, each) < np.inf for each in [*failures[1:], *others]):
                matches.append((distance, mistake))
    return describe(matches, count, stage)


def _others(judge: Judge, stage: str) -> list[_Answer]:
    """The port's answers to the largest cases of its test, and to cases that tell mistakes apart.

    The smallest failures have a pixel or two, in which many mistakes look alike.
    """
    answers = [_compare(judge, case, got) for case, got in judge.answers if case.stage == stage]
    for make in _telling_cases(stage):
        inputs = make(np.random.default_rng(0))
        case = judge.make_case(stage, *(inputs if STAGES[stage].weights else (inputs,)))
        try:
            answers.append(_compare(judge, case, judge.run(case.stage, case.inputs, case.weights)))
        except DepartureError:
            continue  # an answer of another shape, or none: nothing to compare
    return answers


def _telling_cases(stage: str) -> Sequence[Callable[[np.random.Generator], Any]]:
    """Engines' values, constants, far motion, frames of any steps; random ones for the network's; a large one for rrm."""
    if stage in ENGINE_STAGES:
        # Reshaded, a frame of many columns takes long.
        far = large_inputs(stage, 1) if stage not in ("frame", "reshade") else ()
        return (*engine_inputs(stage), *constant_cases(stage), *(frame_cases() if stage == "frame" else ()), *far)
    if STAGES[stage].weights:
        return (partial(network_case, stage, TELLING_SIZE.get(stage, (40, 56))),)
    return large_inputs(stage, 1)


def _again(judge: Judge, finding: Finding) -> _Answer | None:
    """A failure, computed again; None if no answer of it is wrong by itself."""
    case = finding.case
    if finding.expected is None:
        return None
    try:
        answer = _compare(judge, case, judge.run(case.stage, case.inputs, case.weights))
    except DepartureError:
        return None
    return answer if any(wrong.any() for wrong in answer.wrong.values()) else None


def _compare(judge: Judge, case: Case, got: Outputs) -> _Answer:
    right = judge.right(case.stage, case.inputs, case.weights, got)
    return _Answer(case, got, {name: expected.closer(got[name]) for name, expected in right.items()})


def suspects(stage: str) -> tuple[Mistake, ...]:
    """The mistakes in order: first those that large frames show, then the stage's own, those of shared code, of precision."""
    parts = (stage, *CONTAINS.get(stage, ()))
    inside = [mistake for part in parts for mistake in of_stage(part)]
    mistakes = dict.fromkeys([*of_stage(stage), *of_stage(stage, shared=True), *inside])
    places = [mistake for mistake in PRECISION if mistake.stage in parts]
    ordered = sorted(mistakes, key=lambda mistake: not mistake.large)
    return (*ordered, *(EVERYWHERE if STAGES[stage].weights else ()), *places)


@lru_cache(512)
def planted_port(mistake: Mistake) -> Variant:
    """The reference with this mistake."""
    return mistake.port()


def _distance(mistake: Mistake, answered: _Answer) -> float:
    """The distance of a port's wrong numbers from a mistake's, as a share of that from the truth; infinite: it does not explain them.

    It explains them if its own numbers are wrong there, too, and nearer to the port's than the truth is; and if it gives the port's
    numbers, within twice their bound, wherever those are right. Fewer bits are looked for in all numbers of an output together: after
    sums in another order some round to a neighbour, and then no number of the next layers is the same.
    """
    case = answered.case
    try:
        answer = planted_port(mistake).run(case.stage, case.inputs, case.weights)
    except Exception:
        # Planted code on a stranger's case: if it cannot compute the case, it does not explain it.
        return np.inf
    distances = [0.0]
    for name, expected in answered.right.items():
        got, wrong = answered.got[name], answered.wrong[name]
        if answer[name].shape != got.shape:
            return np.inf
        allowed: Any = 2 * np.asarray(expected.allowed)
        theirs = Expected(answer[name].astype(np.float64), allowed, vectors=expected.vectors)
        same = (got == answer[name]) | (np.isnan(got) & np.isnan(answer[name]))
        alike = same | (theirs.ratios(got) <= 1)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            away, off = np.abs(got - answer[name].astype(np.float64)), np.abs(got - expected.want)
            part = np.where(same, 0, away / np.where(off > 0, off, 1))
            together = _rms(away / allowed) / _rms(off / allowed) if mistake in RARE and wrong.any() else np.inf
        # Behind the first wrong output such neighbours add up: there it is enough that the truth is farther away.
        if together <= (NEARER if len(distances) == 1 else 1):
            distances.append(together)
            continue
        explained = (alike | (part <= AS_GOOD)) & (expected.ratios(answer[name]) > 1) & (part <= NEARER)
        if any(where.any() and holds[where].mean() < ALIKE for where, holds in ((wrong, explained), (~wrong, alike))):
            return np.inf
        if wrong.any():
            distances.append(float(np.mean(part[wrong & explained])))
    return max(distances)


def _rms(x: NDArray[Any]) -> float:
    """Root of the mean of the squares."""
    return float(np.sqrt(np.mean(x * x)))


def describe(matches: list[tuple[float, Mistake]], count: int, stage: str) -> str:
    """The diagnosis in words.

    Args:
        matches: the mistakes that fit, each with its distance from the answers, in any order.
        count: number of mistakes that were compared.
        stage: the stage that was judged.
    """
    if not count:
        return "no mistake of this stage is known to compare with"
    if not matches:
        return f"looks like none of the {count} mistakes that were compared"
    matches.sort(key=lambda each: each[0])
    near = [mistake for distance, mistake in matches if distance <= AS_NEAR * matches[0][0]]
    words: dict[str, str] = {}
    for mistake in near:  # the same one may be known of two stages, and the stage's own come first
        words.setdefault(mistake.what, _words(mistake, stage))
    return "looks like: " + "; or ".join([*words.values()][:MOST_NAMED])


def _words(mistake: Mistake, stage: str) -> str:
    """The mistake, and where it is if that is another stage."""
    here = mistake in RARE or stage in (mistake.stage, *mistake.also)
    return mistake.what if here else f"{mistake.what}, in stage {mistake.stage}"
