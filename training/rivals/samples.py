# SPDX-License-Identifier: MIT
"""Add the inputs of NSRR and the aims of ExtraNet to the shards of analytic films.

The folder that is made has the same samples with the same truth; 28 channels follow the 35 of `training.samples`: colour and depth of
the frame itself and of four rendered ones before it, then the motions to these.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from stss.frames.display_frame import DisplayFrame, make_display_frame
from stss.images.color import transfer
from stss_ground.errors import InputError
from stss_ref.arrays import Image
from stss_ref.motion_chain import chain_steps
from stss_ref.schedule import FrameKind
from training.command import command
from training.rivals.networks import EARLIER
from training.samples import NOWHERE, Sample, film_frames, write
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


def extend(shard: Path, out: Path) -> None:
    """Write the shard of an analytic film anew, with NSRR's inputs."""
    index = json.loads((shard / "index.json").read_text())
    inputs, truth = (np.load(shard / f"{name}.npy", mmap_mode="r") for name in ("inputs", "truth"))
    _, seed, kind = shard.name.split("-")
    film, numbers, kinds = random_film(int(seed), kind), index["frames"], index["kinds"]
    display_frames = (
        make_display_frame(b, transfer("srgb"), "scale") for b in film_frames(film, inputs.shape[1:3], max(numbers) + 1)
    )
    frames = {frame.number: frame for frame in display_frames}
    colors = {n: frame.color for n, frame in frames.items() if frame.color is not None}
    samples: list[Sample] = []
    for i, (number, name) in enumerate(zip(numbers, kinds, strict=True)):
        more = five_frames(frames, colors, number, rendered=name == "SF")
        samples.append(Sample(number, FrameKind(name), np.concatenate([inputs[i], more], axis=-1, dtype=np.float32), truth[i]))
    write(out / shard.name, index["scene"], index["split"], index["hole_fill"], samples, [shard])


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.samples``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.samples", description=__doc__)
    parser.add_argument("films", type=Path, help="folder of analytic films, made by python -m training.samples --analytic")
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    shards = sorted(path.parent for path in options.films.glob("analytic-*/index.json"))
    if not shards:
        raise InputError(f"{options.films}: no analytic films; python -m training.samples --analytic makes them")
    for shard in shards:
        if not (options.out / shard.name / "index.json").exists():
            extend(shard, options.out)


if __name__ == "__main__":
    command(main)
