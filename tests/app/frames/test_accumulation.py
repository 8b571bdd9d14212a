"""Images that are mixed with those of the two frames before: an engine's loop, files, ranges, and what skips them."""

import shutil
import tempfile
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

import stss
from stss.cli.main import stss as command
from stss.frames.accumulation import Accumulation, accumulate_arrays
from stss.frames.backends import NETWORK
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import OnArrays
from stss.images.headers import read_header
from stss.images.read_write import read_rgb
from stss.run.job import run
from stss.run.options import RunOptions
from stss.weights.file import ALIASED, MADE_FOR, load, save
from stss_ref.resample import upsample_centres
from tests.app.conftest import frame_channels, frames_of, write_raw

SIZE = (8, 16)
MIXED = ComputeOptions(accumulate=True)
COUNT = 12


@pytest.fixture
def sequence(write_frames):
    """Eight frames, of which every second counts as rendered."""
    return write_frames(range(8), size=SIZE)


def loop(**options):
    return stss.Supersampler("bilinear", backend="ref", transfer="none", **options)


def frames_in(sequence, cut=None):
    opened = stss.open_sequence(sequence)
    for number in opened.numbers:
        buffers = opened.load(number, color=number % 2 == 0)
        yield buffers if number != cut else stss.Buffers(**{**vars(buffers), "cut": True})


@pytest.mark.parametrize("cut", [None, 4])
def test_each_image_is_mixed_with_those_of_the_two_frames_before(sequence, cut):
    frames, earlier, motions = list(frames_in(sequence, cut)), [], []
    for output, alone, buffers in zip(loop(accumulate=True)(frames), loop()(frames), frames, strict=True):
        if buffers.cut:
            earlier, motions = [], []
        motions = [np.asarray(buffers.motion, np.float32), *motions]
        want = accumulate_arrays(alone.image, earlier, motions[: len(earlier)]) if earlier else alone.image
        np.testing.assert_array_equal(output.image, want)
        assert bool(earlier) == (want != alone.image).any()
        earlier, motions = [alone.image, *earlier][:2], motions[:1]


def test_what_follows_a_frame_without_output_is_shown_as_it_is(sequence):
    """Frame 2 has none: its rendered frame and that of frame 1 are lost. Frame 3 has no earlier image, though frame 1 has one."""
    color = next(frames_in(sequence)).color
    frames = [replace(buffers, color=color if buffers.number in {0, 3} else None) for buffers in frames_in(sequence)]
    mixed, alone = loop(accumulate=True), loop()
    pairs = [(mixed.push(buffers), alone.push(buffers)) for buffers in frames[:5]]
    assert pairs[2] == (None, None)
    same = [None if a is None else np.array_equal(a.image, b.image) for a, b in pairs]
    assert same == [True, False, None, True, False]


def test_sequences_in_turns_have_a_history_each(sequence, monkeypatch):
    images, one = [], stss.open_backend("ref", "bilinear", ComputeOptions(accumulate=False))
    compute_one = one.compute
    monkeypatch.setattr(one, "compute", lambda *call: (
        images.append(weakref.ref((result := compute_one(*call))[0])) or result
    ))  # fmt: skip
    backend = Accumulation(one, accumulate_arrays)
    frames = list(frames_in(sequence))
    alone = [output.image for output in loop(accumulate=True)(frames)]
    first, second = (stss.Supersampler(backend=backend, transfer="none") for _ in range(2))
    for want, buffers in zip(alone, frames, strict=True):
        for each in (first, second):
            np.testing.assert_array_equal(each.push(buffers).image, want)
    assert sum(image() is not None for image in images) == 4  # two of each sequence
    del first, second, each
    assert all(image() is None for image in images)


