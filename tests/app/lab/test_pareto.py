# SPDX-License-Identifier: MIT
"""Run time against error: the measurement, and the report."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from stss.cli.main import stss
from stss.frames.compute_options import ComputeOptions
from stss_ground.errors import InputError
from stss_lab.bench import pareto
from stss_lab.bench.pareto import chosen_settings

WORDS = ["bench", "--pareto", "--size", "24x16", "--scenes"]


def test_mistakes():
    with pytest.raises(InputError, match=r"--settings: expected parts of float32 off, .* got quarter"):
        chosen_settings(["quarter"])
    for words, message in (
        (["night"], "--scenes: expected some of"),
        (["static", "--size", "8x8"], "--pareto: expected one --size, got 2"),
    ):
        ran = CliRunner().invoke(stss, [*WORDS, *words])
        assert message in str(ran.exception) + ran.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frames", "20"], "--frames: only with --pareto"),
        (["--launches", "--scenes", "pan"], "--scenes: only with --pareto"),
        (["--launches", "--peers", "openvino"], "--peers: not with --launches"),
        (["--pareto", "--ours", "ref"], "--ours: not with --pareto"),
        (["--pareto", "--dark"], "--dark: not with --pareto"),
    ],
)
def test_an_option_that_would_have_no_effect_is_refused(words, message):
    """Even with its default."""
    ran = CliRunner().invoke(stss, ["bench", "--size", "16x8", *words])
    assert isinstance(ran.exception, InputError)
    assert str(ran.exception) == message


@pytest.mark.thorough
def test_exact_has_the_bits_and_half_departs(device, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = CliRunner().invoke(
        stss, [*WORDS, "static", "--frames", "10", "--settings", "float32 exact,half off", "--json", "found.json"]
    )
    assert ran.exit_code == 0, ran.output
    exact, half = (line.split() for line in ran.output.splitlines() if line.strip().startswith(("float32 exact", "half off")))
    assert exact[-3:-1] == ["same", "bits"]
    assert half[-2].endswith("/255")
    # A float32 network of order 1 is good to some 1e-5; half stores eleven bits.
    assert float(exact[5]) < 1e-4
    assert float(half[5]) > 1e-6
    data = json.loads((tmp_path / "found.json").read_text())
    assert (data["input"], data["threads"] > 0) == ([24, 16], True)
    (rows,) = data["scenes"].values()
    assert [(row["setting"], row["exact"]) for row in rows] == [("float32 exact", True), ("half off", False)]
    for row in rows:
        assert row["share"] == pytest.approx(sum(row["times_ms"]) / sum(row["full_times_ms"]))
    assert f"{rows[0]['share']:.3f}" == exact[-5]


def test_a_share_is_of_the_same_precision(monkeypatch):
    """Each stream counts time by its own precision: half without skipping takes as long as itself."""
    clock, cost = [0.0], {("float32", "off"): 8.0, ("half", "off"): 4.0, ("half", "exact"): 1.0}

    class Counted:
        def __init__(self, weights, device, precision, skip):
            self.cost, self.image = cost[precision, skip], np.full((2, 2, 3), cost[precision, "off"], np.float32)

        def __call__(self, window, steps):
            clock[0] += self.cost
            return self.image, None

    monkeypatch.setattr(pareto, "Stream", Counted)
    monkeypatch.setattr(pareto, "window_and_steps", lambda frames, number: (None, None))
    monkeypatch.setattr(pareto.time, "perf_counter", lambda: clock[0])
    frames, judged = [None] * 10, {9: (np.zeros((2, 2, 3)), np.ones((2, 2, 3)))}
    for precision, skip, share in (("half", "exact", 0.25), ("half", "off", 1)):
        point = pareto.compare_setting(ComputeOptions(precision=precision, skip=skip), None, None, frames, judged)
        assert (point.share, point.exact, point.departure) == (share, False, 4)
