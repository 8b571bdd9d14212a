"""`stss run --preview`, and what the progress line says."""

import io

import numpy as np
import pytest
from rich.console import Console

from stss.images.color import transfer
from stss.images.read_write import read_header, read_rgb, write_rgb
from stss.run.frame_job import FrameReport
from stss.run.options import RunOptions
from stss.run.preview import EVERY, Preview, require_preview
from stss_ground.errors import InputError
from stss_ground.progress import A_MINUTE, show_progress
from stss_ref.schedule import FrameKind


def report(number, outcome="done", cost=None):
    return FrameReport(number, FrameKind.SF, outcome, cost=cost)


@pytest.mark.parametrize("suffix", ["exr", "png"])
def test_a_picture_now_and_then(tmp_path, suffix):
    now = [0.0]
    preview = Preview(tmp_path / "p.png", tmp_path, RunOptions(format=suffix), clock=lambda: now[0])
    shown = []
    for number in range(5):
        write_rgb(tmp_path / f"frame.{number:04d}.{suffix}", np.full((4, 6, 3), number / 8, np.float32))
        preview.show(report(number, "left out" if number == 0 else "done"))
        if (tmp_path / "p.png").exists():
            shown.append(int(read_header(tmp_path / "p.png").attributes["stss:frame"]))
        now[0] += EVERY / 2
    assert shown == [1, 1, 3, 3]
    level = read_rgb(tmp_path / f"frame.0003.{suffix}")[0, 0]
    expected = level if suffix == "png" else transfer("srgb").display(level.reshape(1, 1, 3))[0, 0]
    assert np.abs(read_rgb(tmp_path / "p.png")[0, 0] - expected).max() < 1 / 255


def test_a_place_that_cannot_be_is_said_before_the_run(tmp_path):
    write_rgb(tmp_path / "read.png", np.zeros((1, 1, 3), np.float32))
    for path in (tmp_path / "p.exr", tmp_path / "no" / "p.png", tmp_path / "read.png"):
        with pytest.raises(InputError, match="--preview"):
            require_preview(path, tmp_path / "out", [tmp_path / "read.png"])


def test_a_log_file_gets_a_line_a_minute():
    now = [0.0]
    console = Console(file=io.StringIO(), width=100)
    with show_progress(console, 10, clock=lambda: now[0]) as advance:
        for _ in range(10):
            now[0] += A_MINUTE / 2.5
            advance()
    assert console.file.getvalue().splitlines() == [
        "3 of 10 frames, 0.04 frames/s, 0:02:48 left",
        "6 of 10 frames, 0.04 frames/s, 0:01:36 left",
        "9 of 10 frames, 0.04 frames/s, 0:00:24 left",
    ]
