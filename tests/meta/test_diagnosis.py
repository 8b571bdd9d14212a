"""A wrong answer leads to its mistake: the planted one is among the named ones, and no other named mistake contradicts the answer."""

from itertools import product

import numpy as np
import pytest

from conformance.answers import by_stage
from conformance.cases.every_buffer import frame_cases
from conformance.cases.stage_inputs import make_weights
from conformance.explain import diagnosis
from conformance.explain.choices import decisive_choices
from conformance.explain.diagnosis import diagnose
from conformance.judging.findings import DepartureError
from conformance.judging.judge import Judge, Tier
from conformance.mistakes import MISTAKES, find, of_stage
from conformance.mistakes.precision import FORMATS, rounded_at
from conformance.protocol.reference_copy import half, load, put, returns
from conformance.report.failures import keep_failure
from conformance.suite.properties import find_property
from conformance.suite.run_suite import run_suite
from stss.port import ReferencePort
from tests.meta import run_names
from tests.meta.right_ports import add_pairwise, convolved, fused_lerp
from tests.meta.samples import samples
from tests.tiers import every, thorough


def explain(port, stage):
    """The diagnosis of the first sample that it gets wrong."""
    judge, body = Judge(port), find_property(f"{stage}.agrees_with_the_reference")
    for case in samples(stage):
        try:
            judge.check(body, case.inputs if case.weights is None else (case.inputs, case.weights))
        except DepartureError as error:
            return diagnose(judge, [error.finding])
    return None


NAMED = [
    "motion_chain_x_sign",
    "warp_infinity_clamped",
    "holes_footprint_of_quads",
    "rrm_filled",
    "occlusion_warp_starts_at_1",
    "erm_epsilon_inside",
]


@pytest.mark.parametrize("name", NAMED)
def test_a_planted_mistake_is_named(name):
    mistake = find(name)
    assert mistake.what in explain(mistake.port(), mistake.stage)


def test_mistakes_that_look_alike_in_the_smallest_case_are_told_apart(monkeypatch):
    """In a frame of one pixel a motion outside may count for nothing as if a still one did not win."""
    mistake, body = find("motion_chain_outside_left_out"), find_property("motion_chain.agrees_with_the_reference")
    judge, motions = Judge(mistake.port()), np.zeros((2, 1, 1, 2), np.float32)
    motions[1, ..., 0] = 1
    with pytest.raises(DepartureError) as error:
        judge.check(body, {"motions": motions})
    assert diagnose(judge, [error.value.finding]) == f"looks like: {mistake.what}"

    clock, run = [0.0], judge.run
    monkeypatch.setattr(diagnosis, "process_time", lambda: clock[0])
    # The port compiles for each case: its time is not the diagnosis'.
    monkeypatch.setattr(judge, "run", lambda *case: clock.append(clock.pop() + 2 * diagnosis.MOST_SECONDS) or run(*case))
    assert diagnose(judge, [error.value.finding]) == f"looks like: {mistake.what}"


def test_a_limit_is_not_blamed_for_lost_bits():
    """Where all numbers lie at their limit either gives this mask; the limit's own case tells them apart."""
    mistake = find("holes_normals_in_half")
    (result,) = run_suite(Judge(mistake.port()), ["holes"], only="comparisons_need_all_bits")
    assert f"looks like: {mistake.what}" in result.message
    assert "; or " not in result.message


@pytest.mark.parametrize("name", ["erm_own_pixel_left_out", "erm_value_masked_twice"])
def test_a_mistake_that_is_not_in_the_list_has_no_name(monkeypatch, name):
    """Its smallest failures look like those of others; the port's answers to larger cases tell them apart."""
    mistake, suspects = find(name), diagnosis.suspects
    monkeypatch.setattr(diagnosis, "suspects", lambda stage: [each for each in suspects(stage) if each is not mistake])
    judge = Judge(mistake.port(), Tier("some", 10, 6, 0))
    (result,) = run_suite(judge, [mistake.stage], only="agrees_with_the_reference")
    assert "; looks like none of the" in result.message


@pytest.mark.thorough
def test_what_contains_a_stage_names_its_mistakes():
    mistake = find("history_newest_first")
    assert f"{mistake.what}, in stage history" in explain(mistake.port(), "network")


def test_a_mistake_that_two_stages_know_is_said_once():
    """In the words of the stage that was judged."""
    both = [(0.0, find(name)) for name in ("frame_motions_oldest_first", "motion_chain_oldest_first")]
    assert diagnosis.describe(both, 2, "frame") == "looks like: takes the motions as oldest first"
    assert diagnosis.describe(both[1:], 2, "frame") == "looks like: takes the motions as oldest first, in stage motion_chain"


