# SPDX-License-Identifier: MIT
"""A wrong pixel taken apart: its terms are the formula's, worked out by hand."""

import numpy as np
import pytest

from conformance.answers.expected import Expected
from conformance.explain.terms import TERMS, terms_at_worst
from conformance.judging.findings import Finding
from conformance.judging.judge import Judge, Tier
from conformance.mistakes import find
from conformance.protocol import Case, reference
from conformance.suite.run_suite import run_suite


def terms(stage, inputs, output, wrong_at):
    """Of a port that is right but at one place."""
    inputs = {name: np.asarray(a, {"valid": np.uint8, "paper": np.int32}.get(name, np.float32)) for name, a in inputs.items()}
    want = reference(stage, {name: a.astype(float) if a.dtype.kind == "f" else a for name, a in inputs.items()})[output]
    got = want.copy()
    got[wrong_at] = 1 - got[wrong_at] if want.dtype == np.uint8 else got[wrong_at] + 1
    lines = terms_at_worst(Finding("", Case(stage, inputs), output, got, Expected(want, 0.0)))
    assert lines[0].startswith("at row {}, column {} of ".format(*wrong_at))
    return {name.strip(): text.strip() for name, _, text in (line.strip().partition("  ") for line in lines[1:])}


def still(height, width):
    return {
        "motion": np.zeros((height, width, 2)),
        "stencil_previous": np.zeros((height, width)), "stencil": np.zeros((height, width)),
        "normal_previous": np.ones((height, width, 3)), "normal": np.ones((height, width, 3)),
        "position_previous": np.zeros((height, width, 3)), "position": np.zeros((height, width, 3)),
        "nov": np.full((height, width), 0.5), "depth": np.full((height, width), 0.25),
        "paper": np.zeros(1, np.int32),
    }  # fmt: skip


def test_warp():
    color = np.arange(6.0).reshape(2, 3, 1)
    motion = np.zeros((2, 3, 2))
    motion[1, 2] = -1.25, -0.5
    lines = terms("warp", {"color": color, "motion": motion}, "warped", (1, 2))
    assert lines["motion"] == "(-1.25, -0.5)"
    assert lines["leads to"] == "column 0 + 0.75, row 0 + 0.5"
    assert lines["inside"] == "1"
    assert lines["row 0, columns 0 and 1"] == "(0) and (1)"
    assert lines["row 1, columns 0 and 1"] == "(3) and (4)"
    assert lines["fractions across, down"] == "(0.75, 0.5)"
    assert lines["read between them"] == lines["the test expects"] == "(2.25)"
    assert lines["the port gives"] == "(3.25)"


def test_accumulate():
    image = np.arange(12.0).reshape(2, 6, 1) * np.ones(3)
    motions = np.array([[[(0, 0), (-0.75, 0.25), (0, 0)]], [[(0, 0), (9, 0), (0, 0)]]])
    inputs = {"image": image, "earlier": np.stack([image * 2, image]), "motions": motions}
    lines = terms("accumulate", inputs, "shown", (0, 2))
    assert lines["image"] == "(2, 2, 2)"
    assert lines["box, least"] == "(1, 1, 1)"
    assert lines["box, largest"] == "(9, 9, 9)"
    assert lines["1 back: motion, twice that of the low-resolution pixel"] == "(-1.5, 0.5)"
    assert lines["1 back: leads to"] == "column 0 + 0.5, row 0 + 0.5"
    assert lines["1 back: inside, else the image"] == "1"
    assert lines["1 back: read between them"] == "(7, 7, 7)"
    assert lines["1 back: clamped into the box"] == "(7, 7, 7)"
    assert lines["1 back: its share, 0.25 or less by motion"] == "(0.25)"
    assert lines["2 back: inside, else the image"] == "0"
    assert lines["2 back: clamped into the box"] == "(5, 5, 5)"
    assert lines["the test expects"] == "(3.25, 3.25, 3.25)"


