"""The command line as a user types it."""

import json
import shutil
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest

from stss.demo import demo_path, write_demo_sequence
from stss.images.color import transfer
from stss.images.headers import read_header
from stss.images.read_write import read_rgb, write_channels
from stss.run.skip_report import describe_costs
from stss_cl.cost import Cost
from tests.app.conftest import PLAIN, files, frame_channels, frames_of
from tests.hostile.cases import call, refused
from tests.tiers import thorough

SIZE = (18, 32)
FRAMES = 10
SECONDS = 300
"""Seconds for a call: the first one compiles kernels, and tests the device."""


def stss(*arguments):
    """In this process."""
    return call(*arguments, seconds=SECONDS)


def require_success(result):
    assert result.returncode == 0, result.stderr
    return result


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    write_demo_sequence(out, FRAMES, SIZE)
    return out


@pytest.fixture(scope="module")
def frames(sequence):
    return sequence / "frames"


@pytest.fixture
def changeable(frames, tmp_path):
    return shutil.copytree(frames, tmp_path / "frames")


@pytest.mark.parametrize("group", [(), ("weights",)])
def test_a_command_alone_prints_its_help_in_lines(group):
    words = [sys.executable, "-m", "stss", *group]
    alone, asked = (subprocess.run(words + more, capture_output=True, text=True, check=False) for more in ([], ["--help"]))
    before_8_2 = tuple(map(int, version("click").split(".")[:2])) < (8, 2)
    assert (alone.returncode, asked.returncode) == (0 if before_8_2 else 2, 0)
    assert alone.stdout + alone.stderr == asked.stdout


@pytest.fixture(scope="module")
def by_network(device, frames, weights, tmp_path_factory):
    """Output of the whole sequence on the device, made by a separate process. Tests must not change it."""
    out = tmp_path_factory.mktemp("random") / "out"
    arguments = [sys.executable, "-m", "stss", "run", frames, "-o", out, "--weights", weights]
    result = subprocess.run(arguments, capture_output=True, text=True, timeout=SECONDS, check=False)
    assert "5 SF, 5 EF written" in require_success(result).stderr
    return out


@pytest.fixture(scope="module")
def plain(frames, tmp_path_factory):
    """Output of the whole sequence without a network. Tests must not change it."""
    out = tmp_path_factory.mktemp("plain") / "out"
    require_success(stss("run", frames, "-o", out, *PLAIN))
    return out


@pytest.mark.parametrize("command", ["check", "run -o out", "compare out"])
def test_a_pattern_that_the_shell_wrote_out(frames, command):
    """``stss check frames/*.exr``"""
    refused(
        call(*command.split(), *sorted(frames.iterdir())),
        "demo.0000.exr and 9 more: expected a folder, or a pattern like name.####.exr",
    )


def names(out):
    return sorted(path.name for path in out.glob("frame.*"))


def test_run_doubles_size_and_rate(by_network):
    for number in range(FRAMES):
        path = by_network / f"frame.{number:04d}.exr"
        image = read_rgb(path)
        assert image.shape == (2 * SIZE[0], 2 * SIZE[1], 3)
        assert np.isfinite(image).all()
        attributes = read_header(path).attributes
        assert attributes["stss:kind"] == ("EF" if number % 2 else "SF")
        assert attributes["stss:transfer"] == "srgb"
        assert len(attributes["stss:weights"]) == 64
        assert (by_network / "holes" / f"frame.{number:04d}.png").exists() == bool(number % 2)


def test_the_frames_are_what_python_gets(frames, weights, by_network):
    """The generator of the README and the command line give the same images."""
    from stss.frames.backends import open_backend
    from stss.frames.supersampler import Supersampler
    from stss.sequence.reader import open_sequence
    from stss.weights.file import load

    sequence = open_sequence(frames, "stss")
    outputs = list(Supersampler(backend=open_backend("cl", load(weights).weights))(map(sequence.load, sequence.numbers)))
    assert [output.number for output in outputs] == list(range(FRAMES))
    for output in outputs:
        image = read_rgb(by_network / f"frame.{output.number:04d}.exr")
        np.testing.assert_array_equal(image, output.image.astype(np.float16))


def test_a_range_has_the_bits_of_the_whole_and_says_what_was_skipped(frames, weights, by_network, tmp_path):
    out = tmp_path / "some"
    result = require_success(stss("run", frames, "-o", out, "--weights", weights, "--frames", "5:6"))
    assert names(out) == ["frame.0005.exr", "frame.0006.exr"]
    assert frames_of(out).items() <= frames_of(by_network).items()
    assert "network computed: 2 whole" in result.stderr
    costs = [Cost(1.0, "whole"), Cost(0.1, "changed"), Cost(0.3, "changed"), Cost(0.0, "none")]
    assert describe_costs(costs) == "network computed: 1 whole, 2 in part (20% of the frame had changed), 1 not at all"


