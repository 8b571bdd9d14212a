"""The stress test of the arithmetic: its instruments, and those of its findings that are certain."""

import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from stss.weights.file import load
from stss_ground.errors import InputError
from stss_lab.command_stress import stress_command
from stss_lab.stress import measure
from stss_lab.stress.engines import OpenCLEngine, ReferenceEngine
from stss_lab.stress.inputs import scale, stage_inputs
from stss_lab.stress.measure import make_plan, stress
from stss_lab.stress.table import StressPlan
from stss_ref.weights import random as random_weights

WEIGHTS = random_weights(1)
INPUTS = stage_inputs(1, 8, 16, WEIGHTS)
SMALL = StressPlan([ReferenceEngine()], seeds=1, size=(32, 48), sizes=(8, 16))


def test_the_hole_test_loses_nothing_itself():
    """Differences of neighbours are exact, so float64 gives the same verdicts for the same positions."""
    (table,) = stress(SMALL, ["positions"])
    columns = dict(zip(table.columns, zip(*table.rows, strict=True), strict=True))
    assert columns["float32"] == columns["its test in float64"]
    assert columns["float32"][-1] > 10
    assert columns["origin taken off by the renderer"][-1] < 1


@pytest.mark.thorough
def test_the_backend_is_measured_in_each_of_its_precisions(device):
    plan = make_plan(device, WEIGHTS)
    assert [engine.name for engine in plan.engines] == ["ref", "cl", "cl direct", "cl half", "cl bfloat16"]
    engine = OpenCLEngine(device, "half")
    features = engine.features(INPUTS["network"], WEIGHTS)
    alone = engine.run("encoder", INPUTS["encoder"], WEIGHTS)
    np.testing.assert_array_equal(features["x4"], alone["x4"])
    assert features["image"].shape == (16, 32, 3)
    large = engine.run("decoder", scale("decoder", INPUTS["decoder"], 1e6), WEIGHTS)
    assert np.isfinite(large["image"]).all()
    pruned = load("realtime").weights
    assert {*engine.run("erm", INPUTS["erm"], pruned)} == {"reshaded"}, "the image needs none"
    assert {*engine.features(INPUTS["network"], pruned)} == {*features}


def test_the_command_measures_every_table_without_a_device(monkeypatch):
    """In fewer and smaller frames than a user's."""
    make_plan, stress, tables = measure.make_plan, measure.stress, []
    monkeypatch.setattr(measure, "make_plan", lambda *options: replace(SMALL, engines=make_plan(*options).engines))
    monkeypatch.setattr(measure, "stress", lambda *options, **more: tables.extend(stress(*options, **more)) or tuple(tables))
    result = CliRunner().invoke(stress_command, ["--backend", "ref"])
    assert result.exit_code == 0, result.output
    assert [table.key for table in tables] == [*measure.MEASUREMENTS]
    assert all(table.title[:12] in result.output for table in tables)
    assert "the reference alone" in result.output


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--only", "position"], "only: expected some of bounds"),
        (["--backend", "ref", "--device", "x"], "expected no device"),
    ],
)
def test_mistakes_are_one_line(options, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(stress_command, options)
    assert isinstance(result.exception, InputError)
    assert re.search(words, str(result.exception))
    assert "\n" not in str(result.exception)