def test_motion_chain():
    motions = np.zeros((2, 3, 3, 2))
    motions[0, 0, 0] = 1, 1
    motions[1, 1:, 1:] = [[[1, 0], [0, 2]], [[0, 1], [1, 1]]]
    lines = terms("motion_chain", {"motions": motions}, "motion", (0, 0))
    assert lines["step 1: leads to"] == "column 1 + 0, row 1 + 0"
    assert lines["step 1: motions at rows 1, 2"] == "(1, 0) (0, 2) (0, 1) (1, 1)"
    assert lines["step 1: longest, 0 if one is 0"] == "(0, 2)"
    assert lines["step 1: chained"] == lines["the test expects"] == "(1, 3)"


def test_holes_of_what_stands():
    inputs = still(1, 2)
    inputs["position_previous"][0, 0] = 3, 4, 0
    inputs["position"][0, 1] = 8, 0, 0
    lines = terms("holes", inputs, "valid", (0, 0))
    assert lines["offset read between them"] == "(3, 4, 0)"
    assert (lines["its length"], lines["1.5 footprints, a hole unless <="]) == ("5", "12")
    lines = terms("holes", {**inputs, "paper": np.ones(1, np.int32)}, "valid", (0, 0))
    # A frame of one row: both rows of taps are that one.
    assert lines["distances to the four"] == "(5, 0, 5, 0)"
    assert lines["bias, a hole unless all <="] == str(7.5 * 0.5 + 45 * 0.5 + 50 * 0.25)
    assert not any(name.startswith("cosine") for name in lines)


def test_holes_of_what_moves():
    inputs = still(1, 2)
    inputs["stencil_previous"][:], inputs["stencil"][:] = 2, 2.5
    inputs["normal_previous"][:], inputs["normal"][:] = (0, 0, 1), (0, 0.6, 0.8)
    lines = terms("holes", inputs, "valid", (0, 1))
    assert lines["3 |difference|, a hole if > 1"] == "1.5"
    assert lines["cosine, a hole if < 0.98"].startswith("0.79999")
    assert "distances to the four" not in lines


def test_occlusion_warp():
    """Two pixels write to the place that is looked up; the nearer one stays."""
    motion = np.zeros((1, 3, 2))
    motion[0, 2] = -1, 0
    inputs = {
        "color": np.arange(9.0).reshape(1, 3, 3), "warped": np.zeros((1, 3, 3)), "motion": motion,
        "depth": [[0.5, 0.5, 0.25]], "valid": np.zeros((1, 3), np.uint8),
    }  # fmt: skip
    lines = terms("occlusion_warp", inputs, "occlusion_motion", (0, 1))
    assert lines["looks up what was splatted at"] == "row 0, column 1"
    assert lines["written there by, and stays"] == "row 0, column 2, depth 0.25, motion (-1, 0)"
    assert lines["occlusion motion"] == "(-1, 0)"
    assert lines["from this pixel that leads to"] == "column 0 + 0, row 0 + 0"


def test_lost_motion_is_said_to_be():
    motion = np.full((1, 1, 2), np.nan)
    lines = terms("warp", {"color": np.ones((1, 1, 1)), "motion": motion}, "inside", (0, 0))
    assert lines["leads to"].startswith("nowhere: not finite")


def test_a_comparison_of_two_answers_says_so():
    inputs = {"color": np.ones((1, 1, 1), np.float32), "motion": np.zeros((1, 1, 2), np.float32)}
    finding = Finding("", Case("warp", inputs), "warped", np.full((1, 1, 1), 3.0), Expected(np.full((1, 1, 1), 2.0), 0.0))
    assert terms_at_worst(finding)[-1].split("  ")[-1].strip() == "(1); the test compares two answers of the port"


@pytest.mark.parametrize("name", ["motion_chain_x_sign", "occlusion_warp_starts_at_1", "rrm_filled"])
def test_every_image_stage_shows_its_terms(name):
    mistake = find(name)
    results = run_suite(Judge(mistake.port(), Tier("some", 60, 3)), [mistake.stage], first_only=True)
    lines = results[-1].record.failure.finding.terms
    assert mistake.stage in TERMS
    assert lines[0].startswith("at row ")
    assert {"the port gives", "the test expects"} <= {line.strip().split("  ")[0] for line in lines[1:]}


def test_the_networks_stages_show_none():
    case = Case("history", {"history": np.zeros((3, 8, 8, 4), np.float32)})
    assert terms_at_worst(Finding("", case, "feature", np.zeros((1, 1, 32)), Expected(np.ones((1, 1, 32)), 0.0))) == ()