@pytest.mark.parametrize(
    "others",
    [
        thorough(("--precision", "half", "--skip", "off", "--memory-limit", "9", "--transfer", "none", "--depth", "clip")),
        (*PLAIN, "--keep-going", "--non-finite", "mask", "--format", "png", "--rendered", "even"),
    ],
    ids=" ".join,
)
def test_options_go_together(device, frames, weights, tmp_path, others):
    require_success(stss("run", frames, "-o", tmp_path / "out", "--frames", "0:5", "--weights", weights, *others))
    assert len(names(tmp_path / "out")) == 6


def test_resume_makes_anew_what_other_settings_made(frames, plain, tmp_path):
    again = ["run", frames, "-o", shutil.copytree(plain, tmp_path / "out"), *PLAIN, "--resume", "--transfer", "none"]
    assert "0 kept" in require_success(stss(*again)).stderr
    assert "10 kept" in require_success(stss(*again)).stderr


def test_frames_of_a_longer_run_are_named(changeable, tmp_path):
    """The sequence got shorter: what --resume leaves would be at the film's end."""
    out, count = tmp_path / "out", len(list(changeable.iterdir()))
    require_success(call("run", changeable, "-o", out, *PLAIN))
    (changeable / f"demo.{count - 1:04d}.exr").unlink()
    words = f"of an earlier run, not of this one: frame.{count - 1:04d}."
    assert words in require_success(call("run", changeable, "-o", out, *PLAIN, "--resume")).stderr
    assert "earlier run" not in require_success(call("run", changeable, "-o", out, *PLAIN, "--resume", "--frames", "0:1")).stderr


def test_an_option_s_old_name_is_one_line(frames, plain, tmp_path):
    """``hdr`` gives the files of the default."""
    result = require_success(stss("run", frames, "-o", tmp_path / "out", *PLAIN, "--frames", "0:3", "--transfer", "hdr"))
    (line,) = (line for line in result.stderr.splitlines() if "hdr" in line)
    assert line.startswith("warning: --transfer hdr is gone: srgb carries highlights past the network")
    assert frames_of(tmp_path / "out").items() <= frames_of(plain).items()


def test_png_is_display_referred(frames, plain, tmp_path):
    require_success(stss("run", frames, "-o", tmp_path / "png", "--format", "png", "--frames", "4:4", *PLAIN))
    linear = read_rgb(plain / "frame.0004.exr")
    image = read_rgb(tmp_path / "png" / "frame.0004.png")
    # half a step of 8 bits, and what half precision loses of values up to 1: at most 2**-11
    assert np.abs(transfer("srgb").display(linear) - image).max() <= 0.5 / 255 + 2**-10
    assert read_header(tmp_path / "png" / "frame.0004.png").attributes["stss:kind"] == "SF"


def test_a_bad_frame_stops_the_run_at_its_turn_or_is_left_out(changeable, tmp_path):
    bad = demo_path(changeable, 4)
    bad.write_bytes(bad.read_bytes()[:-10])  # its header does not tell
    run = ["run", changeable, *PLAIN, "-o"]
    refused(stss(*run, tmp_path / "stopped"), bad)
    assert names(tmp_path / "stopped") == [f"frame.000{n}.exr" for n in range(4)]
    result = stss(*run, tmp_path / "out", "--keep-going")
    assert result.returncode == 1
    assert str(bad) in result.stderr
    # 5 has lost the frame it is made from; 6 and later frames start a new history.
    assert names(tmp_path / "out") == [f"frame.000{n}.exr" for n in (0, 1, 2, 3, 6, 7, 8, 9)]


