"""The command line as a user types it."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest

from stss.cli.main import main
from stss.demo import demo_path, write_demo_sequence
from stss.images.read_write import read_header, read_rgb
from stss_ground.optional import installed
from tests.hostile.cases import NOTES, call

SIZE = (18, 32)
FRAMES = 8


SECONDS = 300
"""For a call: the first one compiles kernels, and tests the device."""


def stss(*arguments):
    """In this process."""
    return call(*arguments, seconds=SECONDS)


def command(*arguments):
    return [sys.executable, "-m", "stss", *map(str, arguments)]


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    write_demo_sequence(out, FRAMES, SIZE)
    return out


@pytest.fixture(scope="module")
def by_random_weights(sequence, weights, tmp_path_factory):
    """Output of the whole sequence; a process of its own made it. Nothing may be changed in it."""
    out = tmp_path_factory.mktemp("random") / "out"
    arguments = command("run", sequence / "frames", "-o", out, "--weights", weights)
    result = subprocess.run(arguments, capture_output=True, text=True, timeout=SECONDS, check=False)
    assert result.returncode == 0, result.stderr
    assert "4 SF, 4 EF written" in result.stderr
    return out


@pytest.fixture(scope="module")
def by_default(sequence, tmp_path_factory):
    """Output of the whole sequence by the default weights. Nothing may be changed in it."""
    out = tmp_path_factory.mktemp("default") / "out"
    assert stss("run", sequence / "frames", "-o", out).returncode == 0
    return out


def frames_of(out):
    return {path.name: path.read_bytes() for path in sorted(Path(out).rglob("frame.*")) if path.is_file()}


def fails(result, *words):
    """One line on stderr that holds all of ``words``, status 2, no traceback."""
    assert result.returncode == 2, result.stderr
    lines = [line for line in result.stderr.splitlines() if line and not line.startswith(NOTES)]
    assert len(lines) == 1, result.stderr
    for word in words:
        assert str(word) in lines[0]


def test_run_doubles_size_and_rate(by_random_weights):
    for number in range(FRAMES):
        path = by_random_weights / f"frame.{number:04d}.exr"
        image = read_rgb(path)
        assert image.shape == (2 * SIZE[0], 2 * SIZE[1], 3)
        assert np.isfinite(image).all()
        attributes = read_header(path).attributes
        assert attributes["stss:kind"] == ("EF" if number % 2 else "SF")
        assert attributes["stss:transfer"] == "srgb"
        assert len(attributes["stss:weights"]) == 64
        assert (by_random_weights / "holes" / f"frame.{number:04d}.png").exists() == bool(number % 2)


def test_the_frames_are_what_python_gets(sequence, weights, by_random_weights):
    """The generator of the README and the command line give the same images."""
    from stss.frames.backends import open_backend
    from stss.frames.supersampler import supersample
    from stss.sequence.reader import open_sequence
    from stss.weights.file import load

    frames = open_sequence(sequence / "frames", "stss")
    outputs = list(supersample(map(frames.load, frames.numbers), open_backend("cl", load(weights).weights)))
    assert [output.number for output in outputs] == list(range(FRAMES))
    for output in outputs:
        written = read_rgb(by_random_weights / f"frame.{output.number:04d}.exr")
        np.testing.assert_array_equal(written, output.image.astype(np.float16))


def test_a_range_has_the_bits_of_the_whole(sequence, weights, by_random_weights, tmp_path):
    assert stss("run", sequence / "frames", "-o", tmp_path / "some", "--weights", weights, "--frames", "5:6").returncode == 0
    some, whole = frames_of(tmp_path / "some"), frames_of(by_random_weights)
    assert sorted(p.name for p in (tmp_path / "some").glob("*.exr")) == ["frame.0005.exr", "frame.0006.exr"]
    assert some.items() <= whole.items()


def test_resume_after_a_kill_has_the_bits_of_one_run(sequence, weights, by_random_weights, tmp_path):
    arguments = ["run", sequence / "frames", "--weights", weights, "-o"]
    out = tmp_path / "killed"
    with subprocess.Popen(command(*arguments, out), stderr=subprocess.DEVNULL) as process:
        while not (out / "frame.0001.exr").exists() and process.poll() is None:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
    result = stss(*arguments, out, "--resume")
    assert result.returncode == 0, result.stderr
    assert "0 kept" not in result.stderr
    assert frames_of(out) == frames_of(by_random_weights)
    assert "8 kept" in stss(*arguments, out, "--resume").stderr


def test_resume_makes_anew_what_other_settings_made(sequence, by_default, tmp_path):
    shutil.copytree(by_default, tmp_path / "out")
    result = stss("run", sequence / "frames", "-o", tmp_path / "out", "--weights", "bilinear", "--resume")
    assert "0 kept" in result.stderr


def test_png_is_display_referred(sequence, by_default, tmp_path):
    from stss.images.color import transfer

    stss("run", sequence / "frames", "-o", tmp_path / "png", "--format", "png")
    linear = read_rgb(by_default / "frame.0004.exr")
    shown = read_rgb(tmp_path / "png" / "frame.0004.png")
    # half a step of 8 bits, and what half precision loses of values up to 1: at most 2**-11
    assert np.abs(transfer("srgb").display(linear) - shown).max() <= 0.5 / 255 + 2**-10
    assert read_header(tmp_path / "png" / "frame.0004.png").attributes["stss:kind"] == "SF"


def test_a_bad_frame_stops_or_is_left_out(sequence, tmp_path):
    frames = tmp_path / "frames"
    shutil.copytree(sequence / "frames", frames)
    bad = demo_path(frames, 4)
    bad.write_bytes(bad.read_bytes()[:2000])
    run = ["run", frames, "--weights", "bilinear", "-o"]
    fails(stss(*run, tmp_path / "stopped"), bad)
    result = stss(*run, tmp_path / "out", "--keep-going")
    assert result.returncode == 1
    assert str(bad) in result.stderr
    # 5 has lost the frame it is made of; 6 and 7 start a new history.
    assert sorted(p.name for p in (tmp_path / "out").glob("*.exr")) == [f"frame.000{n}.exr" for n in (0, 1, 2, 3, 6, 7)]


def test_a_missing_frame_is_named(sequence, tmp_path):
    frames = tmp_path / "frames"
    shutil.copytree(sequence / "frames", frames)
    demo_path(frames, 3).unlink()
    fails(stss("run", frames, "-o", tmp_path / "out"), "frame 3", "every display frame")


def test_earlier_frames_are_not_mixed_with(sequence, by_default, tmp_path):
    out = shutil.copytree(by_default, tmp_path / "out")
    fails(stss("run", sequence / "frames", "-o", out), out, "--resume", "--overwrite")
    result = stss("run", sequence / "frames", "-o", out, "--overwrite", "--frames", "2:3")
    assert result.returncode == 0
    assert sorted(p.name for p in out.glob("*.exr")) == ["frame.0002.exr", "frame.0003.exr"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "nowhere", "-o", "out"], ["nowhere"]),
        (["run", "{frames}"], ["--out"]),
        (["run", "{frames}", "-o", "out", "--profile", "renderman"], ["renderman", "blender"]),
        (["run", "{frames}", "-o", "out", "--profile", "blender"], ["Combined"]),
        (["run", "{frames}", "-o", "out", "--frames", "5:2"], ["5:2"]),
        (["run", "{frames}", "-o", "out", "--frames", "5:20"], ["5:20", "0:7"]),
        (["run", "{frames}", "-o", "out", "--rendered", "odd"], ["odd", "frame 1"]),
        (["run", "{frames}", "-o", "out", "--transfer", "log"], ["log", "srgb"]),
        (["run", "{frames}", "-o", "out", "--weights", "nothing.safetensors"], ["nothing.safetensors"]),
        (["run", "{frames}", "-o", "out", "--weights", "{frames}/demo.0000.exr"], ["demo.0000.exr"]),
        (["run", "{frames}", "-o", "out", "--camera", "no.csv"], ["no.csv"]),
        (["run", "{frames}", "-o", "{frames}/demo.0000.exr"], ["demo.0000.exr"]),
        (["compare", "{frames}", "nowhere"], ["nowhere"]),
        (["weights", "inspect", "nothing"], ["nothing"]),
        (["weights", "import", "{frames}/demo.0000.exr", "-o", "w.safetensors"], ["demo.0000.exr"]),
        (["supersample"], ["supersample"]),
        (["demo", "{demo}"], ["--overwrite"]),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(arguments, words, sequence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    filled = [a.format(frames=sequence / "frames", demo=sequence) for a in arguments]
    fails(stss(*filled), *words)
    assert not list(tmp_path.rglob("*.exr"))
    assert not list(tmp_path.rglob("*.safetensors"))


def test_weights_inspect_prints_the_papers_totals(weights):
    text = stss("weights", "inspect", weights).stdout
    assert "417,241" in text or "417.24" in text
    rows = json.loads(stss("weights", "inspect", weights, "--json").stdout)
    assert sum(row["parameters"] for row in rows["components"] if row["name"] != "Full") == 417_241


def test_weights_import_is_what_the_checkpoint_holds(reference_data, tmp_path):
    checkpoint = reference_data / "checkpoints" / "arena.pkl"
    result = stss("weights", "import", checkpoint, "-o", tmp_path / "w.safetensors")
    assert result.returncode == 0, result.stderr
    from stss.weights.checkpoint import read_checkpoint
    from stss.weights.file import load

    expected = read_checkpoint(checkpoint)
    for name, array in load(tmp_path / "w.safetensors").weights.items():
        np.testing.assert_array_equal(array, expected[name])


def test_check_and_compare_and_json(sequence, by_default):
    result = stss("check", sequence / "frames", "--json")
    assert result.returncode in (0, 1), result.stderr
    json.loads(result.stdout)
    comparison = json.loads(stss("compare", by_default, sequence / "truth", "--json").stdout)
    assert set(comparison["means"]) == {"SF", "EF", "MEAN"}


def test_blender_with_the_authors_weights(reference_data, tmp_path):
    """The figures of the specification's page, to 0.1 dB: RGB PSNR over frames 6 to 14."""
    camera = tmp_path / "camera.csv"
    rows = ["frame,x,y,z"]
    for frame in range(1, 15):
        s = frame / 60
        rows.append(f"{frame},{2.5 * np.sin(1.2 * s)},{-8 + 0.8 * s},{2.2 + 0.2 * np.sin(2 * s)}")
    camera.write_text("\n".join(rows) + "\n")
    weights = tmp_path / "arena.safetensors"
    stss("weights", "import", reference_data / "checkpoints" / "arena.pkl", "-o", weights)
    common = [
        "run",
        reference_data / "blender" / "lr",
        "--profile",
        "blender",
        "--camera",
        camera,
        "--frames",
        "6:14",
        "-o",
    ]
    for name, chosen, sf, ef in (("arena", weights, 31.0, 29.2), ("bilinear", "bilinear", 29.7, 27.8)):
        assert stss(*common, tmp_path / name, "--weights", chosen).returncode == 0
        result = stss("compare", tmp_path / name, reference_data / "blender" / "hr", "--json")
        means = json.loads(result.stdout)["means"]
        assert abs(means["SF"]["all"]["psnr_rgb"] - sf) <= 0.1
        assert abs(means["EF"]["all"]["psnr_rgb"] - ef) <= 0.1


def test_an_interrupt_is_not_a_traceback(sequence, tmp_path):
    arguments = command("run", sequence / "frames", "-o", tmp_path / "out")
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as process:
        while not (tmp_path / "out" / "frame.0000.exr").exists() and process.poll() is None:
            time.sleep(0.005)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert "Traceback" not in errors
    assert not [p for p in (tmp_path / "out").rglob("*") if p.name.startswith(".")]
    assert os.path.lexists(tmp_path / "out" / "frame.0000.exr")


def test_an_empty_stand_in_for_a_package_is_no_package(monkeypatch):
    """colour-science leaves one for Matplotlib where that is not installed."""
    monkeypatch.setitem(sys.modules, "matplotlib", types.ModuleType("matplotlib"))
    assert not installed("matplotlib")
    monkeypatch.setattr(sys, "argv", ["stss", "--version"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
