# SPDX-License-Identifier: MIT
"""``--size`` and ``--largest-side``: a fault beyond every tier's size is found, and the report names the sizes that a port does not
accept."""

from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

from conformance.answers.expected import largest
from conformance.answers.windows import expect_windows, places
from conformance.cases.large_inputs import IMAGE_SIZES, USER_SIZES, large_inputs, user_inputs
from conformance.command import conform
from conformance.judging.judge import Judge, Tier
from conformance.protocol.port import Arrays, Outputs
from conformance.protocol.reference_copy import load, returns
from conformance.protocol.stages import STAGES, check_inputs, reference
from conformance.reference_port import ReferencePort
from conformance.report.report import judged_on
from conformance.suite.run_suite import run_suite
from conformance.tolerance import ratio
from stss_ref.weights import Weights
from tests.tiers import thorough

FEW = Tier("few", 1, 1, 1)
BEYOND = 1200


class FailsBeyond(ReferencePort):
    """The last output is wrong in the rows from ``BEYOND`` on, which no other case of these stages has."""

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        outputs = dict(super().run(stage, inputs, weights))
        name = [*outputs][-1]
        outputs[name] = outputs[name].copy()
        outputs[name][BEYOND:] = 1 - outputs[name][BEYOND:]
        return outputs


@pytest.mark.parametrize(("stage", "size"), [("rrm", (1210, 20))])
def test_a_fault_beyond_every_size_is_found_at_a_users_size(stage: str, size: tuple[int, int]):
    run = [run_suite(Judge(FailsBeyond(), FEW, size=each), [stage], only="large") for each in (None, size)]
    assert [[r.outcome for r in results] for results in run] == [["passed"], ["failed"]]
    assert f"row {BEYOND}" in run[1][0].message
    assert run[1][0].record.largest[0] >= size[0]


def test_bounds_of_a_larger_frame_come_from_a_part_of_it(monkeypatch: pytest.MonkeyPatch):
    case, weights = large_inputs("network", 0, (24, 40))[0](np.random.default_rng(0))
    whole = Judge(ReferencePort()).right("network", case, weights)["image"]
    monkeypatch.setattr("conformance.answers.network.SAMPLE", 16)
    part = Judge(ReferencePort()).right("network", case, weights)["image"]  # the first judge knows its answer
    np.testing.assert_array_equal(part.want, whole.want)
    assert part.allowed != whole.allowed
    assert 1 / 2 < float(part.allowed) / float(whole.allowed) < 2


def test_no_case_has_more_rows_or_columns_than_a_port_takes():
    judge = Judge(ReferencePort(), Tier("some", 1, 1, len(IMAGE_SIZES)), largest_side=8192)
    results = run_suite(judge, ["rrm"], only="large")
    assert max(max(r.record.largest) for r in results) == 8192
    assert judged_on(judge, results)[-1] == "no array of more than 8192 rows or columns, as the port declares"
    sizes = [make(np.random.default_rng(0))[0]["mask"].shape for make in large_inputs("network", side=512, size=(257, 8))]
    assert max(map(max, sizes)) == 256, "the image has twice as many"


@pytest.mark.parametrize("words", ["1280", "0x7", "1280x-1", "99999x99999"])
def test_a_size_that_is_none_is_refused(words: str):
    result = CliRunner().invoke(conform, ["--size", words])
    assert result.exit_code == 2
    assert "1280x720" in result.output


@pytest.mark.parametrize("stage", [stage for stage in STAGES if stage != "rrm"])
def test_windows_are_those_of_the_whole(stage: str, monkeypatch: pytest.MonkeyPatch):
    """A window's numbers are the whole's to float64's rounding: at corners of tiles, at each end of the last rows and between."""
    monkeypatch.setattr("conformance.answers.windows.SIDE", 16)
    monkeypatch.setattr("conformance.answers.windows.TILE", 64)
    monkeypatch.setattr("conformance.cases.large_inputs.USER_SIZES", dict.fromkeys(("quick", "full"), (149, 331)))
    (make,) = user_inputs(stage, 99)
    case = make(np.random.default_rng(0))
    inputs, weights = case if STAGES[stage].weights else (case, None)
    judge = Judge(ReferencePort())
    exact = judge.exactly(inputs, stage)
    whole = reference(stage, exact, weights)
    first, *rest = windows = [*expect_windows(stage, judge.round_inputs(inputs, stage), weights, judge.arithmetic, whole)]
    assert (first.rows.start, first.columns.start) == (56, 56)
    sizes = check_inputs(stage, exact)
    assert (rest[-1].rows.stop, rest[-1].columns.stop) == (sizes["H"], sizes["W"])
    assert len(windows) == 5
    for window in windows:
        for name, (place, right) in window.outputs.items():
            if weights is None:
                assert largest(right, whole[name][place]) <= 1
                np.testing.assert_array_equal(right.want, whole[name][place])
            else:
                assert ratio("network.float64", right.want, whole[name][place]) < 1


