# SPDX-License-Identifier: MIT
"""``make kills``: processes of ``run`` and ``gather`` that are killed, each at a random moment, and the files afterwards.

``python -m tests.hostile.run_kills 100`` is the number of kills. Each is killed up to three times; then the command is given once more,
and the folder must have the bytes of an undisturbed run. ``test_kills.py`` goes through every moment, without processes.
"""

import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

from stss.frames.backends import open_backend
from stss.run.gather import gather
from stss.run.job import run
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss.weights.file import load
from tests.app.conftest import files, frame_channels, write_raw

FRAMES = 12


def write_frames(folder):
    """A sequence of frames of 8 x 8 pixels, every second rendered."""
    folder.mkdir()
    for number in range(FRAMES):
        write_raw(folder / f"seq.{number:04d}.exr", frame_channels(number, (8, 8), number % 2 == 0))


def run_frames(frames, out, numbers=None):
    """``stss run --resume``."""
    weights = load("bilinear")
    run(open_sequence(frames, "stss"), out, open_backend("ref", weights), weights.label, RunOptions(frames=numbers, resume=True))


def in_a_process(command, seconds=None):
    """Run it in a fork of this process, killed after so many seconds; how long it took, and whether it was killed."""
    start, child = time.monotonic(), os.fork()
    if child == 0:
        status = 1
        try:
            command()
            status = 0
        finally:
            os._exit(status)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(child, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status not in (0, -signal.SIGKILL):
        raise SystemExit(f"status {status}")
    return time.monotonic() - start, status != 0


def kill_often(name, times, prepare, command, right):
    """Print how often the command was killed before its end, and end with status 1 where its folder is not right afterwards."""
    prepare()
    took, _ = in_a_process(command)
    right()
    kills = processes = 0
    while kills < times:
        prepare()
        for _ in range(random.randint(1, 3)):
            _, killed = in_a_process(command, random.uniform(0, took))
            kills, processes = kills + killed, processes + 1
            if not killed:
                break
        if killed:
            in_a_process(command)
        right()
    print(f"{name}: {kills} kills of {processes} processes of {took:.2f} s, the same bytes after each", flush=True)


def main(times):
    """Kill both so often."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames, out, parts, backup = folder / "frames", folder / "out", folder / "parts", folder / "kept"
        in_a_process(lambda: write_frames(frames))  # here alone, as all else: threads of OpenImageIO would not survive a fork
        in_a_process(lambda: run_frames(frames, folder / "one"))
        for part in range(4):
            numbers = (3 * part, 3 * part + 2)
            in_a_process(lambda numbers=numbers, part=part: run_frames(frames, backup / str(part), numbers))
        want = files(folder / "one")

        def right():
            if files(out) != want or (parts.exists() and any(parts.iterdir())):
                raise SystemExit(f"{sorted(files(folder))}: not as an undisturbed run leaves it")

        def prepare():
            shutil.rmtree(out, ignore_errors=True)
            shutil.rmtree(parts, ignore_errors=True)

        def gather_parts():
            if parts.exists() and any(parts.iterdir()):
                gather(parts, out, frames)

        kill_often("stss run", times, prepare, lambda: run_frames(frames, out), right)
        kill_often("stss gather", times, lambda: (prepare(), shutil.copytree(backup, parts)), gather_parts, right)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
