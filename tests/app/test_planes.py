"""``--planes half``: what is read is rounded, every file says so, and no other option minds."""

import numpy as np
import pytest

from stss.demo import write_demo_sequence
from stss.frames.display_frame import HALF, prepare
from stss.images.color import transfer
from stss.images.read_write import read_header, read_rgb
from stss.sequence.reader import open_sequence
from stss_ground.optional import installed
from tests.app.test_cli import frames_of, stss

COUNT = 8


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    write_demo_sequence(out, COUNT, (18, 32))
    return out / "frames"


@pytest.fixture(scope="module")
def by_half(frames, weights, tmp_path_factory):
    """Nothing may be changed in it."""
    out = tmp_path_factory.mktemp("half") / "out"
    assert stss("run", frames, "-o", out, "--weights", weights, "--planes", "half").returncode == 0
    return out


def test_every_file_names_it(frames, weights, by_half, tmp_path):
    assert stss("run", frames, "-o", tmp_path / "out", "--weights", weights).returncode == 0
    for number in range(COUNT):
        name = f"frame.{number:04d}.exr"
        assert read_header(by_half / name).attributes["stss:planes"] == "half"
        assert read_header(tmp_path / "out" / name).attributes["stss:planes"] == "float32"
    assert any(
        (read_rgb(by_half / f"frame.{n:04d}.exr") != read_rgb(tmp_path / "out" / f"frame.{n:04d}.exr")).any() for n in range(8)
    )


def test_planes_are_those_of_float32_rounded(frames):
    buffers = open_sequence(frames, "stss").load(0)
    exact, rounded = (prepare(buffers, transfer("srgb"), "scale", planes) for planes in ("float32", "half"))
    assert all(getattr(rounded, name).dtype == np.float16 for name in HALF)
    for name in HALF:
        error = np.abs(getattr(rounded, name).astype(np.float64) - getattr(exact, name))
        assert (error <= 2.0**-11 * np.abs(getattr(exact, name)) + 2.0**-25).all()
    assert rounded.motion.dtype == np.float32
    assert np.array_equal(rounded.motion, exact.motion)


def test_resume_makes_anew_what_other_planes_made(frames, weights, by_half, tmp_path):
    run = ["run", frames, "-o", tmp_path / "out", "--weights", weights, "--frames", "0:3"]
    assert stss(*run).returncode == 0
    assert "0 kept" in stss(*run, "--planes", "half", "--resume").stderr
    assert "4 kept" in stss(*run, "--planes", "half", "--resume").stderr
    assert {k: v for k, v in frames_of(by_half).items() if k < "frame.0004"} == frames_of(tmp_path / "out")


@pytest.mark.parametrize(
    "others",
    [
        ("--backend", "ref"),
        ("--precision", "half"),
        ("--skip", "off"),
        ("--memory-limit", "9"),
        ("--transfer", "hdr", "--depth", "clip"),
        ("--keep-going", "--non-finite", "mask", "--format", "png", "--show-skipped"),
        ("--rendered", "even"),
    ],
    ids=" ".join,
)
def test_no_other_option_minds(frames, weights, tmp_path, others):
    planes = ("--planes", "half", "--frames", "0:5")
    result = stss("run", frames, "-o", tmp_path / "out", "--weights", weights, *planes, *others)
    assert result.returncode == 0, result.stderr
    made = sorted((tmp_path / "out").glob("frame.*"))
    assert len(made) == 6
    assert {read_header(path).attributes["stss:planes"] for path in made} == {"half"}


def test_workers_round_too(frames, weights, by_half, tmp_path):
    if not installed("distributed"):
        pytest.skip("the extra cluster is not installed")
    out = tmp_path / "out"
    result = stss("run", frames, "-o", out, "--weights", weights, "--planes", "half", "--cluster", "local:1")
    assert result.returncode == 0, result.stderr
    assert frames_of(out) == frames_of(by_half)


def test_a_budget_is_tried_on_such_frames(tmp_path):
    write_demo_sequence(tmp_path / "demo", 10, (18, 32))
    run = ("run", tmp_path / "demo" / "frames", "-o", tmp_path / "out", "--planes", "half", "--budget", "10000ms")
    assert stss(*run).returncode == 0
    assert read_header(tmp_path / "out" / "frame.0001.exr").attributes["stss:planes"] == "half"


def test_other_planes_are_refused(frames, tmp_path):
    result = stss("run", frames, "-o", tmp_path / "out", "--planes", "quarter")
    assert result.returncode == 2
    assert "quarter" in result.stderr
    assert not (tmp_path / "out").exists()