@pytest.mark.parametrize("size", USER_SIZES.values(), ids=str)
def test_seams_of_equal_parts_lie_in_windows(size: tuple[int, int]):
    for n in (2, 3):
        at = [side // n for side in size]
        assert any(all(s.start < p < s.stop for s, p in zip(window, at, strict=True)) for window in places(*size))


class TileCorners(ReferencePort):
    """What lies diagonally across a corner of four tiles is not seen: a place there is as if the frame ended at the tile's edge."""

    def __init__(self, tile: int):
        self._tile = tile

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        outputs = dict(super().run(stage, inputs, weights))
        for name, array in outputs.items():
            tile = self._tile * (2 if name == "image" else 1)
            outputs[name] = array.copy()
            outputs[name][tile::tile, tile::tile] *= 1.01
        return outputs


CORNERS = [("erm", 64), thorough("erm", 32), thorough("encoder", 64), ("history", 16), ("decoder", 64)]


@pytest.mark.parametrize(("stage", "tile"), CORNERS)
def test_a_corner_of_tiles_is_found_in_the_quick_tier(stage: str, tile: int):
    (result,) = run_suite(Judge(TileCorners(tile), shrink=False), [stage], only="large")
    assert result.outcome == "failed"
    assert f"at [{tile * (2 if stage == 'decoder' else 1)}, " in result.message or "none before row" in result.message


@pytest.mark.thorough
def test_an_index_in_float32_is_found_at_a_users_size(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("conformance.cases.large_inputs.USER_SIZES", dict.fromkeys(("quick", "full"), (160, 300)))

    class IndexedPort(ReferencePort):
        """Reads the wrong one of two neighbours where a float has no odd number."""

        def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
            image = super().run(stage, inputs, weights)["image"]
            flat = image.reshape(-1, 3)
            index = np.arange(len(flat))
            return {"image": flat[np.where(index > 150_000, index // 2 * 2, index)].reshape(image.shape)}

    (result,) = run_suite(Judge(IndexedPort(), Tier("some", 1, 1, 4)), ["frame"], only="users_size")
    assert result.outcome == "failed"
    assert "in the window at row 128, column 268 of the inputs" in result.message
    (result,) = run_suite(Judge(ReferencePort(), Tier("some", 1, 1, 4)), ["frame"], only="users_size")
    assert (result.outcome, result.record.largest) == ("passed", (160, 300))


@pytest.mark.thorough
def test_a_fraction_of_a_rounded_sum_is_found_at_a_users_size(monkeypatch: pytest.MonkeyPatch):
    """The second colour's weights by ``p + m``, a trap of docs/stages.md: far from column 0 the sum has lost the fraction's last bits."""
    monkeypatch.setattr("conformance.cases.large_inputs.USER_SIZES", dict.fromkeys(("quick", "full"), (256, 1280)))

    def summed(place: Any, motion: NDArray[Any]) -> Any:
        axes = np.indices(motion.shape[:2], np.float32)[::-1]
        x, y = ((axis + motion[..., i]).astype(np.float32) for i, axis in enumerate(axes))
        return place._replace(fx=x - np.floor(x), fy=y - np.floor(y))

    (result,) = run_suite(Judge(load("planted", returns("detail.follow", summed)), shrink=False), ["frame"], only="users_size")
    assert result.outcome == "failed"
    assert "in the window at row" in result.message


def test_an_index_in_float32_is_found_in_stage_warp():
    class IndexedPort(ReferencePort):
        """Reads the wrong one of two numbers where a float has no odd index."""

        def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
            outputs = dict(super().run(stage, inputs, weights))
            flat = outputs["warped"].reshape(-1)
            flat[2**24 + 1 :: 2] = flat[2**24 :: 2][: len(flat[2**24 + 1 :: 2])]
            return outputs

    (result,) = run_suite(Judge(IndexedPort(), shrink=False), ["warp"], only="users_size")
    assert result.outcome == "failed"
