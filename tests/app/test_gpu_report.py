"""The model of GPUs that are not here, and the report on one that is: their bookkeeping, never their times."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from stss.bench import gpu_report
from stss.bench.gpu_model import GAP, GPUS, most_like, predict, predict_frame
from stss.bench.gpu_page import page
from stss.bench.gpu_report import Step
from stss.cli.main import stss
from stss_cl.device.discovery import DeviceError, open_device
from stss_ref.weights import random as random_weights
from stss_ref.weights import zeros

SIZE = 48, 64


@pytest.fixture(autouse=True)
def _a_device():
    try:
        open_device()
    except DeviceError as error:
        pytest.skip(str(error))


def test_no_launch_beats_the_roof():
    weights = random_weights(0)
    for name, precision in (
        ("h100", "float32"),
        ("rtx3090", "float32"),
        ("h100", "half"),
        ("rx7900xtx", "half"),
        ("a770", "half"),
    ):
        rows = predict(weights, *SIZE, GPUS[name], precision)
        assert all(row.total > row.roof >= 0 for row in rows)
        assert {"conv_local", "attend_local", "image"} <= {row.kernel for row in rows}
        assert any(row.kernel == "conv_mma" for row in rows) == (precision == "half")


def test_arithmetic_grows_with_the_frame():
    weights = random_weights(0)
    small, large = ([row.roof for row in predict(weights, n, n, GPUS["h100"], "float32")] for n in (32, 64))
    np.testing.assert_array_almost_equal_nulp(4 * np.array(small), np.array(large), 4)


@pytest.mark.parametrize(
    ("name", "maker", "model"),
    [
        ("NVIDIA CUDA: NVIDIA GeForce RTX 4090", "nvidia", "rtx4090"),
        ("NVIDIA CUDA: NVIDIA H200", "nvidia", "h100"),
        ("AMD Accelerated Parallel Processing: gfx1101", "amd", "rx7900xtx"),
        ("Intel(R) OpenCL Graphics: Intel(R) Arc(TM) A750 Graphics", "intel", "a770"),
        ("Portable Computing Language: cpu", "", "h100"),
    ],
)
def test_the_model_most_like_a_device(name, maker, model):
    assert most_like(SimpleNamespace(name=name, maker=maker)) == model


def test_the_command_says_that_it_is_a_model(tmp_path):
    done = CliRunner().invoke(stss, ["bench", "--model", "h100", "--size", "64x48", "--json", str(tmp_path / "m.json")])
    assert done.exit_code == 0, done.output
    assert "a model, not measured" in done.output
    data = json.loads((tmp_path / "m.json").read_text())
    assert data["measured_ms"] is None
    assert data["frame_model_ms"] > data["model_ms"] > data["roof_ms"] > 0
    assert "whole frame 45" in done.output


def test_what_a_frame_adds_is_what_its_planes_weigh():
    """At 2 x 2 pixels nothing but gaps; at a large size the bytes of a pixel: more with the history, fewer in half."""
    gpu, weights = GPUS["rtx3090"], random_weights(0)
    rows = predict_frame(weights, 2, 2, gpu, "float32")
    assert [row.kernel for row in rows if row.total > 1.6e-6] == []
    assert len(rows) == 7

    def bytes_of_a_pixel(weights, precision):
        rows = predict_frame(weights, 4000, 4000, gpu, precision)
        assert {row.limit for row in rows} == {"memory"}
        return round(sum(row.total - GAP for row in rows) * gpu.memory * 1e9 / 4000**2)

    # arrive 64, chain 64, prepare 4 (14 + 3 * 9 + 4) + 36 stored + 1, splats 13 each, fill_holes 1, downsample_8 10
    assert bytes_of_a_pixel(weights, "float32") == 490
    assert bytes_of_a_pixel(weights, "half") == 490 - 72
    # chain 16, prepare 4 (14 + 9 + 4) + 24 stored + 1
    assert bytes_of_a_pixel(zeros(), "half") == 490 - 48 - 72 - 72 - 48 + 24


def test_an_unknown_gpu_is_one_line():
    done = CliRunner().invoke(stss, ["bench", "--model", "voodoo"])
    assert done.exit_code != 0
    assert "--model: expected one of h100" in str(done.exception or done.output)


def command(text):
    return sys.executable, "-c", text


STEPS = [
    Step("good", command("print('all well')"), 60),
    Step("bad", command("print('first'); print('no | such thing'); raise SystemExit(1)"), 60),
    Step("endless", command("import threading; threading.Event().wait()"), 1),
    Step("absent", None, 0, "not here"),
]


def test_every_step_has_its_row_and_what_is_wrong_comes_first(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_report, "steps", lambda *_, **__: STEPS)
    folder, told = tmp_path / "report", []
    assert not gpu_report.gpu_report(folder, None, "h100", tiny=True, tell=told.append)
    steps = json.loads((folder / "report.json").read_text())["steps"]
    assert [step["outcome"] for step in steps] == ["passed", "failed", "over its limit", "skipped"]
    text = (folder / "README.md").read_text()
    assert text.index("**bad** failed") < text.index("## Steps")
    assert "**endless** over its limit, see `logs/endless.txt`: no output" in text
    assert text.index("The figures mean nothing") < text.index("## What is wrong")
    assert "no / such thing" in text
    assert (folder / "logs" / "bad.txt").read_text().splitlines() == ["first", "no | such thing"]
    assert len(told) == len(STEPS)


LEAVES = """
import subprocess, sys
print(subprocess.Popen([sys.executable, "-c", "import threading; threading.Event().wait()"]).pid)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_no_process_outlives_its_step(tmp_path, monkeypatch):
    """Those of a benchmark would go on using the device, while the next step is timed."""
    monkeypatch.setattr(gpu_report, "steps", lambda *_, **__: [Step("bench", command(LEAVES), 60)])
    gpu_report.gpu_report(tmp_path / "report", None, "h100", tiny=False, tell=lambda line: None)
    stat = Path("/proc") / (tmp_path / "report" / "logs" / "bench.txt").read_text().strip() / "stat"
    assert not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] in "ZX"


