"""The stress test of the arithmetic: its instruments, and what it found, as far as that is sure."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner

from stss_ground.errors import InputError
from stss_lab.command_stress import stress_command
from stss_lab.stress import report as stress_report
from stss_lab.stress.engines import OpenCLEngine, ReferenceEngine
from stss_lab.stress.inputs import scaled, stage_inputs
from stss_lab.stress.measure import MEASUREMENTS, Results, make_plan, stress
from stss_lab.stress.table import StressPlan, StressTable
from stss_ref.weights import random as random_weights

WEIGHTS = random_weights(1)
INPUTS = stage_inputs(1, 8, 16, WEIGHTS)
SMALL = StressPlan([ReferenceEngine()], seeds=1, size=(32, 48), sizes=(8, 16))


@pytest.fixture(scope="module")
def results():
    return Results(SMALL, None, stress(SMALL))


def table(results, key):
    return next(table for table in results.tables if table.key == key)


def test_the_hole_test_loses_nothing_itself(results):
    """Differences of neighbours are exact, so float64 gives the same verdicts for the same positions."""
    found = table(results, "positions")
    assert found.column("float32") == found.column("its test in float64")
    assert found.column("float32")[-1] > 10
    assert found.column("origin taken off by the renderer")[-1] < 1


def test_the_length_of_keys_does_not_matter_down_to_the_clamp(results):
    found = table(results, "keys")
    errors = dict(zip((row[0] for row in found.rows), found.column("ref"), strict=True))
    assert errors["2^-40"] == errors["2^0"] == errors["2^40"]
    assert errors["2^70"] > 1e6


def test_the_loss_of_warping_does_not_grow_with_the_frame(results):
    found = table(results, "motion")
    summed, apart = found.column("colour, p + m"), found.column("colour, apart")
    assert summed[-1] > 4 * summed[0]
    assert max(apart) < min(summed)
    assert set(found.column("wrong taps in %, apart")) == {0}
    assert min(found.column("wrong taps in %, p + m")) > 0


def test_the_backend_is_measured_in_each_of_its_precisions():
    from stss_cl.device.discovery import DeviceError, open_device

    try:
        device = open_device()
    except DeviceError as error:
        pytest.skip(str(error))
    plan = make_plan(device, WEIGHTS)
    assert [engine.name for engine in plan.engines] == ["ref", "cl", "cl direct", "cl half", "cl bfloat16"]
    engine = OpenCLEngine(device, "half")
    features = engine.features(INPUTS["network"], WEIGHTS)
    alone = engine.run("encoder", INPUTS["encoder"], WEIGHTS)
    np.testing.assert_array_equal(features["x4"], alone["x4"])
    assert features["image"].shape == (16, 32, 3)
    large = engine.run("decoder", scaled("decoder", INPUTS["decoder"], 1e6), WEIGHTS)
    assert np.isfinite(large["image"]).all()


def test_json_can_be_read(results):
    broken = StressTable("x", "y", ("a", "b"), (("a", float("inf")),))
    text = stress_report.to_json(Results(SMALL, None, (*results.tables, broken)))
    for found in results.tables:
        assert found.rows
        assert all(len(row) == len(found.columns) for row in found.rows), found.key
    data = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert [table["key"] for table in data["tables"]] == [*MEASUREMENTS, "x"]
    assert data["tables"][-1]["rows"] == [["a", "inf"]]
    assert "/home" not in text


def test_the_command(tmp_path):
    done = CliRunner().invoke(stress_command, ["--backend", "ref", "--only", "tone,keys", "--json", str(tmp_path / "s.json")])
    assert done.exit_code == 0, done.output
    assert "Relative error of the light" in done.output
    assert "the reference alone" in done.output
    assert [table["key"] for table in json.loads((tmp_path / "s.json").read_text())["tables"]] == ["tone", "keys"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--only", "tones"], "only: expected some of bounds"),
        (["--backend", "ref", "--device", "x"], "expected no device"),
    ],
)
def test_mistakes_are_one_line(options, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(stress_command, options)
    assert isinstance(done.exception, InputError)
    assert re.search(said, str(done.exception))
    assert "\n" not in str(done.exception)
