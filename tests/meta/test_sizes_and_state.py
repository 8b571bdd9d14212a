"""Mistakes that no small case shows, and mistakes that no single case shows: sizes, state, chance."""

import re
from functools import partial

import numpy as np
import pytest

from conformance.answers.expected import largest
from conformance.cases.alike import alike_calls
from conformance.cases.large_inputs import large_inputs
from conformance.judging.findings import DepartureError
from conformance.judging.judge import TIERS, Judge, Tier
from conformance.protocol.reference_copy import Copy, wrap
from conformance.protocol.stages import STAGES, reference
from conformance.protocol.weights_file import serialise
from conformance.report.failures import keep_failure, replay
from conformance.report.report import judged_on
from conformance.suite.properties import find_property
from conformance.suite.run_suite import run_suite
from stss.port import ReferencePort
from stss_ref.reshade import STEPS
from tests.meta.test_questions import Program
from tests.tiers import every, thorough

NETWORKS = ("history", "encoder", "erm", "decoder", "network", "frame")


def beside(array, first):
    """Wrong from a column on."""
    if array.shape[1] > first:
        array[:, first:] = np.roll(array[:, first:], 1, axis=0) if array.dtype == np.uint8 else array[:, first:] * 1.001


def wrapped(array):
    """An index of 16 bits."""
    flat = array.reshape(-1)
    flat[1 << 16 :] = flat[: max(0, len(flat) - (1 << 16))][: len(flat[1 << 16 :])]