def test_a_folder_with_something_in_it_is_refused(tmp_path):
    (tmp_path / "mine").write_text("")
    done = CliRunner().invoke(stss, ["gpu-report", "-o", str(tmp_path), "--tiny"])
    assert done.exit_code != 0
    assert "expected a new or an empty folder" in str(done.exception or done.output)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_slow_launches_and_faster_peers_are_listed(tmp_path: Path):
    def launch(name, model, measured):
        return {
            "stage": "encoder",
            "name": name,
            "kernel": "conv_local",
            "limit": "L2",
            "roof_us": 1,
            "model_us": model,
            "measured_us": measured,
        }

    launches = [launch("quick", 10, 15), launch("slow", 10, 50), launch("tiny", 0.1, 1)]
    data = {"gpu": "H100", "roof_ms": 0.003, "model_ms": 0.02, "measured_ms": 0.066, "launches": launches}
    (tmp_path / "launches.json").write_text(json.dumps(data))

    def row(name, peer, precision, ms):
        return {"name": name, "peer": peer, "details": {"precision": precision}, "minimum_ms": ms, "median_ms": ms, "error": 1e-6}

    rows = [row("cl", False, "float32", 2.0), row("quicker", True, "float32", 1.0), row("other", True, "float16", 1.0)]
    (tmp_path / "bench.json").write_text(json.dumps({"sizes": [{"rows": rows}]}))
    wrong = page(tmp_path, {"tiny": False, "machine": {"device": "a GPU"}, "steps": []}).split("## Steps")[0]
    assert "mean nothing" not in wrong
    assert "encoder slow: 50 us, by the model 10 (L2)" in wrong
    assert "quicker takes 1.00 ms, cl 2.00 ms" in wrong
    assert "other" not in wrong
    assert "encoder quick" not in wrong
    assert "encoder tiny" not in wrong
