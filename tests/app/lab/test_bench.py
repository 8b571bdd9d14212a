"""The benchmark: its bookkeeping, never its times."""

import io
import json
import multiprocessing
import platform
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from stss_ground.errors import InputError
from stss_lab.bench import launches, measure
from stss_lab.bench import report as bench_report
from stss_lab.bench.contender import Setup
from stss_lab.bench.measure import SUMMARY, SizeResult, Timing, bench
from stss_lab.bench.ours import inputs_for
from stss_ref.weights import random as random_weights
from stss_ref.weights import zeros

WEIGHTS = random_weights(2)


def setup(height=8, width=16, **changes):
    return Setup(**({"weights": WEIGHTS, "height": height, "width": width, "device": None, "threads": 1} | changes))


def printed(results):
    console = Console(width=100, record=True, file=io.StringIO())
    bench_report.print_results(results, console)
    return console.export_text()


RESULT = SizeResult(
    540,
    960,
    (
        Timing(
            *("cl", (0.2, 0.25, 0.9), 1e-6, 300 * 2**20, {"erm": 0.01}, {"precision": "float32", "threads": "2"}),
            cpu_times=(0.18, 0.21, 0.19),
        ),
        Timing("cl-frame", (0.3, 0.3, 0.3), 1e-6),
        Timing("openvino", fault="not installed"),
        Timing("pytorch", (0.6, 0.7, 0.8), float("inf"), cpu_times=(0.6, 0.6, 0.5)),
    ),
)


def test_the_reference_is_timed_and_judged():
    steps = []
    (result,) = bench([setup()], ["ref"], [], repeat=3, on_step=steps.append)
    (row,) = result.rows
    assert row.fault is None
    assert len(row.times) == 3
    assert 0 < row.summary["wall_min"] <= row.summary["wall_median"]
    assert 0 < row.error < 1
    assert steps[0] == "16x8: float64 reference"
    assert steps[-1] == "16x8: run 3 of 3"
    if platform.system() == "Linux":
        assert row.peak_memory > 2**20


def test_a_contender_that_fails_is_a_row_and_the_others_go_on():
    (result,) = bench([setup(device="no such device")], ["ref", "cl"], [], repeat=1)
    good, bad = result.rows
    assert good.fault is None
    assert bad.fault
    assert "\n" not in bad.fault
    assert "no such device" in printed([result])


def test_a_process_that_dies_is_a_row():
    def kill(step):
        for process in multiprocessing.active_children() if "run 1" in step else ():
            process.kill()
            process.join()

    (result,) = bench([setup()], ["ref"], [], 2, kill)
    assert "ended with status -9" in result.rows[0].fault


@pytest.mark.parametrize(
    ("ours", "peers", "repeat", "words"),
    [
        ([], ["cl"], 1, "peers: expected"),
        ([], [], 1, "at least one"),
        (["ref"], [], 0, "at least one"),
    ],
)
def test_wrong_names_are_one_line(ours, peers, repeat, words):
    with pytest.raises(InputError, match=words):
        bench([setup()], ours, peers, repeat)


def test_the_peers_run_in_turns_with_ours():
    pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")
    (result,) = bench([setup()], ["ref"], ["pytorch"], repeat=2)
    assert [(row.name, row.fault, len(row.times)) for row in result.rows] == [
        ("ref", None, 2),
        ("pytorch", None, 2),
    ]
    assert result.shares(result.rows[1]) == dict.fromkeys(SUMMARY, 1)


def test_the_table_shows_stages_and_faults():
    text = printed([RESULT])
    assert "960 x 540 to 1920 x 1080, 3 runs" in text
    assert "openvino: not installed" in text
    lines = [line.split() for line in text.splitlines()]
    times, shares = ["200.0", "250.0", "180.0", "190.0"], ["0.33", "0.36", "0.36", "0.32"]
    assert ["cl", *times, *shares, "1.0e-06", "300"] in lines
    assert ["erm", "10.0"] in lines
    assert "Precision x threads: cl float32 x 2." in text


