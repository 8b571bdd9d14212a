# SPDX-License-Identifier: MIT
"""Render a set of scenes, split by scene into train, validation and test; may be stopped and started again.

    python make_set.py --python BPY/bin/python --scenes 64 --jobs 2 -o set

Needs only the standard library itself; `--python` is one that has `bpy`.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from scenes import SPLITS, describe

ROUND = 8
"""Of so many scenes one is for validation and one for the test."""


KINDS = ("any", "clean", "woven", "level")
"""What `--kind` may choose: every scene, those with exact light, of these those that patterns near the pixel's size cover, and of
these those seen by a level camera before a wall."""


def plan(scenes: int, kind: str = "any", frames: int = 1) -> list[tuple[str, int]]:
    """Split and seed of each scene, mixed, so that a set that was stopped early has some of each; seeds of other kinds are left out."""

    def suitable(split: str) -> Iterator[int]:
        return (seed for seed in count() if kind == "any" or describe(seed, split, frames)[kind])

    seeds = {split: suitable(split) for split in SPLITS}
    splits = ({3: "validation", 7: "test"}.get(i % ROUND, "train") for i in range(scenes))
    return [(split, next(seeds[split])) for split in splits]


def folder_of(output: Path, split: str, seed: int) -> Path:
    """Where a scene goes."""
    return output / split / f"{seed:04}"


def start(given: argparse.Namespace, split: str, seed: int) -> subprocess.Popen[bytes]:
    """Start to render a scene; its lines go to a log beside the frames."""
    folder = folder_of(given.output, split, seed)
    folder.mkdir(parents=True, exist_ok=True)
    command = [given.python, "-W", "ignore", str(Path(__file__).with_name("render.py")), "--scene", str(seed), "--split", split]
    command += ["--size", given.size, "--frames", str(given.frames), "--threads", "1", "-o", str(folder)]
    command += [
        "--samples",
        str(given.samples),
        "--truth-samples",
        str(given.truth_samples if split == "train" else given.test_samples),
    ]
    command += ["--truth-frames", *map(str, given.truth_frames)] if given.truth_frames else []
    command += ["--antialiased"] if given.antialiased else []
    if nice := shutil.which("nice"):
        command = [nice, "-n", str(given.nice), *command]
    with (folder / "log.txt").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)


def say(text: str) -> None:
    """A line of progress."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def render_all(given: argparse.Namespace) -> list[Path]:
    """Render what is not finished, several at a time; returns the folders of the scenes that failed."""
    todo = [
        (split, seed)
        for split, seed in plan(given.scenes, given.kind, given.frames)
        if not (folder_of(given.output, split, seed) / "scene.json").exists()
    ]
    say(f"{given.output}: {given.scenes} scenes, {given.scenes - len(todo)} finished")
    running: dict[tuple[str, int], subprocess.Popen[bytes]] = {}
    waiting, failed, done, begin = list(todo), [], 0, time.monotonic()
    try:
        while waiting or running:
            while waiting and len(running) < given.jobs:
                scene = waiting.pop(0)
                running[scene] = start(given, *scene)
            time.sleep(0.5)
            for scene, process in list(running.items()):
                if process.poll() is None:
                    continue
                del running[scene]
                done += 1
                if process.returncode:
                    failed.append(folder_of(given.output, *scene))
                left = (time.monotonic() - begin) / done * (len(todo) - done)
                verdict = "failed: see log.txt" if process.returncode else "finished"
                say(f"{done}/{len(todo)} {scene[0]} {scene[1]:04} {verdict}; {left / 60:.0f} min left")
    finally:
        for process in running.values():
            process.terminate()
    return failed


def main() -> None:
    """Status 1 if a scene failed."""
    parser = argparse.ArgumentParser(description="Render a set of scenes, split by scene.")
    parser.add_argument("--python", default=sys.executable, help="a Python that has bpy")
    parser.add_argument("--scenes", type=int, default=64, help="in all; more later adds to the set")
    parser.add_argument("--kind", choices=KINDS, default="any", help="of scenes; the others' seeds are left out")
    parser.add_argument("--size", default="160x90", help="of the small frames")
    parser.add_argument("--frames", type=int, default=12, help="of each scene")
    parser.add_argument("--samples", type=int, default=32, help="of a small frame's pixel")
    parser.add_argument("--truth-samples", type=int, default=16, help="of a truth's pixel, for training")
    parser.add_argument(
        "--test-samples", type=int, default=36, help="the same for validation and test: noise would count as error"
    )
    parser.add_argument("--truth-frames", type=int, nargs="+", metavar="N", help="which frames get a truth; default: all")
    parser.add_argument("--antialiased", action="store_true", help="samples spread over the pixel, G-buffer and all")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="scenes rendered at the same time, one thread each")
    parser.add_argument("--nice", type=int, default=19)
    parser.add_argument("-o", "--output", type=Path, required=True)
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that its children end with it
    failed = render_all(given)
    for folder in failed:
        say(f"failed: {folder}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
