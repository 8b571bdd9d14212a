# SPDX-License-Identifier: MIT
"""Add the inputs of NSRR and the aims of ExtraNet to shards, of analytic films or of a renderer's sequences.

The folder that is made has the same samples with the same truth; 28 channels follow the 35 of `training.samples`: colour and depth of
the frame itself and of four rendered ones before it, then the motions to these.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path

import numpy as np

from stss.frames.display_frame import DisplayFrame, make_display_frame
from stss.images.color import transfer
from stss.run.options import RunOptions
from stss.sequence.reader import open_sequence
from stss_ground.errors import InputError
from stss_ref.arrays import Image
from stss_ref.motion_chain import chain_steps
from stss_ref.schedule import FrameKind
from training.command import command
from training.rivals.networks import EARLIER
from training.samples import HISTORIES, NOWHERE, Sample, film_frames, write
from training.scenes import random_film


def five_frames(frames: Mapping[int, DisplayFrame], colors: Mapping[int, Image], number: int, *, rendered: bool) -> Image:
    """The inputs of NSRR, (H, W, 28).

    Where the sequence starts too late, its first rendered frame stands in for earlier ones.

    Args:
        frames: number -> display frame, ``number`` and those before it.
        colors: number -> colour (H, W, 3), of ``number`` and of rendered frames.
        number: the frame that is made.
        rendered: whether it is rendered; the earlier ones are every second frame before it, else from the one before it on.
    """
    first = number - (2 if rendered else 1)
    there = [n for n in range(first, first - 2 * EARLIER, -2) if n in colors] or [number]
    earlier = there + there[-1:] * (EARLIER - len(there))
    steps = [np.zeros_like(frames[number].motion)]
    steps += chain_steps(np.stack([frames[n].motion for n in range(number, earlier[-1], -1)])) if earlier[-1] < number else []
    flows = [np.clip(np.nan_to_num(steps[number - n], nan=NOWHERE), -NOWHERE, NOWHERE) for n in earlier]
    pictures = [plane for n in (number, *earlier) for plane in (colors[n], frames[n].gbuffer[..., 3:4])]
    return np.concatenate([*pictures, *flows], axis=-1, dtype=np.float32)


def film(name: str, size: tuple[int, int]) -> Iterator[DisplayFrame]:
    """The display frames of the analytic film whose shard has this name."""
    _, seed, kind = name.split("-")
    for buffers in film_frames(random_film(int(seed), kind), size, max(HISTORIES) + 1):
        yield make_display_frame(buffers, transfer("srgb"), "scale")


def clip(folder: Path) -> Iterator[DisplayFrame]:
    """The display frames of a renderer's sequence: ``folder`` holds ``lr``, and ``camera.csv`` if there is one."""
    camera = folder / "camera.csv"
    sequence = open_sequence(folder / "lr", camera=camera if camera.exists() else None)
    usual = RunOptions.of(sequence.profile, transfer=None, depth=None)
    for number in sequence.numbers:
        yield make_display_frame(sequence.load(number), transfer(usual.transfer), usual.depth)


def extend(shard: Path, of: Iterator[DisplayFrame], out: Path) -> None:
    """Write a shard anew, with NSRR's inputs, from the display frames that it was made of."""
    index = json.loads((shard / "index.json").read_text())
    inputs, truth = (np.load(shard / f"{name}.npy", mmap_mode="r") for name in ("inputs", "truth"))
    numbers, kinds = index["frames"], index["kinds"]
    frames = {frame.number: frame for frame in takewhile(lambda frame: frame.number <= max(numbers), of)}
    colors = {n: frame.color for n, frame in frames.items() if frame.color is not None}
    samples: list[Sample] = []
    for i, (number, name) in enumerate(zip(numbers, kinds, strict=True)):
        more = five_frames(frames, colors, number, rendered=name == "SF")
        samples.append(Sample(number, FrameKind(name), np.concatenate([inputs[i], more], axis=-1, dtype=np.float32), truth[i]))
    write(out / shard.name, index["scene"], index["split"], index["hole_fill"], samples, [shard])


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.samples``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.samples", description=__doc__)
    parser.add_argument("shards", type=Path, help="folder of shards, made by python -m training.samples")
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument(
        "--clips", type=Path, help="folder of the sequences NAME/lr, NAME/camera.csv of shards NAME of --sequence"
    )
    options = parser.parse_args(arguments)
    shards = sorted(path.parent for path in options.shards.glob("*/index.json"))
    if not shards:
        raise InputError(f"{options.shards}: no shards; python -m training.samples makes them")
    for shard in shards:
        if (options.out / shard.name / "index.json").exists():
            continue
        if shard.name.startswith("analytic-"):
            frames = film(shard.name, np.load(shard / "inputs.npy", mmap_mode="r").shape[1:3])
        elif options.clips is None:
            raise InputError(f"{shard}: no analytic film; expected --clips, the folder of the sequences")
        else:
            frames = clip(options.clips / shard.name)
        extend(shard, frames, options.out)


if __name__ == "__main__":
    command(main)
