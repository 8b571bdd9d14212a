"""The report on a GPU: its bookkeeping, never its times."""

import json
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from rich.console import Console

from stss.cli.main import stss
from stss_lab.bench import gpu_report
from stss_lab.bench.gpu_report import Step
from tests.hostile.cases import runs

pytestmark = pytest.mark.usefixtures("device")


def command(text):
    return sys.executable, "-c", text


STEPS = [
    Step("good", command("print('all well')"), 60),
    Step("bad", command("print('first'); print('no | such thing'); raise SystemExit(1)"), 60),
    Step("endless", command("import threading; threading.Event().wait()"), 1),
    Step("absent", None, 0, "not here"),
]


@pytest.mark.thorough
def test_every_step_has_its_row_and_what_is_wrong_comes_first(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_report, "steps", lambda *_, **__: STEPS)
    folder = tmp_path / "report"
    assert not gpu_report.gpu_report(folder, None, tiny=True, console=Console(quiet=True))
    text = (folder / "README.md").read_text()
    rows = [line.split(" | ")[:2] for line in text.splitlines() if line.startswith("| ")]
    assert rows[2:6] == [["| good", "passed"], ["| bad", "failed"], ["| endless", "over its limit"], ["| absent", "skipped"]]
    assert text.index("**bad** failed") < text.index("## Steps")
    assert "**endless** over its limit, see `logs/endless.txt`: no output" in text
    assert text.index("The figures mean nothing") < text.index("## Faults")
    assert "no / such thing" in text
    assert (folder / "logs" / "bad.txt").read_text().splitlines() == ["first", "no | such thing"]


LEAVES = """
import subprocess, sys
print(subprocess.Popen([sys.executable, "-c", "import threading; threading.Event().wait()"]).pid)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_no_process_outlives_its_step(tmp_path, monkeypatch):
    """Those of a benchmark would go on using the device, while the next step is timed."""
    monkeypatch.setattr(gpu_report, "steps", lambda *_, **__: [Step("bench", command(LEAVES), 60)])
    gpu_report.gpu_report(tmp_path / "report", None, tiny=False, console=Console(quiet=True))
    assert not runs((tmp_path / "report" / "logs" / "bench.txt").read_text().strip())


def test_a_folder_with_something_in_it_is_refused(tmp_path):
    (tmp_path / "mine").write_text("")
    result = CliRunner().invoke(stss, ["gpu-report", "-o", str(tmp_path), "--tiny"])
    assert result.exit_code != 0
    assert "expected a new or an empty folder" in str(result.exception or result.output)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_faster_peers_are_listed(tmp_path: Path):
    def row(name, peer, precision, ms):
        return {"name": name, "peer": peer, "details": {"precision": precision}, "minimum_ms": ms, "median_ms": ms, "error": 1e-6}

    rows = [row("cl", False, "float32", 2.0), row("quicker", True, "float32", 1.0), row("other", True, "float16", 1.0)]
    (tmp_path / "bench.json").write_text(json.dumps({"sizes": [{"rows": rows}]}))
    assert gpu_report.find_slower(tmp_path / "bench.json") == ["quicker takes 1.00 ms, cl 2.00 ms"]
