# SPDX-License-Identifier: MIT
"""Display frames one after the other: stage ``frame`` for each, computing only where something changed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stss_cl.device.discovery import Device, open_device
from stss_cl.device.grid import ceil8
from stss_cl.frame import Frame
from stss_cl.image_space.frame_planes import MOST_STEPS, check_steps
from stss_cl.image_space.stages import Gather
from stss_cl.network.layer_builder import dtype_of
from stss_cl.network.layers import Layers
from stss_cl.network.network import Precision
from stss_cl.network.strips import bytes_for
from stss_cl.skip.display_frame import DisplayFrame
from stss_cl.skip.error_control import Attention
from stss_cl.skip.frame_cache import FrameCache, Last, Report
from stss_cl.skip.uploaded_frames import Tiles, UploadedFrame, UploadedFrames, sources
from stss_ref.arrays import ArrayError, require_dtype, require_shape
from stss_ref.weights import Weights

Skip = Literal["off", "exact", "bounded"]
SKIPS: tuple[Skip, ...] = ("off", "exact", "bounded")
"""``off``: every frame is computed whole. ``exact``: what did not change is kept, with the bits of ``off``. ``bounded``: where a camera
moves, flat tiles are left out besides."""


class Stream:
    """Stage ``frame`` (spec 11) for display frames as they come; buffers are made once for each size and reused.

    Args:
        weights: the 92 tensors.
        device: to run on; None = ``stss_cl.device.discovery.open_device()``.
        precision: see ``stss_cl.network.network.PRECISIONS``.
        gather: how the motion chain reads between pixels.
        memory_limit: see ``stss_cl.network.network.Network``; where what is kept does not fit, nothing is left out.
        skip: of ``SKIPS``.
        max_error: for ``bounded``: how far the image may be from that of ``off``, in units of the image. Held by checks: every so
            many frames one is computed whole, which shows what leaving out makes (docs/skipping.md says how often it is missed).

    Attributes:
        report: what the last frame cost.
    """

    def __init__(
        self,
        weights: Weights,
        device: Device | None = None,
        precision: Precision = "float32",
        gather: Gather = "longest",
        memory_limit: int | None = None,
        skip: Skip = "exact",
        max_error: float = 0.0,
    ):
        self.device = open_device() if device is None else device
        self.precision: Precision = precision
        self.report = Report(1.0, 1.0, "whole")
        self._whole = Frame(weights, self.device, precision, gather, memory_limit)
        self._gather: Gather = gather
        self._weights, self._memory = weights, self.device.memory // 2 if memory_limit is None else memory_limit
        self._skip: Skip = skip
        self._max_error, self._attention = max_error if skip == "bounded" else 0.0, Attention()
        self._uploaded: UploadedFrames | None = None
        self._caches: dict[bool, FrameCache] = {}
        self._latest: FrameCache | None = None

    def __call__(
        self, window: Sequence[DisplayFrame], steps: Sequence[int], out: NDArray[np.float32] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Compute the last frame of ``window``.

        Nothing of a call depends on those before it but the time it takes. Frames are known again by being the same objects, from one
        window to the next. On a processor their arrays are read in place, and those of a window are compared with what arrives in the
        next one: nothing of a frame may change until a call without it, which already finds the frame's arrays free for another one.
        A caller that hands in windows of six thus needs six sets of arrays, and an object for each frame.

        Args:
            window: consecutive display frames of one size, oldest first.
            steps: how many frames back the three colour frames lie, newest first; ``window`` holds them.
            out: (2H, 2W, 3) float32, C-contiguous: what the image is copied to; None: the stream lends its own.

        Returns:
            image: (2H, 2W, 3) float32, not clipped: ``out``, or an array that is read-only where something is kept, since it may be the
                last frame's. That never changes while it, or a view of it, is in somebody's hands.
            valid: (H, W) False in the warping holes of the newest colour frame; likewise.

        Raises:
            ArrayError: shapes, dtypes or steps are not a frame's, ``out`` is not an image's, or an array other than motion and position
                is not finite.
        """
        if out is None:
            return self._next(window, steps)
        height, width = window[-1].nov.shape
        require_shape("out", out, (2 * height, 2 * width, 3))
        require_dtype("out", out, np.dtype(np.float32))
        if not (out.flags.c_contiguous and out.flags.writeable):
            raise ArrayError("out: expected a C-contiguous array that can be written to")
        image, valid = self._next(window, steps)
        np.copyto(out, image)
        return out, valid

    def _next(self, window: Sequence[DisplayFrame], steps: Sequence[int]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        chosen = check_steps(steps)
        if len(window) <= chosen[2]:
            raise ArrayError(f"window: expected the {chosen[2] + 1} frames that the steps lead to, got {len(window)}")
        if any(window[-1 - step].color is None for step in chosen):
            raise ArrayError(f"window: expected a colour {', '.join(map(str, chosen))} frames back")
        window, size = window[-MOST_STEPS - 1 :], window[-1].nov.shape
        if self._latest is not None:
            self._latest.network.settle()
        uploaded, cache = self._arriving(size), self._keep(size, extrapolates=chosen[0] > 0)
        looking = self._attention.begin()
        held = uploaded.take(window, compare=cache is not None and looking)
        self._latest = cache
        if cache is None:
            self.report = Report(1.0, 1.0, "whole")
            return self._whole.compute(sources(held, chosen), size)
        dirty = self._dirty(uploaded, cache, held, cache.read(chosen)) if cache.control.needs_changes else None
        return self._compute(cache, held, chosen, dirty, window[-1 - chosen[0]].color)

    def expect(self, size: tuple[int, int]) -> None:
        """Build what the first call for frames of (H, W) would wait for, such as while that frame is being read."""
        self._arriving(size)
        if self._keep(size, extrapolates=False) is None:
            self._whole.expect(size)

    def activity(self) -> NDArray[np.float32]:
        """How much of the network the last frame took, for each 4 x 4 of its pixels: 0 nothing, 1 everything.

        Of a frame that was computed where something changed it is the share of the stored activations that came to differ; of one of
        which something was left out, see ``FrameCache.activity``.
        """
        assert self._uploaded is not None, "no frame was computed yet"
        rows, columns = (-(-length // 4) for length in self._uploaded.size)
        network = self.report.network
        if self._latest is None or network in ("none", "whole"):
            return np.full((rows, columns), network != "none", np.float32)
        shares = self._latest.network.activity() if network == "changed" else self._latest.activity()
        return shares[:rows, :columns]

    def _compute(
        self,
        cache: FrameCache,
        held: list[UploadedFrame],
        steps: tuple[int, int, int],
        dirty: Tiles | None,
        color: NDArray[np.float32] | None,
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Plan the frame, execute the plan, learn. ``dirty``, ``color``: see ``ErrorControl``."""
        control, last = cache.control, cache.last
        inputs = control.plan_inputs(dirty)
        if last is not None and inputs.nothing:
            self.report = Report(0.0, 0.0, "none")
            cache.last = _last(held, cache.read(steps), last.valid)
            return cache.image.show(), last.valid
        changed = cache.prepare_inputs(sources(held, steps), inputs)
        plan = control.plan(inputs, changed, color)
        departure, valid = cache.execute(plan)
        control.learn(plan, departure)
        self.report = Report(1.0 if dirty is None else float(dirty.mean()), changed, plan.network, departure)
        cache.last = _last(held, cache.read(steps), valid)
        return cache.image.show(), valid

    def _arriving(self, size: tuple[int, int]) -> UploadedFrames:
        if self._uploaded is None or self._uploaded.size != size:
            self._caches.clear()
            self._uploaded = UploadedFrames(self.device, *size)
        return self._uploaded

    def _keep(self, size: tuple[int, int], *, extrapolates: bool) -> FrameCache | None:
        """What is kept of SFs, or of EFs; None: nothing is."""
        if self._skip == "off":
            return None
        if extrapolates not in self._caches:
            if not self._can_keep(size):
                self._skip = "off"
                return None
            layers = Layers(
                self.device, self._weights, *size, self.precision, self._memory, self._whole.network.residual, keep=True
            )
            self._caches[extrapolates] = FrameCache(self.device, layers, self._gather, self._max_error, self._attention)
        return self._caches[extrapolates]

    def _can_keep(self, size: tuple[int, int]) -> bool:
        """Whether the limit is enough to keep all of an SF and all of an EF."""
        height, width = map(ceil8, size)
        return 2 * bytes_for(height, height, width, dtype_of(self.precision), keep=True) <= self._memory

    def _dirty(
        self, uploaded: UploadedFrames, cache: FrameCache, held: list[UploadedFrame], steps: tuple[int, ...]
    ) -> Tiles | None:
        """Where the network's inputs may differ from those of the last frame of the kind; None: everywhere.

        They are the same where, in all frames that either read, nothing moves and the surface is the same, and so are the colours.
        """
        last = cache.last
        if last is None or _missing(steps) != _missing(last.steps):
            return None
        oldest, newest = min(last.oldest, held[-1 - steps[-1]].number), max(last.number, held[-1].number)
        moved = uploaded.changed(oldest, newest)
        if moved is None:
            return None
        for step, before in zip(steps, last.colors, strict=True):
            recolored = uploaded.color_changed(held[-1 - step].number, before)
            if recolored is None:
                return None
            moved = moved | recolored
        return moved


def _last(held: list[UploadedFrame], steps: tuple[int, ...], valid: NDArray[np.bool_]) -> Last:
    return Last(held[-1].number, held[-1 - steps[-1]].number, steps, tuple(held[-1 - step].number for step in steps), valid)


def _missing(steps: tuple[int, ...]) -> list[bool]:
    """Which older colour frames stand in for missing ones."""
    return [older == newer for newer, older in pairwise(steps)]