def tiled(port, stage, inputs, weights, columns=64):
    """Tiles that do not read each other's pixels."""
    width = next(array for name, array in inputs.items() if name in ("color", "history", "gbuffer")).shape[-2]
    if width <= columns or width % 8:
        return port.run(stage, inputs, weights)
    cut = {name: width // array.shape[1 if name != "history" else 2] for name, array in inputs.items()}
    parts = []
    for first in range(0, width, columns):
        some = {n: a[..., first // cut[n] : (first + columns) // cut[n]] if a.ndim == 2 else
                a[..., first // cut[n] : (first + columns) // cut[n], :] for n, a in inputs.items()}  # fmt: skip
        parts.append(port.run(stage, {n: np.ascontiguousarray(a) for n, a in some.items()}, weights))
    return {name: np.ascontiguousarray(np.concatenate([part[name] for part in parts], axis=1)) for name in parts[0]}


class SizedPort(ReferencePort):
    """Wrong in large frames."""

    def __init__(self, kind):
        self.kind = kind

    def run(self, stage, inputs, weights=None):
        if self.kind == "clamped":
            inputs = {n: np.clip(a, -32, 32) if n in ("motion", "motions") else a for n, a in inputs.items()}
        if self.kind == "tiled":
            return tiled(super(), stage, inputs, weights)
        outputs = super().run(stage, inputs, weights)
        for array in outputs.values():
            if self.kind == "wrapped":
                wrapped(array)
            elif isinstance(self.kind, str) and self.kind != "clamped":
                rest, side = map(int, self.kind.split(" of "))
                if array.shape[1] > side and array.shape[1] % side == rest:
                    beside(array, array.shape[1] - 1)
            elif self.kind != "clamped":
                beside(array, self.kind)
        return outputs


SIZED = [
    *((stage, kind) for stage in STAGES for kind in ((64, 256) if stage in ("warp", "network") else (64,))),
    *((stage, "wrapped") for stage in ("warp", "rrm", "network")),
    *((stage, "clamped") for stage in ("motion_chain", "warp")),
    *((stage, "tiled") for stage in ("encoder", "decoder")),
    *((stage, f"{rest} of 32") for stage, rests in (("rrm", (1, 7, 25, 31)), ("encoder", (8, 24))) for rest in rests),
    *((stage, rest) for stage in ("erm", "history") for rest in ("6 of 8", "7 of 8", "11 of 16", "15 of 16")),
]
"""Stages and what is wrong: from a column on, an index, long motion, tiles, the last column where vectors or tiles leave so many over."""


@pytest.mark.parametrize("sized", every(3, SIZED), ids=str)
def test_a_mistake_of_size_is_found_in_the_quick_tier(sized):
    stage, kind = sized
    body, judge = find_property(f"{stage}.large_frames_agree_with_the_reference"), Judge(SizedPort(kind))
    cases = [make(np.random.default_rng(0)) for make in large_inputs(stage, TIERS["quick"].large)]
    with pytest.raises(DepartureError):
        any(judge.check(body, case) for case in cases)


def test_a_mistake_of_size_says_where_it_begins():
    (message,) = messages(SizedPort(64), Tier("few", 2, 2, 1), "motion_chain")
    assert "numbers depart, none before column 64" in message


def test_large_frames_have_holes_that_only_the_widest_rings_fill():
    """Where an object appears: in scattered holes a narrow ring finds something, too."""
    shares = []

    def like_sums(copy, right, *planes):
        sums, totals = right(*planes)
        copy.put("reshade.STEPS", STEPS[:4])
        shares.append(((right(*planes)[1] == 0) & (totals > 0)).mean())
        copy.put("reshade.STEPS", STEPS)
        return sums, totals

    copy, judge = Copy(), Judge(ReferencePort())
    wrap("reshade.like_sums", partial(like_sums, copy))(copy)
    for inputs, weights in (make(np.random.default_rng(0)) for make in large_inputs("frame", TIERS["quick"].large)):
        copy.get("stages.network_inputs")(judge.make_case("frame", inputs).inputs, weights)
    assert len(shares) == 3
    assert min(shares) > 0.1


class CountingPort(ReferencePort):
    """Fails where a frame has more than ``most`` rows, pixels or numbers: what lies beyond is that of the first ones."""

    def __init__(self, what, most):
        self.what, self.most = what, most

    def run(self, stage, inputs, weights=None):
        outputs = super().run(stage, inputs, weights)
        for array in outputs.values():
            flat = array.reshape(
                {"rows": len(array), "pixels": array.shape[0] * array.shape[1], "numbers": array.size}[self.what], -1
            )
            flat[self.most :] = flat[: len(flat[self.most :])]
        return outputs


@pytest.mark.parametrize("counted", [("rows", 720), ("pixels", 1 << 20), ("numbers", 65_535 * 64)], ids=str)
@pytest.mark.parametrize("stage", [thorough("warp"), "rrm"])
def test_a_mistake_beyond_720p_is_found_in_the_quick_tier(stage, counted):
    if (stage, counted[0]) == ("rrm", "numbers"):
        counted = "numbers", 65_535 * 16
    (result,) = run_suite(Judge(CountingPort(*counted), shrink=False), [stage], only="large or users", first_only=True)[-1:]
    assert result.outcome == "failed"


@pytest.mark.parametrize("stage", [thorough("encoder"), "decoder"])
def test_an_index_of_16_bits_is_found_in_a_stage_of_the_network_alone(stage):
    (result,) = run_suite(Judge(CountingPort("pixels", 1 << 16), shrink=False), [stage], only="users")
    assert result.outcome == "failed"
    assert "in the window at row" in result.message


def test_what_quick_leaves_to_full_is_the_last_line():
    judge = Judge(ReferencePort(), Tier("quick", 1, 1, 4))
    results = [result for stage in ("history", "rrm") for result in run_suite(judge, [stage], only="agrees_with")]
    assert judged_on(judge, results)[-1] == "not judged at 1080 x 1920, as --tier full does: history"
    assert "not judged" not in judged_on(Judge(ReferencePort(), TIERS["full"]), results)[-1]


def header_of(weights):
    data = serialise(weights)
    return data[: 8 + int.from_bytes(data[:8], "little")]


KEYS = {
    "first rows": lambda inputs, _: [array[..., :1, :, :] if array.ndim > 2 else array[:1] for array in inputs.values()],
    "last rows": lambda inputs, _: [array[..., -1:, :, :] if array.ndim > 2 else array[-1:] for array in inputs.values()],
    "borders": lambda inputs, _: [e for a in inputs.values() if a.ndim > 1 for e in (a[:1], a[-1:], a[:, :1], a[:, -1:])],
    "sums": lambda inputs, _: [np.sort(array, axis=None) for array in inputs.values()],
    "every second pixel": lambda inputs, _: [array.reshape(-1)[::2] for array in inputs.values()],
    "the first array": lambda inputs, _: [next(iter(inputs.values()))],
    "the last array": lambda inputs, _: [[*inputs.values()][-1]],
    "the newest frame": lambda inputs, _: [array[0] if array.ndim == 4 else array for array in inputs.values()],
    "no weights": lambda inputs, weights: [*inputs.values()],
    "the first weights": lambda inputs, weights: [*inputs.values(), weights[min(weights)]],
    "all numbers of the weights' file": lambda inputs, weights: [*inputs.values(), *weights.values()],
    "the header of the weights' file": lambda inputs, weights: [*inputs.values(), np.frombuffer(header_of(weights), np.uint8)],
    "sums of weights": lambda inputs, weights: [
        *inputs.values(),
        *(np.sort(weights[name], axis=None) for name in sorted(weights)),
    ],
}


class Keeps(ReferencePort):
    """Gives the last answer again where a part of the inputs is that of the last call."""

    def __init__(self, key):
        self.key, self.cached, self.answer = key, None, None

    def run(self, stage, inputs, weights=None):
        key = [(array.shape, array.tobytes()) for array in map(np.ascontiguousarray, KEYS[self.key](inputs, weights))]
        if key != self.cached:
            self.cached, self.answer = key, super().run(stage, inputs, weights)
        return self.answer


CACHING_PORTS = [
    *(("history", key) for key in ("first rows", "last rows", "sums", "every second pixel", "no weights", "sums of weights")),
    *((stage, "the header of the weights' file") for stage in NETWORKS),
    *(("erm", key) for key in ("the first array", "the last array", "the first weights")),
    *(("frame", key) for key in ("first rows", "the newest frame", "all numbers of the weights' file")),
    *(("warp", key) for key in ("sums", "the last array")),
    *(("holes", key) for key in ("first rows", "the last array")),
    ("rrm", "borders"),
]
"""Stage and what it is kept by."""


@pytest.mark.parametrize("kept", every(4, CACHING_PORTS), ids=" by ".join)
def test_what_is_kept_by_a_part_of_the_inputs_is_found(kept):
    stage, key = kept
    (result,) = run_suite(Judge(Keeps(key), shrink=False), [stage], only="kept_by_a_part")
    assert result.outcome == "failed"
    assert result.record.about.startswith("the previous call differs only in this: ")


class KeepsLarge(ReferencePort):
    """Gives the last answer again where a frame has more than 64 rows and the last one's size."""

    def __init__(self):
        self.answer = {}

    def run(self, stage, inputs, weights=None):
        right = super().run(stage, inputs, weights)
        first = next(iter(right.values()))
        if len(first) <= 64 or [a.shape for a in right.values()] != [a.shape for a in self.answer.values()]:
            self.answer = right
        return self.answer


@pytest.mark.parametrize("stage", ["rrm", thorough("encoder")])
def test_what_is_kept_of_large_frames_alone_is_found(stage):
    (result,) = run_suite(Judge(KeepsLarge(), shrink=False), [stage], only="large")
    assert result.outcome == "failed"


@pytest.mark.parametrize("stage", STAGES)
def test_calls_that_are_alike_have_other_answers(stage):
    """By more than any bound: else no state would show."""
    judge = Judge(ReferencePort())
    (_, inputs, weights), *others = alike_calls(stage)(np.random.default_rng(0))
    first = reference(stage, judge.exactly(inputs, stage), weights)
    for what, other, tensors in others:
        truth = reference(stage, judge.exactly(other, stage), tensors)
        right = judge.right(stage, other, tensors, truth) if what.startswith(("weights", "normal", "base_color")) else None
        if right is None:
            assert max(np.nanmax(np.abs(truth[name].astype(float) - first[name])) for name in truth) > 0.001, what
        else:
            assert max(largest(right[name], first[name]) for name in right) > 2, what


class Uncleared(ReferencePort):
    """A number that no pass writes is that of the last call of this size."""

    def __init__(self):
        self.last = {}

    def run(self, stage, inputs, weights=None):
        (name, right), *_ = super().run(stage, inputs, weights).items()
        kept = self.last.setdefault(right.shape, right)
        self.last[right.shape] = right.copy()
        right[0, 0] = kept[0, 0]
        return {name: right}


@pytest.mark.parametrize("stage", ["reshade", thorough("frame")])
def test_what_is_not_cleared_between_calls_of_one_size_is_found(stage):
    (result,) = run_suite(Judge(Uncleared(), Tier("some", 1, 6), shrink=False), [stage], only="the_same_twice")
    assert result.outcome == "failed"


class Remembering(ReferencePort):
    """Now and then the answer before, where it has the right shape."""

    def __init__(self, every):
        self.every, self.calls, self.last = every, 0, {}

    def stages(self):
        return frozenset({"warp"})

    def run(self, stage, inputs, weights=None):
        right = super().run(stage, inputs, weights)
        before, self.last = self.last, right
        self.calls += 1
        if self.calls % self.every == 0 and before and before["warped"].shape[-1] <= right["warped"].shape[-1]:
            wrong = right["warped"].copy()
            wrong[0, 0, 0] = before["warped"][0, 0, 0]
            return {**right, "warped": wrong}
        return right


class Chance(ReferencePort):
    """One wrong answer in 500, or more often."""

    def __init__(self, one_in=500, seed=3):
        self.one_in, self.random = one_in, np.random.default_rng(seed)

    def stages(self):
        return frozenset({"warp"})

    def run(self, stage, inputs, weights=None):
        right = super().run(stage, inputs, weights)
        return {**right, "inside": 1 - right["inside"]} if self.random.random() < 1 / self.one_in else right


def messages(port, tier=TIERS["quick"], stage="warp"):
    return [result.message for result in run_suite(Judge(port, tier), [stage], first_only=True) if result.outcome == "failed"]


def test_the_answer_before_says_that_it_depends_on_the_case_before():
    assert any("depends on the case before: it passes alone" in message for message in messages(Remembering(1)))


def test_one_in_500_says_that_it_differs_from_run_to_run():
    (message,) = messages(Chance())
    assert "differs from run to run: alone it is wrong 0 of 20 times, so chance decides, or what" in message


def test_one_in_50_depends_on_nothing_and_is_counted():
    counts = []
    for seed in range(4):
        judge = Judge(Chance(50, seed), Tier("some", 200, 2))
        failure = run_suite(judge, ["warp"], only="agrees_with")[0]
        match = re.search(r"differs from run to run: alone it is wrong (\d+) of 20 times", failure.message)
        assert match is not None or "depends" not in failure.message
        counts.append(int(match[1]) if match else -1)
    assert max(counts) > 0, counts


class Unwritten(Chance):
    """Every answer is wrong, each by other numbers, or all by the same."""

    def __init__(self, changes):
        super().__init__()
        self.changes = changes

    def run(self, stage, inputs, weights=None):
        right = ReferencePort.run(self, stage, inputs, weights)
        return {**right, "warped": right["warped"] + np.float32(self.random.random() + 1 if self.changes else 1)}


@pytest.mark.parametrize("changes", [True, False])
def test_answers_that_are_always_wrong_with_other_bits_are_told_from_a_mistake(changes):
    judge = Judge(Unwritten(changes), Tier("some", 20, 2))
    (failure,) = run_suite(judge, ["warp"], only="agrees_with_the_reference")
    assert ("; the port's answers change from run to run" in failure.message) == changes, failure.message


def test_repeats_find_a_race_in_few_cases():
    judge = Judge(Chance(), Tier("few", 20, 2), repeat=40, shrink=False)
    assert any(result.outcome == "failed" for result in run_suite(judge, ["warp"], first_only=True))


def test_a_program_that_remembers_is_kept_with_the_case_that_it_needs(tmp_path):
    """And fails again from its folder, while the reference passes it."""

    def stale(job, number, outputs):
        if number and outputs["valid"].shape == (8, 8):
            return outputs
        return {"valid": np.ones_like(outputs["valid"])} if number and job[number - 1].inputs["valid"].all() else outputs

    port = Program(stale)
    judge = Judge(port, Tier("some", 60, 5))
    failure = next(r for r in run_suite(judge, ["rrm"], first_only=True) if r.outcome == "failed")
    assert "depends on the" in failure.message
    folder = keep_failure(tmp_path, failure.id, failure.record.failure, "stss conform")
    assert replay(port, folder).failure is not None
    assert replay(ReferencePort(), folder).failure is None
