# SPDX-License-Identifier: MIT
"""``--size`` and ``--largest-side``: a fault beyond every tier's size is found, and what a port does not take is left out and said."""

import numpy as np
import pytest
from click.testing import CliRunner

from conformance.cases.large_inputs import IMAGE_SIZES, large_inputs
from conformance.command import conform
from conformance.judging.judge import Judge, Tier
from conformance.protocol.port import Arrays, Outputs
from conformance.reference_port import ReferencePort
from conformance.report.report import judged_on
from conformance.suite.run_suite import run_suite
from stss_ref.weights import Weights

FEW = Tier("few", 1, 1, 1)
BEYOND = 600


class FailsBeyond(ReferencePort):
    """The last output is wrong in the rows from ``BEYOND`` on, which no other case of these stages has."""

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        outputs = dict(super().run(stage, inputs, weights))
        name = [*outputs][-1]
        outputs[name] = outputs[name].copy()
        outputs[name][BEYOND:] = 1 - outputs[name][BEYOND:]
        return outputs


@pytest.mark.parametrize(("stage", "size"), [("rrm", (610, 20))])
def test_a_fault_beyond_every_size_is_found_at_a_users_size(stage: str, size: tuple[int, int]):
    run = [run_suite(Judge(FailsBeyond(), FEW, size=each), [stage], only="large") for each in (None, size)]
    assert [[r.outcome for r in results] for results in run] == [["passed"], ["failed"]]
    assert f"row {BEYOND}" in run[1][0].message
    assert run[1][0].record.largest[0] >= size[0]


def test_bounds_of_a_larger_frame_come_from_a_part_of_it(monkeypatch: pytest.MonkeyPatch):
    case, weights = large_inputs("network", 0, (24, 40))[0](np.random.default_rng(0))
    judge = Judge(ReferencePort())
    whole = judge.right("network", case, weights)["image"]
    monkeypatch.setattr("conformance.answers.network.SAMPLE", 16)
    part = judge.right("network", case, weights)["image"]
    np.testing.assert_array_equal(part.want, whole.want)
    assert part.allowed != whole.allowed
    assert 1 / 2 < float(part.allowed) / float(whole.allowed) < 2


def test_no_case_has_more_rows_or_columns_than_a_port_takes():
    judge = Judge(ReferencePort(), Tier("some", 1, 1, len(IMAGE_SIZES)), largest_side=8192)
    results = run_suite(judge, ["rrm", "warp"], only="large")
    assert max(max(r.record.largest) for r in results) == 4500
    assert judged_on(judge, results)[-1] == "no array of more than 8192 rows or columns, as the port declares"
    assert len(large_inputs("network", side=512)) == 1, "the image has twice as many"


@pytest.mark.parametrize("words", ["1280", "0x7", "1280x-1", "99999x99999"])
def test_a_size_that_is_none_is_refused(words: str):
    result = CliRunner().invoke(conform, ["--size", words])
    assert result.exit_code == 2
    assert "1280x720" in result.output
