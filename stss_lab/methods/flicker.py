# SPDX-License-Identifier: MIT
"""Measure flicker: how the colour of followed surfaces changes from frame to frame, compared with the truth."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from stss.frames.display_frame import DisplayFrame, prepare
from stss.images.color import transfer
from stss.images.resample import enlarged
from stss.quality.metrics import PEAK
from stss.quality.output_and_truth import KINDS, Pair, find_pairs, require_size
from stss.quality.tables import print_whole
from stss.sequence.reader import Sequence as Frames
from stss_ground.errors import InputError
from stss_ground.progress import Track
from stss_ref.arrays import Image, Mask
from stss_ref.holes import holes
from stss_ref.sample import follow, leads_inside
from stss_ref.warp import warp

COLUMNS = ("output", "truth", "error")


@dataclass(frozen=True)
class Change:
    """How a frame changed since the one before it, or a mean over frames, in 8-bit levels. None: nothing could be followed.

    Attributes:
        output: how much the output changes, ``mean |d|``.
        truth: how much the truth changes: ``mean |d*|``.
        error: how much the two changes differ: ``mean |d - d*|``. It also shows flicker that blur hides in ``output``.
    """

    output: float | None
    truth: float | None
    error: float | None


@dataclass(frozen=True)
class FrameFlicker:
    """One frame: its number, "SF" or "EF" or None, its change, and the share of pixels that could be followed."""

    number: int
    kind: str | None
    change: Change
    followed: float


@dataclass(frozen=True)
class Flicker:
    """The result of ``flicker``: frames in order; means by kind, and over all frames as ``all``."""

    rows: Sequence[FrameFlicker]
    means: Mapping[str, Change]

    def to_json(self) -> str:
        """As JSON; null where nothing could be followed."""
        frames = [{"frame": r.number, "kind": r.kind, **asdict(r.change), "followed": r.followed} for r in self.rows]
        means = {name: asdict(mean) for name, mean in self.means.items()}
        return json.dumps({"frames": frames, "means": means}, indent=2, allow_nan=False)


def flicker(
    out: Path,
    truth: Path,
    sequence: Frames,
    *,
    frames: tuple[int, int] | None = None,
    track: Track = iter,
) -> Flicker:
    """Follow each surface by the sequence's motion, and measure how its colour changes.

    ``d(p) = out_t(p) - out_{t-1}(p + motion_t(p))``, and ``d*`` is the same of the truth. Means run over the pixels whose motion leads
    into the frame and to the surface seen now (spec 4). Images are taken as a screen shows them, times 255. Motion and holes come from
    the low-resolution G-buffer, whose pixels stand for four each.

    Args:
        out: frames, numbered as the sequence's.
        truth: the frames that they should equal.
        sequence: has motion and G-buffer of every frame.
        frames: first and last to measure, both included; None: all. The first has no frame before it.
        track: as for `stss.quality.compare.compare`.

    Raises:
        InputError: a folder does not exist, a file cannot be read, sizes do not fit, or no two frames follow each other.
    """
    pairs, _, _ = find_pairs(out, truth, frames)
    numbers = [n for n in pairs if n - 1 in pairs and n in sequence.frames and n - 1 in sequence.frames]
    if not numbers:
        raise InputError(f"{out}: expected two frames in a row that {truth} and {sequence.path} have, found none")
    rows: list[FrameFlicker] = []
    before: tuple[int, tuple[Image, Image], DisplayFrame] | None = None
    for number in track(numbers):
        if before is None or before[0] != number - 1:
            before = number - 1, _shown(pairs[number - 1], sequence), _load(sequence, number - 1)
        now, buffers = _shown(pairs[number], sequence), _load(sequence, number)
        motion, followed = display_motion(before[2], buffers)
        change, _ = change_between(before[1], now, motion, followed)
        rows.append(FrameFlicker(number, pairs[number].kind, change, float(followed.mean())))
        before = number, now, buffers
    return Flicker(rows, _means(rows))


def display_motion(before: DisplayFrame, now: DisplayFrame) -> tuple[Image, Mask]:
    """Bring the motion between two frames to display resolution, and find where it can be followed.

    Args:
        before: the earlier frame, (H, W).
        now: the one after it.

    Returns:
        motion: (2H, 2W, 2) display pixels, now -> before.
        followed: (2H, 2W) True where it leads to the same surface within the frame.
    """
    valid = holes(
        now.motion,
        stencil_previous=before.stencil,
        stencil=now.stencil,
        normal_previous=before.gbuffer[..., :3],
        normal=now.gbuffer[..., :3],
        position_previous=before.position,
        position=now.position,
        nov=now.nov,
        depth=now.gbuffer[..., 3],
    )
    motion = enlarged(2 * now.motion)
    return motion, enlarged(valid) & leads_inside(follow(motion))


def change_between(before: tuple[Image, Image], now: tuple[Image, Image], motion: Image, followed: Mask) -> tuple[Change, float]:
    """Measure the change of one frame since another, and the largest ``|d - d*|`` of all pixels, in 8-bit levels.

    Args:
        before: output and truth, each (H, W, 3), display-referred, in [0, 1].
        now: likewise.
        motion: (H, W, 2) pixels, now -> before.
        followed: (H, W) True where pixels count.
    """
    d, d_true = ((b - warp(a, motion)[0])[followed] * PEAK for a, b in zip(before, now, strict=True))
    if not d.size:
        return Change(None, None, None), 0.0
    off = np.abs(d - d_true)
    return Change(*(float(x.mean(dtype=np.float64)) for x in (np.abs(d), np.abs(d_true), off))), float(off.max())


def print_flicker(found: Flicker, console: Console) -> None:
    """Print a table of frames and means."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for heading in ("frame", "kind", *COLUMNS, "followed"):
        table.add_column(heading, justify="left" if heading == "kind" else "right")
    for row in found.rows:
        table.add_row(str(row.number), row.kind or "", *_cells(row.change), f"{row.followed:.1%}")
    table.add_section()
    for name, mean in found.means.items():
        table.add_row("mean", name, *_cells(mean), style="bold")
    print_whole(table, console)


def _shown(pair: Pair, sequence: Frames) -> tuple[Image, Image]:
    image, truth = pair.load()
    require_size(pair.output, image, sequence.path, (2 * sequence.size[0], 2 * sequence.size[1]))
    return image, truth


def _load(sequence: Frames, number: int) -> DisplayFrame:
    buffers = sequence.load(number, color=False)
    return prepare(buffers, transfer("none"), sequence.profile.depth_normalisation)


def _means(rows: Sequence[FrameFlicker]) -> dict[str, Change]:
    groups = {kind: [row.change for row in rows if row.kind == kind] for kind in KINDS}
    groups["all"] = [row.change for row in rows]

    def mean(changes: Sequence[Change], name: str) -> float | None:
        values = [getattr(change, name) for change in changes]
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if known else None

    return {name: Change(*(mean(of, field.name) for field in fields(Change))) for name, of in groups.items() if of}


def _cells(change: Change) -> list[str]:
    values = [getattr(change, name) for name in COLUMNS]
    return ["-" if value is None else f"{value:.2f}" for value in values]