@pytest.mark.parametrize("fault", ["empty", "header", "size"])
def test_a_frame_whose_header_is_bad_is_left_out_like_any_other(fault, changeable, tmp_path):
    """A renderer's placeholder has no bytes; a frame may be of another size."""
    bad = demo_path(changeable, 4)
    content = {"empty": b"", "header": bad.read_bytes()[:300]}
    if fault == "size":
        write_channels(bad, frame_channels(4, (20, 20)))
    else:
        bad.write_bytes(content[fault])
    result = stss("run", changeable, *PLAIN, "-o", tmp_path / "out", "--keep-going")
    assert result.returncode == 1
    assert str(bad) in result.stderr
    assert names(tmp_path / "out") == [f"frame.000{n}.exr" for n in (0, 1, 2, 3, 6, 7, 8, 9)]
    refused(stss("run", changeable, *PLAIN, "-o", tmp_path / "none"), bad)
    report = stss("check", changeable)
    assert report.returncode == 2
    (line,) = (line for line in report.stdout.splitlines() if line.startswith("error"))
    assert bad.name in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("run nowhere -o out", ["nowhere"]),
        ("run {frames}", ["--out"]),
        ("run {frames} -o {plain}", ["--resume", "--overwrite"]),
        ("run {frames} -o out --resume --overwrite", ["--resume", "--overwrite"]),
        ("run {frames} -o out --profile renderman", ["renderman", "blender"]),
        ("run {frames} -o out --profile blender", ["profile blender finds normal", "profile stss finds 10"]),
        ("run {frames} -o out --also normla", ["did you mean normal"]),
        ("conform --port stss.port:ReferencePort --stages wrap", ["--stages", "did you mean warp?"]),
        ("run {frames} -o out --frames 5:20", ["5:20", "0:9"]),
        ("run {frames} -o out --rendered odd", ["odd", "frame 1"]),
        ("run {frames} -o out --transfer log", ["log", "srgb"]),
        ("run {frames} -o out --weights {frames}/demo.0000.exr", ["demo.0000.exr"]),
        ("run {frames} -o {frames}/demo.0000.exr", ["demo.0000.exr"]),
        ("compare {frames} nowhere", ["nowhere"]),
        ("compare . {frames}", ["no frames", "NAME.0001.png"]),
        ("weights inspect nothing", ["nothing"]),
        ("weights import {frames}/demo.0000.exr -o w.safetensors", ["demo.0000.exr"]),
        ("comprae {frames}", ["no command comprae", "did you mean compare?"]),
        ("demo {demo}", ["--overwrite"]),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(arguments, words, sequence, frames, plain, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = files(plain)
    refused(stss(*arguments.format(frames=frames, demo=sequence, plain=plain).split()), *words)
    assert not files(tmp_path)
    assert files(plain) == before


@pytest.mark.parametrize(
    ("command", "key"),
    [("check {demo}/frames", "findings"), ("compare {plain} {demo}/truth", "means"), ("weights inspect {weights}", "components")],
)
def test_json_has_what_it_is_for(sequence, plain, weights, command, key):
    assert key in json.loads(stss(*command.format(demo=sequence, plain=plain, weights=weights).split(), "--json").stdout)


@pytest.mark.thorough
def test_blender_with_the_authors_weights(device, reference_data, blender_camera, tmp_path):
    """The figures of the specification's page, to 0.1 dB: RGB PSNR over frames 6 to 14."""
    weights = tmp_path / "arena.safetensors"
    require_success(stss("weights", "import", reference_data / "checkpoints" / "arena.pkl", "-o", weights))
    common = ["run", reference_data / "blender" / "lr", "--profile", "blender", "--camera", blender_camera, "--frames", "6:14"]
    for name, source, sf, ef in (("arena", weights, 31.0, 29.2), ("bilinear", "bilinear", 29.7, 27.8)):
        require_success(stss(*common, "-o", tmp_path / name, "--weights", source))
        result = stss("compare", tmp_path / name, reference_data / "blender" / "hr", "--json")
        means = json.loads(result.stdout)["means"]
        assert abs(means["SF"]["all"]["psnr_rgb"] - sf) <= 0.1
        assert abs(means["EF"]["all"]["psnr_rgb"] - ef) <= 0.1


def test_a_mistake_is_said_before_a_device_is_opened(frames, tmp_path, monkeypatch):
    """A test of a new device takes a minute."""
    monkeypatch.setattr("stss.cli.run.open_backend", lambda *_, **__: pytest.fail("opened"))
    for option in (["--frames", "1:99999"], ["--cuts", "77"], ["--resume", "--overwrite"]):
        refused(stss("run", frames, "-o", tmp_path / "out", "--weights", "bilinear", *option), option[0])
    refused(stss("run", frames, "-o", frames, "--weights", "bilinear"), "the folder of the frames that are read")
    (tmp_path / "locked").mkdir()
    monkeypatch.setattr("os.access", lambda place, mode: place != tmp_path / "locked")  # to root all folders are open
    for out in ("locked", "locked/deep/out"):
        refused(stss("run", frames, "-o", tmp_path / out, "--weights", "bilinear"), "cannot be written to")
