"""The examples run as they stand, on small input."""

import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from conformance.judging.judge import TIERS, Tier
from stss.cli.main import stss

EXAMPLES = Path(__file__).parents[2] / "examples"


def run_example(monkeypatch, capsys, name, *words):
    monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


@pytest.fixture
def few_cases(monkeypatch):
    """The judge itself is tested elsewhere."""
    monkeypatch.setitem(TIERS, "quick", Tier("quick", 6, 2, 0))


@pytest.mark.parametrize(("page", "before"), [("README.md", "examples/"), ("webgpu/README.md", "")])
def test_the_page_names_every_example(page, before):
    for path in (EXAMPLES / page).parent.glob("*.[pw][yg]*"):
        assert f"`{before}{path.name}`" in (EXAMPLES / page).read_text(), path.name


def test_the_porters_port_passes(monkeypatch, few_cases):
    monkeypatch.chdir(EXAMPLES)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    result = CliRunner().invoke(stss, ["conform", "--port", "porter:Port", "--stages", "warp"], catch_exceptions=False)
    assert result.exit_code == 0, result.output


def test_arrays_of_an_engine(device, monkeypatch, capsys):
    lines = run_example(monkeypatch, capsys, "engine_engineer.py").splitlines()
    assert [line.split(":")[0] for line in lines] == [f"frame {n} {'EF' if n % 2 else 'SF'}" for n in range(6)]
    assert all("160 x 96" in line for line in lines)


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
