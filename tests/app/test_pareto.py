# SPDX-License-Identifier: MIT
"""Run time against error: what is measured, and what is said of it."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from stss.cli.main import stss
from stss_ground.errors import InputError
from stss_lab.bench.pareto import chosen_settings

WORDS = ["bench", "--pareto", "--size", "24x16", "--scenes"]


def test_mistakes():
    with pytest.raises(InputError, match=r"--settings: expected parts of float32 off, .* got quarter"):
        chosen_settings(["quarter"])
    for words, said in (
        (["night"], "--scenes: expected some of"),
        (["static", "--json", "found.json"], "--json: expected without --pareto"),
        (["static", "--size", "8x8"], "--pareto: expected one --size, got 2"),
    ):
        ran = CliRunner().invoke(stss, [*WORDS, *words])
        assert said in str(ran.exception) + ran.output


def test_exact_has_the_bits_and_half_departs(device):
    ran = CliRunner().invoke(stss, [*WORDS, "static", "--frames", "10", "--settings", "float32 exact,half off"])
    assert ran.exit_code == 0, ran.output
    exact, half = (line.split() for line in ran.output.splitlines() if line.strip().startswith(("float32 exact", "half off")))
    assert exact[-3:-1] == ["same", "bits"]
    assert half[-2].endswith("/255")
    # A float32 network of order 1 is good to some 1e-5; half stores eleven bits.
    assert float(exact[5]) < 1e-4
    assert float(half[5]) > 1e-6
