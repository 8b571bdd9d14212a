# SPDX-License-Identifier: MIT
"""Run time against error: what is measured, and what is said of it."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from stss.cli.main import stss
from stss_ground.errors import InputError
from stss_lab.bench.pareto import SETTINGS, chosen_settings, measure


def test_mistakes():
    with pytest.raises(InputError, match=r"--settings: expected parts of float32 off, .* got quarter"):
        chosen_settings(["quarter"])
    with pytest.raises(InputError, match=r"--scenes: expected some of .* got 'night'"):
        next(measure({}, None, ["night"], SETTINGS, (8, 8), 12))
    with pytest.raises(InputError, match="--frames: expected at least 10, got 3"):
        next(measure({}, None, ["static"], SETTINGS, (8, 8), 3))


def test_exact_has_the_bits_and_half_departs(device, tmp_path):
    out = tmp_path / "found.json"
    words = ["bench", "--pareto", "--size", "24x16", "--scenes", "static", "--frames", "10"]
    ran = CliRunner().invoke(stss, [*words, "--settings", "float32 exact,half off", "--json", str(out)])
    assert ran.exit_code == 0, ran.output
    exact, half = json.loads(out.read_text())["points"]
    assert [point["setting"] for point in (exact, half)] == ["float32 exact", "half off"]
    assert [point["same_bits"] for point in (exact, half)] == [True, False]
    # A float32 network of order 1 is good to some 1e-5; half stores eleven bits.
    assert exact["error"] < 1e-4
    assert half["error"] > 1e-6
    assert [len(point["times_ms"]) for point in (exact, half)] == [2, 2]
