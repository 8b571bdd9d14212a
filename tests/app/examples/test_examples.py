"""The examples run as they stand, on small input."""

import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import stss as stss_package
from conformance.judging.judge import TIERS, Tier
from conformance.scenes import render
from stss.cli.main import stss
from stss.images.read_write import read_rgb
from stss_ref.warp import warp

EXAMPLES = Path(__file__).parents[3] / "examples"


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


SMALL = 24, 40


def show(folder, **changes):
    """The images of the engine's loop for twelve small frames, with `bilinear`; ``changes`` to the example, by name."""
    example = runpy.run_path(str(EXAMPLES / "engine_loop.py"))
    example["main"].__globals__.update(changes)
    example["main"](folder, SMALL, 12, "bilinear")
    return {int(path.stem): read_rgb(path) for path in sorted(folder.iterdir())}, example


def error(image, number, example):
    """Mean distance to the full render without jitter, except at the spark."""
    truth = example["EXPOSURE"] * render(example["SCENE"], number, *(2 * n for n in SMALL), samples=4).color
    y, x = (np.indices(image.shape[:2]) + 0.5) / image.shape[1]
    spark = (x - number / example["FRAMES"]) ** 2 + (y - 0.15) ** 2 < 0.05**2
    return np.abs(image - (truth / (1 + truth)) ** (1 / 2.2))[~spark].mean()


def test_the_loop_of_an_engine(device, tmp_path, capsys):
    """Cut and dropped frame; a picture that is not moved back by its jitter is farther from the full render."""
    images, example = show(tmp_path / "right", DROPPED=4)
    lines = capsys.readouterr().out.splitlines()
    kinds = ["SF", "EF", "SF", "EF", None, "the last one again", *3 * ["SF", "EF"]]
    assert lines == [f"frame {n}: {kind}" for n, kind in enumerate(kinds) if kind]
    assert sorted(images) == [n for n in range(12) if n != 4]
    np.testing.assert_array_equal(images[5], images[3])
    trembling, _ = show(tmp_path / "trembling", DROPPED=4, settle=lambda image, shift: image)
    here = [n for n in images if n != 5 and example["jitter"](n).any()]
    assert np.mean([error(trembling[n], n, example) / error(images[n], n, example) for n in here]) > 1.2


def test_motion_of_the_loop_has_the_jitter():
    """It leads to where the same static surface was; without the jitter's step it would not."""
    example = runpy.run_path(str(EXAMPLES / "engine_loop.py"))
    camera = np.array(example["SCENE"].camera.position(0)) / 100
    before, now = (stss_package.convert(n, example["draw"](n, SMALL), example["RULES"], camera=camera) for n in (1, 2))
    step = np.float32(example["jitter"](1) - example["jitter"](2))
    assert step.any()
    apart = []
    for motion in (now.motion, now.motion - step):
        there, inside = warp(before.position, motion)
        surface = inside & np.isfinite(now.depth) & (now.stencil == 0)
        apart.append(np.median(np.linalg.norm(there - now.position, axis=-1)[surface]))
    assert apart[0] < apart[1] / 5, apart


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
        result = CliRunner().invoke(stss, [*words, *stage], catch_exceptions=False)
        assert result.exit_code == 0, result.output
    for name in ("results.json", "junit.xml", "report.html", "full.json"):
        assert name in text
        assert Path(name).is_file()
