"""The examples run as they stand, on small input."""

import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from conformance.judging.judge import TIERS, Tier
from stss.cli.main import stss
from stss.images.read_write import read_header, write_channels
from tests.app.conftest import frame_channels

EXAMPLES = Path(__file__).parents[2] / "examples"


def run_example(monkeypatch, capsys, name, *words):
    monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


@pytest.fixture
def few_cases(monkeypatch):
    """The judge itself is tested elsewhere."""
    monkeypatch.setitem(TIERS, "quick", Tier("quick", 6, 2, 0))


def test_the_page_names_every_example():
    page = (EXAMPLES / "README.md").read_text()
    for path in EXAMPLES.glob("*.py"):
        assert f"`examples/{path.name}`" in page, path.name


def test_the_porters_port_passes(monkeypatch, few_cases):
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    result = CliRunner().invoke(stss, ["conform", "--port", "porter:Port", "--stages", "warp"], catch_exceptions=False)
    assert result.exit_code == 0, result.output


def test_arrays_of_an_engine(device, monkeypatch, capsys):
    lines = run_example(monkeypatch, capsys, "engine_engineer.py").splitlines()
    assert [line.split(":")[0] for line in lines] == [f"frame {n} {'EF' if n % 2 else 'SF'}" for n in range(6)]
    assert all("160 x 96" in line for line in lines)


def test_frames_of_blender(device, tmp_path, monkeypatch, capsys):
    passes = {"motion": "Vector", "normal": "Normal", "depth": "Depth", "position": "Position", "stencil": "IndexOB"}
    (tmp_path / "lr").mkdir()
    for number in range(1, 4):
        channels = {name: plane for name, plane in frame_channels(number).items() if name != "nov.X"}
        named = {
            "ViewLayer." + (f"Combined.{n}" if n in "RGB" else n.replace(*_renamed(n, passes))): p for n, p in channels.items()
        }
        write_channels(tmp_path / "lr" / f"frame.{number:04d}.exr", named)
    (tmp_path / "camera.csv").write_text("frame,x,y,z\n" + "".join(f"{n},0,0,0\n" for n in range(1, 4)))
    said = run_example(monkeypatch, capsys, "blender_user.py", tmp_path / "lr", tmp_path / "camera.csv", tmp_path / "out")
    assert said.splitlines() == ["3 display frames, 3 with colour, 64 x 48", "frame 2: SF", "frame 3: EF"]
    assert read_header(tmp_path / "out" / "frame.0003.png").size == (96, 128)


def _renamed(name, passes):
    buffer = name.split(".")[0]
    return buffer, passes.get(buffer, buffer)


def test_numbers_that_a_tester_gets(monkeypatch, capsys):
    lines = run_example(monkeypatch, capsys, "numerical_tester.py").splitlines()
    units = {line.split(":")[0]: float(line.split()[3]) for line in lines if "units" in line}
    assert np.ptp([units["reference, width 64"], units["reference, width 4096"]]) < 4
    assert units["careless, width 4096"] > 20 * units["reference, width 4096"]
    assert "reference: a flat frame stays flat" in lines
    assert "careless: a flat frame does not stay flat" in lines


def test_the_workflow_of_a_port(tmp_path, monkeypatch, few_cases):
    """Its commands, for one stage of the reference."""
    text = re.sub(r">\n +(stss .*)\n +", r"\1 ", (EXAMPLES / "conform.yml").read_text())
    commands = re.findall(r"- run: (stss .*)", text)
    assert len(commands) == 2
    monkeypatch.chdir(tmp_path)
    Path("port.py").write_text("import sys, pathlib, stss.port as ours\nours.run_job(pathlib.Path(sys.argv[1]), 'ref')\n")
    Path("known.json").write_text('{"format": 1, "failures": []}')
    for command in commands:
        line = (
            command.replace("./my_port", f"'{sys.executable} port.py'")
            .replace("warp,holes", "rrm")
            .replace("--tier full", "--tier quick")
        )
        words = shlex.split(line)[1:]
        stage = ["--stages", "rrm"] if words[0] == "conform" else []
        done = CliRunner().invoke(stss, [*words, *stage], catch_exceptions=False)
        assert done.exit_code == 0, done.output
    for name in ("results.json", "junit.xml", "report.html", "full.json"):
        assert name in text
        assert Path(name).is_file()
