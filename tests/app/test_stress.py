"""The stress test of the arithmetic: its instruments, and what it found, as far as that is sure."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner

from conformance.protocol.stages import reference
from conformance.tolerance import BOUNDS, UNIT, ratio
from stss_ground.errors import InputError
from stss_ground.optional import require
from stss_lab.command_stress import stress_command
from stss_lab.stress import plot as stress_plot
from stss_lab.stress import report as stress_report
from stss_lab.stress.engines import NETWORK, OpenCLEngine, ReferenceEngine
from stss_lab.stress.inputs import exact, image_noise, permuted, scaled, stage_inputs, transposed, transposed_arrays
from stss_lab.stress.measure import MEASUREMENTS, Results, make_plan, stress
from stss_lab.stress.monte_carlo import StochasticRounding, Trace, Watcher, digits_of, samples, significant_digits, watched
from stss_lab.stress.table import StressPlan, StressTable, relative_error, short
from stss_ref.weights import LAYERS
from stss_ref.weights import random as random_weights

WEIGHTS = random_weights(1)
INPUTS = stage_inputs(1, 8, 16, WEIGHTS)
SMALL = StressPlan([ReferenceEngine()], seeds=1, size=(32, 48), sizes=(8, 16), runs=3)


@pytest.fixture(scope="module")
def results():
    return Results(SMALL, None, stress(SMALL))


def as_watched(array, watcher):
    return watched({"x": np.array(array, np.float64)}, watcher)["x"]


@pytest.mark.parametrize("bits", [24, 11])
def test_rounding_is_to_the_two_neighbours_and_right_on_average(bits):
    rounded = np.asarray(as_watched(np.ones(20000), StochasticRounding(bits, 0)) / 3)
    below = np.floor(2.0 ** (bits + 1) / 3) * 2.0 ** -(bits + 1)
    step = 2.0 ** -(bits + 1)
    assert set(np.unique(rounded)) == {below, below + step}
    share = (1 / 3 - below) / step
    assert abs((rounded > below).mean() - share) < 5 * np.sqrt(share * (1 - share) / rounded.size)


def test_what_is_exact_in_so_many_bits_stays_exact():
    x = as_watched(np.arange(-50, 50), StochasticRounding(11, 0))
    np.testing.assert_array_equal(np.asarray(np.maximum(x * 4 + 3, 0) / 2), np.maximum(np.arange(-50, 50) * 4 + 3, 0) / 2)
    special = as_watched([np.inf, -np.inf, np.nan, -0.0, 0.0], StochasticRounding(11, 0)) * 1.0
    np.testing.assert_array_equal(np.asarray(special), [np.inf, -np.inf, np.nan, -0.0, 0.0])


@pytest.mark.parametrize("stage", [*INPUTS, "warp", "motion_chain", "occlusion_warp"])
def test_watching_changes_nothing(stage):
    inputs = INPUTS[stage] if stage in INPUTS else image_noise(1, 8, 16)[stage]
    want = reference(stage, exact(inputs), WEIGHTS)
    for name, array in reference(stage, watched(inputs, Watcher()), WEIGHTS).items():
        np.testing.assert_array_equal(array, want[name])


def test_thirteen_bits_fewer_are_four_digits_fewer():
    digits = {}
    for bits in (24, 11):
        runs = samples("encoder", INPUTS["encoder"], WEIGHTS, lambda i, bits=bits: StochasticRounding(bits, i), 8)
        digits[bits] = np.median(significant_digits(runs["x1"], bits)[runs["x1"][0] != 0])
    assert 3.5 < digits[24] - digits[11] < 4.3
    assert 6 < digits[24] < 7.3


def test_storing_in_few_bits_costs_less_than_computing_in_them():
    spread = {}
    for where in ("layers", "operations"):
        runs = samples("network", INPUTS["network"], WEIGHTS, lambda i, where=where: StochasticRounding(11, i, where), 8)
        spread[where] = runs["image"].std(axis=0).mean()
    assert 0 < spread["layers"] < spread["operations"]


def test_digits():
    value, error = np.array([1.0, 1.0, 1.0, 0.0, 0.0]), np.array([0.0, 1e-3, 10.0, 0.0, 1.0])
    most = 24 * np.log10(2)
    np.testing.assert_array_equal(digits_of(error, value, 24).round(6), np.round([most, 3, 0, most, 0], 6))


def test_the_trace_notes_what_convolutions_read():
    trace = Trace()
    reference("history", watched(INPUTS["history"], trace), WEIGHTS)
    shapes = [array.shape for array in trace.read]
    assert len(shapes) == 3 * 9 + 2
    assert shapes[0] == (8, 16, 4)
    assert shapes[-1] == (1, 2, 96)
    np.testing.assert_array_equal(trace.read[0], INPUTS["history"]["history"][0])


@pytest.mark.parametrize("stage", NETWORK)
def test_other_orders_are_the_same_function(stage):
    """In float64, and not in the same bits: then nothing would have been reordered."""
    inputs, other = exact(INPUTS[stage]), permuted(WEIGHTS, 3)
    want = reference(stage, inputs, WEIGHTS)
    turned = transposed_arrays(reference(stage, transposed_arrays(inputs), transposed(other)))
    for got in (reference(stage, inputs, other), turned):
        for name, array in want.items():
            assert ratio("network.float64", got[name], array) <= 1
        assert any((got[name] != array).any() for name, array in want.items())


def test_scaling_leaves_masks_and_positions_of_taps_alone():
    by = scaled("network", INPUTS["network"], 1e-6)
    np.testing.assert_array_equal(by["mask"], INPUTS["network"]["mask"])
    np.testing.assert_array_equal(by["history"][..., 3], INPUTS["network"]["history"][..., 3])
    assert by["color"].max() <= 1e-6
    image = image_noise(1, 8, 16)
    assert (scaled("warp", image["warp"], 100)["motion"] == image["warp"]["motion"]).all()
    assert (scaled("motion_chain", image["motion_chain"], 2)["motions"] == 2 * image["motion_chain"]["motions"]).all()


def test_relative_error():
    one = {"a": np.array([1.0, -4.0])}
    assert relative_error({"a": np.array([1.0, -3.0])}, one) == 0.25
    assert relative_error(one, one) == 0
    assert relative_error({"a": np.array([1.0, np.nan])}, one) == np.inf


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0, "0"),
        (1234.5, "1230"),
        (12345, "1.2e4"),
        (3.21, "3.2"),
        (1e-3, "0.001"),
        (1e-7, "1e-7"),
        (np.inf, "inf"),
        (np.nan, "-"),
    ],
)
def test_numbers_are_short(number, text):
    assert short(number) == text


def test_every_table_is_whole(results):
    assert [table.key for table in results.tables] == list(MEASUREMENTS)
    for table in results.tables:
        assert table.rows
        assert all(len(row) == len(table.columns) for row in table.rows), table.key
        numbers = [cell for row in table.rows for cell in row if isinstance(cell, float)]
        assert all(number >= 0 for number in numbers), table.key


def test_all_layers_are_looked_at(results):
    assert {row[0] for row in results.table("layers").rows} == {layer.name for layer in LAYERS} | {"image"}


def test_depth_does_not_make_the_error_grow(results):
    """What each layer reads is as good as what the whole network is asked for."""
    errors = results.table("layers").column("error of its input")
    assert max(errors) * UNIT["float32"] <= BOUNDS["network.float32"].floor


def test_the_hole_test_loses_nothing_itself(results):
    """Differences of neighbours are exact, so float64 gives the same verdicts for the same positions."""
    table = results.table("positions")
    assert table.column("float32") == table.column("its test in float64")
    assert table.column("float32")[-1] > 10
    assert table.column("origin taken off by the renderer")[-1] < 1


def test_the_length_of_keys_does_not_matter_down_to_the_clamp(results):
    table = results.table("keys")
    errors = dict(zip((row[0] for row in table.rows), table.column("ref"), strict=True))
    assert errors["2^-40"] == errors["2^0"] == errors["2^40"]
    assert errors["2^70"] > 1e6


def test_the_loss_of_warping_does_not_grow_with_the_frame(results):
    table = results.table("motion")
    summed, apart = table.column("colour, p + m"), table.column("colour, apart")
    assert summed[-1] > 4 * summed[0]
    assert max(apart) < min(summed)
    assert set(table.column("wrong taps in %, apart")) == {0}
    assert min(table.column("wrong taps in %, p + m")) > 0


def test_the_backend_is_measured_in_each_of_its_precisions():
    from stss_cl.device.discovery import DeviceError, open_device

    try:
        device = open_device()
    except DeviceError as error:
        pytest.skip(str(error))
    plan = make_plan(device, WEIGHTS)
    assert [engine.name for engine in plan.engines] == ["ref", "cl", "cl direct", "cl half"]
    engine = OpenCLEngine(device, "half")
    features = engine.features(INPUTS["network"], WEIGHTS)
    alone = engine.run("encoder", INPUTS["encoder"], WEIGHTS)
    np.testing.assert_array_equal(features["x4"], alone["x4"])
    assert features["image"].shape == (16, 32, 3)
    large = engine.run("decoder", scaled("decoder", INPUTS["decoder"], 1e6), WEIGHTS)
    assert np.isfinite(large["image"]).all()


def test_a_page_is_renewed_between_its_markers(results, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("Prose.\n\n<!-- stress: tone -->\nold\n<!-- end -->\n\nMore.\n<!-- stress: measured -->\n<!-- end -->\n")
    stress_report.write_page(page, results)
    first = page.read_text()
    assert first.startswith("Prose.\n\n<!-- stress: tone -->\n*Relative error of the light*\n\n| light |")
    assert "old" not in first
    assert "\n\nMore.\n<!-- stress: measured -->\nstss " in first
    stress_report.write_page(page, Results(SMALL, None, ()))
    assert "| light |" in page.read_text(), "a table that was not measured stays"
    page.write_text("nothing")
    with pytest.raises(InputError, match=r"page\.md: expected <!-- stress"):
        stress_report.write_page(page, results)


def test_json_can_be_read(results):
    broken = StressTable("x", "y", ("a", "b"), (("a", float("inf")),))
    text = stress_report.to_json(Results(SMALL, None, (*results.tables, broken)))
    data = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert [table["key"] for table in data["tables"]] == [*MEASUREMENTS, "x"]
    assert data["tables"][-1]["rows"] == [["a", "inf"]]
    assert "/home" not in text


def test_pictures_are_drawn(results, tmp_path):
    try:
        require("matplotlib")
    except InputError as error:
        pytest.skip(str(error))
    drawn = stress_plot.plot(results, tmp_path / "pictures")
    assert [path.name for path in drawn] == ["stability_growth.png", "stability_cases.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in drawn)
    assert stress_plot.plot(Results(SMALL, None, results.tables[:2]), tmp_path) == ()


def test_the_command(tmp_path):
    done = CliRunner().invoke(stress_command, ["--backend", "ref", "--only", "tone,wall", "--json", str(tmp_path / "s.json")])
    assert done.exit_code == 0, done.output
    assert "Relative error of the light" in done.output
    assert "the reference alone" in done.output
    assert [table["key"] for table in json.loads((tmp_path / "s.json").read_text())["tables"]] == ["tone", "wall"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--only", "tones"], "only: expected some of bounds"),
        (["--backend", "ref", "--device", "x"], "expected no device"),
        (["--write", "no.md"], r"no\.md: cannot be read"),
        (
            ["--backend", "ref", "--only", "tone", "--json", "no/such/folder.json"],
            "--json no/such/folder.json: expected a file in a folder that exists",
        ),
    ],
)
def test_mistakes_are_one_line(options, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(stress_command, options)
    assert isinstance(done.exception, InputError)
    assert re.search(said, str(done.exception))
    assert "\n" not in str(done.exception)