@pytest.mark.parametrize("name", [thorough("frame_missing_not_masked"), thorough("network_erm_unmasked")])
def test_neighbours_are_told_apart(name):
    """By frames of any steps, and by places of mask 0 at 1/8 size."""
    mistake = find(name)
    assert run_names.named(mistake)[0] == f"looks like: {mistake.what}"
    assert "looks like none of the" in run_names.named(mistake, listed=False)[0]


@pytest.mark.parametrize("what", ["input", "weights"])
def test_the_place_of_fewer_bits_is_named(what):
    port = load("planted", *rounded_at("latentEncoder.2", what, half))
    assert f"half precision at the {what} of latentEncoder.2" in explain(port, "erm")


@pytest.mark.parametrize(("stage", "name"), [("history", "bfloat16"), ("encoder", "bfloat16"), thorough("encoder", "tf32")])
def test_fewer_bits_are_named_whatever_the_order_of_sums(stage, name):
    """As libraries have them by default on matrix units. An activation here and there rounds to another number than in the planted one."""
    rounded = FORMATS[name]
    port = load("planted", put("conv.conv", lambda x, weight, *rest: convolved(add_pairwise, rounded(x), rounded(weight), *rest)))
    assert explain(port, stage) == f"looks like: {name} at the factors of every layer"


def test_products_of_parts_have_no_name_of_fewer_bits():
    """Three products of bfloat16 for one: wrong, but by none of the formats that are known."""
    first = FORMATS["bfloat16"]

    def conv(x, weight, bias, stride=1):
        rest = [(first(x), weight - first(weight)), (x - first(x), first(weight)), (first(x), first(weight))]
        return bias + sum(convolved(add_pairwise, first(a), first(b), bias * 0, stride) for a, b in rest)

    assert "looks like none" in explain(load("planted", put("conv.conv", conv)), "history")


def test_a_mistake_is_named_in_other_arithmetic():
    """What should be copied has hardly a bound, and here it is read between pixels, by fused multiply-adds."""
    mistake = find("occlusion_warp_valid_inverted")
    assert mistake.what in explain(load("planted", *mistake.plants, put("sample.lerp", fused_lerp)), "occlusion_warp")


def test_a_mistake_without_effect_explains_nothing():
    """What is off by less than twice the bound is near to any mistake that changes no number of the case."""
    port = load("planted", returns("warp.warp", lambda result: (result[0] * np.float32(1 + 2.0**-20), result[1])))
    assert "none of the" in explain(port, "warp")


def test_the_answers_that_are_right_count_too():
    """A mistake that explains the failure is not named if it were wrong where the port is right."""
    case = samples("warp")[0]
    judge = Judge(find("warp_x_sign").port())
    with pytest.raises(DepartureError) as error:
        judge.check(find_property("warp.agrees_with_the_reference"), case.inputs)
    assert "to the left" in diagnose(judge, [error.value.finding])
    judge.answers.append((case, ReferencePort().run("warp", case.inputs)))
    assert "to the left" not in diagnose(judge, [error.value.finding])


class Odd(ReferencePort):
    """An unknown mistake."""

    def run(self, stage, inputs, weights=None):
        outputs = super().run(stage, inputs, weights)
        return {name: a + np.float32(0.37) * np.sin(a) if a.dtype.kind == "f" else a for name, a in outputs.items()}


def test_nothing_is_named_that_does_not_fit():
    assert "looks like none of the" in explain(Odd(), "warp")


def test_no_mistakes_to_compare_with_are_said_in_words(monkeypatch):
    monkeypatch.setattr("conformance.explain.diagnosis.suspects", lambda stage: ())
    assert explain(Odd(), "warp") == "no mistake of this stage is known to compare with"


def test_a_stage_without_right_answers_is_named(monkeypatch):
    """The error for somebody who adds a mistake."""
    monkeypatch.setitem(by_stage.STAGES, "dim", by_stage.STAGES["warp"])
    with pytest.raises(AssertionError, match=r"dim: no right answers; expected a function in conformance/answers/by_stage.py"):
        by_stage.expect("dim", {}, None, None, {})


def test_a_right_answer_looks_like_nothing():
    """Where two answers together are wrong, each may be right."""
    judge, case = Judge(Odd()), samples("warp")[0]
    with pytest.raises(DepartureError) as error:
        judge.check(find_property("warp.agrees_with_the_reference"), case.inputs)
    assert diagnose(Judge(ReferencePort()), [error.value.finding]) == ""


STEPS = ((0, 0, 0), (0, 2, 2), (0, 2, 4), (0, 1, 2), (1, 1, 1), (1, 3, 3), (1, 3, 5), (2, 3, 5))


