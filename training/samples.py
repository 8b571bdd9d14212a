# SPDX-License-Identifier: MIT
"""Make training samples: the network's inputs for a display frame, from the project's own pipeline, and the truth.

Each sequence has a folder with ``inputs.npy`` (N, H, W, 35) and ``truth.npy`` (N, 2H, 2W, 3), float16, display-referred, and
``index.json``, which is written last: a folder without it does not count. Channels of the inputs: first colour 3, gbuffer 9,
history 3 x (warped 3, mask 1), motion 2, `details` 9. The network's color 6 and mask are among them (`unpack`). Motion leads to the
display frame before, in pixels; it is NOWHERE where the surface is not seen there.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from conformance.scenes import render
from stss.cli.options import MAX_COUNT, sequence_options
from stss.frames.buffers import Buffers
from stss.frames.display_frame import WINDOW, DisplayFrame, frame_inputs, make_display_frame, same_surface, schedule_of, window_at
from stss.images.color import transfer
from stss.images.headers import MAX_SIDE
from stss.quality.output_and_truth import find_images, read_shown, require_size
from stss.run.options import RunOptions
from stss.sequence.conventions import BACKGROUND_POSITION
from stss.sequence.reader import SequenceOptions
from stss_ground.commands import Subcommand, gather_options
from stss_ground.errors import InputError
from stss_ground.option_kinds import ReadPath, Size, WrittenFolder
from stss_ground.output.write_whole import whole_folder
from stss_ground.terminal import echo
from stss_ref.arrays import Array, Image
from stss_ref.constants import HOLE_FILLS, HoleFill
from stss_ref.frame import FrameInputs, NetworkInputs, detail_of, motion_by_step, prepare
from stss_ref.resample import upsample_centres
from stss_ref.schedule import FrameKind
from training.command import command
from training.scenes import INPUTS, Film, random_film

SPLITS = ("training", "validation", "test")
NOWHERE = 1e4
"""Motion of pixels that cannot be followed, finite as float16."""
SAMPLES = 16
"""Number of rays for each pixel of the analytic truth."""
SIDE = 3
"""The mean over a low-resolution pixel takes SIDE x SIDE rays; odd, so that one ray goes through the centre."""
HISTORIES = (6, 7, 9)
"""Display frames of a film that get a truth and have five predecessors."""
FAR = 15.0
"""PSNR of bilinear upsampling, dB: right sequences have 20 and more, the truth of another scene 8 to 13."""
START = 2
"""One more frame with a truth; the start of the film cuts its history short."""


@dataclass(frozen=True)
class Sample:
    """One display frame, as SF or as EF: ``inputs`` (H, W, 35), ``truth`` (2H, 2W, 3), display-referred."""

    number: int
    kind: FrameKind
    inputs: Image
    truth: Image


def samples(frames: Sequence[DisplayFrame], truths: Mapping[int, Image], hole_fill: HoleFill) -> Iterator[Sample]:
    """Yield every frame with a truth twice, as a rendered frame (SF) and as an extrapolated one (EF).

    Args:
        frames: consecutive display frames, each with its colour.
        truths: frame number -> (2H, 2W, 3) display-referred.
        hole_fill: the stage that fills the holes.
    """
    for i, last in enumerate(frames):
        if last.number not in truths:
            continue
        for kind, odd in ((FrameKind.SF, 0), (FrameKind.EF, 1)):
            window = [
                frame if (last.number - frame.number) % 2 == odd else replace(frame, color=None) for frame in window_at(frames, i)
            ]
            schedule = schedule_of(window)
            if schedule is not None and len(window) > 1:
                frame_planes = frame_inputs(window, schedule.steps)
                inputs = pack(
                    prepare(frame_planes, hole_fill=hole_fill), _motion(window[-2], last), details(frame_planes, hole_fill)
                )
                yield Sample(last.number, kind, inputs, truths[last.number])


def _motion(before: DisplayFrame, now: DisplayFrame) -> Image:
    return np.where(same_surface(before, now)[..., None], now.motion, np.float32(NOWHERE))


def details(inputs: FrameInputs, hole_fill: HoleFill) -> Image:
    """The second colour "detail" of R, G and B apart, (H, W, 9): across, down, level. Augmentation lets the colours change places."""
    first = prepare(inputs, hole_fill=hole_fill).color[..., :3]
    motions, pair = motion_by_step(inputs.motions, inputs.steps), (inputs.colors, first)
    planes = [detail_of(inputs, motions, *(np.repeat(x[..., c : c + 1], 3, axis=-1) for x in pair)) for c in range(3)]
    return np.stack(planes, axis=-1).reshape(*inputs.nov.shape, 9)


def pack(inputs: NetworkInputs, motion: Image, of_pixels: Image) -> Image:
    """The network's inputs, the motion and `details` as (H, W, 35); channels that occur twice are stored once."""
    height, width, _ = inputs.gbuffer.shape
    history = np.moveaxis(inputs.history, 0, 2).reshape(height, width, 12)
    return np.concatenate([inputs.color[..., :3], inputs.gbuffer, history, motion, of_pixels], axis=-1)


