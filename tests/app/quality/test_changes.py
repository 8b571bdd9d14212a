# SPDX-License-Identifier: MIT
"""Flicker: changes along the motion."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stss.images.read_write import write_rgb
from stss.quality.compare import compare, facts
from stss.sequence.reader import open_sequence
from stss_ground.errors import InputError

SIZE = (16, 24)


def slides_by(dx, dy):
    """The frames of conftest's plane with this motion instead of its own."""

    def change(number, channels):
        channels["motion.X"], channels["motion.Y"] = np.full(SIZE, float(dx)), np.full(SIZE, float(dy))
        channels["stencil.X"] = np.zeros(SIZE)
        for i, name in enumerate(("position.X", "position.Y")):
            y, x = np.indices(SIZE)
            channels[name] = (x + dx * number, y + dy * number)[i].astype(float)  # the same point where motion leads

    return change


@pytest.fixture
def sequence(write_frames):
    """Make a sequence of six frames with this motion."""

    def make(dx, dy):
        return open_sequence(write_frames(range(6), size=SIZE, change=slides_by(dx, dy), folder=f"in{dx}{dy}"), "stss")

    return make


def texture(dx=0, dy=0):
    """(2H, 2W, 3) levels of 8 bits, moved by whole pixels; the pattern repeats, so nothing comes into view."""
    levels = np.random.default_rng(3).integers(60, 180, (2 * SIZE[0], 2 * SIZE[1], 3))
    return np.roll(levels, (dy, dx), (0, 1)) / 255


def write(folder, images, *, labelled=True):
    folder.mkdir()
    for number, image in enumerate(images):
        labels = {"stss:kind": "EF" if number % 2 else "SF", "stss:transfer": "none"}
        write_rgb(folder / f"frame.{number:04d}.png", image, metadata=labels if labelled else None)
    return folder


def near(value, expected):
    """Equal but for float32 rounding of values up to 255."""
    return abs(value - expected) < 1e-4


def flicker(*folders_and_sequence, frames=None):
    """The comparison, and what flickers in each of its frames."""
    out, truth, input_frames = folders_and_sequence
    comparison = compare(out, truth, sequence=input_frames, frames=frames)
    return comparison, [row.scores["all"].flicker for row in comparison.rows]


def test_what_moves_as_its_motion_says_does_not_flicker(sequence, tmp_path):
    """By one low-resolution pixel right and two down a frame, that is 2 and 4; the motion leads back."""
    out = write(tmp_path / "out", [texture(2 * n, 4 * n) + 8 / 255 * (n % 2) for n in range(6)])
    truth = write(tmp_path / "truth", [texture(2 * n, 4 * n) for n in range(6)])
    assert all(near(error, 8) for error in flicker(out, truth, sequence(-1, -2))[1][1:])
    assert flicker(truth, truth, sequence(-1, -2))[1] == [None, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(("output", "truth", "error"), [(6, -2, 8), (4, 4, 0)])
def test_flicker_is_a_change_that_the_truth_has_not(sequence, tmp_path, output, truth, error):
    """Every second frame so many levels brighter: both still, both flicker, the light changes."""
    folders = [
        write(tmp_path / name, [texture() + levels / 255 * (n % 2) for n in range(6)])
        for name, levels in (("out", output), ("truth", truth))
    ]
    values, errors = flicker(*folders, sequence(0, 0))
    assert errors[0] is None
    assert [mean.name for mean in values.means] == ["SF", "EF", "MEAN"]
    assert all(near(x, error) for x in (*errors[1:], *(mean.scores["all"].flicker for mean in values.means)))


def test_what_cannot_be_followed_is_left_out(sequence, tmp_path, write_frames):
    """An object that is not the one of the previous frame: its pixels flicker, and do not count."""

    def change(number, channels):
        slides_by(0, 0)(number, channels)
        channels["stencil.X"][4:8, 6:12] = number % 2

    noisy = texture()
    noisy[8:16, 12:24] = 1
    frames = open_sequence(write_frames(range(6), size=SIZE, change=change), "stss")
    out = write(tmp_path / "out", [noisy if n % 2 else texture() for n in range(6)])
    truth = write(tmp_path / "truth", [texture()] * 6)
    assert flicker(out, truth, frames)[1][1:] == [0] * 5
    assert min(flicker(out, truth, sequence(0, 0))[1][1:]) > 1


def test_nothing_to_follow_is_no_number(sequence, tmp_path):
    images = [texture()] * 6
    out, truth = write(tmp_path / "out", images, labelled=False), write(tmp_path / "truth", images)
    values, errors = flicker(out, truth, sequence(99, 0))
    assert errors == [None] * 6
    assert json.loads(values.to_json())["means"]["all"]["all"]["flicker"] is None
    assert any(line == "flicker of the steps: all -" for line in facts(values))


def test_only_frames_in_a_row_count(sequence, tmp_path):
    out, truth = write(tmp_path / "out", [texture()] * 6), write(tmp_path / "truth", [texture()] * 6)
    (out / "frame.0003.png").unlink()
    assert flicker(out, truth, sequence(0, 0))[1] == [None, 0, 0, None, 0]
    short = sequence(0, 0).part(range(2))
    assert flicker(out, truth, short)[1] == [None, 0, None, None, None]


def test_sizes_must_fit_the_sequence(sequence, tmp_path):
    images = [texture()[:-2]] * 6
    with pytest.raises(InputError, match=r"frame\.0000\.png: expected 48 x 32 pixels to go with .*, found 48 x 30"):
        flicker(write(tmp_path / "out", images), write(tmp_path / "truth", images), sequence(0, 0))