def test_the_device_and_files(sequence, tmp_path):
    """The command's frames are the reference's, and say that they are mixed."""
    words = ["run", str(sequence), "--weights", "bilinear", "--accumulate"]
    for out, *more in (["cl"], ["ref", "--backend", "ref"]):
        result = CliRunner().invoke(command, [*words, "-o", str(tmp_path / out), *more])
        assert result.exit_code == 0, result.exception
    for number in range(8):
        name = f"frame.{number:04d}.exr"
        images = [read_rgb(tmp_path / folder / name) for folder in ("cl", "ref")]
        # Files hold half: the last bit of the transfer back may decide which of two neighbours a value becomes.
        np.testing.assert_allclose(*images, rtol=2**-10, atol=2**-20)
        assert read_header(tmp_path / "cl" / name).attributes["stss:method"] == "network, accumulate"


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Frames that all have colour."""
    folder = tmp_path_factory.mktemp("film")
    for number in range(COUNT):
        write_raw(folder / f"seq.{number:04d}.exr", frame_channels(number, SIZE))
    return folder


class ReadsAll(OnArrays):
    """An image of the three colours that stage ``frame`` may read; weights differ in how many they use."""

    name, method = "reads all", NETWORK

    def frame(self, inputs):
        return upsample_centres(inputs.colors.mean(axis=0)), np.ones(inputs.nov.shape, bool)


NUMBERS = st.integers(0, COUNT - 1)


@settings(max_examples=20)
@given(
    frames=st.tuples(NUMBERS, NUMBERS).map(sorted),
    cuts=st.sets(st.integers(1, COUNT - 1), max_size=2),
    missing=st.sets(st.integers(1, COUNT - 2), max_size=2),
    rendered=st.sampled_from([None, "even", "odd", "all"]),
)
def test_a_range_has_the_bits_of_the_whole(film, frames, cuts, missing, rendered):
    """Wherever it begins, and whatever lies before it; and a run that goes on from it keeps what is right."""
    weights = load("bilinear")
    with tempfile.TemporaryDirectory() as folder:
        taken = Path(folder) / "film"
        shutil.copytree(film, taken)
        for number in missing:
            (taken / f"seq.{number:04d}.exr").write_bytes(b"cut short")
        sequence = stss.open_sequence(taken, keep_going=True)
        usual = RunOptions(cuts=tuple(sorted(cuts - missing)), rendered=rendered, keep_going=True)
        run(sequence, Path(folder) / "whole", Accumulation(ReadsAll(), accumulate_arrays), weights.label, usual)
        whole = frames_of(Path(folder) / "whole")
        out = Path(folder) / "out"
        backend = Accumulation(ReadsAll(), accumulate_arrays)
        run(sequence, out, backend, weights.label, replace(usual, frames=tuple(frames)))
        part = frames_of(out)
        assert part == {name: data for name, data in whole.items() if frames[0] <= int(name.split(".")[-2]) <= frames[1]}
        summary = run(sequence, out, backend, weights.label, replace(usual, resume=True))
        assert frames_of(out) == whole
        assert summary.count("kept") == sum(name.startswith("frame") for name in part)


def test_a_still_picture_is_mixed_once(tmp_path):
    """Where nothing changes, the images of two frames before are shown again: they have the bits."""
    calls, alone = [], stss.open_backend("cl", "realtime", ComputeOptions(accumulate=False))
    opened = Accumulation(alone, lambda *arrays: (calls.append(arrays), alone.accumulate(*arrays))[1])
    without = stss.open_backend("cl", "realtime", ComputeOptions(accumulate=True, skip="off"))
    channels = frame_channels(0, (16, 24)) | {"motion.X": np.zeros((16, 24)), "motion.Y": np.zeros((16, 24))}
    for number in range(16):
        write_raw(tmp_path / f"seq.{number:04d}.exr", {**channels, "R": channels["R"] * (0.5 if number < 4 else 1)})
    frames = list(frames_in(tmp_path))
    for got, want in zip(*(stss.Supersampler(backend=each)(frames) for each in (opened, without)), strict=True):
        np.testing.assert_array_equal(got.image, want.image)
    assert len(calls) == 11  # at the twelfth frame three in a row are those of two frames before


@pytest.mark.parametrize(
    ("made_for", "words", "mixes"), [(ALIASED, [], True), (ALIASED, ["--no-accumulate"], False), ("", [], False)]
)
def test_weights_for_aliased_input_mix(sequence, tmp_path, made_for, words, mixes):
    path = tmp_path / "own.safetensors"
    save(path, load("bilinear").weights, {MADE_FOR: made_for} if made_for else {})
    run_words = ["run", str(sequence), "-o", str(tmp_path / "out"), "--backend", "ref", "--weights", str(path), "--frames", "3:3"]
    result = CliRunner().invoke(command, [*run_words, *words])
    assert result.exit_code == 0, result.exception
    method = read_header(tmp_path / "out" / "frame.0003.exr").attributes["stss:method"]
    assert method == ("network, accumulate" if mixes else "network")
    shown = CliRunner().invoke(command, ["weights", "inspect", str(path)]).output
    assert ("made for: aliased frames" in shown) == bool(made_for)


def test_of_the_shipped_weights_realtime_mixes():
    names = "realtime", "antialiased", "bilinear"
    assert [isinstance(stss.open_backend("ref", name), Accumulation) for name in names] == [True, False, False]