def test_the_loop_of_an_engine_has_times_and_no_error(monkeypatch):
    monkeypatch.setenv("STSS_TRUST_DEVICE", "1")
    steps = []
    (result,) = bench([setup(weights=zeros())], ["cl-push"], [], repeat=2, on_step=steps.append)
    (row,) = result.rows
    assert (row.fault, row.error, len(row.times)) == (None, None, 2)
    assert next(line.split() for line in printed([result]).splitlines() if line.split()[:1] == ["cl-push"])[-2] == "-"
    assert json.loads(bench_report.to_json([result], "abc", 2))["sizes"][0]["rows"][0]["error"] is None


@pytest.mark.parametrize("name", ["cl", "cl-frame"])
def test_a_dark_frame_has_subnormal_colours_and_nothing_else(name):
    light, dark = (inputs_for(name, setup(dark=dark)) for dark in (False, True))
    for key, array in vars(dark).items():
        if key == "history":
            np.testing.assert_array_equal(array[..., 3], light.history[..., 3])
        elif key not in ("color", "colors"):
            np.testing.assert_array_equal(array, vars(light)[key])
    colors = dark.colors if name == "cl-frame" else dark.color
    assert 0 < colors.max() < np.finfo(np.float32).smallest_normal
    assert json.loads(bench_report.to_json([RESULT], "abc", 2, dark=True))["dark"]


def test_json_can_be_read_and_names_no_place():
    text = bench_report.to_json([RESULT], "abc", 2)
    data = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert data["threads"] == 2
    (size,) = data["sizes"]
    assert size["output"] == [1920, 1080]
    assert [row["peer"] for row in size["rows"]] == [False, False, True, True]
    assert [row.get("error") for row in size["rows"]] == [1e-6, 1e-6, None, "inf"]
    ours = size["rows"][0]
    assert (ours["minimum_ms"], ours["cpu_min_ms"], ours["cpu_times_ms"]) == (200, 180, [180, 210, 190])
    assert round(ours["of_first_peer"]["cpu_min"], 6) == 0.36
    assert platform.node() not in text
    assert "/home" not in text


def test_the_time_of_a_run_is_that_of_one_of_its_frames(monkeypatch):
    messages, orders = [], iter(["time", "end"])
    pipe = SimpleNamespace(send=messages.append, recv=lambda: next(orders))
    clocks = SimpleNamespace(wall=0.0, processor=0.0)

    def run():
        clocks.wall, clocks.processor = clocks.wall + 16, clocks.processor + 4

    engine = SimpleNamespace(frames=8, details={}, prepare=lambda inputs: None, run=run, image=lambda: np.zeros(1))
    monkeypatch.setattr(measure, "contender", lambda name, setup: engine)
    monkeypatch.setattr(measure, "time", SimpleNamespace(perf_counter=lambda: clocks.wall, process_time=lambda: clocks.processor))
    measure.serve(pipe, "cl-stream", setup())
    assert messages[1] == (True, (2, 0.5))


def test_launches_have_times_and_work():
    timings = launches.time_launches(setup(16, 24), "cl", repeat=2)
    names = [each.name for each in timings.launches]
    assert names[0] == "conv1"
    assert all(len(each.seconds) == 2 and min(each.seconds) > 0 < each.bytes for each in timings.launches)
    assert timings.launches[0].products == 9 * 24 * 24 * 16 * 24  # 21 channels are three eights
    console = Console(width=100, record=True, file=io.StringIO())
    launches.print_launches(timings, console)
    assert f"all{' ' * 8}" in (text := console.export_text())
    assert f"{16 * 24 * 9 * 24 * 24 * 1e-9:.2f}" in text
    data = json.loads(launches.to_json([timings], "weights"))
    assert [row["name"] for row in data["tables"][0]["launches"]] == names


def test_launches_are_of_a_network():
    with pytest.raises(InputError, match=r"--launches: expected --ours of cl, cl-direct, .*, got 'cl-frame'"):
        launches.time_launches(setup(), "cl-frame", repeat=1)