def frames_of_every_kind():
    """Tiny frames: each choice of steps, of missing frames, of second colour and of hole test."""
    inputs, _ = frame_cases()[1](np.random.default_rng(0))
    planes = "nov", "stencils"
    tiny = {n: a[..., :6, :7] if n in planes else a[..., :6, :7, :] for n, a in inputs.items() if n != "steps"}
    for steps, second, test in product(STEPS, ("newest", "detail"), ("footprint", "paper")):
        yield {**tiny, "steps": np.array(steps, np.int32)}, make_weights("random", 0, second, test)


@pytest.mark.parametrize("stage", every(4, ["erm", "history", "encoder", "decoder"]))
def test_every_mistake_runs_on_what_its_stage_draws(stage):
    """One that raises would explain nothing. `test_mutants` runs those of image stages on all of their samples."""
    cases = samples(stage)[:3]
    for mistake in MISTAKES:
        if stage in (mistake.stage, *mistake.also) and not mistake.large:
            port = mistake.port()
            for case in cases:
                port.run(stage, case.inputs, case.weights)


@pytest.mark.thorough
def test_every_mistake_runs_on_every_kind_of_frame():
    """The network itself, which takes long and none of them changes, is left out."""
    judge = Judge(ReferencePort())
    cases = [judge.make_case("frame", *case) for case in frames_of_every_kind()]
    black = put("frame.network", lambda color, *_: np.zeros((2 * color.shape[0], 2 * color.shape[1], 3), color.dtype))
    for mistake in of_stage("frame"):
        port = load(mistake.id, black, *mistake.plants)
        for case in cases:
            port.run("frame", case.inputs, case.weights)


def fail(*_):
    raise AttributeError("no attribute 'shape'")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("reshade_no_nearest", "the same frames are right with hole_fill occlusion_warp"),
        thorough("frame_splat_by_roughness", "the same frames are right with hole_fill reshade"),
        ("frame_detail_whole", "the same frames are right with second_color newest"),
        thorough("frame_hole_test_ignored", "the same frames are right with hole_test footprint"),
        ("frame_history_newest_first", ""),  # though this small frame is right by the paper's hole test
    ],
)
def test_a_frame_says_which_choice_it_hangs_on(name, words):
    judge = Judge(find(name).port(), Tier("some", 24, 24, 0), shrink=False)
    (result,) = run_suite(judge, ["frame"], only="agrees_with_the_reference")
    assert decisive_choices(judge, [result.record.failure.finding]) == words


@pytest.mark.parametrize("part", ["decisive_choices", "diagnose", "first_departure", "terms_at_worst", "confirm"])
def test_a_failure_outlives_its_explanation(part, monkeypatch, tmp_path):
    """With its numbers, and with what is kept in its folder."""
    monkeypatch.setattr(f"conformance.explain.explain.{part}", fail)
    (result,) = run_suite(Judge(find("warp_x_sign").port(), Tier("some", 20, 2)), ["warp"], first_only=True)
    assert result.outcome == "failed"
    assert "error / bound" in result.message
    assert "explaining it failed: AttributeError: no attribute 'shape'" in result.message
    monkeypatch.setattr("conformance.report.failures.draw", fail)
    folder = keep_failure(tmp_path, result.id, result.record.failure, "stss conform")
    text = (folder / "README.txt").read_text()
    assert "drawing it failed: AttributeError" in text
    assert "--replay" in text


def test_a_mistake_that_raises_explains_nothing(monkeypatch):
    mistake = find("warp_x_sign")
    monkeypatch.setattr("conformance.explain.diagnosis.of_stage", lambda *_, **__: (mistake,))
    monkeypatch.setattr("conformance.explain.diagnosis.planted_port", fail)
    assert "looks like none of the" in explain(mistake.port(), "warp")


def test_the_judges_own_fault_keeps_its_case(monkeypatch, tmp_path):
    """It is an error, no failure of the port; and its case can be run again."""
    monkeypatch.setattr("conformance.judging.judge.expect", fail)
    (result,) = run_suite(Judge(ReferencePort(), Tier("some", 20, 2)), ["warp"], first_only=True)
    assert result.outcome == "error"
    assert (keep_failure(tmp_path, result.id, result.record.failure, "stss conform") / "0000" / "in" / "color.npy").exists()


class Nothing(ReferencePort):
    def run(self, stage, inputs, weights=None):
        return None


def test_a_port_that_returns_nothing_is_judged():
    (result,) = run_suite(Judge(Nothing(), Tier("some", 20, 2)), ["warp"], first_only=True)
    assert result.outcome == "failed"
    assert "NoneType" in result.message
