"""Frames that are mixed with those shown before them: files, an engine's loop, and what may not go with it."""

import numpy as np
import pytest
from click.testing import CliRunner

import stss
from stss.cli.main import stss as command
from stss.frames.compute_options import ComputeOptions
from stss.images.read_write import read_rgb
from stss_ground.errors import InputError
from stss_ref.accumulate import accumulate

SIZE = (8, 16)


@pytest.fixture
def sequence(write_frames):
    """Six frames, of which every second has colour."""
    return write_frames(range(6), size=SIZE)


def loop(**options):
    return stss.Supersampler("bilinear", backend="ref", transfer="none", **options)


def frames_of(sequence, cut=None):
    opened = stss.open_sequence(sequence)
    for number in opened.numbers:
        buffers = opened.load(number, color=number % 2 == 0)
        yield buffers if number != cut else stss.Buffers(**{**vars(buffers), "cut": True})


def test_each_image_is_mixed_with_the_one_shown_before_it(sequence):
    frames = list(frames_of(sequence))
    before = None
    for output, alone, buffers in zip(loop(accumulate=True)(frames), loop()(frames), frames, strict=True):
        want = alone.image if before is None else accumulate(alone.image, before, np.asarray(buffers.motion, np.float32))
        np.testing.assert_array_equal(output.image, want)
        assert before is None or (want != alone.image).any()
        before = want


def test_a_cut_shows_the_frame_as_it_is(sequence):
    frames = list(frames_of(sequence, cut=2))
    for output, alone in zip(loop(accumulate=True)(frames), loop()(frames), strict=True):
        assert (output.image == alone.image).all() == (output.number in (0, 2))


def test_sequences_in_turns_have_a_history_each(sequence):
    backend = stss.open_backend("ref", "bilinear", ComputeOptions(accumulate=True))
    frames = list(frames_of(sequence))
    alone = [output.image for output in loop(accumulate=True)(frames)]
    first, second = (stss.Supersampler(backend=backend, transfer="none") for _ in range(2))
    for want, buffers in zip(alone, frames, strict=True):
        for each in (first, second):
            np.testing.assert_array_equal(each.push(buffers).image, want)
    del first, second, each
    assert backend._images == {}


def test_the_device_and_files(sequence, tmp_path):
    """The command's frames are the reference's; a range has the bits of the whole."""
    run = ["run", str(sequence), "--weights", "bilinear", "--accumulate"]
    for words in (["-o", "cl"], ["-o", "ref", "--backend", "ref"], ["-o", "range", "--frames", "3:4"]):
        result = CliRunner().invoke(command, [*run, "-o", str(tmp_path / words[1]), *words[2:]])
        assert result.exit_code == 0, result.exception
    for number in range(6):
        name = f"frame.{number:04d}.exr"
        images = [read_rgb(tmp_path / folder / name) for folder in ("cl", "ref")]
        np.testing.assert_allclose(*images, rtol=0, atol=2**-20)
        if number in (3, 4):
            np.testing.assert_array_equal(images[0], read_rgb(tmp_path / "range" / name))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--resume"], "--resume: each output depends on all before it, so none can be kept; expected --overwrite"),
        (["--cluster", "local:2"], "--cluster: with --accumulate each output depends on all before it; expected one of the two"),
    ],
)
def test_what_needs_frames_alone_is_refused(sequence, tmp_path, words, message):
    out = tmp_path / "out"
    result = CliRunner().invoke(command, ["run", str(sequence), "-o", str(out), "--weights", "bilinear", "--accumulate", *words])
    assert isinstance(result.exception, InputError)
    assert message in str(result.exception)
    assert not out.exists()
