# SPDX-License-Identifier: MIT
"""Methods that take the camera's jitter, as backends: our `taau`, and the temporal upsamplers that others made."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from stss.frames.buffers import Buffers
from stss.frames.display_frame import DisplayFrame, OnHost, frame_inputs
from stss.images.color import Transfer
from stss_ground.errors import InputError
from stss_lab.baselines.taau import Taau
from stss_ref.arrays import Image, Mask, Plane
from stss_ref.frame import prepare

Offset = tuple[float, float]
"""The shift of a frame's image by jitter in low-resolution pixels, x right, y down."""


@dataclass(frozen=True)
class Jittered:
    """The inputs of a temporal upsampler of a frame.

    Attributes:
        color: (H, W, 3) linear, in [0, 1]; in an EF the newest rendered frame, warped to the current one.
        motion: (H, W, 2) low-resolution pixels, current -> previous, without jitter.
        depth: (H, W) view depth in the renderer's unit, > 0; 1e9 where nothing was hit.
        offset, before: of this picture and of the one before.
        first: nothing of earlier frames is used.
    """

    color: Image
    motion: Image
    depth: Plane
    offset: Offset
    before: Offset
    first: bool


class Upsampler(Protocol):
    """Computes the linear image (2H, 2W, 3) of each frame in turn."""

    def __call__(self, frame: Jittered) -> Image:
        """Compute the frame that follows the last one."""
        ...


class JitteredBackend(OnHost):
    """An upsampler, or `Taau`, as a `stss.frames.backends.Backend`.

    Args:
        method: the name in the files' metadata.
        upsampler: called with each frame.
        offsets: frame -> `Offset`; frames that are not there have none.
        read: a frame's buffers, by its number.
        curve: to what a screen shows, and back.
    """

    name, window, cost = "numpy", None, None

    def __init__(
        self,
        method: str,
        upsampler: Upsampler | Taau,
        offsets: Mapping[int, Offset],
        read: Callable[[int], Buffers],
        curve: Transfer,
    ):
        self.method, self._upsampler, self._offsets, self._read, self._curve = method, upsampler, offsets, read, curve
        self._before: Offset | None = None

    def expect(self, size: tuple[int, int]) -> None:
        """See `stss.frames.backends.Backend`: nothing needs to be prepared."""

    def compute(self, window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> tuple[Image, Mask]:
        """See `stss.frames.backends.Backend`; frames come in display order."""
        inputs, number = frame_inputs(window, steps), window[-1].number
        prepared, offset = prepare(inputs), self._offsets.get(window[-1].number, (0.0, 0.0))
        valid = prepared.mask.astype(bool)
        if isinstance(self._upsampler, Taau):
            return self._upsampler(inputs, prepared), valid
        first = max(steps) == 0 or self._before is None
        before = offset if self._before is None else self._before
        shift = np.subtract(before, offset, dtype=np.float32)
        depth = self._read(number).depth
        frame = Jittered(
            self._curve.decode(prepared.color[..., :3]),
            np.nan_to_num(window[-1].motion - shift, nan=1e4, posinf=1e4, neginf=-1e4),
            np.where(np.isfinite(depth), np.minimum(depth, 1e9), 1e9).astype(np.float32),
            offset,
            before,
            first,
        )
        self._before = offset
        return self._curve.encode(self._upsampler(frame)), valid


def read_offsets(path: Path | None) -> dict[int, Offset]:
    """Read a CSV of frame,x,y; None: no jitter.

    Raises:
        InputError: the file can't be read, or a line is of another form.
    """
    if path is None:
        return {}
    try:
        rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        return {int(row["frame"]): (float(row["x"]), float(row["y"])) for row in rows}
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected lines of frame,x,y ({error})") from error