def unpack(packed: Array) -> NetworkInputs:
    """The network's inputs of an array of `pack`."""
    height, width, _ = packed.shape
    history = np.moveaxis(packed[..., 12:24].reshape(height, width, 3, 4), 2, 0)
    color = np.concatenate([packed[..., :3], packed[..., 20:23]], axis=-1)
    return NetworkInputs(color, packed[..., 3:12], packed[..., 23], np.ascontiguousarray(history))


def film_frames(film: Film, size: tuple[int, int], count: int) -> Iterator[Buffers]:
    """The first ``count`` display frames of a film."""
    for number in range(count):
        planes = _planes(film, size, number)
        background = np.isinf(planes["depth"])[..., None]
        planes["position"] = np.where(background, np.float32(BACKGROUND_POSITION), planes["position"])
        yield Buffers(number=number, **planes)


def _planes(film: Film, size: tuple[int, int], number: int) -> dict[str, NDArray[np.float32]]:
    height, width = size
    if not film.averaged:
        r = render(film.at(number), number, height, width)
        return {name: getattr(r, name).astype(np.float32) for name in r.__dataclass_fields__}
    r = render(film.at(number), number, SIDE * height, SIDE * width)
    planes: dict[str, NDArray[np.float32]] = {}
    for name in r.__dataclass_fields__:
        plane: Array = getattr(r, name)
        if name in film.averaged:
            plane = plane.reshape(height, SIDE, width, SIDE, *plane.shape[2:]).mean(axis=(1, 3))
        else:
            plane = plane[SIDE // 2 :: SIDE, SIDE // 2 :: SIDE]
        planes[name] = plane.astype(np.float32)
    planes["motion"] /= SIDE
    return planes


def film_samples(film: Film, size: tuple[int, int], hole_fill: HoleFill) -> Iterator[Sample]:
    """The samples of an analytic film."""
    curve, numbers = transfer("srgb"), (START, *HISTORIES)
    frames = [make_display_frame(buffers, curve, "scale") for buffers in film_frames(film, size, max(numbers) + 1)]
    doubled = 2 * size[0], 2 * size[1]
    truths = {n: curve.encode(render(film.at(n), n, *doubled, samples=SAMPLES).color) for n in numbers}
    return samples(frames, truths, hole_fill)


def sequence_samples(low: Path, high: Path, reading: SequenceOptions, hole_fill: HoleFill) -> Iterator[Sample]:
    """The samples of a renderer's sequence: frames that have a truth, within runs of consecutive frames; as ``stss run`` reads them."""
    sequence = reading.open(low)
    usual = RunOptions.of(sequence.profile, transfer=None, depth=None)
    curve, truths = transfer(usual.transfer), find_images(high)
    window: list[DisplayFrame] = []
    for number in sequence.numbers:
        if number not in sequence.rendered:
            raise InputError(
                f"{low}: frame {number} has no colour; expected the colour of every frame, from which training takes both halves"
            )
        if window and number != window[-1].number + 1:
            window.clear()
        window = [*window[1 - WINDOW :], make_display_frame(sequence.load(number), curve, usual.depth)]
        if number in truths:
            truth = read_shown(truths[number], curve, reading.non_finite)
            require_size(truths[number], truth, low, (2 * sequence.size[0], 2 * sequence.size[1]))
            yield from samples(window, {number: truth}, hole_fill)


def nearness(film: Sequence[Sample]) -> float:
    """PSNR of the samples' first colours, enlarged, over R, G and B; dB, at most 99."""
    errors = [np.mean((upsample_centres(sample.inputs[..., :3]) - sample.truth) ** 2) for sample in film]
    return min(-10 * math.log10(np.mean(errors) + 1e-12), 99.0)


def split_of(scene: str) -> str:
    """The split of a scene, the same for all its sequences: about one scene in ten is for validation, and one for the test."""
    return {0: "validation", 1: "test"}.get(int(hashlib.sha256(scene.encode()).hexdigest(), 16) % 10, "training")


FILES = {"inputs.npy", "truth.npy", "index.json"}
"""The files of a shard."""


def require_shard(folder: Path, reads: Sequence[Path] = ()) -> None:
    """Refuse to replace anything but a shard: the existing folder is removed when the new one is complete.

    Args:
        folder: absent, or a shard.
        reads: folders that are read; the shard is neither one of them nor above or below one.

    Raises:
        InputError: it is something else.
    """
    place = folder.resolve()
    for read in (path.resolve() for path in reads):
        if place in (read, *read.parents) or read in place.parents:
            raise InputError(f"{folder}: lies above or below {read}, which is read; expected another --out or --name")
    if os.path.lexists(folder):
        files = (
            {path.name for path in folder.iterdir() if path.is_file()} if folder.is_dir() and not folder.is_symlink() else None
        )
        if files != FILES or len(list(folder.iterdir())) != len(FILES):
            raise InputError(f"{folder}: expected nothing there, or a shard of {', '.join(sorted(FILES))} alone")


def write(
    folder: Path, scene: str, split: str, hole_fill: HoleFill, samples: Iterable[Sample], reads: Sequence[Path] = ()
) -> int:
    """Write samples as a shard, whole or not at all; see `require_shard`. Returns their number."""
    require_shard(folder, reads)
    rows = list(samples)
    if not rows:
        raise InputError(f"{folder.name}: no frame has a truth and a history")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with whole_folder(folder) as new:
        for name, arrays in (("inputs", [s.inputs for s in rows]), ("truth", [s.truth for s in rows])):
            half: NDArray[np.float16] = np.stack(arrays).astype(np.float16)
            if not np.isfinite(half).all():
                raise InputError(f"{folder.name}: {name}: not finite as float16")
            np.save(new / f"{name}.npy", half)
        index = {"scene": scene, "split": split, "frames": [s.number for s in rows], "kinds": [s.kind.value for s in rows]}
        (new / "index.json").write_text(json.dumps({**index, "hole_fill": hole_fill}))
        require_shard(folder, reads)
        shutil.rmtree(folder, ignore_errors=True)
    return len(rows)


def write_film(seed: int, inputs: str, size: tuple[int, int], hole_fill: HoleFill, split: str | None, out: Path) -> str:
    """Write the shard of the analytic film number ``seed``, unless it exists in this size, fill and split. Returns a line to print."""
    film = random_film(seed, inputs)
    scene, name = film.scene.name, f"{film.scene.name}-{inputs}"
    split = split or split_of(scene)
    if (index := out / name / "index.json").exists():
        there = json.loads(index.read_text())
        shape = np.load(out / name / "inputs.npy", mmap_mode="r").shape
        if (there.get("hole_fill", HOLE_FILLS[0]), there["split"], shape[1:3]) == (hole_fill, split, size):
            return f"{name}: there"
    return f"{name}: {write(out / name, scene, split, hole_fill, film_samples(film, size, hole_fill))} samples"


@dataclass(frozen=True)
class FilmChoice:
    """The analytic films to make: the options of these names."""

    analytic: int
    first: int
    inputs: str
    size: tuple[int, int]
    jobs: int


@dataclass(frozen=True)
class RenderingChoice:
    """The frames of a renderer to cut samples from: the options of these names."""

    sequence: tuple[Path, Path] | None
    name: str | None
    scene: str | None


@click.command(cls=Subcommand, help=__doc__.splitlines()[0] if __doc__ else None)
@click.option("-o", "--out", type=WrittenFolder(), required=True, help="Folder of the shards.")
@click.option(
    "--hole-fill",
    type=click.Choice(HOLE_FILLS),
    default=HOLE_FILLS[0],
    show_default=True,
    help="The stage that fills the holes; that of the weights that the run starts from, reshade for realtime.",
)
@click.option("--split", type=click.Choice(SPLITS), help="The shard's split  [default: drawn from the scene's name, 8 : 1 : 1]")
@gather_options(
    "Analytic films",
    "films",
    FilmChoice,
    click.option("--analytic", type=click.IntRange(0, MAX_COUNT), default=0, metavar="N", help="Make N random analytic films."),
    click.option("--first", type=click.IntRange(0), default=0, help="Number of the first film."),
    click.option(
        "--inputs", type=click.Choice(list(INPUTS)), default="aliased", help="The films' inputs that are means over the pixel."
    ),
    click.option("--size", type=Size(MAX_SIDE), default="160x96", show_default=True, help="Size of the films' small frames."),
    click.option("--jobs", type=click.IntRange(1), default=1, help="Processes."),
)
@gather_options(
    "A renderer's frames",
    "rendering",
    RenderingChoice,
    click.option("--sequence", nargs=2, type=ReadPath(), metavar="LR HR", help="Frames of a renderer and their truth."),
    click.option("--name", help="Name of the shard  [default: that of the folder above LR]"),
    click.option("--scene", help="Sequences of one scene go into one split  [default: the name]"),
)
@sequence_options
def make(
    out: Path,
    hole_fill: HoleFill,
    split: str | None,
    films: FilmChoice,
    rendering: RenderingChoice,
    reading: SequenceOptions,
) -> None:
    """``python -m training.samples``."""
    if rendering.sequence is None and not films.analytic:
        raise InputError("expected --sequence LR HR or --analytic N, found neither")
    if rendering.sequence is not None:
        low, high = rendering.sequence
        name = rendering.name or low.resolve().parent.name
        if name in ("", ".", "..") or not {"/", "\\"}.isdisjoint(name):
            raise InputError(f"--name {name}: expected the name of a folder, without separators")
        scene = rendering.scene or name
        require_shard(out / name, [low, high])
        part, film = split or split_of(scene), list(sequence_samples(low, high, reading, hole_fill))
        count = write(out / name, scene, part, hole_fill, film, [low, high])
        near = nearness(film)
        doubt = f"; below {FAR:g}: is {high} the truth of {low}?" if near < FAR else ""
        echo(f"{name}: {count} samples for {part}; bilinear upsampling has {near:.1f} dB{doubt}")
    work = partial(write_film, inputs=films.inputs, size=films.size, hole_fill=hole_fill, split=split, out=out)
    with ProcessPoolExecutor(films.jobs) as pool:
        for line in pool.map(work, range(films.first, films.first + films.analytic)):
            echo(line)


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.samples``."""
    make.main(arguments, prog_name="python -m training.samples", standalone_mode=False)


if __name__ == "__main__":
    command(main)
